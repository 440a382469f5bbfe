import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ndtr, ndtri
from scipy.stats import chi2, ncx2

from holdfast.attacks import bias
from holdfast.campaign.roc import RATES, Margins, Signal, compare, curves
from holdfast.detectors import chi_square, likelihood_ratio
from holdfast.estimators import unknown_input
from holdfast.evaluate import scores
from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.records import Knowledge
from holdfast.report.roc_figure import roc_panels, roc_png, roc_table

KEY = jax.random.key(0)


def correlated(rng, shift, runs=200, rows=100, common=0.5):
    """N(0, 1) and N(shift, 1) rows; each run shares a part of variance ``common``."""
    own = np.sqrt(common) * rng.normal(size=(runs, 1))
    rest = np.sqrt(1 - common)
    quiet, attacked = (own + rest * rng.normal(size=(runs, rows)) for _ in range(2))
    return Margins(quiet, attacked + shift)


def exact(shift, rate):
    return ndtr(shift + ndtri(rate))


def test_curve_and_area_are_those_of_the_pooled_rows():
    """Against the sorted rows themselves, and the area of `scores.roc`."""
    rng = np.random.default_rng(1)
    pair = correlated(rng, 1.0)
    attacked = pair.attacked.copy()
    attacked[:50, ::3] = np.nan  # rows that were not tested do not count
    found = curves({"one": Margins(pair.quiet, attacked)}, KEY)
    left = attacked[~np.isnan(attacked)]
    highest = np.sort(pair.quiet.ravel())[::-1]
    for rate in (0.01, 0.05, 0.5):
        # as many false alarms as the rate says, one more or one less
        alarms = round(rate * highest.size)
        fewer, more = (np.mean(left >= highest[alarms - 1 + i]) for i in (-1, 1))
        assert fewer <= found.detection["one"].at(rate)[0] <= more
    both = np.concatenate([left, pair.quiet.ravel()])
    truth = scores.roc(both, np.arange(both.size) < left.size).auc
    # trapezoids on 380 knots of a concave curve
    assert found.area["one"].value == pytest.approx(truth, abs=1e-4)


def test_intervals_hold_what_they_say_for_rows_that_are_correlated():
    """95 % of them contain the closed form."""
    rng = np.random.default_rng(2)
    rate, hits, of, widths, naive = 0.05, np.zeros(4), 40, [], []
    for i in range(of):
        weak, strong = correlated(rng, 1.0, runs=100), correlated(rng, 1.5, runs=100)
        pairs = {"weak": weak, "strong": strong}
        found = curves(pairs, jax.random.key(i))
        gain = exact(1.5, rate) - exact(1.0, rate)
        for j, (one, truth) in enumerate(
            (
                (found.detection["weak"].at(rate), exact(1.0, rate)),
                (found.gain["strong"].at(rate), gain),
                (found.area["weak"], ndtr(1.0 / np.sqrt(2))),
                (found.area_gain["strong"], ndtr(1.5 / np.sqrt(2)) - ndtr(1.0 / np.sqrt(2))),
            )
        ):
            hits[j] += one[1] <= truth <= one[2]
        _, low, high = found.detection["weak"].at(rate)
        widths.append(high - low)
        share = exact(1.0, rate)
        naive.append(2 * 1.96 * np.sqrt(share * (1 - share) / weak.attacked.size))
    # binomial(40, 0.95) is under 32 with probability 3e-4
    assert np.all(hits >= 32), hits
    # and these intervals are far wider than those of independent rows
    assert np.mean(widths) > 2 * np.mean(naive)


def test_differences_are_of_the_same_runs():
    """The same statistic, in other units or a monotone one: no gain, and no doubt about it."""
    pair = correlated(np.random.default_rng(3), 1.0)
    found = curves({"one": pair, "cubed": Margins(pair.quiet**3, pair.attacked**3)}, KEY)
    gain = found.gain["cubed"]
    # thresholds between neighbouring rows are interpolated on the statistic's own scale
    assert np.max(np.abs(gain.value)) < 1e-3
    assert np.max(np.abs(np.stack([gain.low, gain.high]))) < 2e-3
    twice = curves({"one": pair, "again": pair}, KEY)
    assert not np.any(np.stack(twice.gain["again"]))
    assert twice.verdict("again", 0.05) == "no difference seen"
    assert curves({"one": pair, "up": correlated(np.random.default_rng(3), 2.0)}, KEY).verdict(
        "up", 0.05
    ) == ("better")
    assert curves({"up": correlated(np.random.default_rng(3), 2.0), "one": pair}, KEY).verdict(
        "one", 0.05
    ) == ("worse")


def test_tied_values_are_broken_by_lot():
    """Eight in ten attack-free rows are 0, up to rounding: beyond a rate of 0.2 lots decide."""
    rng = np.random.default_rng(4)
    noise = 1e-13 * rng.normal(size=(2, 100, 200))
    quiet = np.where(rng.random((100, 200)) < 0.8, noise[0], 1.0)
    attacked = np.where(rng.random((100, 200)) < 0.4, noise[1] + 1e-12, 1.0)
    found = curves({"one": Margins(quiet, attacked)}, KEY).detection["one"]
    above = np.mean(quiet == 1.0), np.mean(attacked == 1.0)
    for rate in (0.3, 0.5):
        lots = (rate - above[0]) / (1 - above[0])
        # the curve is a straight line there: rounding alone
        assert found.at(rate)[0] == pytest.approx(above[1] + lots * (1 - above[1]), abs=1e-3)


