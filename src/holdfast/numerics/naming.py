"""Which channels are attacked: a z-test on each, with one false-alarm budget for all."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import ndtri


def sidak(level: float, most: int) -> np.ndarray:
    """The two-sided limits on |z| of 1, 2, .., ``most`` tests that together alarm at ``level``.

    P(|z_i| <= t_m for all i <= m) = 1 - level: exact for independent z, and never less for
    correlated ones.

    Source: Sidak, J. Amer. Statist. Assoc. 62 (1967).
    """
    each = -np.expm1(np.log1p(-level) / np.arange(1, most + 1))
    return -ndtri(each / 2.0)


def z_values(
    v: Float[Array, " m"], variance: Float[Array, " m"]
) -> tuple[Float[Array, " m"], Bool[Array, " m"]]:
    """|v_i| / sd(v_i), and which i can be tested; 0 for the others.

    A variance of 0 or infinity says that the entry was not seen or not determined.
    """
    used = (variance > 0) & jnp.isfinite(variance)
    return jnp.where(used, jnp.abs(v) / jnp.sqrt(jnp.where(used, variance, 1.0)), 0.0), used


def named(
    d: Float[Array, " nd"],
    variance: Float[Array, " nd"],
    active: Bool[Array, " nd"],
    limits: Float[Array, " m"],
) -> Bool[Array, " nd"]:
    """Which physical channels are really attacked, of those that the mode has as ``active``.

    Channel i is if |d_i| / sd(d_i) > limits[number of channels tested]; ``limits`` has infinity
    for none and then `sidak` for 1, 2, ..: the level is the probability of naming any channel
    where none is attacked, given the mode. The estimates must be of physical channels,
    d = V1 d1 + V2 d2: the singular vectors of H are arbitrary where its values repeat.

    Source: NISME, Algorithm 4, with a budget in place of one level for every test.
    """
    z, used = z_values(d, variance)
    used = used & active
    return used & (z > limits[jnp.sum(used)])
