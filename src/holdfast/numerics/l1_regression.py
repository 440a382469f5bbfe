"""Regression that a few wildly wrong rows do not move: least sum of absolute residuals.

    minimise over x   sum_j w_j |y_j - Phi_j x|

Its dual, max y'd subject to Phi'd = 0 and |d_j| <= w_j, is solved by an interior-point method
(a predictor-corrector on a linear program with bounds), which leads to a face; a vertex of that
is found by elimination and, should rounding have misled it, improved by pivots. The vertex is
solved for exactly, so that rows without error are met to the last digit.

Source: Portnoy and Koenker, *The Gaussian hare and the Laplacian tortoise*, Statistical Science
12 (1997); Barrodale and Roberts for the pivots; DECODER (12), and (10) by Lemma 2.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.linalg import SMALL
from holdfast.numerics.reduced import Reduced, reduced

ROUNDS = 40
"""Interior-point steps at most; 8 to 20 are usual."""
CLOSE = 1e-9
"""Relative gap at which the interior point has told which vertex it is."""
STEP = 0.99995
"""Share of the way to the boundary that a step goes."""
PIVOTS = 64
"""Changes of the vertex at most; none is usual."""
ZERO = 1e-11
"""Residual, relative to the target, that a vertex counts as met; rounding leaves about 1e-15."""
FEASIBLE = 1e-9
"""Excess of a multiplier over its bound that is rounding."""
DEPENDENT = 1e-8
"""Length left of a unit row after elimination that counts as none."""


class Regression(NamedTuple):
    """``residual`` (m,) = y - Phi x, not weighted; ``objective``: the weighted sum.

    ``gap``: what the objective may at most be above the minimum, by a feasible point of the dual;
    ``rank``: of all rows together, below n where they do not determine x (it is then the
    smallest such x); ``rounds`` and ``pivots``: what it took.
    """

    x: Float[Array, " n"]
    residual: Float[Array, " m"]
    objective: Float[Array, ""]
    gap: Float[Array, ""]
    rank: Int[Array, ""]
    rounds: Int[Array, ""]
    pivots: Int[Array, ""]


def l1_regression(
    Phi: Float[Array, "m n"],
    y: Float[Array, " m"],
    weight: Float[Array, " m"] | None = None,
    exact: Bool[Array, " m"] | None = None,
) -> Regression:
    """The x with the least sum of weighted absolute residuals.

    ``weight`` (m,), not negative: 0 leaves a row out. ``exact`` (m,): rows that come first (met
    exactly where they can be, else by least squares) and do not count in the sum. Data and
    weights are expected to be finite. Source: DECODER (12).
    """
    return l1_of_reduced(reduced(Phi, y, weight, exact), Phi, y, weight, exact)


def l1_of_reduced(
    problem: Reduced,
    Phi: Float[Array, "m n"],
    y: Float[Array, " m"],
    weight: Float[Array, " m"] | None = None,
    exact: Bool[Array, " m"] | None = None,
) -> Regression:
    """The same, ``problem`` being these data reduced already."""
    scale = jnp.max(jnp.abs(problem.target), initial=0.0)
    scale = jnp.where(scale > 0, scale, 1.0)
    goal = problem.target / scale
    present = jnp.arange(Phi.shape[1]) < problem.free
    d, trust, rounds = _interior(problem.columns, goal, present)
    corner = _corner(problem.columns, trust, present)
    v = _vertex(problem.columns, goal, present, d, corner)
    x = problem.state(v.z * scale)
    residual = y - Phi @ x
    size = jnp.abs(residual) if weight is None else jnp.abs(residual) * weight
    size = size if exact is None else jnp.where(exact, 0.0, size)
    objective = jnp.sum(size)
    gap = jnp.maximum(objective - scale * _bound(problem.columns, goal, present, v), 0.0)
    return Regression(x, residual, objective, gap, problem.rank, rounds, v.pivots)


def _bound(columns, goal, present, v: "_Vertex"):
    """What the minimum is at least: goal'd of a d with columns'd = 0 and no entry above one."""
    d = v.side.at[v.corner.basis].add(jnp.where(present, v.multipliers, 0.0))
    # rounding in the equation, times the coordinates, is what the bound is off by
    off = jnp.abs(d @ columns) @ jnp.abs(v.z)
    return (goal @ d - off) / jnp.maximum(1.0, jnp.max(jnp.abs(d)))


class _Iterate(NamedTuple):
    """a and 1 - a are the two slacks of the dual d = 2 a - 1, ``up`` and ``down`` their
    multipliers: the positive and negative part of minus the residual.
    """

    a: Float[Array, " m"]
    z: Float[Array, " n"]
    up: Float[Array, " m"]
    down: Float[Array, " m"]
    gap: Float[Array, ""]
    round: Int[Array, ""]


def _interior(columns, goal, present: Bool[Array, " n"]):
    """The dual d, how near to met each row is (large: its residual is zero), and the rounds."""
    m = len(goal)
    # coordinates that are not there have no columns: one on the diagonal keeps them at zero
    absent = jnp.where(present, 0.0, 1.0)
    z = columns.T @ goal
    residual = columns @ z - goal
    floor = 1e-3 * jnp.mean(jnp.abs(residual)) + 1e-12
    up, down = jnp.maximum(residual, 0.0) + floor, jnp.maximum(-residual, 0.0) + floor
    start = _Iterate(
        jnp.full(m, 0.5), z, up, down, jnp.sum(up + down) * 0.5, jnp.asarray(0, jnp.int32)
    )

    def going(at: _Iterate):
        # the objective is about the sum of the absolute residuals
        size = jnp.sum(jnp.abs(at.up - at.down))
        return (at.gap > CLOSE * size) & (at.gap > 1e-15 * m) & (at.round < ROUNDS)

    at = jax.lax.while_loop(going, lambda at: _stepped(columns, absent, at), start)
    trust = 1.0 / (at.up / at.a + at.down / (1.0 - at.a))
    return 2.0 * at.a - 1.0, trust, at.round


def _stepped(columns, absent, at: _Iterate) -> _Iterate:
    """One predictor-corrector step."""
    a, other = at.a, 1.0 - at.a
    q = 1.0 / (at.up / a + at.down / other)
    factor = _factor(columns, q, absent)

    def directions(fixed):
        """The step whose residual change is (columns dz) and a change q (columns dz - fixed)."""
        dz = _solved(factor, columns.T @ (q * fixed))
        return dz, q * (columns @ dz - fixed)

    gap_now = at.up - at.down
    dz, da = directions(gap_now)
    d_up, d_down = -at.up * (1.0 + da / a), -at.down * (1.0 - da / other)
    forward = _reach(a, da, other, -da)
    dual = _reach(at.up, d_up, at.down, d_down)
    mu = at.up @ a + at.down @ other
    after = (at.up + dual * d_up) @ (a + forward * da) + (at.down + dual * d_down) @ (
        other - forward * da
    )
    mu = mu * (after / mu) ** 3 / (2 * len(a))
    # second-order terms of the complementarity products
    cross_up, cross_down = d_up * da / a, -d_down * da / other
    centre = mu * (1.0 / a - 1.0 / other)
    dz, da = directions(gap_now - centre + cross_up - cross_down)
    d_up = mu / a - at.up - at.up * da / a - cross_up
    d_down = mu / other - at.down + at.down * da / other - cross_down
    forward = _reach(a, da, other, -da)
    dual = _reach(at.up, d_up, at.down, d_down)
    a, up, down = a + forward * da, at.up + dual * d_up, at.down + dual * d_down
    return _Iterate(
        a, at.z - dual * dz, up, down, up @ a + down @ (1.0 - a), at.round + 1
    )


def _reach(first, d_first, second, d_second):
    """How far both can go before one reaches zero, 1 at most."""
    shrink = jnp.max(jnp.maximum(-d_first / first, -d_second / second))
    return jnp.minimum(1.0, STEP / jnp.maximum(shrink, STEP))


def _factor(columns, q, absent):
    """The Cholesky factor of columns' diag(q) columns, as a list of rows where it is small."""
    n = columns.shape[1]
    gram = (columns * q[:, None]).T @ columns
    ridge = absent + 1e-14 * jnp.max(jnp.diagonal(gram))
    if n > SMALL:
        return jnp.linalg.cholesky(gram + jnp.diag(ridge))
    lower: list[list[Array]] = []
    for i in range(n):
        row: list[Array] = []
        for j in range(i):
            row.append((gram[i, j] - sum(row[k] * lower[j][k] for k in range(j))) * lower[j][j])
        # the diagonal holds the inverse
        pivot = gram[i, i] + ridge[i] - sum(value * value for value in row)
        lower.append([*row, jax.lax.rsqrt(pivot)])
    return lower


