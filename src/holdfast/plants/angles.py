"""Differences of angles."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float


def shorter_way(
    apart: Float[Array, " ny"], outputs: Sequence[str], angles: Sequence[str]
) -> Float[Array, " ny"]:
    """``apart`` with the outputs that are ``angles`` (rad) turned into (-pi, pi]."""
    if not angles:
        return apart
    turns = jnp.ceil(apart / (2.0 * jnp.pi) - 0.5)
    turning = jnp.asarray([name in angles for name in outputs])
    return apart - jnp.where(turning, 2.0 * jnp.pi * turns, 0.0)
