"""`holdfast papers`: the papers' examples and claims, judged."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import rich.console
import rich.markup
import rich.table

from holdfast.papers.index import STUDIES
from holdfast.papers.rows import VERDICTS, Row
from holdfast.report.tables import json_safe
from holdfast.shell import runtime
from holdfast.shell.calibrating import busy
from holdfast.shell.errors import InputError, one_of
from holdfast.shell.writing import FILES, check_place, write_figures, write_text

WIDE = 160
"""Columns of a table that goes to a file or a pipe."""
COLOURS = {"reproduced": "green", "holds": "green", "fails": "red", "not reproduced": "red"}


def papers(name: str | None, as_json: bool, output: str | None) -> None:
    """Judge one paper, or all; print a table or JSON, and write figures to a folder."""
    runtime.configure()
    if name is not None and name not in STUDIES:
        raise InputError("papers", "", repr(name), one_of(STUDIES, name))
    if output is not None:
        if Path(output).suffix.lower() in FILES:
            raise InputError(output, "", "the name of a file", "a folder for the figures")
        check_place(output)
    rows: list[Row] = []
    for paper in [name] if name else STUDIES:
        with busy(f"judging {paper}"):
            study = STUDIES[paper]()
        rows += study.rows
        if output is not None:
            write_figures(output, study.figures())
    text = json.dumps(json_safe([row.as_dict() for row in rows]), allow_nan=False, indent=1)
    if output is not None:
        write_text(Path(output) / "papers.json", text + "\n")
    if as_json:
        print(text)
    else:
        _print(rows)


def _print(rows: list[Row]) -> None:
    console = rich.console.Console()
    if not console.is_terminal:
        console.width = WIDE
    table = rich.table.Table("id", "what", "paper", "ours", "verdict", box=None, pad_edge=False)
    for row in rows:
        verdict = (
            f"[{COLOURS[row.verdict]}]{row.verdict}[/]" if row.verdict in COLOURS else row.verdict
        )
        cells = (row.id, row.what, shown(row.paper), shown(row.ours, row.spread))
        table.add_row(*map(rich.markup.escape, cells), verdict)
    console.print(table)
    counts = Counter(row.verdict for row in rows)
    console.print(", ".join(f"{counts[one]} {one}" for one in VERDICTS if counts[one]))
    console.print("Why, row by row: the notes of --json.", highlight=False)


def shown(value: Any, spread: Any = None) -> str:
    """A value, or a list of them, to four digits, each with its spread."""
    if value is None:
        return "-"
    if isinstance(value, list):
        spreads = spread if isinstance(spread, list) else [None] * len(value)
        return ", ".join(shown(*pair) for pair in zip(value, spreads, strict=True))
    if isinstance(value, float):
        return f"{value:.4g}" + ("" if spread is None else f" ± {spread:.2g}")
    return str(value)
