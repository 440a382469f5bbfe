"""The BATADAL water network (hourly SCADA): its logs, and how the competition scored an alarm."""

import datetime
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from holdfast.shell.errors import InputError

FLAG = "ATT_FLAG"
FORMAT = "%d/%m/%y %H"
GAMMA = 0.5
"""Weight of the time to detection in the competition's score."""


class Scada(NamedTuple):
    """Hours in order: signals by name, the hour of the day, and which hours are attacked."""

    signals: dict[str, np.ndarray]
    hour: np.ndarray
    attacked: np.ndarray


class Scored(NamedTuple):
    """The competition's score S = gamma S_TTD + (1 - gamma) S_CLF and what it is made of.

    ``detection`` S_TTD = 1 - mean(time to detection / length) over the attacks, an attack that
    is not detected counting whole; ``classification`` S_CLF = (TPR + TNR) / 2 over hours.
    ``delays``: hours to the first alarm of every attack, inf where there is none.
    """

    score: float
    detection: float
    classification: float
    true_positive: float
    true_negative: float
    delays: tuple[float, ...]


def read_scada(path: str | Path) -> Scada:
    """A BATADAL file. Raises `InputError` for one that is none."""
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "", str(error), "a BATADAL file (CSV)") from None
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    if names[:1] != ["DATETIME"] or FLAG not in names:
        raise InputError(path, "", f"columns {names[:3]}", f"DATETIME, signals and {FLAG}")
    times, rows = [], []
    for number, line in enumerate(lines[1:], 2):
        cells = line.split(",")
        try:
            times.append(datetime.datetime.strptime(cells[0].strip(), FORMAT))
            rows.append([float(cell) for cell in cells[1:]])
        except ValueError as error:
            raise InputError(path, f"line {number}", str(error), "a time and numbers") from None
        if len(cells) != len(names):
            raise InputError(path, f"line {number}", f"{len(cells)} cells", f"{len(names)}")
    step = datetime.timedelta(hours=1)
    for number, (one, two) in enumerate(itertools.pairwise(times), 3):
        if two - one != step:
            raise InputError(path, f"line {number}", f"{two - one} after", "an hour")
    values = np.array(rows).T
    columns = dict(zip(names[1:], values, strict=True))
    attacked = columns.pop(FLAG) == 1
    return Scada(columns, np.array([time.hour for time in times]), attacked)


def scored(alarm: ArrayLike, attacked: ArrayLike) -> Scored:
    """Alarms by the hour against the hours attacked.

    Source: Taormina and others, Battle of the Attack Detection Algorithms, J. Water Resources
    Planning and Management 144 (2018), eqs. 1 to 4.
    """
    alarm, attacked = np.asarray(alarm, bool), np.asarray(attacked, bool)
    delays, shares = [], []
    for first, last in _spans(attacked):
        hits = np.flatnonzero(alarm[first:last])
        delays.append(float(hits[0]) if len(hits) else np.inf)
        shares.append(min(delays[-1] / (last - first), 1.0))
    detection = 1.0 - float(np.mean(shares))
    positive, negative = float(alarm[attacked].mean()), float((~alarm[~attacked]).mean())
    classification = (positive + negative) / 2
    score = GAMMA * detection + (1 - GAMMA) * classification
    return Scored(score, detection, classification, positive, negative, tuple(delays))


def _spans(mask: np.ndarray) -> Sequence[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
