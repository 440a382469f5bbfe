"""The figure of a bank of modes: what was true, what was believed in, how probable each was."""

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from holdfast.report.drawing import ALARM, ATTACK, FAULT, GRID, MAIN, MORE, averaged
from holdfast.report.figures import STYLE, WIDE, Layout, legend

COLOURS = MAIN, ATTACK, MORE[0], FAULT, MORE[1], ALARM
"""Of the modes that are shown by name, the others are grey."""
OTHERS = "others"
LONG = 40
"""Characters of a name that a legend shows."""
LETTERS, BESIDE = 14, 6
"""Letters of a legend to an inch; as many as stand beside each label take up."""


def modes(data: xr.Dataset, layout: Layout = WIDE) -> Figure:
    """Strips of the mode believed in and of the true one, over the probabilities, stacked.

    The modes that matter most are named (as many as there are colours), the rest is one.
    """
    t, dt = data.time.values, float(data.attrs["dt"])
    bins = layout.bins * layout.columns
    named = [str(name) for name in data["named"].values]
    strips = {"believed": _shares(data["mode"].values, len(named), bins)}
    if "true_mode" in data:
        strips["true"] = _shares(data["true_mode"].values, len(named), bins)
    p, starts = averaged(data["p"].values, bins)
    edges = np.append(t[starts] - dt, t[-1])
    bank = [str(name) for name in data["bank"].values]
    names = _foremost(
        [(named, share) for share in strips.values()] + [(bank, p)], most=len(COLOURS)
    )
    colours = dict(zip(names, COLOURS, strict=False))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(layout.width, 2.5 + 0.3 * len(strips)), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[0.3 * len(strips), 2.0])
        for row, share in enumerate(strips.values()):
            _strip(above, edges, share, row, named, colours)
        above.set_yticks(np.arange(len(strips)) + 0.4, list(strips))
        above.set_ylim(len(strips) - 0.1, -0.1)
        above.tick_params(length=0)
        above.grid(visible=False)
        above.spines[:].set_visible(False)
        _stack(below, edges, p, bank, colours)
        below.set_ylabel("probability")
        below.set_xlabel("time (s)")
        below.set_ylim(0, 1)
        below.set_xlim(edges[0], edges[-1])
        keys = [Patch(color=colour, label=_short(name)) for name, colour in colours.items()]
        if set(named) | set(bank) > set(names):
            keys.append(Patch(color=GRID, label=OTHERS))
        legend(figure, keys, _columns([str(key.get_label()) for key in keys], layout.width))
    return figure


def _shares(mode: np.ndarray, count: int, bins: int) -> np.ndarray:
    """Of each part of the rows (parts x modes), the share in which each mode was the one."""
    return averaged(mode[:, None] == np.arange(count), bins)[0]


def _foremost(shown: list[tuple[list[str], np.ndarray]], most: int) -> list[str]:
    """The names with the largest mean share in anything shown, in the order of the modes."""
    weight: dict[str, float] = {}
    for names, share in shown:
        for name, mean in zip(names, np.mean(share, 0), strict=True):
            weight[name] = max(weight.get(name, 0.0), float(mean))
    kept = sorted(weight, key=lambda name: -weight[name])[:most]
    return [name for name in weight if name in kept and weight[name] > 0]


def _strip(panel, edges, share, row, named, colours) -> None:
    """Each part in the colour of the mode that had most of it; a gap where none had any."""
    foremost = np.where(np.any(share > 0, 1), np.argmax(share, 1), -1)
    drawn = np.array([colours.get(name, GRID) for name in named])
    colour = np.where(foremost >= 0, drawn[foremost], "")
    for kind in dict.fromkeys(drawn.tolist()):
        if np.any(colour == kind):
            top = np.where(colour == kind, row + 0.8, row)
            panel.stairs(top, edges, baseline=float(row), fill=True, color=kind, lw=0)


def _stack(panel, edges, p, bank, colours) -> None:
    """The probabilities on top of one another; what has no colour of its own comes last."""
    base = np.zeros(len(p))
    for name, colour in colours.items():
        if name in bank:
            top = base + p[:, bank.index(name)]
            panel.stairs(top, edges, baseline=base, fill=True, color=colour, lw=0)
            base = top
    if np.any(base < 1 - 1e-9):
        panel.stairs(np.ones(len(p)), edges, baseline=base, fill=True, color=GRID, lw=0)


def _columns(labels: list[str], width: float) -> int:
    """Columns of a legend that fit into so many inches, filled one after the other."""
    for columns in range(len(labels), 1, -1):
        rows = -(-len(labels) // columns)
        widths = [max(map(len, labels[i : i + rows])) for i in range(0, len(labels), rows)]
        if sum(widths) + BESIDE * len(widths) <= LETTERS * width:
            return columns
    return 1


def _short(name: str) -> str:
    return name if len(name) <= LONG else name[: LONG - 3] + "..."
