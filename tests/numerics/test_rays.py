"""Worst ratios against linear programmes for every sign, fine grids and random directions."""

import itertools

import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from holdfast.numerics import rays
from holdfast.numerics.ratio_bounds import bounded, largest, single

ROWS = np.arange(20)


def sums(G, group, U):
    """The g_i at the columns of U, straight from their definition."""
    z = np.abs(G @ U) ** 2
    total = np.zeros((len(G), U.shape[1]))
    for g in np.unique(group):
        total += np.sqrt(z[:, group == g].sum(1))
    return total.T


def worst(G, group=None, most=1, trusted=(), limit=rays.MOST):
    group = ROWS[: G.shape[1]] if group is None else group
    return rays.worst(rays.components(G, group, trusted), len(G), most, limit)


def by_linear_programmes(G, members):
    """The largest sum over I with the others' at most 1: a linear programme for each sign."""
    inside = np.isin(np.arange(len(G)), members)
    n = G.shape[2]
    rest, own = G[~inside].reshape(-1, n), G[inside].reshape(-1, n)
    N = len(rest)
    A_ub = np.vstack([np.hstack([rest, -np.eye(N)]), np.hstack([-rest, -np.eye(N)])])
    A_ub = np.vstack([A_ub, np.append(np.zeros(n), np.ones(N))])
    bounds = [(None, None)] * n + [(0, None)] * N
    found = []
    for signs in itertools.product([1.0, -1.0], repeat=len(own) - 1):
        c = np.append(-np.append(1.0, signs) @ own, np.zeros(N))
        done = linprog(c, A_ub, np.append(np.zeros(2 * N), 1.0), bounds=bounds)
        found.append(np.inf if done.status == 3 else -done.fun)
    return max(found)


@pytest.mark.parametrize(("seed", "n", "m", "d"), [(0, 2, 3, 2), (1, 3, 4, 3), (2, 4, 5, 2)])
def test_exact_as_linear_programmes_are(seed, n, m, d):
    G = np.random.default_rng(seed).normal(size=(m, d, n))
    most = (m - 1) // 2
    found = worst(G, most=most)
    np.testing.assert_array_equal(found.lower, found.upper)
    np.testing.assert_array_equal(found.lower_sets, found.upper_sets)
    truth = [by_linear_programmes(G, [i]) for i in range(m)]
    # the tolerance of HiGHS
    np.testing.assert_allclose(found.lower, truth, rtol=1e-6)
    for p in range(1, most + 1):
        sets = itertools.combinations(range(m), p)
        truth = max(by_linear_programmes(G, list(chosen)) for chosen in sets)
        np.testing.assert_allclose(found.lower_sets[p - 1], truth, rtol=1e-6)


def test_no_direction_is_worse():
    rng = np.random.default_rng(3)
    G = rng.normal(size=(6, 4, 4)) * 10.0 ** rng.uniform(-3, 3, (6, 4, 1))
    found = worst(G, most=2)
    g = sums(G, ROWS[:4], rng.normal(size=(4, 100_000)))
    assert np.all(single(g).max(0) <= found.upper * (1 + 1e-9))
    assert np.all(largest(g, 2).max(0) <= found.upper_sets * (1 + 1e-9))


def test_units_do_not_matter():
    rng = np.random.default_rng(4)
    G = rng.normal(size=(5, 3, 3))
    units = np.array([1e-7, 1.0, 1e6])
    np.testing.assert_allclose(worst(G * units).lower, worst(G).lower, rtol=1e-9)
    np.testing.assert_allclose(worst(1e9 * G).lower, worst(G).lower, rtol=1e-9)


def test_parallel_rows_are_one():
    """Sensors of a scalar plant: any number of rows, one ray; by hand."""
    G = np.array([[[3.0], [-1.0]], [[1e-3], [0.0]], [[-2.0], [2.0]]])
    found = worst(G, most=1)
    total = 4.0 + 1e-3 + 4.0
    np.testing.assert_allclose(found.lower, [4 / (total - 4), 1e-3 / 8, 4 / (total - 4)])
    assert rays.affordable(rays.components(G, ROWS[:2]), 1.0)


