"""The worst attack that a detector does not notice, planned from the plant and its filter."""

import math
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from holdfast.attacks.channels import Channels, resolve
from holdfast.attacks.settings import first_step, number
from holdfast.attacks.window import Window, windowed
from holdfast.numerics.attack_sets import strongest
from holdfast.numerics.multipliers import Long
from holdfast.numerics.reachability import moves, patterns
from holdfast.numerics.stealth import DETECTORS, Stealth
from holdfast.parts import Attack, InvalidValue, Plant
from holdfast.plants.watched import watched
from holdfast.records import Enforcement, Injection, Knowledge

LONGEST = 20_000
"""Steps that are planned; sums of residuals have a limit each, and so are planned for fewer."""
MOST_SUMS = 2_000


class Stealthy(Attack):
    """Row k - first of a plan (t x ny) made beforehand, added to the sensors hit."""

    channels: Channels
    plan: Float[Array, "t ny"]
    first: Int[Array, ""]

    def init(self, key: PRNGKeyArray, known: Knowledge) -> tuple:
        """Nothing to remember: the plan depends on nothing that is measured."""
        return ()

    def step(self, state: tuple, known: Knowledge) -> tuple[tuple, Injection]:
        """The row of this step."""
        i, t = known.k - self.first, self.plan.shape[0]
        row = jnp.where((i >= 0) & (i < t), self.plan[jnp.clip(i, 0, t - 1)], 0.0)
        u, d = jnp.zeros(self.channels.u.shape), jnp.zeros(self.channels.d.shape)
        return state, Injection(u, row, d)


def build(
    plant: Plant,
    *,
    epsilon: float,
    channel: str | None = None,
    channels: list[str] | None = None,
    start: float = 0.0,
    stop: float = math.inf,
    at: float | None = None,
    detector: Literal["chi_square", "windowed", "sprt"] = "chi_square",
    level: float = 0.01,
    length: int = 10,
    direction: list[float] | None = None,
    enforcement: Enforcement | None = None,
) -> Window:
    """The attack with the largest expected error at time ``at`` that no test notices.

        max |E e_k|  over  a_1 .. a_t  with  P(alarm) <= level + epsilon  at every step

    for a Kalman filter in its steady state. ``at`` in seconds, the last sample before ``stop``
    unless given: to stay unnoticed after it, let ``stop`` lie behind the next authenticated block.
    ``detector`` is the test that is to be deceived, ``level`` its false-alarm probability,
    ``length`` that of a windowed one. ``direction`` (n numbers): what of the error counts; all of
    it unless given. ``enforcement``: when the sensors hit are authenticated, which he knows.

    Raises `InvalidValue` for a plant without a steady-state filter, channels that are no sensors,
    no finite ``stop``, a setting out of range.

    Source: INTEGRITY, Section II-B (10)-(16); the plan is the optimum of Section V.
    """
    found = resolve(plant, channel, channels)
    if bool(np.any(found.u)) or bool(np.any(found.d)):
        raise InvalidValue(
            "channels", channels or [channel], "sensors: a stealthy attack is on them"
        )
    _check(epsilon, level, length, detector)
    system = watched(plant)
    first, last = max(1, first_step(plant, start)), _end(plant, start, stop, detector)
    steps, hit = last - first, np.asarray(found.y)
    if steps < 1:
        raise InvalidValue("stop", stop, "at least one sample after start")
    place = steps if at is None else first_step(plant, at) - first + 1
    if not 1 <= place <= steps:
        raise InvalidValue("at", at, f"seconds from {start:g} to before {stop:g}")
    enforced = np.zeros((steps, len(hit)), bool)
    if enforcement is not None:
        enforced = np.asarray(enforcement.at(jnp.arange(first, last, dtype=jnp.int32)))
    sets, index = patterns(hit & ~enforced)
    stealth = Stealth(detector, epsilon, level, len(hit), (1.0,) * length)
    limits = stealth.limits(steps, tight=detector == "sprt")
    of = Long(moves(*system[:4], sets), index, limits.w, limits.b, None)
    plan = strongest(of, _counted(direction, len(system.A)), place).a
    attack = Stealthy(found, jnp.asarray(plan), jnp.asarray(first, jnp.int32))
    return windowed(plant, attack, start, stop)


def _check(epsilon: float, level: float, length: int, detector: str) -> None:
    number("epsilon", epsilon)
    if not 0.0 < level < 1.0:
        raise InvalidValue("level", level, "a probability between 0 and 1")
    if not 0.0 < epsilon < 1.0 - level:
        raise InvalidValue("epsilon", epsilon, f"between 0 and 1 - level ({1.0 - level:g})")
    if detector not in DETECTORS:
        raise InvalidValue("detector", detector, f"one of {', '.join(DETECTORS)}")
    if detector == "sprt" and epsilon >= 0.5:
        # of sums as long as can be, half raise the alarm by themselves
        raise InvalidValue("epsilon", epsilon, "a probability under 0.5 with sprt")
    if length != int(length) or length < 1:
        raise InvalidValue("length", length, "a whole number of rows, at least 1")


def _end(plant: Plant, start: float, stop: float, detector: str) -> int:
    """The step after the last one."""
    most = MOST_SUMS if detector == "sprt" else LONGEST
    if not math.isfinite(start):
        raise InvalidValue("start", start, "a finite number of seconds")
    if not math.isfinite(stop):
        raise InvalidValue("stop", stop, "seconds at which the attack ends: it is planned to there")
    last = first_step(plant, stop)
    if last - first_step(plant, start) > most:
        raise InvalidValue("stop", stop, f"at most {most} samples after start")
    return last


def _counted(direction: list[float] | None, n: int) -> np.ndarray:
    if direction is None:
        return np.eye(n)
    row = np.asarray(direction, float)
    if row.shape != (n,) or not np.all(np.isfinite(row)) or not np.any(row):
        raise InvalidValue("direction", direction, f"{n} finite numbers, not all 0")
    return row[None]
