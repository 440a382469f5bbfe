"""The figures of the arena: a map of errors for each plant, and one of alarms where there is one.

Drawn from the cases, so that whoever reads cases.csv can draw them again.
"""

import math
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from holdfast.report.arena_numbers import DETECTORS, ESTIMATORS
from holdfast.report.arena_tables import BROKEN, FALSE_ALARMS, KEPT, Cell, Table, said, tables
from holdfast.report.campaign_grid import plain, short
from holdfast.report.drawing import ALARM, PAPER, SOFT
from holdfast.report.figures import STYLE, WIDE, Layout, legend
from holdfast.report.words import DASH

MOST = 1000.0
"""Times the unit from which all errors have one colour."""
LETTER = 0.072
"""Inches that a letter of a heading is wide."""
SMALLEST, LARGEST = 3.4, 7.0
"""Points of the letters in the cells; below that nothing is written."""
ROW = 0.21
"""Inches that a row is high."""


def figures(cases: pd.DataFrame, layout: Layout = WIDE) -> dict[str, Figure]:
    """The figures by name, PLANT_STUDY: of each comparison of estimators, or of detectors."""
    drawn: dict[str, Figure] = {}
    with matplotlib.rc_context(STYLE):
        for table in tables(cases):
            if table.study in (ESTIMATORS, DETECTORS):
                drawn[f"{table.ground}_{table.study}"] = _figure(table, layout)
    return drawn


def _figure(table: Table, layout: Layout) -> Figure:
    """A panel of all estimators, or one for each estimator with its detectors."""
    alarms = table.study == DETECTORS
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(table.columns):
        groups.setdefault(name.rpartition(" / ")[0] if alarms else "", []).append(i)
    abreast = layout.columns > 1
    names = [_row_name(" ".join(row.names)) for row in table.rows]
    # the words beside the bar need that much
    aside = abreast and ROW * len(names) > 2.3
    beside = LETTER * max(map(len, names)) + (0.85 if aside else 0.2)
    widest = max(map(len, groups.values()))
    inches = (layout.width - beside) / (sum(map(len, groups.values())) if abreast else widest)
    heads = {i: _head(name.rpartition(" / ")[2], inches) for i, name in enumerate(table.columns)}
    # upright headings if any is too long for its column
    upright = any(LETTER * max(map(len, h.split("\n"))) > inches for h in heads.values())
    above = max(map(len, heads.values())) * LETTER if upright else 0.4
    height = len(names) * ROW + above + (0.25 if alarms else 0)
    high = height * (1 if abreast else len(groups)) + 0.15 + (0 if aside else 0.45)
    figure = Figure(figsize=(layout.width, high), layout="constrained")
    shape = (1, len(groups)) if abreast else (len(groups), 1)
    ratios: Any = {"width_ratios": list(map(len, groups.values()))} if abreast else {}
    panels = figure.subplots(*shape, squeeze=False, sharey=abreast, **ratios).ravel()
    norm, pictures = Normalize(0, 100) if alarms else LogNorm(1, MOST), []
    for panel, (title, columns) in zip(panels, groups.items(), strict=True):
        cells = [[row.cells[i] for i in columns] for row in table.rows]
        pictures.append(_map(panel, cells, norm, inches))
        shown = [heads[i].replace("\n", " ") if upright else heads[i] for i in columns]
        panel.set_xticks(range(len(columns)), shown, rotation=90 if upright else 0)
        panel.set_yticks(range(len(names)), names)
        panel.set_title(short(plain(title)))
        if alarms:
            panel.axhline(len(names) - 1.5, color=PAPER, lw=2.5)
    _bar(figure, pictures[0], panels, alarms=alarms, aside=aside)
    _keys(figure, table)
    return figure


def _row_name(name: str) -> str:
    return name if name == FALSE_ALARMS else short(plain(name), 22)