def _solved(factor, right: Float[Array, " n"]) -> Float[Array, " n"]:
    """The solution with the factor of `_factor`."""
    if not isinstance(factor, list):
        return jax.scipy.linalg.cho_solve((factor, True), right)
    n = len(factor)
    half: list[Array] = []
    for i in range(n):
        half.append((right[i] - sum(factor[i][k] * half[k] for k in range(i))) * factor[i][i])
    for i in reversed(range(n)):
        rest = half[i] - sum(factor[k][i] * half[k] for k in range(i + 1, n))
        half[i] = rest * factor[i][i]
    return jnp.stack(half)


class _Corner(NamedTuple):
    """Independent rows ``basis`` (n,), and the inverse of the matrix they make."""

    basis: Int[Array, " n"]
    inverse: Float[Array, "n n"]


def _corner(columns, trust, present) -> _Corner:
    """Independent rows, those whose residual is nearest to zero first (elimination with pivots)."""
    m, n = columns.shape
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
            jnp.where(index == i, row.astype(jnp.int32), basis),
            directions + here[:, None] * direction,
            made + here[:, None] * own,
        )

    start = unit, jnp.zeros(n, jnp.int32), jnp.zeros((n, n)), jnp.zeros((n, n))
    _, basis, directions, made = jax.lax.fori_loop(0, n, chosen, start)
    return _Corner(basis, directions.T @ made)


