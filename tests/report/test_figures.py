"""What is drawn from long series, and that every figure draws."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

import demo
from holdfast.evaluate.scores import TradeOff
from holdfast.report import drawing, figures
from holdfast.report.tables import dataset


def test_extremes_keep_every_peak_and_gap_in_order():
    rng = np.random.default_rng(0)
    t, values = np.arange(100_000.0), rng.normal(size=100_000)
    values[777], values[40_000:60_000] = 50.0, np.nan
    times, found = drawing.extremes(t, values, 300)
    assert len(times) <= 600
    assert np.all(np.diff(times) >= 0)
    assert found[times == 777][0] == 50.0
    assert np.nanmin(found) == np.nanmin(values)
    assert np.all(np.isnan(found[(times > 40_400) & (times < 59_600)]))
    few = drawing.extremes(t[:500], values[:500], 300)
    np.testing.assert_array_equal(few[1], values[:500])


def test_envelope_contains_the_band():
    rng = np.random.default_rng(1)
    t, low = np.arange(10_001.0), rng.normal(size=10_001)
    times, bottom, top = drawing.envelope(t, low, low + 1, 100)
    which = np.searchsorted(times, t, side="right") - 1
    assert np.all(bottom[which] <= low)
    assert np.all(top[which] >= low + 1)
    assert bottom.min() == low.min()


def test_shares_and_spans():
    mask = np.zeros(1000, bool)
    mask[500:505] = True
    found = drawing.shares(mask, 100)
    assert found[50] == 0.5
    assert found.sum() == 0.5
    t = np.arange(1.0, 6.0)
    rows = np.array([True, False, False, True, True])
    assert drawing.spans(t, rows, 1.0) == [(0.0, 1.0), (3.0, 2.0)]
    lonely = drawing.lonely(np.array([1.0, np.nan, 1.0, 1.0, np.nan, 1.0]))
    assert lonely.tolist() == [True, False, False, False, False, True]


def test_map_names_are_places_not_speeds():
    assert drawing.map_pair(["v_north", "v_east", "pos_north", "pos_east"]) == (
        "pos_east",
        "pos_north",
    )
    assert drawing.map_pair(["north", "v_east"]) is None
    assert drawing.map_pair(["north_doppler", "gps_north", "GPS-East"]) == ("GPS-East", "gps_north")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["flight", "log"])
def test_every_figure_draws_and_is_the_same_again(kind, plant, request):
    trace = request.getfixturevalue(kind)
    data = dataset(trace, plant, demo.time_of(trace), units=demo.UNITS)
    window = (30.0, 50.0)

    curve = TradeOff(np.array([1.0, 2.0]), np.array([0.5, np.inf]), np.array([3, 0]))
    drawn = [
        figures.svg(figure)
        for figure in (
            figures.states(data, window),
            figures.attacks(data, None, figures.NARROW),
            figures.residuals(data, window),
            figures.statistic(data, window),
            figures.samples(data),
            figures.path(data, ("east", "north")),
            figures.trade_off(curve, (0, np.nan)),
        )
    ]
    assert drawn[0] == figures.svg(figures.states(data, window))
    for text in drawn:
        ElementTree.fromstring(text)
    assert "north (m)" in drawn[0]


def test_an_inline_drawing_has_its_own_ids_and_the_pages_colours(plant, flight):
    data = dataset(flight, plant, demo.time_of(flight))
    text = drawing.inline(figures.svg(figures.statistic(data, None)), "one", 'a "<b>"')
    assert text.startswith("<svg viewBox=")
    assert 'aria-label="a &quot;&lt;b&gt;&quot;"' in text
    assert set(re.findall(r'\bid="(\w+?)-', text)) == {"one"}
    ids = set(re.findall(r'\bid="([^"]*)"', text))
    assert set(re.findall(r"url\(#([^)]*)\)", text)) <= ids
    assert "var(--main)" in text
    assert drawing.MAIN not in text
    assert "http" not in text


def test_many_channels_are_cut_to_a_dozen_panels(plant, flight):
    data = dataset(flight, plant, demo.time_of(flight))
    wide = data.isel(state=[0, 1, 2, 3] * 4, state_=[0, 1, 2, 3] * 4)
    assert len(figures.states(wide, None).axes) == figures.PANELS
