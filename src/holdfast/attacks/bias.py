"""A constant added to every channel hit."""

import math

from jaxtyping import Array, Float, PRNGKeyArray

from holdfast.attacks.channels import Channels, resolve
from holdfast.attacks.settings import number
from holdfast.attacks.window import Window, windowed
from holdfast.parts import Attack, Plant
from holdfast.records import Injection, Knowledge


class Bias(Attack):
    """value."""

    channels: Channels
    value: Float[Array, ""]

    def init(self, key: PRNGKeyArray, known: Knowledge) -> tuple:
        """Nothing to remember."""
        return ()

    def step(self, state: tuple, known: Knowledge) -> tuple[tuple, Injection]:
        """The same at every step."""
        return state, self.channels.add(self.value)


def build(
    plant: Plant,
    *,
    value: float,
    channel: str | None = None,
    channels: list[str] | None = None,
    start: float = 0.0,
    stop: float = math.inf,
) -> Window:
    """``value``, in units of the channel, for start <= t < stop (seconds).

    Raises `InvalidValue` for an unknown channel or a setting out of range.
    """
    attack = Bias(resolve(plant, channel, channels), number("value", value))
    return windowed(plant, attack, start, stop)
