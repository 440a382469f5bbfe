"""The page and the figures of the arena show the cases that they were given."""

import itertools

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex

from holdfast.report.arena_figures import figures
from holdfast.report.arena_page import page
from holdfast.report.drawing import ALARM
from holdfast.report.figures import NARROW, WIDE
from holdfast.report.words import DASH, NBSP
from test_arena_tables import DETECTED, FOUGHT, INF, NAN, case, frame
from test_campaign_page import EVIL, Reader


def crowd(estimators, ground="car"):
    """So many estimators under as many attacks, the errors far apart."""
    return frame(*(
        case(f"attack, number {i}", f"the estimator {k}", 10.0 ** (i + k - 3), ground=ground)
        for i, k in itertools.product(range(estimators), repeat=2)
    ))  # fmt: skip


def said(panel):
    return {tuple(t.get_position()): t.get_text() for t in panel.texts}


@pytest.mark.parametrize("layout", [WIDE, NARROW])
@pytest.mark.parametrize("cases", [crowd(1), crowd(10), FOUGHT, DETECTED], ids=len)
def test_nothing_overlaps_or_leaves_the_figure(cases, layout):
    (figure,) = figures(cases, layout).values()
    FigureCanvasAgg(figure).draw()
    panels = [panel.get_tightbbox() for panel in figure.axes]
    legends = [legend.get_window_extent() for legend in figure.legends]
    for box in (*panels, *legends):
        assert box.x0 >= figure.bbox.x0 - 1
        assert box.x1 <= figure.bbox.x1 + 1
        assert box.y0 >= figure.bbox.y0 - 1
        assert box.y1 <= figure.bbox.y1 + 1
    for one, other in itertools.combinations([*panels, *legends], 2):
        assert not one.overlaps(other)
    for panel in figure.axes[:-1]:
        ticks = [label.get_window_extent() for label in panel.get_xticklabels()]
        assert not any(a.overlaps(b) for a, b in itertools.pairwise(ticks))
        wide = panel.get_window_extent().width / len(ticks)
        assert all(text.get_window_extent().width <= wide for text in panel.texts)


def test_the_map_of_errors():
    figure = figures(FOUGHT)["car_estimators"]
    panel, _ = figure.axes
    values = np.ma.filled(panel.images[0].get_array().astype(float), NAN)
    expected = [[1, 1.15, 2], [1000, 1.2, 3.2], [1000, NAN, 1000], [2, 2.5, 2.45]]
    np.testing.assert_allclose(values, expected)
    texts = said(panel)
    assert (texts[0, 1], texts[0, 2], texts[1, 2]) == ("3500", "\N{INFINITY}", DASH)
    dots = {(round(float(x)), round(float(y))) for x, y in (d.get_xydata()[0] for d in panel.lines)}
    assert dots == {(0, 0), (1, 0), (2, 0), (2, 1), (2, 2)}
    frames = [p for p in panel.patches if to_hex(p.get_edgecolor()) == ALARM]
    assert [(round(p.get_x() + 0.44), round(p.get_y() + 0.42)) for p in frames] == [(1, 1)]
    keys = [text.get_text() for text in figure.legends[0].texts]
    assert keys == ["promised beforehand, and kept", "promise broken"]
    assert not figures(crowd(2))["car_estimators"].legends


def test_the_map_of_alarms_has_a_panel_for_each_estimator():
    figure = figures(DETECTED)["car_detectors"]
    kalman, nise, _ = figure.axes
    assert [panel.get_title("left") for panel in (kalman, nise)] == ["Kalman", "NISE"]
    np.testing.assert_allclose(kalman.images[0].get_array(), [[50, 90], [50, 60], [1, 1]])
    assert [t.get_text() for t in kalman.get_xticklabels()] == ["chi", "CUSUM"]
    assert said(nise)[0, 0] == "<1"


def test_other_studies_and_plants_without_any_value():
    found = FOUGHT.assign(study="mismatch", truth="tau = 2")
    assert figures(found) == {}
    nothing = frame(case("none", "Kalman", NAN), case("bias", "Kalman", INF))
    assert list(figures(nothing)) == ["car_estimators"]
    assert "figure" not in Reader(page(found)).tags
    assert [f"{NBSP}".join(row) for row in Reader(page(nothing)).rows][-1] == f"bias{NBSP}\u221e"


def test_a_page_has_every_table():
    mismatch = FOUGHT.assign(study="mismatch", truth="tau = 2")
    other = crowd(2, "boat")
    reader = Reader(page(pd.concat([FOUGHT, DETECTED, mismatch, other], ignore_index=True)))
    assert f"{len(FOUGHT) * 2 + len(DETECTED) + 4} cases on 2 plants." in reader.said
    assert reader.tags.count("figure") == 3
    assert ["bias", "3500", "1.2 \N{BALLOT X}", "3.2 \N{CHECK MARK}", "no"] in reader.rows
    assert ["covert", "\N{INFINITY}", DASH, "1.2e5 \N{CHECK MARK}", "yes"] in reader.rows
    assert ["bias", "50", "90", "<1", "0"] in reader.rows
    assert ["tau = 2", "false alarms, %", "2.0", "1.0", "1.0"] in reader.rows
    assert ["car, estimators", "drift", "Kalman 2.00", "decoder 2.45"] in reader.rows
    assert {"1.0", "1.1", "1.2", "90"} <= set(reader.bold)
    assert "2.5" not in reader.bold
    assert "holdfast arena car boat -o out" in reader.said
    assert {"#summary", "#reading", "#plant-1", "#plant-2", "#losses", "#command"} <= set(
        reader.links
    )


def test_a_page_is_self_contained_and_escaped():
    evil = frame(
        case("none", EVIL, 1.0, ground=EVIL), case(EVIL, EVIL, 2.0, ground=EVIL),
        case(EVIL, "$x_", 2.0, ground=EVIL),
        case(EVIL, EVIL, 2.0, ground=EVIL, study=EVIL, truth=EVIL, detector=EVIL),
    )  # fmt: skip
    reader = Reader(page(evil))
    assert "script" not in reader.tags
    assert all(link.startswith(("#", "data:")) for link in reader.links)
    assert len(reader.ids) == len(set(reader.ids))
    assert sum(EVIL in text for text in reader.said) >= 8
