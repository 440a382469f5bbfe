"""CARE: state and attack estimated jointly, then held to what physics allows.

The estimator without constraints is `UnknownInput`; on what it says each row lays the limits
of the plant (`holdfast.plants.constraints`): the state at k on those of the state, the attack
on those of the attack. Detection belongs on the estimate before the projection (``d_free``):
projected, it makes a test weaker, not stronger (errata, Theorem 9).

Source: CARE Algorithm 1, with the errata.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from holdfast.estimators.unknown_input import UnknownInput, UnknownInputState
from holdfast.estimators.unknown_input import build as build_unknown_input
from holdfast.numerics.limits import Limited
from holdfast.numerics.linalg import RANK_TOLERANCE, dot, repeat, symmetric
from holdfast.numerics.projection import project
from holdfast.numerics.truncated import Slabs, find_slabs, restricted
from holdfast.parts import Estimator, InvalidValue, Plant
from holdfast.plants.constraints import limits_of
from holdfast.records import Estimate, Observation, Status

STIFFNESS = 1e-8
"""Variance of a limit that gives way, relative to that of the estimate along its row: where
limits contradict each other the fallback "nearest" shares the violation among them."""


class Care(Estimator):
    """min (z - z^u)' P^{-1} (z - z^u)  subject to  rows z <= bound,  for z = x_k and z = d.

    ``project`` says what follows from it:

    "feedback"  the paper: the projected x_k is carried on, and the covariances are (22), (27),
                P - P A'(A P A')^{-1} A P for the active rows A. They hold if the truth lies on
                the active faces; where it lies inside they are too small. Singular, of rank
                n - (active rows).
    "output"    the same projection of what is given out; the filter runs on without it.
    "moments"   mean and covariance of the Gaussian N(z^u, P) restricted to the set
                (`holdfast.numerics.truncated`), state and attack jointly, which are right for a
                truth that is drawn so; the filter runs on without them.

    Limits of what the data leave undetermined at a row do not act there. Where no point of a
    set is left the row is INFEASIBLE and gives the estimate without that set; with
    ``fallback`` "nearest", the point that violates the limits least.

    Source: CARE (9), (10), (18)-(27), Algorithm 1 lines 14 to 19; errata 4 and 5.
    """

    free: UnknownInput
    slabs: Slabs = eqx.field(static=True)
    project: str = eqx.field(static=True)
    nearest: bool = eqx.field(static=True)

    @property
    def plant(self) -> Plant:
        """The plant watched."""
        return self.free.plant

    @property
    def delay(self) -> int:
        """Steps by which the attack estimate lags."""
        return self.free.delay

    def init(self) -> tuple[UnknownInputState, Estimate]:
        """The estimate one sample before the first row, without limits."""
        return self.free.init()

    def step(
        self, state: UnknownInputState, observation: Observation
    ) -> tuple[UnknownInputState, Estimate]:
        """One row without limits, then the limits on what it says."""
        state, free, cross = self.free.jointly(state, observation)
        rows, bound = limits_of(self.plant).state.at(state.k, observation.u)
        x = _hold(Limited.of(free.x, free.x_cov, rows, bound), self.nearest)
        d = _hold(Limited.of(free.d, free.d_cov, free.d_rows, free.d_bound), self.nearest)
        if self.project == "feedback":
            state = _carried(state, x, rows)
        empty = jnp.where(x.feasible & d.feasible, 0, int(Status.INFEASIBLE)).astype(jnp.int32)
        held = (x.value, x.cov, d.value, d.cov)
        if self.project == "moments":
            held = _restricted(x, d, cross, self.slabs)
        return state, eqx.tree_at(
            lambda e: (e.x, e.x_cov, e.d, e.d_cov, e.status), free, (*held, free.status | empty)
        )


class _Held(NamedTuple):
    """An estimate under its limits: where it is held, and by which rows how strongly."""

    value: Float[Array, " m"]
    cov: Float[Array, "m m"]
    active: Bool[Array, " r"]
    multipliers: Float[Array, " r"]
    feasible: Bool[Array, ""]
    free: Limited


def _hold(free: Limited, nearest: bool) -> _Held:
    """The estimate projected onto its limits; where they contradict each other, as it was."""
    found = project(free.value, free.cov, free.rows, free.bound)
    ok = found.feasible
    instead = _least_violation(free) if nearest else free.value
    value = jnp.where(free.unknown, free.value, jnp.where(ok, found.point, instead))
    cov = free.told(on_faces(free.cov, free.rows, found.active))
    return _Held(value, cov, found.active, found.multipliers, ok, free)


def _restricted(x: _Held, d: _Held, cross, slabs: Slabs):
    """Mean and covariance of x and of d, jointly Gaussian, inside the limits of both.

    The limits of an attack tell about the state that it moved, and the other way round.
    """
    n = len(x.value)
    sides = (x.free, d.free)
    cov = jnp.block([[x.free.cov, cross], [cross.T, d.free.cov]])
    rows = _side_by_side(x.free.rows, d.free.rows)
    bound = jnp.concatenate([jnp.where(s.feasible, s.free.bound, jnp.inf) for s in (x, d)])
    start = jnp.concatenate([side.value for side in sides])
    found = restricted(start, cov, rows, bound, slabs)
    mean = jnp.where(jnp.concatenate([side.unknown for side in sides]), start, found.mean)
    given = (mean[:n], found.cov[:n, :n], mean[n:], found.cov[n:, n:])
    x_mean = jnp.where(x.feasible, given[0], x.value)
    d_mean = jnp.where(d.feasible, given[2], d.value)
    return x_mean, x.free.told(given[1]), d_mean, d.free.told(given[3])


def _side_by_side(first: Float[Array, "a n"], second: Float[Array, "b m"]):
    """The rows of both, each on its own columns."""
    return jnp.concatenate(
        [
            jnp.pad(first, ((0, 0), (0, second.shape[1]))),
            jnp.pad(second, ((0, 0), (first.shape[1], 0))),
        ]
    )


def on_faces(
    cov: Float[Array, "n n"], rows: Float[Array, "m n"], active: Bool[Array, " m"]
) -> Float[Array, "n n"]:
    """P - P A'(A P A')^{-1} A P for the active rows A: the covariance if they hold exactly.

    Rows are taken one by one, (I - k a) P (I - k a)' with k = P a / (a P a'). What is left of
    a variance below `RANK_TOLERANCE` of what it was is rounding, and made zero: the rank is
    n less the number of active rows, whatever the numbers.

    Source: CARE (22), (27), errata 4.
    """

    def row(i, P):
        a = jnp.where(active[i], rows[i], 0.0)
        along = dot(P, a)
        variance = dot(a, along)
        gain = along / jnp.where(variance > 0, variance, 1.0)
        P = P - gain[:, None] * along
        return P - dot(P, a)[:, None] * gain

    left = symmetric(repeat(rows.shape[0], row, cov))
    gone = jnp.diagonal(left) <= RANK_TOLERANCE * jnp.diagonal(cov)
    return jnp.where(gone[:, None] | gone[None, :], 0.0, left)


def _carried(state: UnknownInputState, x: _Held, rows) -> UnknownInputState:
    """The state with x_k where it is held, and what is correlated with it moved along.

    For H = 0 nothing else in z is determined at k, and this is lines 17 to 19 of Algorithm 1.
    """
    wide = jnp.pad(rows, ((0, 0), (0, state.z.shape[0] - rows.shape[1])))
    z = state.z - dot(state.P, dot(wide.T, x.multipliers))
    return eqx.tree_at(lambda s: (s.z, s.P), state, (z, on_faces(state.P, wide, x.active)))


def _least_violation(free: Limited):
    """The point whose squared violations of the limits, in its standard deviations, are least.

    The projection of (value, 0) with a stiff slack for each row: rows z - slack <= bound.
    """
    m, n = free.rows.shape
    variance = jnp.sum(dot(free.rows, free.cov) * free.rows, 1)
    slack = STIFFNESS * jnp.where(variance > 0, variance, 1.0)
    wide = jnp.concatenate([free.rows, -jnp.eye(m)], 1)
    both = jnp.pad(free.cov, (0, m)) + jnp.diag(jnp.concatenate([jnp.zeros(n), slack]))
    return project(jnp.pad(free.value, (0, m)), both, wide, free.bound).point[:n]


def build(
    plant: Plant,
    x0,
    P0,
    *,
    project: Literal["feedback", "output", "moments"] = "feedback",
    delay: int = 0,
    fallback: Literal["unprojected", "nearest"] = "unprojected",
) -> Care:
    """The estimator from the estimate ``x0``, ``P0`` before the first row.

    ``project``: what follows from the limits; ``delay``: steps to wait for an attack;
    ``fallback``: what a row gives whose limits contradict each other (all in `Care`).
    Raises `InvalidValue` for a setting that cannot be.
    """
    for key, value, allowed in (
        ("project", project, ("feedback", "output", "moments")),
        ("fallback", fallback, ("unprojected", "nearest")),
    ):
        if value not in allowed:
            raise InvalidValue(key, repr(value), " or ".join(map(repr, allowed)))
    limits = limits_of(plant)
    slabs = find_slabs(np.zeros((0, 0)))
    if project == "moments":
        sides = (limits.state.matrix, limits.attack.matrix)
        if any(side.ndim > 2 for side in sides):
            expected = "constant rows of the constraints (their bounds may move)"
            raise InvalidValue("project", "'moments'", expected)
        slabs = find_slabs(np.asarray(_side_by_side(*sides)))
    free = build_unknown_input(plant, x0, P0, delay=delay)
    # the abstract field `plant` is a property here, which pyright takes for one more argument
    return Care(free, slabs, project, fallback == "nearest")  # pyright: ignore[reportCallIssue]
