"""Minimum-variance unbiased joint estimate of state and attack, the attack wholly free.

Attacks may enter the dynamics (G), the outputs (H) or both, H of any rank, and any sample may
be missing. The vector (x_k, d_k, ..., d_{k-1-L}) is carried with what the data leave
undetermined (`holdfast.numerics.blue`): nothing about d is assumed, so d_k starts free at
every step. Where C G V2 has full column rank and L = 0 this is the ULISE of Yong, Zhu and
Frazzoli; with H = 0 it is CARE's Algorithm 1, lines 1 to 13 (line 9 corrected by + Q).

An attack that reaches the outputs only after some steps (C G = 0) is determined by later
data: with ``delay`` L the vector remembers L more attacks, and row k gives the oldest.

Source: CARE (5)-(8), (15), Algorithm 1; NISE (8), Algorithm 1, with the errata of both.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from holdfast.estimators.channels import direct_channels, hidden_input
from holdfast.numerics.blue import (
    Split,
    absorb,
    echelon,
    leftover,
    split,
    undetermined,
    whitener,
)
from holdfast.numerics.linalg import dot, sandwich
from holdfast.parts import Estimator, InvalidValue, Plant, step_zero
from holdfast.plants.constraints import limits_of
from holdfast.plants.linear import LinearPlant
from holdfast.plants.local import motion, sensing
from holdfast.records import Estimate, Observation, Status

PASSES = 6
"""Linearisations of a nonlinear plant at one row, at most: Newton's method doubles the digits."""
SETTLED = 1e-3
"""Move of the linearisation point, in standard deviations of the estimate, taken as none."""


class Structure(NamedTuple):
    """What a step determines and leaves free, whatever the numbers measured.

    ``free`` is about what is carried on, ``unknown`` about all that the row estimates.
    """

    parts: Split
    free: Float[Array, "m m"]
    unknown: Bool[Array, " l"]


class UnknownInputState(eqx.Module):
    """z = (x_k, d_k, ..., d_{k-L}), its covariance and the basis ``free`` of what is undetermined.

    ``inputs``: u_k back to u_{k-L+1}. A constant plant need not find the structure of a step
    again once it repeats itself: ``usual`` is then what maps ``free`` onto itself where every
    sample arrives and none is authenticated, and ``settled`` says that it does.
    """

    k: Int[Array, ""]
    z: Float[Array, " s"]
    P: Float[Array, "s s"]
    free: Float[Array, "s s"]
    inputs: Float[Array, "l nu"]
    settled: Bool[Array, ""]
    usual: Structure | None


class _Point(NamedTuple):
    """Where a nonlinear plant is linearised: before the step and after it."""

    x_before: Float[Array, " n"]
    d_before: Float[Array, " nd"]
    x: Float[Array, " n"]
    d: Float[Array, " nd"]


class _Row(NamedTuple):
    """What one row estimates: z = (x_k, d_k, ..., d_{k-1-L}), and what of it is unknown."""

    z: Float[Array, " w"]
    P: Float[Array, "w w"]
    structure: Structure
    settled: Bool[Array, ""]
    usual: Structure | None
    residual: Float[Array, " ny"]
    residual_cov: Float[Array, "ny ny"]


