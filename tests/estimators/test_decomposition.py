"""`decomposition` against the fixed-gain filter, written out in NumPy.

Tolerance 1e-10 of the largest estimate: the systems are drawn so that x is made of terms up to
1e3 times as large (`decomposed.forgotten`), in F and in G; measured 2e-12, with a gain 3 % off
1e-4 and more. The covariances are A P A' corrected, which cancels where A = (I - K C)^-1 M is
large: measured 3e-10 of the largest so far.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from decomposed import COUNT, KINDS, covariance, decomposable
from holdfast.estimators import decomposition
from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from systems import estimates, quiet_plant, random_log

STEPS = 40
TOLERANCE = np.array([1e-10, 1e-9, 1e-10, 1e-9])  # x, P, innovation, its covariance


def fixed_gain(s, K, P, u, y, seen):
    """x, P, innovation and its covariance at every row; a missing sample's innovation is zero."""
    x, rows = s.x0, []
    for k in range(len(y)):
        before, P_before = s.A @ x + s.B @ u[k], s.A @ P @ s.A.T + s.Q
        innovation = np.where(seen[k], y[k] - s.D @ u[k] - s.C @ before, 0.0)
        spread = s.C @ P_before @ s.C.T + s.R
        spread = np.where(np.outer(seen[k], seen[k]), spread, 0.0)
        gain = K * seen[k]
        x, left = before + gain @ innovation, np.eye(len(x)) - gain @ s.C
        P = left @ P_before @ left.T + gain @ s.R @ gain.T
        rows.append((x, P, innovation, spread))
    return [np.array(column) for column in zip(*rows, strict=True)]


def widened(built, n=12, m=20):
    """The same estimator among states and sensors that do nothing: one compilation for all."""
    bank, plant = built.bank, built.plant
    small_m, d, small_n = plant.C.shape[0], len(bank.b), plant.C.shape[1]

    def to(array, *shape):
        array = np.asarray(array)
        return np.pad(array, [(0, t - s) for t, s in zip(shape, array.shape, strict=True)])

    wide = quiet_plant(
        A=to(plant.A, n, n), B=to(plant.B, n, 2), C=to(plant.C, m, n), D=to(plant.D, m, 2),
        Q=to(plant.Q, n, n), R=np.diag(np.arange(m) >= small_m) + to(plant.R, m, m),
    )  # fmt: skip
    F = to(np.reshape(bank.F, (small_n, small_m, d)), n, m, n).reshape(n, -1)
    G = to(np.reshape(bank.G, (small_m, d, small_n)), m, n, n).reshape(-1, n)
    enter = to(np.reshape(bank.enter, (small_m, d, 2)), m, n, 2).reshape(-1, 2)
    arrays = (to(bank.S, n, n), to(bank.b, n), F, G, enter, to(bank.K, n, m))
    return replace(
        built,
        plant=wide,
        bank=decomposition.Bank(*map(jnp.asarray, arrays)),
        x0=jnp.asarray(to(built.x0, n)),
        P0=jnp.asarray(to(built.P0, n, n)),
    )


def plant_of(s):
    return quiet_plant(A=s.A, B=s.B, C=s.C, D=s.D, Q=s.Q, R=s.R)


def so_far(covariances):
    largest = np.max(np.abs(covariances), (1, 2), keepdims=True)
    return np.maximum.accumulate(np.maximum(largest, 1e-300))


def worst_difference(seed, wide, gap, off=1.0):
    """Largest relative differences (x, P, innovation and its covariance); ``off``: the truth's
    gain is that many times too large."""
    s = decomposable(seed)
    n, m = s.K.shape
    built = decomposition.build(
        plant_of(s), s.x0, covariance(np.random.default_rng(seed), n), gain=s.K
    )
    u, y, seen = random_log(seed, built.plant, STEPS, gap)
    truth = fixed_gain(s, off * s.K, np.asarray(built.P0), u, y, seen)
    if wide:
        built = widened(built)
        y, seen = (np.pad(a, [(0, 0), (0, 20 - m)], constant_values=v)
                   for a, v in ((y, 0.0), (seen, True)))  # fmt: skip
    got = estimates(built, u, y, seen)
    found = (got.x[:, :n], got.x_cov[:, :n, :n], got.residual[:, :m], got.residual_cov[:, :m, :m])
    # gaps let a covariance grow, and its rounding stays: it is judged by the largest so far
    sizes = [np.max(np.abs(truth[0])), so_far(truth[1])]
    sizes += [np.max(np.abs(truth[0]) @ np.abs(s.C.T)), so_far(truth[3])]
    return [np.max(np.abs(a - b) / scale) for a, b, scale in zip(found, truth, sizes, strict=True)]


def check(seeds, wide):
    found = np.array([worst_difference(seed, wide, 0.2 * (seed % 3)) for seed in seeds])
    print("x, P, innovation, its covariance differ by at most", found.max(0))
    assert np.all(found < TOLERANCE), (np.argmax(found, 0), found.max(0))


def test_it_is_the_fixed_gain_filter():
    """Two at their own size (small sizes are other code, `linalg.dot`), two of each kind at
    one size.
    """
    check((1, 2), wide=False)
    check(range(2 * len(KINDS)), wide=True)