def test_infinite_where_nothing_is_left():
    G = np.zeros((3, 1, 2))
    G[:, 0, 0] = 1.0
    G[2, 0] = [1.0, 1.0]
    found = worst(G, most=2)
    assert found.lower.tolist() == found.upper.tolist()
    # the third alone sees the second state; of the first two, one against the others
    np.testing.assert_allclose(found.lower, [1.0, 1.0, np.inf])
    assert found.upper_sets.tolist() == [np.inf, np.inf]
    assert bounded(rays.components(G, ROWS[:1])[0], 1, 1e6).lower[2] == np.inf


def test_a_block_that_sees_nothing_has_no_part():
    G = np.random.default_rng(5).normal(size=(4, 2, 3))
    with_none = np.concatenate([G, np.zeros((1, 2, 3))])
    np.testing.assert_allclose(worst(with_none).lower, [*worst(G).lower, 0.0], rtol=1e-12)


def test_what_a_trusted_block_sees_is_left_out():
    """Against the same rows on a kernel worked out by hand."""
    rng = np.random.default_rng(6)
    G = rng.normal(size=(5, 2, 4))
    G[0] = [[1.0, 2.0, 0.0, 0.0], [2.0, 4.0, 0.0, 0.0]]
    basis = np.array([[2.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]).T
    found = worst(G, most=2, trusted=(0,))
    truth = worst(G[1:] @ basis, most=2)
    assert found.lower[0] == 0.0
    np.testing.assert_allclose(found.lower[1:], truth.lower, rtol=1e-9)
    np.testing.assert_allclose(found.upper_sets, truth.upper_sets, rtol=1e-9)
    # a trusted block that sees everything leaves nothing to lie about
    G[0, :, :] = 0.0
    whole = np.concatenate([np.eye(4)[None], np.concatenate([G, 0 * G], 1)[1:]])
    assert worst(whole, most=2, trusted=(0,)).upper_sets.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("K", [1, 2, 3, 8, 64])
def test_directions_bound_a_modulus(K):
    z = np.exp(1j * np.linspace(0.0, 2 * np.pi, 50_001))
    angles = np.arange(K) * np.pi / K
    found = np.sin(np.pi / (2 * K)) * np.abs((z[:, None] * np.exp(-1j * angles)).real).sum(1)
    # both ends are reached, to the square of half the step
    np.testing.assert_allclose(found.max(), 1.0, atol=1e-8)
    np.testing.assert_allclose(found.min(), np.cos(np.pi / (2 * K)), atol=1e-4 / K)
    assert found.max() <= 1.0 + 1e-12
    assert found.min() >= np.cos(np.pi / (2 * K)) - 1e-12


def test_a_pair_in_the_plane_against_a_fine_grid():
    G = np.random.default_rng(7).normal(size=(5, 2, 2))
    group = np.array([0, 0])
    found = worst(G, group, most=2)
    angles = np.linspace(0.0, np.pi, 200_001)
    g = sums(G, group, np.stack([np.cos(angles), np.sin(angles)]))
    # the ratio is known to 1e-6, and the grid is off by its step squared
    for lower, upper, truth in (
        (found.lower, found.upper, single(g).max(0)),
        (found.lower_sets, found.upper_sets, largest(g, 2).max(0)),
    ):
        np.testing.assert_allclose(lower, truth, rtol=2e-6)
        assert np.all(truth <= upper)
        np.testing.assert_allclose(upper, truth, rtol=2e-6)


@pytest.mark.parametrize(
    ("seed", "n", "m", "group"), [(8, 3, 5, [0, 0, 1]), (9, 4, 4, [0, 0, 1, 1])]
)
def test_pairs_and_rows_against_a_search(seed, n, m, group):
    rng = np.random.default_rng(seed)
    group = np.array(group)
    G = rng.normal(size=(m, n, n))
    found = worst(G, group, limit=2e7)
    assert np.all(found.upper <= 1.025 * found.lower)
    U = rng.normal(size=(n, 20_000))
    ratios = single(sums(G, group, U))
    for i in range(m):
        first = U[:, np.argmax(ratios[:, i])]
        best = -minimize(
            lambda u, i=i: -single(sums(G, group, u[:, None]))[0, i],
            first, method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-10, "maxiter": 4000},
        ).fun  # fmt: skip
        assert best <= found.upper[i] * (1 + 1e-9)
        assert best <= found.lower[i] * (1 + 1e-3)


