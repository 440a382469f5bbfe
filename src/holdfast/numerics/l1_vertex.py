"""A vertex of least absolute residuals: independent rows that are met, and whether it is the best.

The multipliers d_j = +-1 of the rows that are not met leave, by Phi'd = 0, those of the rows that
are: where none of these is over one in size, d proves that no x has a smaller sum. Where one is,
its row may go, and the first row that stops the descent takes its place (a pivot).

Source: Barrodale and Roberts, An improved algorithm for discrete l1 linear approximation, SIAM
Journal on Numerical Analysis 10 (1973).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

PIVOTS = 64
"""Changes of the vertex at most; none is usual."""
ZERO = 1e-13
"""Residual, relative to its terms, that a vertex counts as met; rounding leaves about 1e-15."""
FEASIBLE = 1e-9
"""Excess of a multiplier over its bound that is rounding."""
DEPENDENT = 1e-8
"""Length left of a unit row after elimination that counts as none."""


class Corner(NamedTuple):
    """Independent rows ``basis`` (n,), and the inverse of the matrix they make."""

    basis: Int[Array, " n"]
    inverse: Float[Array, "n n"]


def corner(
    columns: Float[Array, "m n"], trust: Float[Array, " m"], present: Bool[Array, " n"]
) -> Corner:
    """Independent rows, those with most ``trust`` first (elimination with pivots)."""
    n = columns.shape[1]
    length = jnp.sqrt(jnp.sum(columns * columns, 1))
    unit = columns / jnp.where(length > 0, length, 1.0)[:, None]
    root = jnp.sqrt(trust) * length
    index = jnp.arange(n)

    def chosen(i, carry):
        left, basis, directions, made = carry
        size = jnp.sqrt(jnp.sum(left * left, 1))
        row = jnp.argmax(jnp.where(size > DEPENDENT, root * size, 0.0))
        short = size[row]
        here = (present & (index == i)).astype(float)
        direction = left[row] / jnp.where(short > DEPENDENT, short, 1.0)
        share = directions @ columns[row]
        # direction = made_i basis rows
        own = (here - share @ made) / jnp.where(short > DEPENDENT, short * length[row], 1.0)
        left = left - (left @ direction)[:, None] * direction
        return (
            left.at[row].set(0.0),
            jnp.where(index == i, row, basis),
            directions + here[:, None] * direction,
            made + here[:, None] * own,
        )

    start = unit, jnp.zeros(n, int), jnp.zeros((n, n)), jnp.zeros((n, n))
    _, basis, directions, made = jax.lax.fori_loop(0, n, chosen, start)
    return Corner(basis, directions.T @ made)


class Vertex(NamedTuple):
    """A corner, its residual (m,), the signs ``side`` (m,) of the rows that are not in it, which of
    all are ``met``, and the multipliers (n,) of those in it, which say whether it is optimal.
    """

    corner: Corner
    z: Float[Array, " n"]
    residual: Float[Array, " m"]
    side: Float[Array, " m"]
    met: Bool[Array, " m"]
    multipliers: Float[Array, " n"]
    pivots: Int[Array, ""]


def vertex(
    columns: Float[Array, "m n"],
    goal: Float[Array, " m"],
    present: Bool[Array, " n"],
    d: Float[Array, " m"],
    corner: Corner,
    shake: Float[Array, " m"],
) -> Vertex:
    """The vertex, improved by pivots until it is optimal for the goal moved by ``shake``.

    ``present``: the columns that are there; ``d``: multipliers for rows that are met beyond need.
    """
    moved = goal + shake

    def solution(corner: Corner, goal):
        mine = jnp.where(present, goal[corner.basis], 0.0)
        z = corner.inverse @ mine
        # one refinement: what elimination lost in digits comes back
        return z + corner.inverse @ (mine - columns[corner.basis] @ z), mine

    def at(corner: Corner, count):
        z, mine = solution(corner, moved)
        residual = moved - columns @ z
        basic = _among(corner.basis, present, len(goal))
        # a row that is met without being in the basis keeps the interior point's multiplier
        reach = jnp.abs(corner.inverse) @ jnp.abs(mine)
        met = jnp.abs(residual) <= ZERO * (jnp.abs(columns) @ reach + jnp.abs(goal))
        side = jnp.where(basic, 0.0, jnp.where(met, d, jnp.sign(residual)))
        multipliers = -(side @ columns) @ corner.inverse
        return Vertex(corner, z, residual, side, met, multipliers, count)

    def going(v: Vertex):
        return (jnp.max(jnp.abs(v.multipliers)) > 1.0 + FEASIBLE) & (v.pivots < PIVOTS)

    def pivoted(v: Vertex):
        basis, inverse = v.corner
        out = jnp.argmax(jnp.abs(v.multipliers))
        along = -inverse[:, out] * jnp.sign(v.multipliers[out])
        free = ~_among(basis, present, len(goal))
        row = _entering(columns @ along, free, v, jnp.abs(v.multipliers[out]))
        change = columns[row] @ inverse - jnp.where(jnp.arange(len(basis)) == out, 1.0, 0.0)
        inverse = inverse - inverse[:, out, None] * change / (columns[row] @ inverse[:, out])
        return at(Corner(basis.at[out].set(row), inverse), v.pivots + 1)

    v = jax.lax.while_loop(going, pivoted, at(corner, jnp.asarray(0)))
    z, _ = solution(v.corner, goal)
    return v._replace(z=z, residual=goal - columns @ z)


def _among(basis, present, rows: int) -> Bool[Array, " m"]:
    """Which rows are in the basis."""
    same = (jnp.arange(rows)[:, None] == basis) & present
    return jnp.any(same, 1)


def _entering(change, free, v: Vertex, slope) -> Int[Array, ""]:
    """The row that becomes zero at the lowest point along an edge of a vertex.

    The residuals of the ``free`` rows move by minus ``change``; the sum falls by ``slope`` - 1
    per unit at first.
    """
    met = v.met
    moving = free & (jnp.abs(change) > ZERO)
    ahead = moving & (met | (v.residual * change > 0.0))
    step = jnp.where(met, 0.0, v.residual / jnp.where(moving, change, 1.0))
    # a row that is met bends by less: part of its slope is in the multiplier already
    bend = jnp.where(met, jnp.abs(change) + v.side * change, 2.0 * jnp.abs(change))
    bend = jnp.where(ahead, bend, 0.0)
    step = jnp.where(ahead, step, jnp.inf)
    # without sorting, which takes long to compile
    risen = jnp.where(step <= step[:, None], 1.0, 0.0) @ bend
    return jnp.argmin(jnp.where(risen >= slope - 1.0, step, jnp.inf))
