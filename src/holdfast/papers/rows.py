"""The record of one judged statement, and how a verdict follows from numbers."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

VERDICTS = (
    "reproduced",
    "holds",
    "fails",
    "not reproduced",
    "proof read only",
    "unstated",
)
LONGEST = 150
DEVIATIONS = 3.0
"""A paper shows one run of ours: three standard deviations over seeds hold 99.7 % of them."""
SLACK = 0.005
"""Where the spread is smaller than this share, what a paper leaves unsaid moves the third digit."""


@dataclass(frozen=True)
class Row:
    """A statement of a paper beside what this run found.

    ``id`` is the paper's own name of it, ``paper`` its number or claim, ``ours`` what was
    computed, ``spread`` the standard deviation over seeds where there are seeds. A verdict of
    "proof read only" or "unstated" needs a ``note`` that says why.
    """

    id: str
    what: str
    paper: Any
    ours: Any
    spread: Any
    verdict: str
    note: str = ""

    def __post_init__(self):
        if self.verdict not in VERDICTS:
            raise ValueError(f"{self.id}: {self.verdict!r} is none of {VERDICTS}")
        if len(self.what) >= LONGEST:
            raise ValueError(f"{self.id}: what has {len(self.what)} characters")
        if self.verdict in ("proof read only", "unstated") and not self.note:
            raise ValueError(f"{self.id}: {self.verdict} without a reason")

    def as_dict(self) -> dict[str, Any]:
        """The seven fields by name."""
        return asdict(self)


@dataclass(frozen=True)
class Study:
    """All rows of a paper, and its figures as a function: name to matplotlib figure."""

    rows: tuple[Row, ...]
    figures: Callable[[], dict[str, Any]]


Truth = bool | np.bool_
"""What a comparison of NumPy numbers gives."""


def claim(id: str, what: str, paper: Any, ours: Any, holds: Truth, note: str = "") -> Row:
    """A statement that is true or false of what was computed."""
    return Row(id, what, paper, _plain(ours), None, "holds" if holds else "fails", note)


def claim_over_seeds(id: str, what: str, paper: Any, per_seed, holds: Truth, note: str = "") -> Row:
    """A statement judged on a number per seed, given by its mean and standard deviation."""
    mean, spread = _over_seeds(per_seed)
    return Row(id, what, paper, mean, spread, "holds" if holds else "fails", note)


def figure(id: str, what: str, paper: Any, per_seed, shows: Truth, note: str = "") -> Row:
    """What a figure shows, judged on numbers per seed."""
    mean, spread = _over_seeds(per_seed)
    return Row(id, what, paper, mean, spread, "reproduced" if shows else "not reproduced", note)


def number(id: str, what: str, paper: Any, per_seed, note: str = "", slack: float = SLACK) -> Row:
    """A paper's number, or list of numbers, beside ours over seeds (first axis).

    "reproduced" where every one lies within `DEVIATIONS` standard deviations of our mean, or
    within the share ``slack`` of itself.
    """
    mean, spread = _over_seeds(per_seed)
    target = np.asarray(paper, float)
    allowed = np.maximum(DEVIATIONS * np.asarray(spread), slack * np.abs(target))
    close = np.abs(np.asarray(mean) - target) <= allowed
    verdict = "reproduced" if np.all(close) else "not reproduced"
    return Row(id, what, paper, mean, spread, verdict, note)


def read_only(id: str, what: str, paper: Any, note: str, ours: Any = None) -> Row:
    """A statement that nothing in the run decides; ``note`` says why."""
    return Row(id, what, paper, _plain(ours), None, "proof read only", note)


def unstated(id: str, what: str, ours: Any, note: str) -> Row:
    """What the paper leaves out, and what was chosen."""
    return Row(id, what, None, _plain(ours), None, "unstated", note)


def _over_seeds(per_seed) -> tuple[Any, Any]:
    values = np.asarray(per_seed, float)
    if len(values) < 2:
        raise ValueError("a spread needs two seeds or more")
    return _plain(values.mean(0)), _plain(values.std(0, ddof=1))


def _plain(value: Any) -> Any:
    """The same as plain numbers and lists."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return value
