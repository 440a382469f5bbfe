"""Projection onto polytopes against enumeration of the active faces and an independent solver."""

import daqp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.numerics.projection import project
from polytopes import FAMILIES, Problems, covariances, enumerated, equalities, generic, times

alone, batch = jax.jit(project), jax.jit(jax.vmap(project))
SHAPES = ((1, 4, 40), (2, 5, 160), (3, 8, 160), (4, 8, 120), (6, 8, 80))
"""Dimensions, faces, problems of each of the nine families: 5040 in all."""
EXACT = 1e-10
"""Of the size of the problem. Rounding times the condition of the active faces, 3e5 at most
where the covariance has condition 1e11, is 7e-11; without those it is 1e-12."""


def projected(problems):
    return jax.tree.map(np.asarray, batch(*problems))


def size(problems, truth):
    return 1.0 + np.max(np.abs(problems.point), 1) + np.max(np.abs(truth), 1)


@pytest.mark.parametrize(("n", "m", "count"), SHAPES)
def test_equals_enumeration(n, m, count):
    rng = np.random.default_rng(n)
    for family in FAMILIES:
        problems = family(rng, count, n, m)
        truth, feasible, _ = enumerated(problems)
        found = projected(problems)
        np.testing.assert_array_equal(found.feasible, feasible, family.__name__)
        error = np.max(np.abs(found.point - truth), 1) / size(problems, truth)
        assert np.max(error[feasible], initial=0.0) < EXACT, family.__name__
        # what is empty is left alone, whatever the loop had done before it found out
        np.testing.assert_array_equal(found.point[~feasible], problems.point[~feasible])
        assert not np.any(found.active[~feasible])
        assert not np.any(found.multipliers[~feasible])
        assert all(np.all(np.isfinite(part)) for part in found)


def test_families_are_what_they_say():
    """Some sets are empty, some points inside, some faces too many for their vertex."""
    rng = np.random.default_rng(7)
    feasible, held = [], []
    for family in FAMILIES:
        found = projected(family(rng, 120, 4, 8))
        feasible.append(found.feasible.mean())
        held.append(found.active.sum(1).mean())
    assert min(feasible) < 0.8
    assert max(feasible) == 1.0
    assert max(held) > 2.0


def test_conditions_of_optimality():
    """Karush-Kuhn-Tucker in the units given; 1e-11: a hundred roundings of sums of eight."""
    rng = np.random.default_rng(11)
    problems = generic(rng, 120, 4, 8)
    found = projected(problems)
    assert np.max(found.residual) < 1e-11
    excess = times(problems.rows, found.point) - problems.bound
    pull = times(problems.cov, times(problems.rows.swapaxes(1, 2), found.multipliers))
    assert np.max(excess) < 1e-11
    assert np.min(found.multipliers) >= 0.0
    np.testing.assert_array_equal(found.multipliers > 0, found.active)
    np.testing.assert_allclose(found.multipliers * excess, 0.0, atol=1e-11)
    np.testing.assert_allclose(found.point, problems.point - pull, atol=1e-11)


def test_equals_daqp():
    """1e-8: the tolerance asked of the other solver, times the condition of the weights."""
    problems = generic(np.random.default_rng(12), 120, 6, 8)
    found = projected(problems)
    for i in range(120):
        weight = np.linalg.inv(problems.cov[i])
        other, _, flag, _ = daqp.solve(
            weight, -weight @ problems.point[i], problems.rows[i], problems.bound[i],
            primal_tol=1e-11, dual_tol=1e-11,
        )  # fmt: skip
        assert flag == 1
        np.testing.assert_allclose(found.point[i], other, atol=1e-8)


def test_a_batch_is_its_problems_one_by_one():
    """The batch works on other axes, in blocks, one of them filled up; shared arguments too."""
    problems = generic(np.random.default_rng(13), 120, 4, 8)
    found = projected(problems)
    for i in (0, 63, 64, 119):
        one = alone(*(part[i] for part in problems))
        np.testing.assert_allclose(found.point[i], one.point, atol=1e-13)
        np.testing.assert_array_equal(found.active[i], one.active)
    shared = jax.vmap(project, (0, None, None, None))
    _, cov, rows, bound = (jnp.asarray(part[0]) for part in problems)
    several = shared(problems.point[:3], cov, rows, bound)
    one = alone(problems.point[2], cov, rows, bound)
    np.testing.assert_allclose(several.point[2], one.point, atol=1e-13)


def test_inside_nothing_is_touched():
    point = np.array([0.1, -0.0, 1e-300, 3.7])
    found = alone(point, np.eye(4), np.ones((8, 4)), np.full(8, 4.0))
    assert np.asarray(found.point).tobytes() == point.tobytes()
    assert not np.any(found.active)
    assert found.feasible


