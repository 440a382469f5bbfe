"""An estimate beside the polytope that physics allows, whatever is known of either."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.linalg import RANK_TOLERANCE


class Limited(NamedTuple):
    """An estimate and the limits that act on it; its entries of infinite variance have none.

    ``cov`` is 0 where it was infinite, ``bound`` +inf for rows that touch such an entry.
    """

    value: Float[Array, " m"]
    cov: Float[Array, "m m"]
    rows: Float[Array, "r m"]
    bound: Float[Array, " r"]
    unknown: Bool[Array, " m"]

    @classmethod
    def of(cls, value, cov, rows, bound) -> "Limited":
        """From an estimate as a record has it: infinite variance = undetermined."""
        unknown = ~jnp.isfinite(jnp.diagonal(cov))
        known = jnp.where(unknown[:, None] | unknown[None, :], 0.0, cov)
        touched = jnp.any((rows != 0) & unknown, 1)
        return cls(value, known, rows, jnp.where(touched, jnp.inf, bound), unknown)

    def told(self, cov: Float[Array, "m m"]) -> Float[Array, "m m"]:
        """``cov`` with the infinite variances back in place."""
        place = self.unknown[:, None] & jnp.eye(len(self.unknown), dtype=bool)
        return jnp.where(place, jnp.inf, cov)


def pseudo_distance(
    value: Float[Array, " m"], cov: Float[Array, "m m"], before: Float[Array, "m m"]
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """V' P^+ v with the Moore-Penrose inverse of a projected covariance P, and P's rank.

    The rank is judged in units of the deviations that ``before``, the covariance before the
    projection, gives: what is left of a variance below `RANK_TOLERANCE` of it is rounding.
    Entries undetermined before (infinite variance) are left out. A v outside the range of P,
    as a point on a face is, loses that part; its value then depends on the units of v.

    Source: CARE (2), (22) with errata 4 and 6.
    """
    variance = jnp.diagonal(before)
    used = (variance > 0) & jnp.isfinite(variance)
    scale = jnp.where(used, 1.0 / jnp.sqrt(jnp.where(used, variance, 1.0)), 0.0)
    held = jnp.where(used[:, None] & used[None, :], cov, 0.0)
    relative = jnp.linalg.eigvalsh(scale[:, None] * held * scale[None, :])
    rank = jnp.sum(relative > RANK_TOLERANCE)
    values, vectors = jnp.linalg.eigh(held)
    kept = jnp.arange(value.shape[0]) >= value.shape[0] - rank
    along = jnp.where(used, value, 0.0) @ vectors
    return jnp.sum(jnp.where(kept, along**2 / jnp.where(kept, values, 1.0), 0.0)), rank
