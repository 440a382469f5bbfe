"""Late samples passed off as current ones."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from holdfast.attacks.channels import Channels, resolve
from holdfast.attacks.settings import sample_count
from holdfast.attacks.window import Window, windowed
from holdfast.parts import Attack, Plant
from holdfast.records import Injection, Knowledge


class Delay(Attack):
    """Shows the sample of k - N, N = ``length`` samples; the first one while k < N."""

    channels: Channels
    length: int = eqx.field(static=True)

    def init(self, key: PRNGKeyArray, known: Knowledge) -> Float[Array, "length nz"]:
        """A recording full of the first sample; sample k has its place at k mod N."""
        sample = self.channels.signals(known)
        return jnp.broadcast_to(sample, (self.length, *sample.shape))

    def step(
        self, state: Float[Array, "length nz"], known: Knowledge
    ) -> tuple[Float[Array, "length nz"], Injection]:
        """Takes the oldest sample and puts the current one in its place."""
        place = jnp.mod(known.k, self.length)
        shown = self.channels.show(state[place], known)
        return state.at[place].set(self.channels.signals(known)), shown


def build(
    plant: Plant,
    *,
    seconds: float,
    channel: str | None = None,
    channels: list[str] | None = None,
    start: float = 0.0,
    stop: float = math.inf,
) -> Window:
    """The sample of ``seconds`` ago (to the nearest whole sample) for start <= t < stop.

    Sensors and actuators only. On an actuator the attacker replaces the command he has seen,
    which is one sample older than the one his injection is added to.

    Raises `InvalidValue` for an unknown channel or a setting out of range.
    """
    found = resolve(plant, channel, channels, recorded="delay")
    attack = Delay(found, sample_count(plant, "seconds", seconds))
    return windowed(plant, attack, start, stop)
