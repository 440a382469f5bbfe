"""Small pieces of HTML; every text that comes in is escaped here and nowhere else."""

from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from typing import Any, NamedTuple

from holdfast import __version__
from holdfast.report.words import DASH, MINUS


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


class Column(NamedTuple):
    """A column's heading, and whether its cells are numbers."""

    heading: str
    numeric: bool = False


def text(value: Any) -> Markup:
    """The value as HTML: escaped, unless it is `Markup`."""
    return value if isinstance(value, Markup) else Markup(escape(str(value)))


def join(parts: Sequence[str]) -> Markup:
    """Pieces of markup, one after the other."""
    return Markup("\n".join(parts))


def element(name: str, *content: Any, **attributes: str) -> Markup:
    """<name attributes>content</name>; ``class_`` gives class, ``aria_label`` aria-label."""
    given = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(v)}"' for key, v in attributes.items()
    )
    return Markup(f"<{name}{given}>{''.join(text(c) for c in content)}</{name}>")


def table(columns: Sequence[Column], rows: Sequence[Sequence[Any]], caption: str = "") -> Markup:
    """A table whose first column heads its rows; it scrolls sideways where it must."""
    kinds = [{"class_": "n"} if c.numeric else {} for c in columns]
    head = [element("th", c.heading, scope="col", **k) for c, k in zip(columns, kinds, strict=True)]
    body = [
        element(
            "tr",
            element("th", row[0], scope="row"),
            *(element("td", cell, **k) for cell, k in zip(row[1:], kinds[1:], strict=True)),
        )
        for row in rows
    ]
    whole = element("table", element("thead", element("tr", *head)), element("tbody", *body))
    # above the part that scrolls: a caption inside would be cut off on a phone
    above = element("p", caption, class_="caption") if caption else ""
    return join([above, element("div", whole, class_="scroll", tabindex="0")])


def records(rows: Sequence[Mapping[str, Any]]) -> Markup:
    """A table of mappings: a column for every key, in the order of their first coming."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    numeric = [all(isinstance(row.get(k), int | float | None) for row in rows) for k in keys]
    columns = [Column(_spaced(k), n) for k, n in zip(keys, numeric, strict=True)]
    return table(columns, [[_cell(row.get(key)) for key in keys] for row in rows])


def settings(found: Mapping[str, Any]) -> Markup:
    """A list of names and values."""
    pairs = (
        element("div", element("dt", _spaced(key)), element("dd", _cell(value)))
        for key, value in found.items()
    )
    return element("dl", *pairs, class_="settings")


def items(lines: Sequence[Any]) -> Markup:
    """A list of lines."""
    return element("ul", *(element("li", line) for line in lines))


def section(key: str, heading: str, *content: Any) -> Markup:
    """A part of the page with its heading; ``key`` is its address."""
    return element("section", element("h2", heading, id=key), *content, aria_labelledby=key)


def _spaced(key: Any) -> str:
    return str(key).replace("_", " ")


def _cell(value: Any) -> str:
    if value is None:
        return DASH
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}".replace("-", MINUS)
    if isinstance(value, Mapping):
        return ", ".join(f"{_spaced(k)} {_cell(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_cell(v) for v in value)
    return str(value)


def document(title: str, top: Markup, parts: Sequence[Markup]) -> str:
    """A whole page in one file: its style, the header ``top``, and its parts."""
    style = resources.files("holdfast.report").joinpath("style.css").read_text("utf-8")
    head = join([
        Markup('<meta charset="utf-8">'),
        Markup('<meta name="viewport" content="width=device-width, initial-scale=1">'),
        element("title", title),
        element("style", Markup(style)),
    ])  # fmt: skip
    body = element("main", *parts)
    foot = element("footer", element("p", f"Written by holdfast {__version__}."))
    return f'<!DOCTYPE html>\n<html lang="en">\n<head>\n{head}\n</head>\n<body>\n' + (
        f"{top}\n{body}\n{foot}\n</body>\n</html>\n"
    )
