"""The papers' figures drawn again: panels one above the other over the same time."""

import io
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from holdfast.report.drawing import ALARM, FAULT, INK, MAIN
from holdfast.report.figures import STYLE

DASHED = ("truth", "threshold")
WIDTH, HEIGHT = 8.4, 2.1
DOTS_PER_INCH = 150


class Panel(NamedTuple):
    """Series over time by name; those called "truth" or "threshold" are dashed."""

    title: str
    lines: dict[str, np.ndarray]
    log: bool = False


def stacked(t: np.ndarray, panels: list[Panel]) -> Figure:
    """The panels over ``t`` in seconds, with one legend."""
    colours = iter((ALARM, MAIN, FAULT))
    style = {}
    for name in dict.fromkeys(name for panel in panels for name in panel.lines):
        if name in DASHED:
            style[name] = {"color": INK, "lw": 1.0, "ls": (0, (4, 3))}
        else:
            style[name] = {"color": next(colours), "lw": 0.9}
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 0.6 + HEIGHT * len(panels)), layout="constrained")
        axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for place, panel in zip(axes, panels, strict=True):
            place.set_title(panel.title)
            place.set_xlim(0, t[-1])
            if panel.log:
                place.set_yscale("log")
            for name, values in panel.lines.items():
                place.plot(t, values, label=name, **style[name])
        axes[-1].set_xlabel("time (s)")
        found = {
            label: line
            for place in axes
            for line, label in zip(*place.get_legend_handles_labels(), strict=True)
        }
        figure.legend(found.values(), found.keys(), loc="outside upper left", ncols=4)
    return figure


def png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    target = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        FigureCanvasAgg(figure).print_figure(target, dpi=DOTS_PER_INCH)
    return target.getvalue()
