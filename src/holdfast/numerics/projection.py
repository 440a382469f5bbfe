"""Exact projection of a point onto a polytope in the metric of its own covariance.

    minimise (z - p)' P^{-1} (z - p)   subject to   rows z <= bound

P is never inverted. With P = F F' every z that can be reached is p + F x, so that the problem
is the shortest x with a x <= c: a = rows F, each scaled to unit length, and c the distance of
each face from p in standard deviations (negative where p violates it). A singular covariance
only takes directions away, and neither the units of a row nor those of z matter.

The dual active-set method of Goldfarb and Idnani takes the most violated face, moves onto it
and lets go of faces that would have to pull. All it needs is one table with a row for each
face:

    active face      d_j, the dual basis: d_j a_k = 1 for k = j, 0 for the other active k
    any other face   b_i, what is left of a_i orthogonally to the active ones

so that the multipliers are -d_j x, a face that depends on the active ones has b_i = 0, and
adding or dropping a face changes every row by a multiple of one vector. The Gram matrix
a a' would serve as well, but squares the condition of nearly parallel faces.
"""

import functools
import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.linalg import lower_factor, repeat

ROUNDING = 1e-12
"""How far a face may be violated, relative to the numbers its violation is the difference
of: what 1e4 roundings leave."""
INDEPENDENT = 1e-8
"""Sine of the angle to the span of the active faces under which a face depends on them; also
the part of a row's length under which the covariance does not see it. A covariance of
condition 1e10 leaves 1e-5, rounding 1e-16 to 1e-11."""
PIVOTS_PER_ROW = 8
BLOCK = 64
"""Problems of a batch that are worked on side by side: they fit the cache, and the loop ends
with the slowest of 64 and not of all."""


class Projection(NamedTuple):
    """The nearest point of a polytope.

    ``active``: the faces it is held by, linearly independent in the metric;
    ``multipliers`` >= 0, zero off them: the projection is point - cov rows' multipliers.
    ``residual``: the largest relative violation of the Karush-Kuhn-Tucker conditions.
    ``feasible`` False: no point of the polytope lies in the starting point plus the range of
    the covariance; nothing was moved then, and the residual is 0.
    """

    point: Float[Array, " n"]
    active: Bool[Array, " m"]
    multipliers: Float[Array, " m"]
    residual: Float[Array, ""]
    feasible: Bool[Array, ""]


class _Faces(NamedTuple):
    """The polytope in standard deviations from the point: normal x <= distance.

    ``scale``: the size of the numbers that ``distance`` is the difference of; ``usable``
    False where there is no bound or where the covariance does not see the row.
    """

    normal: Float[Array, "m n *b"]
    distance: Float[Array, "m *b"]
    scale: Float[Array, "m *b"]
    usable: Bool[Array, "m *b"]


class _Working(NamedTuple):
    """A set of active faces and the shortest ``x`` that meets them exactly.

    ``excess`` = normal x - distance. ``entering``: the face being added while others make
    way for it. ``passed``: faces violated by no more than rounding.
    """

    table: Float[Array, "m n *b"]
    x: Float[Array, "n *b"]
    excess: Float[Array, "m *b"]
    active: Bool[Array, "m *b"]
    entering: Bool[Array, "m *b"]
    passed: Bool[Array, "m *b"]
    empty: Bool[Array, "*b"]
    pivots: Int[Array, ""]


def project(
    point: Float[Array, " n"],
    cov: Float[Array, "n n"],
    rows: Float[Array, "m n"],
    bound: Float[Array, " m"],
) -> Projection:
    """The z nearest to ``point`` with rows z <= bound, in the norm of cov^{-1}.

    z = point - cov rows' l with l >= 0, rows z <= bound and l (rows z - bound) = 0. ``cov``
    may be singular: z moves within its range. A bound of +inf is no row; with -inf, or with
    anything that is not a number, nothing is feasible. A point that violates every row by no
    more than `ROUNDING` comes back as it is.

    Each face added raises the dual objective, so that no set of active faces comes back and
    the loop ends by itself, after 2 m pivots at most in 10^6 random problems. It is cut off at
    8 (m + 1), which only rounding can make it reach: one problem of those with a covariance
    of condition 1e11 did, and its ``residual`` was 8e-9 instead of 1e-12 or less.

    Source: Goldfarb and Idnani (1983), the dual method; CARE (18) to (20), (24) to (26).
    """
    if rows.size == 0:
        none = jnp.zeros(bound.shape, bool), jnp.zeros(bound.shape), jnp.zeros(())
        return Projection(point, *none, jnp.all(jnp.isfinite(point)) & jnp.all(bound >= 0))
    return Projection(*_project(point, cov, rows, bound))


