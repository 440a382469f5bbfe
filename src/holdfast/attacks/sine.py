"""A sinusoid."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from holdfast.attacks.channels import Channels, resolve
from holdfast.attacks.settings import number
from holdfast.attacks.window import Window, windowed
from holdfast.parts import Attack, Plant
from holdfast.records import Injection, Knowledge


class Sine(Attack):
    """amplitude sin(2 pi frequency t + phase), t = k dt."""

    channels: Channels
    amplitude: Float[Array, ""]
    frequency: Float[Array, ""]
    phase: Float[Array, ""]
    dt: Float[Array, ""]

    def init(self, key: PRNGKeyArray, known: Knowledge) -> tuple:
        """Nothing to remember."""
        return ()

    def step(self, state: tuple, known: Knowledge) -> tuple[tuple, Injection]:
        """The sinusoid at the time of this sample."""
        t = known.k.astype(float) * self.dt
        angle = 2.0 * jnp.pi * self.frequency * t + self.phase
        return state, self.channels.add(self.amplitude * jnp.sin(angle))


def build(
    plant: Plant,
    *,
    amplitude: float,
    frequency: float,
    phase: float = 0.0,
    channel: str | None = None,
    channels: list[str] | None = None,
    start: float = 0.0,
    stop: float = math.inf,
) -> Window:
    """The sinusoid amplitude sin(2 pi ``frequency`` t + ``phase``) for start <= t < stop.

    ``frequency`` in Hz, ``phase`` in rad at t = 0 (not at the start).

    Raises `InvalidValue` for an unknown channel or a setting out of range.
    """
    attack = Sine(
        resolve(plant, channel, channels),
        number("amplitude", amplitude),
        number("frequency", frequency, least=0.0),
        number("phase", phase),
        jnp.asarray(plant.dt),
    )
    return windowed(plant, attack, start, stop)