def _head(name: str, inches: float) -> str:
    """The heading of a column, on two lines where that makes it fit."""
    name = short(plain(name), 22)
    breaks = [i for i, letter in enumerate(name) if letter == " " and i]
    if LETTER * len(name) <= inches or not breaks:
        return name
    at = min(breaks, key=lambda i: max(i, len(name) - i))
    return f"{name[:at]}\n{name[at + 1 :]}"


def _map(panel: Axes, cells: list[list[Cell]], norm: Normalize, inches: float) -> Any:
    """Cells of equal size with their values, and what became of promises."""
    values = np.array([
        [cell.value * (1 if cell.kind == "error" else 100) for cell in row] for row in cells
    ])  # fmt: skip
    # grown beyond all numbers is the colour of the largest
    values = np.where(np.isnan(values), np.nan, np.clip(values, norm.vmin, norm.vmax))
    picture = panel.imshow(values, norm=norm, cmap="viridis", aspect="auto",
                           interpolation="nearest")  # fmt: skip
    panel.grid(visible=False)
    panel.tick_params(length=0)
    panel.xaxis.tick_top()
    for spine in panel.spines.values():
        spine.set_visible(False)
    texts = [[_text(cell) for cell in row] for row in cells]
    longest = max(len(text) for row in texts for text in row)
    size = min(LARGEST, 72 * inches / 0.68 / max(longest, 3))
    for y, row in enumerate(cells):
        for x, cell in enumerate(row):
            known = math.isfinite(values[y, x])
            # white and black stay as they are on a dark page, as the map does
            colour = ("white" if norm(values[y, x]) < 0.6 else "black") if known else SOFT
            if size >= SMALLEST:
                panel.text(x, y, texts[y][x], ha="center", va="center", size=size, color=colour)
            _promise(panel, x, y, cell, colour)
    return picture


def _text(cell: Cell) -> str:
    return DASH if math.isnan(cell.value) else "∞" if math.isinf(cell.value) else (
        said(cell.value, cell.kind))  # fmt: skip


def _promise(panel: Axes, x: int, y: int, cell: Cell, colour: str) -> None:
    if cell.promise in KEPT:
        panel.plot(x + 0.42, y - 0.35, "o", color=colour, ms=2.6, mew=0)
    elif cell.promise == BROKEN:
        # white below, or it is lost on some colours of the map
        for ink, width in (("white", 3.4), (ALARM, 1.8)):
            panel.add_patch(Rectangle((x - 0.44, y - 0.42), 0.88, 0.84, fill=False, ec=ink,
                                      lw=width))  # fmt: skip


def _bar(figure: Figure, picture: Any, panels: Any, *, alarms: bool, aside: bool) -> None:
    """What the colours mean: on the right, or below where there is no room for that."""
    where: Any = {"aspect": 24} if aside else {"location": "bottom", "aspect": 40}
    label = "attacked rows with alarm, %" if alarms else "error / that of the first, not attacked"
    bar = figure.colorbar(picture, ax=list(panels), pad=0.02, **where)
    bar.set_label(label, fontsize=8)
    bar.outline.set_visible(False)
    if not alarms:
        bar.set_ticks([1, 10, 100, MOST], labels=["≤ 1", "10", "100", "≥ 1000"])
        bar.minorticks_off()


def _keys(figure: Figure, table: Table) -> None:
    found = {cell.promise for row in table.rows for cell in row.cells}
    keys: list[Any] = []
    if found & set(KEPT):
        keys.append(Line2D([], [], ls="", marker="o", color=SOFT, ms=3, mew=0,
                           label="promised beforehand, and kept"))  # fmt: skip
    if BROKEN in found:
        keys.append(Patch(fill=False, ec=ALARM, lw=1.8, label="promise broken"))
    if keys:
        legend(figure, keys, 2)
        box = figure.legends[0].get_window_extent(FigureCanvasAgg(figure).get_renderer())
        figure.set_figheight(figure.get_figheight() + box.height / figure.dpi)