class UnknownInput(Estimator):
    """x_k and d from y up to k, best linear unbiased with every attack free; see the module.

    ``direct`` marks the channels whose axis lies in the row space of H: they are given at
    k - L, the others at k - 1 - L (per step where H is). ``hidden``: some attack that moves
    the state reaches no output of its own row. ``active``: the channels that may be attacked;
    the others are 0, with variance 0. A nonlinear plant is linearised about the estimates of
    the same row, again until they settle, NOT_CONVERGED where they do not; or, unless
    ``settle``, as NISE has it: f about the row before, h about the prediction.
    """

    plant: Plant
    x0: Float[Array, " n"]
    P0: Float[Array, "n n"]
    direct: Bool[Array, "*t nd"]
    hidden: Bool[Array, "*t"]
    active: Bool[Array, " nd"]
    delay: int = eqx.field(static=True)
    settle: bool = eqx.field(static=True)

    def init(self) -> tuple[UnknownInputState, Estimate]:
        """The estimate one sample before the first row; the attacks up to there are free."""
        n, nd, ny, nu = self._sizes
        size = n + nd * (self.delay + 1)
        P = jnp.zeros((size, size)).at[:n, :n].set(self.P0)
        unknown = jnp.concatenate([jnp.zeros(n, bool), jnp.tile(self.active, self.delay + 2)])
        free = jnp.diag(jnp.where(unknown[:size], 1.0, 0.0))
        usual = None
        if isinstance(self.plant, LinearPlant) and self.plant.constant:
            rows = jnp.zeros((ny, size + nd))
            usual = Structure(Split(jnp.eye(ny), rows, rows), jnp.zeros_like(free), unknown)
        state = UnknownInputState(
            step_zero(),
            jnp.concatenate([self.x0, jnp.zeros(size - n)]),
            P,
            free,
            jnp.zeros((self.delay, nu)),
            jnp.asarray(False),
            usual,
        )
        row = _Row(
            jnp.pad(state.z, (0, nd)),
            jnp.pad(P, (0, nd)),
            Structure(Split(jnp.eye(0), *2 * (jnp.zeros((0, 0)),)), free, unknown),
            state.settled,
            usual,
            jnp.zeros(ny),
            jnp.zeros((ny, ny)),
        )
        nothing = jnp.zeros(nu), jnp.asarray(int(Status.OK), jnp.int32)
        return state, self._estimate(row, jnp.asarray(1, jnp.int32), *nothing)[0]

    def step(
        self, state: UnknownInputState, observation: Observation
    ) -> tuple[UnknownInputState, Estimate]:
        """One row: predict z, determine what can be, correct the rest."""
        state, estimate, _ = self.jointly(state, observation)
        return state, estimate

    def jointly(
        self, state: UnknownInputState, observation: Observation
    ) -> tuple[UnknownInputState, Estimate, Float[Array, "n nd"]]:
        """`step`, and the covariance of the errors of x and d (0 where either is undetermined)."""
        k, status = state.k + 1, observation.status
        if isinstance(self.plant, LinearPlant):
            row = self._row(state, observation, None)
        elif not self.settle:
            row = self._predicted(state, observation)
        else:
            row, moving = self._relinearised(state, observation)
            status = status | jnp.where(moving, int(Status.NOT_CONVERGED), 0)
        hidden = jnp.where(_at_row(self.hidden, k), int(Status.HIDDEN_INPUT), 0)
        inputs = jnp.concatenate([observation.u[None], state.inputs])
        found = self._estimate(row, k, inputs[-1], (status | hidden).astype(jnp.int32))
        keep = state.z.shape[0]
        state = UnknownInputState(
            k,
            row.z[:keep],
            row.P[:keep, :keep],
            row.structure.free,
            inputs[: self.delay],
            row.settled,
            row.usual,
        )
        return state, *found

    @property
    def _sizes(self) -> tuple[int, int, int, int]:
        plant = self.plant
        return len(plant.states), len(plant.attacks), len(plant.outputs), len(plant.inputs)

    def _row(self, state: UnknownInputState, observation: Observation, at: _Point | None) -> _Row:
        """The update, a nonlinear plant taken as its tangent about ``at``."""
        k, u, seen, trusted = state.k + 1, observation.u, observation.seen, observation.trusted
        n, nd, ny, _ = self._sizes
        before = (state.z[:n], state.z[n : n + nd]) if at is None else at[:2]
        m = motion(self.plant, k, before[0], u, before[1])
        x = dot(m.A, state.z[:n]) + dot(m.G, state.z[n : n + nd]) + m.offset
        move = _move(m.A, m.G, self.delay)
        P = sandwich(move, state.P)
        P = P + jnp.pad(m.Q, (0, P.shape[0] - n))
        s = sensing(self.plant, k, *((x, u, jnp.zeros(nd)) if at is None else (at.x, u, at.d)))
        new = _new_attack(s.H, trusted, self.active)
        new = jnp.pad(new, ((n, P.shape[0] - n - nd), (0, 0)))
        free = jnp.concatenate([dot(move, state.free), new], 1)
        H = jnp.where(trusted[:, None], 0.0, s.H)
        sense = jnp.pad(jnp.concatenate([s.C, H], 1), ((0, 0), (0, P.shape[0] - n - nd)))
        whiten = self.plant.whiten if isinstance(self.plant, LinearPlant) else whitener
        W, W_inverse = whiten(s.R, seen)
        whole = jnp.all(seen) & ~jnp.any(trusted)
        structure, settled, usual = _structure(state, whole, W, sense, free)
        M = dot(W, sense)
        update = absorb(P, M, free, structure.parts)
        expected = dot(s.C, x) + s.offset
        innovation = jnp.where(seen, self.plant.innovation(observation.y, expected), 0.0)
        z = jnp.concatenate([x, jnp.zeros(nd), state.z[n:]])
        z = z + dot(update.gain, dot(W, innovation))
        blind = dot(W_inverse, update.blind)
        spread = sandwich(M, P) + jnp.eye(ny)
        return _Row(
            z,
            update.cov,
            structure,
            settled,
            usual,
            dot(dot(blind, W), innovation),
            sandwich(blind, spread),
        )

    def _predicted(self, state: UnknownInputState, observation: Observation) -> _Row:
        """The row with h linearised about the prediction, which takes in the attack before k.

        That attack is found first, with h about the prediction without it: where h is linear
        in what finds it (Assumption 4.1) the two agree.
        """
        n, nd, _, _ = self._sizes
        k, u = state.k + 1, observation.u
        x, d, none = state.z[:n], state.z[n : n + nd], jnp.zeros(nd)
        first = _Point(x, d, self.plant.transition(k, x, u, d), none)
        row = self._row(state, observation, first)
        before = jnp.where(
            row.structure.unknown[n + nd : n + 2 * nd], d, row.z[n + nd : n + 2 * nd]
        )
        at = _Point(x, d, self.plant.transition(k, x, u, before), none)
        return self._row(state, observation, at)

    def _relinearised(
        self, state: UnknownInputState, observation: Observation
    ) -> tuple[_Row, Bool[Array, ""]]:
        """The row linearised about its own estimates (Gauss-Newton), and whether they moved on."""
        n, nd, _, _ = self._sizes
        k, u = state.k + 1, observation.u
        x, d = state.z[:n], state.z[n : n + nd]

        def again(carry):
            count, at, _, _ = carry
            row = self._row(state, observation, at)
            near, size = _about(at), n + 2 * nd
            z = jnp.where(row.structure.unknown[:size], near, row.z[:size])
            # only possible points: beyond the limits a plant may bend any way
            after = _Point(
                x,
                self.plant.saturated(k, u, z[n + nd :]),
                self.plant.confined(k, u, z[:n]),
                self.plant.saturated(k, u, z[n : n + nd]),
            )
            deviation = jnp.sqrt(jnp.maximum(jnp.diagonal(row.P)[:size], 0.0))
            moved = jnp.abs(_about(after) - near) > SETTLED * deviation + 1e-12
            return count + 1, after, row, jnp.any(moved)

        at = _Point(x, d, self.plant.transition(k, x, u, d), jnp.zeros(nd))
        first = again((0, at, None, None))
        _, _, row, moving = jax.lax.while_loop(
            lambda carry: carry[3] & (carry[0] < PASSES), again, first
        )
        return row, moving

    def _estimate(self, row: _Row, k, u, status) -> tuple[Estimate, Float[Array, "n nd"]]:
        """The record of a row, and the covariance of x and d.

        ``u`` is the input of row k - L, over which its attack acted.
        """
        n, nd, _, _ = self._sizes
        z, P, unknown = row.z, row.P, row.structure.unknown
        direct = self.direct if self.direct.ndim == 1 else self.direct[k - 1]
        newer = n + nd * self.delay
        pick = jnp.concatenate([jnp.diag(direct), jnp.diag(~direct)], 1).astype(float)
        hidden = jnp.where(direct, unknown[newer : newer + nd], unknown[newer + nd :])
        d = jnp.where(hidden, 0.0, dot(pick, z[newer:]))
        d_cov = _with_unknown(sandwich(pick, P[newer:, newer:]), hidden)
        # with a delay the state is meant to await later data
        lost = jnp.any(hidden) | (jnp.any(unknown[:n]) if self.delay == 0 else False)
        d_rows, d_bound = limits_of(self.plant).attack.at(k - self.delay, u)
        cross = dot(P[:n, newer:], pick.T)
        cross = jnp.where(unknown[:n, None] | hidden[None, :], 0.0, cross)
        estimate = Estimate(
            x=z[:n],
            x_cov=_with_unknown(P[:n, :n], unknown[:n]),
            d=d,
            d_cov=d_cov,
            d_free=d,
            d_free_cov=d_cov,
            d_rows=d_rows,
            d_bound=d_bound,
            residual=row.residual,
            residual_cov=row.residual_cov,
            status=status | jnp.where(lost, int(Status.UNOBSERVABLE), 0).astype(jnp.int32),
        )
        return estimate, cross


