"""Exact projection of a point onto a polytope in the metric of its own covariance.

    minimise (z - p)' P^{-1} (z - p)   subject to   rows z <= bound

P is never inverted. With P = F F' every z that costs anything finite is p + F x, so that the
problem is the shortest x with a x <= c: a = rows F scaled to unit length, c the distance of
each face from p in standard deviations (negative where p violates it). A covariance that is
singular only takes directions away, and neither the units of a row nor those of z matter.

The dual active-set method of Goldfarb and Idnani takes the most violated face, moves onto it
and lets go of faces that would have to pull. Its working set is one table of the size of
``rows``, with a row of length n for each face:

    active face      d_j, the dual basis: d_j a_k = 1 for k = j, 0 for the other active k
    any other face   b_i, its part orthogonal to the active ones

so that the multipliers are -d_j x, a dependent face has b_i = 0, and both adding and dropping
a face change every row by a multiple of one vector. Unlike the Gram matrix rows P rows' the
table keeps the full precision where faces are nearly parallel.
"""

import functools
import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.linalg import lower_factor

ROUNDING = 1e-12
"""How far a face may be violated, relative to the numbers its violation is the difference
of: what 1e4 roundings leave."""
INDEPENDENT = 1e-8
"""Sine of the angle to the span of the active faces under which a face depends on them. A
covariance of condition 1e10 leaves 1e-5 of an angle, rounding 1e-16 to 1e-11."""
PIVOTS_PER_ROW = 8
"""The loop ends after 8 (m + 1) pivots. Each face added raises the dual objective, so no set
of faces comes back; 1.5 m pivots are the most that was met in 10^6 random problems."""


BLOCK = 64

class Projection(NamedTuple):
    """The nearest point of a polytope.

    ``active``: the faces it is held by, linearly independent in the metric;
    ``multipliers`` >= 0 with point - P rows' multipliers = the projection, zero elsewhere.
    ``residual``: the largest relative violation of the Karush-Kuhn-Tucker conditions;
    rounding unless the loop ran into its bound. ``feasible`` False: no point of the polytope
    lies in the starting point plus the range of P, and nothing was moved.
    """

    point: Float[Array, " n"]
    active: Bool[Array, " m"]
    multipliers: Float[Array, " m"]
    residual: Float[Array, ""]
    feasible: Bool[Array, ""]


class _Faces(NamedTuple):
    """The polytope in standard deviations from the point: normal x <= distance.

    ``scale``: the size of the numbers that ``distance`` is the difference of; ``usable``
    False where there is no bound or where P does not see the row.
    """

    normal: Float[Array, "m n *b"]
    distance: Float[Array, "m *b"]
    scale: Float[Array, "m *b"]
    usable: Bool[Array, "m *b"]


class _Working(NamedTuple):
    """The working set: ``x`` is the shortest with its active faces met exactly.

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

    z = point - cov rows' l with l >= 0, rows z <= bound, l (rows z - bound) = 0: in exact
    arithmetic after finitely many pivots. ``cov`` may be singular: z moves within its range.
    A bound of +inf is no row; with -inf, or with anything that is not a number, nothing is
    feasible. A point that violates no row by more than rounding comes back as it is.

    Source: Goldfarb and Idnani (1983), the dual method; CARE (18), (20), (24).
    """
    if rows.size == 0:
        nothing = jnp.zeros(bound.shape, bool), jnp.zeros(bound.shape), jnp.zeros(())
        return Projection(point, *nothing, jnp.all(jnp.isfinite(point)) & jnp.all(bound >= 0))
    return Projection(*_project(point, cov, rows, bound))


@jax.custom_batching.custom_vmap
def _project(point, cov, rows, bound):
    return _lanes(point, cov, lower_factor(cov)[0], rows, bound)