def _alone(point, cov, rows, bound):
    return _lanes(point, cov, lower_factor(cov)[0], rows, bound)


_project = jax.custom_batching.custom_vmap(_alone)


@_project.def_vmap
def _(axis_size, in_batched, *given):
    """A batch as blocks, the last one filled up with problems met before."""
    given = tuple(
        a if of_a else jnp.broadcast_to(a, (axis_size, *a.shape))
        for a, of_a in zip(given, in_batched, strict=True)
    )
    if axis_size <= BLOCK:
        found = _block(given)
    else:
        fill = -axis_size % BLOCK
        blocks = tuple(
            jnp.concatenate([a, a[:fill]]).reshape(-1, BLOCK, *a.shape[1:]) for a in given
        )
        found = jax.lax.map(_block, blocks)
        found = tuple(a.reshape(-1, *a.shape[2:])[:axis_size] for a in found)
    return found, (True,) * len(found)


def _block(given):
    """A batch as the last axis of every array: the loop then works on whole vectors."""
    point, cov, rows, bound = (jnp.moveaxis(a, 0, -1) for a in given)
    factor = jax.vmap(lower_factor, -1, -1)(cov)[0]
    return tuple(jnp.moveaxis(a, -1, 0) for a in _lanes(point, cov, factor, rows, bound))


def _lanes(point, cov, factor, rows, bound):
    """`project` given F; one problem for each entry of an axis behind those named, if any."""
    there = bound != jnp.inf
    rows = jnp.where(there[:, None], rows, 0.0)
    bound = jnp.where(there, bound, 0.0)
    slack = bound - _dot(rows, point[None])
    scale = jnp.abs(bound) + _dot(jnp.abs(rows), jnp.abs(point)[None])
    sane = jnp.isfinite(_sum(scale) + _sum(_sum(cov)))

    spread = _sum([rows[:, i, None] * factor[i] for i in range(len(factor))])
    size = _sum([jnp.abs(rows[:, i, None]) * jnp.abs(factor[i]) for i in range(len(factor))])
    deviation = jnp.sqrt(_dot(spread, spread))
    seen = deviation > INDEPENDENT * jnp.sqrt(_dot(size, size))
    unit = jnp.where(seen, 1.0, 0.0) / jnp.where(seen, deviation, 1.0)
    met = ~_any(~seen & (slack < -ROUNDING * scale))

    faces = _Faces(unit[:, None] * spread, unit * slack, unit * scale, seen & there)
    found = _solve(faces, sane & met)
    feasible = sane & met & ~found.empty
    active = found.active & feasible
    x, weight = _polished(faces, found, active)
    return (
        jnp.where(_any(active), point + _dot(factor, x[None]), point),
        active,
        jnp.where(active, unit * jnp.maximum(weight, 0.0), 0.0),
        jnp.where(feasible, _residual(faces, x, weight, active), 0.0),
        feasible,
    )


def _solve(faces: _Faces, wanted: Bool[Array, "*b"]) -> _Working:
    """The working set at the solution, from x = 0 and no active face."""
    none = jnp.zeros_like(faces.usable)
    most = PIVOTS_PER_ROW * (len(none) + 1)

    def unfinished(s: _Working):
        violated = _waiting(faces, s) & (s.excess > _noise(faces, s.x))
        return wanted & ~s.empty & (_any(violated) | _any(s.entering))

    start = _Working(
        faces.normal, jnp.zeros_like(faces.normal[0]), -faces.distance, none, none, none,
        none[0], jnp.asarray(0, jnp.int32),
    )  # fmt: skip
    return jax.lax.while_loop(
        lambda s: jnp.any(unfinished(s)) & (s.pivots < most),
        lambda s: _pivot(faces, s, unfinished(s)),
        start,
    )


def _waiting(faces: _Faces, s: _Working) -> Bool[Array, "m *b"]:
    return faces.usable & ~s.active & ~s.passed


def _noise(faces: _Faces, x: Float[Array, "n *b"]) -> Float[Array, "m *b"]:
    """The excess that rounding alone leaves at x."""
    return ROUNDING * (faces.scale + jnp.sqrt(_sum(x * x)))