def watched(low, high):
    """A state that is nearly zero: the attack's estimate is the sensor, of deviation 1."""
    plant = linear_plant(
        A=[[1e-3]], C=[[1.0]], H=[[1.0]], Q=[[1e-12]], R=[[1.0]], attacks=["push"],
        constraints={"attack": {"matrix": [[1.0], [-1.0]], "bound": [high, -low]}},
    )  # fmt: skip
    tests = {"chi-square": chi_square, "ratio": likelihood_ratio}
    detectors = {name: module.build(plant, on="attack") for name, module in tests.items()}
    return unknown_input.build(plant, np.zeros(1), 1e-12 * np.eye(1)), detectors


@pytest.mark.parametrize(("low", "same"), [(0.0, False), (-20.0, True)])
def test_one_channel_is_the_closed_form(low, same):
    """Two-sided against one-sided Gaussian test for d >= 0; no difference within wide limits."""
    estimator, detectors = watched(low, 20.0)
    attack = bias.build(estimator.plant, channel="channel:push", value=2.0)
    found = compare(estimator, detectors, (attack,), first=2, steps=101, runs=250)
    for rate in (0.01, 0.05, 0.2):
        two_sided = ncx2.sf(chi2.isf(rate, 1), 1, 4.0)
        truth = two_sided if same else exact(2.0, rate)
        # 25 000 rows: the threshold is known to sqrt(rate / 25000) in rate, 6 % at 0.01, at a
        # slope of 8 there: sd 0.006; 4 sd
        assert found.detection["chi-square"].at(rate)[0] == pytest.approx(two_sided, abs=0.024)
        assert found.detection["ratio"].at(rate)[0] == pytest.approx(truth, abs=0.024)
        expected = "no difference seen" if same else "better"
        assert found.verdict("ratio", rate) == expected


def test_rows_before_the_first_do_not_count():
    """An attack that ends before them is not there."""
    estimator, detectors = watched(-20.0, 20.0)
    attack = bias.build(estimator.plant, channel="channel:push", value=9.0, stop=50.0)
    found = compare(estimator, detectors, (attack,), first=52, steps=101, runs=250)
    # the two simulations have the same noise: the very same rows
    np.testing.assert_allclose(found.detection["ratio"].value, RATES, rtol=0.05)
    assert found.area["ratio"].value == pytest.approx(0.5, abs=1e-12)


def test_a_signal_is_injected_as_it_stands():
    signal = Signal(jnp.arange(6.0).reshape(3, 2))
    for k, truth in ((0, [0, 1]), (2, [4, 5]), (7, [4, 5])):
        known = Knowledge(jnp.asarray(k, jnp.int32), jnp.zeros(1), jnp.zeros(3))
        _, injection = signal.step((), known)
        np.testing.assert_array_equal(injection.d, truth)
        assert not np.any(injection.u)
        assert not np.any(injection.y)


@pytest.mark.parametrize(
    ("key", "settings"),
    [
        ("runs", {"runs": 19}),
        ("runs, steps", {"runs": 100, "steps": 100}),
        ("first", {"first": 0}),
        ("first", {"first": 601}),
    ],
)
def test_what_cannot_be_compared_is_refused(key, settings):
    estimator, detectors = watched(0.0, 20.0)
    with pytest.raises(InvalidValue) as error:
        compare(estimator, detectors, (), **{"first": 2, "steps": 600} | settings)
    assert error.value.key == key
    few = Margins(np.zeros((50, 100)), np.ones((50, 100)))
    with pytest.raises(InvalidValue):
        curves({"one": few}, KEY)


def test_table_and_figure_show_the_curves():
    weak, strong = (correlated(np.random.default_rng(5), shift) for shift in (1.0, 2.0))
    found = curves({"first": weak, "second": strong}, KEY)
    head, _, row = roc_table({"case": found}, (0.05,)).splitlines()
    assert head == "|  | first at 0.05 | second at 0.05 | gain of second | verdict |"
    values = (found.detection[name].at(0.05)[0] for name in ("first", "second"))
    gain, low, high = found.gain["second"].at(0.05)
    cells = [f"{value:.3f}" for value in values]
    cells += [f"{gain:+.4f} [{low:+.4f}, {high:+.4f}]", "better"]
    assert row == f"| case | {' | '.join(cells)} |"
    figure = roc_panels({"case": found, "again": found})
    panels = [panel for panel in figure.axes if panel.get_visible()]
    assert [panel.get_title(loc="left") for panel in panels] == ["case", "again"]
    drawn = {line.get_label(): line.get_ydata() for line in panels[0].lines}
    for name in ("first", "second"):
        np.testing.assert_array_equal(drawn[name], found.detection[name].value)
    assert roc_png({"case": found}).startswith(b"\x89PNG")
