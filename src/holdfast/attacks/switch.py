"""The plant's switches thrown: a line opened, a gear engaged, a relay tripped."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from holdfast.attacks.window import Window, windowed
from holdfast.parts import Attack, InvalidValue, Plant
from holdfast.records import Injection, Knowledge


class Switch(Attack):
    """The switches held in one position; nothing is added to any signal.

    Source: NISME Section 2, the hidden switch j_il(t).
    """

    position: Int[Array, ""]
    channels: int = eqx.field(static=True)

    def init(self, key: PRNGKeyArray, known: Knowledge) -> tuple:
        """Nothing to remember."""
        return ()

    def step(self, state: tuple, known: Knowledge) -> tuple[tuple, Injection]:
        """The position at every step."""
        nothing = jnp.zeros_like(known.u), jnp.zeros_like(known.y), jnp.zeros(self.channels)
        return state, Injection(*nothing, self.position)


def build(plant: Plant, *, to: str, start: float = 0.0, stop: float = math.inf) -> Window:
    """The switches in the position called ``to`` for start <= t < stop (seconds).

    Raises `InvalidValue` for a position that the plant does not have.
    """
    if to not in plant.positions:
        raise InvalidValue("to", repr(to), f"one of {', '.join(plant.positions)}")
    position = jnp.asarray(plant.positions.index(to), jnp.int32)
    return windowed(plant, Switch(position, len(plant.attacks)), start, stop)
