"""Least absolute residuals against a simplex method, closed forms, and what a decoder may meet.

HiGHS stops within 1e-7; the rows of its basis are solved once more, so that its objective is good
to rounding. Zero rows and columns make one shape serve for many: two compilations see nearly all.
"""

from functools import cache
from typing import NamedTuple

import jax
import numpy as np
import pytest
from scipy.optimize import linprog

from holdfast.numerics import l1_regression as module
from holdfast.numerics import l1_vertex
from holdfast.numerics.l1_regression import l1_regression, sparsest

SMALL, WIDE, TALL, LARGE = (50, 10), (80, 8), (200, 20), (1000, 50)
NEAR = 1e-10
"""Difference of the objectives, relative; rounding, about 1e-16 times the condition of a basis."""
EXACT = 1e-9
"""Of a state that is recovered: rounding times the condition of the rows, here 1e4 at most."""


class Given(NamedTuple):
    Phi: np.ndarray
    y: np.ndarray
    weight: np.ndarray
    exact: np.ndarray


def given(Phi, y, weight=None, exact=None) -> Given:
    m = len(y)
    weight = np.ones(m) if weight is None else np.asarray(weight, float)
    return Given(Phi, np.asarray(y, float), weight, np.zeros(m, bool) if exact is None else exact)


@cache
def compiled():
    return jax.jit(l1_regression), jax.jit(jax.vmap(l1_regression))


def solve(p: Given):
    return jax.tree.map(np.asarray, compiled()[0](*p))


def padded(p: Given, shape=SMALL) -> Given:
    """With rows of weight 0, that say something, and columns of zeros."""
    m, n = p.Phi.shape
    Phi, y = np.ones(shape), np.full(shape[0], 7.0)
    Phi[:, n:] = 0.0
    Phi[:m, :n], y[:m] = p.Phi, p.y
    rest = np.zeros(shape[0] - m)
    return Given(Phi, y, np.append(p.weight, rest), np.append(p.exact, rest > 0))


# ---- the other solver


class Truth(NamedTuple):
    """The minimum by a basis, and a dual bound that nothing is below."""

    objective: float
    bound: float


def free(p: Given):
    """A, b: what the sum sees as b - A v once the exact rows are met."""
    rows, goal = p.Phi * p.weight[:, None], p.y * p.weight
    first = rows[p.exact]
    start = np.linalg.lstsq(first, goal[p.exact], rcond=1e-10)[0]
    _, values, basis = np.linalg.svd(first)
    rank = np.sum(values > 1e-10 * values[0]) if len(values) else 0
    A, b = rows @ basis[rank:].T, goal - rows @ start
    # what only rounding leaves of a row would look like a row
    A[np.abs(A) < 1e-12 * np.max(np.abs(rows), 1, keepdims=True)] = 0.0
    A[p.exact], b[p.exact] = 0.0, 0.0
    return A, b


def independent(A, order):
    """The first rows in this order that are linearly independent, as many as there are."""
    basis, chosen = np.zeros((0, A.shape[1])), []
    for j in order:
        length = np.linalg.norm(A[j])
        row = A[j] - basis.T @ (basis @ A[j])
        row = row - basis.T @ (basis @ row)
        size = np.linalg.norm(row)
        if size > 1e-9 * length > 0:
            basis = np.vstack([basis, row / size])
            chosen.append(j)
    return chosen


def least(p: Given) -> Truth:
    """By HiGHS on the dual, twice: its tolerances are absolute, so that next to residuals of 1e6
    the small ones are all alike. The second time the large ones are cut short, which is no other
    problem as long as they stay the large ones; whether it was, objective and bound tell.
    """
    A, b = free(p)
    if not A.any():
        return Truth(np.sum(np.abs(b)), np.sum(np.abs(b)))
    U, values, _ = np.linalg.svd(A, full_matrices=False)
    U = U[:, values > 1e-10 * values[0]]
    x, objective, bound = np.zeros(A.shape[1]), np.sum(np.abs(b)), 0.0
    for share in (1.0, 1e-3, 1e-5):
        left = b - A @ x
        most = share * np.max(np.abs(left), initial=1e-300)
        found, d, basis = by_highs(A, np.clip(left, -most, most) / most)
        x = x + most * found
        again = np.linalg.lstsq(A[basis], b[basis], rcond=1e-13)[0]
        tried = [np.sum(np.abs(b - A @ v)) for v in (x, again)]
        x, objective = (x, again)[int(np.argmin(tried))], min(objective, *tried)
        # rounding in the dual's equation
        for _ in range(2):
            d = d - U @ (U.T @ d)
        bound = max(bound, b @ d / max(1.0, np.max(np.abs(d))))
        if objective - bound <= 1e-13 * objective:
            break
    return Truth(objective, bound)


