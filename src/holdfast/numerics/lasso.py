"""Exact LASSO by the dual active-set method, warm-started: every coordinate a group of its own.

    minimise over f   1/2 |c - Z' f|^2 + sum_j w_j |f_j|          Z (N x r), N > r as a rule

Its dual is the projection of c onto the polytope |Z_j p| <= w_j, with p = c - Z' f: a point, N
slabs about the origin, so that the polytope is never empty. The method is that of
`holdfast.numerics.projection` (Goldfarb and Idnani), with two differences that matter here: a
slab has one row of the table and not two, and the table, which depends on the active set alone
and not on c, is handed from one problem to the next. What moves little from step to step then
costs one pivot or none.

    active slab      d_j, the dual basis: d_j z_k = 1 for k = j, 0 for the other active k
    any other        what is left of z_j orthogonally to the active ones

with z_j the rows of Z scaled to unit length. Rows at a small angle, of sine s, cost the table
1 / s^2 in accuracy, and pivots add to its errors. A problem that it does not solve to `AGAIN` is
solved again from an empty one and with care: what is left of a row is made orthogonal a second
time, and the solution is refined for as long as that gains. So rows whose units differ by 1e4 in
condition are solved to the rounding of f itself, eps |Z| |Z'| |f|; beyond, `group_lasso` is.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.linalg import repeat

ROUNDING = 1e-13
"""Violation of a slab, relative to the largest |Z c| and w, that is put down to rounding."""
INDEPENDENT = 1e-8
"""Sine of the angle to the span of the active rows under which a row depends on them."""
PIVOTS_PER_ROW = 8
JUMP = 2
"""Multipliers of the wrong sign, beside an eighth of them all, up to which a warm start is one."""
REFINEMENTS, CAREFUL_REFINEMENTS = 2, 20
WORN = 1e-8
"""Error of a table at which it is not started from: `REFINEMENTS` square it."""
BROKEN = 1e-6
"""Multiplier of the wrong sign, relative to the largest |Z c| and w of unit rows, that shows a
table without accuracy."""
AGAIN = 5e-13
"""Residual from which a problem is solved again, from a cold start and with care."""


class Warm(NamedTuple):
    """Where the last problem ended: the table, the active slabs and the side of each (+-1)."""

    table: Float[Array, "N r"]
    active: Bool[Array, "N"]
    side: Float[Array, "N"]


class Solution(NamedTuple):
    """``f`` and p = c - Z' f; ``residual``: the largest violation of the optimality conditions
    |Z_j p| <= w_j, Z_j p = w_j sign(f_j), relative to max w + max |Z c|; ``pivots`` taken.
    """

    f: Float[Array, "N"]
    p: Float[Array, "r"]
    residual: Float[Array, ""]
    pivots: Int[Array, ""]


class _Slabs(NamedTuple):
    """Unit rows, their bounds, the lengths taken out; ``scale`` of what is compared."""

    normal: Float[Array, "N r"]
    bound: Float[Array, "N"]
    length: Float[Array, " N"]
    scale: Float[Array, ""]


class _Working(NamedTuple):
    """The point p nearest to c on the active slabs' faces, by what it does to every row.

    ``place`` = normal p; ``weight``: the multipliers of the active rows; ``rest``: the squared
    length of the table's other rows. ``entering``: the slab being added while others make way;
    ``passed``: violated by no more than rounding; ``settling``: the warm active set may still
    hold multipliers of the wrong sign.
    """

    warm: Warm
    place: Float[Array, " N"]
    weight: Float[Array, " N"]
    rest: Float[Array, " N"]
    entering: Bool[Array, " N"]
    passed: Bool[Array, " N"]
    settling: Bool[Array, ""]
    done: Bool[Array, ""]
    pivots: Int[Array, ""]


def cold(Z: Float[Array, "N r"]) -> Warm:
    """No active slab."""
    none = jnp.zeros(Z.shape[0])
    return Warm(_unit(Z)[0], none > 0, none)


def lasso(
    Z: Float[Array, "N r"], w: Float[Array, " N"], c: Float[Array, " r"], warm: Warm
) -> tuple[Solution, Warm]:
    """The minimiser and where to start next time.

    At most 8 (N + 1) pivots from the warm start, and as many again from a cold one where that
    failed. Where the minimiser is not unique, one of them. A c that is not finite: nor is the
    residual.

    Source: DECOMPOSE (31), eliminated: x_s = x^ + F f, c = -Z' zeta.
    """
    found = _lasso(Z, w, c, *warm)
    return Solution(*found[:4]), Warm(*found[4:])


def _alone(Z, w, c, *warm):
    unit, length = _unit(Z)
    bound = w / length
    reach = unit @ c
    slabs = _Slabs(unit, bound, length, jnp.max(bound) + jnp.max(jnp.abs(reach)))
    scale = jnp.max(w) + jnp.max(jnp.abs(length * reach))

    def attempt(carry):
        count, start, *_ = carry
        found, f, p = jax.lax.cond(
            count == 0,
            lambda: _solve(slabs, c, start, careful=False),
            lambda: _solve(slabs, c, start, careful=True),
        )
        missed = _residual(slabs, w, f, p, scale)
        # a second attempt has to start from nothing
        after = jax.tree.map(
            lambda end, none: jnp.where(missed <= AGAIN, end, none), found.warm, cold(Z)
        )
        return count + 1, after, f / length, p, missed, carry[5] + found.pivots

    wrong = jnp.asarray(jnp.inf)
    start = (jnp.asarray(0), Warm(*warm), jnp.zeros_like(w), c, wrong, jnp.asarray(0))
    _, after, f, p, missed, pivots = jax.lax.while_loop(
        lambda carry: (carry[0] < 2) & ~(carry[4] <= AGAIN), attempt, start
    )
    return f, p, missed, pivots, *after


_lasso = jax.custom_batching.custom_vmap(_alone)


@_lasso.def_vmap
def _(axis_size, in_batched, *given):
    """One after the other: problems side by side wait for the slowest, and take 3 times as long."""

    def one(batched):
        rest = iter(batched)
        return _alone(*(next(rest) if of else a for a, of in zip(given, in_batched, strict=True)))

    batched = tuple(a for a, of in zip(given, in_batched, strict=True) if of)
    found = jax.lax.map(one, batched)
    return found, (True,) * len(found)


def _unit(Z):
    length = jnp.sqrt(jnp.sum(Z * Z, 1))
    length = jnp.where(length > 0, length, 1.0)
    return Z / length[:, None], length


def _on_faces(slabs: _Slabs, c, warm: Warm, rounds: int):
    """The multipliers of the active slabs, and p = c - sum of them times the rows.

    The dual basis solves for them up to its own error; each round gains as many digits as it
    has.
    """
    table = jnp.where(warm.active[:, None], warm.table, 0.0)
    target = warm.side * slabs.bound

    def closer(_, carry):
        f, p = carry
        missed = jnp.where(warm.active, slabs.normal @ p - target, 0.0)
        f = f + table @ (missed @ table)
        return f, c - f @ slabs.normal

    return repeat(rounds, closer, (jnp.zeros_like(target), c))


def _refined(slabs: _Slabs, c, warm: Warm):
    """As `_on_faces`, for as long as a round gains: a poor table may need many or lose."""
    table = jnp.where(warm.active[:, None], warm.table, 0.0)

    def missed_at(f):
        p = c - f @ slabs.normal
        off = slabs.normal @ p - warm.side * slabs.bound
        return jnp.where(warm.active, off, 0.0)

    def closer(carry):
        f, missed, _, rounds = carry
        then = f + table @ (missed @ table)
        left = missed_at(then)
        gains = jnp.max(jnp.abs(left)) < jnp.max(jnp.abs(missed))
        return jnp.where(gains, then, f), jnp.where(gains, left, missed), gains, rounds + 1

    f = jnp.zeros_like(slabs.bound)
    start = (f, missed_at(f), jnp.asarray(True), jnp.asarray(0))
    return jax.lax.while_loop(lambda s: s[2] & (s[3] < CAREFUL_REFINEMENTS), closer, start)[0]


def _solve(slabs: _Slabs, c, warm: Warm, careful: bool):
    """The last state, and its multipliers and point to full precision; a multiplier never has
    the wrong sign.
    """
    weight, p = _on_faces(slabs, c, warm, 1)
    place = slabs.normal @ p
    none = jnp.zeros_like(warm.active)
    # many pivots wear a table out; and after a jump of c dropping what is wrong costs more, and
    # more digits, than to begin with nothing
    off = jnp.where(warm.active, jnp.abs(place - warm.side * slabs.bound), 0.0)
    wrong = jnp.sum(jnp.where(warm.active & (weight * warm.side < 0), 1, 0))
    few = wrong <= JUMP + jnp.sum(jnp.where(warm.active, 1, 0)) // 8
    fit = few & (jnp.max(off) <= WORN * slabs.scale)
    empty = Warm(slabs.normal, none, jnp.zeros_like(weight))
    warm = jax.tree.map(lambda old, new: jnp.where(fit, old, new), warm, empty)
    weight = jnp.where(fit, weight, 0.0)
    place = jnp.where(fit, place, slabs.normal @ c)
    some = jnp.any(warm.active)
    most = PIVOTS_PER_ROW * (len(none) + 1)
    start = _Working(
        warm,
        place,
        weight,
        jnp.where(warm.active, 1.0, jnp.sum(warm.table * warm.table, 1)),
        none,
        none,
        some,
        jnp.zeros_like(some),
        jnp.zeros_like(some, int),
    )
    last = jax.lax.while_loop(
        lambda s: ~s.done & (s.pivots < most), lambda s: _pivot(slabs, s, careful), start
    )
    f = _refined(slabs, c, last.warm) if careful else _on_faces(slabs, c, last.warm, REFINEMENTS)[0]
    f = jnp.where(last.warm.active & (f * last.warm.side > 0), f, 0.0)
    return last, f, c - f @ slabs.normal


def _pivot(slabs: _Slabs, s: _Working, careful: bool) -> _Working:
    """One slab added or dropped.

    The slab whose face is dearest to reach, excess^2 over what is left of its row, enters.
    Raising its multiplier by t lowers those of the active ones by t rates. Either its excess
    vanishes first, and it is added, or another multiplier does, and that slab is dropped and
    the entering one goes on. (One of the two happens: the origin is feasible.)
    """
    table, active, side = s.warm
    if careful:
        s = s._replace(rest=jnp.where(active, 1.0, jnp.sum(table * table, 1)))
    force = jnp.where(active, side * s.weight, jnp.inf)
    lowest = -jnp.max(-force)
    settling = s.settling & (lowest < 0)
    excess = jnp.abs(s.place) - slabs.bound
    violated = ~active & ~s.passed & (excess > ROUNDING * slabs.scale)
    score = jnp.where(violated, excess, 0.0) * excess / jnp.maximum(s.rest, INDEPENDENT**2)
    best = jnp.max(score)
    fresh = ~jnp.any(s.entering)
    entering = jnp.where(fresh, _first(score, best), s.entering)
    # multipliers that turn negative on their own: the table is no more what it should be
    broken = fresh & ~s.settling & (lowest < -BROKEN * slabs.scale)
    done = (fresh & ~(best > 0) & ~settling) | broken

    height, sign = _pick(excess, entering), jnp.sign(_pick(s.place, entering))
    left = _pick(table, entering)
    square = left @ left
    toward = table @ _pick(slabs.normal, entering)
    rates = side * sign * toward
    falls = active & (rates > 0)
    last = jnp.where(falls, force, jnp.inf) / jnp.where(falls, rates, 1.0)
    nearest = -jnp.max(-last)
    independent = square > INDEPENDENT**2
    adding = independent & (height <= nearest * square) & ~settling
    stuck = ~independent & (nearest == jnp.inf) & ~settling
    moves = ~(done | stuck)
    chosen = _first(jnp.where(settling, force, last), jnp.where(settling, lowest, nearest))
    chosen = jnp.where(adding, entering, chosen)

    # an added row leaves the others what is orthogonal to it, a dropped one gives its part back
    along = _pick(table, chosen)
    if careful:
        strays = slabs.normal @ along - jnp.where(chosen, 1.0, 0.0)
        strays = jnp.where(active, strays, 0.0)
        along = along - strays @ table
    square = along @ along
    inverse = jnp.where(moves, 1.0, 0.0) / jnp.where(square > 0, square, 1.0)
    across = slabs.normal @ along
    of_active = jnp.where(adding, toward, table @ along)
    change = jnp.where(active, of_active, jnp.where(adding, across, -across)) * inverse
    push = jnp.where(adding, sign * height, _pick(s.weight, chosen))
    step = jnp.where(adding, push, -push) * inverse
    swapped = chosen & moves
    others = table - change[:, None] * along[None]
    return _Working(
        Warm(
            jnp.where(swapped[:, None], (inverse * along)[None], others),
            active ^ swapped,
            jnp.where(swapped, jnp.where(adding, sign, 0.0), side),
        ),
        s.place - step * across,
        jnp.where(
            swapped, jnp.where(adding, step, 0.0), s.weight - jnp.where(active, change, 0.0) * push
        ),
        jnp.where(swapped, inverse, s.rest - jnp.where(active, 0.0, change * across)),
        entering & ~adding & ~settling & moves,
        (s.passed & ~(moves & adding)) | (entering & stuck),
        settling,
        done,
        s.pivots + jnp.where(done, 0, 1),
    )


def _residual(slabs: _Slabs, w, f, p, scale):
    place = slabs.length * (slabs.normal @ p)
    missed = jnp.where(f != 0, jnp.abs(place - w * jnp.sign(f)), jnp.abs(place) - w)
    return jnp.maximum(jnp.max(missed), 0.0) / jnp.where(scale > 0, scale, 1.0)


def _pick(table, one_hot):
    """The row that is marked; zero where none is."""
    shape = (-1,) + (1,) * (table.ndim - 1)
    return jnp.sum(jnp.where(one_hot.reshape(shape), table, 0.0), 0)


def _first(values, wanted):
    """One-hot: the first entry that equals ``wanted``."""
    return jnp.arange(len(values)) == jnp.argmax(values == wanted)
