"""Filters side by side, one per mode, which share all that their modes have in common.

Modes with the same switch position have the same f and h. They differ in which channels they
take for attacked, so their covariances differ by few columns from that of a filter which
believes in no attack (`holdfast.numerics.deviations`): one large factorisation per position
and row serves them all. A *group* is the set of modes that share it: those of one position
where the plant is large, linearised about the most probable one of them; every mode for itself
where it is small. The means always move by f itself, each its own.

Attacks are carried in units of their prior standard deviation.

Source: NISME Algorithm 1; errata 1 to 5, 12.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.blue import whitener
from holdfast.numerics.deviations import Deviation, after, deviation, shortened
from holdfast.numerics.innovations import Correction, correction
from holdfast.numerics.linalg import SMALL, dot, lower_inverse, sandwich
from holdfast.parts import Plant
from holdfast.plants.linear import LinearPlant
from holdfast.plants.local import motion, sensing
from holdfast.records import Observation

FEW = 4
"""Groups that are written out: each costs its own time to compile."""


class Uses(eqx.Module):
    """The channels that modes take for attacked, by number; what a mode does not use is off.

    ``before``: those that may move the state, felt one row later; ``now``: those that may
    falsify an output.
    """

    before: Int[Array, "*j a"]
    before_on: Bool[Array, "*j a"]
    now: Int[Array, "*j b"]
    now_on: Bool[Array, "*j b"]


class Group(eqx.Module):
    """The modes that share a factorisation: where the switches stand, and what each uses."""

    position: Int[Array, "*s"]
    uses: Uses


class Means(eqx.Module):
    """The estimates of every filter: the state, and the attacks at this row that falsify an
    output, in units of their prior.
    """

    x: Float[Array, "*s j n"]
    d: Float[Array, "*s j b"]


class Covariances(eqx.Module):
    """Those of every filter, P + Z Z' in common and in particular, of the state and of the
    attacks in `Means`; ``open``: which attacks that move the state no output has told yet.
    """

    open: Bool[Array, "*s j a"]
    P: Float[Array, "*s n n"]
    Z: Float[Array, "*s j m q"]


class Gains(NamedTuple):
    """All of a row that does not depend on what is measured.

    ``spread``: covariance of the common filter's innovation; ``columns``: what each filter's
    uncertainty and attacks add to the measurement; ``held``: attacks that authentication rules
    out; ``lost``: largest share of a filter's Z Z' given up to keep Z short.
    """

    common: Correction
    spread: Float[Array, "p p"]
    columns: Float[Array, "j p c"]
    own: Deviation
    held: Bool[Array, "j b"]
    lost: Float[Array, ""]


class Fit(NamedTuple):
    """How well each filter of a group explains the row.

    ``attack``: the attacks before and at the row, in units of their prior; ``evidence``,
    ``paper``, ``quadratic``: log-likelihoods.
    """

    x: Float[Array, "j n"]
    attack: Float[Array, "j r"]
    innovation: Float[Array, "j p"]
    evidence: Float[Array, " j"]
    paper: Float[Array, " j"]
    quadratic: Float[Array, " j"]


def one_by_one(plant: Plant, group: Group) -> bool:
    """Whether every mode is a group of its own: matrices small enough to need no LAPACK."""
    return len(plant.states) + group.uses.now.shape[-1] <= SMALL


def over_groups(plant: Plant, group: Group, function, *arguments, apart: bool = False):
    """``function`` of every group: batched where groups are small, in turn where they are large
    (batches of LAPACK calls can lock one another out).

    ``apart``: few large groups are written out. Much arithmetic on few matrices is faster so (a
    loop copies them in and out), the other way round slower.
    """
    if one_by_one(plant, group):
        return jax.vmap(function)(*arguments)
    count = len(group.position)
    if count > FEW or not apart:
        return jax.lax.map(lambda each: function(*each), arguments)
    leaves, shape = jax.tree.flatten(arguments)
    found = [function(*shape.unflatten(parts)) for parts in zip(*leaves, strict=True)]
    return jax.tree.map(lambda *parts: jnp.stack(parts), *found)


def physical(plant: Plant, uses: Uses, d: Float[Array, " b"], scale) -> Float[Array, " nd"]:
    """The attacks that a mode has found at a row, on the plant's channels and in their units."""
    spread = jnp.where(uses.now_on, d * scale[uses.now], 0.0)
    return jnp.zeros(len(plant.attacks)).at[uses.now].add(spread)