def by_highs(A, b):
    """x, the dual d, the rows that the basis meets; rows of length one, data of size one."""
    size = np.linalg.norm(A, axis=1)
    size[size == 0] = 1.0
    held = A / size[:, None]
    found = linprog(
        -b / size, A_eq=held.T, b_eq=np.zeros(A.shape[1]), bounds=np.stack([-size, size], 1),
        method="highs-ds",
    )  # fmt: skip
    assert found.status == 0, found.message
    d, x = found.x / size, -found.eqlin.marginals
    inside = np.abs(d) < 1 - 1e-7
    return x, d, independent(A, np.lexsort((np.abs(b - A @ x) / size, ~inside)))


class Off(NamedTuple):
    """Relative: above the basis, above the dual bound, and what is claimed."""

    basis: float
    bound: float
    claim: float


def compare(p: Given, found) -> Off:
    truth = least(p)
    said = np.sum(np.abs(np.where(p.exact, 0.0, p.weight * (p.y - p.Phi @ found.x))))
    # what is subtracted, and its rounding
    terms = np.sum(p.weight * (np.abs(p.y) + np.abs(p.Phi) @ np.abs(found.x)))
    size = max(truth.objective, 1e-4 * terms, 1e-300)
    rounding = 1e-15 * terms
    np.testing.assert_allclose(found.residual, p.y - p.Phi @ found.x, rtol=0, atol=1e-9 * size)
    np.testing.assert_allclose(found.objective, said, rtol=1e-12, atol=rounding)
    assert found.gap >= 0
    # the claim is an upper bound of what it is off by
    assert said - truth.objective <= found.gap + 10 * rounding
    return Off((said - truth.objective) / size, (said - truth.bound) / size, found.gap / size)


# ---- random windows


def observability(rng, m, n, p=10):
    """C, C A, C A^2 ..: the spectral radius about one, some sensors sparse, some alike."""
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.7, 1.05) / np.max(np.abs(np.linalg.eigvals(A)))
    C = rng.normal(size=(p, n)) * (rng.random((p, n)) < rng.choice([0.3, 1.0]))
    return np.concatenate([C @ np.linalg.matrix_power(A, t) for t in range(m)])[:m]


