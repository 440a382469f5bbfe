"""Playback of a recording: the stretch just before the attack, over and over."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from holdfast.attacks.channels import Channels, resolve
from holdfast.attacks.settings import first_step, sample_count
from holdfast.attacks.window import Window, windowed
from holdfast.parts import Attack, InvalidValue, Plant
from holdfast.records import Injection, Knowledge


class Replay(Attack):
    """Shows the sample of k - m N, the latest before ``first``; N = ``length`` samples."""

    channels: Channels
    first: Int[Array, ""]
    length: int = eqx.field(static=True)

    def init(self, key: PRNGKeyArray, known: Knowledge) -> Float[Array, "length nz"]:
        """An empty recording; sample k has its place at k mod N."""
        return jnp.zeros((self.length, *self.channels.hit.shape))

    def step(
        self, state: Float[Array, "length nz"], known: Knowledge
    ) -> tuple[Float[Array, "length nz"], Injection]:
        """Records until the start, plays back from then on."""
        place = jnp.mod(known.k, self.length)
        sample = self.channels.signals(known)
        recorded = jnp.where(known.k < self.first, sample, state[place])
        return state.at[place].set(recorded), self.channels.show(recorded, known)


def build(
    plant: Plant,
    *,
    seconds: float,
    channel: str | None = None,
    channels: list[str] | None = None,
    start: float,
    stop: float = math.inf,
) -> Window:
    """From ``start`` on the last ``seconds`` before it, repeated, for start <= t < stop.

    Sensors and actuators only. On an actuator the attacker replaces the command he has seen,
    which is one sample older than the one his injection is added to.

    Raises `InvalidValue` for an unknown channel, a setting out of range, or a start with
    fewer than ``seconds`` before it.
    """
    found = resolve(plant, channel, channels, recorded="replay")
    length = sample_count(plant, "seconds", seconds)
    first = first_step(plant, start)
    if first < length:
        raise InvalidValue("start", start, f"at least {seconds:g}: replay records that long before")
    attack = Replay(found, jnp.asarray(first, jnp.int32), length)
    return windowed(plant, attack, start, stop)
