"""Any attack, between a start and a stop."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from holdfast.attacks.settings import first_step
from holdfast.parts import Attack, InvalidValue, Plant
from holdfast.records import Injection, Knowledge


class Window(Attack):
    """``attack`` where first <= k < last, nothing elsewhere.

    The attack's own state goes on outside, so that it can record what it will play back.
    """

    attack: Attack
    first: Int[Array, ""]
    last: Int[Array, ""]

    def init(self, key: PRNGKeyArray, known: Knowledge) -> Any:
        """The state of the attack inside."""
        return self.attack.init(key, known)

    def step(self, state: Any, known: Knowledge) -> tuple[Any, Injection]:
        """The injection of the attack inside, or zeros."""
        state, injection = self.attack.step(state, known)
        active = (self.first <= known.k) & (known.k < self.last)
        return state, jax.tree.map(
            lambda added: jnp.where(active, added, jnp.zeros_like(added)), injection
        )


def active_steps(plant: Plant, start: float, stop: float) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """The first sample k with t >= start and the first with t >= stop, t = k dt in seconds.

    Raises `InvalidValue` for a start that is not finite or a stop that is not after it.
    """
    if not math.isfinite(start):
        raise InvalidValue("start", start, "a finite number of seconds")
    if not stop > start:
        raise InvalidValue("stop", stop, f"seconds after start ({start:g})")
    first, last = (jnp.asarray(first_step(plant, t), jnp.int32) for t in (start, stop))
    return first, last


def windowed(plant: Plant, attack: Attack, start: float, stop: float) -> Window:
    """``attack`` for start <= t < stop in seconds, t the time of the sample injected.

    Raises `InvalidValue` as `active_steps`.
    """
    return Window(attack, *active_steps(plant, start, stop))
