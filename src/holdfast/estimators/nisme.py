"""NISME: a bank of filters, one per mode, and the probability of every mode.

A mode says which attack channels are used and where the plant's switches stand. Each has its
NISE (`holdfast.estimators.bank`); probabilities follow Bayes' rule, in logs, from the evidence

    log p(y_k | mode) = log N(nu_k; 0, S + F D F'),

the density of the innovation when the attack has the prior N(0, D) that physics gives it. It
is the evidence of a Kalman filter with that prior, so modes that free different numbers of
directions are compared over the same space. The paper's line 15 compares densities over spaces
of different dimension, which rescaling an output changes ("paper"); without the normaliser they
are the plain exponential ("quadratic"): both are here to be compared with.

Source: NISME Algorithms 1 and 2, errata 5, 6, 8.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from holdfast.estimators import held_gains
from holdfast.estimators.bank import (
    Covariances,
    Group,
    Means,
    Uses,
    fit,
    gains_of,
    one_by_one,
    over_groups,
    physical,
)
from holdfast.estimators.believed import Hypotheses, Sets, first, one, record
from holdfast.estimators.channels import reach
from holdfast.estimators.hypotheses import Mode, Slots, arranged, modes_of
from holdfast.estimators.mixing import check_mixing, mixed
from holdfast.numerics.linalg import SMALL
from holdfast.numerics.naming import sidak
from holdfast.parts import Estimator, InvalidValue, Plant, step_zero
from holdfast.records import Estimate, Held, Observation, Status

WIDTH = 3
"""Columns kept for every channel of a large plant: what a filter's covariance has beyond the
common one falls off as the common filter forgets."""
LIKELIHOODS = ("evidence", "paper", "quadratic")
"""What modes may be weighed by, by number in `Nisme.likelihood`: one program serves all."""
LOST = 1e-6
"""Share of a filter's own covariance that may be given up for that before a row says so."""


class NismeState(eqx.Module):
    """Step number, estimates of every filter, log-probability of every mode; ``kept``: the
    covariances, or where gains may be held a `Held` of them and the gains.
    """

    k: Int[Array, ""]
    means: Means
    log_p: Float[Array, " modes"]
    kept: Covariances | Held


