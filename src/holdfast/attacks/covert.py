"""Pushing the plant and taking what that does back out of every sensor."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from holdfast.attacks.channels import Channels, resolve
from holdfast.attacks.effect import effect
from holdfast.attacks.settings import number
from holdfast.attacks.window import active_steps
from holdfast.numerics.linalg import dot
from holdfast.parts import Attack, InvalidValue, Plant
from holdfast.records import Injection, Knowledge


class Covert(Attack):
    """Adds ``push`` to (u, y, d) where first <= k < last, and -(C x^a_k + H a_k) to the outputs
    in ``told``, with x^a_{k+1} = A x^a_k + G a_k, a_k what he adds (`holdfast.attacks.effect`).
    """

    push: Float[Array, " nz"]
    told: Bool[Array, " ny"]
    first: Int[Array, ""]
    last: Int[Array, ""]
    A: Float[Array, "n n"]
    G: Float[Array, "n nz"]
    C: Float[Array, "ny n"]
    H: Float[Array, "ny nz"]

    def init(self, key: PRNGKeyArray, known: Knowledge) -> Float[Array, " n"]:
        """x^a = 0: he has moved nothing yet."""
        return jnp.zeros(self.A.shape[0])

    def step(
        self, state: Float[Array, " n"], known: Knowledge
    ) -> tuple[Float[Array, " n"], Injection]:
        """The push of this step, and what takes its effect so far out of the samples."""
        pushing = (self.first <= known.k) & (known.k < self.last)
        added = jnp.where(pushing, self.push, 0.0)
        shown = dot(self.C, state) + dot(self.H, added)
        nu, ny = known.u.shape[0], known.y.shape[0]
        taken = jnp.where(self.told, -shown, 0.0)
        after = dot(self.A, state) + dot(self.G, added)
        return after, Injection(added[:nu], taken, added[nu + ny :])


def build(
    plant: Plant,
    *,
    size: float,
    channel: str | None = None,
    channels: list[str] | None = None,
    start: float = 0.0,
    stop: float = math.inf,
) -> Covert:
    """Pushes with the constant ``size`` for start <= t < stop, and hides it.

        x^a_k = A x^a_{k-1} + B u^a_{k-1} + G d^a_{k-1},  x^a = 0 at the start
        y^a_k = -(C x^a_k + D u^a_k + H d^a_k)

    The true state is off by x^a, while the samples, and so estimates, verdicts and the
    controller's commands, are those without attack: no detector can do better than chance. It
    takes the plant's matrices, but no knowledge of its state.

    ``channel``, ``channels``: actuators and attack channels named are those that he pushes (none
    named: every actuator), sensors named those that he can falsify (none named: every one). What
    he cannot falsify shows the push, and so does an authenticated sample. After ``stop`` he no
    longer pushes, but goes on hiding for ever what x^a has become. Limits of the plant are not in
    his model: where they act, the push shows.

    Raises `InvalidValue` for a plant that is not linear and constant or has nothing to push, an
    unknown channel, or a setting out of range.

    Source: Smith, A decoupled feedback structure for covertly appropriating networked control
    systems, IFAC World Congress (2011): reference [32] of INTEGRITY.
    """
    matrices = effect(plant, "covert")
    hit = _hit(plant, channel, channels)
    moving, told = jnp.concatenate([hit.u, jnp.zeros_like(hit.y), hit.d]), hit.y
    if not np.any(hit.u) and not np.any(hit.d):
        raise InvalidValue(
            "channels", "no actuator: the plant has no input", "attack channels to push"
        )
    if not np.any(told):
        told = jnp.ones_like(told)
    push = jnp.where(moving, number("size", size), 0.0)
    # no `Window`: what he hides does not end with what he pushes
    first, last = active_steps(plant, start, stop)
    return Covert(push, told, first, last, *map(jnp.asarray, matrices))


def _hit(plant: Plant, channel: str | None, channels: list[str] | None) -> Channels:
    """The channels named, and every actuator where nothing to push is among them."""
    every = [f"actuator:{name}" for name in plant.inputs]
    sizes = (len(names) for names in (plant.inputs, plant.outputs, plant.attacks))
    none = Channels(*(jnp.zeros(size, bool) for size in sizes))
    named = none if channel is None and channels is None else resolve(plant, channel, channels)
    if np.any(named.u) or np.any(named.d) or not every:
        return named
    return Channels(jnp.ones(len(every), bool), named.y, named.d)
