"""Attack-free runs of a monitor: where they start, how long they may be, what it says."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray

from holdfast.loop import Monitor, Scenario, simulate
from holdfast.numerics.linalg import dot, psd_factor
from holdfast.parts import Controller, Estimator, Plant
from holdfast.plants.linear import LinearPlant

BATCH = 250
"""Runs simulated side by side: more no longer fit the cache."""
GROWTH = 1e8
"""How far an unstable plant may run: rounding errors grow with its state."""


class Judged(NamedTuple):
    """What a detector said over many runs; axes run, time, then the detector's own."""

    statistic: Float[Array, "runs t *m"]
    threshold: Float[Array, "runs t *m"]
    alarm: Bool[Array, "runs t *m"]


def start_state(estimator: Estimator, key: PRNGKeyArray) -> Float[Array, " n"]:
    """A true x0 as the estimator believes it: N(x0, P0), its mean where that is unknown."""
    _, initial = estimator.init()
    known = jnp.isfinite(jnp.diagonal(initial.x_cov))
    cov = jnp.where(known[:, None] & known[None, :], initial.x_cov, 0.0)
    return jnp.asarray(initial.x) + dot(psd_factor(cov), jax.random.normal(key, initial.x.shape))


def horizon(plant: Plant, controller: Controller | None) -> int | None:
    """How many rows a run may have: per-step matrices end, unstable plants run away."""
    if not isinstance(plant, LinearPlant):
        return None
    limits = [] if plant.steps is None else [plant.steps]
    x, u = jnp.zeros(len(plant.states)), jnp.zeros(len(plant.inputs))
    radius = np.max(np.abs(np.linalg.eigvals(np.asarray(plant.at(1, x, u).A))))
    if controller is None and radius > 1.0 + 1e-7:
        limits.append(max(2, int(np.log(GROWTH) / np.log(radius))))
    return min(limits, default=None)


def attack_free(
    monitor: Monitor, controller: Controller | None, keys: Key[Array, " runs"], steps: int
) -> Judged:
    """The verdicts of ``steps`` rows without attack, one run per key."""
    return over_runs(lambda some: _attack_free(monitor, controller, some, steps), keys)


@eqx.filter_jit
def _attack_free(
    monitor: Monitor, controller: Controller | None, keys: Key[Array, " runs"], steps: int
) -> Judged:
    def run(key: PRNGKeyArray) -> Judged:
        start_key, run_key = jax.random.split(key)
        x0 = start_state(monitor.estimator, start_key)
        scenario = Scenario(monitor.estimator.plant, x0, monitor, controller)
        verdict = simulate(scenario, run_key, steps).verdict
        said = (verdict.statistic, verdict.threshold, verdict.alarm)
        return Judged(*map(jnp.asarray, said))

    return jax.vmap(run)(keys)


def over_runs(batch: Callable[[Array], Any], keys: Key[Array, " runs"]) -> Any:
    """``batch`` over `BATCH` keys at a time, so that it is compiled once for any number of runs.

    The last batch is filled up with keys met before; what it says of those is dropped.
    """
    runs = keys.shape[0]
    filled = keys[jnp.arange(-(-runs // BATCH) * BATCH) % runs]
    parts = [batch(filled[i : i + BATCH]) for i in range(0, filled.shape[0], BATCH)]
    return jax.tree.map(lambda *rows: np.concatenate(rows)[:runs], *parts)