class Nisme(Estimator):
    """State and attack of the most probable mode, and the probability of every one.

    ``places`` (modes x 2): group and place of every mode in the bank; ``real``: which places
    are a mode's. ``scale``: the prior standard deviation of every channel. Probabilities are
    cut from below at ``floor`` and normalised, after a step of the Markov chain ``transition``
    where there is one. ``hypotheses``: what `Estimate.mode` counts; where the bank has fewer
    modes, z-tests on the attack against ``limits`` say which of them it is. ``likelihood``: the
    number of what weighs them in `LIKELIHOODS`.
    """

    plant: Plant
    x0: Float[Array, " n"]
    P0: Float[Array, "n n"]
    group: Group
    places: Int[Array, "modes 2"]
    real: Bool[Array, "s j"]
    sets: Sets
    hypotheses: Hypotheses | None
    hidden: Bool[Array, ""]
    scale: Float[Array, " nd"]
    floor: Float[Array, ""]
    transition: Float[Array, "modes modes"] | None
    likelihood: Int[Array, ""]
    freeze: float = eqx.field(static=True)
    mixing: bool = eqx.field(static=True)
    modes: tuple[str, ...] = eqx.field(static=True)
    named: tuple[str, ...] = eqx.field(static=True)

    def init(self) -> tuple[NismeState, Estimate]:
        """Every filter at the same estimate, one sample before the first row; all modes alike."""
        s, j, b = self.group.uses.now.shape
        n, a = len(self.plant.states), self.group.uses.before.shape[-1]
        means = Means(jnp.broadcast_to(self.x0, (s, j, n)), jnp.zeros((s, j, b)))
        full = n + b
        alone = one_by_one(self.plant, self.group)
        columns = full if alone else min(full, WIDTH * (a + b))
        P = jnp.broadcast_to(self.P0, (s, n, n))
        cov = Covariances(self.group.uses.before_on, P, jnp.zeros((s, j, full, columns)))
        even = jnp.full(len(self.modes), -math.log(len(self.modes)), float)
        kept = cov
        if self.freeze:
            sizes = (len(names) for names in (self.plant.inputs, self.plant.outputs))
            nothing = jax.tree.map(jnp.asarray, Observation.of(*map(np.zeros, sizes)))
            best, k = self._best(even), jnp.asarray(1, jnp.int32)
            kept = Held(held_gains.empty(cov, *self._rules(means, best, k, nothing)))
        state = NismeState(step_zero(), means, even, kept)
        return state, first(self.plant, self.x0, self.P0, self.sets, jnp.exp(even))

    def step(self, state: NismeState, observation: Observation) -> tuple[NismeState, Estimate]:
        """One row of every filter, and Bayes' rule for the modes."""
        k = state.k + 1
        best, means = self._best(state.log_p), state.means
        if isinstance(state.kept, Held):
            rules = self._rules(means, best, k, observation)
            memory = held_gains.refreshed(state.kept.value, *rules, observation, self.freeze)
            gains, kept = memory.gains, Held(memory)
        else:
            cov = state.kept
            if self.mixing and self.transition is not None:
                means, cov = mixed(means, cov, state.log_p, self.transition)
            gains, kept = self._rules(means, best, k, observation)[0](cov)
        fitted = over_groups(
            self.plant,
            self.group,
            lambda group, means, g: fit(self.plant, group, means, g, k, observation, self.scale),
            self.group,
            means,
            gains,
        )
        likely = jnp.stack([getattr(fitted, name) for name in LIKELIHOODS])[self.likelihood]
        log_p = self._updated(state.log_p, self._of_modes(likely))
        uses = self.group.uses
        told = uses.now_on & ~gains.held & ~gains.own.unknown[..., uses.before.shape[-1] :]
        d = jnp.where(told, fitted.attack[..., uses.before.shape[-1] :], 0.0)
        after = NismeState(k, Means(fitted.x, d), log_p, kept)
        mode = jnp.argmax(log_p).astype(jnp.int32)
        believed = one(uses, gains, fitted, self.places[mode], self.scale)
        status = observation.status | jnp.where(self.hidden, int(Status.HIDDEN_INPUT), 0)
        status = status | jnp.where(jnp.max(gains.lost) > LOST, int(Status.NOT_CONVERGED), 0)
        estimate = record(
            self.plant, k, observation, mode, believed, self.sets, self.hypotheses, status
        )
        return after, eqx.tree_at(
            lambda e: e.p, estimate, jnp.exp(log_p), is_leaf=lambda leaf: leaf is None
        )

    def _rules(self, means: Means, best, k, observation: Observation):
        """How gains come from covariances at this row, and what says whether they would change."""
        plant, group, scale = self.plant, self.group, self.scale

        def refresh(cov):
            return over_groups(
                plant,
                group,
                lambda group, means, cov, i: gains_of(
                    plant, group, means, cov, i, k, observation, scale
                ),
                group,
                means,
                cov,
                best,
                apart=True,
            )

        def slope(cov, gains):
            def of(group, means, i, P, spread):
                uses = jax.tree.map(lambda leaf: leaf[i], group.uses)
                d = physical(plant, uses, means.d[i], scale)
                at = group.position, means.x[i], observation.u, d, k, scale
                return held_gains.slope_of(plant, *at, P, spread)

            return over_groups(plant, group, of, group, means, best, cov.P, gains.spread)

        return refresh, slope

    def _of_modes(self, values: Float[Array, "s j"]) -> Float[Array, " modes"]:
        return values[self.places[:, 0], self.places[:, 1]]

    def _best(self, log_p: Float[Array, " modes"]) -> Int[Array, " s"]:
        """The most probable mode of every group, by its place."""
        spread = jnp.full(self.real.shape, -jnp.inf)
        spread = spread.at[self.places[:, 0], self.places[:, 1]].set(log_p)
        return jnp.argmax(spread, 1)

    def _updated(self, log_p, log_likelihood) -> Float[Array, " modes"]:
        """Bayes' rule in logs; the largest likelihood is 1, so that none overflows."""
        if self.transition is not None:
            log_p = jax.nn.logsumexp(jnp.log(self.transition) + log_p[:, None], 0)
        log_p = log_p + (log_likelihood - jnp.max(log_likelihood))
        log_p = log_p - jax.nn.logsumexp(log_p)
        log_p = jnp.maximum(log_p, jnp.log(self.floor))
        return log_p - jax.nn.logsumexp(log_p)


