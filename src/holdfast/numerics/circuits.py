"""Do strips |y_j - Phi_j x| <= t_j have a common point, and if not: which few of them have none?

By Helly's theorem n + 1 strips of x in R^n are enough to show that all of them have no point in
common. Such a *circuit* is a linear dependency of its rows, c' Phi = 0, with

    |c' y|  >  sum_j |c_j| t_j

which no x can satisfy, whatever it is: a proof, as a bad least-squares fit is not.

The rows are written in terms of n of them, Phi = T Phi_N. Row b of T is a dependency, e_b - T_b,
and the strips of its rows leave T_b Phi_N x no other values than T_b y_N +- |T_b| t_N: where that
interval misses strip b, a circuit is found. While there is none, x is moved from one vertex to
the next: the most violated row takes the place in N of a row that can still give way (the simplex
method for bounds). It ends at a common point or at a row where nothing can give way: a circuit.

Source: Dutertre and de Moura, A fast linear-arithmetic solver for DPLL(T), CAV 2006, section 3.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.linalg import repeat

RANK = 1e-10
"""What is left of a unit row, orthogonally to others, at which it depends on them."""
NOTHING = 1e-9
"""A coefficient of a dependency of unit rows that counts as zero."""
SLACK = 1e-9
"""Share of the tolerances up to which a strip is missed without consequences."""
ROUNDING = 1e-13
"""The same of the samples themselves."""
DRIFT = 1e-7
"""Error of a dependency at which it shows nothing any more."""
BOLD, MOST = 6, 40
"""Pivots per column by the largest violation, and after that, by Bland's rule, in all."""

LOYALTY = 30.0
"""How much rather a row joins a basis if its unit has one there."""
HEAVIEST = 1e6
"""Largest ratio of the weights 1 / t_j of a fit."""
REFINEMENTS = 2

CONSISTENT, CONFLICT, UNDECIDED = 0, 1, 2


class Strips(NamedTuple):
    """Unit ``rows``, their ``centre`` y and ``half`` width t; ``unit``: the rows attacked alike."""

    rows: Float[Array, "m n"]
    centre: Float[Array, " m"]
    half: Float[Array, " m"]
    unit: Int[Array, " m"]


class Tableau(NamedTuple):
    """All rows in terms of those ``at`` the columns; columns not ``placed`` are nobody's: 0."""

    table: Float[Array, "m n"]
    at: Int[Array, " n"]
    placed: Bool[Array, " n"]


class Verdict(NamedTuple):
    """``status``; the units of ``circuit`` (one of them has to go), or those ``forced`` to go.

    A conflict with neither is one between fixed rows.
    """

    status: Int[Array, ""]
    circuit: Bool[Array, " U"]
    forced: Bool[Array, " U"]


class Disjoint(NamedTuple):
    """Contradictions without a free unit in common: ``more`` units have to go because of them.

    Those ``forced``, and one of ``circuit``, the smallest of the others. ``status`` of all rows,
    the ``there`` that are left.
    """

    there: Bool[Array, " m"]
    more: Int[Array, ""]
    forced: Bool[Array, " U"]
    circuit: Bool[Array, " U"]
    status: Int[Array, ""]
    going: Bool[Array, ""]


class _Vertex(NamedTuple):
    tableau: Tableau
    value: Float[Array, " n"]
    missed: Bool[Array, " m"]
    pivots: Int[Array, ""]
    status: Int[Array, ""]


def exchange(tableau: Tableau, row: Int[Array, ""], column: Int[Array, ""]) -> Tableau:
    """Row ``row`` takes the place of the one at ``column``."""
    old = tableau.table
    own = jnp.arange(old.shape[1]) == column
    pivot = old[row]
    change = (pivot - jnp.where(own, 1.0, 0.0)) / pivot[column]
    table = old - old[:, column][:, None] * change[None, :]
    return Tableau(table, jnp.where(own, row, tableau.at), tableau.placed | own)


