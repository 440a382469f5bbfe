"""A log put on the plant's time grid: times checked, gaps filled, inputs held."""

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from holdfast.records import Observation, Status
from holdfast.shell.columns import Columns
from holdfast.shell.errors import InputError

JITTER = 0.1
"""Share of dt by which a row may miss its time."""
MOST_ROWS = 20_000_000
"""Rows of a log, the filled ones included."""


@dataclass(frozen=True)
class Log:
    """A log on the plant's grid: one row per step.

    ``time`` (T,) in seconds; ``observation`` with time along the leading axis; ``filled``
    (T,) marks rows that were not in the file (nothing arrived in them).
    """

    time: np.ndarray
    observation: Observation
    filled: np.ndarray | None = None


def on_grid(path: str | Path, columns: Columns, dt: float) -> Log:
    """The log with skipped rows filled in, inputs held and gaps marked; times checked."""
    place = _places(path, columns.time, dt)
    count = int(place[-1]) + 1
    filled = np.ones(count, bool)
    filled[place] = False

    def spread(values: np.ndarray) -> np.ndarray:
        if count == len(values):
            return values
        out = np.zeros((count, *values.shape[1:]), values.dtype)
        out[place] = values
        return out

    sent = spread(columns.sent)
    u = _held(spread(columns.u), sent)
    seen = spread(columns.seen)
    missing = filled | ~np.all(sent, 1)
    observation = Observation(
        u=jnp.asarray(u),
        y=jnp.asarray(np.where(seen, spread(columns.y), 0.0)),
        seen=jnp.asarray(seen),
        trusted=jnp.asarray(spread(columns.trusted) & seen),
        status=jnp.asarray(np.where(missing, int(Status.MISSING), 0).astype(np.int32)),
    )
    time = np.interp(np.arange(count), place, columns.time) if count > len(place) else columns.time
    return Log(time, observation, filled)


def _places(path: str | Path, time: np.ndarray, dt: float) -> np.ndarray:
    """The row of the grid that each row of the file is; time checked.

    A row is off where it is more than `JITTER` of dt off both the row before it and the grid
    that starts at the first row: stamps that scatter and clocks that drift both pass.
    """
    step = np.diff(time)
    back = np.flatnonzero(step <= 0)
    if len(back):
        i = back[0]
        raise InputError(
            path,
            f"row {i + 2}, column 'time'",
            f"{float(time[i + 1])!r} after {float(time[i])!r}",
            "time that runs forwards",
        )
    if (time[-1] - time[0]) / dt > MOST_ROWS:
        worst = int(np.argmax(step))
        raise InputError(
            path,
            f"row {worst + 2}, column 'time'",
            f"a step of {step[worst]:.6g} s in a log of {time[-1] - time[0]:.6g} s",
            f"at most {MOST_ROWS} rows of dt = {dt:g} s",
        )
    rows = np.rint(step / dt)
    place = np.concatenate([[0.0], np.cumsum(rows)])
    from_before = np.abs(step - np.maximum(rows, 1) * dt)
    from_grid = np.abs(time - time[0] - place * dt)[1:]
    slack = JITTER * dt * (1 + 1e-9) + 4 * np.spacing(np.max(np.abs(time)))
    off = np.flatnonzero((rows < 1) | ((from_before > slack) & (from_grid > slack)))
    if len(off):
        i = off[0]
        raise InputError(
            path,
            f"row {i + 2}, column 'time'",
            f"{float(time[i + 1])!r}, {step[i]:.6g} s after the row before",
            f"a whole number of steps of dt = {dt:g} s, to 10 %",
        )
    return place.astype(int)


def nearest_samples(
    time: np.ndarray, first: float, rows: int, dt: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """Of samples at ``time`` the one nearest to each row of a grid: which rows have one, which
    samples those are, and how many samples lay within half a row of any.
    """
    row = np.rint((time - first) / dt).astype(int)
    candidates = np.flatnonzero((row >= 0) & (row < rows))
    distance = np.abs(time - first - dt * row)
    nearest_first = candidates[np.lexsort((distance[candidates], row[candidates]))]
    taken, which = np.unique(row[nearest_first], return_index=True)
    return taken, nearest_first[which], len(candidates)


def _held(u: np.ndarray, sent: np.ndarray) -> np.ndarray:
    """Inputs that were not sent hold the last finite value before them; 0 before the first."""
    known = sent & np.isfinite(u)
    last = np.maximum.accumulate(np.where(known, np.arange(len(u))[:, None], -1), 0)
    before = np.where(last < 0, 0.0, np.take_along_axis(u, np.maximum(last, 0), 0))
    return np.where(sent, u, before)