def build(
    plant: Plant,
    x0,
    P0,
    *,
    modes: list[Any] | Literal["single", "all"] = "single",
    floor: float = 1e-4,
    likelihood: Literal["evidence", "paper", "quadratic"] = "evidence",
    attack_prior_sd: float | list[float] = 1.0,
    transition: float | list[list[float]] | None = None,
    mixing: bool = False,
    bank: list[Any] | None = None,
    level: float = 0.01,
    freeze: float = 0.0,
) -> Nisme:
    """The bank from the estimate ``x0``, ``P0`` before the first row.

    ``modes``: what may be true; each a list of attack names ([] for none), or a table { name,
    attacks, switch }; "all" for every set of channels in every switch position, "single" for
    none, each channel alone, and each position without attack. ``attack_prior_sd``: how large
    an attack may well be, in units of each channel, one number or one per channel.
    ``transition``: probability per row that the mode changes (to each other one alike), or a
    matrix whose row i says where mode i goes; without it probabilities only stay above
    ``floor``. ``mixing``: each filter starts a row from all of them, as the chain has it (the
    interacting multiple model filter), so that none goes on from what a wrong mode has left;
    for small plants. ``bank``: the modes that have a filter, all if not given; where there are
    fewer, z-tests with ``level`` as false-alarm budget of a row name the channels really
    attacked (`holdfast analyse` says which sets suffice). ``freeze``: hold gains that change by
    less than about this part of a standard deviation; 0 computes them at every row.

    Raises `InvalidValue` for an unknown name, or a number out of range.
    """
    x0, P0 = jnp.asarray(x0, float), jnp.asarray(P0, float)
    listed = modes_of(plant, modes)
    run = listed if bank is None else modes_of(plant, bank, "bank")
    hypotheses = None if bank is None else _hypotheses(plant, listed, run, level)
    if not 0.0 < floor < 1.0 / len(run):
        raise InvalidValue("floor", floor, f"a number above 0 and under 1/{len(run)}, one per mode")
    if likelihood not in LIKELIHOODS:
        raise InvalidValue("likelihood", repr(likelihood), f"one of {', '.join(LIKELIHOODS)}")
    if not 0.0 <= freeze < 1.0:
        raise InvalidValue("freeze", freeze, "a part of a standard deviation, 0 for never")
    found = reach(plant, np.asarray(x0), [m.position for m in run], [m.active for m in run])
    falsified = max(int(np.sum(np.asarray(m.active, bool) & found.sensed)) for m in run)
    slots = arranged(run, found.moving, found.sensed, len(x0) + falsified > SMALL)
    places = np.zeros((len(run), 2), np.int32)
    places[slots.modes[slots.real]] = np.argwhere(slots.real)
    if mixing:
        check_mixing(transition, freeze, slots.modes.shape[1])
    return Nisme(
        plant=plant,
        x0=x0,
        P0=P0,
        group=_group(slots),
        places=jnp.asarray(places),
        real=jnp.asarray(slots.real),
        sets=Sets(*_listed(run), jnp.asarray(found.direct)),
        hypotheses=hypotheses,
        hidden=jnp.asarray(bool(np.any(found.hidden))),
        scale=_scale(plant, attack_prior_sd),
        floor=jnp.asarray(float(floor)),
        transition=None if transition is None else _chain(transition, len(run)),
        likelihood=jnp.asarray(LIKELIHOODS.index(likelihood)),
        freeze=float(freeze),
        mixing=mixing,
        modes=tuple(m.name for m in run),
        named=tuple(m.name for m in listed),
    )


def _group(slots: Slots) -> Group:
    position, before, now = (
        jnp.asarray(v, jnp.int32) for v in (slots.position, slots.before, slots.now)
    )
    on = jnp.asarray(slots.before_on), jnp.asarray(slots.now_on)
    return Group(position, Uses(before, on[0], now, on[1]))


def _listed(modes: Sequence[Mode]) -> tuple[Array, Array]:
    """The position and the channels of every mode."""
    active = np.array([m.active for m in modes], bool).reshape(len(modes), -1)
    return jnp.asarray([m.position for m in modes], jnp.int32), jnp.asarray(active)


def _hypotheses(
    plant: Plant, listed: Sequence[Mode], run: Sequence[Mode], level: float
) -> Hypotheses:
    if not 0.0 < level < 1.0:
        raise InvalidValue("level", level, "a probability between 0 and 1")
    missing = {m.position for m in run} - {m.position for m in listed}
    if missing:
        name = plant.positions[missing.pop()]
        raise InvalidValue("bank", f"the switch position {name!r}", "one that is in modes")
    most = len(plant.attacks)
    limits = np.concatenate([[np.inf], sidak(level, most)]) if most else np.array([np.inf])
    return Hypotheses(*_listed(listed), jnp.asarray(limits))


def _scale(plant: Plant, sd: float | Sequence[float]) -> Float[Array, " nd"]:
    nd = len(plant.attacks)
    found = np.asarray(sd, float)
    if found.shape not in ((), (nd,)):
        raise InvalidValue(
            "attack_prior_sd", f"{found.size} numbers", f"one, or {nd}: one per attack"
        )
    if not np.all(np.isfinite(found) & (found > 0)):
        raise InvalidValue("attack_prior_sd", sd, "numbers above 0, in units of the attacks")
    return jnp.asarray(np.broadcast_to(found, (nd,)))


def _chain(
    transition: float | Sequence[Sequence[float]], count: int
) -> Float[Array, "modes modes"]:
    """The matrix of the chain: row i says where mode i goes."""
    found = np.asarray(transition, float)
    if found.ndim == 0:
        if not 0.0 < found < 1.0:
            raise InvalidValue("transition", transition, "a probability between 0 and 1")
        others = max(count - 1, 1)
        found = np.where(np.eye(count, dtype=bool), 1.0 - found, found / others)
        return jnp.asarray(found)
    if found.shape != (count, count):
        raise InvalidValue(
            "transition", f"shape {found.shape}", f"{count} x {count}, one row per mode"
        )
    if np.any(found < 0) or not np.allclose(found.sum(1), 1.0, rtol=0, atol=1e-9):
        raise InvalidValue("transition", "other rows", "rows of probabilities that add up to 1")
    return jnp.asarray(found)
