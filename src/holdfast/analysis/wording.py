"""Names, directions and bounds in words."""

from collections.abc import Iterable

import numpy as np

SHOWN = 3
"""Names that a sentence lists."""


def between(lower: float, upper: float) -> str:
    """A ratio that lies between two bounds."""
    if lower == np.inf:
        return "infinite"
    if upper == np.inf:
        return f"over {lower:.3g}"
    ends = f"{lower:.3g}", f"{upper:.3g}"
    return ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"


def combination(vector: np.ndarray, names: Iterable[str]) -> str:
    """A direction in words: the largest entry taken as 1, what is under 1e-6 of it left out.

    The sign is such that the first name has none.
    """
    vector = vector / vector[np.argmax(np.abs(vector))]
    first = vector[np.abs(vector) > 1e-6][0]
    text = ""
    for value, name in zip(-vector if first.real < 0 else vector, names, strict=True):
        if abs(value) <= 1e-6:
            continue
        real = abs(value.imag) <= 1e-6 * abs(value)
        size = f"{abs(value):.3g} " if real else f"({value:.3g}) "
        minus = real and value.real < 0
        text += (" - " if minus else " + ") * bool(text) + ("" if size == "1 " else size) + name
    return text


def steps(count: int) -> str:
    """So many steps."""
    return f"{count} step{'s' if count != 1 else ''}"


def either(names: Iterable[str]) -> str:
    """Quoted names, one of which will do."""
    return joined([f'"{name}"' for name in names], "or")


def listed(names: Iterable[str]) -> str:
    """Names, all of which are meant."""
    return joined(list(names), "and")


def joined(names: list[str], word: str) -> str:
    """A list in words, `SHOWN` names at most."""
    shown = names[:SHOWN] + ([f"{len(names) - SHOWN} more"] if len(names) > SHOWN else [])
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} {word} {shown[-1]}"
