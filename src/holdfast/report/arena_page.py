"""The page of the arena: the summary, maps and tables of every plant, and what our own lose."""

import math
import shlex
from typing import Any

import pandas as pd

from holdfast.report.arena_figures import figures
from holdfast.report.arena_numbers import DETECTORS
from holdfast.report.arena_tables import (
    GROWS,
    LEGEND,
    Cell,
    Table,
    losses,
    mark,
    said,
    sentences,
    tables,
)
from holdfast.report.figures import NARROW, WIDE, svg
from holdfast.report.markup import Column, Markup, document, element, join, section, table
from holdfast.report.pictures import Picture
from holdfast.report.sections import contents
from holdfast.report.words import DASH, NBSP, count

TITLE = "The arena: every estimator against every attack"

_READINGS = {
    False: "The error of each estimator (across) under each attack (down), as in the table below. "
    "A dot: what was promised beforehand was kept; a frame: it was broken.",
    True: "The share of attacked rows with an alarm, of each detector (across) on each estimator, "
    "under each attack (down). The last row has the alarms without attack.",
}


def page(cases: pd.DataFrame) -> str:
    """The page as text, complete in itself, from the cases of the arena."""
    found = tables(cases)
    drawn = _pictures(cases)
    plants = list(dict.fromkeys(one.ground for one in found))
    parts = [section("summary", "Summary", *(element("p", line) for line in sentences(cases)))]
    parts.append(section("reading", "How to read it", element("p", _html(LEGEND))))
    for i, plant in enumerate(plants):
        inside = [
            part
            for one in found if one.ground == plant
            for part in (
                element("h3", one.study),
                *([drawn[f"{plant}_{one.study}"]] if f"{plant}_{one.study}" in drawn else []),
                _table(one),
            )
        ]  # fmt: skip
        # a name may hold what an address may not
        parts.append(section(f"plant-{i + 1}", plant, *inside))
    parts += [section("losses", "What our own lose", _losses(cases)), _command(plants)]
    under = f"{count(len(cases), 'case')} on {count(len(plants), 'plant')}."
    top = element("header", element("h1", TITLE), element("p", under, class_="under"),
                  contents(parts))  # fmt: skip
    return document(TITLE, top, parts)


def _pictures(cases: pd.DataFrame) -> dict[str, Markup]:
    wide, narrow = figures(cases, WIDE), figures(cases, NARROW)
    made = {}
    for i, (name, figure) in enumerate(wide.items()):
        alarms = name.endswith(f"_{DETECTORS}")
        what = "Share of attacked rows with alarm" if alarms else "Error of the estimates"
        shows = f"{what} on {name.rpartition('_')[0]}"
        picture = Picture(f"arena-{i}", shows, _READINGS[alarms], svg(figure), svg(narrow[name]))
        made[name] = picture.markup()
    return made


def _table(found: Table) -> Markup:
    last = [Column(GROWS)] if any(row.grows for row in found.rows) else []
    columns = [Column(head) for head in found.heads]
    columns += [*(Column(name, True) for name in found.columns), *last]
    rows = [
        [*row.names, *(_cell(cell) for cell in row.cells), *([row.grows] * len(last))]
        for row in found.rows
    ]
    unit = "Share of attacked rows with an alarm, %." if found.study == DETECTORS else (
        f"Error, in units of what {found.columns[0]} has without attack.")  # fmt: skip
    return table(columns, rows, unit)


def _cell(cell: Cell) -> Markup:
    shown: Any = said(cell.value, cell.kind)
    if not math.isfinite(cell.value):
        shown = DASH if math.isnan(cell.value) else "∞"
    shown = element("em", shown) if cell.failed else shown
    shown = element("strong", shown) if cell.best else shown
    return element("span", shown, mark(cell).replace(" ", NBSP))


def _html(legend: str) -> str:
    """The legend with the signs that stand on a page."""
    return legend.replace("inf:", "∞:").replace("-: no value", f"{DASH}: no value")


def _losses(cases: pd.DataFrame) -> Markup:
    sentence, lost = losses(cases)
    heads = [Column(head) for head in ("Plant, study", "Attack", "Baseline", "Best of our own")]
    return join([element("p", sentence), *([table(heads, lost)] if lost else [])])


def _command(plants: list[str]) -> Markup:
    command = f"holdfast arena {shlex.join(plants)} -o out"
    above = element("p", "The command that runs it again, with the studies behind it in "
                    "out/PLANT/STUDY.toml:", class_="caption")  # fmt: skip
    return section("command", "Run it again", above, element("pre", command, tabindex="0"))
