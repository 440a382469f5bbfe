"""Regression that a few wildly wrong groups of rows do not move: least sum of norms.

    minimise over x   sum_g |r_g|        r = diag(w) (y - Phi x),  |.|: 2-norm or largest entry

With ``columns`` orthonormal (`holdfast.numerics.reduced`) the dual is

    maximise r' d      subject to   columns' d = 0,  |d_g|* <= 1

with the dual norm: the 2-norm, or the sum of absolute values. Both are one cone programme: cones
s >= |r_c|, a whole group or one of its rows, with heads s that a group shares. It is solved by a
predictor-corrector with Nesterov and Todd's scaling that starts, and stays, feasible for both.

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
from holdfast.numerics.reduced import Reduced, reduced

Norm = Literal["l1l2", "l1linf"]

ROUNDS = 60
"""Interior-point steps at most; 8 to 20 are usual."""
AGREE = 4e-15
"""Residual of least squares, relative to the largest row, that is rounding."""
CLOSE = 1e-14
"""Relative gap from which the interior point cannot be improved."""
STEP = 0.995
"""Share of the way to the boundary that a step goes."""
STALLED = 0.9
"""Share of the gap that, left by a step, shows that rounding has the upper hand..."""
ROUGH = 1e-11
"""... under this relative gap."""
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
    member = np.equal.outer(np.asarray(group), np.arange(max(group, default=-1) + 1)).astype(float)
    of = _Groups(member, norm == "l1l2")
    problem = reduced(Phi, y, weight, exact)
    z, objective, gap, rounds = _solved(of, problem)
    x = problem.state(z)
    residual = y - Phi @ x
    sized = residual if weight is None else residual * weight
    sized = sized if exact is None else jnp.where(exact, 0.0, sized)
    total = jnp.sum(of.norms(sized))
    # rounding on the way back is a part of the gap
    gap = jnp.maximum(total - (objective - gap), 0.0)
    return GroupRegression(x, residual, total, gap, problem.rank, rounds)


class _Groups(NamedTuple):
    """``member`` (m x g): which row is in which group. A cone is a group, or else a row."""

    member: np.ndarray
    euclidean: bool

    def sums(self, rows: Float[Array, " m"]) -> Float[Array, " g"]:
        """Over the rows of each group."""
        return rows @ self.member

    def spread(self, groups: Float[Array, " g"]) -> Float[Array, " m"]:
        """A value per group on each of its rows."""
        return jnp.asarray(self.member) @ groups

    def cone_sums(self, rows: Float[Array, " m"]) -> Float[Array, " c"]:
        """Over the rows of each cone."""
        return self.sums(rows) if self.euclidean else rows

    def of_cones(self, cones: Float[Array, " c"]) -> Float[Array, " m"]:
        """A value per cone on each of its rows."""
        return self.spread(cones) if self.euclidean else cones

    def heads(self, groups: Float[Array, " g"]) -> Float[Array, " c"]:
        """A value per group on each of its cones."""
        return groups if self.euclidean else self.spread(groups)

    def totals(self, cones: Float[Array, " c"]) -> Float[Array, " g"]:
        """Over the cones of each group."""
        return cones if self.euclidean else self.sums(cones)

    def norms(self, r: Float[Array, " m"]) -> Float[Array, " g"]:
        """Of every group."""
        if self.euclidean:
            return jnp.sqrt(self.sums(r * r))
        return jnp.max(jnp.abs(r)[:, None] * self.member, 0, initial=0.0)

    def dual_norms(self, d: Float[Array, " m"]) -> Float[Array, " g"]:
        """Of every group."""
        return jnp.sqrt(self.sums(d * d)) if self.euclidean else self.sums(jnp.abs(d))


class _Iterate(NamedTuple):
    """Primal cones (``heads``, residual of z), dual cones (``share``, -d), all strictly inside.

    The shares of a group's cones sum to one.
    """

    z: Float[Array, " n"]
    heads: Float[Array, " g"]
    d: Float[Array, " m"]
    share: Float[Array, " c"]
    gap: Float[Array, ""]
    going: Bool[Array, ""]
    round: Int[Array, ""]


class _Polished(NamedTuple):
    """The best points so far."""

    z: Float[Array, " n"]
    d: Float[Array, " m"]
    gap: Float[Array, ""]
    attempt: Int[Array, ""]


def _solved(of: _Groups, problem: Reduced):
    """z, its objective and gap, and the rounds taken."""
    columns, target = problem.columns, problem.target
    least = columns.T @ target
    left = target - columns @ least
    left = left - columns @ (columns.T @ left)
    scale = jnp.max(jnp.abs(left), initial=0.0)
    # rows that agree to rounding need no choice between them
    agree = scale <= AGREE * jnp.max(jnp.abs(target), initial=0.0)
    scale = jnp.where(agree, 1.0, scale)
    at = _interior(of, columns, left / scale, ~agree)
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


def _feasible(of: _Groups, columns, d):
    """The dual point next to d: orthogonal to the columns, then inside its bounds."""
    for _ in range(2):
        d = d - columns @ (columns.T @ d)
    return d / jnp.maximum(1.0, jnp.max(of.dual_norms(d), initial=0.0))


def _gap(of: _Groups, problem: Reduced, z, d) -> Float[Array, ""]:
    """By which the objective at z is above the minimum at most.

    A minimiser z* has  sum |r*_g| >= r*' d = r' d + (z - z*)' columns' d, where the columns' d is
    rounding and |z - z*| <= |r| + |r*|, the 2-norms, which the sums of norms bound.
    """
    r = problem.target - problem.columns @ z
    size = of.norms(r)
    most = 1.0 if of.euclidean else float(np.sqrt(max(1.0, of.member.sum(0).max(initial=0.0))))
    stray = jnp.sqrt(jnp.sum((problem.columns.T @ d) ** 2))
    return jnp.sum(jnp.maximum(size - of.sums(r * d), 0.0)) + 2.0 * most * stray * jnp.sum(size)


# ---- the interior point


class _Scaling(NamedTuple):
    """Nesterov and Todd's: W = size [w, v'; v, I + v v' / (1 + w)] takes a dual cone's point and
    its inverse the primal cone's to the same, ``head``, ``rest`` of determinant ``det``.
    """

    of: _Groups
    size: Float[Array, " c"]
    w: Float[Array, " c"]
    v: Float[Array, " m"]
    head: Float[Array, " c"]
    rest: Float[Array, " m"]
    det: Float[Array, " c"]

    def _turned(self, head, rest, sign):
        along = self.of.cone_sums(self.v * rest)
        by = sign * head + along / (1.0 + self.w)
        return self.w * head + sign * along, rest + self.of.of_cones(by) * self.v

    def scaled(self, head, rest):
        """W times a vector."""
        head, rest = self._turned(head, rest, 1.0)
        return self.size * head, self.of.of_cones(self.size) * rest

    def unscaled(self, head, rest):
        """The inverse of W times a vector."""
        head, rest = self._turned(head, rest, -1.0)
        return head / self.size, rest / self.of.of_cones(self.size)


def _scaling(of: _Groups, heads, r, share, d) -> _Scaling:
    """At one primal and one dual point."""
    det_r, det_d = _determinant(of, heads, r), _determinant(of, share, d)
    root_r, root_d = jnp.sqrt(det_r), jnp.sqrt(det_d)
    product = (heads * share - of.cone_sums(r * d)) / (root_r * root_d)
    norm = 1.0 / jnp.sqrt(2.0 * (1.0 + product))
    w = norm * (heads / root_r + share / root_d)
    v = of.of_cones(norm / root_r) * r + of.of_cones(norm / root_d) * d
    found = _Scaling(of, jnp.sqrt(root_r / root_d), w, v, w, v, root_r * root_d)
    head, rest = found.scaled(share, -d)
    return found._replace(head=head, rest=rest)


def _determinant(of: _Groups, head, rest):
    """head^2 - |rest|^2: positive inside the cone."""
    size = jnp.sqrt(of.cone_sums(rest * rest))
    return jnp.where(head > size, (head - size) * (head + size), -1.0)


class _Newton(NamedTuple):
    """The linear equations of a step: a dual change = ``diagonal`` times the residual's, less
    the outer product of ``radial`` in each group, once the heads are eliminated.
    """

    bend: Float[Array, " c"]
    cross: Float[Array, " m"]
    diagonal: Float[Array, " m"]
    radial: Float[Array, " m"]
    factor: Float[Array, "n n"]


def _newton(scaling: _Scaling, columns, absent) -> _Newton:
    of, w = scaling.of, scaling.w
    inverse = 1.0 / scaling.size**2
    bend = inverse * (2.0 * w * w - 1.0)
    cross = of.of_cones(2.0 * inverse * w) * scaling.v
    if of.euclidean:
        diagonal = of.of_cones(inverse)
        radial = of.of_cones(inverse * jnp.sqrt(2.0 / bend)) * scaling.v
    else:
        diagonal = bend
        radial = cross / of.spread(jnp.sqrt(of.totals(bend)))
    along = columns.T @ (radial[:, None] * of.member)
    gram = (columns * diagonal[:, None]).T @ columns - along @ along.T + jnp.diag(absent)
    ridge = 1e-15 * jnp.max(jnp.diagonal(gram), initial=0.0) * jnp.eye(len(absent))
    return _Newton(bend, cross, diagonal, radial, jnp.linalg.cholesky(gram + ridge))


def _direction(of: _Groups, columns, at: _Iterate, newton: _Newton, head, rest):
    """Changes of z, heads, residual, d, share for a dual right-hand side (head, rest)."""
    need = of.totals(head) if of.euclidean else of.totals(head + at.share) - 1.0
    bend = of.totals(newton.bend)
    fixed = -rest - newton.cross * of.spread(need / bend)
    dz = jax.scipy.linalg.cho_solve((newton.factor, True), columns.T @ (at.d + fixed))
    dr = -columns @ dz
    heads = (need + of.sums(newton.cross * dr)) / bend
    dd = fixed + newton.diagonal * dr - newton.radial * of.spread(of.sums(newton.radial * dr))
    share = jnp.zeros_like(at.share)
    if not of.euclidean:
        share = head - newton.bend * of.heads(heads) + newton.cross * dr
    return dz, heads, dr, dd, share


def _interior(of: _Groups, columns, goal, needed: Bool[Array, ""]) -> _Iterate:
    """The last iterate, for a residual ``goal`` orthogonal to the columns, of size one."""
    size = of.norms(goal)
    heads = size + jnp.max(size, initial=0.0)
    heads = jnp.where(heads > 0, heads, 1.0)
    one = jnp.ones(of.member.shape[1])
    share = one if of.euclidean else of.spread(1.0 / jnp.maximum(of.sums(jnp.ones_like(goal)), 1.0))
    start = _Iterate(
        jnp.zeros(columns.shape[1]),
        heads,
        jnp.zeros_like(goal),
        share,
        jnp.sum(heads),
        needed & jnp.isfinite(jnp.sum(heads)),
        jnp.asarray(0),
    )
    # coordinates beyond the rank have no columns: one on the diagonal keeps them at zero
    absent = jnp.where(jnp.sum(columns * columns, 0) > 0, 0.0, 1.0)
    return jax.lax.while_loop(
        lambda at: at.going & (at.round < ROUNDS),
        lambda at: _stepped(of, columns, goal, absent, at),
        start,
    )


def _stepped(of: _Groups, columns, goal, absent, at: _Iterate) -> _Iterate:
    """One predictor-corrector step, or the end."""
    r, tops = goal - columns @ at.z, of.heads(at.heads)
    scaling = _scaling(of, tops, r, at.share, at.d)
    newton = _newton(scaling, columns, absent)
    # predictor: straight to a gap of zero
    _, heads, dr, dd, share = _direction(of, columns, at, newton, -at.share, at.d)
    # the gap falls in proportion to the step
    far = jnp.minimum(1.0, _reach(of, tops, r, of.heads(heads), dr, at.share, at.d, share, dd))
    centre = (1.0 - far) ** 3 * (tops @ at.share - r @ at.d) / len(at.share)
    # corrector: toward the centre, with the second-order terms as far as the predictor goes
    a, a_rest = scaling.unscaled(of.heads(heads), dr)
    b, b_rest = scaling.scaled(share, -dd)
    top = centre - far * (a * b + of.cone_sums(a_rest * b_rest))
    rest = -far * (of.of_cones(a) * b_rest + of.of_cones(b) * a_rest)
    head = (scaling.head * top - of.cone_sums(scaling.rest * rest)) / scaling.det
    rest = (rest - of.of_cones(head) * scaling.rest) / of.of_cones(scaling.head)
    head, rest = scaling.unscaled(head, rest)
    dz, heads, dr, dd, share = _direction(of, columns, at, newton, head - at.share, rest + at.d)
    far = STEP * _reach(of, tops, r, of.heads(heads), dr, at.share, at.d, share, dd)
    far = jnp.minimum(1.0, far)
    new = at._replace(
        z=at.z + far * dz,
        heads=at.heads + far * heads,
        d=at.d + far * dd,
        share=at.share + far * share,
        round=at.round + 1,
    )
    return _accepted(of, columns, goal, at, new)


def _accepted(of: _Groups, columns, goal, at: _Iterate, new: _Iterate) -> _Iterate:
    """The new iterate if it is one: inside, and with a smaller gap."""
    r, tops = goal - columns @ new.z, of.heads(new.heads)
    gap = jnp.sum(new.heads) - r @ new.d
    inside = jnp.min(_determinant(of, tops, r), initial=1.0) > 0
    inside = inside & (jnp.min(_determinant(of, new.share, new.d), initial=1.0) > 0)
    fine = inside & (gap < at.gap) & jnp.all(jnp.isfinite(new.z))
    stalled = (gap > STALLED * at.gap) & (gap < ROUGH * jnp.sum(new.heads))
    going = fine & ~stalled & (gap > CLOSE * jnp.sum(new.heads))
    kept = jax.tree.map(lambda a, b: jnp.where(fine, a, b), new._replace(gap=gap), at)
    return kept._replace(going=going, round=new.round)


def _reach(of: _Groups, tops, r, d_tops, dr, share, d, d_share, dd):
    """How far both points can go inside their cones, 2 at most."""
    far = jnp.asarray(2.0)
    for head, rest, d_head, d_rest in ((tops, r, d_tops, dr), (share, d, d_share, dd)):
        a = d_head**2 - of.cone_sums(d_rest * d_rest)
        b = head * d_head - of.cone_sums(rest * d_rest)
        c = _determinant(of, head, rest)
        # from inside, (p' J dp)^2 >= (p' J p) (dp' J dp) whatever the direction
        q = jnp.sqrt(jnp.maximum(b * b - a * c, 0.0)) - b
        times = jnp.where(q > 0, c, 2.0) / jnp.where(q > 0, q, 1.0)
        far = jnp.minimum(far, jnp.min(times, initial=2.0))
    return far


# ---- the polish


def _pseudo(rows: Float[Array, "m k"]):
    """Rows^+ (k x m), and the projector on what the rows see."""
    left, values, basis = jnp.linalg.svd(rows, full_matrices=False)
    there = values > INDEPENDENT
    basis = jnp.where(there[:, None], basis, 0.0)
    return (basis.T / jnp.where(there, values, 1.0)) @ left.T, basis.T @ basis


def _smooth(of: _Groups, problem: Reduced, z, d, bound):
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


def _vertex(of: _Groups, problem: Reduced, z, d, bound):
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
