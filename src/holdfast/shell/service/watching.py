"""How far every sensor is from what the estimate expects of it, whether it is fused or not."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from holdfast.parts import Plant, no_attack
from holdfast.records import Estimate, Observation

Watch = Callable[[int, Estimate, Observation], np.ndarray]
"""Squared innovations over their variance of the outputs that were not fused."""


def watch_of(plant: Plant) -> Watch:
    """The function for a plant, compiled.

    A sample that the estimate x, P has not used is off what is expected by h(x) - y, whose
    variance is that of C x and that of its own noise, C being h's slope at x.
    """
    d = no_attack(plant)

    @jax.jit
    def squares(k, x, P, u, y):
        C = jax.jacfwd(lambda at: plant.output(k, at, u, d))(x)
        _, R = plant.noise(k, x, u)
        apart = plant.innovation(y, plant.output(k, x, u, d))
        variance = jnp.sum((C @ jnp.where(jnp.isfinite(P), P, 0.0)) * C, 1) + jnp.diag(R)
        unknown = jnp.any((C != 0) & ~jnp.isfinite(jnp.diag(P)), 1)
        return jnp.where((variance > 0) & ~unknown, apart**2 / variance, jnp.nan)

    def watch(k: int, estimate: Estimate, observation: Observation) -> np.ndarray:
        u = np.nan_to_num(np.asarray(observation.u))
        y = np.asarray(observation.y)
        found = squares(np.int32(k), estimate.x, estimate.x_cov, u, y)
        return np.asarray(found)

    n = len(plant.states)
    zero = np.zeros((n, n))
    squares(np.int32(1), np.zeros(n), zero, np.zeros(len(plant.inputs)),
            np.zeros(len(plant.outputs)))  # fmt: skip
    return watch


def fused_squares(estimate: Estimate) -> np.ndarray:
    """Squared innovations over their variance of the outputs that were fused; NaN of others."""
    # a record's attributes cost more to look up than these sums
    fields = vars(estimate)
    residual, variance = fields["residual"], fields["residual_cov"].diagonal()
    known = (variance > 0) & (variance < np.inf)
    squares = np.full(residual.shape, np.nan)
    return np.divide(residual * residual, variance, out=squares, where=known)
