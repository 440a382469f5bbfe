"""The recursion against (59) written out, against closed forms and against mpmath."""

import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.linalg import solve_triangular

from attackers import drawn, filtered
from holdfast.numerics.linalg import SMALL
from holdfast.numerics.reachability import (
    backward,
    cheapest,
    forward,
    joined,
    moves,
    patterns,
)
from holdfast.numerics.square_root import informed, triangle

SHAPES = [(1, 1), (2, 3), (4, 2), (6, 5)]


class Case:
    """A random system, whose outputs ``hit`` are free but in the last ``f`` of each ``every``."""

    def __init__(self, seed, n, p, t=12):
        rng = np.random.default_rng((seed, n, p))
        self.s = drawn((seed, n, p), n, p, rng.uniform(0.7, 1.1))
        self.hit = [np.zeros(p, bool), np.ones(p, bool), rng.random(p) < 0.5][min(seed % 4, 2)]
        self.f, every = 1 + seed % 3, int(rng.integers(4, 7))
        self.index = (np.arange(t) % every >= every - self.f).astype(np.int32)
        self.index[t - self.f :] = 1
        self.alterable = np.array([self.hit, 0 * self.hit], bool)
        self.m = moves(*self.s[:4], self.alterable)
        self.ones, self.zero = np.ones((t, 1)), np.zeros((n, n))

    def factors(self):
        L = forward(self.m, self.index, self.ones, self.zero)
        T = backward(self.m, self.index, self.ones, np.zeros(len(L), int))
        return joined(L, T)


def dense(s, free):
    """All Y_k / alpha^2 of (59) by Theta of (49), M_k of (44); ``free``: the outputs, step by
    step.
    """
    A, C, K, Q = s[:4]
    d = sum(len(one) for one in free)
    e, theta, M, at = np.zeros((len(A), d)), np.zeros((d, d)), [], 0
    for one in free:
        a = np.zeros((len(C), d))
        a[one, np.arange(at, at + len(one))] = 1.0
        z, at = C @ A @ e + a, at + len(one)
        theta += z.T @ np.linalg.solve(Q, z)
        e = (A - K @ C @ A) @ e - K @ a
        M.append(e)
    if not d:
        return np.zeros((len(free), len(A), len(A)))
    return np.array([m @ np.linalg.solve(theta, m.T) for m in M])


def agrees(case):
    free = [np.flatnonzero(case.alterable[i]) for i in case.index]
    truth = dense(case.s, free)
    found = case.factors()
    for Y, half in zip(truth, found, strict=True):
        # Theta is not ill conditioned over a dozen steps: 1e-10 leaves it four digits
        assert np.linalg.norm(half @ half.T - Y) <= 1e-10 * np.linalg.norm(Y)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_recursion_is_the_dense_formula(shape):
    for seed in range(10):
        agrees(Case(seed, *shape))


@pytest.mark.slow
@pytest.mark.parametrize("shape", [*SHAPES, (3, 3), (5, 1), (1, 4), (3, 2)])
def test_the_recursion_is_the_dense_formula_on_two_hundred_systems(shape):
    for seed in range(25):
        agrees(Case(seed, *shape))


def test_an_unstable_scalar_over_two_hundred_steps():
    """Where (59) is off by 87 % at k = 100 and says nothing."""
    s = filtered([[1.2]], [[1.0]], [[0.3]], [[1.0]])
    a, K, Q = 1.2, s.K[0, 0], s.Q[0, 0]
    m, t = moves(*s[:4], np.array([[True], [False]])), 200
    index, ones = np.zeros(t, np.int32), np.ones((t, 1))
    k = np.arange(1, t + 1)
    W = K * K * Q * (a ** (2.0 * k) - 1.0) / (a * a - 1.0)
    found = forward(m, index, ones, np.zeros((1, 1)))[:, 0, 0]
    np.testing.assert_allclose(found**2, W, rtol=1e-9)
    # and before an authenticated step at the end, whose residual is a e
    index[-1] = 1
    L = forward(m, index, ones, np.zeros((1, 1)))
    T = backward(m, index, ones, np.zeros(t, int))
    to_come = np.zeros(t)
    to_come[-2] = a * a / Q
    for i in range(t - 3, -1, -1):
        to_come[i] = a * a / (1.0 / to_come[i + 1] + K * K * Q)
    Y = joined(L, T)[:, 0, 0] ** 2
    np.testing.assert_allclose(Y[:-1], 1.0 / (1.0 / W + to_come)[:-1], rtol=1e-9)


