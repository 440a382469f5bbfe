"""The vehicle against plain NumPy: the log, both filters, the statistics, the errata's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import chdtri

from holdfast.detectors import care_paper, likelihood_ratio
from holdfast.papers import care_detection as detection
from holdfast.papers import care_table as table
from holdfast.papers import care_vehicle as vehicle
from papers import care_oracle as oracle

pytestmark = pytest.mark.slow  # sixteen seeds of the case study

SEED = 3
SEEDS_OF_ERRATA = 16


def close(ours, theirs, tolerance=1e-8):
    """Relative to the size of the whole series: both carry 1000 steps of rounding."""
    scale = np.max(np.abs(theirs))
    np.testing.assert_allclose(ours / scale, theirs / scale, rtol=0, atol=tolerance)


@pytest.mark.parametrize("which", ["care", "ise"])
def test_both_filters_equal_algorithm_1_in_plain_numpy(run, which):
    """Only the log and the printed matrices are shared."""
    A, G = (np.stack(part) for part in zip(*map(oracle.matrices, run.speed[SEED]), strict=True))
    theirs = oracle.care(
        A, G, np.eye(4), oracle.Q, oracle.R, oracle.X0, np.eye(4), run.y[SEED],
        oracle.STATE, oracle.ATTACK, project_it=which == "care",
    )  # fmt: skip
    ours = getattr(run, which).estimate
    for name in oracle.Filtered._fields:
        # the first row has a covariance of d of 1e4, every other of 1: compared apart
        mine = getattr(ours, name)[SEED]
        close(mine[:1], getattr(theirs, name)[:1])
        close(mine[1:], getattr(theirs, name)[1:])


def test_the_log_obeys_the_model_and_the_limits(run):
    x_before = np.concatenate(
        [np.broadcast_to(vehicle.START, run.x[:, :1].shape), run.x[:, :-1]], 1
    )
    np.testing.assert_array_equal(run.speed, x_before[..., 3])
    A, G = vehicle.matrices(run.speed)
    w = run.x - np.einsum("skij,skj->ski", A, x_before) - np.einsum("skij,skj->ski", G, run.d)
    free = ~run.outside
    assert 0.1 < np.mean(free) < 0.5
    for noise, variance in (
        (w[..., 2], vehicle.PROCESS[2]),  # the heading has no limits: never clipped
        *((run.y[..., i] - run.x[..., i], vehicle.MEASUREMENT[i]) for i in range(4)),
    ):
        # 16000 draws know a variance to 1.1 %: five standard deviations
        assert np.var(noise) == pytest.approx(variance, rel=0.056)
    assert np.all((run.x >= vehicle.LOW) & (run.x <= vehicle.HIGH))
    assert np.any(run.x[..., 0] == 20.0)
    # what the row on Fig. 2 says of the linearisation about a heading of 0
    assert np.max(np.abs(run.x[..., 2])) > 4.0


def test_attack_and_matrices_are_those_written_down_twice():
    signal = vehicle.attack_signal(vehicle.Setting())
    np.testing.assert_allclose(
        signal, np.stack([oracle.attack(k) for k in range(1000)]), rtol=0, atol=1e-15
    )
    for speed in (0.0, 18.8, 22.0):
        for ours, theirs in zip(vehicle.matrices(speed), oracle.matrices(speed), strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_the_products_vehicle_is_the_printed_one(run):
    plant = vehicle.plant_along(run.speed[SEED], vehicle.Setting())
    for name, printed in zip("AG", vehicle.matrices(run.speed[SEED]), strict=True):
        np.testing.assert_allclose(getattr(plant, name), printed, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(plant.B, plant.G)
    for name, (rows, bound) in (("state", oracle.STATE), ("attack", oracle.ATTACK)):
        side = getattr(plant.constraints, name)
        # in whatever order: row and bound side by side, sorted
        ours = np.column_stack([side.matrix, side.bound])
        np.testing.assert_allclose(
            ours[np.lexsort(ours.T)],
            (theirs := np.column_stack([rows, bound]))[np.lexsort(theirs.T)],
            rtol=0,
            atol=1e-15,
        )
    limits = plant.constraints
    np.testing.assert_array_equal(limits.state.matrix, vehicle.STATE_ROWS)
    np.testing.assert_array_equal(limits.attack.matrix, vehicle.ATTACK_ROWS)
    np.testing.assert_allclose(limits.attack.bound, vehicle.ATTACK_BOUND, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("which", "column", "mean", "spread"),
    [
        ("ise", 0, 125.5, 2.3), ("care", 0, 92.3, 2.9), ("ise", 1, 1027, 27), ("care", 1, 676, 25),
        ("care", 2, 0.4605, 0.010), ("care", 3, 28.3, 0.4),
    ],
)  # fmt: skip
def test_table_1_is_that_of_an_independent_implementation(run, which, column, mean, spread):
    """The means of two sets of 16 other seeds: three standard deviations of their difference."""
    ours = np.mean(table.cells(getattr(run, which), run.x, run.d)[:, column])
    assert abs(ours - mean) < 3.0 * spread * np.sqrt(2.0 / SEEDS_OF_ERRATA)


@pytest.mark.parametrize(
    ("name", "share", "spread"),
    [
        ("Section 5.2, 66.44 %", 25.9, 1.7),
        ("Theorem 9, vehicle, pseudo-inverse", 94.5, 1.0),
        ("Theorem 9, vehicle, reduced degrees of freedom", 84.4, 1.3),
        ("Theorem 9, vehicle, weight (P^{d,u})^-1", 33.5, 1.5),
    ],
)
def test_false_negatives_are_those_of_an_independent_implementation(rows, name, share, spread):
    ours = np.atleast_1d(rows[name].ours)[0]
    assert abs(ours - share) < 3.0 * spread * np.sqrt(2.0 / SEEDS_OF_ERRATA)


def test_the_state_error_saved_is_what_the_paper_promises(rows):
    assert rows["Table 1, column 1"].ours >= 25.0


def test_statistics_row_by_row(run):
    """Each reading from its definition; ranks are judged against the unprojected covariance."""
    found, said = detection.statistics(run.care.estimate), run.care.estimate
    kinds = set()
    for k in range(0, 1000, 3):
        d, free, P = (one[SEED, k] for one in (said.d, said.d_free, said.d_free_cov))
        W = np.linalg.inv(P)
        values, vectors = np.linalg.eigh(said.d_cov[SEED, k])
        # 1e-9 of the smallest unprojected variance: rounding is 1e-16 of the largest, which is
        # at most 1e4 times the smallest
        kept = values > 1e-9 * np.linalg.eigvalsh(P)[0]
        pseudo = np.sum((vectors[:, kept].T @ d) ** 2 / values[kept])
        kinds.add(int(kept.sum()))
        assert found.dof[SEED, k] == kept.sum()
        assert found.pseudo[SEED, k] == pytest.approx(pseudo, rel=1e-9, abs=1e-12)
        assert found.free[SEED, k] == pytest.approx(free @ W @ free, rel=1e-9)
        assert found.weighted[SEED, k] == pytest.approx(d @ W @ d, rel=1e-9)
        ratio = free @ W @ free - (free - d) @ W @ (free - d)
        assert found.ratio[SEED, k] == pytest.approx(ratio, rel=1e-9, abs=1e-9)
        if not kept.all():
            # (22) is singular: its inverse is infinite, or rounding divided by rounding
            assert abs(found.inverted[SEED, k]) > 1e6
    assert kinds == {0, 1, 2}


def test_the_projected_statistic_never_exceeds_the_free_one(run):
    found = detection.statistics(run.care.estimate)
    # 0 is within the limits: |d^|_W <= |d^u|_W, up to rounding
    assert np.all(found.weighted <= found.free * (1 + 1e-9))


def test_the_products_detector_sums_as_the_paper_does(run):
    free = detection.statistics(run.ise.estimate).free
    # rounding of 1000 sums
    np.testing.assert_allclose(run.ise.verdict.statistic, detection.summed(free, 0.15), rtol=1e-10)
    np.testing.assert_allclose(run.ise.verdict.threshold[:, 100:], detection.limit(), rtol=1e-12)


def verdicts(part, run, **settings):
    """What a detector of the product says of CARE's estimates on one seed."""
    plant = vehicle.plant_along(run.speed[SEED], vehicle.Setting())
    detector = part.build(plant, on="attack", threshold="paper", **settings)
    estimates = jax.tree.map(lambda leaf: jnp.asarray(leaf[SEED]), run.care.estimate)
    return jax.lax.scan(lambda *row: detector.step(*row), detector.init(), estimates)[1]


