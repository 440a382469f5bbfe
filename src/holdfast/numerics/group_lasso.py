"""Exact group LASSO by Newton's method on the active groups, warm-started.

    minimise over f   1/2 |c - Z' f|^2 + sum_g w_g |f_g|_2        Z (N x r), groups disjoint

Where every group is one coordinate `holdfast.numerics.lasso` is several times faster. Here the
norms are second-order cones, and no finite method exists: each round works on the largest
violation of the optimality conditions,

    f_g = 0 though  |grad_g| > w_g          those groups enter
    f_g != 0 though |grad_g| <= w_g at 0    those groups leave
    grad_g + w_g f_g / |f_g| != 0           a Newton step on all that are not zero

with grad = -Z (c - Z' f). Every step is taken to the exact minimum along its line (the objective
is convex), so that the objective never rises; close to the solution the Newton steps double the
digits.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.lasso import Solution
from holdfast.numerics.linalg import backward, cholesky, forward

ROUNDING = 1e-13
"""Violation, relative to max w + the largest |Z_g c|, at which a solution is one."""
RIDGE = 1e-14
"""What is added to the diagonal of a Newton step, relative: more groups than r can be active on
the way, and then the step goes along what is singular until a group vanishes."""
REACHED = 0.25
"""Violation, relative to eps |Z| |Z'| |f|, at which nothing is to be gained: f itself is
rounded. It is above `ROUNDING` where rows of Z are long and nearly dependent."""
ROUNDS = 40
ROUNDS_PER_GROUP = 8
BISECTIONS = 60
VANISHED = 1e-10
"""Size of a group after a step, relative to before, at which it has met its kink."""


class _Problem(NamedTuple):
    """``member`` (N x g): which coordinate is in which group; ``within`` = Z Z' inside groups."""

    Z: Float[Array, "N r"]
    gram: Float[Array, "N N"]
    within: Float[Array, "N N"]
    member: Float[Array, "N g"]
    w: Float[Array, " g"]
    c: Float[Array, " r"]

    @property
    def scale(self) -> Float[Array, ""]:
        """What a violation is compared with."""
        return jnp.max(self.w) + jnp.max(self.norms(self.Z @ self.c))

    def norms(self, v: Float[Array, " N"]) -> Float[Array, " g"]:
        """The 2-norm of every group."""
        return jnp.sqrt((v * v) @ self.member)

    def objective(self, f: Float[Array, " N"]) -> Float[Array, ""]:
        """What is minimised."""
        p = self.c - f @ self.Z
        return 0.5 * p @ p + self.w @ self.norms(f)


class _Round(NamedTuple):
    """The best ``f`` so far, the one at hand, its violation, whether it is good enough."""

    best: Float[Array, " N"]
    least: Float[Array, ""]
    f: Float[Array, " N"]
    done: Bool[Array, ""]
    rounds: Int[Array, ""]


class _State(NamedTuple):
    """Gradient, sizes and violations at one f."""

    grad: Float[Array, " N"]
    size: Float[Array, " g"]
    unit: Float[Array, " N"]
    missed: Float[Array, " N"]
    excess: Float[Array, " g"]
    off: Float[Array, " g"]


def group_lasso(
    Z: Float[Array, "N r"],
    w: Float[Array, " g"],
    c: Float[Array, " r"],
    group: np.ndarray,
    start: Float[Array, " N"],
) -> Solution:
    """The minimiser from a guess; ``group`` (N,) numbers the group of each coordinate.

    ``residual``: max over groups of the violated condition above, relative to
    max w + max |Z_g c|; ``pivots``: rounds, at most 40 + 8 per group. Where that is reached, the
    best f met is given with its residual. A c that is not finite: nor is the residual.

    Source: DECOMPOSE (31) with complex entries or a norm per sensor.
    """
    member = np.equal.outer(group, np.arange(len(w))).astype(float)
    gram = Z @ Z.T
    problem = _Problem(Z, gram, gram * jnp.asarray(member @ member.T), jnp.asarray(member), w, c)
    scale = problem.scale
    most = ROUNDS + ROUNDS_PER_GROUP * len(w)

    def turn(s: _Round) -> _Round:
        at = _state(problem, s.f)
        wrong = jnp.maximum(jnp.max(at.excess), jnp.max(at.off))
        better = wrong < s.least
        return _Round(
            jnp.where(better, s.f, s.best),
            jnp.where(better, wrong, s.least),
            _improved(problem, s.f, at),
            ~(wrong > jnp.maximum(ROUNDING * scale, REACHED * _rounding(problem, s.f))),
            s.rounds + 1,
        )

    # a start may come from an attack that is over
    start = jnp.where(problem.objective(start) < problem.objective(0.0 * start), start, 0.0)
    wrong = jnp.asarray(jnp.inf)
    first = _Round(start, wrong, start, jnp.asarray(False), jnp.asarray(0))
    last = jax.lax.while_loop(lambda s: ~s.done & (s.rounds < most), turn, first)
    # a scale that is not a number shows in the residual
    residual = jnp.maximum(last.least, 0.0) / jnp.where(scale == 0, 1.0, scale)
    return Solution(last.best, c - last.best @ Z, residual, last.rounds)