def test_pairs_of_parallel_rows_are_exact():
    rng = np.random.default_rng(10)
    G = np.zeros((5, 2, 3))
    G[:, 0] = rng.normal(size=(5, 3))
    G[:, 1] = 0.75 * G[:, 0]
    found = worst(G, np.array([0, 0]), most=2)
    truth = worst(G[:, :1], most=2)
    np.testing.assert_array_equal(found.lower, found.upper)
    np.testing.assert_allclose(found.lower, truth.lower, rtol=1e-9)
    np.testing.assert_allclose(found.lower_sets, truth.lower_sets, rtol=1e-9)


def test_decoupled_plants_are_taken_apart():
    """Three plants of 2 states under one roof: too dear together, cheap apart."""
    rng = np.random.default_rng(11)
    order = rng.permutation(6)
    alone = [rng.normal(size=(8, 6, 2)) for _ in range(3)]
    G = np.zeros((8, 6, 6))
    for k, part in enumerate(alone):
        G[:, :, order[2 * k : 2 * k + 2]] = part * (rng.random(6) < 0.7)[:, None]
        alone[k] = G[:, :, order[2 * k : 2 * k + 2]]
    rows = G.copy()
    G = np.zeros((8, 18, 6))
    for k in range(3):
        columns = order[2 * k : 2 * k + 2]
        G[:, 6 * k : 6 * k + 6, columns] = rows[:, :, columns]
    parts = rays.components(G, ROWS[:18])
    assert len(parts) == 3
    found = worst(G, most=3)
    each = [worst(part, most=3) for part in alone]
    for name in ("lower", "upper", "lower_sets", "upper_sets"):
        truth = np.max([getattr(one, name) for one in each], 0)
        np.testing.assert_allclose(getattr(found, name), truth, rtol=1e-9)
    np.testing.assert_array_equal(found.lower, found.upper)


@pytest.mark.parametrize(("seed", "n", "m"), [(12, 3, 5), (13, 4, 7), (14, 5, 8)])
def test_intervals_contain_the_truth(seed, n, m):
    G = np.random.default_rng(seed).normal(size=(m, n, n))
    most = (m - 1) // 2
    exact = worst(G, most=most)
    (part,) = rays.components(G, ROWS[:n])
    interval = bounded(part, most, 1e9)
    assert np.all(interval.lower <= exact.lower * (1 + 1e-12))
    assert np.all(exact.lower <= interval.upper)
    assert np.all(interval.lower_sets <= exact.lower_sets * (1 + 1e-12))
    assert np.all(exact.lower_sets <= interval.upper_sets)
    assert np.all(interval.lower >= 0.998 * exact.lower)
    assert np.all(interval.upper <= 1.3 * exact.lower)


def test_too_many_rays_give_an_interval():
    G = np.random.default_rng(15).normal(size=(20, 12, 12))
    parts = rays.components(G, ROWS[:12])
    assert rays.affordable(parts, rays.MOST)
    assert not rays.affordable(parts, 1e4)
    found = worst(G, most=2, limit=2e7)
    assert np.all(found.lower < found.upper)
    assert np.all(found.upper < 1.8 * found.lower)
