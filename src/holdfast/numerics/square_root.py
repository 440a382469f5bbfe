"""Covariances as factors W = L L': products, inverses and sums that never square a number."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from holdfast.numerics.linalg import SMALL, solve_lower


def triangle(m: Float[Array, "r n"]) -> Float[Array, "n n"]:
    """R upper triangular with R'R = m'm, r >= n, by Householder reflections.

    Large rows first keeps it accurate row by row. Unrolled up to `SMALL`, so that a loop over
    steps is one compiled kernel.
    """
    n = m.shape[1]
    if n > SMALL:
        return jnp.linalg.qr(m, mode="r")
    rows = []
    for j in range(n):
        column = m[:, j]
        length = jnp.sqrt(jnp.sum(column * column))
        turned = column.at[0].add(jnp.where(column[0] < 0, -length, length))
        size = jnp.sum(turned * turned)
        share = jnp.sum(turned[:, None] * m, 0) * (2.0 / jnp.where(size > 0, size, 1.0))
        m = m - turned[:, None] * share[None, :]
        rows.append(jnp.where(jnp.arange(n) < j, 0.0, m[0]))
        m = m[1:]
    return jnp.stack(rows)


def times(a, b) -> Float[Array, "m q"]:
    """A B (m x q), as a sum that fuses into a loop where both are small."""
    return jnp.sum(a[:, :, None] * b[None], 1) if max(a.shape + b.shape) <= SMALL else a @ b


def informed(L: Float[Array, "n n"], G: Float[Array, "r n"]) -> Float[Array, "n n"]:
    """A factor of (W^-1 + G'G)^-1 with W = L L', which may be singular: L R^-1,
    R'R = I + (G L)' G L.
    """
    n = L.shape[0]
    R = triangle(jnp.concatenate([times(G, L), jnp.eye(n)]))
    return solve_lower(R.T, jnp.ones(n, bool), L.T).T


def forward_step(F, B, G, L) -> Float[Array, "n n"]:
    """A factor of W at i from one, L, at i - 1: F (W^-1 + G'G)^-1 F' + B B'.

    F (n x n), B (n x q), G (r x n), L (n x n).
    """
    moved = times(F, informed(L, G))
    return triangle(jnp.concatenate([moved.T, B.T])).T


def backward_step(F, B, G, T) -> Float[Array, "n n"]:
    """A factor of the cost to come, S = T'T, at i - 1 from one, T, at i:
    F' S (I + B B' S)^-1 F + G'G. Arguments as in `forward_step`.
    """
    n = F.shape[0]
    R = triangle(jnp.concatenate([times(T, B).T, jnp.eye(n)]))
    after = solve_lower(R.T, jnp.ones(n, bool), T)
    return triangle(jnp.concatenate([times(after, F), G]))
