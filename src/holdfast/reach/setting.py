"""Who attacks what: the filter in its steady state, the detector, the attacker, the policy."""

import math
from typing import NamedTuple

import numpy as np

from holdfast.numerics.reachability import Moves, moves, patterns
from holdfast.numerics.stealth import Stealth
from holdfast.plants.watched import Watched
from holdfast.records import Enforcement


class Setting(NamedTuple):
    """One question: the filter, the detector, the outputs the attacker is on, the policy.

    ``enforced`` (t x p, bool): the policy where it is not periodic (row k - 1 is step k); nothing
    is authenticated after its end. ``aware``: whether he knows the policy; if not, any step may
    be authenticated and his residuals have to be ready for it. ``functional`` (q x n): what of
    the error counts.
    """

    system: Watched
    stealth: Stealth
    compromised: np.ndarray
    enforcement: Enforcement | None
    functional: np.ndarray
    aware: bool = True
    enforced: np.ndarray | None = None

    @property
    def blocks(self) -> int:
        """Steps in a row that the unaware attacker must be ready for."""
        if self.aware:
            return 0
        if self.enforcement is None:
            return 1
        return max(1, int(np.max(np.where(self.compromised, self.enforcement.duration, 0))))

    @property
    def period(self) -> int:
        """The least common multiple of the periods of the outputs that are attacked."""
        if self.enforcement is None:
            return 1
        every, duration, _ = self.enforcement_fields
        held = self.compromised & (duration > 0)
        return math.lcm(1, *(int(e) for e in every[held]))

    @property
    def after(self) -> int:
        """A step from which on the policy is periodic: the end of the first blocks of all."""
        if self.enforcement is None:
            return 0
        _, duration, first = self.enforcement_fields
        held = self.compromised & (duration > 0)
        return int(np.max((first + duration - 1)[held], initial=0))

    def alterable(self, steps: int, first: int = 0) -> np.ndarray:
        """Which outputs can be altered at the steps first + 1 .. first + steps (steps x p)."""
        k = np.arange(first + 1, first + steps + 1)
        free = np.ones((steps, len(self.compromised)), bool)
        if self.enforced is not None:
            rows = self.enforced[first : first + steps]
            free[: len(rows)] = ~rows
        elif self.enforcement is not None:
            every, duration, begin = self.enforcement_fields
            since = k[:, None] - begin
            free = (since < 0) | (since % np.maximum(every, 1) >= duration)
        return free & self.compromised

    def moves(self, steps: int, first: int = 0) -> tuple[Moves, np.ndarray]:
        """The attacker's moves at those steps, and which of them each step has."""
        s = self.system
        rows, index = patterns(self.alterable(steps, first))
        return moves(s.A, s.C, s.K, s.Q, rows, self.blocks), index

    def horizons(self, steps: int) -> np.ndarray:
        """For each k = 1 .. steps the step t >= k whose constraint is used: where every output
        that is both altered and authenticated has completed a block at or after k.

        Blocks of several outputs may follow each other closely: k then shares the t of the round
        that it falls in. Without a policy: k. For an attacker who does not know the policy, the
        end of the block that he must be ready for behind that t.
        """
        ends = self._ends(steps)
        found = np.empty(steps, int)
        t = 0
        for i in range(steps):
            if i >= t:
                t = ends(i + 1)
            found[i] = t
        return found + self.blocks

    def _ends(self, steps: int):
        if self.enforced is not None:
            held = np.asarray(self.enforced)[:, self.compromised]
            stops = held & ~np.vstack([held[1:], np.zeros((1, held.shape[1]), bool)])
            lists = [np.flatnonzero(column) + 1 for column in stops.T]
            return lambda k: max([k, *(int(s[s >= k][0]) for s in lists if np.any(s >= k))])
        if self.enforcement is None:
            return lambda k: k
        rows = [
            (int(every), int(duration), int(first))
            for every, duration, first, hit in zip(
                *(np.asarray(v) for v in self.enforcement_fields), self.compromised, strict=True
            )
            if hit and 0 < duration < every
        ]
        return lambda k: max([k, *(_end(k, *row) for row in rows)])

    @property
    def enforcement_fields(self) -> tuple[np.ndarray, ...]:
        """every, duration, first."""
        held = self.enforcement
        assert held is not None
        return np.asarray(held.every), np.asarray(held.duration), np.asarray(held.first)


def _end(k: int, every: int, duration: int, first: int) -> int:
    """The last step of the block at or after k."""
    if k < first:
        return first + duration - 1
    since = (k - first) % every
    return k - since + duration - 1 + (every if since >= duration else 0)
