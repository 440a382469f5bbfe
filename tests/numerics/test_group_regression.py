"""Regression by a sum of norms of groups: cone solvers, closed forms, certificates, recovery.

One shape serves nearly all: weights of zero take rows away and zero columns directions, so that
two compilations, one per norm, see every kind of problem.
"""

from functools import cache
from typing import NamedTuple

import clarabel
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import linprog

from holdfast.numerics import group_regression as module
from holdfast.numerics import norm_cones
from holdfast.numerics.group_regression import group_regression

NORMS = ("l1l2", "l1linf")
SIZES = (8, 6, 4, 3, 3, 2, 2, 1, 1)
# rows of a group are not neighbours
GROUP = tuple(np.random.default_rng(0).permutation(np.repeat(np.arange(9), SIZES)).tolist())
OF = np.array(GROUP)
ROWS, STATES = len(GROUP), 4
CLAIM = 1e-10
"""Gap asked for, relative to the objective; below 1e-12 in nearly all of what follows."""
ORACLE = 1e-7
"""To which the cone solver's objective can be relied on, relative; it is asked for 1e-10."""


@cache
def compiled(norm, group=GROUP):
    def alone(Phi, y, weight, exact):
        return group_regression(Phi, y, group, norm, weight, exact)

    return jax.jit(alone), jax.jit(jax.vmap(alone))


class Problem(NamedTuple):
    Phi: np.ndarray
    y: np.ndarray
    weight: np.ndarray
    exact: np.ndarray


def problem(Phi, y, weight=None, exact=None):
    """Padded with columns of zero."""
    m = len(y)
    wide = np.zeros((m, STATES))
    wide[:, : Phi.shape[1]] = Phi
    weight = np.ones(m) if weight is None else np.asarray(weight, float)
    return Problem(
        wide, np.asarray(y, float), weight, np.zeros(m, bool) if exact is None else exact
    )


def solve(given, norm):
    return jax.tree.map(np.asarray, compiled(norm)[0](*given))


# ---- independent answers


def norms(r, norm, group=OF):
    of = [r[group == g] for g in range(group.max() + 1)]
    if norm == "l1l2":
        return np.array([np.sqrt(v @ v) for v in of])
    return np.array([np.max(np.abs(v)) for v in of])


def free(given):
    """A, b: what the norms see as b - A v, x = start + N v, once the exact rows are met."""
    rows, goal = given.Phi * given.weight[:, None], given.y * given.weight
    first = rows[given.exact]
    start = np.linalg.lstsq(first, goal[given.exact], rcond=1e-10)[0]
    _, values, basis = np.linalg.svd(first)
    rank = np.sum(values > 1e-10 * values[0]) if len(values) else 0
    A = rows @ basis[rank:].T
    b = goal - rows @ start
    A[given.exact], b[given.exact] = 0.0, 0.0
    return A, b


def least(given, norm, group=OF):
    """The minimum, and a dual point, from another solver."""
    A, b = free(given)
    return (_conic if norm == "l1l2" else _linear)(A, b, group)


def _linear(A, b, group):
    (m, n), g = A.shape, group.max() + 1
    tops = np.eye(g)[group]
    rows = np.block([[-A, -tops], [A, -tops]])
    cost = np.r_[np.zeros(n), np.ones(g)]
    found = linprog(cost, rows, np.r_[-b, b], bounds=(None, None), method="highs-ds")
    assert found.status == 0
    below = -found.ineqlin.marginals
    return found.fun, below[:m] - below[m:]


def _conic(A, b, group):
    (_, n), g = A.shape, group.max() + 1
    rows, right, cones, order = [], [], [], []
    for k in range(g):
        mine = np.flatnonzero(group == k)
        block = np.zeros((1 + len(mine), n + g))
        block[0, n + k] = -1.0
        block[1:, :n] = A[mine]
        rows.append(block)
        right.append(np.r_[0.0, b[mine]])
        cones.append(clarabel.SecondOrderConeT(1 + len(mine)))
        order.append(np.r_[-1, mine])
    scale = max(np.abs(b).max(), 1e-300)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    found = clarabel.DefaultSolver(
        sp.csc_matrix((n + g, n + g)),
        np.r_[np.zeros(n), np.ones(g)],
        sp.csc_matrix(np.vstack(rows)),
        np.concatenate(right) / scale,
        cones,
        settings,
    ).solve()
    assert "Solved" in str(found.status)
    order, z = np.concatenate(order), np.array(found.z)
    d = np.zeros(len(b))
    d[order[order >= 0]] = -z[order >= 0]
    return found.obj_val * scale, d


