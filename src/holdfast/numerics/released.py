"""Least squares over some of the columns, which are marked row by row of a log."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from holdfast.numerics.linalg import RANK_TOLERANCE, backward, cholesky, dot, forward


class Released(NamedTuple):
    """Least squares over marked columns: (Z_A Z_A')^-1, rows and columns scaled to one.

    ``dependent``: some marked column is a combination of others, and nothing is solved.
    """

    marked: Bool[Array, " M"]
    scale: Float[Array, " M"]
    lower: Float[Array, "M M"]
    dependent: Bool[Array, ""]

    @classmethod
    def of(cls, columns: Float[Array, "M r"], marked: Bool[Array, " M"]) -> "Released":
        """The factor of the Gram matrix of the marked columns."""
        length = jnp.sqrt(jnp.sum(columns**2, 1))
        scale = jnp.where(marked & (length > 0), 1.0 / jnp.where(length > 0, length, 1.0), 0.0)
        unit = scale[:, None] * columns
        gram = dot(unit, unit.T)
        lower = cholesky(gram + jnp.diag(jnp.where(marked, RANK_TOLERANCE**1.5, 1.0)))
        pivots = jnp.where(marked, jnp.diagonal(lower) ** 2, 1.0)
        dependent = ~jnp.all(pivots > RANK_TOLERANCE)
        return cls(marked, scale, jnp.where(dependent, jnp.eye(len(marked)), lower), dependent)

    def half(self, b: Float[Array, "M *k"]) -> Float[Array, "M *k"]:
        """H with H' H = b' (Z_A Z_A')^-1 b."""
        shape = (-1,) + (1,) * (b.ndim - 1)
        scaled = self.scale.reshape(shape) * b
        return forward(self.lower, scaled)

    def solve(self, b: Float[Array, " M"]) -> Float[Array, " M"]:
        """(Z_A Z_A')^-1 b on the marked columns, 0 elsewhere."""
        return self.scale * backward(self.lower, self.half(b))
