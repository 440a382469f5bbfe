"""The search for the rarest authentication: candidates, and what is reached under each."""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from holdfast.numerics.attackable import growth_of, movable
from holdfast.numerics.steady_state import UNSTABLE
from holdfast.numerics.subspaces import scaled, silent
from holdfast.parts import InvalidValue
from holdfast.reach.bounds import reach as reach_of
from holdfast.reach.bounds import stretches
from holdfast.reach.forever import forever, worst
from holdfast.reach.pieces import Piece, highest
from holdfast.reach.setting import Setting
from holdfast.records import Enforcement

MOST = 400
"""Steps between two blocks that are tried at most."""
BEYOND = 3
"""Neighbours of a distance that are tried where it fails: the error need not grow with it where the
plant turns, and an even distance can see less than an odd one."""
TURNED = 1e-9
SMALL = 240
"""Unknowns of a period up to which a policy's error is computed to the end."""
MULTIPLES = (2, 3, 4)
"""Of the others' distance that a sensor of its own may have."""


class Reached(NamedTuple):
    """``value``: the largest error, from above; ``proof`` "horizon" or "period"."""

    value: float
    proof: str


class Policy(NamedTuple):
    """``enforcement`` None: nothing need be authenticated. ``worst``: the error that is reached,
    from above. ``share``: authenticated messages over all; ``cost``: what they cost a step.
    ``tried``: how many policies were looked at.
    """

    enforcement: Enforcement | None
    worst: float
    limit: float
    share: float
    cost: float
    steps: int | None
    proof: str
    tried: int


def greatest(setting: Setting, steps: int | None, limit: float = math.inf) -> Reached:
    """The largest error over ``steps``, or ever; over ``limit`` the first one found that is.

    Raises `InvalidValue` where no bound holds for ever because the detector sums for ever.
    """
    if steps is not None:
        return Reached(_within(setting, steps, limit), "horizon")
    if setting.stealth.detector == "sprt":
        raise InvalidValue(
            "steps",
            "none with the detector sprt, whose bound grows with the length of the sum",
            "a number of steps, or the detector chi_square or windowed",
        )
    found = forever(setting)
    top = worst(setting, found, limit)
    return Reached(math.inf if top is None else top.value, "period")


def _within(setting: Setting, steps: int, limit: float) -> float:
    if setting.stealth.detector == "sprt":
        return float(np.max(reach_of(setting, steps).norm, initial=0.0))
    value = 0.0
    for piece, _, ks, like in stretches(setting, steps, tight=False):
        if not like:
            value = max(value, highest(setting, piece, ks, limit).value)
        if value > limit:
            break
    return value


def cost_of(found: Policy) -> float:
    """What an authenticated step costs under a policy: what the search makes small."""
    return found.cost