def drawn(kind: str, seed: int, shape=SMALL) -> Given:
    rng = np.random.default_rng(seed)
    (m, n), weight, exact = shape, None, None
    Phi, x, noise = rng.normal(size=shape), rng.normal(size=n), rng.normal(size=m)
    bad = rng.random(m) < 0.2
    if kind == "plant":
        Phi = observability(rng, m, n, min(m, 10))
        noise = noise * np.where(bad, 10.0, 0.01)
    elif kind == "huge":
        noise = noise * np.where(bad, 1e6, rng.choice([1.0, 1e-3, 0.0]))
    elif kind == "sparse":
        Phi, noise = Phi * (rng.random(shape) < 0.2), noise * bad
    elif kind == "ties":
        # repeated and parallel rows, small integers: the minimiser is often not the only one
        Phi = rng.integers(-1, 2, shape)[rng.integers(0, m // 2, m)].astype(float)
        noise, x = rng.integers(-2, 3, m).astype(float), 0.0 * x
    elif kind == "zero":
        Phi[bad] = 0.0
    elif kind == "levels":
        Phi = Phi * 10.0 ** rng.uniform(-2, 2, m)[:, None]
        noise = noise * 10.0 ** rng.uniform(-3, 3, m)
    elif kind == "weights":
        weight = 10.0 ** rng.uniform(-3, 3, m) * (rng.random(m) < 0.8)
    elif kind == "exact":
        exact = np.arange(m) < rng.integers(1, max(2, n))
    elif kind == "rank":
        Phi = Phi[:, :3] @ rng.normal(size=(min(3, n), n))
    elif kind == "absent":
        weight = 1.0 * (np.arange(m) < n - 2)
    return given(Phi, Phi @ x + noise, weight, exact)


KINDS = ("dense", "plant", "huge", "sparse", "ties", "zero", "levels", "weights", "exact", "rank",
         "absent")  # fmt: skip


def sweep(shape, seeds):
    """All kinds in turn; the largest of what they are off by."""
    worst, effort = Off(0.0, 0.0, 0.0), (0, 0)
    for seed in seeds:
        kind = KINDS[seed % len(KINDS)]
        p = drawn(kind, seed, shape)
        found = solve(p)
        off = compare(p, found)
        assert abs(off.basis) <= NEAR, (kind, seed, off, found.pivots, found.rounds)
        assert off.bound <= NEAR, (kind, seed, off)
        assert off.claim <= NEAR, (kind, seed, off)
        worst = Off(*map(max, worst, map(abs, off)))
        effort = max(effort, (int(found.pivots), int(found.rounds)))
    print(f"{shape}: {Off(*(float(f'{a:.2g}') for a in worst))}, pivots and rounds {effort}")


@pytest.mark.parametrize("shape", [SMALL, WIDE])
def test_the_minimum(shape):
    sweep(shape, range(44))


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "count"), [(SMALL, 800), (WIDE, 800), (TALL, 800), (LARGE, 50)])
def test_the_minimum_often(shape, count):
    sweep(shape, range(100, 100 + count))


@pytest.mark.slow
def test_the_minimum_in_other_shapes():
    """As many rows as states, fewer, one of either."""
    for shape in ((8, 8), (3, 5), (12, 1)):
        sweep(shape, range(44))


# ---- recovery


@pytest.mark.parametrize("size", [1.0, 1e6])
def test_honest_rows_are_met_exactly(size):
    """Observability rows, no noise, three of 50 samples attacked, whether by as much as the state
    or by a million times that: x to rounding wherever the minimum is there (its objective, found
    to 1e-13, is otherwise below that of x)."""
    worst, at = 0.0, 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        Phi = observability(rng, 50, 10, 10) if seed % 2 else rng.normal(size=SMALL)
        if np.linalg.cond(Phi) > 1e4:
            continue
        x, y = rng.normal(size=10), np.zeros(50)
        lying = rng.choice(50, 3, replace=False)
        y[lying] = size * rng.normal(size=3)
        there = np.sum(np.abs(y))
        found = solve(given(Phi, Phi @ x + y))
        assert found.objective <= there * (1 + 1e-12) + 1e-12
        if there - found.objective <= 1e-9 * there:
            at += 1
            worst = max(worst, np.max(np.abs(found.x - x)))
    print(f"{at} at x, off by {worst:.2g}")
    assert at >= 20
    # of samples of 1e6 rounding is 1e-10
    assert worst <= EXACT


def test_nothing_at_all():
    found = solve(given(np.random.default_rng(0).normal(size=SMALL), np.zeros(50)))
    assert not np.any(found.x)
    assert found.objective == found.gap == 0
    found = solve(given(np.zeros(SMALL), np.arange(50.0)))
    assert not np.any(found.x)
    assert found.objective == 1225
    assert found.rank == 0
    assert found.gap <= 1e-9


@pytest.mark.parametrize("factor", [1e-200, 1e-8, 1e8, 1e200])
def test_units_do_not_matter(factor):
    """Powers of two beside: nothing in it has a size of its own."""
    p = drawn("plant", 5)
    found = solve(p)
    of_y = solve(p._replace(y=factor * p.y))
    np.testing.assert_allclose(of_y.x, factor * found.x, rtol=EXACT)
    if 1e-100 < factor < 1e100:
        of_x = solve(p._replace(Phi=factor * p.Phi))
        np.testing.assert_allclose(of_x.x * factor, found.x, rtol=0, atol=EXACT)


# ---- closed forms


