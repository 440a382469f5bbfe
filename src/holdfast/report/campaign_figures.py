"""The figures of a campaign: every score over the grid of settings, and the ROC curves.

Drawn from the dataset of the campaign, so that whoever opens result.nc can draw them again.
What a figure has no room for, its title says.
"""

import textwrap
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from holdfast.report.campaign_grid import (
    LINES,
    SHARES,
    Axis,
    Plan,
    decades,
    even,
    families,
    labels,
    limits_of,
    line_axis,
    panel_values,
    plain,
    plan_of,
    short,
    study_axes,
)  # fmt: skip
from holdfast.report.drawing import ALARM, ATTACK, FAULT, INK, LOST, MAIN, MORE, SOFT
from holdfast.report.figures import STYLE, WIDE, Layout, legend
from holdfast.report.words import DASH, NBSP

COLOURS = MAIN, ALARM, MORE[0], FAULT, ATTACK, INK, LOST, "#7b61c9"
MARKERS = "osD^vPX*"
SMALL = 10
"""Cells a side of a map that has their values written in."""
TOP = 0.96
"""Where on an axis from 0 to 1 an infinite value stands."""
LETTERS, BESIDE = 13, 5
"""Letters to an inch, and as many as a legend's handle takes."""


def figures(found: xr.Dataset, layout: Layout = WIDE) -> dict[str, Figure]:
    """The figures by name: curves (or bars) and maps of each family of scores, ROC curves."""
    axes = study_axes(found)
    numeric = sorted((a for a in axes if a.numeric), key=lambda a: -len(a.values))
    drawn: dict[str, Figure] = {}
    with matplotlib.rc_context(STYLE):
        if axes:
            across = numeric[0] if numeric else max(axes, key=lambda a: len(a.values))
            plan = plan_of(axes, across, line_axis(axes, across), LINES)
            kind = _curves if numeric else _bars
            for name, scores, left_out in families(found, plan):
                drawn[name] = _series(found, plan, scores, left_out, layout, kind)
        if len(numeric) > 1 and len(numeric[1].values) > 2:
            plan = plan_of(axes, numeric[0], numeric[1], None)
            for name, scores, left_out in families(found, plan):
                drawn[f"map_{name}"] = _maps(found, plan, scores, left_out, layout)
        if "false_share" in found and "true_share" in found:
            roc = _roc(found, axes, layout)
            drawn |= {"roc": roc} if roc is not None else {}
    return drawn


