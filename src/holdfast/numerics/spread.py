"""How far noise moves an estimate of least absolute residuals.

Near the truth, minimising sum_i w_i |n_i - Phi_i e| over e means

    sum_i w_i Phi_i' (sign(n_i) - 2 f_i(0) Phi_i e) = 0,     2 f_i(0) = sqrt(2 / pi) / s_i

with s_i the standard deviation of the Gaussian noise n_i: the estimate is linear in the signs,
whose covariance is (2 / pi) arcsin of the correlation. Rows far off (attacked) have a sign that
is given and no curvature: what they pull is a bias, and is added squared. Rows that come first
are least squares, linear in the noise itself, and correlated with the signs by sqrt(2 / pi).

Source: Bassett and Koenker, Asymptotic theory of least absolute error regression, JASA 73 (1978);
for the correlated case the arcsine law (Van Vleck) and Bussgang's theorem.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from holdfast.numerics.linalg import symmetric
from holdfast.numerics.reduced import Reduced, orthonormal
from holdfast.numerics.stacked import StackedNoise

ROOT = math.sqrt(2.0 / math.pi)


class Signs(NamedTuple):
    """Of Gaussian noise: its standard deviations ``sd`` (m,), and the covariance of its signs."""

    sd: Float[Array, " m"]
    cov: Float[Array, "m m"]


def signs(cov: Float[Array, "m m"]) -> Signs:
    """The arcsine law: (2 / pi) arcsin of the correlation."""
    variance = jnp.maximum(jnp.diagonal(cov), 0.0)
    sd = jnp.sqrt(variance)
    inverse = jnp.where(sd > 0, 1.0 / jnp.where(sd > 0, sd, 1.0), 0.0)
    correlation = jnp.clip(cov * inverse[:, None] * inverse, -1.0, 1.0)
    return Signs(sd, 2.0 / math.pi * jnp.arcsin(correlation))


class Errors(NamedTuple):
    """Covariances: ``x`` (n x n) of the last state, ``residual`` (p x p) of the last p rows."""

    x: Float[Array, "n n"]
    residual: Float[Array, "p p"]


class Influence(NamedTuple):
    """What each weighted row moves the first state by: back (C' k C)^-1 C' (n x m), C being the
    reduced columns and k the curvatures; ``known``: whether rows with curvature determine it.
    """

    gain: Float[Array, "n m"]
    known: Bool[Array, ""]


def influence(problem: Reduced, curvature: Float[Array, " m"]) -> Influence:
    """By orthonormal columns of the root: no normal equations are solved."""
    half = jnp.sqrt(curvature)[:, None] * problem.columns
    size = jnp.sqrt(jnp.sum(half * half, 0))
    size = jnp.where(size > 0, size, 1.0)
    found = orthonormal(half / size)
    by = found.by / size[:, None]
    return Influence(problem.back @ (by @ (by.T @ problem.columns.T)), found.rank >= problem.free)


def of_signs(
    problem: Reduced, weight: Float[Array, " m"], sd: Float[Array, " m"], far: Bool[Array, " m"]
) -> Influence:
    """The same for the sign of every row; ``far`` rows have no curvature."""
    inside = (weight > 0) & ~far & (sd > 0)
    curvature = jnp.where(inside, ROOT / jnp.where(inside, sd * weight, 1.0), 0.0)
    return influence(problem, curvature)


def errors(
    Phi: Float[Array, "m n"],
    last: Float[Array, "n n"],
    noise: StackedNoise,
    law: Signs,
    lead: Float[Array, "n m"],
    gain: Float[Array, "n m"],
    pulled: Float[Array, " n"],
    p: int,
) -> Errors:
    """Covariances of x_last = last (lead y + gain sign(..)), and of the last p residuals.

    ``law``: of the noise that the signs are of, which is n - Phi lead n; ``pulled`` (n,): what
    the attacked rows move the first state by.
    """
    scale = jnp.where(law.sd > 0, ROOT / jnp.where(law.sd > 0, law.sd, 1.0), 0.0)
    own = noise.cov - noise.cov @ lead.T @ Phi.T
    # of the noise with the first state's error
    with_error = noise.cov @ lead.T + (own * scale) @ gain.T
    mixed = lead @ (own * scale) @ gain.T
    first = (
        symmetric(lead @ noise.cov @ lead.T + gain @ law.cov @ gain.T + mixed + mixed.T)
        + pulled[:, None] * pulled
    )
    # of the first state's error with what the process noise leaves outside the window's reach
    outside = noise.cross - Phi @ (lead @ noise.cross)
    to_last = last @ (lead @ noise.cross + gain @ (scale[:, None] * outside))
    x = symmetric(last @ first @ last.T + noise.extra - to_last - to_last.T)
    rows = Phi[-p:] if p else Phi[:0]
    back = rows @ with_error[len(Phi) - p :].T
    residual = symmetric(
        noise.cov[len(Phi) - p :, len(Phi) - p :] + rows @ first @ rows.T - back - back.T
    )
    return Errors(x, residual)