def test_the_weighted_median():
    rng = np.random.default_rng(1)
    for _ in range(20):
        slope, y, weight = rng.normal(size=9), rng.normal(size=9), rng.uniform(0.1, 3, 9)
        order = np.argsort(y / slope)
        share = np.cumsum((weight * np.abs(slope))[order])
        middle = order[np.searchsorted(share, share[-1] / 2)]
        found = solve(padded(given(slope[:, None], y, weight)))
        np.testing.assert_allclose(found.x, (y / slope)[middle] * np.eye(10)[0], atol=1e-14)


def test_the_counterexample():
    """Errata 1: who shouts is believed. x = 1, sensor 1 of C = (100, 1, 1)' attacked by -100."""
    C = np.tile([100.0, 1.0, 1.0], 3)
    found = solve(padded(given(C[:, None], np.tile([0.0, 1.0, 1.0], 3))))
    np.testing.assert_allclose(found.x, 0, atol=1e-15)
    np.testing.assert_allclose(found.objective, 6)


# ---- rows that come first


def test_exact_rows_that_determine_x():
    """Weighted least squares of these, whatever the others say; their own misfit does not count."""
    rng = np.random.default_rng(2)
    for many in (10, 14):
        Phi, y, weight = rng.normal(size=SMALL), rng.normal(size=50), rng.uniform(0.5, 2, 50)
        exact = np.arange(50) < many
        found = solve(given(Phi, y, weight, exact))
        rows = Phi * weight[:, None]
        x = np.linalg.lstsq(rows[exact], (y * weight)[exact])[0]
        np.testing.assert_allclose(found.x, x, atol=1e-12)
        rest = np.sum((weight * np.abs(y - Phi @ x))[~exact])
        np.testing.assert_allclose(found.objective, rest, rtol=1e-13)
        assert found.gap <= 1e-12 * rest


def test_exact_rows_that_can_be_met_are():
    """A few, some of them twice: they hold to rounding."""
    rng = np.random.default_rng(3)
    for seed in range(8):
        p = drawn("dense", seed)
        exact = np.isin(np.arange(50), rng.choice(50, 6, replace=False))
        first = np.flatnonzero(exact)
        p.Phi[first[4:]], p.y[first[4:]] = p.Phi[first[:2]], p.y[first[:2]]
        p = p._replace(exact=exact)
        found = solve(p)
        assert np.max(np.abs(found.residual[exact])) < 1e-12
        compare(p, found)


# ---- what nobody sees


@pytest.mark.parametrize("units", [1.0, 1e-7, 1e7])
def test_what_no_row_sees_is_as_small_as_can_be(units):
    """x is in the row space of what counts, by its pseudo-inverse; with exact rows as well."""
    for seed, exact in ((9, 0), (20, 2), (31, 5)):
        p = drawn("rank", seed)
        p = p._replace(Phi=units * p.Phi, exact=np.arange(50) < exact)
        found = solve(p)
        assert found.rank == 3
        projector = np.linalg.pinv(p.Phi, rcond=1e-10) @ p.Phi
        size = np.max(np.abs(found.x))
        np.testing.assert_allclose(projector @ found.x, found.x, atol=1e-12 * size)
        compare(p, found)
    p = drawn("absent", 10)
    found = solve(p)
    assert found.rank == 8
    there = p.weight > 0
    np.testing.assert_allclose(found.x, np.linalg.pinv(p.Phi[there]) @ p.y[there], atol=1e-12)


def test_a_row_of_weight_zero_may_say_anything():
    p = drawn("weights", 7)
    other = solve(p._replace(y=np.where(p.weight > 0, p.y, 1e9)))
    np.testing.assert_array_equal(solve(p).x, other.x)


# ---- side by side


