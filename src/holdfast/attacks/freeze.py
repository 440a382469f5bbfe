"""A channel that sticks at its last value."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from holdfast.attacks.channels import Channels, resolve
from holdfast.attacks.settings import first_step
from holdfast.attacks.window import Window, windowed
from holdfast.parts import Attack, Plant
from holdfast.records import Injection, Knowledge


class Freeze(Attack):
    """Shows the last sample before ``first``."""

    channels: Channels
    first: Int[Array, ""]

    def init(self, key: PRNGKeyArray, known: Knowledge) -> Float[Array, " nz"]:
        """The sample at time 0, for a channel that has stuck from the start."""
        return self.channels.signals(known)

    def step(
        self, state: Float[Array, " nz"], known: Knowledge
    ) -> tuple[Float[Array, " nz"], Injection]:
        """Follows the samples until the start, holds from then on."""
        held = jnp.where(known.k < self.first, self.channels.signals(known), state)
        return held, self.channels.show(held, known)


def build(
    plant: Plant,
    *,
    channel: str | None = None,
    channels: list[str] | None = None,
    start: float = 0.0,
    stop: float = math.inf,
) -> Window:
    """The last sample before ``start``, for start <= t < stop.

    Sensors and actuators only. On an actuator the attacker replaces the command he has seen,
    which is one sample older than the one his injection is added to.

    Raises `InvalidValue` for an unknown channel or a setting out of range.
    """
    found = resolve(plant, channel, channels, recorded="freeze")
    attack = Freeze(found, jnp.asarray(first_step(plant, start), jnp.int32))
    return windowed(plant, attack, start, stop)