def spanning(
    rows: Float[Array, "m n"],
    weight: Float[Array, " m"],
    unit: Int[Array, " m"] | None = None,
    loyalty: float = 1.0,
) -> Tableau:
    """Independent rows that span all with a ``weight`` > 0, heavy and nearly orthogonal ones first.

    Rows of a ``unit`` that has one in the basis count ``loyalty`` times as much. Rows of weight 0
    become zero.
    """
    n = rows.shape[1]
    start = Tableau(
        jnp.where(weight[:, None] > 0, rows, 0.0), jnp.zeros(n, int), jnp.zeros(n, bool)
    )

    def more(carry):
        tableau, _, going = carry
        return going & ~jnp.all(tableau.placed)

    def add(carry):
        tableau, weight, _ = carry
        left = jnp.where(tableau.placed, 0.0, jnp.abs(tableau.table))
        size = jnp.max(left, 1)
        score = jnp.where(size > RANK, size * weight, 0.0)
        row = jnp.argmax(score)
        some = score[row] > 0
        if unit is not None:
            alike = unit == unit[row]
            # once: a row in the basis scores nothing
            known = jnp.any(alike[tableau.at] & tableau.placed)
            weight = jnp.where(alike & ~known, loyalty * weight, weight)
        then = jax.lax.cond(
            some, lambda: exchange(tableau, row, jnp.argmax(left[row])), lambda: tableau
        )
        return then, weight, some

    tableau = jax.lax.while_loop(more, add, (start, weight, jnp.asarray(True)))[0]
    return tableau._replace(table=jnp.where(tableau.placed, tableau.table, 0.0))


def disjoint(
    strips: Strips,
    there: Bool[Array, " m"],
    fixed: Bool[Array, " m"],
    weight: Float[Array, " m"],
    guess: Float[Array, " m"],
    units: int,
    enough: Int[Array, ""],
) -> Disjoint:
    """Contradictions between the rows ``there``, as `examine` finds them, up to ``enough``.

    ``more`` exceeds all ``units`` where fixed rows contradict each other.
    """

    def another(so_far: Disjoint) -> Disjoint:
        verdict = examine(strips, so_far.there, fixed, weight, guess, units)
        wrong = verdict.status == CONFLICT
        size = jnp.sum(jnp.where(verdict.circuit, 1, 0))
        forced = jnp.sum(jnp.where(verdict.forced, 1, 0))
        more = so_far.more + forced + jnp.where(size > 0, 1, 0)
        more = jnp.where(wrong & (size + forced == 0), units + 1, more)
        known = jnp.sum(jnp.where(so_far.circuit, 1, 0))
        smaller = (size > 0) & ((known == 0) | (size < known))
        gone = verdict.circuit | verdict.forced
        return Disjoint(
            so_far.there & (fixed | ~gone[strips.unit]),
            more,
            so_far.forced | verdict.forced,
            jnp.where(smaller, verdict.circuit, so_far.circuit),
            jnp.where(so_far.more == 0, verdict.status, so_far.status),
            wrong & (more < enough),
        )

    none, nothing = jnp.zeros(units, bool), jnp.asarray(0)
    start = Disjoint(there, nothing, none, none, jnp.asarray(UNDECIDED), jnp.asarray(True))
    return jax.lax.while_loop(lambda d: d.going, another, start)


def examine(
    strips: Strips,
    there: Bool[Array, " m"],
    fixed: Bool[Array, " m"],
    weight: Float[Array, " m"],
    guess: Float[Array, " m"],
    units: int,
) -> Verdict:
    """Whether the strips ``there`` have a point in common.

    ``fixed`` rows are not charged to their units. ``weight``: which rows to look at first;
    ``guess``: where a good x is, by what it does to every row.
    """
    several = units < len(strips.centre)
    tableau = spanning(
        strips.rows,
        jnp.where(there, weight, 0.0),
        strips.unit if several else None,
        LOYALTY if several else 1.0,
    )
    low, high = strips.centre - strips.half, strips.centre + strips.half
    value = jnp.clip(guess, low, high)[tableau.at]
    n = value.shape[0]
    start = _Vertex(tableau, value, jnp.zeros_like(there), jnp.asarray(0), jnp.asarray(UNDECIDED))
    last = jax.lax.while_loop(
        lambda s: (s.status == UNDECIDED) & (s.pivots <= MOST * n),
        lambda s: _step(strips, there, low, high, s),
        start,
    )
    none = jnp.zeros(units, bool)
    return jax.lax.cond(
        last.status == CONFLICT,
        lambda: _charged(strips, there, fixed, last, units),
        lambda: Verdict(last.status, none, none),
    )


