"""Feedback linearisation of a power network: every bus is steered to its own angle."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from holdfast.parts import Controller, InvalidValue
from holdfast.plants.library.swing import SwingNetwork, operating_point
from holdfast.records import Estimate


class Linearising(Controller):
    """The input of `linearised` from the estimate, held until the next sample."""

    plant: SwingNetwork
    target: Float[Array, " n"]
    gains: Float[Array, "2"]

    def command(self, estimate: Estimate) -> Float[Array, " n"]:
        """The input to apply over the next sample."""
        theta, f = jnp.split(jnp.asarray(estimate.x), 2)
        return linearised(self.plant, theta, f, self.target, self.gains)


def linearised(
    plant: SwingNetwork,
    theta: Float[Array, " n"],
    f: Float[Array, " n"],
    target: Float[Array, " n"],
    gains: Float[Array, "2"],
) -> Float[Array, " n"]:
    """U with which f' = -g1 (theta - target) - g2 f while no switch is thrown.

    u = D f + flow(theta) + demand + m (-g1 (theta - target) - g2 f), the flow that of the
    normal position of the switches: whoever steers does not know what an attacker has opened.

    theta, target (rad), f (rad/s), u (per unit): one per bus; gains in 1/s^2 and 1/s.

    Source: NISME, Section 7 ("backstepping inspired"), unstated there; errata 11.
    """
    normal = plant.at_position(jnp.asarray(0, jnp.int32))
    wished = -gains[0] * (theta - target) - gains[1] * f
    return plant.damping * f + normal.flow(theta) + plant.demand + plant.inertia * wished


def build(plant: SwingNetwork, *, gains: list[float] | None = None) -> Linearising:
    """The feedback that holds each bus at its angle of the operating point.

    ``gains``: two numbers above 0, of theta (1/s^2) and of f (1/s); default 2 and 2.

    Raises `InvalidValue` for gains that do not stabilise.
    """
    found = [2.0, 2.0] if gains is None else gains
    if len(found) != 2 or not all(0.0 < gain < float("inf") for gain in found):
        raise InvalidValue("gains", found, "two finite numbers above 0")
    target, _ = jnp.split(operating_point(plant), 2)
    return Linearising(plant, target, jnp.asarray(found, float))
