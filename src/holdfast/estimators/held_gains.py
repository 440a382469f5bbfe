"""Gains that repeat themselves, kept instead of computed again.

Covariances of a bank do not depend on what is measured except through the points where f and h
are linearised. Once no variance and no log-determinant changes by more than a tenth of the
tolerance from one row to the next, the gains are held. They are computed anew at any row where a
sample is missing or authenticated, and once the plant, linearised where it now is, moves errors
of one standard deviation otherwise than it did by more than the tolerance, in standard deviations.

Source: errata 12 of NISME.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from holdfast.estimators import bank
from holdfast.parts import Plant
from holdfast.records import Observation


class Memory(eqx.Module):
    """Covariances and gains after a row; ``level``: logarithms of what must repeat itself;
    ``slope``: how the linearised plant moved the errors; ``settled``: whether they may be held.
    """

    cov: bank.Covariances
    gains: bank.Gains
    level: Float[Array, " l"]
    slope: Float[Array, "s w"]
    settled: Bool[Array, ""]


Refresh = Callable[[bank.Covariances], tuple[bank.Gains, bank.Covariances]]
Slope = Callable[[bank.Covariances, bank.Gains], Float[Array, "s w"]]


def empty(cov: bank.Covariances, refresh: Refresh, slope: Slope) -> Memory:
    """Before the first row: nothing that could be held."""
    shapes = jax.eval_shape(refresh, cov)[0]
    gains = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    sizes = jax.eval_shape(slope, cov, shapes)
    return Memory(
        cov, gains, jnp.zeros(jax.eval_shape(level, shapes, cov).shape), jnp.zeros(sizes.shape),
        jnp.asarray(False),
    )  # fmt: skip


def refreshed(
    memory: Memory, refresh: Refresh, slope: Slope, observation: Observation, tolerance: float
) -> Memory:
    """The memory with gains for this row: those held, or new ones.

    A loop of at most one turn, not a branch: what a branch hands through is copied.
    Gains that are not finite are not taken: the last ones serve, and are not held.
    """
    whole = jnp.all(observation.seen) & ~jnp.any(observation.trusted)
    moved = jnp.max(jnp.abs(slope(memory.cov, memory.gains) - memory.slope)) > tolerance
    start = ~(memory.settled & whole & ~moved), memory

    def compute(carry):
        _, old = carry
        gains, cov = refresh(old.cov)
        now = level(gains, cov)
        change = jnp.max(jnp.abs(now - old.level))
        settled = whole & (change <= 0.1 * tolerance)
        new = Memory(cov, gains, now, slope(cov, gains), settled)
        leaves = jax.tree.leaves(eqx.filter(new, eqx.is_inexact_array))
        ok = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))
        kept = jax.tree.map(lambda a, b: jnp.where(ok, a, b), new, old)
        return jnp.asarray(False), eqx.tree_at(lambda m: m.settled, kept, ok & settled)

    return jax.lax.while_loop(lambda carry: carry[0], compute, start)[1]


def level(gains: bank.Gains, cov: bank.Covariances) -> Float[Array, " l"]:
    """Logarithms of every filter's variances, of its information about the attack, and of the
    determinants in its evidence: what no choice of columns in Z changes.
    """
    n = cov.P.shape[-1]
    variance = jnp.diagonal(cov.P, axis1=-2, axis2=-1)[:, None]
    variance = variance + jnp.sum(cov.Z[:, :, :n] ** 2, -1)
    root = jnp.diagonal(gains.own.root, axis1=-2, axis2=-1)
    prior = jnp.diagonal(gains.own.prior, axis1=-2, axis2=-1)
    logs = [jnp.log(jnp.where(v > 0, v, 1.0)).ravel() for v in (variance, root, prior)]
    return jnp.concatenate([*logs, gains.own.log_det.ravel(), gains.common.log_det])


def slope_of(
    plant: Plant, position, x, u, d, k, scale, cov: Float[Array, "n n"], spread: Float[Array, "p p"]
) -> Float[Array, " w"]:
    """What one error of state and attack becomes after a step and in the measurement, linearised
    at (x, d), in standard deviations of the state (``cov``) and of the innovation (``spread``).
    """
    at = plant.at_position(position)
    sizes = [jnp.sqrt(jnp.maximum(jnp.diagonal(c), 0.0)) for c in (cov, spread)]
    # no two entries alike, so that no change of the linearised plant hides
    n = x.shape[0]
    error = sizes[0] * jnp.asarray(0.5 + np.sqrt(2.0) * np.arange(1, n + 1) % 1.0)
    moved, by_step = jax.jvp(lambda x, d: at.transition(k, x, u, d), (x, d), (error, scale))
    none = jnp.zeros_like(d)
    _, by_output = jax.jvp(lambda x: at.output(k, x, u, none), (moved,), (error,))
    parts = [
        jnp.where(size > 0, v / jnp.where(size > 0, size, 1.0), 0.0)
        for v, size in zip((by_step, by_output), sizes, strict=True)
    ]
    return jnp.concatenate(parts)
