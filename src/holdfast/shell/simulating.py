"""Many runs of a scenario, in blocks, with a progress bar where somebody watches."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from holdfast.loop import Scenario, simulate
from holdfast.records import Trace
from holdfast.shell.errors import InputError
from holdfast.shell.progress import progress
from holdfast.shell.reading import size_in_words

MOST_BYTES = 8 * 2**30
"""Memory that the records of all runs may take."""
SMALL = 1_000_000
"""Rows in all up to which no record is too large to be worth the tracing."""
BLOCK_ROWS = 200_000
"""Rows simulated at a time: large enough to be fast, small enough to show progress."""


def simulated(
    scenario: Scenario, steps: int, runs: int, seed: int, file: str
) -> tuple[Trace, np.ndarray]:
    """The records of all runs, and the times of the rows (the first is at dt).

    A single run has no leading axis. Run i has the same noise whatever the number of runs.
    """
    key = jax.random.key(seed)
    time = scenario.plant.dt * np.arange(1, steps + 1)
    _check_size(scenario, steps, runs, file)
    if runs == 1:
        trace = simulate(scenario, jax.random.fold_in(key, 0), steps)
        return jax.tree.map(np.asarray, trace), time
    block = max(1, min(runs, BLOCK_ROWS // steps))
    parts = []
    with progress("runs", runs) as advance:
        for start in range(0, runs, block):
            numbers = jnp.arange(start, min(start + block, runs))
            keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(numbers)
            parts.append(jax.tree.map(np.asarray, _many(scenario, keys, steps)))
            advance(len(numbers))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts), time


@eqx.filter_jit
def _many(scenario: Scenario, keys: jax.Array, steps: int) -> Trace:
    return jax.vmap(lambda key: simulate(scenario, key, steps))(keys)


def _check_size(scenario: Scenario, steps: int, runs: int, file: str) -> None:
    if steps * runs <= SMALL:
        return
    record: Any = eqx.filter_eval_shape(simulate, scenario, jax.random.key(0), 1)
    row = sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(record))
    if row * steps * runs > MOST_BYTES:
        raise InputError(
            file,
            "run",
            f"{runs} runs of {steps} steps, {size_in_words(row * steps * runs)} of records",
            f"fewer runs or steps: at most {size_in_words(MOST_BYTES)}",
        )
