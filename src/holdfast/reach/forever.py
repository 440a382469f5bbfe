"""Bounds that hold at every step of a periodic policy, however long the attack lasts."""

import math
from typing import NamedTuple

import numpy as np

from holdfast.numerics.attack_sets import MOST, unknowns
from holdfast.numerics.attackable import growth
from holdfast.numerics.multipliers import Certificate, Long, certificate, descended, evenly, factors
from holdfast.numerics.reachability import forward
from holdfast.reach.pieces import Highest, Piece, highest, sizes_of, stretch
from holdfast.reach.setting import Setting

LONGEST = 2000
"""Steps of a period that is looked at."""
FAR = 256
"""Steps that are looked at in one piece where there is a choice."""
TURNS = 400
"""Periods after which a set that still grows is given up."""
SETTLED = 1.0 + 1e-6
"""Growth over a period from which on the limit is near."""
MARGINS = (1.0 + 1e-6, 1.0 + 1e-4, 1.0 + 1e-3)
"""What the set is enlarged by so that it is not below its limit."""
ROUGH = 1e-3
"""Relative change of a set's size that is not worth another round."""
FEW = 12
"""Turns of the multipliers where only a choice hangs on them."""
PARTS = np.geomspace(3e-3, 0.1, 3)
"""What a step may take of a certificate, tried one after the other."""
ROUNDS = 6
"""Times that the multipliers and the set that they keep are chosen in turn."""


class Forever(NamedTuple):
    """``bounded``: whether the error stays bounded for ever, decided by ``radius``, the largest
    modulus per step of what can be moved unseen (under 1: bounded); None where the period is too
    long to look at. Never with ``sprt``, whose bound has no limit, unless nothing can be moved.

    ``kept``: a factor of an ellipsoid that holds e_after and every e a whole number of periods
    later; None where there is none, ``reason`` says why.
    """

    period: int
    radius: float
    bounded: bool | None
    after: int
    kept: np.ndarray | None
    reason: str | None


def forever(setting: Setting) -> Forever:
    """The periodic steady state: a set that a period maps into itself, and what follows from it.

    The set is the fixed point of the period map of the recursion with multipliers that fade from
    period to period: W <- Y(W / mu_0; mu_1 .. mu_L), sum mu_j b_j = 1. What the map of a period
    sends into itself holds the error for ever, once it holds it at one step.
    """
    period = setting.period
    if setting.enforced is not None:
        return _none(setting, period, math.nan, None, "the policy is a table that ends")
    if period > LONGEST:
        return _none(setting, period, math.nan, None, f"the period of {period} steps is too long")
    s = setting.system
    found = growth(s.A, s.C, s.K, setting.alterable(period, setting.after), aware=setting.aware)
    if found.unbounded:
        why = f"a mode of modulus {found.radius:.6g} can be moved unseen"
        return _none(setting, period, found.radius, False, why)
    if setting.stealth.detector == "sprt":
        why = "the bound of a sum of residuals grows with its length, beyond every limit"
        still = not np.any(setting.moves(period, setting.after)[0].B)
        return _none(setting, period, found.radius, still, why)
    kept = _kept(setting, period)
    if kept is None:
        return _none(setting, period, found.radius, True, "no set was found that a period keeps")
    return Forever(period, found.radius, True, setting.after, kept, None)


def _none(setting, period, radius, bounded, reason) -> Forever:
    return Forever(period, radius, bounded, setting.after, None, reason)


def _kept(setting: Setting, period: int) -> np.ndarray | None:
    """A factor of a set that holds e at `after` and that a period maps into itself.

    First with multipliers that fade evenly, then with those that suit the worst step of the
    period, chosen in turn with the set. Every one of them is sound; the best is taken.
    """
    after, n = setting.after, len(setting.system.A)
    of = stretch(setting, Piece(after, after + period, np.eye(n)))
    first = _fading_away(setting, of)
    best, least = None, math.inf
    for part in PARTS:
        kept = _fixed(of, certificate(of, _fading(len(of.b), part, period)), first)
        if kept is not None and (size := _largest(setting, of, kept)[0]) < least:
            best, least = kept, size
    if best is None:
        return None
    for _ in range(ROUNDS):
        kept = _fixed(of, _suited(setting, of, best), first)
        if kept is None or (size := _largest(setting, of, kept)[0]) >= least * (1.0 - ROUGH):
            break
        best, least = kept, size
    return best * _held(setting, best)