@_project.def_vmap
def _(axis_size, in_batched, *given):
    """A batch as the last axis of every array: the loop then works on whole vectors."""
    given = tuple(
        a if of_a else jnp.broadcast_to(a, (axis_size, *a.shape))
        for a, of_a in zip(given, in_batched, strict=True)
    )
    blocks = -(-axis_size // BLOCK)
    if blocks == 1:
        found = _block(*given)
    else:
        short = blocks * BLOCK - axis_size
        split = (
            jnp.concatenate([a, a[:short]]).reshape(blocks, BLOCK, *a.shape[1:]) for a in given
        )
        found = jax.lax.map(lambda some: _block(*some), tuple(split))
        found = tuple(a.reshape(-1, *a.shape[2:])[:axis_size] for a in found)
    return found, (True,) * len(found)


def _block(*given):
    """One batch, as the last axis of every array: the loop then works on whole vectors."""
    point, cov, rows, bound = (jnp.moveaxis(a, 0, -1) for a in given)
    factor = jax.vmap(lower_factor, -1, -1)(cov)[0]
    return tuple(jnp.moveaxis(a, -1, 0) for a in _lanes(point, cov, factor, rows, bound))


def _lanes(point, cov, factor, rows, bound):
    """`project` with any axes behind those named, one problem each."""
    there = bound != jnp.inf
    rows = jnp.where(there[:, None], rows, 0.0)
    bound = jnp.where(there, bound, 0.0)
    slack = bound - _dot(rows, point[None])
    scale = jnp.abs(bound) + _dot(jnp.abs(rows), jnp.abs(point)[None])
    sane = jnp.isfinite(_sum(scale) + _sum([_sum(line) for line in cov]))

    spread = _sum([rows[:, i, None] * factor[i] for i in range(len(point))])
    size = _sum([jnp.abs(rows[:, i, None]) * jnp.abs(factor[i]) for i in range(len(point))])
    deviation = jnp.sqrt(_dot(spread, spread))
    seen = deviation > INDEPENDENT * jnp.sqrt(_dot(size, size))
    unit = jnp.where(seen, 1.0, 0.0) / jnp.where(seen, deviation, 1.0)
    met = _all(seen | (slack >= -ROUNDING * scale))

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


def _sum(terms):
    """Term by term: a loop over whole vectors, where a reduction would go entry by entry."""
    return functools.reduce(operator.add, [terms[i] for i in range(len(terms))])


def _dot(a, b):
    """Sums over the second axis of a * b."""
    return _sum([a[:, i] * b[:, i] for i in range(a.shape[1])])


def _pick(table, one_hot):
    """The row of the table that is marked."""
    return _sum([jnp.where(one_hot[i], table[i], 0.0) for i in range(table.shape[0])])


def _largest(values):
    return functools.reduce(jnp.maximum, [values[i] for i in range(values.shape[0])])


def _all(flags):
    return ~_any(~flags)


def _any(flags):
    return functools.reduce(operator.or_, [flags[i] for i in range(flags.shape[0])])


def _first(values, wanted):
    """One-hot: the first entry that equals ``wanted``."""
    found = [values[0] == wanted]
    before = found[0]
    for i in range(1, values.shape[0]):
        here = values[i] == wanted
        found.append(here & ~before)
        before = before | here
    return jnp.stack(found)


def _noise(faces: _Faces, x: Float[Array, "n *b"]) -> Float[Array, "m *b"]:
    """The excess that rounding alone leaves at x."""
    return ROUNDING * (faces.scale + jnp.sqrt(_sum([x[i] * x[i] for i in range(len(x))])))


def _solve(faces: _Faces, wanted: Bool[Array, "*b"]) -> _Working:
    """The working set at the solution, from x = 0 and no active face."""
    m = faces.normal.shape[0]
    none = jnp.zeros_like(faces.usable)

    def body(s: _Working):
        return _pivot(faces, s, _unfinished(faces, s, wanted))

    def cond(s: _Working):
        return jnp.any(_unfinished(faces, s, wanted)) & (s.pivots < PIVOTS_PER_ROW * (m + 1))

    start = _Working(
        faces.normal, jnp.zeros_like(faces.normal[0]), -faces.distance, none, none, none,
        none[0], jnp.asarray(0, jnp.int32),
    )  # fmt: skip
    return jax.lax.while_loop(cond, body, start)


def _unfinished(faces, s, wanted):
    violated = faces.usable & ~s.active & ~s.passed & (s.excess > _noise(faces, s.x))
    return wanted & ~s.empty & (_any(violated) | _any(s.entering))


def _pivot(faces: _Faces, s: _Working, on: Bool[Array, "*b"]) -> _Working:
    """One face added or dropped.

    Raising the entering face's multiplier by t lowers those of the active faces by t rates:
    either its excess vanishes first (it is added), or another multiplier does (that face is
    dropped, and the entering one goes on).
    """
    fresh = ~_any(s.entering)
    open_faces = jnp.where(faces.usable & ~s.active & ~s.passed, s.excess, -jnp.inf)
    entering = jnp.where(fresh, _first(open_faces, _largest(open_faces)), s.entering)
    height = _pick(s.excess, entering)
    rates = jnp.where(s.active, _dot(s.table, _pick(faces.normal, entering)[None]), 0.0)
    noise = _noise(faces, s.x)
    tolerated = jnp.where(entering, 1.0, jnp.abs(rates)) * noise
    passing = fresh & (height <= _sum([tolerated[i] for i in range(len(tolerated))]))

    weight = -_dot(s.table, s.x[None])
    falling = rates > 0
    steps = jnp.where(falling, -jnp.maximum(weight, 0.0) / jnp.where(falling, rates, 1.0), -jnp.inf)
    shortest = _largest(steps)
    rest = _pick(s.table, entering)
    length = _sum([rest[i] * rest[i] for i in range(len(rest))])
    independent = length > INDEPENDENT**2
    adding = independent & (height <= -shortest * length)
    empty = on & ~passing & ~independent & (shortest == -jnp.inf)

    chosen = jnp.where(adding, entering, _first(steps, shortest))
    along = jnp.where(adding, rest, _pick(s.table, chosen))
    square = _sum([along[i] * along[i] for i in range(len(along))])
    # divided rather than masked: the one operation that XLA's CPU backend computes once and
    # keeps, where it repeats all others for every entry of the table
    moves = on & ~passing & ~empty
    inverse = jnp.where(moves, 1.0, 0.0) / jnp.where(square > 0, square, 1.0)
    across = _dot(faces.normal, along[None])
    of_active = jnp.where(adding, rates, _dot(s.table, along[None]))
    change = jnp.where(s.active, of_active, jnp.where(adding, across, -across))
    change = jnp.where(inverse > 0, change, 0.0) / jnp.where(square > 0, square, 1.0)
    table = s.table - change[:, None] * along[None]
    table = jnp.where((chosen & (inverse > 0))[:, None], (inverse * along)[None], table)
    back = _sum([s.x[i] * along[i] for i in range(len(along))])
    step = jnp.where(inverse > 0, jnp.where(adding, height, back), 0.0) / jnp.where(
        square > 0, square, 1.0
    )
    return _Working(
        table,
        s.x - step * along,
        s.excess - step * across,
        s.active ^ (chosen & (inverse > 0)),
        entering & (inverse > 0) & ~adding,
        jnp.where(passing, s.passed | entering, s.passed & adding),
        s.empty | empty,
        s.pivots + 1,
    )


def _polished(faces: _Faces, found: _Working, active: Bool[Array, "m *b"]):
    """X and the multipliers after one step of iterative refinement on the active faces."""
    table = jnp.where(active[:, None], found.table, 0.0)
    x = jnp.where(_any(active), found.x, 0.0)
    missed = jnp.where(active, _dot(faces.normal, x[None]) - faces.distance, 0.0)
    x = x - _sum([missed[i] * table[i] for i in range(len(missed))])
    return x, -_dot(table, x[None])


def _residual(faces: _Faces, x, weight, active: Bool[Array, "m *b"]) -> Float[Array, "*b"]:
    """The largest of: faces violated, active faces missed, multipliers < 0, x + a'l."""
    excess = _dot(faces.normal, x[None]) - faces.distance
    size = faces.scale + jnp.sqrt(_sum([x[i] * x[i] for i in range(len(x))]))
    missed = jnp.where(active, jnp.abs(excess), jnp.maximum(excess, 0.0))
    primal = jnp.where(faces.usable, missed / jnp.where(size > 0, size, 1.0), 0.0)
    most = _largest(jnp.abs(weight))
    dual = _largest(-weight) / jnp.where(most > 0, most, 1.0)
    pulls = weight[:, None] * faces.normal
    left = _largest(jnp.abs(x + _sum(pulls)))
    total = _largest(_sum(jnp.abs(pulls)))
    stationary = left / jnp.where(total > 0, total, 1.0)
    return jnp.maximum(jnp.maximum(_largest(primal), dual), stationary)