def certificate(given, norm, x):
    """The gap of x by a dual point of our own: that of its residual, where that has a direction,
    and the other solver's, made orthogonal, where it has none."""
    A, _ = free(given)
    d = least(given, norm)[1]
    r = np.where(given.exact, 0.0, given.weight * (given.y - given.Phi @ x))
    size = norms(r, norm)
    if norm == "l1l2":
        away = size > 1e-9 * size.max()
        unit = r / np.where(away, size, 1.0)[OF]
        d = np.where(away[OF], unit, d)
        met = ~away[OF]
        d[met] -= np.linalg.lstsq(A[met].T, A.T @ d, rcond=1e-9)[0]
        dual = norms(d, norm)
    else:
        dual = np.bincount(OF, np.abs(d))
    d = d / max(1.0, dual.max())
    # what is left of d along the columns, times how far A x can be from A x* at most
    stray = np.linalg.norm(A @ np.linalg.lstsq(A, d, rcond=1e-9)[0])
    return size.sum() - r @ d + 2 * np.sqrt(max(SIZES)) * stray * size.sum()


# ---- random systems


def drawn(kind, seed):
    rng = np.random.default_rng(seed)
    Phi, x = rng.standard_normal((ROWS, STATES)), rng.standard_normal(STATES)
    noise, weight, exact = rng.standard_normal(ROWS), None, None
    bad = np.isin(OF, rng.choice(9, 3, replace=False))
    if kind == "sparse":
        Phi = Phi * (rng.random(Phi.shape) < 0.25)
        noise = noise * bad
    elif kind == "integer":
        Phi, noise = rng.integers(-2, 3, Phi.shape).astype(float), rng.integers(-3, 4, ROWS)
        x = 0.0 * x
    elif kind == "repeated":
        Phi, noise = Phi[rng.integers(0, 3, ROWS)], rng.integers(-1, 2, ROWS)
    elif kind == "rank":
        Phi = Phi @ np.diag([1.0, 1.0, 0.0, 0.0]) @ rng.standard_normal((STATES, STATES))
    elif kind == "levels":
        noise = noise * 10.0 ** rng.integers(-4, 5, 9)[OF]
    elif kind == "weights":
        weight = 10.0 ** rng.uniform(-2, 2, ROWS)
    elif kind == "absent":
        weight = np.where(rng.random(ROWS) < 0.5, 1.0, 0.0)
    elif kind == "exact":
        exact = np.arange(ROWS) < rng.integers(1, STATES)
    return problem(Phi, Phi @ x + noise, weight, exact)


KINDS = ("dense", "sparse", "integer", "repeated", "rank", "levels", "weights", "absent", "exact")


def check(given, norm):
    found = solve(given, norm)
    r = np.where(given.exact, 0.0, given.weight * found.residual)
    floor = 1e-15 * np.abs(given.weight * given.y).max()
    np.testing.assert_allclose(found.residual, given.y - given.Phi @ found.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.objective, norms(r, norm).sum(), rtol=1e-12, atol=floor)
    assert found.gap >= 0
    gap = found.gap / (found.objective + 1e3 * floor)
    minimum, _ = least(given, norm)
    np.testing.assert_allclose(found.objective, minimum, rtol=ORACLE, atol=1e3 * floor)
    assert found.objective <= minimum * (1 + 1e-8) + 1e3 * floor
    assert found.objective - found.gap <= minimum * (1 + ORACLE) + 1e3 * floor
    return gap, certificate(given, norm, found.x) / (found.objective + 1e3 * floor)


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_minimum_is_found(norm, kind):
    """The gap, by its own account and by a dual point that owes nothing to it."""
    gaps, others = np.transpose([check(drawn(kind, seed), norm) for seed in range(8)])
    print(f"gap {gaps.max():.2g}, by the other dual {others.max():.2g}")
    assert gaps.max() <= CLAIM
    assert others.max() <= CLAIM


@pytest.mark.slow
@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_minimum_is_found_often(norm, kind):
    gaps = np.array([check(drawn(kind, seed), norm) for seed in range(100, 250)])
    others = np.quantile(gaps[:, 1], [0.95, 1.0])
    print(f"gap {gaps[:, 0].max():.2g}, by the other dual {others}")
    assert gaps[:, 0].max() <= CLAIM
    # a residual of 1e-8 has a direction to 1e-8 only
    assert others[0] <= CLAIM
    assert others[1] <= 1e-6


# ---- recovery