class Search:
    """One search: what is asked, and what has been tried."""

    def __init__(self, setting: Setting, limit: float, steps: int | None, price):
        self.setting, self.limit, self.steps, self.price = setting, limit, steps, price
        self.known: dict[tuple, Reached] = {}
        s = setting.system
        self.modes = movable(s.A, s.C, s.K)

    def reached(self, enforcement: Enforcement | None) -> Reached:
        """What the attacker reaches under a policy: whether it is under the limit, at least."""
        key = () if enforcement is None else _key(enforcement)
        if key not in self.known:
            asked = self.setting._replace(enforcement=enforcement)
            if self.steps is None and not self._bounded(asked):
                self.known[key] = Reached(math.inf, "period")
            else:
                self.known[key] = greatest(asked, self.steps, self.limit)
        return self.known[key]

    def _bounded(self, asked: Setting) -> bool:
        """Cheap, and exact: whether there is a bound at all."""
        period = 1 if asked.enforcement is None else asked.period
        rows = asked.alterable(period, asked.after)
        return not growth_of(self.modes, rows, aware=asked.aware).unbounded

    def found(self, enforcement: Enforcement | None, reached: Reached) -> Policy:
        """The record of a policy that does."""
        shares = np.zeros(len(self.price)) if enforcement is None else enforcement.share
        shares = np.asarray(shares)
        cost = float(shares @ self.price)
        return Policy(
            enforcement, reached.value, self.limit, float(np.mean(shares)), cost, self.steps,
            reached.proof, len(self.known),
        )  # fmt: skip

    def durations(self) -> range:
        """Lengths of a block worth trying."""
        s = self.setting.system
        told = silent(scaled(s.A, np.zeros((len(s.A), 0)), s.C, np.zeros((len(s.C), 0))))
        # told has an entry for no sample, and one for each that adds something
        return range(1, max(1, min(len(told) - 1, self.modes.unstable)) + 1)

    def together(self, duration: int) -> Policy:
        """All outputs at once: the longest distance that does."""
        return self._longest(self._global(duration), duration)

    def rarer(self, best: Policy, duration: int) -> Policy:
        """The same with blocks of ``duration``, where that is rarer than ``best``."""
        held = best.enforcement
        assert held is not None
        every = int(held.every[0]) * duration // int(held.duration[0]) + 1
        made = self._global(duration)
        for shortest in range(every, min(every + self._around(), MOST) + 1):
            if self.reached(made(shortest)).value <= self.limit:
                return min(best, self._longest(made, shortest), key=cost_of)
        return best

    def _global(self, duration: int) -> Callable[[int], Enforcement]:
        p = len(self.price)
        return lambda every: Enforcement.of([every] * p, duration, every)

    def _longest(self, made: Callable[[int], Enforcement], shortest: int) -> Policy:
        """The largest ``every`` for which ``made(every)`` does; ``shortest`` is one that does.

        Where an answer costs next to nothing all are tried, from the longest down. Else by halving,
        first on whether the first block comes in time at all. Where the plant turns a distance
        counts as one that does if a slightly shorter one does, and the longest of those is taken.
        """

        def does(every: int) -> bool:
            return self.reached(made(every)).value <= self.limit

        if self.setting.stealth.detector == "sprt":
            every = next((every for every in range(MOST, shortest, -1) if does(every)), shortest)
            return self._tight(made(every))
        top = _last(lambda every: self._early(made(every)), shortest, MOST)
        around = self._around()

        def near(every: int) -> bool:
            return any(does(one) for one in range(every, max(every - around, shortest) - 1, -1))

        last = min(_last(near, shortest, top) + around, MOST)
        good = next((every for every in range(last, shortest, -1) if does(every)), shortest)
        return self._tight(made(good))

    def _early(self, enforcement: Enforcement) -> bool:
        """Whether the limit holds up to the end of the first blocks: quick to say."""
        asked = self.setting._replace(enforcement=enforcement)
        last = asked.after
        steps = range(1, min(last, self.steps or last) + 1)
        return highest(asked, Piece(0, last, None), steps, self.limit).value <= self.limit

    def _around(self) -> int:
        """How many neighbours of a distance are tried: some where a mode that does not fade changes
        its sign or turns.
        """
        values = np.linalg.eigvals(self.setting.system.A)
        lasting = values[np.abs(values) >= UNSTABLE]
        turns = np.any(np.abs(lasting - np.abs(lasting)) > TURNED * np.abs(lasting))
        return BEYOND if turns else 0

    def _tight(self, enforcement: Enforcement) -> Policy:
        """The record of a policy that does, with what it comes to and not only that it does."""
        asked = self.setting._replace(enforcement=enforcement)
        shown = self.reached(enforcement)
        if int(np.max(enforcement.every)) * np.sum(asked.compromised) <= SMALL:
            shown = min(shown, greatest(asked, self.steps))
        return self.found(enforcement, shown)

    def apart(self, together: Policy) -> Policy:
        """Each output its own schedule: which of those attacked, staggered over a common distance;
        then one by one at a multiple of it.
        """
        hit = np.flatnonzero(self.setting.compromised)
        best = together
        for count in range(1, len(hit) + 1):
            for chosen in itertools.combinations(hit, count):
                for duration in self.durations():
                    found = self._staggered(np.array(chosen), duration)
                    if found.cost < best.cost * (1.0 - 1e-9):
                        best = found
        return self._slower(best)

    def _staggered(self, chosen: np.ndarray, duration: int) -> Policy:
        """The outputs ``chosen`` in turn, evenly spread over the distance."""
        p = len(self.price)

        def made(every: int) -> Enforcement:
            lasting, first = np.zeros(p, int), np.ones(p, int)
            lasting[chosen] = duration
            turn = np.arange(len(chosen)) * every // len(chosen)
            first[chosen] = every - turn if every > duration else 1
            return Enforcement.of([every] * p, lasting, first)

        always = self.reached(made(duration))
        if always.value <= self.limit:
            return self._longest(made, duration)
        return self.found(made(duration), always)._replace(cost=math.inf)

    def _slower(self, best: Policy) -> Policy:
        """One output after the other at a multiple of its distance, where that still does."""
        held = best.enforcement
        if held is None:
            return best
        for i in np.flatnonzero(np.asarray(held.duration)):
            for times in MULTIPLES:
                every = np.array(held.every)
                every[i] = int(np.asarray(held.every)[i]) * times
                now = Enforcement.of(every, held.duration, held.first)
                reached = self.reached(now)
                if reached.value > self.limit:
                    break
                better = self.found(now, reached)
                best = min(best, better, key=cost_of)
            assert best.enforcement is not None
            held = best.enforcement
        return best


def _key(held: Enforcement) -> tuple:
    return tuple(np.concatenate([held.every, held.duration, held.first]).tolist())


def _last(does: Callable[[int], bool], low: int, high: int) -> int:
    """The largest number up to ``high`` that does, if whatever is below one that does does too;
    ``low`` does.
    """
    if low >= high or does(high):
        return max(low, high)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if does(middle) else (low, middle)
    return low
