"""The tables and sentences of the arena, from its cases, and both as Markdown."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import pandas as pd

from holdfast.report.arena_numbers import (
    DETECTORS,
    Win,
    grouped,
    leaders,
    name_of,
    number,
    records,
    summary,
    winners,
)
from holdfast.report.words import count

FALSE_ALARMS = "false alarms, %"
GROWS = "undetected lies can grow"
KEPT, BROKEN = ("kept", "exact"), "broken"
YES, NO = "\N{CHECK MARK}", "\N{BALLOT X}"
LEGEND = (
    "Errors are root mean squares over rows and runs of the state with the largest, in units of "
    "what the first estimator has without attack. Bold: the best of the row, and all whose 95 % "
    "interval overlaps its own, without those who failed where the best has not. Italics: failed, "
    "3 times the unit or more, or no estimate. "
    f"{YES}: what was promised beforehand was kept, {NO}: it was broken, neither: nothing was "
    "promised. inf: grown beyond all numbers, -: no value. Alarms are shares of the attacked rows "
    f'in per cent. "{GROWS.capitalize()}": whether lies of the sensors hit can, in theory, '
    "become as large as the attacker likes without showing; blank: no sensor is hit, or it is "
    "not known."
)


class Cell(NamedTuple):
    """A number of a table; ``kind``: "error", "alarms" or "false alarms"."""

    value: float
    kind: str
    best: bool = False
    failed: bool = False
    promise: str = ""


class Row(NamedTuple):
    """The names of a row, its cells, and whether undetected lies can grow ("yes", "no", "")."""

    names: tuple[str, ...]
    cells: list[Cell]
    grows: str = ""


class Table(NamedTuple):
    """A study on a plant; ``heads`` over the names of the rows, ``columns`` over the cells."""

    ground: str
    study: str
    heads: tuple[str, ...]
    columns: list[str]
    rows: list[Row]


def tables(cases: pd.DataFrame) -> list[Table]:
    """A table for each study on each plant, in the order of the cases."""
    groups = grouped(records(cases), "ground", "study")
    return [_table(ground, study, group) for (ground, study), group in groups.items()]


def _table(ground: str, study: str, cases: list[dict[str, Any]]) -> Table:
    columns = list(dict.fromkeys(map(name_of, cases)))
    places = {(case["truth"], case["attack"], name_of(case)): case for case in cases}
    truths = list(dict.fromkeys(case["truth"] for case in cases))
    attacks = list(dict.fromkeys(case["attack"] for case in cases))
    mismatch = any(truths)
    rows = []
    for truth in truths:
        before = (truth,) if mismatch else ()
        for attack in attacks:
            row = [places.get((truth, attack, column)) for column in columns]
            if study == DETECTORS and attack == attacks[0]:
                continue  # no row of it is attacked: the false alarms below are all there is
            known = [case for case in row if case is not None]
            best = list(map(name_of, leaders(known, study)))
            grows = {_grows(case) for case in known} - {""}
            rows.append(Row((*before, attack), [_cell(case, study, best) for case in row],
                            "" if mismatch else "/".join(sorted(grows))))  # fmt: skip
        if mismatch or study == DETECTORS:
            quiet = [places.get((truth, attacks[0], column)) for column in columns]
            cells = [Cell(math.nan if case is None else case["false_alarms"], "false alarms")
                     for case in quiet]  # fmt: skip
            rows.append(Row((*before, FALSE_ALARMS), cells))
    return Table(ground, study, ("truth", "attack") if mismatch else ("attack",), columns, rows)


def _cell(case: dict[str, Any] | None, study: str, best: Sequence[str]) -> Cell:
    kind = "alarms" if study == DETECTORS else "error"
    if case is None:
        return Cell(math.nan, kind)
    leads = name_of(case) in best
    if study == DETECTORS:
        return Cell(case["alarms"], kind, leads)
    return Cell(case["error"], kind, leads, bool(case["failed"]), case["promise"])


def _grows(case: dict[str, Any]) -> str:
    return {"True": "yes", "False": "no"}.get(str(case.get("attackable", "")), "")


def said(value: float, kind: str) -> str:
    """The value of a cell: an error in its units, shares in per cent."""
    if kind == "error" or math.isnan(value):
        return number(value)
    if kind == "false alarms":
        return number(100 * value)
    return "<1" if 0 < value < 0.01 else f"{100 * value:.0f}"


def sentences(cases: pd.DataFrame) -> list[str]:
    """What the summary says."""
    found = summary(cases)
    broken = f"{found['broken']} broken" if found["broken"] else "none broken"
    lines = [
        f"Of {count(found['cases'], 'case')} {found['promised']} have a promise: "
        f"{found['exact']} exact, {count(found['kept'], 'bound')}, {broken}.",
        f"Of {count(found['attacked'], 'case')} with an attack {found['attacked_promised']} have "
        f"a promise, and {found['failed_promised']} of these failed; without a promise "
        f"{found['failed_unpromised']} failed and {found['sound_unpromised']} did not.",
    ]
    if found["kept"]:
        least, most, median = (
            number(found[f"tightness_{name}"]) for name in ("least", "most", "median")
        )
        lines.append(f"The error is {least} to {most} of its bound, in the median {median}.")
    if found["false_alarms_worst"]:
        least, most = (number(100 * found[f"false_alarms_{name}"]) for name in ("least", "most"))
        lines.append(
            f"Without attack and mismatch {least} to {most} per cent of the rows have an alarm, "
            f"most with {found['false_alarms_worst']}."
        )
    return lines


def losses(cases: pd.DataFrame) -> tuple[str, list[tuple[str, str, str, str]]]:
    """A sentence on how often, and of each loss plant and study, attack, baseline, best own."""
    found = winners(cases)
    lost = [win for win in found if win.lost_to]
    lines = [
        (f"{win.ground}, {win.study}", win.attack, _held(win, win.lost_to, win.lost_value),
         _held(win, win.own, win.own_value) if win.own else "none has a value")
        for win in lost
    ]  # fmt: skip
    times = f"In {len(lost)} of {count(len(found), 'comparison')}"
    return f"{times} a baseline beats all of our own beyond the 95 % intervals.", lines


def _held(win: Win, name: str, value: float) -> str:
    """A name with its value, to a digit more than in the tables."""
    shown = f"{number(100 * value, 3)} %" if win.study == DETECTORS else number(value, 3)
    return f"{name} {shown}"


def markdown(cases: pd.DataFrame) -> str:
    """Summary, tables and losses, for documentation and terminal."""
    parts = [" ".join(sentences(cases)), LEGEND]
    ground = ""
    for table in tables(cases):
        if table.ground != ground:
            ground = table.ground
            parts.append(f"## {_plain(ground)}")
        parts += [f"### {_plain(ground)}: {_plain(table.study)}", "\n".join(_lines(table))]
    sentence, lost = losses(cases)
    parts += ["## What our own estimators lose", sentence]
    if lost:
        lines = (
            f"- {place}, {attack}: {rival}; our own: {own}" for place, attack, rival, own in lost
        )
        parts.append("\n".join(map(_plain, lines)))
    return "\n\n".join(parts) + "\n"


def _lines(table: Table) -> Iterator[str]:
    last = [GROWS] if any(row.grows for row in table.rows) else []
    heads = [*table.heads, *table.columns, *last]
    rules = ["---"] * len(table.heads) + ["---:"] * len(table.columns) + ["---"] * len(last)
    yield _line(map(_plain, heads))
    yield _line(rules)
    for row in table.rows:
        yield _line([*map(_plain, row.names), *map(_marked, row.cells), *([row.grows] * len(last))])


def _line(cells) -> str:
    return f"| {' | '.join(cells)} |"


def _plain(text: str) -> str:
    """A name on one line, without what Markdown would take for its own."""
    text = " ".join(text.split())
    for sign in "\\|*_`<[":
        text = text.replace(sign, f"\\{sign}")
    return text


def _marked(cell: Cell) -> str:
    stars = "*" * (2 * cell.best + cell.failed)
    return f"{stars}{said(cell.value, cell.kind)}{stars}{mark(cell)}"


def mark(cell: Cell) -> str:
    """What became of the promise, as a sign behind the number."""
    return f" {YES}" if cell.promise in KEPT else f" {NO}" if cell.promise == BROKEN else ""