def attacked(seed, size, m=ROWS, n=STATES, group=OF, count=2):
    """Without noise; ``count`` groups lie wildly."""
    rng = np.random.default_rng(seed)
    Phi, x = rng.standard_normal((m, n)), rng.standard_normal(n)
    lying = np.isin(group, rng.choice(group.max() + 1, count, replace=False))
    y = Phi @ x + np.where(lying, size * rng.standard_normal(m), 0.0)
    return Problem(Phi, y, np.ones(m), np.zeros(m, bool)), x, lying


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e6])
def test_honest_groups_are_met_exactly(norm, size):
    """Two of nine groups lie, by little or by much: x to rounding.

    The two may be the largest groups, and outweigh the rest. Whether the minimum is at x, the
    objective tells: found to 1e-13, it is below that of x then.
    """
    worst, recovered = 0.0, 0
    for seed in range(30):
        given, x, lying = attacked(seed, size)
        found = solve(given, norm)
        there = norms(given.y - given.Phi @ x, norm).sum()
        assert found.objective <= there * (1 + 1e-13) + 1e-13
        if there - found.objective <= 1e-11 * there:
            recovered += 1
            worst = max(worst, np.abs(found.x - x).max() / np.abs(x).max())
            assert np.abs(found.residual[~lying]).max() <= 1e-9
    print(f"{recovered} of 30 at x, error {worst:.2g}")
    assert recovered >= 15
    assert worst <= 1e-9


@pytest.mark.parametrize("norm", NORMS)
def test_nothing_to_choose(norm):
    """All rows agree: x to rounding, an objective of rounding."""
    given, x, _ = attacked(1, 0.0)
    found = solve(given, norm)
    np.testing.assert_allclose(found.x, x, rtol=0, atol=1e-13)
    assert found.gap <= found.objective <= 1e-13


@pytest.mark.slow
@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("size", [1.0, 1e6])
def test_ten_sensors_over_eight_samples(norm, size):
    """The decoder's size: three of ten sensors lie, 100 problems side by side."""
    group = np.arange(80) % 10
    all_given, x, _ = zip(*(attacked(s, size, 80, 8, group, 3) for s in range(100)), strict=True)
    batch = Problem(*(np.stack(a) for a in zip(*all_given, strict=True)))
    found = jax.tree.map(np.asarray, compiled(norm, tuple(group.tolist()))[1](*batch))
    gap = found.gap / found.objective
    error = np.abs(found.x - np.array(x)).max(1)
    print(f"gap {gap.max():.2g}, error {np.quantile(error, [0.5, 0.95, 1])}")
    assert gap.max() <= CLAIM
    assert np.mean(error <= 1e-9) >= 0.95


# ---- closed forms


def only(chosen):
    """Weights that leave these rows alone."""
    return np.isin(np.arange(ROWS), chosen).astype(float)


@pytest.mark.parametrize("angle", [0.3, 1.2])
def test_fermats_point(angle):
    """Three groups of two rows y_i - x: the point that sees the three under 120 degrees, or the
    vertex of an angle of more."""
    rows = [np.flatnonzero(g == OF)[:2] for g in (0, 3, 5)]
    corners = np.array([[np.cos(angle), np.sin(angle)], [np.cos(angle), -np.sin(angle)], [0, 0]])
    Phi, y = np.zeros((ROWS, 2)), np.zeros(ROWS)
    for mine, corner in zip(rows, corners, strict=True):
        Phi[mine], y[mine] = np.eye(2), corner
    found = solve(problem(Phi, y, only(np.concatenate(rows))), "l1l2")
    # isosceles: from the axis, both sides meet it under 60 degrees
    along = max(np.cos(angle) - np.sin(angle) / np.sqrt(3), 0.0) if angle < np.pi / 3 else 0.0
    np.testing.assert_allclose(found.x, [along, 0, 0, 0], rtol=0, atol=1e-10)
    assert found.rank == 2
    assert found.gap <= 1e-12


def test_one_group_is_least_squares():
    given = drawn("dense", 3)
    given = given._replace(weight=only(np.flatnonzero(OF == 0)))
    expected = np.linalg.lstsq(given.Phi[OF == 0], given.y[OF == 0])[0]
    found = solve(given, "l1l2")
    np.testing.assert_allclose(found.x, expected, rtol=0, atol=1e-12)
    assert found.gap <= 1e-12