def find_structure(W, sense, free, keep: int) -> Structure:
    """What whitened measurements W y = W sense z + noise settle; z's first ``keep`` stay."""
    bound = dot(jnp.abs(W), dot(jnp.abs(sense), jnp.abs(free)))
    parts = split(dot(W, dot(sense, free)), bound)
    left = leftover(free, parts)
    return Structure(parts, echelon(left[:keep]), undetermined(left))


def _structure(
    state: UnknownInputState, whole: Bool[Array, ""], W, sense, free
) -> tuple[Structure, Bool[Array, ""], Structure | None]:
    """The structure of this row, whether it maps ``state.free`` onto itself, and the usual one."""
    keep, usual = state.free.shape[0], state.usual
    if usual is None:
        return find_structure(W, sense, free, keep), state.settled, None

    def anew():
        found = find_structure(W, sense, free, keep)
        same = whole & jnp.all(found.free == state.free)
        kept = jax.tree.map(lambda new, old: jnp.where(same, new, old), found, usual)
        return found, same, kept

    return jax.lax.cond(whole & state.settled, lambda: (usual, state.settled, usual), anew)


def build(plant: Plant, x0, P0, *, delay: int = 0) -> UnknownInput:
    """The estimator from the estimate ``x0``, ``P0`` before the first row.

    ``delay``: steps to wait for an attack; `holdfast analyse` says how many each one needs.
    Raises `InvalidValue` where it is negative.
    """
    if delay < 0:
        raise InvalidValue("delay", delay, "a number of steps, 0 or more")
    return restricted(plant, x0, P0, np.ones(len(plant.attacks), bool), delay)


