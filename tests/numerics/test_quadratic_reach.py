"""Reach under quadratic bounds: clarabel, closed forms, a sweep of directions, Cholesky in mpmath.

Clarabel stops at a relative gap of 1e-9 to 1e-10, so 1e-7 is what a comparison of its values can
hold; semidefinite problems come out a little worse, 1e-6. Clarabel is given the problems in good
units only: bad units are a known change of the same problem.
"""

import itertools

import clarabel
import mpmath
import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.numerics.quadratic_reach import inner, largest, outer

KINDS = ("steps", "windows", "nested", "faded")


def weights(kind, T):
    """Constraints on single steps, on windows of three, on all prefixes, on faded sums."""
    age = np.arange(T)[:, None] - np.arange(T)
    return {
        "steps": np.eye(T),
        "windows": ((age >= 0) & (age < 3)) * 1.0,
        "nested": (age >= 0) * 1.0,
        "faded": np.where(age >= 0, 0.7 ** np.maximum(age, 0), 0.0),
    }[kind]


def drawn(seed, kind, q, d=None, r=2):
    """A problem in good units; half of them causal, with moves that only later steps show."""
    rng = np.random.default_rng(seed)
    d = int(rng.integers(2, 9)) if d is None else d
    T = -(-d // r) + int(rng.integers(0, 4))
    Z = rng.normal(size=(T, r, d))
    if seed % 2:
        begin = np.minimum(np.arange(d) // r, T - 1)
        Z = Z * (np.arange(T)[:, None] >= begin)[:, None] * 0.5
        Z[begin, np.arange(d) % r, np.arange(d)] += 2.0
    w = weights(kind, T)
    return Z, w, rng.uniform(0.5, 2.0, T) * np.sum(w, 1), rng.normal(size=(q, d))


def forms(Z, w):
    """All M_j."""
    return np.einsum("ji,ird,ire->jde", w, Z, Z)


def solved(cost, A, right, cones, accuracy=1e-10):
    options = clarabel.DefaultSettings()
    options.verbose = False
    options.tol_gap_abs = options.tol_gap_rel = options.tol_feas = accuracy
    P = sp.csc_matrix((len(cost), len(cost)))
    found = clarabel.DefaultSolver(P, cost, sp.csc_matrix(A), right, cones, options).solve()
    assert "Solved" in str(found.status)
    return found


def by_cones(Z, w, b, c):
    """The largest c'theta, by clarabel's second-order cones."""
    A, right, cones = [], [], []
    for row, bound in zip(w, b, strict=True):
        shifts = np.concatenate([np.sqrt(a) * z for a, z in zip(row, Z, strict=True) if a > 0])
        A += [np.zeros((1, len(c))), -shifts]
        right += [[np.sqrt(bound)], np.zeros(len(shifts))]
        cones.append(clarabel.SecondOrderConeT(1 + len(shifts)))
    return -solved(-c, np.vstack(A), np.concatenate(right), cones).obj_val


def by_semidefinite(Z, w, b, B):
    """The least b'mu with mu >= 0, M(mu) >= B'B, by clarabel's semidefinite cone."""
    i, j = np.triu_indices(B.shape[1])
    order = np.lexsort((i, j))
    i, j = i[order], j[order]

    def packed(S):
        return S[..., i, j] * np.where(i == j, 1.0, np.sqrt(2.0))

    m = len(b)
    A = np.vstack([-np.eye(m), -packed(forms(Z, w)).T])
    right = np.concatenate([np.zeros(m), -packed(B.T @ B)])
    cones = [clarabel.NonnegativeConeT(m), clarabel.PSDTriangleConeT(B.shape[1])]
    return solved(b, A, right, cones, 1e-9).obj_val


def used(Z, w, b, theta):
    """theta' M_j theta / b_j."""
    return w @ np.sum((Z @ theta) ** 2, 1) / b


def proved(Z, w, b, B, mu, value):
    """Whether mu shows |B theta|^2 <= value (1 + 1e-12), in 50 digits."""
    with mpmath.workdps(50):
        M = mpmath.matrix(B.shape[1], B.shape[1])
        for i, z in enumerate(Z):
            weight = sum(
                mpmath.mpf(float(m)) * mpmath.mpf(float(a))
                for m, a in zip(mu, w[:, i], strict=True)
            )
            M += weight * (mpmath.matrix(z.tolist()).T * mpmath.matrix(z.tolist()))
        goal = mpmath.matrix(B.tolist())
        S = M * (1 + mpmath.mpf("1e-12")) - goal.T * goal
        try:
            mpmath.cholesky(S)
        except ValueError:
            return False
        return min(mu) >= 0 and abs(mpmath.fdot(mu.tolist(), b.tolist()) / value - 1) < 1e-13


def checked(Z, w, b, B, found):
    """What always holds of `largest`."""
    assert np.max(used(Z, w, b, found.theta)) <= 1.0
    assert found.lower == pytest.approx(np.linalg.norm(B @ found.theta), rel=1e-13)
    assert found.lower <= found.upper * (1 + 1e-13)
    assert found.exact == (found.upper - found.lower <= 1e-7 * found.upper)
    assert proved(Z, w, b, B, found.mu, found.upper**2)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(10))
def test_one_row_is_the_convex_problem(kind, seed):
    Z, w, b, B = drawn(seed, kind, 1)
    truth = by_cones(Z, w, b, B[0])
    found = largest(Z, w, b, B)
    assert found.exact
    assert found.upper == pytest.approx(truth, rel=1e-7)
    assert found.lower == pytest.approx(truth, rel=1e-7)
    checked(Z, w, b, B, found)
    # the same in other units: of every move, of every step's shift, of B
    rng = np.random.default_rng(seed)
    move = 10.0 ** rng.uniform(-6, 6, Z.shape[2])
    shift = 10.0 ** rng.uniform(-3, 3)
    unit = 10.0 ** rng.uniform(-6, 6)
    scaled = (shift * Z * move, w, shift**2 * b, unit * B * move)
    found = largest(*scaled)
    assert found.exact
    assert found.upper == pytest.approx(unit * truth, rel=1e-7)
    checked(*scaled, found)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_conditions_of_optimality(kind, seed):
    Z, w, b, B = drawn(seed, kind, 1, d=12)
    found = outer(Z, w, b, B)
    theta, M = found.theta[:, 0], np.tensordot(found.mu, forms(Z, w), 1)
    # both feasible, and both products small: the conditions of the problem and its dual
    assert np.max(used(Z, w, b, theta)) <= 1.0
    assert proved(Z, w, b, B, found.mu, found.value)
    assert found.mu * b @ (1.0 - used(Z, w, b, theta)) <= 1e-9 * found.value
    assert abs(theta @ M @ theta - np.sum((B @ theta) ** 2)) <= 1e-9 * found.value
    # S theta = 0 itself only to the root of that, as |S theta|^2 <= |S| theta' S theta
    missed = M @ theta - B.T @ (B @ theta)
    whole = np.linalg.cholesky(np.tensordot(1.0 / b, forms(Z, w), 1))
    size = np.linalg.norm(np.linalg.solve(whole, B.T @ (B @ theta)))
    assert np.linalg.norm(np.linalg.solve(whole, missed)) <= 3e-5 * size


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("q", [2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_the_relaxation_is_clarabels(kind, q, seed):
    Z, w, b, B = drawn(seed, kind, q, r=1)
    found = outer(Z, w, b, B)
    assert found.converged
    assert found.value == pytest.approx(by_semidefinite(Z, w, b, B), rel=1e-6)
    assert np.max(w @ np.sum((Z @ found.theta) ** 2, 1) / b[:, None]) <= 1.0
    checked(Z, w, b, B, largest(Z, w, b, B))


@pytest.mark.parametrize("seed", range(6))
def test_a_few_directions_do_not_beat_the_ascent(seed):
    Z, w, b, B = drawn(seed, "steps", 2, d=3, r=1)
    found = largest(Z, w, b, B)
    angle = np.linspace(0, np.pi, 60, endpoint=False)
    swept = max(by_cones(Z, w, b, np.array([np.cos(a), np.sin(a)]) @ B) for a in angle)
    assert swept <= found.upper * (1 + 1e-7)
    assert found.lower >= swept * (1 - 1e-7)
    # the best of 60 directions is off the best of all by at most the cosine of their distance
    assert found.lower <= swept / np.cos(np.pi / 120) * (1 + 1e-7)


def vertices(Z, b):
    """Of |z_i theta| <= sqrt(b_i), two moves: all intersections that are feasible."""
    rows, root = Z[:, 0], np.sqrt(b)
    points = []
    for i, j in itertools.combinations(range(len(b)), 2):
        for sign in (-1.0, 1.0):
            points.append(np.linalg.solve(rows[[i, j]], [root[i], sign * root[j]]))
    points = np.array(points)
    return points[np.all(np.abs(points @ rows.T) <= root * (1 + 1e-9), 1)]


@pytest.mark.parametrize("seed", range(12))
def test_polygons_by_their_vertices(seed):
    rng = np.random.default_rng(seed)
    T = int(rng.integers(2, 7))
    Z, b, B = rng.normal(size=(T, 1, 2)), rng.uniform(0.5, 2.0, T), rng.normal(size=(2, 2))
    truth = np.max(np.linalg.norm(vertices(Z, b) @ B.T, axis=1))
    found = largest(Z, np.eye(T), b, B)
    assert found.lower == pytest.approx(truth, rel=1e-9)
    assert found.upper >= truth * (1 - 1e-12)
    checked(Z, np.eye(T), b, B, found)


@pytest.mark.parametrize("n", [3, 4, 5, 12])
def test_a_regular_polygon_has_a_gap(n):
    # 2 n sides at distance 1: X = I and mu = 2 / n are optimal, the corners at 1 / cos(pi / 2 n)
    angle = np.pi * np.arange(n) / n
    Z = np.stack([np.cos(angle), np.sin(angle)], 1)[:, None]
    found = largest(Z, np.eye(n), np.ones(n), np.eye(2))
    assert not found.exact
    assert found.upper == pytest.approx(np.sqrt(2.0), rel=1e-9)
    assert found.lower == pytest.approx(1.0 / np.cos(np.pi / 2 / n), rel=1e-9)
    np.testing.assert_allclose(np.sum(found.mu), 2.0, rtol=1e-9)


def test_a_box_is_exact_though_the_relaxation_is_not_unique():
    # X = I and X = (1, 1)(1, 1)' are both optimal: the corners are found by sums with signs
    for d in (2, 3, 5):
        Z = np.eye(d)[:, None]
        found = largest(Z, np.eye(d), np.ones(d), np.eye(d))
        assert found.exact
        assert found.upper == pytest.approx(np.sqrt(d), rel=1e-9)


def test_bounds_on_single_moves():
    rng = np.random.default_rng(0)
    d = 20
    B, b = rng.normal(size=(1, d)) * 10.0 ** rng.uniform(-3, 3, d), 10.0 ** rng.uniform(-4, 2, d)
    found = largest(np.eye(d)[:, None], np.eye(d), b, B)
    truth = np.sum(np.abs(B[0]) * np.sqrt(b))
    assert found.exact
    assert found.upper == pytest.approx(truth, rel=1e-9)
    assert found.lower == pytest.approx(truth, rel=1e-9)


@pytest.mark.parametrize("q", [1, 2, 4])
def test_a_single_bound_is_an_eigenvalue(q):
    Z, w, b, B = drawn(q, "steps", q, d=6)
    w, b = np.ones((1, len(Z))), np.array([0.3])
    M = forms(Z, w)[0]
    truth = b[0] * np.max(np.linalg.eigvalsh(B @ np.linalg.solve(M, B.T)))
    found = largest(Z, w, b, B)
    assert found.upper**2 == pytest.approx(truth, rel=1e-11)
    assert found.lower**2 == pytest.approx(truth, rel=1e-9)
    assert found.mu[0] == pytest.approx(truth / b[0], rel=1e-11)


def test_the_ascent_alone():
    Z, w, b, B = drawn(3, "steps", 2, d=6)
    above = outer(Z, w, b, B)
    for start in (None, above.theta, np.eye(6)[:, :1]):
        found = inner(Z, w, b, B, start)
        assert found.value == pytest.approx(np.linalg.norm(B @ found.theta), rel=1e-13)
        assert found.value <= np.sqrt(above.value)
        assert np.max(used(Z, w, b, found.theta)) <= 1.0
        # a fixed point: no feasible theta goes farther along B theta
        c = B @ found.theta / found.value
        assert by_cones(Z, w, b, c @ B) == pytest.approx(found.value, rel=1e-7)


def test_no_effect():
    Z, w, b, B = drawn(0, "windows", 3)
    found = largest(Z, w, b, 0.0 * B)
    assert (found.upper, found.lower, found.exact) == (0.0, 0.0, True)
    assert not np.any(found.mu)
    padded = np.vstack([B[:1], 0.0 * B[:2]])
    assert largest(Z, w, b, padded).upper == pytest.approx(largest(Z, w, b, B[:1]).upper, rel=1e-9)
    assert inner(Z, w, b, 0.0 * B).value == 0.0


def test_one_step_one_move():
    found = largest(np.full((1, 1, 1), 2.0), np.eye(1), np.array([9.0]), np.array([[-4.0]]))
    assert found.upper == pytest.approx(6.0, rel=1e-12)
    assert found.lower == pytest.approx(6.0, rel=1e-9)
    assert abs(found.theta[0]) == pytest.approx(1.5, rel=1e-9)


def test_bounds_that_do_not_bind():
    Z, w, b, B = drawn(2, "nested", 2, d=4)
    plain = largest(Z, w, b, B)
    # nothing in it, never active, only a step without shift, a repetition
    empty, loose = np.zeros((1, len(Z))), np.ones((1, len(Z)))
    Z = np.concatenate([Z, np.zeros((1, *Z.shape[1:]))])
    more = np.vstack([w, empty, loose, w[-1:]])
    more = np.hstack([more, np.eye(len(more))[:, [0]]])
    found = largest(Z, more, np.append(b, [1.0, 1e8, b[-1]]), B)
    assert found.upper == pytest.approx(plain.upper, rel=1e-8)
    assert found.lower == pytest.approx(plain.lower, rel=1e-8)
    assert np.all(found.mu[len(b) : len(b) + 2] <= 1e-8 * np.max(found.mu))


@pytest.mark.parametrize("q", [1, 2])
def test_bounds_far_apart(q):
    Z, w, b, B = drawn(4, "steps", q, d=6)
    b = b * 10.0 ** np.linspace(-4, 4, len(b))
    found = largest(Z, w, b, B)
    checked(Z, w, b, B, found)
    if q == 1:
        assert found.exact


@pytest.mark.parametrize("seed", range(6))
def test_a_badly_conditioned_shift_does_not_break_the_proof(seed):
    # singular values from 1 to 1e-9: the bounds move apart instead of passing each other
    rng = np.random.default_rng(seed)
    left, right = (np.linalg.qr(rng.normal(size=(8, 8)))[0] for _ in range(2))
    Z = (left * 10.0 ** np.linspace(0, -9, 8) @ right).reshape(4, 2, 8)
    b, B = rng.uniform(0.5, 2.0, 4), rng.normal(size=(2, 8))
    found = largest(Z, np.eye(4), b, B)
    assert proved(Z, np.eye(4), b, B, found.mu, found.upper**2)
    with mpmath.workdps(50):
        theta = mpmath.matrix(found.theta.tolist())
        for z, bound in zip(Z, b, strict=True):
            assert mpmath.norm(mpmath.matrix(z.tolist()) * theta) ** 2 <= bound
    assert found.lower <= found.upper
    assert found.lower >= 0.999 * found.upper


def test_refusals():
    Z, w, b, B = drawn(0, "steps", 2, d=4)
    unseen = Z @ np.diag([1.0, 1.0, 0.0, 1.0])
    for bad in (unseen, Z @ np.ones((4, 4)), Z[:1], 0.0 * Z):
        with pytest.raises(ValueError, match="no bound"):
            largest(bad, w[: len(bad), : len(bad)], b[: len(bad)], B)
    with pytest.raises(ValueError, match="no bound"):
        outer(Z, np.zeros_like(w), b, B)
    for arguments in ((Z[0], w, b, B), (Z, w[:, 1:], b, B), (Z, w, b[1:], B), (Z, w, b, B[0])):
        with pytest.raises(ValueError, match="T x r x d"):
            outer(*arguments)
    for arguments in ((Z, -w, b, B), (Z, w, 0.0 * b, B), (Z, w, b, B * np.nan)):
        with pytest.raises(ValueError, match="finite"):
            inner(*arguments)


def test_what_did_not_converge_is_said_and_still_a_bound(monkeypatch):
    Z, w, b, B = drawn(5, "windows", 2, d=8)
    truth = outer(Z, w, b, B)
    for rounds in range(1, 6):
        monkeypatch.setattr("holdfast.numerics.quadratic_interior.ROUNDS", rounds)
        found = outer(Z, w, b, B)
        assert not found.converged
        assert found.iterations == rounds
        assert found.value >= truth.value
        assert (1.0 - found.gap) * found.value <= truth.value * (1 + 1e-12)
        assert proved(Z, w, b, B, found.mu, found.value)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(KINDS), st.integers(1, 4), st.integers(1, 3))
def test_the_bounds_never_pass_each_other(seed, kind, q, r):
    Z, w, b, B = drawn(seed, kind, q, r=r)
    rng = np.random.default_rng(seed)
    B = B * 10.0 ** rng.uniform(-6, 6, (q, 1))
    b = b * 10.0 ** rng.uniform(-3, 3, len(b))
    found = largest(Z, w, b, B)
    checked(Z, w, b, B, found)
    assert found.exact or q > 1


@pytest.mark.slow
def test_five_thousand_directions():
    """The support function of the image at every direction, by the solver with one row."""
    Z, w, b, B = drawn(1, "windows", 2, d=3, r=1)
    found = largest(Z, w, b, B)
    angle = np.linspace(0, np.pi, 5_000, endpoint=False)
    ends = [outer(Z, w, b, np.array([[np.cos(a), np.sin(a)]]) @ B).theta[:, 0] for a in angle]
    swept = np.max(np.linalg.norm(np.array(ends) @ B.T, axis=1))
    assert found.lower >= swept * (1 - 1e-8)
    assert swept >= found.lower * np.cos(np.pi / 10_000) * (1 - 1e-8)
    assert swept <= found.upper * (1 + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("d", [60, 120])
def test_large_problems_converge(kind, d):
    for q in (1, 2, 5):
        Z, w, b, B = drawn(d + q, kind, q, d=d)
        found = outer(Z, w, b, B)
        assert found.converged
        assert found.iterations <= 40
        if q == 1:
            assert found.value == pytest.approx(by_cones(Z, w, b, B[0]) ** 2, rel=2e-7)