@pytest.mark.slow
@pytest.mark.parametrize("shape", [SMALL, (30, 20)])
def test_side_by_side_is_one_by_one(shape):
    """200 of all kinds, of which some need more rounds; n = 20 factorises by LAPACK, of which two
    calls at a time could wait for each other for ever. What has several minimisers may end at
    another of them: rounding differs."""
    many = [drawn(KINDS[s % 11] if shape == SMALL else "huge", s, shape) for s in range(200)]
    batch = Given(*(np.stack(a) for a in zip(*many, strict=True)))
    found = jax.tree.map(np.asarray, compiled()[1](*batch))
    for i in range(0, 200, 7):
        alone = solve(many[i])
        size = np.sum(many[i].weight * np.abs(many[i].y))
        rounding = 1e-13 * size
        np.testing.assert_allclose(found.objective[i], alone.objective, rtol=1e-9, atol=rounding)
        if KINDS[i % 11] not in ("ties", "absent") or shape != SMALL:
            np.testing.assert_allclose(found.x[i], alone.x, rtol=1e-9, atol=1e-9)
    claim = found.gap / (found.objective + 1e-4 * np.sum(batch.weight * np.abs(batch.y), 1))
    assert np.max(claim) < NEAR


# ---- too few rounds


def test_what_is_claimed_where_it_fails(monkeypatch):
    """The gap is an upper bound whatever point it is told of."""
    monkeypatch.setattr(module, "ROUNDS", 1)
    monkeypatch.setattr(l1_vertex, "PIVOTS", 1)
    monkeypatch.setattr(module, "PASSES", 1)
    cut, rough = jax.jit(lambda *p: l1_regression(*p)), 0
    for seed in range(22):
        p = drawn(KINDS[seed % 11], seed)
        found, truth = jax.tree.map(np.asarray, cut(*p)), least(p)
        rounding = 1e-12 * np.sum(p.weight * np.abs(p.y))
        assert found.objective - found.gap <= truth.objective + rounding
        rough += bool(found.gap > 1e-6 * truth.objective)
    assert rough >= 5


# ---- decoder 1


@cache
def compiled_sparsest():
    return jax.jit(sparsest)


def test_decoder_1_is_decoder_2():
    """Lemma 2. (10) with N = Q_2' and b = Q_2' Y, by HiGHS in its own form: E = E+ - E-."""
    m, n = 24, 5
    for seed in range(12):
        rng = np.random.default_rng(seed)
        Phi, x = observability(rng, m, n, 6), rng.normal(size=n)
        attack = np.where(rng.random(m) < 0.15, rng.normal(size=m), 0.0)
        if np.linalg.cond(Phi) > 1e6:
            continue
        Y = Phi @ x + attack + 0.01 * rng.normal(size=m)
        Q, R = np.linalg.qr(Phi, mode="complete")
        Q1, Q2 = Q[:, :n], Q[:, n:]
        found = jax.tree.map(np.asarray, compiled_sparsest()(Q2.T, Q2.T @ Y))
        E = found.residual
        np.testing.assert_allclose(Q2.T @ E, Q2.T @ Y, atol=1e-12)
        linear = linprog(
            np.ones(2 * m), A_eq=np.hstack([Q2.T, -Q2.T]), b_eq=Q2.T @ Y, method="highs-ds"
        )
        # HiGHS meets its equations to 1e-7
        np.testing.assert_allclose(np.sum(np.abs(E)), linear.fun, rtol=1e-6)
        other = solve(padded(given(Phi, Y)))
        np.testing.assert_allclose(other.objective, linear.fun, rtol=1e-6)
        np.testing.assert_allclose(np.sum(np.abs(E)), other.objective, rtol=1e-12)
        np.testing.assert_allclose(E, other.residual[:m], atol=1e-10)
        # (11)
        decoded = np.linalg.solve(R[:n], Q1.T @ (Y - E))
        np.testing.assert_allclose(decoded, other.x[:n], atol=1e-9)


def test_sparsest_with_equations_that_say_the_same():
    """A row twice; and one that contradicts: least squares of the two."""
    rng = np.random.default_rng(0)
    N = rng.normal(size=(19, 24))
    N[18] = N[0]
    b = N @ rng.normal(size=24)
    found = compiled_sparsest()(N, b)
    np.testing.assert_allclose(N @ found.residual, b, atol=1e-12)
    linear = linprog(np.ones(48), A_eq=np.hstack([N, -N]), b_eq=b, method="highs-ds")
    np.testing.assert_allclose(found.objective, linear.fun, rtol=1e-6)
    wrong = b + 2.0 * np.eye(19)[18]
    found = compiled_sparsest()(N, wrong)
    np.testing.assert_allclose(N @ found.residual - b, np.eye(19)[0] + np.eye(19)[18], atol=1e-12)
