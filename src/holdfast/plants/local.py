"""A plant near a point, as an estimator of an unknown attack needs it.

x_k = A x_{k-1} + G d_{k-1} + offset + w,    y_k = C x_k + H d_k + offset + v:
exact for linear plants, the tangent at the point for others.
"""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float

from holdfast.numerics.linalg import dot
from holdfast.parts import Plant
from holdfast.plants.linear import LinearPlant


class Motion(NamedTuple):
    """How the state moves; the known input is in ``offset``."""

    A: Float[Array, "n n"]
    G: Float[Array, "n nd"]
    Q: Float[Array, "n n"]
    offset: Float[Array, " n"]


class Sensing(NamedTuple):
    """What the sensors say; the known input is in ``offset``."""

    C: Float[Array, "ny n"]
    H: Float[Array, "ny nd"]
    R: Float[Array, "ny ny"]
    offset: Float[Array, " ny"]


def motion(plant: Plant, k, x, u, d) -> Motion:
    """The step to k about the state ``x`` and the attack ``d`` at k-1."""
    if isinstance(plant, LinearPlant):
        m = plant.at(k, x, u)
        return Motion(m.A, m.G, m.Q, dot(m.B, u))
    Q, _ = plant.noise(k, x, u)
    A, G = plant.jacobian(k, x, u, d)
    return Motion(A, G, Q, plant.transition(k, x, u, d) - dot(A, x) - dot(G, d))


def sensing(plant: Plant, k, x, u, d) -> Sensing:
    """The measurement at k about the state ``x`` and the attack ``d`` at k."""
    if isinstance(plant, LinearPlant):
        m = plant.at(k, x, u)
        return Sensing(m.C, m.H, m.R, dot(m.D, u))
    _, R = plant.noise(k, x, u)
    C, H = jax.jacfwd(lambda x, d: plant.output(k, x, u, d), argnums=(0, 1))(x, d)
    return Sensing(C, H, R, plant.output(k, x, u, d) - dot(C, x) - dot(H, d))
