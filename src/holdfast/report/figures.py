"""The figures of a report, drawn from the dataset of `holdfast.report.results`.

Every function takes the dataset of one run (so that whoever opens result.nc can draw it
again) and returns a matplotlib figure; `svg` writes it. Nothing here touches pyplot.
"""

import io
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from holdfast.evaluate.scores import TradeOff
from holdfast.report.drawing import (
    ALARM,
    ATTACK,
    FAULT,
    GRID,
    INK,
    LOST,
    MAIN,
    PAPER,
    SOFT,
    envelope,
    extremes,
    lighter,
    lonely,
    map_pair,
    shares,
    spans,
    spread,
)
from holdfast.report.results import FAULTY

PANELS = 12
"""Small multiples drawn at most; a page says how many were left out."""

Window = tuple[float, float] | None

STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "holdfast",
    "path.simplify": False,
    "font.family": "sans-serif",
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": SOFT,
    "axes.labelcolor": SOFT,
    "axes.facecolor": "none",
    "axes.titlecolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "text.color": INK,
    "figure.facecolor": PAPER,
    "lines.solid_capstyle": "round",
    "axes.formatter.useoffset": False,
}


class Layout(NamedTuple):
    """How wide, how many panels side by side, how many bins a panel is worth."""

    width: float
    columns: int
    bins: int


WIDE = Layout(8.4, 2, 260)
NARROW = Layout(3.9, 1, 180)


def svg(figure: Figure) -> str:
    """The figure as SVG text, the same for the same data."""
    target = io.StringIO()
    with matplotlib.rc_context(STYLE):
        FigureCanvasSVG(figure).print_svg(target, metadata={"Date": None, "Creator": None})
    return lighter(target.getvalue())


def states(data: xr.Dataset, window: Window, layout: Layout = WIDE) -> Figure:
    """Each state with its 2-sigma band, and the truth where it is known."""
    truth = data.true_x.values if "true_x" in data else None
    return _bands(data, "x", truth, window, layout)


def attacks(data: xr.Dataset, window: Window, layout: Layout = WIDE) -> Figure:
    """Each attack estimate with its 2-sigma band; gaps where the data do not determine it."""
    truth = data.true_d.values if "true_d" in data else None
    return _bands(data, "d", truth, window, layout, zero=True)


def sensor_attacks(data: xr.Dataset, window: Window, layout: Layout = WIDE) -> Figure:
    """What each sensor is believed to be off by, and the injection where it is known."""
    t, value = data.time.values, data.sensor_attack.values
    truth = data.injected_y.values if "injected_y" in data else None
    with matplotlib.rc_context(STYLE):
        figure, panels = _panels(_names(data, "output"), layout)
        for i, panel in enumerate(panels):
            _shade(panel, t, window)
            _line(panel, t, value[:, i], layout.bins, color=MAIN, lw=1.1)
            if truth is not None:
                panel.plot(*extremes(t, truth[:, i], layout.bins), color=INK, lw=0.9,
                           ls=(0, (4, 3)))  # fmt: skip
        _legend(figure, [
            Line2D([], [], color=MAIN, lw=1.2, label="estimate"),
            *([Line2D([], [], color=INK, lw=0.9, ls=(0, (4, 3)), label="truth")]
              if truth is not None else []),
            *_window_key(window),
        ], layout)  # fmt: skip
    return figure


def residuals(data: xr.Dataset, window: Window, layout: Layout = WIDE) -> Figure:
    """Each residual over its standard deviation, with the lines at +-2."""
    variance = np.diagonal(data.residual_cov.values, axis1=-2, axis2=-1)
    known = np.isfinite(variance) & (variance > 0)
    scaled = np.where(known, data.residual.values / np.sqrt(np.where(known, variance, 1)), np.nan)
    t = data.time.values
    with matplotlib.rc_context(STYLE):
        figure, panels = _panels(_names(data, "output", unit=False), layout)
        for i, panel in enumerate(panels):
            _shade(panel, t, window)
            for level in (-2, 2):
                panel.axhline(level, color=INK, lw=0.8, ls=(0, (4, 3)))
            _dots(panel, *extremes(t, scaled[:, i], layout.bins), MAIN, 1.7)
            largest = np.nanmax(np.abs(scaled[:, i]), initial=0.0)
            panel.set_ylim(-max(3.5, 1.1 * largest), max(3.5, 1.1 * largest))
        _legend(figure, [
            Line2D([], [], color=MAIN, marker="o", ms=2.5, ls="", label="residual / its sd"),
            Line2D([], [], color=INK, lw=0.8, ls=(0, (4, 3)), label="±2 sd"),
            *_window_key(window),
        ], layout)  # fmt: skip
    return figure