def padded(*given):
    """Any small problem as one of four dimensions and eight rows, already compiled."""
    point, cov, rows, bound = (np.asarray(a, float) for a in given)
    n, m = point.size, bound.size
    wide = np.zeros((8, 4))
    wide[:m, :n] = rows
    whole = np.eye(4)
    whole[:n, :n] = cov
    full = np.concatenate([bound, np.full(8 - m, np.inf)])
    found = alone(np.pad(point, (0, 4 - n)), whole, wide, full)
    return np.asarray(found.point)[:n], bool(found.feasible)


def test_what_the_covariance_does_not_see():
    """Moves along (1, 1) only: a limit on z1 - z2 is met or it is not."""
    cov = [[1.0, 1.0], [1.0, 1.0]]
    across = [[1.0, -1.0], [1.0, 0.0]]
    found, feasible = padded([2.0, 1.0], cov, across, [1.0, 0.5])
    assert feasible
    np.testing.assert_allclose(found, [0.5, -0.5], atol=1e-15)
    found, feasible = padded([2.0, 1.0], cov, across, [0.9, 0.5])
    assert not feasible
    np.testing.assert_array_equal(found, [2.0, 1.0])


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_no_number_is_no_bound(bad):
    found, feasible = padded([2.0], [[1.0]], [[1.0], [1.0]], [1.0, bad])
    assert not feasible
    np.testing.assert_array_equal(found, [2.0])


@pytest.mark.parametrize("part", [0, 1, 2])
def test_nothing_is_said_of_what_is_not_a_number(part):
    problem = [np.zeros(4), np.eye(4), np.ones((8, 4)), np.zeros(8)]
    problem[part] = np.full_like(problem[part], np.nan)
    found = alone(*problem)
    assert not found.feasible
    assert not np.any(found.active)
    assert np.all(np.isfinite(found.multipliers))


def test_no_rows_and_no_dimensions():
    found = project(jnp.ones(2), jnp.eye(2), jnp.zeros((0, 2)), jnp.zeros(0))
    np.testing.assert_array_equal(found.point, [1.0, 1.0])
    assert found.feasible
    for bound, feasible in ((0.0, True), (-1.0, False)):
        found = project(jnp.zeros(0), jnp.eye(0), jnp.zeros((1, 0)), jnp.array([bound]))
        assert found.feasible == feasible


seeds = st.integers(0, 2**32 - 1)
CLOSE = 1e-9
"""For the properties: two projections, each exact to `EXACT`, through maps of condition 10."""


@given(seeds)
def test_a_projection_stays_where_it_is(seed):
    problems = equalities(np.random.default_rng(seed), 64, 4, 8)
    once = projected(problems)
    twice = projected(problems._replace(point=once.point))
    np.testing.assert_array_equal(once.feasible, twice.feasible)
    np.testing.assert_allclose(once.point, twice.point, atol=CLOSE)


@given(seeds)
def test_units_order_and_coordinates_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    problems = equalities(rng, 64, 4, 8)
    found = projected(problems)
    order = rng.permutation(8)
    units = 10.0 ** rng.uniform(-6, 6, (64, 8))
    turn = np.linalg.qr(rng.normal(size=(4, 4)))[0] * 10.0 ** rng.uniform(-0.5, 0.5, 4)
    back = np.linalg.inv(turn)
    other = projected(
        Problems(
            problems.point @ turn.T,
            turn @ problems.cov @ turn.T,
            ((units[..., None] * problems.rows) @ back)[:, order],
            (units * problems.bound)[:, order],
        )
    )
    np.testing.assert_array_equal(other.feasible, found.feasible)
    np.testing.assert_allclose(other.point, found.point @ turn.T, atol=CLOSE)
    same = np.where(found.feasible[:, None], units * other.multipliers[:, np.argsort(order)], 0)
    np.testing.assert_allclose(
        times(problems.rows.swapaxes(1, 2), same),
        times(problems.rows.swapaxes(1, 2), found.multipliers),
        rtol=1e-6,  # multipliers are large where faces are nearly parallel
        atol=CLOSE,
    )


@given(seeds)
def test_never_further_apart_than_before(seed):
    rng = np.random.default_rng(seed)
    problems = generic(rng, 64, 4, 8)
    other = problems._replace(point=problems.point + rng.normal(size=(64, 4)))
    weight = np.linalg.inv(problems.cov)

    def apart(a, b):
        return np.einsum("ki,kij,kj->k", a - b, weight, a - b)

    after = apart(projected(problems).point, projected(other).point)
    assert np.all(after <= apart(problems.point, other.point) * (1 + CLOSE))


def test_covariances_are_definite():
    """The weights above exist."""
    values = np.linalg.eigvalsh(covariances(np.random.default_rng(0), 64, 4))
    assert np.min(values) > 0.09
