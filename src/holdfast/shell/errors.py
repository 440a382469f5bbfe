"""What a user did wrong, in one line: which file, which key, what was found, what was expected."""

import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

SHOWN = 80
"""Characters of a found value that a message shows."""


class InputError(Exception):
    """Input that cannot be used: ``FILE: KEY: found X, expected Y``, always on one line."""

    def __init__(self, file: str | Path, key: str, found: str, expected: str):
        parts = [str(file), key] if key else [str(file)]
        line = f"{': '.join(parts)}: found {found}"
        super().__init__(one_line(f"{line}, expected {expected}" if expected else line))
        self.file, self.key, self.found, self.expected = str(file), key, found, expected


def one_line(text: str) -> str:
    """The text without line breaks or control characters."""
    return "".join(c if c.isprintable() else " " for c in text)


def shown(value: Any) -> str:
    """A value as a message quotes it: short, and never raising."""
    try:
        text = repr(value)
    except (RecursionError, ValueError):
        text = f"a {type(value).__name__}"
    return text if len(text) <= SHOWN else text[: SHOWN - 3] + "..."


def one_of(names: Iterable[str], found: str = "") -> str:
    """``'a', 'b' or 'c'`` and, where one of them is close to ``found``, "did you mean"."""
    names = list(names)
    if not names:
        return "none: there is nothing to name"
    listed = ", ".join(map(repr, names[:30])) + (", ..." if len(names) > 30 else "")
    close = did_you_mean(found, names)
    expected = listed if len(names) == 1 else f"one of {listed}"
    return f"{expected}; did you mean {close!r}?" if close else expected


def did_you_mean(found: str, names: Iterable[str]) -> str | None:
    """The name that ``found`` most likely stands for, if any is close."""
    by_lower = {name.lower(): name for name in names}
    wrong = found.lower()[:200]
    # letters in the wrong order come first: "td" is "dt" and not "d"
    swapped = [name for name in by_lower if sorted(name) == sorted(wrong)]
    close = swapped or difflib.get_close_matches(wrong, by_lower, n=1)
    return by_lower[close[0]] if close else None