def statistic(data: xr.Dataset, window: Window, layout: Layout = WIDE) -> Figure:
    """The detector's statistic against its threshold, alarms marked."""
    t, bins = data.time.values, layout.bins * layout.columns
    value, alarm = data.statistic.values, data.alarm.values
    threshold = np.where(np.isfinite(data.threshold.values), data.threshold.values, np.nan)
    with matplotlib.rc_context(STYLE):
        figure, panel = _one_panel(layout, 2.6)
        _shade(panel, t, window)
        _line(panel, t, value, bins, color=MAIN, lw=0.9)
        _line(panel, t, threshold, bins, held=True, color=INK, lw=1.1, ls=(0, (4, 3)))
        _dots(panel, *extremes(t, np.where(alarm, value, np.nan), bins), ALARM, 2.6)
        _log_if_wide(panel, value, threshold)
        panel.set_ylabel("statistic")
        dt = float(data.attrs["dt"])
        rug = spread(t, alarm, bins)
        panel.broken_barh(spans(t, rug, dt), (1.0, 0.035), transform=panel.get_xaxis_transform(),
                          color=ALARM, lw=0.6, clip_on=False)  # fmt: skip
        _legend(figure, [
            Line2D([], [], color=MAIN, lw=1.2, label="statistic"),
            Line2D([], [], color=INK, lw=1.1, ls=(0, (4, 3)), label="threshold"),
            Line2D([], [], color=ALARM, marker="o", ms=3, ls="", label="alarm"),
            *_window_key(window),
        ], layout)  # fmt: skip
    return figure


def samples(data: xr.Dataset, layout: Layout = WIDE) -> Figure:
    """A strip per output: where samples are missing, and where they were faulty."""
    names, t, bins = _names(data, "output", unit=False)[:PANELS], data.time.values, layout.bins
    kinds = data["sample"].values
    lost = np.stack([shares(kinds[:, i] != 0, bins) for i in range(len(names))])
    bad = np.stack([shares(kinds[:, i] >= FAULTY, bins) > 0 for i in range(len(names))])
    colour = np.array(to_rgb(LOST)), np.array(to_rgb(FAULT))
    picture = np.zeros((*lost.shape, 4))
    picture[..., :3] = np.where(bad[..., None], colour[1], colour[0])
    # a trace of what is rare must show: one lost sample in a bin of hundreds
    picture[..., 3] = np.where(bad, 1.0, np.where(lost > 0, 0.25 + 0.65 * lost, 0.0))
    dt = float(data.attrs["dt"])
    with matplotlib.rc_context(STYLE):
        figure, panel = _one_panel(layout, 0.75 + 0.22 * len(names))
        panel.imshow(picture, aspect="auto", interpolation="nearest",
                     extent=(t[0] - dt, t[-1], len(names), 0))  # fmt: skip
        panel.set_yticks(np.arange(len(names)) + 0.5, names)
        panel.grid(visible=False)
        panel.tick_params(axis="y", length=0)
        for edge in range(1, len(names)):
            panel.axhline(edge, color=GRID, lw=0.6)
        _legend(figure, [
            Patch(color=LOST, alpha=0.9, label="missing (paler: some of the samples)"),
            Patch(color=FAULT, label="faulty"),
        ], layout)  # fmt: skip
    return figure


def trade_off(curve: TradeOff, chosen: tuple[float, float] | None, layout: Layout = WIDE) -> Figure:
    """Delay of the alarm against false-alarm episodes before the attack, over thresholds.

    ``chosen``: (episodes, delay) of the threshold in use.
    """
    caught = np.isfinite(curve.delay)
    with matplotlib.rc_context(STYLE):
        figure, panel = _one_panel(layout, 2.6, time=False)
        panel.set_xlabel("false-alarm episodes before the attack")
        panel.set_ylabel("delay (s)")
        order = np.lexsort((curve.delay[caught], curve.episodes[caught]))
        x, y = curve.episodes[caught][order], curve.delay[caught][order]
        best = np.minimum.accumulate(y) if len(y) else y
        panel.step(x, best, where="post", color=MAIN, lw=1.4)
        _dots(panel, x.astype(float), y, MAIN, 2.2)
        if chosen is not None and np.isfinite(chosen[1]):
            panel.plot(*chosen, "o", ms=7, mfc="none", mec=ALARM, mew=1.6, zorder=4)
        panel.set_ylim(bottom=0)
        panel.set_xlim(left=-0.3)
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        _legend(figure, [
            Line2D([], [], color=MAIN, lw=1.4, marker="o", ms=2.5, label="every threshold"),
            Line2D([], [], color=ALARM, marker="o", ms=6, mfc="none", ls="", label="in use"),
        ], layout)  # fmt: skip
    return figure