@pytest.mark.parametrize(("n", "p", "hit"), [(2, 2, [True, False]), (3, 2, [False, True])])
def test_an_unstable_plant_with_some_sensors_compromised(n, p, hit):
    s, t = drawn(3, n, p, 1.4), 36
    alterable = np.array([hit, [False] * p])
    index = np.zeros(t, np.int32)
    index[[20, 21, t - 1]] = 1
    m, ones = moves(*s[:4], alterable), np.ones((t, 1))
    L = forward(m, index, ones, np.zeros((n, n)))
    T = backward(m, index, ones, np.zeros(t, int))
    found = joined(L, T)
    j = int(np.flatnonzero(hit)[0])
    with mpmath.workdps(100):
        A, C, K, Q = (mpmath.matrix(x.tolist()) for x in s[:4])
        inverse, F, d = Q**-1, A - K * C * A, t - 3
        e, theta, M, at = mpmath.zeros(n, d), mpmath.zeros(d, d), [], 0
        for i in index:
            a = mpmath.zeros(p, d)
            if i == 0:
                a[j, at], at = 1, at + 1
            z = C * A * e + a
            theta, e = theta + z.T * inverse * z, F * e - K * a
            M.append(e)
        freely = theta**-1
        for k in (1, 2, 15, 22, 30, 35, 36):
            Y = np.array((M[k - 1] * freely * M[k - 1].T).tolist(), float)
            half = found[k - 1]
            # the recursion works on factors; their errors grow with the steps, not with e
            np.testing.assert_allclose(half @ half.T, Y, rtol=1e-9, atol=1e-9 * np.max(np.abs(Y)))


@pytest.mark.parametrize("shape", SHAPES[:3])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_cheapest_attack_step_by_step(shape, seed):
    case = Case(seed, *shape)
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.2, 3.0, case.ones.shape)
    start = 0.3 * rng.normal(size=case.zero.shape) if seed == 3 else case.zero
    L = forward(case.m, case.index, weights, start)
    T = backward(case.m, case.index, weights, np.zeros(len(L), int))
    for k in (1, 5, 12):
        half = joined(L, T)[k - 1]
        Y, goal = half @ half.T, rng.normal(size=len(half))
        path = cheapest(case.m, case.index, weights, k, goal, start)
        np.testing.assert_allclose(path.e[k - 1], Y @ goal, rtol=1e-9, atol=1e-12)
        A, C, K, Q = case.s[:4]
        e, spent = start @ path.first, 0.0
        for i, which in enumerate(case.index):
            assert not np.any(path.a[i][~case.alterable[which]])
            z = C @ A @ e + path.a[i]
            e = A @ e - K @ z
            np.testing.assert_allclose(path.e[i], e, rtol=1e-10, atol=1e-12)
            cost = z @ np.linalg.solve(Q, z)
            assert path.cost[i, 0] == pytest.approx(cost, rel=1e-9, abs=1e-14)
            spent += weights[i, 0] * cost
        total = spent + path.first @ path.first
        assert total == pytest.approx(goal @ Y @ goal, rel=1e-9, abs=1e-14)


def test_a_path_holds_together_when_the_weights_differ_by_ten_orders():
    """Costates go back through weights of 1e-10; what is played must be what is reported."""
    case = Case(1, 2, 3, t=60)
    weights = 10.0 ** np.random.default_rng(0).uniform(-10, 0, case.ones.shape)
    path = cheapest(case.m, case.index, weights, 40, np.array([1.0, -2.0]), case.zero)
    A, C, K, Q = case.s[:4]
    e, size = np.zeros(2), np.max(np.abs(path.e))
    for i in range(60):
        z = C @ A @ e + path.a[i]
        e = A @ e - K @ z
        assert np.max(np.abs(path.e[i] - e)) <= 1e-11 * size
        assert path.cost[i, 0] == pytest.approx(z @ np.linalg.solve(Q, z), rel=1e-7, abs=1e-16)


