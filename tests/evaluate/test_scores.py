"""Scores against closed forms, enumeration, scipy and Monte Carlo."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from holdfast.evaluate import scores

ROWS = st.lists(st.booleans(), min_size=1, max_size=60).map(np.array)


def test_rmse_and_worst_leave_out_what_is_undetermined():
    error = np.array([[3.0, 1.0], [-4.0, 0.0], [100.0, 0.0]])
    variance = np.array([[1.0, np.inf], [1.0, np.inf], [np.inf, np.inf]])
    assert scores.rmse(error, variance)[0] == pytest.approx(np.sqrt(12.5))
    assert scores.worst_error(error, variance)[0] == 4.0
    assert np.isnan(scores.rmse(error, variance)[1])
    assert np.isnan(scores.worst_error(error, variance)[1])
    assert scores.rmse(np.stack([error, error]))[1] == pytest.approx(np.sqrt(1 / 3))


def test_normalised_squares_count_only_what_carries_information():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    cov, v = root @ root.T, rng.normal(size=3)
    value, degrees = scores.normalised_squares(v, cov)
    np.testing.assert_allclose(value, v @ np.linalg.solve(cov, v), rtol=1e-9)
    assert degrees == 3
    blocked = cov.copy()
    blocked[0], blocked[:, 0] = 0.0, 0.0  # no information
    blocked[1], blocked[:, 1] = 0.0, 0.0
    blocked[1, 1] = np.inf  # undetermined
    value, degrees = scores.normalised_squares(np.stack([v, v]), np.stack([blocked, cov]))
    np.testing.assert_allclose(value[0], v[2] ** 2 / cov[2, 2], rtol=1e-9)
    assert degrees.tolist() == [1, 3]


def test_consistency_interval_covers_white_squares_and_rejects_other_scales():
    rng = np.random.default_rng(1)
    squares, degrees = rng.chisquare(2, (2000, 150)), np.full(150, 2)
    inside = np.mean([scores.consistency(row, degrees).consistent for row in squares])
    assert abs(inside - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 2000)
    long = rng.chisquare(2, 20_000)
    assert not scores.consistency(1.03 * long / long.mean() * 2, np.full(20_000, 2)).consistent
    found = scores.consistency(long, np.full(20_000, 2))
    low, high = stats.chi2.ppf([0.025, 0.975], 40_000) / 40_000
    np.testing.assert_allclose([found.low, found.high], [low, high], rtol=1e-12)
    assert np.isnan(scores.consistency(np.zeros(3), np.zeros(3)).ratio)


def test_correlated_rows_are_worth_their_number_over_the_correlation_time():
    # squares of an AR(1) process correlate as a^(2k): 1 + 2 sum = (1 + a^2) / (1 - a^2)
    rng, a, rows = np.random.default_rng(2), 0.9, 400_000
    noise = rng.normal(size=rows) * np.sqrt(1 - a * a)
    from scipy.signal import lfilter

    x = lfilter([1.0], [1.0, -a], noise)
    expected = (1 + a * a) / (1 - a * a)
    assert scores.correlation_time(x * x) == pytest.approx(expected, rel=0.05)
    found = scores.consistency(x * x, np.ones(rows), white=False)
    assert found.independent == pytest.approx(rows / expected, rel=0.05)
    assert scores.correlation_time(rng.normal(size=10_000)) < 1.1


def test_share_is_wilsons_interval():
    for count, of in [(0, 299), (1, 10), (50, 100), (10, 10)]:
        found = scores.share(count, of)
        expected = stats.binomtest(count, of).proportion_ci(0.95, method="wilson")
        np.testing.assert_allclose([found.low, found.high], expected, atol=1e-12)
        assert found.value == count / of
    assert np.isnan(scores.share(0, 0).value)


def test_false_alarms_and_misses_treat_untested_rows_as_they_should():
    alarm = np.array([True, False, False, True, False, False])
    attacked = np.array([False, False, False, True, True, True])
    tested = np.array([True, True, False, True, True, False])
    false = scores.false_alarm_rate(alarm, ~attacked, tested)
    missed = scores.missed_share(alarm, attacked, tested)
    assert (false.hits, false.of) == (1, 2)  # what was not tested could not alarm
    assert (missed.hits, missed.of) == (2, 3)  # but an unseen attack is missed


def test_detection_delay_takes_alarms_within_the_attack_only():
    t = np.arange(1, 11.0)
    alarm = np.isin(t, [2, 6, 9])
    assert scores.detection_delay(t, alarm, 5.0) == 1.0
    assert scores.detection_delay(t, alarm, 6.0) == 0.0
    assert scores.detection_delay(t, alarm, 7.0, 9.0) == np.inf
    assert scores.detection_delay(t, np.zeros(10, bool), 5.0) == np.inf


@given(ROWS, st.integers(1, 6))
@settings(deadline=None, max_examples=50)
def test_episodes_are_what_a_loop_over_the_rows_finds(alarm, gap):
    dt = 0.1
    expected: list[list[int]] = []
    for row in np.flatnonzero(alarm).tolist():
        if expected and row - expected[-1][1] <= gap:
            expected[-1][1] = row
        else:
            expected.append([row, row])
    found = scores.episodes(dt * np.arange(1, len(alarm) + 1), alarm, gap * dt)
    assert [list(pair) for pair in found] == expected


def test_event_rate_is_the_rule_of_three_and_garwoods_interval():
    # 246 event-free seconds: at best under 1.4 episodes per 117 s
    assert 117 * scores.event_rate(0, 246.0).upper == pytest.approx(-np.log(0.05) * 117 / 246)
    assert round(117 * scores.event_rate(0, 246.0).upper, 1) == 1.4
    for count in (1, 4, 30):
        found = scores.event_rate(count, 10.0)
        # the bounds are where the observed count sits exactly in the tail
        assert stats.poisson.sf(count - 1, 10 * found.low) == pytest.approx(0.025)
        assert stats.poisson.cdf(count, 10 * found.high) == pytest.approx(0.025)
        assert stats.poisson.cdf(count, 10 * found.upper) == pytest.approx(0.05)
    assert np.isnan(scores.event_rate(0, 0.0).upper)


def test_margin_is_nan_where_nothing_was_tested():
    found = scores.margin([3.0, 0.0, 2.0], [2.0, np.inf, 4.0])
    np.testing.assert_array_equal(found, [1.5, np.nan, 0.5])


def test_trade_off_equals_an_enumeration_of_thresholds():
    rng = np.random.default_rng(3)
    t = np.arange(1.0, 61.0)
    statistic = rng.exponential(size=60) + np.where(t >= 40, 2.0, 0.0)
    statistic[[5, 45]] = np.nan
    curve = scores.trade_off(t, statistic, 40.0, gap=2.0)
    assert len(curve.threshold) == 58
    for threshold, delay, count in zip(*curve, strict=True):
        over = [k for k in range(60) if statistic[k] > threshold]
        after = [t[k] - 40 for k in over if t[k] >= 40]
        before = [t[k] for k in over if t[k] < 40]
        starts = [s for i, s in enumerate(before) if i == 0 or s - before[i - 1] > 2.0]
        assert delay == (min(after) if after else np.inf)
        assert count == len(starts)
    assert np.all(np.diff(curve.delay[np.isfinite(curve.delay)]) >= 0)
    chosen = scores.trade_off(t, statistic, 40.0, thresholds=[1.0, 2.0])
    assert chosen.threshold.tolist() == [1.0, 2.0]


def test_roc_area_is_the_share_of_ordered_pairs_and_its_interval_covers():
    rng = np.random.default_rng(4)
    statistic = rng.integers(0, 8, 90).astype(float)
    attacked = rng.random(90) < 0.4
    statistic[attacked] += 2
    statistic[:5] = np.nan
    found = scores.roc(statistic, attacked)
    bad = statistic[attacked & ~np.isnan(statistic)]
    good = statistic[~attacked & ~np.isnan(statistic)]
    pairs = (bad[:, None] > good) + 0.5 * (bad[:, None] == good)
    assert found.auc == pytest.approx(pairs.mean())
    assert np.trapezoid(found.true, found.false) == pytest.approx(found.auc)
    assert (found.false[0], found.true[0], found.false[-1], found.true[-1]) == (0, 0, 1, 1)
    # two unit Gaussians a distance 1 apart: Phi(1 / sqrt 2)
    truth, kinds = stats.norm.cdf(1 / np.sqrt(2)), np.arange(200) < 80
    hits = 0
    for _ in range(600):
        one = scores.roc(rng.normal(size=200) + kinds, kinds)
        hits += one.low <= truth <= one.high
    assert abs(hits / 600 - 0.95) < 0.04
    assert np.isnan(scores.roc(np.ones(3), np.zeros(3, bool)).auc)
