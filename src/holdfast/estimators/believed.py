"""What a bank says at a row: the record of the mode that it believes in."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from holdfast.estimators import bank
from holdfast.numerics.linalg import RANK_TOLERANCE, dot, lower_inverse, sandwich
from holdfast.numerics.naming import named
from holdfast.parts import Plant, no_attack
from holdfast.plants.constraints import limits_of
from holdfast.records import Estimate, Observation, Status


class Sets(NamedTuple):
    """Of every mode of the bank: the position of the switches, the channels it takes for
    attacked, and which of them are given at the row, not for the row before.
    """

    position: Int[Array, " modes"]
    active: Bool[Array, "modes nd"]
    direct: Bool[Array, "modes nd"]


class Hypotheses(NamedTuple):
    """What may be true, where the bank has filters for the largest sets of channels alone;
    ``limits`` of the z-tests that tell them apart, see `holdfast.numerics.naming`.
    """

    position: Int[Array, " named"]
    active: Bool[Array, "named nd"]
    limits: Float[Array, " m"]


class One(NamedTuple):
    """The filter of one mode after a row; ``attack`` and its ``root`` R, covariance R R', in
    the channels' own units, as numbered by ``uses``; ``told``: known, ``held``: known to be 0.
    """

    uses: bank.Uses
    x: Float[Array, " n"]
    x_cov: Float[Array, "n n"]
    attack: Float[Array, " r"]
    root: Float[Array, "r r"]
    told: Bool[Array, " r"]
    held: Bool[Array, " b"]
    residual: Float[Array, " p"]
    residual_cov: Float[Array, "p p"]


def one(uses: bank.Uses, gains: bank.Gains, fit: bank.Fit, place, scale) -> One:
    """The filter at ``place`` (group, place in it) of the bank.

    Taken out array by array: of a whole group they would be megabytes.
    """
    s, j = place[0], place[1]
    use = bank.Uses(*(v[s, j] for v in (uses.before, uses.before_on, uses.now, uses.now_on)))
    root, columns, moves = (v[s, j] for v in (gains.own.root, gains.columns, gains.own.moves))
    r = root.shape[0]
    z = moves.shape[1] - r
    told, spread = ~gains.own.unknown[s, j], lower_inverse(root).T
    uncertain = jnp.concatenate([moves[:, :z], dot(moves[:, z:], spread)], 1)
    F = columns[:, z:]
    whole = gains.spread[s] + _square(columns[:, :z])
    residual_cov = _cleared(whole - _square(dot(F, spread)), whole)
    residual = fit.innovation[s, j] - dot(F, fit.attack[s, j])
    unit = scale[jnp.concatenate([use.before, use.now])]
    return One(
        use,
        fit.x[s, j],
        gains.common.cov[s] + _square(uncertain),
        fit.attack[s, j] * unit,
        spread * unit[:, None],
        told,
        gains.held[s, j],
        jnp.where(jnp.diagonal(residual_cov) > 0, residual, 0.0),
        residual_cov,
    )


def record(
    plant: Plant,
    k: Int[Array, ""],
    observation: Observation,
    mode: Int[Array, ""],
    one: One,
    sets: Sets,
    hypotheses: Hypotheses | None,
    status: Int[Array, ""],
) -> Estimate:
    """The record of the filter of ``mode``; its attack on the plant's channels.

    With ``hypotheses`` the channels that the z-tests do not name count as not attacked.
    """
    nd, direct, active = len(plant.attacks), sets.direct[mode], sets.active[mode]
    uses = one.uses
    channels = jnp.concatenate([uses.before, uses.now])
    shown = jnp.concatenate([uses.before_on & ~direct[uses.before], uses.now_on & direct[uses.now]])
    picked = (shown & one.told).astype(float)
    place = jnp.zeros((nd, len(channels))).at[channels, jnp.arange(len(channels))].set(picked)
    d, d_cov = dot(place, one.attack), _square(dot(place, one.root))
    if hypotheses is not None:
        guilty = named(d, jnp.diagonal(d_cov), active, hypotheses.limits)
        d, d_cov = jnp.where(guilty, d, 0.0), jnp.where(guilty[:, None] & guilty, d_cov, 0.0)
        mode = _which(hypotheses, sets.position[mode], guilty)
    authentic = jnp.zeros(nd, bool).at[uses.now].max(uses.now_on & one.held)
    missing = active & ~jnp.any(place != 0, 1) & ~authentic
    d_cov = d_cov + jnp.diag(jnp.where(missing, jnp.inf, 0.0))
    status = status | jnp.where(jnp.any(missing), int(Status.UNOBSERVABLE), 0)
    limits = limits_of(plant).attack.at(k, observation.u)
    return Estimate(
        one.x, one.x_cov, d, d_cov, d, d_cov, *limits, one.residual, one.residual_cov,
        status.astype(jnp.int32), mode=mode,
    )  # fmt: skip


def first(plant: Plant, x0, P0, sets: Sets, p: Float[Array, " modes"]) -> Estimate:
    """The record before the first row, of the first mode."""
    ny, d = len(plant.outputs), no_attack(plant)
    d_cov = jnp.diag(jnp.where(sets.active[0], jnp.inf, 0.0))
    u, k, zero = jnp.zeros(len(plant.inputs)), jnp.asarray(1, jnp.int32), jnp.asarray(0, jnp.int32)
    limits = limits_of(plant).attack.at(k, u)
    nothing = jnp.zeros(ny), jnp.zeros((ny, ny))
    return Estimate(x0, P0, d, d_cov, d, d_cov, *limits, *nothing, zero, p=p, mode=zero)


def _which(hypotheses: Hypotheses, position, guilty: Bool[Array, " nd"]) -> Int[Array, ""]:
    """The hypothesis at this position whose channels are those named, or nearest to them: most
    of them in it, then fewest others.
    """
    shared = jnp.sum(hypotheses.active & guilty, 1)
    others = jnp.sum(hypotheses.active & ~guilty, 1)
    score = shared * (1 + guilty.shape[0]) - others
    score = jnp.where(hypotheses.position == position, score, -1 - guilty.shape[0])
    return jnp.argmax(score).astype(jnp.int32)


def _square(root: Float[Array, "m c"]) -> Float[Array, "m m"]:
    return sandwich(root, jnp.eye(root.shape[1]))


def _cleared(cov: Float[Array, "p p"], size: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """The covariance with rows of zero where nothing but rounding is left of ``size``."""
    variance = jnp.diagonal(cov)
    kept = variance > RANK_TOLERANCE * jnp.diagonal(size)
    return jnp.where(kept[:, None] & kept[None, :], cov, 0.0)
