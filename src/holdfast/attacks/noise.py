"""White Gaussian noise on every channel hit."""

import math

import jax
from jaxtyping import Array, Float, PRNGKeyArray

from holdfast.attacks.channels import Channels, resolve
from holdfast.attacks.settings import number
from holdfast.attacks.window import Window, windowed
from holdfast.parts import Attack, Plant
from holdfast.records import Injection, Knowledge


class Noise(Attack):
    """sd times a standard normal number, its own for every channel and step."""

    channels: Channels
    sd: Float[Array, ""]

    def init(self, key: PRNGKeyArray, known: Knowledge) -> PRNGKeyArray:
        """The key that all its numbers come from."""
        return key

    def step(self, state: PRNGKeyArray, known: Knowledge) -> tuple[PRNGKeyArray, Injection]:
        """The numbers of this step."""
        key = jax.random.fold_in(state, known.k)
        draws = jax.random.normal(key, self.channels.hit.shape)
        return state, self.channels.add(self.sd * draws)


def build(
    plant: Plant,
    *,
    sd: float,
    channel: str | None = None,
    channels: list[str] | None = None,
    start: float = 0.0,
    stop: float = math.inf,
) -> Window:
    """Noise of standard deviation ``sd``, in units of the channel, for start <= t < stop.

    Raises `InvalidValue` for an unknown channel or a setting out of range.
    """
    attack = Noise(resolve(plant, channel, channels), number("sd", sd, least=0.0))
    return windowed(plant, attack, start, stop)