class _Vertex(NamedTuple):
    """A corner, its residual (m,), the signs ``side`` (m,) of the rows that are not in it and the
    multipliers (n,) of those that are, which say whether it is optimal.
    """

    corner: _Corner
    z: Float[Array, " n"]
    residual: Float[Array, " m"]
    side: Float[Array, " m"]
    multipliers: Float[Array, " n"]
    pivots: Int[Array, ""]


def _vertex(columns, goal, present, d, corner: _Corner) -> _Vertex:
    """The vertex, improved by pivots until it is optimal."""

    def at(corner, count):
        mine = jnp.where(present, goal[corner.basis], 0.0)
        z = corner.inverse @ mine
        # one refinement: what elimination lost in digits comes back
        z = z + corner.inverse @ (mine - columns[corner.basis] @ z)
        residual = goal - columns @ z
        basic = _among(corner.basis, present, len(goal))
        # a row that is met without being in the basis keeps the interior point's multiplier
        met = jnp.abs(residual) <= ZERO
        side = jnp.where(basic, 0.0, jnp.where(met, d, jnp.sign(residual)))
        multipliers = -(side @ columns) @ corner.inverse
        return _Vertex(corner, z, residual, side, multipliers, count)

    def going(v: _Vertex):
        return (jnp.max(jnp.abs(v.multipliers)) > 1.0 + FEASIBLE) & (v.pivots < PIVOTS)

    def pivoted(v: _Vertex):
        basis, inverse = v.corner
        out = jnp.argmax(jnp.abs(v.multipliers))
        along = -inverse[:, out] * jnp.sign(v.multipliers[out])
        free = ~_among(basis, present, len(goal))
        row = _entering(columns @ along, free, v, jnp.abs(v.multipliers[out]))
        change = columns[row] @ inverse - jnp.where(jnp.arange(len(basis)) == out, 1.0, 0.0)
        inverse = inverse - inverse[:, out, None] * change / (columns[row] @ inverse[:, out])
        return at(_Corner(basis.at[out].set(row), inverse), v.pivots + 1)

    return jax.lax.while_loop(going, pivoted, at(corner, jnp.asarray(0, jnp.int32)))


def _among(basis, present, rows: int) -> Bool[Array, " m"]:
    """Which rows are in the basis."""
    same = (jnp.arange(rows)[:, None] == basis) & present
    return jnp.any(same, 1)


def _entering(change, free, v: _Vertex, slope) -> Int[Array, ""]:
    """The row that becomes zero at the lowest point along an edge of a vertex.

    The residuals of the ``free`` rows move by minus ``change``; the sum falls by ``slope`` - 1
    per unit at first.
    """
    met = jnp.abs(v.residual) <= ZERO
    moving = free & (jnp.abs(change) > ZERO)
    ahead = moving & (met | (v.residual * change > 0.0))
    step = jnp.where(met, 0.0, v.residual / jnp.where(moving, change, 1.0))
    # a row that is met bends by less: part of its slope is in the multiplier already
    bend = jnp.where(met, jnp.abs(change) + v.side * change, 2.0 * jnp.abs(change))
    order = jnp.argsort(jnp.where(ahead, step, jnp.inf))
    risen = jnp.cumsum(jnp.where(ahead, bend, 0.0)[order])
    return order[jnp.argmax(risen >= slope - 1.0)].astype(jnp.int32)