def path(data: xr.Dataset, place: tuple[str, str], layout: Layout = WIDE) -> Figure:
    """The way on a map, ``place`` naming the states east and north: estimated, measured, true."""
    measured = map_pair(data.output.values)
    keep = slice(None, None, max(1, len(data.time) // (6 * layout.bins)))
    with matplotlib.rc_context(STYLE):
        figure, panel = _one_panel(layout, min(4.2, layout.width), time=False)
        panel.set_xlabel(_label(data, "state", place[0]))
        panel.set_ylabel(_label(data, "state", place[1]))
        keys = [Line2D([], [], color=MAIN, lw=1.6, label="estimate")]
        if measured is not None:
            east, north = (data.y.sel(output=name).values[keep] for name in measured)
            _dots(panel, east, north, LOST, 1.6)
            keys.append(Line2D([], [], color=LOST, marker="o", ms=2.5, ls="", label="measured"))
        ways = [data.x.sel(state=name).values[keep] for name in place]
        panel.plot(*ways, color=MAIN, lw=1.6)
        if "true_x" in data:
            panel.plot(*(data.true_x.sel(state=name).values[keep] for name in place),
                       color=INK, lw=0.9, ls=(0, (4, 3)))  # fmt: skip
            keys.append(Line2D([], [], color=INK, lw=0.9, ls=(0, (4, 3)), label="truth"))
        hit = data.alarm.values[keep]
        if np.any(hit):
            _dots(panel, ways[0][hit], ways[1][hit], ALARM, 3.0)
            keys.append(Line2D([], [], color=ALARM, marker="o", ms=3, ls="", label="alarm"))
        panel.set_aspect("equal", adjustable="datalim")
        _legend(figure, keys, layout)
    return figure


def _bands(data, name, truth, window, layout, *, zero=False) -> Figure:
    kind = data[name].dims[-1]
    t, value = data.time.values, data[name].values
    variance = np.diagonal(data[f"{name}_cov"].values, axis1=-2, axis2=-1)
    sd = np.sqrt(np.where(np.isfinite(variance), variance, np.nan))
    with matplotlib.rc_context(STYLE):
        figure, panels = _panels(_names(data, kind), layout)
        for i, panel in enumerate(panels):
            _shade(panel, t, window)
            if zero:
                panel.axhline(0, color=SOFT, lw=0.6)
            low, high = value[:, i] - 2 * sd[:, i], value[:, i] + 2 * sd[:, i]
            panel.fill_between(*envelope(t, low, high, layout.bins), color=MAIN, alpha=0.2, lw=0)
            alone = np.flatnonzero(lonely(value[:, i]) & np.isfinite(sd[:, i]))
            alone = alone[:: max(1, len(alone) // layout.bins)]
            panel.vlines(t[alone], low[alone], high[alone], color=MAIN, alpha=0.3, lw=1.2)
            _line(panel, t, np.where(np.isfinite(sd[:, i]), value[:, i], np.nan), layout.bins,
                  color=MAIN, lw=1.1)  # fmt: skip
            if truth is not None:
                panel.plot(*extremes(t, truth[:, i], layout.bins), color=INK, lw=0.9,
                           ls=(0, (4, 3)))  # fmt: skip
            _frame(panel, value[:, i], sd[:, i], None if truth is None else truth[:, i])
        _legend(figure, [
            Line2D([], [], color=MAIN, lw=1.2, label="estimate"),
            Patch(color=MAIN, alpha=0.2, label="±2 sd"),
            *([Line2D([], [], color=INK, lw=0.9, ls=(0, (4, 3)), label="truth")]
              if truth is not None else []),
            *_window_key(window),
        ], layout)  # fmt: skip
    return figure


def _frame(panel: Axes, value, sd, truth) -> None:
    """Limits by the values; a band that starts out very wide must not flatten the rest."""
    known = np.isfinite(value) & np.isfinite(sd)
    if not np.any(known):
        panel.text(0.5, 0.5, "not determined by the data", transform=panel.transAxes,
                   ha="center", va="center", color=SOFT)  # fmt: skip
        panel.set_yticks([])
        return
    typical = 2 * np.quantile(sd[known], 0.9)
    low, high = value[known].min(), value[known].max()
    if truth is not None and np.any(np.isfinite(truth)):
        low, high = min(low, np.nanmin(truth)), max(high, np.nanmax(truth))
    reach = max(typical, 0.05 * (high - low), 1e-12 * max(1.0, abs(high)))
    panel.set_ylim(low - 1.1 * reach, high + 1.1 * reach)


def _names(data: xr.Dataset, kind: str, *, unit: bool = True) -> list[str]:
    names = [str(name) for name in data[kind].values]
    return [_label(data, kind, name) for name in names] if unit else names


def _label(data: xr.Dataset, kind: str, name: str) -> str:
    units = dict(
        pair.split(": ", 1) for pair in data[kind].attrs.get("units_of", "").split("; ") if pair
    )
    return f"{name} ({units[name]})" if name in units else name


def _panels(names: list[str], layout: Layout) -> tuple[Figure, list[Axes]]:
    names = names[:PANELS]
    columns = min(layout.columns, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(layout.width, 0.62 + 1.5 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    panels = list(grid.ravel())
    for panel, name in zip(panels, names, strict=False):
        panel.set_title(name)
    for panel in panels[len(names) :]:
        panel.remove()
    for panel in panels[max(0, len(names) - columns) : len(names)]:
        panel.set_xlabel("time (s)")
        panel.tick_params(labelbottom=True)
    for panel in panels[: len(names)]:
        panel.yaxis.set_major_locator(MaxNLocator(4))
    return figure, panels[: len(names)]


def _one_panel(layout: Layout, height: float, *, time: bool = True) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(layout.width, height), layout="constrained")
    panel = figure.subplots()
    if time:
        panel.set_xlabel("time (s)")
    return figure, panel


def legend(figure: Figure, keys: list, columns: int) -> None:
    """What the colours mean, above the panels."""
    figure.legend(handles=keys, loc="outside upper left", ncols=columns,
                  handlelength=1.6, columnspacing=1.4, borderaxespad=0.2)  # fmt: skip


def _legend(figure: Figure, keys: list, layout: Layout) -> None:
    legend(figure, keys, 5 if layout.columns > 1 else 2)


def _shade(panel: Axes, t: np.ndarray, window: Window) -> None:
    panel.set_xlim(t[0], t[-1] if len(t) > 1 else t[0] + 1)
    if window is not None:
        panel.axvspan(max(window[0], t[0]), min(window[1], t[-1]), color=ATTACK, alpha=0.16, lw=0)


def _window_key(window: Window) -> list[Patch]:
    return [] if window is None else [Patch(color=ATTACK, alpha=0.25, label="attack")]


def _line(panel: Axes, t, values, bins, *, held: bool = False, **style) -> None:
    panel.plot(*extremes(t, values, bins), **style)
    if held and np.any(lonely(values)):
        # a threshold that exists at single rows only still has to be seen
        known = np.flatnonzero(np.isfinite(values))
        panel.plot(*extremes(t[known], values[known], bins), **style)
    elif np.any(lonely(values)):
        _dots(panel, *extremes(t, np.where(lonely(values), values, np.nan), bins),
              style["color"], 2.0)  # fmt: skip


def _dots(panel: Axes, x, y, colour: str, size: float) -> None:
    """Round dots as one path of zero-length strokes: a tenth of the bytes of markers."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y = np.repeat(x[known], 3), np.repeat(y[known], 3)
    x[2::3] = np.nan
    panel.plot(x, y, color=colour, lw=size, solid_capstyle="round")


def _log_if_wide(panel: Axes, value, threshold) -> None:
    positive = value[np.isfinite(value) & (value > 0)]
    levels = threshold[np.isfinite(threshold) & (threshold > 0)]
    if positive.size == 0 or levels.size == 0:
        return
    top = max(positive.max(), levels.max())
    if top > 20 * max(np.median(positive), 1e-12) and np.all(value[np.isfinite(value)] >= 0):
        panel.set_yscale("log")
        bottom = max(np.quantile(positive, 0.05), 1e-3 * levels.min())
        panel.set_ylim(min(bottom, 0.3 * levels.min()), 1.6 * top)
    else:
        panel.set_ylim(min(0.0, positive.min()), 1.1 * top)
