"""The columns of a log, whatever file they stand in: which there are, and what they hold."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from holdfast.parts import Plant
from holdfast.shell.errors import InputError, did_you_mean, one_of

RESULT_PREFIXES = frozenset({"x", "x_sd", "d", "d_sd", "a", "alarm", "p"})

Column = tuple[np.ndarray, np.ndarray]
"""One number per row, and whether it arrived."""


@dataclass(frozen=True)
class Columns:
    """What a file holds, one row per sample; ``sent`` and ``seen``: what arrived of u and y."""

    time: np.ndarray
    u: np.ndarray
    y: np.ndarray
    sent: np.ndarray
    seen: np.ndarray
    trusted: np.ndarray


def columns_of(
    path: str | Path, header: Sequence[str], plant: Plant, extra: Sequence[str] = ()
) -> dict[str, int]:
    """Where each column that is needed or optional stands; every other one looked at."""
    needed = ["time", *(f"u:{n}" for n in plant.inputs), *(f"y:{n}" for n in plant.outputs)]
    optional = [f"trusted:{n}" for n in plant.outputs] + list(extra)
    where: dict[str, int] = {}
    for i, name in enumerate(header):
        if name in needed or name in optional:
            if name in where:
                raise InputError(path, f"column {name!r}", "it twice", "it once")
            where[name] = i
        elif ":" in name and name.split(":")[0] not in RESULT_PREFIXES:
            raise InputError(
                path, f"column {name!r}", "an unknown column", one_of([*needed, *optional], name)
            )
    for name in needed:
        if name not in where:
            close = did_you_mean(name, [h for h in header if h not in where])
            found = f"no such column, but {close!r}" if close else "no such column"
            raise InputError(path, f"column {name!r}", found, f"the header {','.join(needed)}")
    return where


def assembled(
    path: str | Path, plant: Plant, present: Collection[str], numbers: Callable[[str], Column]
) -> Columns:
    """Every column of the plant; ``present`` says which optional ones there are."""
    time, given = numbers("time")
    bad = np.flatnonzero(~given | ~np.isfinite(time))
    if len(bad):
        found = "an empty cell" if not given[bad[0]] else str(time[bad[0]])
        raise InputError(path, f"row {bad[0] + 1}, column 'time'", found, "seconds")
    rows = len(time)

    def side(letter: str, names: tuple[str, ...]) -> Column:
        values, arrived = np.zeros((rows, len(names))), np.ones((rows, len(names)), bool)
        for j, name in enumerate(names):
            values[:, j], arrived[:, j] = numbers(f"{letter}:{name}")
        return values, arrived

    u, sent = side("u", plant.inputs)
    y, seen = side("y", plant.outputs)
    trusted = np.zeros(y.shape, bool)
    for j, name in enumerate(plant.outputs):
        column = f"trusted:{name}"
        if column in present:
            trusted[:, j] = flags(path, column, *numbers(column))
    return Columns(time, u, y, sent, seen, trusted)


def flags(path: str | Path, name: str, values: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Cells of 0 and 1 as truth; an empty one is 0."""
    bad = np.flatnonzero(given & (values != 0) & (values != 1))
    if len(bad):
        raise InputError(path, f"row {bad[0] + 1}, column {name!r}", str(values[bad[0]]), "0 or 1")
    return given & (values == 1)
