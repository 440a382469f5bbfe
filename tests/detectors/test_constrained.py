"""Tests under limits: against closed forms, Monte Carlo and the tests without limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, norm

import care_oracle
import systems
from holdfast.campaign.attack_free import attack_free
from holdfast.campaign.calibrate import calibrated
from holdfast.detectors import care_paper, chi_square, cusum, likelihood_ratio
from holdfast.estimators import care, kalman, unknown_input
from holdfast.loop import Monitor
from holdfast.plants.build import linear_plant
from holdfast.records import Estimate, Reason

DRAWS = 40_000


def plant_of(channels: int):
    eye = np.eye(channels)
    return linear_plant(A=0.5 * eye, C=eye, G=eye, Q=eye, R=eye)


def record(d, cov, rows, bound, held=None) -> Estimate:
    """Estimates of one row each that differ in the free attack estimate only."""
    d = jnp.asarray(d, float)
    runs, m = d.shape
    many = lambda a: jnp.broadcast_to(jnp.asarray(a, float), (runs, *np.shape(a)))  # noqa: E731
    shown, shown_cov = (d, many(cov)) if held is None else held
    return Estimate(
        x=jnp.zeros((runs, 1)), x_cov=jnp.ones((runs, 1, 1)), d=shown, d_cov=shown_cov, d_free=d,
        d_free_cov=many(cov), d_rows=many(np.reshape(rows, (-1, m))), d_bound=many(bound),
        residual=jnp.zeros((runs, m)), residual_cov=many(np.eye(m)),
        status=jnp.zeros(runs, jnp.int32),
    )  # fmt: skip


def judge(detector, records):
    return jax.tree.map(
        np.asarray, jax.jit(jax.vmap(lambda e: detector.step(detector.init(), e)[1]))(records)
    )


def draws(mean, cov, seed=0):
    return np.random.default_rng(seed).multivariate_normal(mean, cov, DRAWS)


def test_without_limits_it_is_the_chi_square_test():
    plant, cov = plant_of(2), np.array([[2.0, 0.6], [0.6, 0.5]])
    given = record(draws([1, 0], cov)[:200], cov, np.zeros((0, 2)), np.zeros(0))
    ours = judge(likelihood_ratio.build(plant, level=0.02), given)
    truth = judge(chi_square.build(plant, level=0.02, on="attack"), given)
    # the same sum, compiled in another order
    np.testing.assert_allclose(ours.statistic, truth.statistic, rtol=1e-14)
    np.testing.assert_array_equal(ours.threshold, truth.threshold)
    none = judge(likelihood_ratio.build(plant, test="possible"), given)
    assert not none.alarm.any()
    assert np.all(none.threshold == np.inf)


def test_the_statistics_are_differences_of_distances():
    """By enumeration of active sets in NumPy: |d|^2 - dist^2 and dist^2."""
    plant, cov = plant_of(2), np.array([[2.0, 0.6], [0.6, 0.5]])
    rows = np.array([[1, 0], [-1, 0], [0, 1], [0.5, -1]])
    bound = np.array([1.0, 0.4, 0.6, 0.3])
    d = draws([0.5, 0.5], cov)[:100]
    attack = judge(likelihood_ratio.build(plant), record(d, cov, rows, bound)).statistic
    possible = judge(likelihood_ratio.build(plant, test="possible"), record(d, cov, rows, bound))
    weight = np.linalg.inv(cov)
    for value, of_attack, distance in zip(d, attack, possible.statistic, strict=True):
        apart = value - care_oracle.project(value, cov, rows, bound)[0]
        np.testing.assert_allclose(distance, apart @ weight @ apart, atol=1e-9)
        np.testing.assert_allclose(of_attack, value @ weight @ value - distance, atol=1e-9)
    assert np.all(attack <= judge(chi_square.build(plant, on="attack"),
                                  record(d, cov, rows, bound)).statistic + 1e-9)  # fmt: skip


def test_against_one_sided_attacks_it_is_the_one_sided_test():
    """d >= 0, one channel: the statistic is max(d, 0)^2 / P, chi-bar-square without attack."""
    plant = plant_of(1)
    found = judge(likelihood_ratio.build(plant), record(draws([0], [[4.0]]), [[4.0]], [[-1]], [0]))
    d = draws([0], [[4.0]])[:, 0]
    np.testing.assert_allclose(found.statistic, np.maximum(d, 0) ** 2 / 4, atol=1e-12)
    for t in (1.0, 4.0):
        share, error = 0.5 * chi2.sf(t, 1), 3 * np.sqrt(0.25 / DRAWS)
        assert abs(np.mean(found.statistic > t) - share) < error


SETS = {
    "half-line": (1, [[-1.0]], [0.0]),
    "slab": (1, [[1.0], [-1.0]], [0.1, 0.1]),
    "point": (2, [[1.0, 0], [-1, 0], [0, 1], [0, -1]], [0.0, 0, 0, 0]),
    "quadrant": (2, [[-1.0, 0], [0, -1]], [0.0, 0]),
    "sharp wedge": (2, [[-0.05, 1.0], [-0.05, -1]], [0.0, 0]),
    "box": (2, [[1.0, 0], [-1, 0], [0, 1], [0, -1]], [2.0, 0, 1, 0]),
}


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_what_is_possible_seldom_alarms(name, correlation):
    """The level holds with the truth in the corner, within 3 standard errors; where the bound
    is attained (half-line, point, the sharpest wedge) the alarms are as many as it allows.
    """
    m, rows, bound = SETS[name]
    cov = np.array([[1.0, correlation], [correlation, 1.0]])[:m, :m]
    level = 0.05
    detector = likelihood_ratio.build(plant_of(m), level=level, test="possible")
    found = judge(detector, record(draws(np.zeros(m), cov), cov, rows, bound))
    rate, error = np.mean(found.alarm), 3 * np.sqrt(level * (1 - level) / DRAWS)
    assert rate < level + error
    if name in ("half-line", "point"):
        assert rate > level - error
    assert set(found.reason[found.alarm]) == {int(Reason.IMPOSSIBLE)}


def test_thresholds_of_one_sided_limits():
    """One row: half the tail of chi2_1, the one-sided normal quantile."""
    detector = likelihood_ratio.build(plant_of(3), level=0.01, test="possible")
    assert float(detector.one_sided[1]) == pytest.approx(norm.isf(0.01) ** 2, rel=1e-12)
    for r in (2, 3):
        t = float(detector.one_sided[r])
        assert 0.5 * (chi2.sf(t, r - 1) + chi2.sf(t, r)) == pytest.approx(0.01, rel=1e-10)


def test_limits_that_contradict_each_other():
    plant = plant_of(1)
    given = record([[3.0]], [[1.0]], [[1.0], [-1.0]], [-1.0, -1.0])
    assert judge(likelihood_ratio.build(plant), given).statistic[0] == pytest.approx(9.0)
    none = judge(likelihood_ratio.build(plant, test="possible"), given)
    assert not none.alarm[0]
    assert none.threshold[0] == np.inf


def test_an_undetermined_channel_is_left_out():
    plant = plant_of(2)
    cov = np.array([[1.0, 0.0], [0.0, np.inf]])
    given = record([[2.0, 0.0]], cov, [[1.0, 0.0], [1.0, 1.0]], [1.0, 0.0])
    found = judge(likelihood_ratio.build(plant), given)
    assert found.statistic[0] == pytest.approx(4.0 - 1.0)
    assert found.threshold[0] == pytest.approx(chi2.isf(0.01, 1))


def test_without_an_attack_estimate_there_is_nothing_to_test():
    plant = linear_plant(A=[[0.5]], C=[[1]], Q=[[1]], R=[[1]])
    monitor = Monitor(kalman.build(plant, [0], [[1]]), likelihood_ratio.build(plant, on="attack"))
    _, estimate = monitor.estimator.init()
    _, verdict = monitor.detector.step(monitor.detector.init(), estimate)
    assert not verdict.alarm
    assert verdict.threshold == jnp.inf


def test_the_projected_statistic_is_the_weaker_one():
    """0 within the limits: |d^|_W <= |d^u|_W for every draw, so Theorem 9 cannot hold with the
    weight W of the free estimate; with the pseudo-inverse the statistic shrinks on average.
    """
    plant, cov = plant_of(2), np.array([[2.0, 0.6], [0.6, 0.5]])
    rows, bound = np.vstack([np.eye(2), -np.eye(2)]), np.full(4, 0.8)
    d = draws([1.5, 0.2], cov)[:400]
    held = [care_oracle.project(value, cov, rows, bound) for value in d]
    points, covs = (np.stack(part) for part in zip(*held, strict=True))
    given = record(d, cov, rows, bound, (jnp.asarray(points), jnp.asarray(covs)))
    ours = judge(care_paper.build(plant, threshold="paper"), given)
    plain = judge(cusum.build(plant, threshold="paper", on="attack"), given)
    # NumPy's Moore-Penrose inverse, rank n less the active rows
    active = np.sum(np.abs(points @ rows.T - bound) < 1e-9, 1)
    for point, spread, faces, statistic in zip(points, covs, active, ours.statistic, strict=True):
        pseudo = np.linalg.pinv(spread, rcond=1e-9, hermitian=True)
        expected = point @ pseudo @ point if faces < 2 else 0.0
        np.testing.assert_allclose(statistic, expected, rtol=1e-8, atol=1e-9)
    weight = np.linalg.inv(cov)
    shorter = np.einsum("ri,ij,rj->r", points, weight, points)
    assert np.all(shorter <= plain.statistic + 1e-9)
    assert np.mean(ours.statistic) < 0.5 * np.mean(plain.statistic)
    assert set(active) >= {0, 1}
    phi = 0.15
    for faces in (0, 1):
        got = ours.threshold[active == faces]
        # the sum starts at the paper's threshold for all channels and follows what was seen
        start = chi2.isf(0.01, 2) / (1 - phi)
        np.testing.assert_allclose(got, phi * start + chi2.isf(0.01, 2 - faces), rtol=1e-12)


@pytest.mark.parametrize("make", [
    lambda plant: likelihood_ratio.build(plant, level=0.05),
    pytest.param(lambda plant: care_paper.build(plant, level=0.05), marks=pytest.mark.slow),
])  # fmt: skip
def test_calibrated_levels(make):
    """Fresh runs at the calibrated threshold: 3 standard errors of calibration and check."""
    system = systems.random_system(4, 3, 3, 2, 0)
    A, _, C, _, G, H, Q, R = systems.matrices(system.plant)
    limits = {"attack": {"matrix": [[-1, 0], [0, 1], [0, -1]], "bound": [0.0, 0.5, 0.5]}}
    plant = systems.quiet_plant(A=A, C=C, G=G, H=H, Q=Q, R=R, constraints=limits)
    estimator = care.build(plant, system.x0, system.P0)
    monitor, how = calibrated(Monitor(estimator, make(plant)), runs=250, steps=200, seed=1)
    assert how.method == "simulated"
    said = attack_free(monitor, None, jax.random.split(jax.random.key(9), 250), 200)
    rates = np.mean(said.alarm[:, 100:], 1)
    error = np.std(rates, ddof=1) / np.sqrt(250)
    assert abs(np.mean(rates) - 0.05) < 3 * np.hypot(error, how.standard_error)


def test_which_thresholds_need_no_simulation():
    plant = plant_of(1)
    free = unknown_input.build(plant, [0], [[1]])
    sentence = calibrated(Monitor(free, likelihood_ratio.build(plant, test="possible")))[1]
    assert sentence.method == "bound"
    held = care.build(plant, [0], [[1]], project="output")
    assert calibrated(Monitor(held, chi_square.build(plant, on="attack")))[1].method == "exact"