@pytest.mark.slow
def test_it_is_the_fixed_gain_filter_on_200_systems():
    check(range(COUNT), wide=True)


def test_a_gain_that_is_3_percent_off_is_seen():
    for seed in range(4, 8):
        assert worst_difference(seed, True, 0.0, off=1.03)[0] > 1e-4


def test_by_default_the_gain_is_kalman_s():
    """K and the steady covariance from SciPy's Riccati solver: its error, 1e-12 as a rule."""
    s = decomposable(0)
    assert s.kind == "kalman"
    P_before = solve_discrete_are(s.A.T, s.C.T, s.Q, s.R)
    K = np.linalg.solve(s.C @ P_before @ s.C.T + s.R, s.C @ P_before).T
    built = decomposition.build(plant_of(s), s.x0)
    np.testing.assert_allclose(built.bank.K, K, atol=1e-10 * np.max(np.abs(K)))
    P = (np.eye(len(K)) - K @ s.C) @ P_before
    np.testing.assert_allclose(built.P0, P, atol=1e-10 * np.max(np.abs(P)))
    u, y, seen = random_log(0, built.plant, STEPS, 0.2)
    x, P, _, _ = fixed_gain(s, K, P, u, y, seen)
    got = estimates(built, u, y, seen)
    np.testing.assert_allclose(got.x, x, atol=1e-9 * np.max(np.abs(x)))
    np.testing.assert_allclose(got.x_cov, P, atol=1e-9 * np.max(np.abs(P)))


def test_x0_and_P0_may_be_left_out():
    s = decomposable(0)
    built = decomposition.build(plant_of(s))
    state, first = built.init()
    assert np.array_equal(first.x, np.zeros(len(s.A)))
    assert np.array_equal(state.zeta, np.zeros(len(state.zeta)))
    # and without gaps the covariance stays where it is
    u, y, seen = random_log(0, built.plant, STEPS)
    got = estimates(built, u, y, seen)
    np.testing.assert_allclose(got.x_cov, np.broadcast_to(first.x_cov, got.x_cov.shape), atol=1e-12)


def test_the_h_infinity_gain():
    """P <- A (P^-1 + C' R^-1 C - I / bound^2)^-1 A' + Q with inverses, and the filter with it."""
    s = decomposable(10)
    n, bound = len(s.A), 0.7
    P = s.Q
    for _ in range(2000):
        P = (
            s.A
            @ np.linalg.inv(
                np.linalg.inv(P) + s.C.T @ np.linalg.solve(s.R, s.C) - np.eye(n) / bound**2
            )
            @ s.A.T
            + s.Q
        )
    K = np.linalg.solve(s.C @ P @ s.C.T + s.R, s.C @ P).T
    built = decomposition.build(plant_of(s), s.x0, np.eye(n), bound=bound)
    kalman = decomposition.build(plant_of(s)).bank.K
    np.testing.assert_allclose(built.bank.K, K, atol=1e-9 * np.max(np.abs(K)))
    assert np.max(np.abs(K - kalman)) > 3e-3 * np.max(np.abs(K))
    u, y, seen = random_log(10, built.plant, STEPS, 0.2)
    x, P, _, _ = fixed_gain(s, K, np.eye(n), u, y, seen)
    got = estimates(built, u, y, seen)
    np.testing.assert_allclose(got.x, x, atol=1e-8 * np.max(np.abs(x)))
    np.testing.assert_allclose(got.x_cov, P, atol=1e-8 * np.max(np.abs(P)))


PLANT = {"A": np.diag([0.9, 0.5]), "C": np.eye(2), "Q": np.eye(2), "R": np.eye(2)}


@pytest.mark.parametrize(
    ("changes", "keys", "message"),
    [
        ({"C": [[1.0, 0.0], [2.0, 0.0]]}, {}, "share the eigenvalue 0.5"),
        ({"A": np.diag([1.5, 0.5]), "C": [[0.0, 1.0]], "R": [[1.0]]}, {}, "unstable mode 1.5"),
        ({}, {"gain": 0.2 * np.eye(3)}, "found 3 x 3, expected 2 x 2"),
        ({}, {"gain": np.full((2, 2), np.nan)}, "gain: found NaN"),
        ({}, {"gain": -0.5 * np.eye(2)}, "not < 1"),
        ({}, {"gain": np.zeros((2, 2))}, "share the eigenvalue"),
        ({}, {"gain": 0.2 * np.eye(2), "bound": 3.0}, "bound: found 3.0, expected no bound"),
        ({}, {"bound": 0.1}, "bound: found 0.1, expected a larger one"),
        ({}, {"bound": -1.0}, "bound: found -1.0"),
        ({"A": np.tile(np.diag([0.9, 0.5]), (4, 1, 1))}, {}, "varies in time"),
    ],
)  # fmt: skip
def test_what_has_none_is_refused(changes, keys, message):
    with pytest.raises(InvalidValue, match=message):
        decomposition.build(linear_plant(**(PLANT | changes)), **keys)
