"""Scores of what a bank of modes believes in, against the mode that was true."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from holdfast.evaluate.scores import Share, share


class Spell(NamedTuple):
    """Rows ``first`` to ``last`` through which ``mode`` was true without a break.

    ``right``: the share of them in which it was believed in. ``delay``: rows from the first
    until it was, inf where it never was.
    """

    mode: int
    first: int
    last: int
    right: Share
    delay: float


def accuracy(believed: ArrayLike, truth: ArrayLike) -> Share:
    """The share of the rows with a true mode (not negative) in which it was believed in.

    Shapes (time) or (run, time). The interval takes the rows as independent, which those of a
    bank that remembers are not.
    """
    believed, truth = np.asarray(believed), np.asarray(truth)
    known = truth >= 0
    return share(int(np.sum(known & (believed == truth))), int(np.sum(known)))


def spells(believed: ArrayLike, truth: ArrayLike) -> list[Spell]:
    """Every spell of one run, in order of time; rows without a true mode belong to none."""
    believed, truth = np.asarray(believed), np.asarray(truth)
    edges = np.flatnonzero(np.diff(truth)) + 1
    found = []
    for first, stop in zip([0, *edges], [*edges, len(truth)], strict=True):
        if stop > first and truth[first] >= 0:
            right = believed[first:stop] == truth[first]
            delay = float(np.argmax(right)) if np.any(right) else np.inf
            counted = share(int(np.sum(right)), int(stop - first))
            found.append(Spell(int(truth[first]), int(first), int(stop - 1), counted, delay))
    return found
