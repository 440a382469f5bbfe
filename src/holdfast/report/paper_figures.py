"""The papers' figures drawn again: panels over the same time, and curves in a plane."""

import io
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from holdfast.report.drawing import ALARM, ATTACK, FAULT, GRID, INK, LOST, MAIN
from holdfast.report.figures import STYLE

DASHED = ("truth", "threshold", "course")
COLOURS = (ALARM, MAIN, FAULT, "#009e73", ATTACK, LOST)
MARKS = ((0, (4, 3)), (0, (1, 2)))
"""Dashes of the first and of the second vertical line."""
DOTS = {"ls": "none", "marker": ".", "ms": 1.5}
WIDTH, HEIGHT, TALL = 8.4, 2.1, 3.2
FEW = 6
"""Labels on an axis of a plane, at most."""
DOTS_PER_INCH = 150


class Panel(NamedTuple):
    """Series over time by name; those called as in `DASHED` are dashed.

    ``x``: of this panel's series, where they have their own; ``marks``: vertical lines by name;
    ``dotted``: series that jump, as dots, but for those that are dashed.
    """

    title: str
    lines: dict[str, np.ndarray]
    log: bool = False
    x: np.ndarray | None = None
    marks: Mapping[str, float] = MappingProxyType({})
    dotted: bool = False


class Plane(NamedTuple):
    """Curves in a plane (N x 2) by name, with the names of both axes.

    ``equal``: one unit is as long on one axis as on the other; ``window``: the lowest and the
    highest value shown on both.
    """

    title: str
    lines: dict[str, np.ndarray]
    x: str
    y: str
    equal: bool = False
    window: tuple[float, float] | None = None


def stacked(t: np.ndarray, panels: list[Panel]) -> Figure:
    """The panels over ``t`` in seconds, with one legend."""
    return _drawn(t, panels, "time (s)", HEIGHT)


def over(x: np.ndarray, panels: list[Panel], label: str, *, same: bool = False) -> Figure:
    """The panels, higher than those over time, over a positive quantity on a logarithmic axis.

    ``same``: they share the vertical axis too.
    """
    figure = _drawn(x, panels, label, TALL, same=same)
    for place in figure.axes:
        place.set_xscale("log")
        place.set_xlim(x[0], x[-1])
        place.grid(True, which="major", color=GRID, lw=0.5)
    return figure


def against(x: np.ndarray, panels: list[Panel], label: str, *, shared: bool = True) -> Figure:
    """The panels over a quantity that starts at 0; those without a logarithmic axis from 0 up.

    ``shared``: all as far as ``x``; else each as far as its own ``x``.
    """
    figure = _drawn(x, panels, label, TALL, shared=shared)
    for place, panel in zip(figure.axes, panels, strict=True):
        if not panel.log:
            place.set_ylim(0, None)
        place.grid(True, which="major", color=GRID, lw=0.5)
    return figure


def planes(panels: list[Plane]) -> Figure:
    """The panels side by side, with one legend."""
    style = _styles(name for panel in panels for name in panel.lines)
    with matplotlib.rc_context(STYLE):
        size = (WIDTH, 0.3 + WIDTH / len(panels))
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(1, len(panels), squeeze=False)[0]
        for place, panel in zip(axes, panels, strict=True):
            place.set_title(panel.title)
            place.set_xlabel(panel.x)
            place.set_ylabel(panel.y)
            for name, values in panel.lines.items():
                place.plot(*values.T, label=name, **style[name])
            if panel.equal:
                place.set_aspect("equal")
            if panel.window is not None:
                place.set_xlim(panel.window)
                place.set_ylim(panel.window)
            place.locator_params(nbins=FEW)
            place.grid(True, which="major", color=GRID, lw=0.5)
        _legend(figure)
    return figure


def _drawn(
    x: np.ndarray, panels: list[Panel], label: str, height: float, *,
    same: bool = False, shared: bool = True,
) -> Figure:  # fmt: skip
    style = _styles(name for panel in panels for name in panel.lines)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 0.6 + height * len(panels)), layout="constrained")
        axes = figure.subplots(len(panels), 1, sharex=shared, sharey=same, squeeze=False)[:, 0]
        for place, panel in zip(axes, panels, strict=True):
            place.set_title(panel.title)
            own = x if panel.x is None else panel.x
            place.set_xlim(0, (x if shared else own)[-1])
            if panel.log:
                place.set_yscale("log")
            for name, values in panel.lines.items():
                dots = DOTS if panel.dotted and name not in DASHED else {}
                place.plot(own, values, label=name, **style[name] | dots)
            for (name, at), dashes in zip(panel.marks.items(), MARKS, strict=False):
                place.axvline(at, label=name, color=INK, lw=0.9, ls=dashes)
        axes[-1].set_xlabel(label)
        _legend(figure)
    return figure


def _styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """How each name is drawn, the same in every panel."""
    colours = iter(COLOURS)
    style = {}
    for name in dict.fromkeys(names):
        if name in DASHED:
            style[name] = {"color": INK, "lw": 1.0, "ls": (0, (4, 3))}
        else:
            style[name] = {"color": next(colours), "lw": 0.9}
    return style


def _legend(figure: Figure) -> None:
    """One for all panels."""
    found = {
        label: line
        for place in figure.axes
        for line, label in zip(*place.get_legend_handles_labels(), strict=True)
    }
    figure.legend(found.values(), found.keys(), loc="outside upper left", ncols=4)


def png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    target = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        FigureCanvasAgg(figure).print_figure(target, dpi=DOTS_PER_INCH)
    return target.getvalue()