def _pivot(faces: _Faces, s: _Working, unfinished: Bool[Array, "*b"]) -> _Working:
    """One face added or dropped, where a problem is unfinished.

    Raising the entering face's multiplier by t lowers those of the active faces by t rates.
    Either its excess vanishes first, and it is added; or another multiplier does, and that
    face is dropped and the entering one goes on; or neither ever does: the set is empty.
    """
    excess = jnp.where(_waiting(faces, s), s.excess, -jnp.inf)
    fresh = ~_any(s.entering)
    entering = jnp.where(fresh, _first(excess, _largest(excess)), s.entering)
    height = _pick(s.excess, entering)
    rest = _pick(s.table, entering)
    length = _sum(rest * rest)
    independent = length > INDEPENDENT**2
    rates = jnp.where(s.active, _dot(s.table, _pick(faces.normal, entering)[None]), 0.0)
    noise = jnp.where(entering, 1.0, jnp.abs(rates)) * _noise(faces, s.x)
    passing = unfinished & fresh & (height <= _sum(noise))

    falls = rates > 0
    last = jnp.where(falls, _dot(s.table, s.x[None]), -jnp.inf) / jnp.where(falls, rates, 1.0)
    nearest = _largest(last)
    adding = independent & (height <= -nearest * length)
    empty = unfinished & ~passing & ~independent & (nearest == -jnp.inf)
    chosen = jnp.where(adding, entering, _first(last, nearest))
    along = jnp.where(adding, rest, _pick(s.table, chosen))

    # Divisions are what XLA's CPU backend computes once and keeps; all else is computed again
    # for every entry of the table. So each factor of the update ends in one.
    square = _sum(along * along)
    square = jnp.where(square > 0, square, 1.0)
    inverse = jnp.where(unfinished & ~passing & ~empty, 1.0, 0.0) / square
    moves = inverse > 0
    across = _dot(faces.normal, along[None])
    of_active = jnp.where(adding, rates, _dot(s.table, along[None]))
    change = jnp.where(s.active, of_active, jnp.where(adding, across, -across))
    change = jnp.where(moves, change, 0.0) / square
    step = jnp.where(moves, jnp.where(adding, height, _sum(s.x * along)), 0.0) / square
    swapped = chosen & moves
    table = s.table - change[:, None] * along[None]
    return _Working(
        jnp.where(swapped[:, None], (inverse * along)[None], table),
        s.x - step * along,
        s.excess - step * across,
        s.active ^ swapped,
        entering & moves & ~adding,
        jnp.where(moves, s.passed & adding, s.passed | (entering & passing)),
        s.empty | empty,
        s.pivots + 1,
    )


def _polished(faces: _Faces, found: _Working, active: Bool[Array, "m *b"]):
    """X and the multipliers to full precision, from a dual basis that is good to 1e-3 or so.

    x is put back into the span of the active faces, then onto them; each round of refinement
    gains as many digits as the dual basis has.
    """
    table = jnp.where(active[:, None], found.table, 0.0)
    x = _sum(_dot(table, found.x[None])[:, None] * faces.normal)

    def closer(_, x):
        missed = jnp.where(active, _dot(faces.normal, x[None]) - faces.distance, 0.0)
        return x - _sum(missed[:, None] * table)

    x = repeat(2, closer, x)
    weight = -_dot(table, x[None])
    left = x + _sum(weight[:, None] * faces.normal)
    return x, weight - _dot(table, left[None])


def _residual(faces: _Faces, x, weight, active: Bool[Array, "m *b"]) -> Float[Array, "*b"]:
    """The largest of: a face violated, an active one missed, a multiplier < 0, x + a' l."""
    excess = _dot(faces.normal, x[None]) - faces.distance
    missed = jnp.where(active, jnp.abs(excess), jnp.maximum(excess, 0.0))
    size = faces.scale + jnp.sqrt(_sum(x * x))
    primal = jnp.where(faces.usable, missed, 0.0) / jnp.where(size > 0, size, 1.0)
    most = _largest(jnp.abs(weight))
    dual = _largest(-weight) / jnp.where(most > 0, most, 1.0)
    pulls = weight[:, None] * faces.normal
    total = _largest(_sum(jnp.abs(pulls)))
    stationary = _largest(jnp.abs(x + _sum(pulls))) / jnp.where(total > 0, total, 1.0)
    return jnp.maximum(jnp.maximum(_largest(primal), dual), stationary)


def _folded(operation, terms):
    """Over the first axis, term by term: a reduction would go entry by entry."""
    return functools.reduce(operation, [terms[i] for i in range(len(terms))])


def _sum(terms):
    return _folded(operator.add, terms)


def _largest(terms):
    return _folded(jnp.maximum, terms)


def _any(terms):
    return _folded(operator.or_, terms)


def _dot(a, b):
    """Sums over the second axis of a * b."""
    return _sum([a[:, i] * b[:, i] for i in range(a.shape[1])])


def _pick(table, one_hot):
    """The row that is marked."""
    return _sum([jnp.where(one_hot[i], table[i], 0.0) for i in range(len(table))])


def _first(values, wanted):
    """One-hot: the first entry that equals ``wanted``."""
    found, before = [], jnp.zeros_like(wanted, bool)
    for i in range(len(values)):
        here = values[i] == wanted
        found.append(here & ~before)
        before = before | here
    return jnp.stack(found)