def _state(problem: _Problem, f) -> _State:
    grad = -problem.Z @ (problem.c - f @ problem.Z)
    size = problem.norms(f)
    active = size > 0
    unit = f / _spread(problem, jnp.where(active, size, 1.0))
    missed = jnp.where(
        _spread(problem, active.astype(float)) > 0, grad + _spread(problem, problem.w) * unit, 0.0
    )
    excess = jnp.where(active, -jnp.inf, problem.norms(grad) - problem.w)
    return _State(grad, size, unit, missed, excess, problem.norms(missed))


def _rounding(problem: _Problem, f) -> Float[Array, ""]:
    """What rounding f may do to the gradient."""
    size = jnp.abs(problem.Z)
    return jnp.finfo(f.dtype).eps * jnp.max(problem.norms(size @ (jnp.abs(f) @ size)))


def _spread(problem: _Problem, of_groups: Float[Array, " g"]) -> Float[Array, " N"]:
    """A value per group on each of its coordinates."""
    return problem.member @ of_groups


def _improved(problem: _Problem, f, at: _State):
    """A lower point: groups leave, or enter, or all that are there move."""
    active = at.size > 0
    at_zero = problem.norms(at.grad - problem.within @ f)
    leaving = active & (at_zero <= problem.w)
    entering = jnp.max(at.excess) > jnp.max(at.off)
    return jax.lax.cond(
        jnp.any(leaving),
        lambda: _without(problem, f, leaving, problem.w - at_zero),
        lambda: _along(
            problem,
            f,
            at,
            jax.lax.cond(entering, lambda: _entry(problem, at), lambda: _newton(problem, f, at)),
        ),
    )


def _without(problem: _Problem, f, leaving: Bool[Array, " g"], margin):
    """All leaving groups set to zero if that is lower, else the surest alone, which always is."""
    surest = jnp.arange(len(leaving)) == jnp.argmax(jnp.where(leaving, margin, -jnp.inf))
    every, one = (
        jnp.where(_spread(problem, gone.astype(float)) > 0, 0.0, f) for gone in (leaving, surest)
    )
    return jnp.where(problem.objective(every) < problem.objective(f), every, one)


def _entry(problem: _Problem, at: _State):
    """Each group that is violated nearly most goes where it would go alone."""
    entering = at.excess >= 0.5 * jnp.max(at.excess)
    norm = problem.norms(at.grad)
    unit = at.grad / _spread(problem, jnp.where(norm > 0, norm, 1.0))
    bend = (unit * (problem.within @ unit)) @ problem.member
    length = jnp.where(entering, at.excess, 0.0) / jnp.where(bend > 0, bend, 1.0)
    return -_spread(problem, length) * unit


def _newton(problem: _Problem, f, at: _State):
    """The step that solves the linearised conditions of all groups that are not zero."""
    there = _spread(problem, (at.size > 0).astype(float)) > 0
    bent = _spread(problem, problem.w / jnp.where(at.size > 0, at.size, jnp.inf))
    same = (problem.member @ problem.member.T) > 0
    curvature = jnp.diag(bent) - jnp.where(same, jnp.outer(bent * at.unit, at.unit), 0.0)
    H = jnp.where(there[:, None] & there[None], problem.gram + curvature, 0.0)
    diagonal = jnp.where(there, (1.0 + RIDGE) * jnp.diagonal(H) + RIDGE * jnp.max(H), 1.0)
    H = H - jnp.diag(jnp.diagonal(H)) + jnp.diag(diagonal)
    root = 1.0 / jnp.sqrt(diagonal)
    factor = cholesky(root[:, None] * H * root[None])
    step = -root * backward(factor, forward(factor, root * at.missed))
    return jnp.where(jnp.all(jnp.isfinite(step)), step, -at.missed / diagonal)


def _along(problem: _Problem, f, at: _State, step):
    """The lowest point between f and f + step: a root of the derivative, which only rises."""
    moved = step @ problem.Z
    slope, bend = at.grad @ step, moved @ moved

    def derivative(s):
        there = f + s * step
        length = problem.norms(there)
        turned = ((there * step) @ problem.member) / jnp.where(length > 0, length, 1.0)
        return slope + bend * s + problem.w @ turned

    def bisected():
        def halve(_, between):
            low, high = between
            middle = 0.5 * (low + high)
            rising = derivative(middle) > 0
            return jnp.where(rising, low, middle), jnp.where(rising, middle, high)

        return jax.lax.fori_loop(0, BISECTIONS, halve, (jnp.asarray(0.0), jnp.asarray(1.0)))[0]

    s = jax.lax.cond(derivative(1.0) <= 1e-3 * jnp.abs(slope), lambda: jnp.asarray(1.0), bisected)
    moved_to = f + s * step
    # a minimum at the kink of a group leaves rounding of it, which would block the next step
    rounding = VANISHED * at.size + 2e-16 * problem.norms(step)
    unfelt = problem.norms(problem.within @ moved_to) <= 0.01 * ROUNDING * problem.scale
    gone = (problem.norms(moved_to) <= rounding) | unfelt
    return jnp.where(_spread(problem, gone.astype(float)) > 0, 0.0, moved_to)
