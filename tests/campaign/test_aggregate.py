"""Means, intervals and quantiles over runs, against plain formulas and what they promise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from holdfast.campaign.aggregate import STATISTICS, aggregated, curve, mean, ratio
from holdfast.campaign.run_scores import BINS
from holdfast.evaluate.scores import roc, share


def test_a_mean_and_its_quantiles():
    values = np.array([3.0, 1.0, np.nan, 2.0, 6.0])
    got = dict(zip(STATISTICS, mean(values), strict=True))
    half = 1.959963984540054 * stats.sem([3, 1, 2, 6])
    assert got["mean"] == pytest.approx(3.0)
    assert (got["low"], got["high"]) == pytest.approx((3 - half, 3 + half))
    assert (got["q05"], got["q50"], got["q95"]) == (1.0, 2.0, 6.0)
    assert np.all(np.isnan(mean(np.array([np.nan]))))
    assert mean(np.array([2.0]))[:3] == pytest.approx([2.0, np.nan, np.nan], nan_ok=True)


def test_a_ratio_of_sums_and_not_a_mean_of_ratios():
    above, below = np.array([1.0, 9.0]), np.array([10.0, 10.0 * 9])
    got = ratio(above, below, bounded=True)
    assert got[0] == pytest.approx(0.1)
    assert got[3:].tolist() == [0.1, 0.1, 0.1]


@pytest.mark.parametrize(("above", "below"), [([0, 0], [10, 30]), ([10, 30], [10, 30]), ([3], [9])])
def test_without_spread_the_interval_is_wilsons(above, below):
    above, below = np.array(above, float), np.array(below, float)
    got, wanted = ratio(above, below, bounded=True), share(int(above.sum()), int(below.sum()))
    assert got[:3] == pytest.approx([wanted.value, wanted.low, wanted.high])


def test_intervals_hold_the_truth_as_often_as_they_say():
    """Alarms that come in bursts within a run: rows are not independent, runs are.

    400 intervals of 95 %: at least 91 % hold it (three standard errors, and one for 60 runs).
    """
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(400):
        rate = rng.beta(2.0, 38.0, 60)  # mean 0.05
        got = ratio(rng.binomial(50, rate).astype(float), np.full(60, 50.0), bounded=True)
        held += got[1] <= 0.05 <= got[2]
    assert held >= 364


def test_a_delay_without_alarm_is_infinite_in_quantiles_and_left_out_of_the_mean():
    scores = {"detection_delay": np.array([1.0, np.inf, np.nan, 3.0]), "rows": np.full(4, 5.0)}
    scores |= dict.fromkeys(
        ("false_alarms", "benign_rows", "missed", "attacked_rows", "nees", "nees_degrees", "nis",
         "nis_degrees", "unobservable", "not_converged", "diverged"), np.zeros(4),
    )  # fmt: skip
    got = aggregated(scores, {"state": (), "attack": ()})
    assert got["detection_delay"][0] == 2.0
    assert got["detection_delay"][3:].tolist() == [1.0, 3.0, np.inf]
    assert got["detected_share"][0] == pytest.approx(2 / 3)
    assert np.isnan(got["missed_share"][0])


@given(
    st.lists(st.integers(0, 9), min_size=BINS, max_size=BINS),
    st.lists(st.integers(0, 9), min_size=BINS, max_size=BINS),
)
@settings(max_examples=20, deadline=None)
def test_the_curve_is_that_of_the_binned_rows(benign, attacked):
    benign, attacked = np.array(benign), np.array(attacked)
    got = curve(benign[None], attacked[None])
    bins = np.arange(BINS)
    statistic = np.concatenate([np.repeat(bins, benign), np.repeat(bins, attacked)])
    kind = np.repeat([False, True], [benign.sum(), attacked.sum()])
    wanted = roc(statistic, kind)
    assert got.auc[0] == pytest.approx(wanted.auc, nan_ok=True)
    if benign.sum():
        np.testing.assert_allclose(got.false[0], 1.0)
        np.testing.assert_allclose(got.false[150], np.mean(statistic[~kind] >= 150))
    assert np.isnan(got.auc[1])


def test_the_jackknife_of_the_area():
    """Over blocks alike it is that of a mean: between DeLong's and nothing."""
    rng = np.random.default_rng(1)
    benign = rng.multinomial(2000, np.full(BINS, 1 / BINS), 30)
    shift = np.roll(np.full(BINS, 1 / BINS), 0)
    shift[: BINS // 2] /= 2
    attacked = rng.multinomial(2000, shift / shift.sum(), 30)
    value, low, high = curve(benign, attacked).auc
    each = [curve(benign[i : i + 1], attacked[i : i + 1]).auc[0] for i in range(30)]
    half = 1.96 * np.std(each, ddof=1) / np.sqrt(30)
    assert (high - low) / 2 == pytest.approx(half, rel=0.02)
    assert low < np.mean(each) < high
    assert value == pytest.approx(np.mean(each), abs=half)
