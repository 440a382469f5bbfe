"""Runs of a linear plant under attacks on its sensors, many seeds at a time (DECODER, Section V).

The attacks do not look at the samples, so that they are drawn beforehand; the noises are the
same for every estimator and every size of attack.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from holdfast.estimators.l1_kalman import L1KalmanState
from holdfast.numerics.linalg import dot
from holdfast.parts import Attack, Estimator, no_attack
from holdfast.plants.linear import LinearPlant
from holdfast.records import Knowledge, Observation

Steered = Literal["truth", "estimate", "decoded"]
"""The state that u is computed from; "decoded": what the decoder inside `l1_kalman` says."""
Oracle = Literal["none", "subtract", "leave out"]
"""What of the attack the estimator is told: nothing, all of it, or which samples are attacked."""


class Course(NamedTuple):
    """The state x_r (N x n) that is wanted at each step, and the input u_r (N x nu) that, without
    noise, leads from one to the next. u = u_r - K (x - x_r) over the following step.
    """

    x: np.ndarray
    u: np.ndarray


class Air(NamedTuple):
    """What does not depend on the estimator: ``w`` (seeds x N x n), ``v`` and the attack ``e``
    (seeds x N x p).
    """

    w: np.ndarray
    v: np.ndarray
    e: np.ndarray


class Flown(NamedTuple):
    """Truth, samples and what the estimator says, seeds first, then steps.

    ``decoded``: the state of the decoder inside `l1_kalman`, else ``estimate`` once more.
    """

    x: np.ndarray
    u: np.ndarray
    y: np.ndarray
    estimate: np.ndarray
    decoded: np.ndarray
    a: np.ndarray
    status: np.ndarray


def air(
    plant: LinearPlant, attacks: Sequence[Attack], seeds: int, steps: int, first: int = 0
) -> Air:
    """The noises of the plant and the sum of the attacks, of seeds ``first`` and on."""
    keys = jax.random.split(jax.random.key(first), seeds)
    factors = [_root(np.asarray(m)) for m in (plant.Q, plant.R)]
    w, v, e = _drawn(plant, tuple(attacks), keys, steps)
    return Air(np.asarray(w) @ factors[0].T, np.asarray(v) @ factors[1].T, np.asarray(e))


def _root(m: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(m)
    return vectors * np.sqrt(np.maximum(values, 0.0))


@eqx.filter_jit
def _drawn(plant: LinearPlant, attacks: tuple[Attack, ...], keys, steps: int):
    n, p, nu = len(plant.states), len(plant.outputs), len(plant.inputs)

    def one(key):
        # each noise has its own key, so that more sensors leave the motion as it is
        moved, sensed, lies = jax.random.split(key, 3)
        known = Knowledge(jnp.asarray(0, jnp.int32), jnp.zeros(nu), jnp.zeros(p))
        own = jax.random.split(lies, max(1, len(attacks)))
        states = tuple(a.init(k, known) for a, k in zip(attacks, own, strict=False))

        def row(states, k):
            now = eqx.tree_at(lambda at: at.k, known, k)
            after, total = [], jnp.zeros(p)
            for attack, state in zip(attacks, states, strict=True):
                state, injection = attack.step(state, now)
                after.append(state)
                total = total + injection.y
            return tuple(after), total

        _, e = jax.lax.scan(row, states, jnp.arange(1, steps + 1, dtype=jnp.int32))
        w, v = (jax.random.normal(k, (steps, m)) for k, m in ((moved, n), (sensed, p)))
        return w, v, e

    return jax.vmap(one)(keys)


def held(plant: LinearPlant, steps: int) -> Course:
    """The course that stays at the origin."""
    return Course(np.zeros((steps, len(plant.states))), np.zeros((steps, len(plant.inputs))))


def flown(
    plant: LinearPlant,
    estimator: Estimator,
    gain: np.ndarray,
    course: Course,
    wind: Air,
    *,
    start: np.ndarray | None = None,
    steered: Steered = "truth",
    oracle: Oracle = "none",
) -> Flown:
    """Every seed, from the state ``start`` one step before the first row (default the course's)."""
    start = course.x[0] if start is None else start
    by = [steered == way for way in ("truth", "estimate", "decoded")]
    knows = [oracle == way for way in ("subtract", "leave out")]
    shaken = by, knows, course.x, course.u, np.asarray(gain, float), np.asarray(start, float), *wind
    found = _flown(plant, estimator, *map(jnp.asarray, shaken))
    return Flown(*map(np.asarray, found))


@eqx.filter_jit
def _flown(
    plant: LinearPlant, estimator: Estimator,
    by, knows, x_r, u_r, gain, start, w, v, e,
):  # fmt: skip
    nobody = jnp.zeros(len(plant.outputs), bool)
    zero_d, A, B = no_attack(plant), jnp.asarray(plant.A), jnp.asarray(plant.B)
    before = jnp.concatenate([x_r[:1], x_r[:-1]])

    def one(w, v, e):
        def row(carry, now):
            x, state, who = carry
            k, w, v, e, at, push = now
            u = push - dot(gain, who - at)
            x = dot(A, x) + dot(B, u) + w
            y = plant.output(k, x, u, zero_d) + v + e
            seen = (e == 0) | ~knows[1]
            shown = jnp.where(seen, y - jnp.where(knows[0], e, 0.0), 0.0)
            sample = Observation(u, shown, seen, nobody, jnp.asarray(0, jnp.int32))
            state, said = estimator.step(state, sample)
            a = jnp.zeros_like(y) if said.a is None else said.a
            decoded = state.decoder.x if isinstance(state, L1KalmanState) else said.x
            who = jnp.select(list(by), [x, said.x, decoded])
            return (x, state, who), (x, u, y, said.x, decoded, a, said.status)

        state, first = estimator.init()
        who = jnp.where(by[0], start, first.x)
        k = jnp.arange(1, len(w) + 1, dtype=jnp.int32)
        return jax.lax.scan(row, (start, state, who), (k, w, v, e, before, u_r))[1]

    return jax.vmap(one)(w, v, e)


def rms(values: Float[Array, "..."] | np.ndarray, axis=None) -> np.ndarray:
    """The root mean square over the axes given."""
    return np.sqrt(np.mean(np.square(np.asarray(values)), axis=axis))


def per_window(error: np.ndarray, length: int) -> np.ndarray:
    """Root mean square length of (seeds x N x m) over windows of ``length`` steps each."""
    seeds, steps, m = error.shape
    count = steps // length
    parts = error[:, steps - count * length :].reshape(seeds, count, length * m)
    return rms(parts, 2) * np.sqrt(m)