def restricted(
    plant: Plant, x0, P0, active: np.ndarray, delay: int = 0, *, settle: bool = True
) -> UnknownInput:
    """The estimator that holds only the ``active`` channels for attacked."""
    x0, P0 = jnp.asarray(x0, float), jnp.asarray(P0, float)
    direct, hidden = (
        jnp.asarray(f(plant, np.asarray(x0), active)) for f in (direct_channels, hidden_input)
    )
    return UnknownInput(plant, x0, P0, direct, hidden, jnp.asarray(active), delay, settle)


def _move(A, G, delay: int) -> Float[Array, "w s"]:
    """(x, d, older d) -> (A x + G d, 0, d, older d): past attacks are kept beside the new one."""
    n, nd = G.shape
    past = nd * (delay + 1)
    return jnp.concatenate(
        [
            jnp.pad(jnp.concatenate([A, G], 1), ((0, nd), (0, past - nd))),
            jnp.pad(jnp.eye(past), ((0, 0), (n, 0))),
        ]
    )


def _new_attack(H, trusted, active) -> Float[Array, "nd nd"]:
    """The free directions of d_k: the active ones, less what is authenticated.

    A trusted output cannot have been attacked, so H d = 0 there, exactly.
    """
    rows = jnp.where(trusted[:, None] & active, H, 0.0)
    free = jnp.diag(active.astype(float))
    return jax.lax.cond(
        jnp.any(trusted),
        lambda: leftover(free, split(rows, jnp.abs(rows))),
        lambda: free,
    )


def _about(at: _Point) -> Float[Array, " m"]:
    """The linearisation point in the order of z: x_k, d_k, d_{k-1}."""
    return jnp.concatenate([at.x, at.d, at.d_before])


def _with_unknown(cov: Float[Array, "m m"], unknown: Bool[Array, " m"]) -> Float[Array, "m m"]:
    """The covariance with ``inf`` on the diagonal and 0 beside it where nothing is known."""
    either = unknown[:, None] | unknown[None, :]
    diagonal = jnp.eye(len(unknown), dtype=bool) & unknown[:, None]
    return jnp.where(diagonal, jnp.inf, jnp.where(either, 0.0, cov))


def _at_row(flags: Bool[Array, "*t"], k) -> Bool[Array, ""]:
    return flags if flags.ndim == 0 else flags[k - 1]
