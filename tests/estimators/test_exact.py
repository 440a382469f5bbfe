"""`kalman` and `unknown_input` against batch least squares in extended precision."""

import numpy as np
import pytest

import oracles
import systems
from holdfast.estimators import kalman, unknown_input
from systems import estimates

EPS = np.finfo(float).eps

# (n, ny, nd, rank of H): H = 0, full, deficient; as many attacks as outputs
SHAPES = [
    (2, 2, 1, 0),
    (3, 3, 2, 1),
    (3, 3, 3, 0),
    (4, 4, 2, 2),
    (5, 4, 4, 0),
    (6, 6, 2, 0),
]
MORE_SHAPES = [(2, 3, 2, 2), (4, 4, 3, 1), (5, 4, 2, 1), (6, 5, 3, 2)]


def assert_exact(got, answer, rows, condition):
    """Within 1000 eps times the condition number of the least-squares problem."""
    value, cov = got
    tolerance = 1000 * EPS * condition
    scale = max(1.0, float(np.max(np.abs(answer.value[rows]), initial=0.0)))
    np.testing.assert_allclose(
        value.astype(np.longdouble), answer.value[rows], rtol=0, atol=tolerance * scale
    )
    spread = answer.cov[np.ix_(rows, rows)]
    scale = max(1.0, float(np.max(np.abs(spread), initial=0.0)))
    np.testing.assert_allclose(cov.astype(np.longdouble), spread, rtol=0, atol=tolerance * scale)


def attack_rows(direct: np.ndarray, n: int) -> np.ndarray:
    """Where (x_k, d_{k-1}, d_k) holds what row k of a result gives."""
    nd = len(direct)
    return n + np.arange(nd) + np.where(direct, nd, 0)


def check_unknown_input(seed, shape, steps=50):
    system = systems.random_system(seed, *shape)
    plant, n = system.plant, shape[0]
    u, y, seen = systems.random_log(seed, plant, steps)
    estimator = unknown_input.build(plant, system.x0, system.P0)
    got = estimates(estimator, u, y, seen)
    answer = oracles.batch_estimate(systems.matrices(plant), system.x0, system.P0, u, y, seen)
    rows = attack_rows(np.asarray(estimator.direct), n)
    assert answer.determined[:n].all()
    assert answer.determined[rows].all()
    assert_exact((got.x[-1], got.x_cov[-1]), answer, np.arange(n), answer.condition)
    assert_exact((got.d[-1], got.d_cov[-1]), answer, rows, answer.condition)
    np.testing.assert_array_equal(got.d, got.d_free)


@pytest.mark.parametrize("shape", SHAPES)
def test_unknown_input_is_batch_least_squares(shape):
    for seed in range(2):
        check_unknown_input(seed, shape)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [*SHAPES, *MORE_SHAPES])
def test_unknown_input_is_batch_least_squares_on_200_systems(shape):
    for seed in range(100, 120):
        check_unknown_input(seed, shape)


@pytest.mark.parametrize("missing", [0.0, 0.4])
def test_kalman_is_batch_least_squares(missing):
    for seed in range(5):
        system = systems.random_system(seed, 4, 3, 0, 0)
        u, y, seen = systems.random_log(seed, system.plant, 50, missing)
        got = estimates(kalman.build(system.plant, system.x0, system.P0), u, y, seen)
        m = systems.matrices(system.plant)
        answer = oracles.batch_estimate(m, system.x0, system.P0, u, y, seen)
        assert_exact((got.x[-1], got.x_cov[-1]), answer, np.arange(4), answer.condition)


@pytest.mark.slow
def test_kalman_is_batch_least_squares_on_200_systems():
    for seed in range(200):
        n, ny = 2 + seed % 5, 1 + seed % 3
        system = systems.random_system(seed, n, ny, 0, 0)
        u, y, seen = systems.random_log(seed, system.plant, 50, 0.2 * (seed % 2))
        got = estimates(kalman.build(system.plant, system.x0, system.P0), u, y, seen)
        m = systems.matrices(system.plant)
        answer = oracles.batch_estimate(m, system.x0, system.P0, u, y, seen)
        assert_exact((got.x[-1], got.x_cov[-1]), answer, np.arange(n), answer.condition)


@pytest.mark.parametrize("shape", [(4, 4, 2, 1), (3, 3, 3, 0), (4, 2, 3, 1), (5, 3, 2, 1)])
def test_missing_samples_change_what_is_identifiable(shape):
    """At every row: the same quantities are undetermined as in the batch problem, the others
    agree. Attack and state may be barely determined here, so the tolerance is 1e-6 of the
    standard deviation: a recursion carries its rounding through steps at which the
    covariance was up to 1e7.
    """
    n, steps = shape[0], 12
    compared = lost = 0
    for seed in range(4):
        system = systems.random_system(seed, *shape) if shape[1] >= shape[2] else None
        system = system or underdetermined(seed, *shape)
        u, y, seen = systems.random_log(seed, system.plant, steps, 0.3)
        estimator = unknown_input.build(system.plant, system.x0, system.P0)
        got = estimates(estimator, u, y, seen)
        rows = np.r_[np.arange(n), attack_rows(np.asarray(estimator.direct), n)]
        m = systems.matrices(system.plant)
        for k in range(1, steps + 1):
            answer = oracles.batch_estimate(m, system.x0, system.P0, u[:k], y[:k], seen[:k])
            value = np.r_[got.x[k - 1], got.d[k - 1]]
            variance = np.r_[np.diagonal(got.x_cov[k - 1]), np.diagonal(got.d_cov[k - 1])]
            known = answer.determined[rows]
            np.testing.assert_array_equal(np.isfinite(variance), known)
            sd = np.sqrt(np.diagonal(answer.cov)[rows][known].astype(float))
            error = np.abs(value[known] - answer.value[rows][known].astype(float))
            assert np.all(error < 1e-6 * sd)
            np.testing.assert_allclose(np.sqrt(variance[known]), sd, rtol=1e-6)
            compared += known.sum()
            lost += (~known).sum()
    assert compared > 20 or shape[1] < shape[2]
    assert lost > 20


def test_square_plant_with_direct_attacks_stays_undetermined():
    """As many attacks as outputs and some of them direct: the attack before row 1 is free, no
    output is left to tell what it did to the state, and that never changes.
    """
    system = systems.random_system(0, 5, 3, 3, 2)
    u, y, seen = systems.random_log(0, system.plant, 30)
    got = estimates(unknown_input.build(system.plant, system.x0, system.P0), u, y, seen)
    m = systems.matrices(system.plant)
    answer = oracles.batch_estimate(m, system.x0, system.P0, u, y, seen)
    known = np.isfinite(np.diagonal(got.x_cov[-1]))
    np.testing.assert_array_equal(known, answer.determined[:5])
    assert not known.any()


def underdetermined(seed: int, n: int, ny: int, nd: int, rank: int) -> systems.System:
    """More attacks than outputs: much of it stays undetermined for ever."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    plant = systems.quiet_plant(
        A=A * 0.9 / np.max(np.abs(np.linalg.eigvals(A))),
        B=rng.normal(size=(n, 1)),
        C=rng.normal(size=(ny, n)),
        G=rng.normal(size=(n, nd)),
        H=rng.normal(size=(ny, rank)) @ rng.normal(size=(rank, nd)),
        Q=systems.covariance(rng, n),
        R=systems.covariance(rng, ny),
    )
    return systems.System(plant, rng.normal(size=n), systems.covariance(rng, n))
