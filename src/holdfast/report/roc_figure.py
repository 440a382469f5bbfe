"""ROC curves of detectors side by side: a panel, or a line of a table, for each scenario."""

from collections.abc import Mapping, Sequence

import matplotlib
from matplotlib.figure import Figure

from holdfast.campaign.roc import RATES, Curves
from holdfast.report.drawing import ALARM, ATTACK, FAULT, INK, MAIN
from holdfast.report.figures import STYLE
from holdfast.report.paper_figures import png

COLUMNS = 3
WIDTH, HEIGHT = 2.9, 2.5
"""Inches of a panel."""


def roc_panels(scenarios: Mapping[str, Curves]) -> Figure:
    """Detection against the false-alarm rate (log), with 95 % bands, a panel for each title.

    The dashed line is a test that guesses. At most four detectors have a colour each.
    """
    rows = -(-len(scenarios) // COLUMNS)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH * COLUMNS, 0.4 + HEIGHT * rows), layout="constrained")
        panels = figure.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False)
        for panel in panels.ravel()[len(scenarios) :]:
            panel.set_visible(False)
        for panel, (title, curves) in zip(panels.ravel(), scenarios.items(), strict=False):
            panel.set_title(title)
            panel.set_xscale("log")
            panel.set_xlim(RATES[0], RATES[-1])
            panel.set_ylim(0.0, 1.0)
            panel.plot(RATES, RATES, color=INK, lw=0.8, ls=(0, (4, 3)), label="guessing")
            colours = (MAIN, ALARM, FAULT, ATTACK)
            for colour, (name, found) in zip(colours, curves.detection.items(), strict=False):
                panel.fill_between(RATES, found.low, found.high, color=colour, alpha=0.25, lw=0)
                panel.plot(RATES, found.value, color=colour, lw=1.2, label=name)
        figure.supxlabel("false-alarm rate per row", fontsize=8.5)
        figure.supylabel("share of attacked rows detected", fontsize=8.5)
        lines, names = panels[0, 0].get_legend_handles_labels()
        figure.legend(lines, names, loc="outside upper left", ncols=len(names))
    return figure


def roc_png(scenarios: Mapping[str, Curves]) -> bytes:
    """`roc_panels` as a PNG file."""
    return png(roc_panels(scenarios))


def roc_table(scenarios: Mapping[str, Curves], rates: Sequence[float]) -> str:
    """A Markdown table: detection at each false-alarm rate, gain over the first detector with
    its 95 % interval, and what that says. Every scenario has the same detectors.
    """
    first = next(iter(scenarios.values()))
    heads = [
        head
        for rate in rates
        for head in (
            *(f"{name} at {rate:g}" for name in first.detection),
            *(text for name in first.gain for text in (f"gain of {name}", "verdict")),
        )
    ]
    lines = ["", *heads], ["---"] * (1 + len(heads))
    rows = [[name, *_cells(curves, rates)] for name, curves in scenarios.items()]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (*lines, *rows))


def _cells(curves: Curves, rates: Sequence[float]) -> list[str]:
    cells = []
    for rate in rates:
        cells += [f"{found.at(rate)[0]:.3f}" for found in curves.detection.values()]
        for name, gain in curves.gain.items():
            value, low, high = gain.at(rate)
            cells += [f"{value:+.4f} [{low:+.4f}, {high:+.4f}]", curves.verdict(name, rate)]
    return cells