def test_the_products_likelihood_ratio_is_the_one_judged(run):
    ours = detection.statistics(run.care.estimate).ratio[SEED]
    # differences of numbers of order 100, each to rounding
    np.testing.assert_allclose(verdicts(likelihood_ratio, run).statistic, ours, atol=1e-9)


def test_the_products_detector_of_the_paper_is_the_reading_with_reduced_degrees(run):
    found = detection.statistics(run.care.estimate)
    said = verdicts(care_paper, run, forgetting=0.15)
    summed = detection.summed(found.pseudo[SEED], 0.15)
    np.testing.assert_allclose(said.statistic, summed, rtol=1e-9, atol=1e-12)
    quantiles = np.where(found.dof[SEED] > 0, chdtri(np.maximum(found.dof[SEED], 1), 0.01), 0.0)
    # before the start the product supposes rows of full rank: that is forgotten by row 20
    threshold = detection.summed(quantiles, 0.15)
    np.testing.assert_allclose(said.threshold[20:], threshold[20:], rtol=1e-9)


def test_missed_counts_what_1_defines():
    d = np.array([[[0.0, 0.0], [1.0, 0.0], [0.0, 2.0], [1.0, 1.0], [1.0, 0.0]]])
    series = np.array([[0.0, 5.0, 3.0, 7.0, 5.0]])
    assert detection.missed(series, 5.0, d).tolist() == [75.0]
    assert detection.missed(series, np.array([[9.0, 4.0, 4.0, 8.0, 4.0]]), d).tolist() == [50.0]


def test_false_alarm_rate_of_56_by_simulation(rows):
    rng = np.random.default_rng(0)
    total = np.zeros(10**6)
    for _ in range(20):  # 0.15^20 is 3e-17
        total = 0.15 * total + rng.chisquare(2, len(total))
    simulated = np.mean(total > detection.limit())
    # 10^6 independent draws of the stationary sum: three standard errors of 7.3e-5
    assert rows["(56)"].ours == pytest.approx(simulated, abs=2.2e-4)


def test_calibrated_tests_have_the_rate_they_are_given(rows):
    """The limits help a sound test: by the share that the sentence in the docs names."""
    for name in ("likelihood ratio", "likelihood ratio summed"):
        limited, free = rows[f"Section 1, contribution iv, {name}"].ours
        assert 1.0 < free - limited < 10.0


def test_an_attack_in_proportion_needs_the_threshold_that_is_told(run):
    series = np.asarray(run.ise.verdict.statistic)
    needed = detection.needed_threshold(series, run.d)
    # the errata: 18.0, from other seeds
    assert needed == pytest.approx(18.0, abs=0.7)
    assert np.mean(detection.missed(series, needed, run.d)) == pytest.approx(66.44, abs=0.01)
