"""A drift: grows from zero at the start."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from holdfast.attacks.channels import Channels, resolve
from holdfast.attacks.settings import number
from holdfast.attacks.window import Window, windowed
from holdfast.parts import Attack, Plant
from holdfast.records import Injection, Knowledge


class Ramp(Attack):
    """rate (t - start), t = k dt."""

    channels: Channels
    rate: Float[Array, ""]
    start: Float[Array, ""]
    dt: Float[Array, ""]

    def init(self, key: PRNGKeyArray, known: Knowledge) -> tuple:
        """Nothing to remember."""
        return ()

    def step(self, state: tuple, known: Knowledge) -> tuple[tuple, Injection]:
        """The ramp at the time of this sample."""
        elapsed = known.k.astype(float) * self.dt - self.start
        return state, self.channels.add(self.rate * elapsed)


def build(
    plant: Plant,
    *,
    rate: float,
    channel: str | None = None,
    channels: list[str] | None = None,
    start: float = 0.0,
    stop: float = math.inf,
) -> Window:
    """``rate`` (units of the channel per second) times (t - start), for start <= t < stop.

    Raises `InvalidValue` for an unknown channel or a setting out of range.
    """
    attack = Ramp(
        resolve(plant, channel, channels),
        number("rate", rate),
        number("start", start),
        jnp.asarray(plant.dt),
    )
    return windowed(plant, attack, start, stop)