def test_one_group_is_chebyshevs_fit():
    """A line through |t|^(1/2) at 0, 1, 4, 9 and in between: the error alternates three times."""
    mine = np.flatnonzero(OF == 0)
    t = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 9.0])
    Phi, y = np.zeros((ROWS, 2)), np.zeros(ROWS)
    Phi[mine], y[mine] = np.stack([np.ones(8), t], 1), np.sqrt(t)
    found = solve(problem(Phi, y, only(mine)), "l1linf")
    # slope 1/3 of the chord; at its midpoint between chord and the largest distance, at t = 2
    middle = (np.sqrt(2.0) - 2.0 / 3.0) / 2.0
    np.testing.assert_allclose(found.x, [middle, 1 / 3, 0, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.objective, middle, rtol=1e-12)


@pytest.mark.parametrize("norm", NORMS)
def test_groups_of_one_are_absolute_values(norm):
    """The weighted median of nine numbers, by sorting."""
    rows = [np.flatnonzero(g == OF)[0] for g in range(9)]
    weight = only(rows)
    weight[rows] = [1.0, 2.0, 1.5, 0.3, 2.2, 0.7, 1.1, 0.4, 0.6]
    y = np.random.default_rng(5).standard_normal(ROWS)
    order = np.argsort(y[rows])
    half = np.searchsorted(np.cumsum(weight[rows][order]), weight.sum() / 2)
    found = solve(problem(np.ones((ROWS, 1)), y, weight), norm)
    np.testing.assert_allclose(found.x[0], y[rows][order][half], rtol=0, atol=1e-13)
    assert found.gap <= 1e-13


# ---- rows that come first, rows that are absent, directions nobody sees


@pytest.mark.parametrize("norm", NORMS)
def test_exact_rows_come_first(norm):
    """Consistent ones hold; ones that cannot all be met are met by weighted least squares."""
    given = drawn("exact", 11)
    found = solve(given, norm)
    assert np.abs(found.residual[given.exact]).max() <= 1e-12
    exact = np.arange(ROWS) < 7
    given = given._replace(exact=exact, weight=1.0 + np.arange(ROWS) % 3)
    found = solve(given, norm)
    rows = given.Phi * given.weight[:, None]
    expected = np.linalg.lstsq(rows[exact], (given.y * given.weight)[exact])[0]
    np.testing.assert_allclose(found.x, expected, rtol=0, atol=1e-12)
    rest = np.where(exact, 0.0, given.weight * found.residual)
    np.testing.assert_allclose(found.objective, norms(rest, norm).sum(), rtol=1e-13)
    assert found.gap <= 1e-12


@pytest.mark.parametrize("norm", NORMS)
def test_a_row_of_weight_zero_may_say_anything(norm):
    given = drawn("absent", 2)
    wild = np.where(given.weight > 0, given.y, 1e9)
    one, other = solve(given, norm), solve(given._replace(y=wild), norm)
    np.testing.assert_array_equal(one.x, other.x)
    assert one.objective == other.objective


@pytest.mark.parametrize("norm", NORMS)
def test_what_no_row_sees_is_as_small_as_can_be(norm):
    given = drawn("rank", 4)
    found = solve(given, norm)
    assert found.rank == 2
    _, _, basis = np.linalg.svd(given.Phi)
    assert np.abs(basis[2:] @ found.x).max() <= 1e-12


@pytest.mark.parametrize("norm", NORMS)
def test_units_do_not_matter(norm):
    """Other units of the states and of the rows give the same answer in them."""
    given = drawn("dense", 6)
    units = np.array([1e-5, 1.0, 30.0, 1e6])
    found = solve(given, norm)
    other = solve(given._replace(Phi=1e-4 * given.Phi * units, y=1e-4 * given.y), norm)
    np.testing.assert_allclose(other.x * units, found.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(other.objective, 1e-4 * found.objective, rtol=1e-12)


# ---- batches, and failures that are told


@pytest.mark.parametrize("norm", ["l1l2", pytest.param("l1linf", marks=pytest.mark.slow)])
def test_side_by_side_is_one_by_one(norm):
    many = [drawn(kind, seed) for kind in ("dense", "sparse", "absent") for seed in range(4)]
    one_by_one = [solve(given, norm) for given in many]
    batch = compiled(norm)[1](*(np.stack(a) for a in zip(*many, strict=True)))
    for i, alone in enumerate(one_by_one):
        np.testing.assert_allclose(batch.x[i], alone.x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(batch.objective[i], alone.objective, rtol=1e-12)
        assert batch.rank[i] == alone.rank


@pytest.mark.parametrize("norm", NORMS)
def test_data_that_are_not_finite_show(norm):
    given = drawn("dense", 0)
    assert not np.isfinite(solve(given._replace(y=np.where(OF == 1, np.nan, given.y)), norm).gap)


def test_too_few_rounds_show_in_the_gap(monkeypatch):
    """Nor does the bound lie then."""
    monkeypatch.setattr(norm_cones, "ROUNDS", 2)
    monkeypatch.setattr(module, "NEWTON", 0)
    cut = jax.jit(lambda Phi, y: group_regression(Phi, y, GROUP))
    for seed in range(5):
        given = drawn("dense", seed)
        found = cut(jnp.asarray(given.Phi), jnp.asarray(given.y))
        minimum, _ = least(given, "l1l2")
        assert found.gap > 1e-6
        assert found.objective - found.gap <= minimum <= found.objective