def _fading(count: int, part: float, period: int) -> np.ndarray:
    """Shares of ``count`` limits and of what came before: each step takes ``part`` of the rest."""
    fade = part * (1.0 - part) ** np.arange(period)[::-1]
    groups = max(1, count // period)
    return np.append(np.resize(fade, count) / groups, (1.0 - part) ** period)


def _fading_away(setting: Setting, of: Long) -> np.ndarray:
    """A factor of a set that holds e at `after`, where a period's moves do not reach all of it:
    what could be moved before the policy began, and can no more. Else zero.
    """
    n = len(setting.system.A)
    nothing = np.zeros((n, n))
    early = stretch(setting, Piece(0, setting.after, None)) if setting.after else None
    if early is None or unknowns(early) == 0:
        return nothing
    held = descended(early, np.eye(n), setting.after, rounds=FEW).held
    first = factors(early, held)[-1]
    even = certificate(of, evenly(of))
    W = nothing
    for _ in range(n):
        W = _after(of, even, W)
    return nothing if np.isfinite(_ratio(first, W)) else first


def _fixed(of: Long, held: Certificate, more: np.ndarray) -> np.ndarray | None:
    """A set that the period map with this certificate sends into itself, just above the limit of
    those reached from nothing, ``more`` (a factor) being added to each; None where these grow on.
    """
    W = np.zeros_like(held.start)
    for _ in range(TURNS):
        new = _after(of, held, W)
        if np.any(more):
            new = np.asarray(np.linalg.qr(np.hstack([new, more]).T, mode="r")).T
        if not np.all(np.isfinite(new)):
            return None
        if _ratio(new, W) <= SETTLED:
            for margin in MARGINS:
                # larger by a little everywhere, and what the attacker adds is not: it shrinks
                if _ratio(_after(of, held, new * margin), new * margin) <= 1.0:
                    return new * margin
        W = new
    return None


def _after(of: Long, held: Certificate, W: np.ndarray) -> np.ndarray:
    """A factor of the set after a period, from one of the set before it."""
    start = W / np.sqrt(float(held.share[-1]))
    return forward(of.m, of.sets, held.weights, start)[-1]


def _ratio(inner: np.ndarray, outer: np.ndarray) -> float:
    """The least t with inner inner' <= t^2 outer outer', inf where there is none."""
    unit = _units(outer, inner)
    outer, inner = outer / unit, inner / unit
    found, *_ = np.linalg.lstsq(outer, inner, rcond=1e-13)
    left = np.linalg.norm(outer @ found - inner)
    return np.inf if left > 1e-9 * np.linalg.norm(inner) else float(np.linalg.norm(found, 2))


def _units(*of: np.ndarray) -> np.ndarray:
    """Units of the states (n x 1) in which the rows of factors are of size one, or zero."""
    sizes = np.linalg.norm(np.hstack(of), axis=1, keepdims=True)
    return np.where(sizes > 0, sizes, 1.0)


def _largest(setting: Setting, of: Long, kept: np.ndarray) -> tuple[float, int]:
    """The largest error within a period that starts in the set, roughly, and its step."""
    of = of._replace(start=kept)
    sizes = sizes_of(setting, of, certificate(of, evenly(of)))
    place = int(np.argmax(sizes)) + 1
    return descended(of, setting.functional, place, rounds=FEW).upper, place


def _suited(setting: Setting, of: Long, kept: np.ndarray) -> Certificate:
    """The certificate of the period map that serves the worst step best, given the set.

    What matters of the error after a period is what becomes of it at that step of the next one;
    a little of the rest keeps the set from growing where that does not look.
    """
    of = of._replace(start=kept)
    _, place = _largest(setting, of, kept)
    grown = np.eye(len(kept))
    for which in of.sets[:place]:
        grown = np.asarray(of.m.F)[which] @ grown
    on = setting.functional @ grown
    weak = 1e-3 * np.linalg.norm(on, 2) * np.eye(len(kept))
    return descended(of, np.vstack([on, weak]), len(of.sets), rounds=FEW).held


def _held(setting: Setting, kept: np.ndarray) -> float:
    """What the set has to be multiplied by to hold every e at `after`; at least 1."""
    after = setting.after
    if after == 0:
        return 1.0
    of = stretch(setting, Piece(0, after, None))
    if unknowns(of) == 0:
        return 1.0
    unit = _units(kept)
    goal = np.linalg.pinv(kept / unit) / unit.T
    return max(1.0, descended(of, goal, after, enough=1.0).upper)


def worst(setting: Setting, found: Forever, limit: float = math.inf) -> Highest | None:
    """The largest error at any step ever, from above; None where no set is kept.

    Over the first steps from the start itself; from then on over a period that one whole period
    lies before, or as many as can be written out, from the set that all of them keep. Over
    ``limit`` the first bound that is will do.
    """
    if found.kept is None:
        return None
    width, period = max(1, int(np.sum(setting.compromised))), found.period
    before = max(MOST // width // period - 1, min(1, FAR // period - 1), 0) * period
    early = found.after + before
    last = early + found.period
    piece = Piece(found.after, last, found.kept)
    top = highest(setting, piece, range(early + 1, last + 1), limit)
    if early and top.value <= limit:
        top = max(top, highest(setting, Piece(0, early, None), range(1, early + 1), limit))
    return top
