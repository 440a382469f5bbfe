"""Runs of a scenario in blocks of a fixed size, each run with a key of its own.

A block has always the same shape, so one compiled program serves any number of runs, and what
a run gives depends neither on how many there are nor on who computes which block.
"""

import hashlib
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Key, PRNGKeyArray

from holdfast.campaign.attack_free import start_state
from holdfast.campaign.run_scores import AsChannels, as_channels, margins, run_scores
from holdfast.loop import Scenario, simulate
from holdfast.records import Trace

BLOCK = 256
"""Runs side by side: more no longer fit the cache."""


class Case(eqx.Module):
    """A point of a study: what is simulated, how long, and where a run starts.

    ``drawn``: the true start is drawn from what the estimator believes, else it is the
    scenario's.
    """

    scenario: Scenario
    maps: AsChannels | None
    steps: int = eqx.field(static=True)
    drawn: bool = eqx.field(static=True)


class Block(NamedTuple):
    """What the runs of a block gave: every score run by run, and how often statistic /
    threshold lay in each bin in all of them together.
    """

    scores: dict[str, np.ndarray]
    benign: np.ndarray
    attacked: np.ndarray


def case_of(scenario: Scenario, steps: int, drawn: bool) -> Case:
    """A point ready to be run."""
    return Case(scenario, as_channels(scenario.plant), steps, drawn)


def point_key(seed: int, name: str) -> PRNGKeyArray:
    """The key of a point of a study, from what the point is called and not from its place:
    points can be added to a study without changing the others.
    """
    digest = hashlib.sha256(name.encode()).digest()
    key = jax.random.key(seed)
    for start in (0, 4, 8, 12):
        key = jax.random.fold_in(key, int.from_bytes(digest[start : start + 4], "big"))
    return key


def single(case: Case, key: PRNGKeyArray, run: int) -> Trace:
    """The record of run number ``run`` of a point."""
    # as an array: a number would be part of the program, which each run would compile again
    return _single(case, key, jnp.asarray(run))


@eqx.filter_jit
def _single(case: Case, key: PRNGKeyArray, run: Int[Array, ""]) -> Trace:
    return _simulated(case, jax.random.fold_in(key, run))


def block(case: Case, key: PRNGKeyArray, number: int, runs: int) -> Block:
    """Block ``number`` of a point of ``runs`` runs; its last runs are left out beyond them."""
    first = number * BLOCK
    count = min(BLOCK, runs - first)
    numbers = jnp.arange(BLOCK)
    found, benign, attacked = _block(case, key, first + numbers, numbers < count)
    scores = {name: np.asarray(values)[:count] for name, values in found.items()}
    return Block(scores, np.asarray(benign), np.asarray(attacked))


@eqx.filter_jit
def _block(case: Case, key: PRNGKeyArray, numbers, used: Bool[Array, " runs"]) -> Any:
    keys: Key[Array, " runs"] = jax.vmap(jax.random.fold_in, (None, 0))(key, numbers)

    def run(key, used):
        trace = _simulated(case, key)
        counts = jax.tree.map(lambda c: jnp.where(used, c, 0), margins(trace))
        return run_scores(case.scenario, trace, case.maps), counts

    scores, (benign, attacked) = jax.vmap(run)(keys, used)
    return scores, jnp.sum(benign, 0), jnp.sum(attacked, 0)


def _simulated(case: Case, key: PRNGKeyArray) -> Trace:
    scenario = case.scenario
    if case.drawn:
        start, key = jax.random.split(key)
        x0 = start_state(scenario.monitor.estimator, start)
        scenario = eqx.tree_at(lambda s: s.x0, scenario, x0)
    return simulate(scenario, key, case.steps)
