"""Regression that a few wildly wrong groups of rows do not move: least sum of norms.

    minimise over x   sum_g |r_g|        r = diag(w) (y - Phi x),  |.|: 2-norm or largest entry

With ``columns`` orthonormal (`holdfast.numerics.reduced`) the dual is

    maximise r' d      subject to   columns' d = 0,  |d_g|* <= 1

with the dual norm: the 2-norm, or the sum of absolute values. Both are one cone programme, solved
by an interior point (`holdfast.numerics.norm_cones`).

What that leaves of the order of its gap, a polish removes: multipliers strictly inside tell which
groups are met and, for the largest entry, which rows are active. These equations are solved; for
the 2-norm the groups that are left are smooth, and Newton's method finishes. What a dual point,
made feasible to rounding, bounds is reported as the gap, wherever the points came from.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.linalg import repeat
from holdfast.numerics.norm_cones import Groups, interior
from holdfast.numerics.reduced import Reduced, reduced

Norm = Literal["l1l2", "l1linf"]

AGREE = 4e-15
"""Residual of least squares, relative to the largest row, that is rounding."""
ZERO_MULTIPLIERS = (1e-3, 1e-5, 1e-7, 1e-1)
"""Distance of a multiplier from its bound that counts as none, by attempts of the polish: an
interior point of relative gap g leaves g^(1/2) where the solution is degenerate, else g."""
POLISHED = 1e-13
"""Relative gap at which no other attempt is made, and under which a polished point is the one
taken: the objective cannot tell them, but what is solved for is exact."""
INDEPENDENT = 1e-9
"""Singular value of active rows under which they are dependent."""
FLAT = 1e-13
"""Curvature, relative to the largest, in which there is nothing but rounding."""
NEWTON = 6
"""Newton steps; from the interior point they double its digits."""


class GroupRegression(NamedTuple):
    """``residual`` (m,) = y - Phi x, not weighted; ``objective``: the sum of norms, weighted.

    ``gap``: what the objective may at most be above the minimum, by a feasible point of the dual;
    ``rank``: of all rows together, below n where they do not determine x (it is then the
    smallest such x); ``rounds`` of the interior point.
    """

    x: Float[Array, " n"]
    residual: Float[Array, " m"]
    objective: Float[Array, ""]
    gap: Float[Array, ""]
    rank: Int[Array, ""]
    rounds: Int[Array, ""]


def group_regression(
    Phi: Float[Array, "m n"],
    y: Float[Array, " m"],
    group: tuple[int, ...],
    norm: Norm = "l1l2",
    weight: Float[Array, " m"] | None = None,
    exact: Bool[Array, " m"] | None = None,
) -> GroupRegression:
    """The x with the least sum of the norms of groups of weighted residuals.

    ``group``: the number, from 0, of the group of each row, static; a group's rows need not be
    neighbours. ``norm``: of a group, "l1l2" its 2-norm, "l1linf" its largest absolute value.
    ``weight`` (m,), not negative: 0 leaves a row out, and a weight of a group is that of each of
    its rows. ``exact`` (m,): rows that come first (met exactly where they can be, else by least
    squares) and do not count in the norms. Never raises on data: a gap that is not small
    against the objective, or against the rounding of y, says that this x is not the minimiser.
    Data that are not finite: nor is the gap. Source: DECODER (12), with a norm per sensor.
    """
    problem = reduced(Phi, y, weight, exact)
    return group_of_reduced(problem, Phi, y, group, norm, weight, exact)


def group_of_reduced(
    problem: Reduced,
    Phi: Float[Array, "m n"],
    y: Float[Array, " m"],
    group: tuple[int, ...],
    norm: Norm = "l1l2",
    weight: Float[Array, " m"] | None = None,
    exact: Bool[Array, " m"] | None = None,
) -> GroupRegression:
    """The same, ``problem`` being these data reduced already."""
    member = np.equal.outer(np.asarray(group), np.arange(max(group, default=-1) + 1)).astype(float)
    of = Groups(member, norm == "l1l2")
    z, objective, gap, rounds = _solved(of, problem)
    x = problem.state(z)
    residual = y - Phi @ x
    sized = residual if weight is None else residual * weight
    sized = sized if exact is None else jnp.where(exact, 0.0, sized)
    total = jnp.sum(of.norms(sized))
    # rounding on the way back is a part of the gap
    gap = jnp.maximum(total - (objective - gap), 0.0)
    return GroupRegression(x, residual, total, gap, problem.rank, rounds)


class _Polished(NamedTuple):
    """The best points so far."""

    z: Float[Array, " n"]
    d: Float[Array, " m"]
    gap: Float[Array, ""]
    attempt: Int[Array, ""]


def _solved(of: Groups, problem: Reduced):
    """z, its objective and gap, and the rounds taken."""
    columns, target = problem.columns, problem.target
    least = columns.T @ target
    left = target - columns @ least
    left = left - columns @ (columns.T @ left)
    scale = jnp.max(jnp.abs(left), initial=0.0)
    # rows that agree to rounding need no choice between them
    agree = scale <= AGREE * jnp.max(jnp.abs(target), initial=0.0)
    scale = jnp.where(agree, 1.0, scale)
    at = interior(of, columns, left / scale, ~agree)
    start = least + scale * at.z
    bounds = jnp.asarray(ZERO_MULTIPLIERS)

    def size(z):
        return jnp.sum(of.norms(target - columns @ z))

    def attempted(best: _Polished) -> _Polished:
        polish = _smooth if of.euclidean else _vertex
        z, d = polish(of, problem, start, at.d, bounds[best.attempt])
        d = _feasible(of, columns, d)
        kept, replaced = (
            jnp.stack([_gap(of, problem, of_z, of_d) for of_d in (best.d, d)])
            for of_z in (best.z, z)
        )
        better = jnp.min(replaced) <= jnp.maximum(jnp.min(kept), POLISHED * size(z))
        gaps = jnp.where(better, replaced, kept)
        return _Polished(
            jnp.where(better, z, best.z),
            jnp.where(gaps[1] < gaps[0], d, best.d),
            jnp.min(gaps),
            best.attempt + 1,
        )

    def going(best: _Polished):
        rough = ~(best.gap <= POLISHED * size(best.z)) | (best.attempt == 0)
        return rough & (best.attempt < len(bounds))

    d = _feasible(of, columns, at.d)
    first = _Polished(start, d, _gap(of, problem, start, d), jnp.asarray(0))
    best = jax.lax.while_loop(going, attempted, first)
    return best.z, size(best.z), best.gap, at.round


def _feasible(of: Groups, columns, d):
    """The dual point next to d: orthogonal to the columns, then inside its bounds."""
    for _ in range(2):
        d = d - columns @ (columns.T @ d)
    return d / jnp.maximum(1.0, jnp.max(of.dual_norms(d), initial=0.0))


def _gap(of: Groups, problem: Reduced, z, d) -> Float[Array, ""]:
    """By which the objective at z is above the minimum at most.

    A minimiser z* has  sum |r*_g| >= r*' d = r' d + (z - z*)' columns' d, where the columns' d is
    rounding and |z - z*| <= |r| + |r*|, the 2-norms, which the sums of norms bound.
    """
    r = problem.target - problem.columns @ z
    size = of.norms(r)
    most = 1.0 if of.euclidean else float(np.sqrt(max(1.0, of.member.sum(0).max(initial=0.0))))
    stray = jnp.sqrt(jnp.sum((problem.columns.T @ d) ** 2))
    return jnp.sum(jnp.maximum(size - of.sums(r * d), 0.0)) + 2.0 * most * stray * jnp.sum(size)


def _pseudo(rows: Float[Array, "m k"]):
    """Rows^+ (k x m), and the projector on what the rows see."""
    left, values, basis = jnp.linalg.svd(rows, full_matrices=False)
    there = values > INDEPENDENT
    basis = jnp.where(there[:, None], basis, 0.0)
    return (basis.T / jnp.where(there, values, 1.0)) @ left.T, basis.T @ basis


def _smooth(of: Groups, problem: Reduced, z, d, bound):
    """The groups whose multiplier is inside met, Newton's method for the others: z and d."""
    columns, target = problem.columns, problem.target
    met = of.spread(jnp.where(of.dual_norms(d) < 1.0 - bound, 1.0, 0.0)) > 0
    back, seen = _pseudo(jnp.where(met[:, None], columns, 0.0))
    loose = jnp.eye(len(z)) - seen

    def unit(z):
        r = jnp.where(met, 0.0, target - columns @ z)
        size = of.norms(r)
        size = jnp.where(size > 0, size, 1.0)
        return r / of.spread(size), 1.0 / size

    def closer(_, z):
        z = z + back @ jnp.where(met, target - columns @ z, 0.0)
        u, inverse = unit(z)
        spread = jnp.where(met, 0.0, of.spread(inverse))
        along = columns.T @ ((u * jnp.sqrt(spread))[:, None] * of.member)
        bent = loose @ ((columns * spread[:, None]).T @ columns - along @ along.T) @ loose
        values, vectors = jnp.linalg.eigh(0.5 * (bent + bent.T))
        # a projector on nothing leaves the square of its rounding
        none = jnp.maximum(FLAT * jnp.max(values), FLAT**2 * jnp.max(spread, initial=0.0))
        there = values > none
        slope = jnp.where(there, vectors.T @ (loose @ (columns.T @ u)), 0.0)
        step = vectors @ (slope / jnp.where(there, values, 1.0))
        return z + loose @ step

    z = repeat(NEWTON, closer, z)
    z = z + back @ jnp.where(met, target - columns @ z, 0.0)
    d = jnp.where(met, d, unit(z)[0])
    for _ in range(2):
        d = d - back.T @ (columns.T @ d)
    return z, d


def _vertex(of: Groups, problem: Reduced, z, d, bound):
    """The rows with a multiplier as large as their group's head, which is zero where the
    group's multipliers are inside: z and d.
    """
    columns, target = problem.columns, problem.target
    met = of.spread(jnp.where(of.dual_norms(d) < 1.0 - bound, 1.0, 0.0)) > 0
    active = ~met & (jnp.abs(d) > bound)
    side = jnp.where(active, jnp.sign(d), 0.0)
    signs = side[:, None] * of.member
    used = met | active
    rows = jnp.concatenate([jnp.where(used[:, None], columns, 0.0), signs], 1)
    back, _ = _pseudo(rows)
    heads = of.norms(jnp.where(used, target - columns @ z, 0.0))
    both = jnp.concatenate([z, heads])
    for _ in range(2):
        both = both + back @ (jnp.where(used, target, 0.0) - rows @ both)
    z = both[: len(z)]
    d = jnp.where(used, d, 0.0)
    whole = jnp.where(of.sums(jnp.where(active, 1.0, 0.0)) > 0, 1.0, 0.0)
    wanted = jnp.concatenate([jnp.zeros(len(z)), whole])
    for _ in range(2):
        d = d - back.T @ (rows.T @ d - wanted)
    return z, d
