"""The Kalman correction as matrices that can be kept, whatever is measured.

For an innovation nu = C e + v, e ~ (0, P), v ~ (0, R), with S = C P C' + R over what was seen:
T with T S T' = I, so that T nu is white; U = P C' T', so that x + U (T nu) is the estimate; the
covariance after the correction in Joseph's form; log |S|.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float

from holdfast.numerics.linalg import SMALL, dot, one_at_a_time, repeat, symmetric

ROUNDING = 1e-14
"""Share of |C| |P| |C'| below which C P C' is the rounding of what it is a difference of. A row
about which no more is known before it than that is not used: its gain would be noise, of any
size. It takes a P of 1e14 times the noise."""


class Correction(NamedTuple):
    """What a row of measurements does; rows and columns that were not seen are zero.

    ``white`` T (p x p), ``moves`` U (n x p), ``cov`` after the correction, ``log_det``
    log |S| plus p log 2 pi, p the number of rows seen.
    """

    white: Float[Array, "p p"]
    moves: Float[Array, "n p"]
    cov: Float[Array, "n n"]
    log_det: Float[Array, ""]


Whitener = Callable[
    [Float[Array, "p p"], Bool[Array, " p"]], tuple[Float[Array, "p p"], Float[Array, "p p"]]
]


def correction(
    P: Float[Array, "n n"],
    C: Float[Array, "p n"],
    R: Float[Array, "p p"],
    whiten: Whitener,
    seen: Bool[Array, " p"],
) -> Correction:
    """The correction of P by the rows of C that were seen.

    ``whiten(R, seen)``: W with W R W' = I on those rows and zero elsewhere, and its inverse
    there. Small states take the rows one at a time, so that nothing is inverted and nothing
    calls LAPACK (which may be batched); large ones factorise S.
    """
    if P.shape[0] > SMALL:
        return _factorised(P, jnp.where(seen[:, None], C, 0.0), R, seen)
    return _row_by_row(P, C, *whiten(R, seen), seen)


def _row_by_row(P, C, W, W_inverse, seen) -> Correction:
    p, n = C.shape
    M = dot(W, C)
    rows = jnp.arange(p)

    def row(i, carry):
        P, gain, white, moves, log_det = carry
        h, here = M[i], rows == i
        along = dot(P, h)
        known = dot(h, along)
        told = known > ROUNDING * dot(jnp.abs(h), dot(jnp.abs(P), jnp.abs(h)))
        along = jnp.where(told, along, 0.0)
        spread = jnp.where(told, known, 0.0) + 1.0
        k, rest = along / spread, jnp.where(here, 1.0, 0.0) - dot(h, gain)
        kept = P - k[:, None] * along
        P = kept + (k - dot(kept, h))[:, None] * k  # Joseph's form, with unit noise
        root = jnp.sqrt(spread)
        white = jnp.where(here[:, None], rest / root, white)
        moves = jnp.where(here, (k * root)[:, None], moves)
        return P, gain + k[:, None] * rest, white, moves, log_det + jnp.log(spread)

    start = (P, jnp.zeros((n, p)), jnp.zeros((p, p)), jnp.zeros((n, p)), jnp.asarray(0.0))
    P, _, white, moves, log_det = repeat(p, row, start)
    noise = jnp.where(seen, jnp.diagonal(W_inverse), 1.0)
    size = 2.0 * jnp.sum(jnp.log(noise)) + _constant(seen)
    return Correction(dot(white, W), jnp.where(seen, moves, 0.0), symmetric(P), log_det + size)


@one_at_a_time
def _factorised(P, C, R, seen) -> Correction:
    """From the factor of S, unless it hides the noise: then row by row."""
    CP, noise = C @ P, jnp.where(seen[:, None] & seen[None, :], R, 0.0)
    noise = noise + jnp.diag(jnp.where(seen, 0.0, 1.0))
    known = symmetric(CP @ C.T)
    lower = jnp.linalg.cholesky(known + noise)
    kept = jnp.all(ROUNDING * jnp.diagonal(known) < jnp.diagonal(noise))

    def whole():
        white = solve_triangular(lower, jnp.diag(seen.astype(float)), lower=True)
        moves = (white @ CP).T
        gain = moves @ white
        log_det = 2.0 * jnp.sum(jnp.log(jnp.diagonal(lower))) + _constant(seen)
        rest = P - gain @ CP  # (I - KC) P; then Joseph's form, in fewer products
        cov = symmetric(rest - (rest @ C.T - _times(gain, noise)) @ gain.T)
        return Correction(white, moves, cov, log_det)

    def slow():
        half = jnp.linalg.cholesky(noise)
        inverse = solve_triangular(half, jnp.diag(seen.astype(float)), lower=True)
        found = _row_by_row(P, C, inverse, half, seen)
        # what rounding has left of P is not known: a variance, or P would be indefinite
        left = ROUNDING * jnp.max(jnp.diagonal(P)) * jnp.eye(P.shape[0])
        return found._replace(cov=found.cov + left)

    return jax.lax.cond(kept & jnp.all(jnp.isfinite(lower)), whole, slow)


def _times(gain, noise):
    """K R, at once where no sensor shares its noise with another."""
    alone = jnp.diagonal(noise)
    shared = jnp.any(noise != jnp.diag(alone))
    return jax.lax.cond(shared, lambda: gain @ noise, lambda: gain * alone)


def _constant(seen: Bool[Array, " p"]) -> Float[Array, ""]:
    return math.log(2.0 * math.pi) * jnp.sum(seen.astype(float))
