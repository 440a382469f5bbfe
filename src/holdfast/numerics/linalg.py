"""Small dense linear algebra, fast under `jax.jit` at the sizes of live estimators.

XLA's CPU backend runs a matrix product or a factorisation as a call of its own, which at
n = 4 costs more than the arithmetic. Up to `SMALL` everything here is written as sums and
unrolled loops that fuse; above it `jax.numpy.linalg` is faster.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

SMALL = 10
RANK_TOLERANCE = 1e-10
"""Relative size under which a pivot is structurally zero: rounding leaves about 1e-15, a
direction that a sensor sees at all leaves R / (CPC' + R), above 1e-10 unless the prior is
1e10 times vaguer than the sensor."""


def one_at_a_time(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function`` of every entry of a batch in turn, where `jax.vmap` would batch its LAPACK
    calls: two batches of them at a time can wait for each other's threads for ever (jaxlib
    0.10, CPU).
    """
    return jax.custom_batching.sequential_vmap(function)


cholesky = one_at_a_time(jnp.linalg.cholesky)
"""The lower factor of a matrix."""


@one_at_a_time
def forward(lower, b):
    """L^-1 b for a lower triangular L."""
    return jax.scipy.linalg.solve_triangular(lower, b, lower=True)


@one_at_a_time
def backward(lower, b):
    """L^-T b for a lower triangular L."""
    return jax.scipy.linalg.solve_triangular(lower, b, trans=1, lower=True)


def dot(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """A @ b for matrices and vectors, as a fusible sum where the matrices are small.

    A matrix that a batch shares times the batch's vectors is one matrix product of the whole
    batch: seven times faster than 1024 sums.
    """
    if max(a.shape + b.shape, default=0) > SMALL:
        return a @ b
    if a.ndim == 2 and b.ndim == 1:
        return _times_vector(a, b)
    if a.ndim == 1:
        return jnp.sum(a * b, 0) if b.ndim == 1 else jnp.sum(a[:, None] * b, 0)
    return jnp.sum(a[:, :, None] * b[None, :, :], 1)


def _sum_times_vector(a, b):
    return jnp.sum(a * b[None, :], 1)


_times_vector = jax.custom_batching.custom_vmap(_sum_times_vector)


@_times_vector.def_vmap
def _(axis_size, in_batched, a, b):
    of_a, of_b = in_batched
    if of_b and not of_a:
        return b @ a.T, True
    if not (of_a or of_b):
        return _sum_times_vector(a, b), False
    axes = (0 if of_a else None, 0 if of_b else None)
    return jax.vmap(_sum_times_vector, axes)(a, b), True


def sandwich(a: Float[Array, "m n"], p: Float[Array, "n n"]) -> Float[Array, "m m"]:
    """A P A', exactly symmetric."""
    return symmetric(dot(dot(a, p), a.T))


def symmetric(p: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """(P + P') / 2."""
    return 0.5 * (p + p.T)


def repeat(count: int, body: Callable[[Any, Any], Any], carry: Any) -> Any:
    """Carry <- body(i, carry) for i = 0 .. count-1."""
    return jax.lax.fori_loop(0, count, body, carry) if count else carry


def lower_factor(p: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, " n"]]:
    """L, kept with P = L L' for positive semidefinite P; dependent rows get a zero column.

    Rows are taken in order. Where the pivot is structurally zero (under `RANK_TOLERANCE` of
    the row's own diagonal) the row is a combination of earlier ones: ``kept`` is False there.
    """
    n = p.shape[0]
    if n > SMALL:
        return _lower_factor_looped(p)
    lower = [[jnp.zeros(()) for _ in range(n)] for _ in range(n)]
    kept = []
    for j in range(n):
        pivot = p[j, j] - sum(lower[j][i] * lower[j][i] for i in range(j))
        ok = pivot > RANK_TOLERANCE * p[j, j]
        root = jnp.where(ok, jnp.sqrt(jnp.where(ok, pivot, 1.0)), jnp.inf)
        lower[j][j] = jnp.where(ok, root, 0.0)
        kept.append(ok)
        for r in range(j + 1, n):
            lower[r][j] = (p[r, j] - sum(lower[r][i] * lower[j][i] for i in range(j))) / root
    return jnp.array(lower).reshape(n, n), jnp.array(kept, bool)


def lower_inverse(lower: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """L^-1 of a well-conditioned L, row by row without LAPACK, so that it may be batched."""
    n = lower.shape[0]
    if n <= SMALL:
        return solve_lower(lower, jnp.ones(n, bool), jnp.eye(n))
    rows = jnp.arange(n)

    def row(i, inverse):
        unit = jnp.where(rows == i, 1.0, 0.0)
        entries = (unit - lower[i] @ inverse) / lower[i, i]
        return inverse.at[i].set(entries)

    return jax.lax.fori_loop(0, n, row, jnp.zeros_like(lower))


def _lower_factor_looped(p):
    n = p.shape[0]
    rows = jnp.arange(n)

    def column(j, carry):
        lower, kept = carry
        pivot = p[j, j] - jnp.sum(lower[j] * lower[j])
        ok = pivot > RANK_TOLERANCE * p[j, j]
        root = jnp.sqrt(jnp.where(ok, pivot, 1.0))
        entries = jnp.where(ok & (rows >= j), (p[:, j] - lower @ lower[j]) / root, 0.0)
        return lower.at[:, j].set(entries), kept.at[j].set(ok)

    return jax.lax.fori_loop(0, n, column, (jnp.zeros_like(p), jnp.zeros(n, bool)))


def psd_factor(p: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Any F with F F' = P, for positive semidefinite P."""
    if p.shape[0] > SMALL:
        values, vectors = _eigen(p)
        return vectors * jnp.sqrt(jnp.maximum(values, 0.0))
    return lower_factor(p)[0]


@one_at_a_time
def _eigen(p):
    return tuple(jnp.linalg.eigh(p))


def solve_lower(
    lower: Float[Array, "n n"], kept: Bool[Array, " n"], b: Float[Array, "n *m"]
) -> Float[Array, "n *m"]:
    """X with L X = b by forward substitution; rows that are not kept give 0."""
    n = lower.shape[0]
    if n > SMALL:
        safe = jnp.where(kept[:, None], lower, 0.0) + jnp.diag(jnp.where(kept, 0.0, 1.0))
        masked = jnp.where(kept.reshape((n,) + (1,) * (b.ndim - 1)), b, 0.0)
        return forward(safe, masked)
    found: list[Array] = []
    for i in range(n):
        rest = b[i] - sum(lower[i, j] * found[j] for j in range(i))
        found.append(jnp.where(kept[i], rest / jnp.where(kept[i], lower[i, i], 1.0), 0.0))
    return jnp.stack(found) if found else b


def mahalanobis(
    v: Float[Array, " n"], cov: Float[Array, "n n"]
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """V' cov^+ v and its degrees of freedom.

    Entries of zero or infinite variance carry no information and are left out; so are
    dependent rows of a singular covariance (for a v in its range the value is the same
    whichever rows are kept).
    """
    variance = jnp.diagonal(cov)
    used = (variance > 0) & jnp.isfinite(variance)
    scale = jnp.where(used, 1.0 / jnp.sqrt(jnp.where(used, variance, 1.0)), 0.0)
    safe = jnp.where(used[:, None] & used[None, :], cov, 0.0)
    correlation = scale[:, None] * safe * scale[None, :]
    normalised = scale * v
    if v.shape[0] > SMALL:
        values, vectors = _eigen(correlation)
        kept = values > RANK_TOLERANCE * jnp.maximum(values[-1], 1.0)
        squares = (vectors.T @ normalised) ** 2 / jnp.where(kept, values, 1.0)
        return jnp.sum(jnp.where(kept, squares, 0.0)), jnp.sum(kept)
    lower, kept = lower_factor(correlation)
    white = solve_lower(lower, kept, normalised)
    return jnp.sum(white * white), jnp.sum(kept)
