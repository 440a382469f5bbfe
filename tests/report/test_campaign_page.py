"""A campaign's figures show the numbers they were given, and the page has every point."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm, to_hex

from holdfast.report import campaign_figures, campaign_page
from holdfast.report.campaign_figures import COLOURS, figures
from holdfast.report.figures import NARROW, WIDE
from holdfast.report.words import NBSP

STATISTICS = ["mean", "low", "high", "q05", "q50", "q95"]
EVIL = "<script>alert('x')</script> & \"co\""
ATTRS = {"study": "spoofing", "runs": 50, "steps": 600, "seed": 7, "holdfast": "0.1.0",
         "scenario": "uav.toml", "command": "holdfast campaign study.toml"}  # fmt: skip


def campaign(axes, scores, *, roc=False, **attrs):
    """``scores``: name to means over the grid; an interval reaches a tenth either side."""
    shape = tuple(map(len, axes.values()))
    summary = np.full((*shape, len(scores), 6), np.nan)
    for i, mean in enumerate(scores.values()):
        mean = np.broadcast_to(np.asarray(mean, float), shape)
        summary[..., i, :3] = np.stack([mean, 0.9 * mean, 1.1 * mean], -1)
    data = {"summary": ((*axes, "score", "statistic"), summary)}
    coords = {name: list(values) for name, values in axes.items()}
    coords |= {"score": list(scores), "statistic": STATISTICS}
    if roc:
        coords["margin"] = [0.1, 0.5, 1.0, 2.0]
        place = np.arange(np.prod(shape, dtype=int)).reshape(shape)[..., None]
        data["false_share"] = ((*axes, "margin"), 0 * place + np.array([1.0, 0.5, 0.1, 0.0]))
        true = np.minimum(1, 0.01 * place + np.array([1.0, 0.8, 0.6, 0.0]))
        data["true_share"] = ((*axes, "margin"), true)
        data["auc"] = (tuple(axes), 0.8 + 0.001 * place[..., 0])
    found = xr.Dataset(data, coords, ATTRS | {"points": int(np.prod(shape, dtype=int))} | attrs)
    units = ["s" if name == "detection_delay" else "" for name in scores]
    return found.assign_coords(unit=("score", units))


def heads(figure):
    """Titles of the panels, on one line each."""
    found = [panel.get_title("left").replace("\n", " ") for panel in figure.axes]
    return [text.replace(NBSP, " ") for text in found if text]


def keys(figure):
    return [t.get_text().replace(NBSP, " ").replace("\n", " ") for t in figure.legends[0].texts]


def line(panel, colour):
    """The one curve of this colour."""
    (found,) = [
        one for one in panel.lines
        if one.get_linestyle() == "-" and to_hex(one.get_color()) == colour
    ]  # fmt: skip
    return found.get_xydata()


def test_curves_over_the_longest_numeric_axis_in_the_order_of_its_values():
    x, names = [2.0, 0.0, 1.0], ["ekf", "uio"]
    mean = np.array([[3.0, 30.0], [1.0, 10.0], [2.0, 20.0]])
    axes = {"attack.value": x, "estimator": names, "estimator.gamma": [0.5]}
    figure = figures(campaign(axes, {"state_rmse:north": mean[..., None]}))["state_rmse"]
    (panel,) = figure.axes
    assert panel.get_title("left") == "state RMSE, north"
    assert figure.get_supxlabel() == "attack.value"
    for i, colour in enumerate(COLOURS[:2]):
        expected = np.stack([[0.0, 1.0, 2.0], mean[[1, 2, 0], i]], 1)
        np.testing.assert_array_equal(line(panel, colour), expected)
        band = panel.collections[i].get_paths()[0].vertices
        at_two = band[band[:, 0] == 2.0, 1]
        np.testing.assert_allclose([at_two.min(), at_two.max()], mean[0, i] * np.array([0.9, 1.1]))
    assert keys(figure) == ["ekf", "uio", "95 % interval of the mean"]
    assert figure.legends[0].get_title().get_text() == "estimator"
    assert figure.get_suptitle() == ""


def test_scales_are_logarithmic_over_more_than_two_decades():
    decades = np.geomspace(0.1, 100, 4)
    wide = figures(campaign({"a": decades}, {"detection_delay": decades, "missed_share": 0.5}))
    panel, share = wide["detection"].axes
    assert (panel.get_xscale(), panel.get_yscale(), share.get_yscale()) == ("log", "log", "linear")
    near = campaign({"a": np.linspace(0, 100, 4)}, {"detection_delay": [0.0, 1.0, 10.0, 1000.0]})
    (panel,) = figures(near)["detection"].axes
    assert (panel.get_xscale(), panel.get_yscale()) == ("linear", "linear")


@pytest.mark.parametrize("known", ["mean", "median"])
def test_a_delay_without_end_is_a_ring_at_the_top(known):
    found = campaign({"attack.value": [0.0, 1.0, 2.0]}, {"detection_delay": [np.inf, 4.0, 2.0]})
    if known == "median":
        found["summary"].loc[0.0, "detection_delay"] = [np.nan] * 4 + [np.inf] * 2
    figure = figures(found)["detection"]
    (panel,) = figure.axes
    curve, ring = panel.lines
    np.testing.assert_array_equal(curve.get_ydata(), [np.nan, 4.0, 2.0])
    np.testing.assert_array_equal(ring.get_xydata(), [[0.0, campaign_figures.TOP]])
    assert ring.get_transform() == panel.get_xaxis_transform()
    assert ring.get_markerfacecolor() == "none"
    assert keys(figure)[-1] == "no alarm"
    never = figures(campaign({"a": [0, 1]}, {"detection_delay": np.inf}))["detection"]
    assert never.axes[0].lines[1].get_xydata().shape == (2, 2)
    endless = figures(campaign({"a": [0, 1]}, {"state_rmse:x": [np.inf, 1.0]}))["state_rmse"]
    assert keys(endless)[-1] == "infinite"


def test_further_axes_are_panels_and_what_is_left_out_is_said():
    axes = {"a": np.arange(12.0), "kind": list("pq"), "window": range(9), "b": [1, 2]}
    mean = np.arange(12.0 * 2 * 9 * 2).reshape(12, 2, 9, 2)
    scores = {"detected_share": mean / mean.max()} | {f"state_rmse:{i}": mean + i for i in range(4)}
    figure = campaign_figures.figures(campaign(axes, scores))["state_rmse"]
    assert len(figure.axes) == 12
    assert heads(figure)[0] == "state RMSE, 0 window = 0, b = 1"
    assert heads(figure)[5] == "state RMSE, 0 window = 8, b = 2"
    np.testing.assert_array_equal(line(figure.axes[5], COLOURS[1])[:, 1], mean[:, 1, 8, 1])
    said = figure.get_suptitle().replace("\n", " ")
    assert "6 of 18 combinations of window and b" in said
    # that change most for their size: the ones that nothing is added to
    assert "2 of 4 channels, those that change most" in said
    assert {head[12] for head in heads(figure)} == {"0", "1"}


def test_more_lines_than_colours_are_left_out_aloud():
    mean = np.arange(120.0).reshape(12, 10) / 120
    figure = figures(campaign({"a": range(12), "b": range(10)}, {"missed_share": mean}))[
        "detection"
    ]
    np.testing.assert_array_equal(line(figure.axes[0], COLOURS[2])[:, 1], mean[:, 3])
    assert "8 of 10 values of b" in figure.get_suptitle()
    assert keys(figure)[:8] == ["0", "1", "3", "4", "5", "6", "8", "9"]


def test_two_numeric_axes_give_a_map_with_its_values():
    mean = np.array([[1.0, 2.0, 300.0], [4.0, 5.0, np.inf], [7.0, np.nan, 9.0], [2.0, 2.0, 2.0]])
    axes = {"a": [3.0, 2.0, 1.0, 0.0], "b": [0.1, 0.2, 0.3]}
    drawn = figures(campaign(axes, {"detection_delay": mean}))
    assert list(drawn) == ["detection", "map_detection"]
    figure = drawn["map_detection"]
    panel, bar = figure.axes
    picture = panel.images[0]
    np.testing.assert_array_equal(
        np.ma.filled(picture.get_array().astype(float), np.nan),
        np.where(np.isinf(mean), np.nan, mean)[::-1].T,
    )
    assert isinstance(picture.norm, LogNorm)
    assert bar.get_position().width > 0
    said = {tuple(t.get_position()): t.get_text() for t in panel.texts}
    assert said[3, 2] == "300"
    assert said[1, 1] == "\N{EN DASH}"
    assert (2, 2) not in said
    assert panel.lines[0].get_xydata().tolist() == [[2, 2]]
    assert keys(figure) == ["no alarm"]
    large = figures(campaign({"a": range(11), "b": range(3)}, {"missed_share": 0.5}))
    assert not large["map_detection"].axes[0].texts
    assert "map_detection" not in figures(campaign({"a": range(5), "b": [0, 1]}, {"nees": 1.0}))


def test_categories_are_bars_of_shares_and_points_of_all_else():
    axes = {"estimator": ["ekf", "uio", "mhe"], "detector": ["chi2", "cusum"]}
    share = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    found = campaign(axes, {"detection_delay": 10 * share, "detected_share": share})
    figure = figures(found)["detection"]
    points, bars = figure.axes
    assert [t.get_text() for t in points.get_yticklabels()] == ["ekf", "uio", "mhe"]
    assert not points.patches
    np.testing.assert_array_equal(points.lines[1].get_xdata(), 10 * share[:, 1])
    np.testing.assert_allclose([bar.get_width() for bar in bars.patches], share.T.ravel())
    ends = [path.vertices[:, 0] for path in bars.collections[1].get_paths()]
    np.testing.assert_allclose(ends, share[:, 1, None] * [0.9, 1.1])
    assert keys(figure)[:2] == ["chi2", "cusum"]
    # a setting that can be infinite is one of names
    mixed = figures(campaign({"window": [1.0, np.inf]}, {"detected_share": [0.2, 0.4]}))
    assert [t.get_text() for t in mixed["detection"].axes[0].get_yticklabels()] == ["1.0", "inf"]


def test_without_axes_there_are_the_roc_curves_alone():
    assert figures(campaign({}, {"detection_delay": 1.0})) == {}
    (name, figure), *more = figures(campaign({}, {"detection_delay": 1.0}, roc=True)).items()
    assert (name, more) == ("roc", [])
    (panel,) = figure.axes
    np.testing.assert_array_equal(panel.lines[0].get_xydata(), [[0, 0], [1, 1]])
    expected = [[0.0, 0.0], [0.1, 0.6], [0.5, 0.8], [1.0, 1.0]]
    np.testing.assert_array_equal(panel.lines[1].get_xydata(), expected)
    np.testing.assert_array_equal(panel.lines[2].get_xydata(), [[0.1, 0.6]])
    assert keys(figure) == ["this campaign (AUC 0.800)", "guessing", "the calibrated threshold"]


def test_the_roc_curves_name_their_points_and_say_which_are_missing():
    found = campaign({"a": range(10), "kind": ["p"]}, {"nees": 1.0}, roc=True)
    found["true_share"][0] = np.nan
    figure = figures(found)["roc"]
    assert keys(figure)[0] == "a = 1 (AUC 0.801)"
    assert keys(figure)[7] == "a = 9 (AUC 0.809)"
    assert figure.get_suptitle().startswith("Shown: 8 of 10 points of the grid.")


@pytest.mark.parametrize("layout", [WIDE, NARROW])
def test_long_names_stay_inside_and_apart(layout):
    long = "estimator.observers_of_the_bank.number_of_the_hypotheses_that_it_weighs"
    axes = {long: range(9), f"{long}.b": ["_a$", "b$c^{" * 12], "c": [1, 2]}
    found = campaign(axes, {f"state_rmse:{long}": 1.0, "missed_share": 0.5}, roc=True)
    for figure in figures(found, layout).values():
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        legend = figure.legends[0].get_window_extent()
        whole = figure.bbox
        panels = [panel.get_tightbbox() for panel in figure.axes]
        for box in (legend, *panels):
            assert box.x0 >= whole.x0 - 1
            assert box.x1 <= whole.x1 + 1
            assert box.y0 >= whole.y0 - 1
            assert box.y1 <= whole.y1 + 1
        assert not any(legend.overlaps(box) for box in panels)
        if figure.get_suptitle():
            title = figure._suptitle.get_window_extent()
            assert title.y0 >= legend.y1
            assert title.x1 <= whole.x1
        for i, box in enumerate(panels):
            assert not any(box.overlaps(other) for other in panels[i + 1 :])


class Reader(HTMLParser):
    """Checks nesting; collects tags, links, text, and the cells of every table."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.ids, self.links, self.said = [], [], [], [], []
        self.bold, self.rows = [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.ids += [v for k, v in attrs if k == "id"]
        self.links += [v for k, v in attrs if k in ("href", "xlink:href", "src")]
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag != "meta":
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.said.append(data)
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data.replace(NBSP, " ")
        if "strong" in self.open:
            self.bold.append(data)


def test_a_page_is_complete_self_contained_and_escaped():
    axes = {EVIL: [EVIL, "b"]}
    found = campaign(
        axes, {f"state_rmse:{EVIL}": [1.0, 2.0]}, roc=True, study=EVIL, scenario=EVIL,
        command=EVIL, notes=f"first\n{EVIL}",
    )  # fmt: skip
    reader = Reader(campaign_page.page(found))
    assert "script" not in reader.tags
    assert all(link.startswith(("#", "data:")) for link in reader.links)
    assert len(reader.ids) == len(set(reader.ids))
    assert reader.tags.count("figure") == 2
    # title, heading, scenario, command, note; axis and value among the axes, both of them and a
    # score in the table of points, which has the value once more
    assert sum(EVIL in text for text in reader.said) >= 10
    assert ["Runs of each point", "50"] in reader.rows
    assert ["Points", "2"] in reader.rows
    assert "first" in reader.said
    assert "Campaign of 2 points, 50 simulated runs each." in reader.said


def test_the_table_has_every_point_and_the_best_in_bold():
    axes = {"kind": ["p", "q"], "gamma": [0.1, 0.2]}
    scores = {
        "detection_delay": [[np.inf, 4.0], [2.0, 3.0]],
        "detected_share": [[0.1, 0.2], [0.9, np.nan]],
        "false_alarm_rate": 0.01, "nees": [[1.0, 2.0], [3.0, 4.0]], "nis": np.nan,
    }  # fmt: skip
    reader = Reader(campaign_page.page(campaign(axes, scores)))
    top = reader.rows.index(
        ["Point", "kind", "gamma", "detection delay (s)", "detected share", "false alarm rate",
         "NEES"]
    )  # fmt: skip
    assert [row[:5] for row in reader.rows[top + 1 :]] == [
        ["1", "p", "0.1", "no alarm", "0.1 [0.09, 0.11]"],
        ["2", "p", "0.2", "4 [3.6, 4.4]", "0.2 [0.18, 0.22]"],
        ["3", "q", "0.1", "2 [1.8, 2.2]", "0.9 [0.81, 0.99]"],
        ["4", "q", "0.2", "3 [2.7, 3.3]", "\N{EN DASH}"],
    ]
    # neither of a score that is the same everywhere, nor where neither way is better
    assert reader.bold == ["2", "0.9"]


def test_a_long_table_is_cut_aloud(monkeypatch):
    monkeypatch.setattr(campaign_page, "_pictures", lambda _: [])
    found = campaign({"a": range(103), "b": range(5)}, {"nees": 1.0})
    text = campaign_page.page(found)
    assert "15 of 515 points are left out; result.nc has them." in text
    assert Reader(text).rows[-1][:3] == ["500", "99", "4"]
    assert re.search(r'<div class="scroll" tabindex="0"><table>', text)


def test_a_page_without_axes_or_figures():
    reader = Reader(campaign_page.page(campaign({}, {"detection_delay": 1.5})))
    assert "No setting was varied." in reader.said
    assert "figure" not in reader.tags
    assert reader.rows[-1] == ["1", "1.5 [1.35, 1.65]"]
