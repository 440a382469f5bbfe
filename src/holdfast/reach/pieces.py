"""Stretches of steps, and what is certified of the errors in them."""

import math
from typing import NamedTuple

import numpy as np

from holdfast.numerics.attack_sets import MOST, attacks, unknowns
from holdfast.numerics.multipliers import Certificate, Long, certificate, descended, evenly, factors
from holdfast.numerics.quadratic_reach import largest, outer
from holdfast.reach.setting import Setting

SHOWN = 15
"""Turns after which a bound of its own is computed for a step."""
SLACK, LONG_SLACK = 2e-4, 5e-3
"""What the largest of several bounds may be above the largest one computed to the end: where the
attacks can be written out, and over longer stretches."""


class Piece(NamedTuple):
    """The steps first + 1 .. last, from an ellipsoid with the factor ``start`` that holds
    e_first; without it e_first is 0.
    """

    first: int
    last: int
    start: np.ndarray | None


class Bounds(NamedTuple):
    """``upper`` >= the largest |functional e_k| >= ``lower``, and what proves the upper one."""

    upper: float
    lower: float
    held: Certificate


def stretch(setting: Setting, piece: Piece, tight: bool = False) -> Long:
    """The attacks over a piece, within what the detector allows."""
    m, index = setting.moves(piece.last - piece.first, piece.first)
    limits = setting.stealth.limits(piece.last, piece.first, setting.blocks, tight)
    return Long(m, index, limits.w, limits.b, piece.start)


def small(of: Long) -> bool:
    """Whether the attacks can be written out and their cone programs solved exactly."""
    return of.start is None and unknowns(of) <= MOST


def bounds(
    setting: Setting, piece: Piece, of: Long, k: int, share: np.ndarray | None = None
) -> Bounds | None:
    """Both bounds at k; None where no attack moves it at all. ``share``: multipliers to begin at.

    From below by an attack that begins with the piece: where the piece starts in an ellipsoid
    nobody says that its far ends can be reached.
    """
    place, functional = k - piece.first, setting.functional
    if not small(of):
        if of.start is None and unknowns(of) == 0:
            return None
        above = descended(of, functional, place, share)
        if of.start is None:
            return Bounds(above.upper, above.lower, above.held)
        below = descended(of._replace(start=None), functional, place)
        return Bounds(above.upper, below.lower, above.held)
    found = attacks(of)
    B = functional @ found.errors[place - 1]
    if not np.any(B):
        return None
    both = largest(found.Z, found.w, found.b, B)
    return Bounds(both.upper, both.lower, certificate(of, np.append(both.mu * of.b, 0.0)))


class Highest(NamedTuple):
    """The largest upper bound over some steps, and the step it is of."""

    value: float
    k: int


def highest(setting: Setting, piece: Piece, steps: range, limit: float = np.inf) -> Highest:
    """The largest of the upper bounds at ``steps``, without computing all of them.

    Once one is known, of every other step it only has to be shown that its bound is no larger, or
    larger by `SLACK` at most. With a ``limit`` that is what has to be shown of all, and the first
    step of which it is not true ends the search: the value is then a bound that is not tight.
    """
    of = stretch(setting, piece)
    share = evenly(of)
    places = np.array(steps) - piece.first - 1
    rough = sizes_of(setting, of, certificate(of, share))[places]
    value, slack = 0.0, SLACK if unknowns(of) <= MOST else LONG_SLACK
    while True:
        i = int(np.argmax(rough))
        bar = limit if np.isfinite(limit) else value * (1.0 + slack)
        if rough[i] <= bar:
            return Highest(float(rough[i]), steps[i])
        place = int(places[i]) + 1
        shown = descended(of, setting.functional, place, share, bar, limit, SHOWN)
        share = shown.held.share
        rough = np.minimum(rough, sizes_of(setting, of, shown.held)[places])
        if rough[i] <= bar:
            continue
        if shown.lower > limit and piece.start is None:
            return Highest(float(rough[i]), steps[i])
        rough[i] = min(rough[i], _above(setting, piece, of, steps[i], share, bar))
        value = max(value, float(rough[i]))
        if rough[i] > limit:
            return Highest(float(rough[i]), steps[i])


def _above(setting, piece: Piece, of: Long, k: int, share: np.ndarray, bar: float) -> float:
    """The upper bound at k, computed to the end or until it is under ``bar``."""
    if unknowns(of) > MOST:
        return descended(of, setting.functional, k - piece.first, share, bar).upper
    found = attacks(of)
    B = setting.functional @ found.errors[k - piece.first - 1]
    return math.sqrt(outer(found.Z, found.w, found.b, B).value) if np.any(B) else 0.0


def sizes_of(setting: Setting, of: Long, held: Certificate) -> np.ndarray:
    """What one certificate says of every step."""
    return np.linalg.norm(setting.functional @ factors(of, held), 2, axis=(1, 2))