def _series(found, plan, scores, left_out, layout, kind) -> Figure:
    """A panel for each score and combination; ``kind`` draws what is in it."""
    bars, names = kind is _bars, labels(found)
    count = len(scores) * len(plan.panels)
    height = 1.55 if count > 2 else 2.1
    if bars:
        height = 0.55 + len(plan.columns) * (0.1 + 0.15 * len(plan.lines))
    columns = min(count, _columns(plan, layout))
    figure, panels = _grid(count, columns, layout, height, share_y=bars)
    ends = []
    for i, score in enumerate(scores):
        values = np.stack([panel_values(found, plan, score, panel) for panel in plan.panels])
        name = str(found["score"].values[score])
        share = name.partition(":")[0].endswith(SHARES)
        log = decades(values[..., 0])
        limits = limits_of(values, log, zero=bars and share and not log)
        if np.any(np.isinf(values[..., 0])):
            ends.append(_endless(found, score))
        for j, point in enumerate(plan.panels):
            panel = panels[i * len(plan.panels) + j]
            _head(panel, names[score], plan, point, layout.width / columns)
            kind(panel, plan, values[j], (log, limits), share and not log)
    if bars:
        figure.supylabel(short(plain(plan.across.name)), fontsize=8.5, color=SOFT)
    else:
        figure.supxlabel(_wrapped(plain(plan.across.name), layout.width), fontsize=8.5, color=SOFT)
    _keys(figure, plan, ends, layout, bars=bars)
    _finish(figure, left_out, layout, -(-count // columns))
    return figure


def _curves(panel: Axes, plan: Plan, values: np.ndarray, scale, _: bool) -> None:
    """Means over a numeric axis with their 95 % bands; infinite means as rings at the top."""
    x = plan.across.values[plan.columns]
    order = np.argsort(x, kind="stable")
    log, limits = scale
    for i, line in enumerate(values[:, order]):
        mean, low, high = line.T
        colour = COLOURS[i]
        ends = np.where(np.isinf(high), limits[1], high)
        panel.fill_between(x[order], np.where(np.isinf(low), np.nan, low), ends, color=colour,
                           alpha=0.16, lw=0)  # fmt: skip
        panel.plot(x[order], np.where(np.isinf(mean), np.nan, mean), color=colour, lw=1.3,
                   marker=MARKERS[i], ms=3.2, mew=0)  # fmt: skip
        endless = np.isinf(mean)
        if np.any(endless):
            # rings within rings, where several lines end at the same value
            panel.plot(x[order][endless], np.full(endless.sum(), TOP), "o", mfc="none", mec=colour,
                       ms=4 + 2.2 * i, mew=1.1, transform=panel.get_xaxis_transform(),
                       clip_on=False)  # fmt: skip
    if decades(x):
        panel.set_xscale("log")
    elif x.dtype.kind in "iu":
        panel.xaxis.set_major_locator(MaxNLocator("auto", integer=True))
    if log:
        panel.set_yscale("log")
    else:
        panel.yaxis.set_major_locator(MaxNLocator(4))
    _bound(panel.yaxis, values, limits)


def _bars(panel: Axes, plan: Plan, values: np.ndarray, scale, share: bool) -> None:
    """A row for each name: bars of shares, points of all else, with their 95 % intervals."""
    log, limits = scale
    rows, width = np.arange(len(plan.columns)), 0.8 / len(values)
    for i, line in enumerate(values):
        mean, low, high = line.T
        y, colour = rows - 0.4 + (i + 0.5) * width, COLOURS[i]
        known = np.isfinite(mean)
        if share:
            panel.barh(y[known], mean[known], 0.86 * width, color=colour, alpha=0.55, lw=0)
        ends = np.where(np.isinf(high), limits[1], high)
        panel.hlines(y[known], low[known], ends[known], color=INK if share else colour, lw=1.2)
        if not share:
            panel.plot(mean[known], y[known], MARKERS[i], color=colour, ms=4.5, mew=0)
        endless = np.isinf(mean)
        if np.any(endless):
            panel.plot(np.full(endless.sum(), TOP), y[endless], "o", mfc="none", mec=colour, ms=5,
                       mew=1.1, transform=panel.get_yaxis_transform(), clip_on=False)  # fmt: skip
    panel.set_yticks(rows, [short(plan.across.text(i), 24) for i in plan.columns])
    panel.set_ylim(len(rows) - 0.5, -0.5)
    panel.tick_params(axis="y", length=0)
    panel.grid(visible=False, axis="y")
    if log:
        panel.set_xscale("log")
    else:
        panel.xaxis.set_major_locator(MaxNLocator(5))
    _bound(panel.xaxis, values, limits)


def _bound(axis: Any, values: np.ndarray, limits: tuple[float, float]) -> None:
    """The limits, without numbers where the panel has no finite value."""
    (axis.axes.set_ylim if axis.axis_name == "y" else axis.axes.set_xlim)(limits)
    if not np.any(np.isfinite(values[..., 0])):
        axis.set_ticklabels([]) if axis.get_scale() == "log" else axis.set_ticks([])
        if np.all(np.isnan(values[..., 0])):
            axis.axes.text(0.5, 0.5, "no value", transform=axis.axes.transAxes, ha="center",
                           va="center", color=SOFT)  # fmt: skip


def _keys(figure: Figure, plan: Plan, ends: list[str], layout: Layout, *, bars: bool) -> None:
    """What colours, bands and rings mean."""
    band = "95 % interval of the mean"
    keys: list[Any] = [
        Line2D([], [], color=COLOURS[i], marker=MARKERS[i], ms=4, mew=0, lw=0 if bars else 1.3,
               label="mean" if plan.second is None else short(plan.second.text(k)))
        for i, k in enumerate(plan.lines)
    ]  # fmt: skip
    keys.append(Line2D([], [], color=INK if bars else SOFT, lw=1.2, label=band) if bars
                else Patch(color=SOFT, alpha=0.25, label=band))  # fmt: skip
    if ends:
        keys.append(_ring(ends))
    _legend(figure, keys, layout, plan.second.name if plan.second is not None else "")


def _legend(figure: Figure, keys: list[Any], layout: Layout, title: str = "") -> None:
    """Above the panels, in as many columns as fit, each as wide as the longest in it."""
    sizes = [max(map(len, str(key.get_label()).split("\n"))) + BESIDE for key in keys]
    columns = next(
        n for n in range(len(keys), 0, -1)
        if n == 1 or sum(max(c) for c in _filled(sizes, n)) <= LETTERS * layout.width
    )  # fmt: skip
    legend(figure, keys, columns)
    if title:
        figure.legends[-1].set_title(short(plain(title), int(LETTERS * layout.width)))
        figure.legends[-1].set_alignment("left")


def _filled(sizes: list[int], columns: int) -> list[list[int]]:
    """One column after the other, the first ones longer, as a legend is filled."""
    return [part.tolist() for part in np.array_split(sizes, columns)]


def _head(panel: Axes, score: str, plan: Plan, point: dict[str, int], inches: float) -> None:
    """The score, and below it the settings of which the panel is one combination."""
    room = int(0.8 * LETTERS * inches)
    settings = ", ".join(axis.setting(point[axis.name], room) for axis in plan.others)
    lines = [textwrap.fill(text, max(12, room)) for text in (plain(score), settings) if text]
    panel.set_title("\n".join(lines))


def _wrapped(text: str, inches: float) -> str:
    return textwrap.fill(text, max(12, int(LETTERS * inches)))


def _columns(plan: Plan, layout: Layout) -> int:
    """Panels side by side: the combinations of a score in one row or two."""
    return 3 if layout.columns > 1 and len(plan.panels) in (3, 5, 6) else layout.columns


def _grid(
    count: int, columns: int, layout: Layout, height: float, *, share_y: bool = False
) -> tuple[Figure, list[Axes]]:
    rows = -(-count // columns)
    figure = Figure(figsize=(layout.width, 0.35 + height * rows), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False, sharey=share_y).ravel())
    for panel in panels[count:]:
        panel.remove()
    return figure, panels[:count]


def _finish(
    figure: Figure, left_out: list[str], layout: Layout, rows: int = 1, *, beside: bool = False
) -> None:
    """Room for the panels' titles (in so many rows) and for the legend, and above that a title
    that says what is left out.

    ``beside``: the legend stands on the right of one square panel.
    """
    said = ""
    if left_out:
        said = _wrapped(f"Shown: {'; '.join(left_out)}. All are in result.nc.", layout.width)
    # panels stay as high as they are, however long their titles
    heads = max(panel.get_title("left").count("\n") for panel in figure.axes)
    figure.set_figheight(figure.get_figheight() + 0.13 * rows * heads)
    above = 0.1 + 0.17 * (1 + said.count("\n")) if said else 0.0
    wide, high = 0.0, 0.0
    for found in figure.legends:
        box = found.get_window_extent(FigureCanvasAgg(figure).get_renderer())
        wide, high = box.width / figure.dpi + 0.1, box.height / figure.dpi + 0.1
    if beside:
        height = above + max(figure.get_figheight(), high)
        across = min(1 - wide / layout.width, 1.1 * figure.get_figheight() / layout.width)
        inside = (0, 0, across, 1 - above / height)
        free = (0, 0, across + wide / layout.width, inside[3])
    else:
        height = above + high + figure.get_figheight()
        inside, free = (0, 0, 1, 1 - (above + high) / height), (0, 0, 1, 1 - above / height)
    figure.set_figheight(height)
    # matplotlib gives legend and title the same place, so it is parted here
    figure.set_layout_engine("constrained", rect=inside)
    for found in figure.legends:
        found.set_bbox_to_anchor(free, figure.transFigure)
    if said:
        figure.suptitle(said, x=0.01, y=1 - 0.05 / height, ha="left", va="top", fontsize=8.5,
                        color=SOFT)  # fmt: skip


def _maps(found, plan: Plan, scores, left_out, layout: Layout) -> Figure:
    """The mean of each score over two numeric axes, with its value where there is room."""
    rows, columns = len(plan.lines), len(plan.columns)
    count, names = len(scores) * len(plan.panels), labels(found)
    beside = 1 if rows <= SMALL and 6 < columns <= SMALL else min(count, _columns(plan, layout))
    figure, panels = _grid(count, beside, layout, 0.6 + min(3.0, max(1.2, 0.24 * rows)))
    inches = layout.width / beside
    ends = []
    for i, score in enumerate(scores):
        values = np.stack(
            [panel_values(found, plan, score, panel)[..., 0] for panel in plan.panels]
        )
        known = values[np.isfinite(values)]
        if np.any(np.isinf(values)):
            ends.append(_endless(found, score))
        low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
        norm = LogNorm(low, high) if decades(values) else Normalize(low, high)
        longest = max(len(_brief(value)) for value in values.ravel())
        size = min(7.0, 72 * (inches - 1.1) / columns / (0.64 * longest))
        for j, point in enumerate(plan.panels):
            panel = panels[i * len(plan.panels) + j]
            _head(panel, names[score], plan, point, inches)
            _map(panel, plan, values[j], norm, inches - 1.1, size)
    figure.supxlabel(_wrapped(plain(plan.across.name), layout.width), fontsize=8.5, color=SOFT)
    if plan.second is not None:
        figure.supylabel(short(plain(plan.second.name)), fontsize=8.5, color=SOFT)
    if ends:
        _legend(figure, [_ring(ends)], layout)
    _finish(figure, left_out, layout, -(-count // beside))
    return figure


def _map(panel: Axes, plan: Plan, values, norm: Normalize, inches: float, size: float) -> None:
    """A map about so many inches wide, of cells of equal size; rings where it is infinite.

    ``size``: of the letters in the cells.
    """
    assert plan.second is not None
    rows, columns = np.argsort(plan.second.values), np.argsort(plan.across.values)
    values = values[rows][:, columns]
    picture = panel.imshow(values, norm=norm, cmap="viridis", origin="lower", aspect="auto",
                           interpolation="nearest")  # fmt: skip
    panel.grid(visible=False)
    for axis, way, order in ((panel.xaxis, plan.across, columns), (panel.yaxis, plan.second, rows)):
        names = [f"{value:.3g}" for value in way.values[order]]
        most = LETTERS * inches / (max(map(len, names)) + 2) if axis is panel.xaxis else SMALL
        at = np.arange(0, len(names), -(-len(names) // max(2, int(most))))
        axis.set_ticks(at, [names[k] for k in at])
    y, x = np.nonzero(np.isinf(values))
    panel.plot(x, y, "o", mfc="none", mec=SOFT, ms=5, mew=1.1, ls="")
    if max(values.shape) <= SMALL:
        for k, m in zip(*np.nonzero(~np.isinf(values)), strict=True):
            # white and black stay as they are on a dark page, as the map does
            known = np.isfinite(values[k, m])
            colour = ("white" if norm(values[k, m]) < 0.6 else "black") if known else SOFT
            panel.text(m, k, _brief(float(values[k, m])), ha="center", va="center", size=size,
                       color=colour)  # fmt: skip
    if np.any(np.isfinite(values)):
        bar = panel.figure.colorbar(picture, ax=panel, pad=0.02, aspect=14)
        bar.outline.set_visible(False)


def _brief(value: float) -> str:
    if not np.isfinite(value):
        return DASH
    mantissa, _, exponent = f"{float(f'{value:.2g}'):g}".partition("e")
    return f"{mantissa}e{int(exponent)}" if exponent else mantissa


def _endless(found: xr.Dataset, score: int) -> str:
    """What an infinite value of this score means."""
    return "no alarm" if str(found["score"].values[score]) == "detection_delay" else "infinite"


def _ring(ends: list[str]) -> Line2D:
    said = " / ".join(dict.fromkeys(ends))
    return Line2D([], [], ls="", marker="o", mfc="none", mec=SOFT, ms=5, label=said)


def _roc(found: xr.Dataset, axes: Sequence[Axis], layout: Layout) -> Figure | None:
    """The true share against the false share as the threshold falls, a line for each point."""
    names = [d for d in found["false_share"].dims if d != "margin"]
    margin = found["margin"].values
    false, true = (
        found[kind].transpose(*names, "margin").values.reshape(-1, len(margin))
        for kind in ("false_share", "true_share")
    )
    known = np.flatnonzero(np.any(np.isfinite(false) & np.isfinite(true), 1))
    if not known.size:
        return None
    kept = known[even(len(known), len(COLOURS))]
    beside = layout.columns > 1
    figure, (panel,) = _grid(1, 1, layout, 3.4 if beside else 0.88 * layout.width)
    panel.plot([0, 1], [0, 1], color=INK, lw=0.8, ls=(0, (4, 3)))
    keys: list[Any] = []
    for colour, point in zip(COLOURS, kept, strict=False):
        order = np.lexsort((true[point], false[point]))
        panel.plot(false[point][order], true[point][order], color=colour, lw=1.4)
        at = np.flatnonzero(np.isclose(margin, 1))
        panel.plot(false[point][at], true[point][at], "o", color=colour, ms=4.5, mew=0)
        said = _point(found, names, axes, int(point), layout.width - (5.0 if beside else 1.0))
        keys.append(Line2D([], [], color=colour, lw=1.4, label=said))
    keys.append(Line2D([], [], color=INK, lw=0.8, ls=(0, (4, 3)), label="guessing"))
    if np.any(np.isclose(margin, 1)):
        keys.append(Line2D([], [], ls="", marker="o", mew=0, color=SOFT, ms=4.5,
                           label="the calibrated threshold"))  # fmt: skip
    panel.set(xlim=(-0.01, 1.01), ylim=(-0.01, 1.01), xlabel="false share", ylabel="true share")
    if beside:
        figure.legend(handles=keys, loc="outside right upper", handlelength=1.6)
    else:
        legend(figure, keys, 1)
    less = f"{len(kept)} of {len(false)} points of the grid"
    _finish(figure, [less] if len(kept) < len(false) else [], layout, beside=beside)
    return figure


def _point(found: xr.Dataset, names: Sequence[Any], axes, point: int, inches: float) -> str:
    """A point of the grid by its settings, with the area below its curve."""
    place = np.unravel_index(point, [found.sizes[name] for name in names]) if names else ()
    index = dict(zip(names, place, strict=True))
    room = int(LETTERS * inches)
    said = ", ".join(axis.setting(int(index[axis.name]), room) for axis in axes)
    auc = found["auc"].transpose(*names).values.reshape(-1)[point] if "auc" in found else np.nan
    area = f" (AUC{NBSP}{auc:.3f})" if np.isfinite(auc) else ""
    return textwrap.fill((said or "this campaign") + area, room)