def gains_of(
    plant: Plant, group: Group, means: Means, cov: Covariances, best, k, observation, scale
) -> tuple[Gains, Covariances]:
    """What the row does to a group whose most probable mode is number ``best``, and leaves."""
    seen, trusted, u = observation.seen, observation.trusted, observation.u
    uses = group.uses
    n, a, b = len(plant.states), uses.before.shape[-1], uses.now.shape[-1]
    at = plant.at_position(group.position)
    d = physical(plant, jax.tree.map(lambda leaf: leaf[best], uses), means.d[best], scale)
    m = motion(at, k, means.x[best], u, d)
    none = jnp.zeros(len(plant.attacks))
    s = sensing(at, k, at.transition(k, means.x[best], u, d), u, none)
    P = sandwich(m.A, cov.P) + m.Q
    C = jnp.where(seen[:, None], s.C, 0.0)
    common = correction(P, C, s.R, at.whiten if isinstance(at, LinearPlant) else whitener, seen)
    # what is authenticated arrives as it was sent
    G, H = m.G * scale, jnp.where((seen & ~trusted)[:, None], s.H * scale, 0.0)
    held = jax.vmap(lambda use: _held(use, trusted[:, None] & (s.H != 0)))(uses)

    def columns(use, is_open, Z, held):
        known = jnp.where(use.now_on, G[:, use.now], 0.0)
        X = dot(m.A, Z[:n]) + dot(known, Z[n:])
        free = jnp.where(use.before_on & is_open, G[:, use.before], 0.0)
        felt = jnp.where(use.now_on & ~held, H[:, use.now], 0.0)
        Y = jnp.concatenate([dot(C, X), dot(C, free), felt], 1)
        return jnp.concatenate([X, free, jnp.zeros((n, b))], 1), Y

    X, Y = jax.vmap(columns)(uses, cov.open, cov.Z, held)
    own = jax.vmap(lambda X, Y: deviation(common.white, common.moves, X, Y, a + b))(X, Y)
    told = ~own.unknown[:, a:] & uses.now_on & ~held
    carried = jnp.concatenate([jnp.zeros(uses.before.shape, bool), told], 1)
    Z = jax.vmap(lambda moves, root, kept: after(moves, root, kept, b))(
        own.moves, own.root, carried
    )
    Z, lost = _shortened(plant, group, Z, cov.Z.shape[-1])
    same = uses.before[:, :, None] == uses.now[:, None, :]
    settled = jnp.any(same & (told | held)[:, None, :], 2)
    spread = sandwich(C, P) + jnp.where(seen[:, None] & seen[None, :], s.R, 0.0)
    still = uses.before_on & ~settled
    left = Covariances(still, common.cov, Z)
    return Gains(common, spread, Y, own, held, jnp.max(lost)), left


def _held(use: Uses, authentic: Bool[Array, "p nd"]) -> Bool[Array, " b"]:
    """Attacks that an authenticated output rules out: those which alone could falsify it. What
    several could have falsified says that they cancel there, not that each of them is 0.
    """
    reached = authentic[:, use.now] & use.now_on
    return jnp.any(reached & (jnp.sum(reached, 1, keepdims=True) == 1), 0)


def _shortened(plant, group, Z, columns):
    if one_by_one(plant, group):
        return jax.vmap(lambda z: shortened(z, columns))(Z)
    return jax.lax.map(lambda z: shortened(z, columns), Z)


def fit(
    plant: Plant, group: Group, means: Means, g: Gains, k, observation: Observation, scale
) -> Fit:
    """Every filter of a group, corrected by the row."""
    u, seen = observation.u, observation.seen
    at, none = plant.at_position(group.position), jnp.zeros(len(plant.attacks))

    def predicted(x, d, use):
        x = at.transition(k, x, u, physical(plant, use, d, scale))
        nu = at.innovation(observation.y, at.output(k, x, u, none))
        return x, jnp.where(seen, nu, 0.0)

    x, nu = jax.vmap(predicted)(means.x, means.d, group.uses)
    e = nu @ g.common.white.T
    x = x + e @ g.common.moves.T
    fitted = jax.vmap(_fitted)(g.own, x, e)
    x, attack, *likelihoods = fitted
    shared = g.common.log_det
    evidence, paper, quadratic = likelihoods
    return Fit(x, attack, nu, evidence - 0.5 * shared, paper - 0.5 * shared, quadratic)


def _fitted(own: Deviation, x, e):
    """One filter: state, attacks, and the parts of its log-likelihoods that are its own."""
    r, scores = own.root.shape[0], dot(own.scores.T, e)
    z, f = jnp.split(scores, [scores.shape[0] - r])
    inverse = lower_inverse(own.root)
    half, before = dot(inverse, f), dot(lower_inverse(own.prior), f)
    delta = dot(inverse.T, half)
    x = x + dot(own.moves, jnp.concatenate([z, delta]))
    rest = dot(e, e) - dot(z, z)
    blind = rest - dot(half, half)
    size = 2.0 * jnp.sum(jnp.log(jnp.diagonal(own.prior)))
    evidence = -0.5 * (rest - dot(before, before) + own.log_det + size)
    rank = jnp.sum(~own.dependent).astype(float)
    paper = -0.5 * (blind + own.log_det + own.log_free - rank * jnp.log(2.0 * jnp.pi))
    return x, delta, evidence, paper, -0.5 * blind