def test_the_cost_to_come_ends_where_it_is_said_to():
    case = Case(2, 2, 3)
    ends = np.zeros(12, int)
    ends[[3, 8]] = 1
    found = backward(case.m, case.index, case.ones, ends)
    for a, b in ((0, 4), (4, 9), (9, 12)):
        own = backward(case.m, case.index[a:b], case.ones[a:b], np.zeros(b - a, int))
        np.testing.assert_allclose(found[a:b], own, rtol=1e-12, atol=1e-14)
        assert not np.any(found[b - 1])


def test_from_an_ellipsoid_on():
    """W_0 = L L' is where a first stretch of the attack ends."""
    case = Case(2, 4, 2)
    whole = forward(case.m, case.index, case.ones, case.zero)
    rest = forward(case.m, case.index[5:], case.ones[5:], whole[4])
    for L, R in zip(whole[5:], rest, strict=True):
        np.testing.assert_allclose(L @ L.T, R @ R.T, rtol=1e-11, atol=1e-13)


def test_what_is_ahead_counts_with_weights_of_its_own():
    s = drawn(5, 2, 3)
    A, C, K, Q = s[:4]
    free, index = np.array([[True, True, False]]), np.zeros(6, np.int32)
    m = moves(A, C, K, Q, free, blocks=2)
    weights = np.random.default_rng(0).uniform(0.1, 2.0, (6, 3))
    found = forward(m, index, weights, np.zeros((2, 2)))
    root = np.linalg.cholesky(Q)
    told = [C @ A, C @ A @ (A - K @ C @ A)]
    rows = [solve_triangular(root, one, lower=True) for one in told]
    e, theta = np.zeros((2, 12)), np.zeros((12, 12))
    for i in range(6):
        for w, row in zip(weights[i, 1:], rows, strict=True):
            theta += w * (row @ e).T @ (row @ e)
        a = np.zeros((3, 12))
        a[[0, 1], [2 * i, 2 * i + 1]] = 1.0
        z = C @ A @ e + a
        theta += weights[i, 0] * z.T @ np.linalg.solve(Q, z)
        e = (A - K @ C @ A) @ e - K @ a
    Y = e @ np.linalg.solve(theta, e.T)
    np.testing.assert_allclose(found[-1] @ found[-1].T, Y, rtol=1e-10)
    path = cheapest(m, index, weights, 6, np.array([1.0, 2.0]), np.zeros((2, 2)))
    assert np.sum(weights * path.cost) == pytest.approx(path.e[5] @ [1.0, 2.0], rel=1e-10)
    before = np.vstack([np.zeros(2), path.e[:-1]])
    for j, row in enumerate(rows):
        np.testing.assert_allclose(path.cost[:, 1 + j], np.sum((before @ row.T) ** 2, 1), rtol=1e-9)


def test_steps_of_one_kind():
    table = np.array([[1, 0], [0, 0], [1, 0], [1, 1]], bool)
    rows, index = patterns(table)
    assert len(rows) == 3
    np.testing.assert_array_equal(rows[index], table)


@pytest.mark.parametrize(("r", "n"), [(5, 1), (6, 3), (SMALL + 3, SMALL + 1)])
def test_a_triangle_of_rows(r, n):
    rng = np.random.default_rng(n)
    for m in (rng.normal(size=(r, n)), np.zeros((r, n)), rng.normal(size=(r, 1)) * np.ones(n)):
        R = np.asarray(triangle(jnp.asarray(m)))
        np.testing.assert_allclose(R.T @ R, m.T @ m, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(np.tril(R, -1), 0.0, atol=1e-13)


def test_what_is_told_of_a_singular_set():
    L, G = np.array([[1.0, 0.0], [2.0, 0.0]]), np.array([[3.0, -1.0]])
    found = np.asarray(informed(jnp.asarray(L), jnp.asarray(G)))
    np.testing.assert_allclose(found @ found.T, L @ L.T / 2.0, rtol=1e-14)
