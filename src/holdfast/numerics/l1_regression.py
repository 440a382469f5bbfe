"""Regression that a few wildly wrong rows do not move: least sum of absolute residuals.

    minimise over x   sum_j w_j |y_j - Phi_j x|

Its dual, max y'd subject to Phi'd = 0 and |d_j| <= w_j, is solved by an interior-point method
(a predictor-corrector on a linear program with bounds), which leads to a face; a vertex of that
is found by elimination and, should rounding have misled it, improved by pivots. The vertex is
solved for exactly, so that rows without error are met to the last digit.

Source: Portnoy and Koenker, *The Gaussian hare and the Laplacian tortoise*, Statistical Science
12 (1997); DECODER (12), and (10) by Lemma 2.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.l1_vertex import Vertex, corner, vertex
from holdfast.numerics.linalg import SMALL, backward, cholesky, forward
from holdfast.numerics.reduced import Reduced, reduced

ROUNDS = 40
"""Interior-point steps at most; 8 to 20 are usual."""
CLOSE = 1e-9
"""Relative gap at which the interior point has told which vertex it is."""
STEP = 0.99995
"""Share of the way to the boundary that a step goes."""
PASSES, CUT = 4, 1e-3
"""Passes at most, and what each cuts residuals to, relative to the one before."""
ALIKE = 1e-13
"""Gap, relative to the target, that is rounding."""
APART, GOLDEN = 1e-8, 0.6180339887498949
"""What rows are moved apart by, relative to their terms, in multiples of the golden section."""


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
    present = jnp.arange(Phi.shape[1]) < problem.free
    v = _solved_for(problem.columns, problem.target / scale, present)
    x = problem.state(v.z * scale)
    residual = y - Phi @ x
    size = jnp.abs(residual) if weight is None else jnp.abs(residual) * weight
    size = size if exact is None else jnp.where(exact, 0.0, size)
    objective = jnp.sum(size)
    gap = jnp.maximum(objective - scale * v.bound, 0.0)
    return Regression(x, residual, objective, gap, problem.rank, v.rounds, v.pivots)


class _Found(NamedTuple):
    """The best vertex so far, its objective, what the minimum is at least, and what it took."""

    z: Float[Array, " n"]
    objective: Float[Array, ""]
    bound: Float[Array, ""]
    rounds: Int[Array, ""]
    pivots: Int[Array, ""]
    passes: Int[Array, ""]


def _solved_for(columns, goal, present) -> _Found:
    """Passes of interior point and vertex: usually one.

    Next to residuals that are larger by many orders the others are all alike to an interior
    point: another pass takes what is left, large residuals cut short. Where more rows meet in a
    vertex than it needs pivots may lead nowhere: another pass moves them apart a little, which
    leaves a vertex that is optimal also without. All are judged by the goal itself.
    """
    size = jnp.sum(jnp.abs(goal))

    def going(at: _Found):
        rough = at.objective - at.bound > CLOSE * at.objective + ALIKE * size
        return (at.passes == 0) | (rough & (at.passes < PASSES))

    def another(at: _Found) -> _Found:
        left = goal - columns @ at.z
        most = jnp.max(jnp.abs(left), initial=0.0) * CUT**at.passes
        most = jnp.where(most > 0, most, 1.0)
        d, trust, rounds = _interior(columns, jnp.clip(left / most, -1.0, 1.0), present)
        basis = corner(columns, trust, present)
        terms = jnp.abs(goal) + jnp.abs(columns) @ jnp.abs(at.z)
        shake = jnp.where(at.passes > 0, terms, 0.0) * _uneven(len(goal))
        v = vertex(columns, goal, present, d, basis, shake)
        objective = jnp.sum(jnp.abs(v.residual))
        better = objective <= at.objective
        return _Found(
            jnp.where(better, v.z, at.z),
            jnp.where(better, objective, at.objective),
            jnp.maximum(at.bound, _bound(columns, goal, present, v)),
            at.rounds + rounds,
            at.pivots + v.pivots,
            at.passes + 1,
        )

    zero = jnp.asarray(0)
    start = _Found(jnp.zeros(len(present)), size, jnp.zeros(()), zero, zero, zero)
    return jax.lax.while_loop(going, another, start)


def sparsest(annihilator: Float[Array, "r m"], observed: Float[Array, " r"]) -> Regression:
    """The E with the least sum of absolute values and N E = observed, as the ``residual``.

    N: the ``annihilator``. Any E_0 that fits, and an orthonormal basis Phi of what N takes to
    zero, make it a regression: E = E_0 - Phi v, with v as its ``x``. Where nothing fits, E fits
    in least squares. Source: DECODER (10), (11), Lemma 2.
    """
    found = reduced(annihilator, observed)
    start = found.state(found.columns.T @ found.target)
    return l1_regression(found.hidden, start)


def _uneven(rows: int) -> Float[Array, " m"]:
    """Small numbers without a pattern."""
    return jnp.asarray(APART * (np.modf(np.arange(1, rows + 1) * GOLDEN)[0] - 0.5))


def _bound(columns, goal, present, v: Vertex):
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
    start = _Iterate(jnp.full(m, 0.5), z, up, down, jnp.sum(up + down) * 0.5, jnp.asarray(0))

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
    return _Iterate(a, at.z - dual * dz, up, down, up @ a + down @ (1.0 - a), at.round + 1)


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
        return cholesky(gram + jnp.diag(ridge))
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
        return backward(factor, forward(factor, right))
    n = len(factor)
    half: list[Array] = []
    for i in range(n):
        half.append((right[i] - sum(factor[i][k] * half[k] for k in range(i))) * factor[i][i])
    for i in reversed(range(n)):
        rest = half[i] - sum(factor[k][i] * half[k] for k in range(i + 1, n))
        half[i] = rest * factor[i][i]
    return jnp.stack(half)
