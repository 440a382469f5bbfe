"""The filter with Huber's loss, against the loss minimised directly and by reweighting."""

import clarabel
import jax
import numpy as np
import pytest
from scipy import sparse

import banks
import systems
from holdfast.attacks import bias
from holdfast.campaign.attack_free import start_state
from holdfast.detectors import chi_square
from holdfast.estimators import huber, kalman
from holdfast.loop import Monitor, Scenario, simulate
from holdfast.plants.build import linear_plant
from holdfast.records import Status

SIZES = [(1, 1), (2, 4), (4, 3), (6, 8)]


def plant_of(seed, n, ny, correlated=False):
    """A stable plant; uncorrelated sensors, where the LASSO is Huber's loss, unless asked."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
    R = np.diag(rng.uniform(0.1, 2.0, ny)) + (0.3 * np.ones((ny, ny)) if correlated else 0.0)
    C, root = rng.normal(size=(ny, n)), 0.3 * rng.normal(size=(n, n))
    return linear_plant(A=A, C=C, Q=root @ root.T + 0.01 * np.eye(n), R=R, dt=1.0)


def loss(at, x, P, C, nu, sd, threshold):
    e = np.abs(nu - C @ (at - x)) / sd
    rho = np.where(e < threshold, e**2 / 2, threshold * e - threshold**2 / 2)
    return (at - x) @ np.linalg.solve(P, at - x) / 2 + rho.sum()


def direct(x, P, C, nu, sd, threshold):
    """argmin over dx of dx'P^-1 dx/2 + sum rho((nu - C dx)/sd), as a quadratic programme.

    rho(e) = min over s, t of s^2/2 + threshold |t| with e = s + t.
    """
    n, m = len(x), len(nu)
    # variables dx, t+, t-; s = (nu - C dx)/sd - t+ + t-
    B = np.hstack([-C / sd[:, None], -np.eye(m), np.eye(m)])
    H = B.T @ B
    H[:n, :n] += np.linalg.inv(P)
    q = B.T @ (nu / sd) + threshold * np.concatenate([np.zeros(n), np.ones(2 * m)])
    G = np.hstack([np.zeros((2 * m, n)), -np.eye(2 * m)])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-13
    solver = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(H)), q, sparse.csc_matrix(G), np.zeros(2 * m),
        [clarabel.NonnegativeConeT(2 * m)], settings,
    )  # fmt: skip
    return x + np.array(solver.solve().x)[:n]


def reweighted(x, P, C, nu, sd, threshold):
    """Iteratively reweighted least squares, to its fixed point; the covariance there."""
    at = x.copy()
    for _ in range(10_000):
        before, r = at, nu - C @ (at - x)
        w = np.minimum(1.0, threshold * sd / np.maximum(np.abs(r), 1e-300))
        J = np.linalg.inv(P) + C.T @ ((w / sd**2)[:, None] * C)
        at = x + np.linalg.solve(J, C.T @ (w / sd**2 * nu))
        if np.max(np.abs(at - before)) < 1e-13:
            break
    return at, np.linalg.inv(J)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("threshold", [0.3, 1.345, 4.0])
def test_a_row_minimises_the_loss(size, threshold):
    """The fixed point of reweighting to 1e-9, and no programme finds less than it does."""
    for seed in range(2):
        plant = plant_of(seed, *size)
        A, _, C, _, _, _, Q, R = systems.matrices(plant)
        rng = np.random.default_rng(seed)
        x0, P0 = rng.normal(size=size[0]), np.eye(size[0])
        y = 3.0 * rng.standard_t(1.5, (4, size[1]))
        built = huber.build(plant, x0, P0, threshold=threshold)
        got = jax.tree.map(np.asarray, banks.ran(built, banks.log(np.zeros((4, 0)), y))[1])
        x, P = x0, P0
        for k in range(4):
            x, P = A @ x, A @ P @ A.T + Q
            given = x, P, C, y[k] - C @ x, np.sqrt(np.diag(R)), threshold
            assert loss(got.x[k], *given) <= loss(direct(*given), *given) + 1e-9
            at, cov = reweighted(*given)
            np.testing.assert_allclose(got.x[k], at, rtol=0, atol=1e-9)
            np.testing.assert_allclose(got.x_cov[k], cov, rtol=1e-8, atol=1e-10)
            left = y[k] - C @ got.x[k]
            beyond = np.maximum(np.abs(left) - threshold * np.sqrt(np.diag(R)), 0) * np.sign(left)
            np.testing.assert_allclose(got.a[k], beyond, rtol=0, atol=1e-8)
            x, P = got.x[k], got.x_cov[k]
        assert not np.any(got.status & int(Status.NOT_CONVERGED))


def test_a_large_threshold_is_the_kalman_filter():
    plant = plant_of(0, 3, 4, correlated=True)
    y = 5.0 * np.random.default_rng(0).normal(size=(40, 4))
    seen = np.random.default_rng(1).random((40, 4)) < 0.7
    observations = banks.log(np.zeros((40, 0)), y, seen)
    ours = banks.ran(huber.build(plant, np.ones(3), np.eye(3), threshold=1e6), observations)[1]
    theirs = banks.ran(kalman.build(plant, np.ones(3), np.eye(3)), observations)[1]
    for name in ("x", "x_cov", "residual", "residual_cov"):
        np.testing.assert_allclose(
            getattr(ours, name), getattr(theirs, name), rtol=1e-11, atol=1e-12
        )


def test_an_authenticated_sample_is_believed_however_far_it_is():
    plant = plant_of(1, 1, 1)
    far = np.array([[50.0]])
    moved = {}
    for trusted in (False, True):
        log = banks.log(np.zeros((1, 0)), far, trusted=np.full((1, 1), trusted))
        got = banks.ran(huber.build(plant, [0.0], [[1.0]]), log)[1]
        moved[trusted] = float(got.x[0, 0])
        assert (float(got.a[0, 0]) == 0) is trusted
    truth = banks.ran(kalman.build(plant, [0.0], [[1.0]]), log)[1]
    assert moved[True] == pytest.approx(float(truth.x[0, 0]))
    assert abs(moved[False]) < 0.2 * abs(moved[True])


@pytest.mark.slow
def test_one_liar_of_four_pulls_no_harder_for_lying_more():
    """The loss of efficiency without attack, and what a lie does, with the size of the lie."""
    plant = linear_plant(
        A=[[0.95]], C=np.ones((4, 1)), Q=[[0.05]], R=np.eye(4), dt=1.0,
        H=[[1.0], [0.0], [0.0], [0.0]],
    )  # fmt: skip

    def error(module, size, **settings):
        estimator = module.build(plant, [0.0], [[1.0]], **settings)
        monitor = Monitor(estimator, chi_square.build(plant, on="residual"))
        attacks = (bias.build(plant, value=size, channel="channel:d1"),)

        def run(key):
            start, key = jax.random.split(key)
            scenario = Scenario(plant, start_state(estimator, start), monitor, None, attacks)
            trace = simulate(scenario, key, 200)
            return (trace.estimate.x - trace.x)[20:] ** 2

        keys = jax.random.split(jax.random.key(0), 40)
        return float(np.sqrt(np.mean(jax.jit(jax.vmap(run))(keys))))

    quiet = error(kalman, 0.0)
    assert error(huber, 0.0) < 1.03 * quiet
    lies = [error(huber, size) for size in (10.0, 100.0, 1e4)]
    assert max(lies) < 2.1 * quiet  # three honest ones hold against a pull of 1.345 a row
    assert lies[2] == pytest.approx(lies[1], rel=1e-3)
    assert error(kalman, 100.0) > 10 * lies[1]


@pytest.mark.parametrize("value", [0.0, -1.0, float("inf"), float("nan")])
def test_a_threshold_that_is_none(value):
    with pytest.raises(ValueError, match="threshold"):
        huber.build(plant_of(0, 1, 1), [0.0], [[1.0]], threshold=value)
