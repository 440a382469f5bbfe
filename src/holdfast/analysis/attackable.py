"""Which sensors, altered by a stealthy attacker, let the Kalman filter's error grow for ever."""

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from holdfast.analysis.model import Model
from holdfast.analysis.observability import Observability
from holdfast.numerics.attackable import Growth, Mode, Movable, growth_of, movable
from holdfast.numerics.steady_state import SteadyState
from holdfast.records import Enforcement

LONGEST = 100
"""Largest L for which it is tried how many steps in a row must be authenticated."""
LONGEST_PERIOD = 10_000
"""Steps of the common period of a policy that are looked at."""
DEAREST = 2_000_000
"""Unstable modes squared times outputs up to which all periods are tried."""


class Case(NamedTuple):
    """What who alters the sensors ``names`` at every step can do.

    ``radius``: the largest modulus of the modes he can move without limit, 0 if none.
    ``corollary_2``: steps in a row that are enough for any L: the smaller of the observability
    index and of the number of these modes, generalised eigenvectors included. None where nothing
    can be said.
    """

    names: tuple[str, ...]
    attackable: bool | None
    radius: float | None
    modes: tuple[Mode, ...]
    corollary_2: int | None


class Duration(NamedTuple):
    """The fewest steps in a row, all sensors authenticated, that bound the error.

    ``usual``: for most L from 2 to `LONGEST`; ``others``: by L, where it is another number.
    """

    usual: int
    others: dict[int, int]


class Attackable(NamedTuple):
    """``all``: every sensor is altered; ``each``: one alone; ``given``: those asked for.

    ``theorem_4``: its f. ``duration``: against the ``given`` sensors, else all; None if there is
    nothing to bound, or too dear. ``shields``: sensors each of which, always authenticated
    alone, bounds what all others can do, where all together are attackable. ``reason``: why there
    is none of this.
    """

    all: Case
    each: tuple[Case, ...]
    given: Case | None
    theorem_4: int | None
    duration: Duration | None
    shields: tuple[str, ...]
    reason: str | None


class Bounded(NamedTuple):
    """Whether a policy bounds the error; None where that is not known, for the ``reason``.

    ``radius``: the largest modulus per step of what can still be moved; 0 if nothing;
    ``subspace`` (n x r): along what. ``period``: steps after which the policy repeats.
    """

    bounded: bool | None
    radius: float | None
    subspace: np.ndarray | None
    period: int
    reason: str | None


def attackable(
    model: Model,
    steady: SteadyState,
    seen: Observability,
    compromised: tuple[int, ...] | None = None,
) -> Attackable:
    """Perfectly attackable or not, for all sensors, each one, and those asked for.

    A set is if and only if the other sensors leave some unstable mode of A unseen: then an
    attacker moves it while every expected residual stays small. This is Theorem 3 with whole
    eigenspaces and generalised eigenvectors; its "v is reachable" always holds for a gain that
    stabilises.

    Source: INTEGRITY, Theorems 3 and 4, Corollary 2.
    """
    found, reason = _looked_at(model, steady)
    ny = len(model.outputs)
    every = _case(model, found, seen, tuple(range(ny)))
    given = None if compromised is None else _case(model, found, seen, compromised)
    each = tuple(_case(model, found, seen, (i,)) for i in range(ny))
    if found is None:
        return Attackable(every, each, given, None, None, (), reason)
    shields: tuple[str, ...] = ()
    if every.attackable:
        safe = [not growth_of(found, ~row[None]).unbounded for row in np.eye(ny, dtype=bool)]
        shields = tuple(name for name, kept in zip(model.outputs, safe, strict=True) if kept)
    which = every if given is None else given
    duration = None
    if which.attackable and found.unstable**2 * ny <= DEAREST:
        duration = _duration(found, _mask(ny, compromised))
    return Attackable(
        every, each, given, _smaller(seen.rows, found.unstable), duration, shields, None
    )


