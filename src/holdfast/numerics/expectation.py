"""Expectation propagation for a Gaussian restricted to many slabs."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from holdfast.numerics.blue import absorb_known
from holdfast.numerics.box_moments import interval
from holdfast.numerics.linalg import dot, lower_factor, symmetric

SWEEPS = 100
SETTLED = 1e-9
"""Change of every slab's mean (in its standard deviations) and variance (relative) in a sweep
under which the sites have settled."""
SHARPEST = 1e9
"""Largest precision of a site, in units of the slab's own prior variance: a slab narrower
than 1e-4 standard deviations counts as that wide, or cavities drown in rounding."""


def propagate(
    mean: Float[Array, " n"],
    cov: Float[Array, "n n"],
    normals: Float[Array, "g n"],
    low: Float[Array, " g"],
    high: Float[Array, " g"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"], Float[Array, ""]]:
    """Approximate mean, covariance and log probability given low <= normals (z - mean) <= high.

    ``normals`` scaled so that each w_i = normals_i (z - mean) has unit variance (a row of
    zeros: no slab); finite bounds. Every slab is replaced by a Gaussian factor, its *site*
    exp(-tau w^2 / 2 + nu w), such that exchanging the site for the slab itself changes neither
    mean nor variance of w_i: slabs in turn, until a sweep changes nothing or `SWEEPS` are over.

    Exact where the w_i are independent. Over 500 random polytopes of 4 to 6 one-sided rows in
    4 dimensions, beside rejection: mean within 0.065 standard deviations of the restricted
    z (median 0.012), standard deviations within 10 % (median 3 %), log probability within 0.09
    (median 0.013). Slabs that say nearly the same count twice: the variance comes out too small.

    Source: Cunningham, Hennig and Lacoste-Julien, arXiv:1111.6832 (2011), Algorithm 1.
    """
    g = normals.shape[0]
    correlation = symmetric(dot(dot(normals, cov), normals.T))
    places = jnp.arange(g)

    def slab(i, carry):
        tau, nu, centre, spread, change = carry
        one = jnp.where(places == i, 1.0, 0.0)
        of_slab = (jnp.sum(a * one) for a in (tau, nu, centre, low, high))
        old_tau, old_nu, m, lowest, highest = of_slab
        column = jnp.sum(spread * one, 1)
        v = jnp.sum(column * one)
        real = v > 0
        v = jnp.where(real, v, 1.0)
        precision, weighted = _cavity(m, v, old_tau, old_nu)
        found, variance, _ = interval(
            weighted / precision, 1.0 / jnp.sqrt(precision), lowest, highest
        )
        new_tau = 1.0 / jnp.maximum(variance, 0.5 / SHARPEST) - precision
        new_tau = jnp.clip(new_tau, 0.0, SHARPEST)
        new_nu = found * (precision + new_tau) - weighted
        # 1 + (new - old) tau v, without the difference
        growth = v * (precision + new_tau)
        spread = spread - ((new_tau - old_tau) / growth * column)[:, None] * column
        step = (new_nu - old_nu - (new_tau - old_tau) * m) / growth
        centre = centre + jnp.where(real, step, 0.0) * column
        moved = jnp.maximum(jnp.abs(found - m) / jnp.sqrt(v), jnp.abs(1.0 / growth - 1.0))
        here = real & (places == i)
        return (
            jnp.where(here, new_tau, tau),
            jnp.where(here, new_nu, nu),
            centre,
            spread,
            jnp.maximum(change, jnp.where(real, moved, 0.0)),
        )

    def sweep(carry):
        count, *sites, _ = carry
        return count + 1, *jax.lax.fori_loop(0, g, slab, (*sites, jnp.zeros(())))

    def unsettled(carry):
        return (carry[0] < SWEEPS) & (carry[-1] > SETTLED)

    zeros = jnp.zeros(g)
    start = (jnp.asarray(0), zeros, zeros, zeros, correlation, jnp.asarray(jnp.inf))
    _, tau, nu, *_ = jax.lax.while_loop(unsettled, sweep, start)

    root = jnp.sqrt(tau)
    seen = jnp.where(tau > 0, nu / jnp.where(tau > 0, root, 1.0), 0.0)
    gain, reduced = absorb_known(cov, root[:, None] * normals)
    log_probability = _log_probability(correlation, tau, nu, seen, low, high)
    return mean + dot(gain, seen), reduced, log_probability


def _cavity(m, v, tau, nu):
    """Precision, and precision times mean, of w_i without its own site.

    Sites only sharpen, so that it is no sharper than the prior's 1: rounding is cut off there.
    """
    return jnp.maximum(1.0 / v - tau, 1.0), m / v - nu


def _log_probability(V, tau, nu, seen, low, high) -> Float[Array, ""]:
    """Of the set, as the sites have it: each slab's over its site's, times the sites' own."""
    g = V.shape[0]
    root = jnp.sqrt(tau)
    gain, spread = absorb_known(V, jnp.diag(root))
    lower, _ = lower_factor(jnp.eye(g) + root[:, None] * V * root)
    centre, v = dot(gain, seen), jnp.diagonal(spread)
    real = v > 0
    precision, weighted = _cavity(centre, jnp.where(real, v, 1.0), tau, nu)
    log_mass = jax.vmap(interval)(weighted / precision, 1.0 / jnp.sqrt(precision), low, high)[2]
    total = precision + tau
    own = 0.5 * (
        jnp.square(weighted + nu) / total - jnp.square(weighted) / precision
        - jnp.log(total / precision)
    )  # fmt: skip
    sites = 0.5 * jnp.sum(nu * centre) - jnp.sum(jnp.log(jnp.diagonal(lower)))
    return sites + jnp.sum(jnp.where(real, log_mass - own, 0.0))
