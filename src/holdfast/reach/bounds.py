"""The largest expected error at every step, from above and from below."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from holdfast.numerics.multipliers import Long, factors
from holdfast.numerics.reachability import backward, forward, joined
from holdfast.parts import InvalidValue
from holdfast.reach.forever import FAR, Forever, forever
from holdfast.reach.pieces import Piece, bounds, stretch
from holdfast.reach.setting import Setting

CLOSED = 1e-6
"""Relative distance of the two bounds under which they count as one number."""


class Reach(NamedTuple):
    """For each k (t,): ``norm``, the largest |functional e_k| over the stealthy attacks, bounded
    from above, and ``lower``, what an attack that was found reaches; ``exact`` where they agree.

    ``shape`` (t x n x n): Y_k with e' Y_k^+ e <= 1 for every e_k. ``horizon``: the t whose
    constraint is used; ``alpha``: the bound of the residuals at it.
    """

    k: np.ndarray
    alpha: np.ndarray
    norm: np.ndarray
    lower: np.ndarray
    exact: np.ndarray
    shape: np.ndarray
    horizon: np.ndarray


def reach(setting: Setting, steps: int, tight: bool = False) -> Reach:
    """What a stealthy attacker reaches at the steps 1 .. ``steps``.

    For ``sprt`` the sum up to the horizon alone is bounded: Y_k = alpha(t)^2 (W_k^-1 + S_k)^-1 by
    the recursion, exact. ``tight`` adds the sums that end before it. Every other detector bounds
    more than one sum, and each k has cone programs of its own.

    Raises `InvalidValue` where ``tight`` is asked for more steps than can be written out.

    Source: INTEGRITY, Theorem 7 and (59), (61), corrected.
    """
    if setting.stealth.detector == "sprt" and not tight:
        return _sums(setting, steps)
    return _each(setting, steps, tight)


def _sums(setting: Setting, steps: int) -> Reach:
    """The sum constraint at the horizon, exactly.

    An attacker who does not know the policy has to meet it too, and has to be ready for a block
    behind k: whatever he does, its residuals count. The tighter of the two.
    """
    horizon = setting.horizons(steps) - setting.blocks
    last = int(horizon[-1])
    m, index = setting.moves(last)
    told = m.ahead.reshape(-1, m.F.shape[1])
    m, ones = m._replace(ahead=m.ahead[:0]), np.ones((last, 1))
    ends = np.zeros(last, np.int32)
    ends[horizon - 1] = 1
    L = forward(m, index, ones, np.zeros(m.F.shape[1:]))[:steps]
    found = _summed(setting, L, backward(m, index, ones, ends)[:steps], horizon)
    if setting.aware:
        return found
    padded = np.vstack([told, np.zeros(m.F.shape[1:])])
    T = np.tile(np.linalg.qr(padded, mode="r"), (steps, 1, 1))
    ready = _summed(setting, L, T, found.k + setting.blocks)
    less = ready.norm < found.norm
    tighter = (
        np.where(less.reshape(-1, *[1] * (x.ndim - 1)), x, y)
        for x, y in zip(ready, found, strict=True)
    )
    return Reach(*tighter)


def _summed(setting: Setting, L: np.ndarray, T: np.ndarray, horizon: np.ndarray) -> Reach:
    """Y_k = alpha(t)^2 (W_k^-1 + S_k)^-1 of factors of W_k and S_k."""
    alpha = setting.stealth.alpha(horizon)
    factors = joined(L, T) * alpha[:, None, None]
    norm = np.linalg.norm(setting.functional @ factors, 2, axis=(1, 2))
    shape = factors @ np.swapaxes(factors, 1, 2)
    exact = np.ones(len(L), bool)
    return Reach(np.arange(1, len(L) + 1), alpha, norm, norm, exact, shape, horizon)


def _each(setting: Setting, steps: int, tight: bool) -> Reach:
    """A bound for each residual, window or sum: every k on its own."""
    n = len(setting.system.A)
    horizon = setting.horizons(steps)
    norm, lower, exact = np.zeros(steps), np.zeros(steps), np.ones(steps, bool)
    shape = np.zeros((steps, n, n))
    share = None
    for piece, of, ks, like in stretches(setting, steps, tight):
        for k in ks:
            i = k - 1
            if like:
                for values in (norm, lower, exact, shape):
                    values[i] = values[i - like]
                continue
            both = bounds(setting, piece, of, k, _moved_on(share, of))
            if both is None:
                continue
            share = both.held.share
            norm[i], lower[i] = both.upper, both.lower
            exact[i] = both.upper - both.lower <= CLOSED * both.upper
            half = factors(of, both.held)[k - piece.first - 1]
            shape[i] = half @ half.T
    alpha = setting.stealth.alpha(horizon)
    return Reach(np.arange(1, steps + 1), alpha, norm, lower, exact, shape, horizon)


def stretches(
    setting: Setting, steps: int, tight: bool
) -> Iterator[tuple[Piece, Long, range, int]]:
    """The steps 1 .. ``steps`` in groups that share a piece, with the attacks over it; and, where
    a group repeats one that came so many steps before it, that number.

    From the start up to `FAR`, and beyond where nothing better is known. Else from a set that a
    period keeps, `FAR` steps before.
    """
    found: Forever | None = None
    seen: dict[tuple[int, int], tuple[int, Long]] = {}
    groups = list(_groups(setting, steps))
    if tight and groups[-1][1] > FAR:
        until = f"{steps}, which have to be stealthy until step {groups[-1][1]}"
        raise InvalidValue("steps", until, f"at most step {FAR} with every sum bounded (tight)")
    for ks, t in groups:
        if t > FAR and found is None:
            found = forever(setting)
        if t <= FAR or found is None or found.kept is None or ks[0] <= found.after:
            piece = Piece(0, t, None)
            yield piece, stretch(setting, piece, tight), ks, 0
            continue
        first = _boundary(found, ks[0], t - FAR)
        piece, place = Piece(first, t, found.kept), (ks[0] - first, t - first)
        if place not in seen:
            seen[place] = ks[0], stretch(setting, piece)
        before, of = seen[place]
        yield piece, of, ks, ks[0] - before


def _moved_on(share: np.ndarray | None, of: Long) -> np.ndarray | None:
    """The multipliers of the step before, each limit one step older; None where they do not fit."""
    count = len(of.b)
    if share is None or count != len(of.sets) or (share[-1] > 0) != (of.start is not None):
        return None
    if len(share) == count + 1:
        return share
    return np.concatenate([share[:1], share]) if len(share) == count else None


def _groups(setting: Setting, steps: int) -> Iterator[tuple[range, int]]:
    """Runs of steps with one horizon; where a block may come at any time, with a step behind it."""
    horizon = setting.horizons(steps) - max(0, setting.blocks - 1)
    cuts = np.flatnonzero(np.diff(horizon)) + 1
    for a, b in zip([0, *cuts], [*cuts, steps], strict=True):
        yield range(a + 1, b + 1), int(horizon[a])


def _boundary(found: Forever, k: int, least: int) -> int:
    """The first step from ``least`` on that is a whole number of periods behind ``after``; the
    last one before k (> ``after``) where that is not before k.
    """
    periods = min(-(-(least - found.after) // found.period), (k - 1 - found.after) // found.period)
    return found.after + max(0, periods) * found.period
