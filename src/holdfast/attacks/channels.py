"""Where an attack enters: names of sensors, actuators and attack channels, made into masks."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from holdfast.parts import InvalidValue, Plant
from holdfast.records import Injection, Knowledge


class Channels(eqx.Module):
    """Which entries of the actuators ``u``, sensors ``y`` and attack channels ``d`` are hit."""

    u: Bool[Array, " nu"]
    y: Bool[Array, " ny"]
    d: Bool[Array, " nd"]

    @property
    def hit(self) -> Bool[Array, " nz"]:
        """The masks of u, y and d, one after the other."""
        return jnp.concatenate([self.u, self.y, self.d])

    def add(self, value: Float[Array, ""] | Float[Array, " nz"]) -> Injection:
        """``value`` (one for all, or one per entry of `hit`) into the channels hit."""
        hit = self.hit
        amounts = jnp.where(hit, jnp.broadcast_to(value, hit.shape), 0.0)
        nu, ny = self.u.shape[0], self.y.shape[0]
        return Injection(amounts[:nu], amounts[nu : nu + ny], amounts[nu + ny :])

    def show(self, sample: Float[Array, " nz"], known: Knowledge) -> Injection:
        """What makes the channels hit show ``sample`` (as `signals`) instead of ``known``."""
        return self.add(sample - self.signals(known))

    def signals(self, known: Knowledge) -> Float[Array, " nz"]:
        """What the attacker sees on every entry of `hit`: u, y, and nothing on d."""
        return jnp.concatenate([known.u, known.y, jnp.zeros(self.d.shape)])


def resolve(
    plant: Plant,
    channel: str | None,
    channels: Sequence[str] | None,
    *,
    recorded: str | None = None,
) -> Channels:
    """The masks of ``channel`` or ``channels``: "sensor:NAME", "actuator:NAME", "channel:NAME".

    ``recorded`` names an attack that plays back what it has recorded, and so can hit only
    sensors and actuators: an attack channel carries no signal of its own.

    Raises `InvalidValue` for both keys or neither, a name that the plant does not have or
    that comes twice.
    """
    if (channel is None) == (channels is None):
        found = "neither" if channel is None else "both"
        raise InvalidValue("channel, channels", found, "one of the two")
    key = "channels" if channel is None else "channel"
    names = [channel] if channel is not None else list(channels or ())
    known = [f"actuator:{name}" for name in plant.inputs]
    known += [f"sensor:{name}" for name in plant.outputs]
    if recorded is None:
        known += [f"channel:{name}" for name in plant.attacks]
    if not names:
        raise InvalidValue(key, "an empty list", f"one or more of {', '.join(known)}")
    for name in names:
        if recorded is not None and str(name).startswith("channel:"):
            raise InvalidValue(
                key, repr(name), f"a sensor or an actuator ({recorded} plays back its samples)"
            )
        if name not in known:
            raise InvalidValue(key, repr(name), f"one of {', '.join(known)}")
    if len(set(names)) != len(names):
        raise InvalidValue(key, names, "names that differ")
    hit = np.zeros(len(plant.inputs) + len(plant.outputs) + len(plant.attacks), bool)
    hit[[known.index(name) for name in names]] = True
    nu, ny = len(plant.inputs), len(plant.outputs)
    return Channels(*map(jnp.asarray, (hit[:nu], hit[nu : nu + ny], hit[nu + ny :])))
