"""The interior point of a least sum of norms: cones of groups of rows, or of their rows.

    minimise over z   sum_g |r_g|        r = goal - columns z,  |.|: 2-norm or largest entry

as one cone programme: cones s >= |r_c|, a whole group or one of its rows, with heads s that a
group shares. A predictor-corrector with Nesterov and Todd's scaling starts, and stays, strictly
inside the cones and feasible for both the problem and its dual.

Source: Andersen, Roos and Terlaky, On implementing a primal-dual interior-point method for conic
quadratic optimization, Mathematical Programming 95 (2003).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

ROUNDS = 60
"""Interior-point steps at most; 8 to 20 are usual."""
CLOSE = 1e-14
"""Relative gap from which the interior point cannot be improved."""
STEP = 0.995
"""Share of the way to the boundary that a step goes."""
STALLED = 0.9
"""Share of the gap that, left by a step, shows that rounding has the upper hand..."""
ROUGH = 1e-11
"""... under this relative gap."""


class Groups(NamedTuple):
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


class Iterate(NamedTuple):
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


class _Scaling(NamedTuple):
    """Nesterov and Todd's: W = size [w, v'; v, I + v v' / (1 + w)] takes a dual cone's point and
    its inverse the primal cone's to the same, ``head``, ``rest`` of determinant ``det``.
    """

    of: Groups
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


def _scaling(of: Groups, heads, r, share, d) -> _Scaling:
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


def _determinant(of: Groups, head, rest):
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


def _direction(of: Groups, columns, at: Iterate, newton: _Newton, head, rest):
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


def interior(of: Groups, columns, goal, needed: Bool[Array, ""]) -> Iterate:
    """The last iterate, for a residual ``goal`` orthogonal to the columns, of size one."""
    size = of.norms(goal)
    heads = size + jnp.max(size, initial=0.0)
    heads = jnp.where(heads > 0, heads, 1.0)
    one = jnp.ones(of.member.shape[1])
    share = one if of.euclidean else of.spread(1.0 / jnp.maximum(of.sums(jnp.ones_like(goal)), 1.0))
    start = Iterate(
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


def _stepped(of: Groups, columns, goal, absent, at: Iterate) -> Iterate:
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


def _accepted(of: Groups, columns, goal, at: Iterate, new: Iterate) -> Iterate:
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


def _reach(of: Groups, tops, r, d_tops, dr, share, d, d_share, dd):
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
