"""Noise on a few channels at a time, others at every step."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from holdfast.attacks.channels import Channels, resolve
from holdfast.attacks.settings import number
from holdfast.attacks.window import Window, windowed
from holdfast.parts import Attack, InvalidValue, Plant
from holdfast.records import Injection, Knowledge


class Hopping(Attack):
    """sd times a standard normal number on ``count`` of the channels, drawn at every step."""

    channels: Channels
    count: Int[Array, ""]
    sd: Float[Array, ""]

    def init(self, key: PRNGKeyArray, known: Knowledge) -> PRNGKeyArray:
        """The key that all its numbers come from."""
        return key

    def step(self, state: PRNGKeyArray, known: Knowledge) -> tuple[PRNGKeyArray, Injection]:
        """Draws the channels without replacement, all equally likely, then the numbers."""
        choose, draw = jax.random.split(jax.random.fold_in(state, known.k))
        hit = self.channels.hit
        lots = jnp.where(hit, jax.random.uniform(choose, hit.shape), jnp.inf)
        chosen = hit & (jnp.argsort(jnp.argsort(lots)) < self.count)
        amounts = self.sd * jax.random.normal(draw, hit.shape)
        return state, self.channels.add(jnp.where(chosen, amounts, 0.0))


def build(
    plant: Plant,
    *,
    count: int,
    sd: float,
    channel: str | None = None,
    channels: list[str] | None = None,
    start: float = 0.0,
    stop: float = math.inf,
) -> Window:
    """At every step noise of standard deviation ``sd`` on ``count`` of the channels listed.

    Raises `InvalidValue` for an unknown channel or a setting out of range.
    """
    found = resolve(plant, channel, channels)
    listed = int(found.hit.sum())
    if not 1 <= count <= listed:
        raise InvalidValue("count", count, f"1 to {listed}, the number of channels listed")
    attack = Hopping(found, jnp.asarray(count), number("sd", sd, least=0.0))
    return windowed(plant, attack, start, stop)