def smallest(
    model: Model, steady: SteadyState, every: int, compromised: tuple[int, ...] | None = None
) -> int | None:
    """The fewest steps in a row that, all sensors authenticated every ``every`` steps, bound it.

    Exact for this L: Theorem 4's f is enough, and needed only where A^L repeats what the steps
    show (a rotation by 90 degrees, even L). 0 where nothing needs to be authenticated; None
    without a steady-state gain. ``compromised``: who may be altered; left out, every sensor.

    Source: INTEGRITY, Theorem 4.
    """
    found, _ = _looked_at(model, steady)
    mask = _mask(len(model.outputs), compromised)
    return None if found is None else _fewest(found, mask, every, 0)


def sensor_wise(
    model: Model,
    steady: SteadyState,
    enforcement: Enforcement,
    compromised: tuple[int, ...] | None = None,
    *,
    aware: bool = True,
) -> Bounded:
    """Whether a policy, for each sensor its own, bounds what a stealthy attacker can do.

    Exact over the common period of all sensors, for any number of unstable modes. Cheaper
    answers first: the error is bounded if it is without any policy, and is not if the sensors
    that are never authenticated are enough for the attacker. ``aware``: he knows the steps;
    one who does not is always bounded where a filter exists (Theorem 6).

    Source: INTEGRITY, Theorem 6 and the end of Section IV (there for one unstable mode).
    """
    every, duration, first = (
        np.asarray(v) for v in (enforcement.every, enforcement.duration, enforcement.first)
    )
    every = np.where((duration <= 0) | (duration >= every), 1, np.maximum(every, 1))
    period = math.lcm(*every.tolist())
    found, reason = _looked_at(model, steady)
    if found is None:
        return Bounded(None, None, None, period, reason)
    can = _mask(len(model.outputs), compromised)
    for who, unbounded in ((can, False), (can & (duration <= 0), True)):
        known = growth_of(found, who[None], aware=aware)
        if known.unbounded == unbounded and (not unbounded or period > LONGEST_PERIOD):
            return _bounded(known, period)
    if period > LONGEST_PERIOD:
        text = f"the policy repeats only after {period} steps, over {LONGEST_PERIOD}"
        return Bounded(None, None, None, period, text)
    since = np.arange(period)[:, None] - first
    free = can & (np.mod(since, every) >= duration)
    return _bounded(growth_of(found, free, aware=aware), period)


def _looked_at(model: Model, steady: SteadyState) -> tuple[Movable | None, str | None]:
    if steady.K is None:
        return None, f"there is no steady-state Kalman filter: {steady.reason}"
    try:
        return movable(model.A, model.C, steady.K), None
    except np.linalg.LinAlgError as error:
        return None, f"the modes of A cannot be told apart ({error})"


def _bounded(found: Growth, period: int) -> Bounded:
    return Bounded(not found.unbounded, found.radius, found.subspace, period, None)


def _case(model: Model, found: Movable | None, seen: Observability, which: tuple[int, ...]) -> Case:
    names = tuple(model.outputs[i] for i in which)
    if found is None:
        return Case(names, None, None, (), None)
    moved = growth_of(found, _mask(len(model.outputs), which)[None])
    f = _smaller(seen.rows, moved.subspace.shape[1])
    return Case(names, moved.unbounded, moved.radius, moved.modes, f)


def _mask(ny: int, which: tuple[int, ...] | None) -> np.ndarray:
    mask = np.full(ny, which is None)
    mask[list(which or ())] = True
    return mask


def _smaller(index: int | None, count: int) -> int:
    """f; hidden stable modes leave no observability index, and do not matter here."""
    return count if index is None else min(index, count)


def _duration(found: Movable, mask: np.ndarray) -> Duration:
    fewest = {every: _fewest(found, mask, every, 1) for every in range(2, LONGEST + 1)}
    usual = Counter(fewest.values()).most_common(1)[0][0]
    return Duration(usual, {every: f for every, f in fewest.items() if f != usual})


def _fewest(found: Movable, mask: np.ndarray, every: int, start: int) -> int:
    """The smallest f from ``start`` on; with f = L nothing can be altered at all."""
    for f in range(start, every):
        free = mask & (np.arange(every)[:, None] >= f)
        if not growth_of(found, free).unbounded:
            return f
    return every
