"""Whether the covariances of the unknown-input estimator settle: by running them."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from holdfast.analysis.model import Model
from holdfast.estimators import unknown_input
from holdfast.estimators.unknown_input import UnknownInput
from holdfast.plants.build import linear_plant
from holdfast.records import Estimate, Observation

MOST = 4096
"""Steps that the recursion is run for at most; a power of two times `FIRST`."""
FIRST = 64
SETTLED = 1e-6
"""Relative change of a variance while the number of steps doubles that counts as none."""
GROWTH = 1.9
"""Ratio of what the last doubling added to what the one before it added, from which on the
growth is undiminished: 2 for a random walk; under it for a zero at z where 1 - |z| > 2e-5."""
OVERFLOW = 1e100
"""A variance at which the recursion need not go on."""


class Bounds(NamedTuple):
    """``attack`` and ``state``: name -> True (settled or falling), False (growth undiminished,
    or not determined at all), None (neither could be told within ``steps``).
    """

    delay: int
    steps: int
    attack: dict[str, bool | None]
    state: dict[str, bool | None]


def bounds(model: Model, P0: np.ndarray, delay: int) -> Bounds:
    """The covariance recursion of `unknown_input` from ``P0`` (n x n), which no data enter.

    It runs until the variances have changed by under `SETTLED` while the number of steps
    doubled, or for `MOST` steps.
    """
    plant = linear_plant(A=model.A, G=model.G, C=model.C, H=model.H, Q=model.Q, R=model.R)
    n = len(model.states)
    estimator = unknown_input.build(plant, np.zeros(n), P0, delay=delay)
    observation = Observation.of(np.zeros(0), np.zeros(len(model.outputs)))
    values, steps = (np.asarray(v) for v in _run(estimator, observation))
    verdicts = [_verdict(*of) for of in values.T]
    return Bounds(
        delay,
        int(steps),
        dict(zip(model.attacks, verdicts[n:], strict=True)),
        dict(zip(model.states, verdicts[:n], strict=True)),
    )


def _verdict(first: float, second: float, last: float) -> bool | None:
    """From the variance after a quarter of the steps, half of them and all."""
    if not np.isfinite(last) or last > OVERFLOW:
        return False
    if last - second <= SETTLED * last:
        return True
    return False if last - second > GROWTH * (second - first) else None


@eqx.filter_jit
def _run(
    estimator: UnknownInput, observation: Observation
) -> tuple[Float[Array, "t m"], Int[Array, ""]]:
    """The variances of (x, d) after a quarter of the steps, half and all; and the steps."""

    def one(_, carry):
        state, estimate = estimator.step(carry[0], observation)
        return state, _variances(estimate)

    def advance(carry):
        state, values, steps = carry
        state, new = jax.lax.fori_loop(0, steps, one, (state, values[2]))
        return state, jnp.stack([values[1], values[2], new]), 2 * steps

    def moving(carry):
        _, values, steps = carry
        before, now = values[1], values[2]
        known = ~jnp.isinf(now)
        still = jnp.any(known & ~(jnp.abs(now - before) <= SETTLED * now))
        small = jnp.all(~known | (now < OVERFLOW))
        return (steps < 4 * FIRST) | (still & small & (steps < MOST))

    state, estimate = estimator.init()
    state, now = jax.lax.fori_loop(0, FIRST, one, (state, _variances(estimate)))
    start = (state, jnp.stack([now, now, now]), jnp.asarray(FIRST, jnp.int32))
    _, values, steps = jax.lax.while_loop(moving, advance, start)
    return values, steps


def _variances(estimate: Estimate) -> Float[Array, " m"]:
    diagonals = jnp.diagonal(jnp.asarray(estimate.x_cov)), jnp.diagonal(jnp.asarray(estimate.d_cov))
    return jnp.concatenate(diagonals)