def _step(strips: Strips, there, low, high, state: _Vertex) -> _Vertex:
    tableau, value, _, pivots, _ = state
    table, at, placed = tableau
    size = jnp.abs(table)
    centre = strips.centre[at]
    reach = size @ strips.half[at] + strips.half
    slack = ROUNDING * (size @ jnp.abs(centre) + jnp.abs(strips.centre)) + SLACK * reach
    missed = there & (jnp.abs(strips.centre - table @ centre) > reach + slack)
    place = table @ value
    off = jnp.where(there, jnp.abs(place - strips.centre) - strips.half - 2.0 * slack, 0.0)
    violated = off > 0
    status = jnp.where(
        jnp.any(missed), CONFLICT, jnp.where(jnp.any(violated), UNDECIDED, CONSISTENT)
    )
    bland = pivots > BOLD * len(at)
    row = jnp.where(bland, jnp.argmax(violated), jnp.argmax(off))
    side = jnp.where(place[row] < strips.centre[row], 1.0, -1.0)
    pull = side * table[row]
    gives = jnp.where(pull > 0, value < high[at], value > low[at]) & placed
    eligible = gives & (jnp.abs(pull) > NOTHING)
    first = jnp.argmin(jnp.where(eligible, at, len(there)))
    column = jnp.where(bland, first, jnp.argmax(jnp.where(eligible, jnp.abs(pull), 0.0)))
    stuck = ~jnp.any(eligible)
    bound = jnp.where(side > 0, low[row], high[row])
    tableau, value = jax.lax.cond(
        (status == UNDECIDED) & ~stuck,
        lambda: (exchange(tableau, row, column), value.at[column].set(bound)),
        lambda: (tableau, value),
    )
    pivots = jnp.where(stuck, MOST * len(at), pivots) + 1
    return _Vertex(tableau, value, missed, pivots, status)


def _charged(strips: Strips, there, fixed, last: _Vertex, units: int) -> Verdict:
    """The circuit with the fewest units to charge, of those that its tableau shows."""
    table, at, placed = last.tableau
    drift = jnp.max(jnp.abs(strips.rows - table @ strips.rows[at]), 1)
    sound = last.missed & (drift <= DRIFT * (1.0 + jnp.sum(jnp.abs(table), 1)))
    unit, own = strips.unit, strips.unit[at]
    takes = (jnp.abs(table) > NOTHING) & placed & ~fixed[at]
    share = jnp.where(takes, 1.0, 0.0)
    # a unit is counted at the first of its columns
    before = jnp.tril(jnp.where(own[:, None] == own[None, :], 1.0, 0.0), -1).T
    columns = jnp.sum(jnp.where(takes & (share @ before < 0.5), 1, 0), 1)
    alone = ~fixed & ~jnp.any(takes & (unit[:, None] == own[None, :]), 1)
    count = jnp.where(sound, columns + jnp.where(alone, 1, 0), 2 * units)
    row = jnp.argmin(count)
    # of one unit alone: it has to go, as have all others of this kind
    single = count == 1
    first = jnp.where(fixed, own[jnp.argmax(takes, 1)], unit)
    mask = jnp.zeros(units, bool)
    forced = mask.at[first].max(single) & (count[row] == 1)
    circuit = mask.at[own].max(takes[row]).at[unit[row]].max(~fixed[row])
    some = count[row] <= units
    return Verdict(jnp.where(some, CONFLICT, UNDECIDED), circuit & some & (count[row] > 1), forced)


def shortest_fit(
    strips: Strips, Phi: Float[Array, "m n"], y: Float[Array, " m"], kept: Bool[Array, " m"]
) -> tuple[Float[Array, " n"], Int[Array, ""]]:
    """The least-squares x of the rows ``kept`` with weights 1 / t_j, and their rank.

    Of all such x the shortest. ``Phi`` x and ``y`` are the strips' in another basis. The rows
    are written in terms of those that the weights choose, whose normal equations are as good as
    orthogonal.

    Source: Peters and Wilkinson, The least squares problem and pseudo-inverses, 1970.
    """
    n = Phi.shape[1]
    half = jnp.where(kept, strips.half, 0.0)
    widest = jnp.max(half)
    weight = widest / jnp.maximum(half, widest / HEAVIEST)
    weight = jnp.where(kept, jnp.where(widest > 0, weight, 1.0), 0.0)
    table, at, placed = spanning(strips.rows, weight)
    rank = jnp.sum(jnp.where(placed, 1, 0))
    own = jnp.where(placed, weight[at], 1.0)
    tall = weight[:, None] * table / own
    normal = tall.T @ tall + jnp.diag(jnp.where(placed, 0.0, 1.0))
    left, size, right = jnp.linalg.svd(jnp.where(placed[:, None], Phi[at], 0.0))
    size = jnp.where(jnp.arange(n) < rank, 1.0 / jnp.where(size > 0, size, 1.0), 0.0)

    def closer(_, x):
        step = jnp.linalg.solve(normal, tall.T @ (weight * (y - Phi @ x))) / own
        return x + right.T @ (size * (left.T @ jnp.where(placed, step, 0.0)))

    return repeat(1 + REFINEMENTS, closer, jnp.zeros(n)), rank
