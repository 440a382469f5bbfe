"""Streams of records made to measure, and a detector run over them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from holdfast.plants.build import linear_plant
from holdfast.records import Estimate


def plant_of(ny: int, nd: int = 0):
    """Any plant with so many outputs and attack channels: detectors ask for no more."""
    return linear_plant(A=[[0.5]], C=np.ones((ny, 1)), G=np.ones((1, nd)), Q=[[1.0]], R=np.eye(ny))


def records(values, covs, on="residual") -> Estimate:
    """Records whose tested quantity is ``values`` (..., m) with ``covs`` (..., m, m)."""
    values, covs = jnp.asarray(values, float), jnp.asarray(covs, float)
    lead = values.shape[:-1]
    nothing = (jnp.zeros((*lead, 0)), jnp.zeros((*lead, 0, 0)))
    x = (jnp.zeros((*lead, 1)), jnp.zeros((*lead, 1, 1)))
    d = (values, covs) if on == "attack" else nothing
    residual = nothing if on == "attack" else (values, covs)
    rows = (jnp.zeros((*lead, 0, d[0].shape[-1])), jnp.zeros((*lead, 0)))
    return Estimate(*x, *d, *d, *rows, *residual, jnp.zeros(lead, jnp.int32))


@eqx.filter_jit
def judge(detector, estimates):
    """The verdicts over a stream, time along the leading axis."""
    return jax.lax.scan(lambda *row: detector.step(*row), detector.init(), estimates)[1]


@eqx.filter_jit
def judge_white(detectors, key, runs: int, steps: int, missing, m: int):
    """Alarms and thresholds (run, time, detector) over white residuals of size m.

    Each entry is missing with probability ``missing``.
    """

    def run(key):
        values, gaps = jax.random.split(key)
        v = jax.random.normal(values, (steps, m))
        seen = jax.random.uniform(gaps, (steps, m)) >= missing
        v = jnp.where(seen, v, 0.0)
        both = seen[:, :, None] & seen[:, None, :]
        covs = jnp.where(both, jnp.eye(m), 0.0)

        def step(states, row):
            estimate = records(*row)
            pairs = [d.step(s, estimate) for d, s in zip(detectors, states, strict=True)]
            said = [(verdict.alarm, verdict.threshold) for _, verdict in pairs]
            alarm, threshold = map(jnp.stack, zip(*said, strict=True))
            return tuple(state for state, _ in pairs), (alarm, threshold)

        start = tuple(detector.init() for detector in detectors)
        return jax.lax.scan(step, start, (v, covs))[1]

    return jax.vmap(run)(jax.random.split(key, runs))
