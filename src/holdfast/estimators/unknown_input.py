"""Minimum-variance unbiased joint estimate of state and attack, the attack wholly free.

Attacks may enter the dynamics (G), the outputs (H) or both, H of any rank, and any sample may
be missing. The vector (x_k, d_k, d_{k-1}) is carried with what the data leave undetermined
(`holdfast.numerics.blue`): nothing about d is assumed, so d_k starts free at every step.
Where C G V2 has full column rank this is the ULISE of Yong, Zhu and Frazzoli; with H = 0 it is
CARE's Algorithm 1, lines 1 to 13 (line 9 corrected by + Q).

Source: CARE (5)-(8), (15), Algorithm 1; NISE (8), Algorithm 1, with the errata of both.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.blue import Split, absorb, echelon, leftover, split, undetermined
from holdfast.numerics.linalg import RANK_TOLERANCE, dot, sandwich
from holdfast.parts import Estimator, step_zero
from holdfast.plants.linear import LinearPlant, Matrices, Table
from holdfast.records import Estimate, Observation, Status


class UnknownInputState(eqx.Module):
    """(x_k, d_k) with covariance and the basis ``free`` of what is undetermined about them.

    ``plain``: every sample of this row arrived, none authenticated, and they determined x, so
    that ``free`` is what H does not see. ``usual``: the structure of a plain row after a plain
    row, once one was met (``known``); a constant plant need not find it again.
    """

    k: Int[Array, ""]
    x: Float[Array, " n"]
    d: Float[Array, " nd"]
    P: Float[Array, "s s"]
    free: Float[Array, "s s"]
    plain: Bool[Array, ""]
    known: Bool[Array, ""]
    usual: "Structure | None"


class Structure(NamedTuple):
    """What a step determines and leaves free, whatever the numbers measured.

    ``free`` is about (x_k, d_k), ``unknown`` about (x_k, d_k, d_{k-1}).
    """

    parts: Split
    free: Float[Array, "m m"]
    unknown: Bool[Array, " l"]


class UnknownInput(Estimator):
    """x_k and d from y up to k, best linear unbiased with every attack free; see the module.

    ``direct`` marks the channels whose axis lies in the row space of H: they are given at k,
    the others at k-1 (per step where H is). ``hidden``: some attack that moves the state
    reaches no output of its own row.
    """

    plant: LinearPlant
    x0: Float[Array, " n"]
    P0: Float[Array, "n n"]
    direct: Bool[Array, "*t nd"]
    hidden: Bool[Array, "*t"]

    def init(self) -> tuple[UnknownInputState, Estimate]:
        """The estimate one sample before the first row; the attack there is free."""
        n, nd, ny = (len(names) for names in _names(self.plant))
        P = jnp.zeros((n + nd, n + nd)).at[:n, :n].set(self.P0)
        free = jnp.diag(jnp.concatenate([jnp.zeros(n), jnp.ones(nd)]))
        no = jnp.asarray(False)
        usual = None
        if self.plant.constant:
            size, rows = n + 2 * nd, jnp.zeros((ny, n + 2 * nd))
            parts = Split(jnp.eye(ny), rows, rows)
            usual = Structure(parts, jnp.zeros_like(free), jnp.zeros(size, bool))
        state = UnknownInputState(step_zero(), self.x0, jnp.zeros(nd), P, free, no, no, usual)
        unknown = jnp.concatenate([jnp.zeros(n, bool), jnp.ones(2 * nd, bool)])
        estimate = self._estimate(
            jnp.concatenate([self.x0, jnp.zeros(2 * nd)]),
            jnp.zeros((n + 2 * nd, n + 2 * nd)).at[:n, :n].set(self.P0),
            unknown,
            jnp.ones(nd, bool),
            jnp.zeros(len(self.plant.inputs)),
            jnp.zeros(ny),
            jnp.zeros((ny, ny)),
            jnp.asarray(int(Status.OK), jnp.int32),
        )
        return state, estimate

    def step(
        self, state: UnknownInputState, observation: Observation
    ) -> tuple[UnknownInputState, Estimate]:
        """One row: predict (x, d_now, d_before), determine what can be, correct the rest."""
        k, u, seen = state.k + 1, observation.u, observation.seen
        n, nd, ny = (len(names) for names in _names(self.plant))
        m = self.plant.at(k, state.x, u)
        x = dot(m.A, state.x) + dot(m.G, state.d) + dot(m.B, u)
        move = _move(m)
        P = sandwich(move, state.P) + jnp.pad(m.Q, (0, 2 * nd))
        m = self.plant.at(k, x, u)
        trusted = observation.trusted
        H = jnp.where(trusted[:, None], 0.0, m.H)
        free = jnp.concatenate([dot(move, state.free), _new_attack(m.H, trusted, n)], 1)
        sense = jnp.concatenate([m.C, H, jnp.zeros((ny, nd))], 1)
        W, W_inverse = self.plant.whiten(m.R, seen)
        whole = jnp.all(seen) & ~jnp.any(trusted)
        structure, known, usual = _structure(state, whole, W, sense, free)
        M = dot(W, sense)
        update = absorb(P, M, free, structure.parts)
        innovation = jnp.where(seen, observation.y - dot(m.C, x) - dot(m.D, u), 0.0)
        z = jnp.concatenate([x, jnp.zeros(nd), state.d])
        z = z + dot(update.gain, dot(W, innovation))
        blind = dot(dot(W_inverse, update.blind), W)
        spread = sandwich(M, P) + jnp.eye(ny)
        estimate = self._estimate(
            z,
            update.cov,
            structure.unknown,
            self.direct if self.direct.ndim == 1 else self.direct[k - 1],
            u,
            dot(blind, innovation),
            sandwich(dot(W_inverse, update.blind), spread),
            observation.status
            | jnp.where(_row(self.hidden, k), int(Status.HIDDEN_INPUT), 0).astype(jnp.int32),
        )
        keep = n + nd
        plain = whole & ~jnp.any(structure.unknown[:n])
        P = update.cov[:keep, :keep]
        return UnknownInputState(
            k, z[:n], z[n:keep], P, structure.free, plain, known, usual
        ), estimate

    def _estimate(self, z, P, unknown, direct, u, residual, residual_cov, status) -> Estimate:
        n, nd, _ = (len(names) for names in _names(self.plant))
        rows = jnp.concatenate([jnp.diag(direct), jnp.diag(~direct)], 1).astype(float)
        hidden = jnp.where(direct, unknown[n : n + nd], unknown[n + nd :])
        d = jnp.where(hidden, 0.0, dot(rows, z[n:]))
        d_cov = _with_unknown(sandwich(rows, P[n:, n:]), hidden)
        lost = jnp.any(unknown[:n]) | jnp.any(hidden)
        limits = self.plant.constraints
        return Estimate(
            x=z[:n],
            x_cov=_with_unknown(P[:n, :n], unknown[:n]),
            d=d,
            d_cov=d_cov,
            d_free=d,
            d_free_cov=d_cov,
            d_rows=limits.attack,
            d_bound=limits.attack_bound + dot(limits.attack_bound_u, u),
            residual=residual,
            residual_cov=residual_cov,
            status=status | jnp.where(lost, int(Status.UNOBSERVABLE), 0).astype(jnp.int32),
        )


def find_structure(W, sense, free, keep: int) -> Structure:
    """What whitened measurements W y = W sense z + noise settle; z's first ``keep`` stay."""
    bound = dot(jnp.abs(W), dot(jnp.abs(sense), jnp.abs(free)))
    parts = split(dot(W, dot(sense, free)), bound)
    left = leftover(free, parts)
    return Structure(parts, echelon(left[:keep]), undetermined(left))


def _structure(
    state: UnknownInputState, whole: Bool[Array, ""], W, sense, free
) -> tuple[Structure, Bool[Array, ""], Structure | None]:
    """The structure of this row, and the usual one with whether it is known by now."""
    keep = state.free.shape[0]
    usual = state.usual
    if usual is None:
        return find_structure(W, sense, free, keep), state.known, None
    again = state.plain & whole

    def anew():
        found = find_structure(W, sense, free, keep)
        kept = jax.tree.map(lambda new, old: jnp.where(again, new, old), found, usual)
        return found, state.known | again, kept

    return jax.lax.cond(again & state.known, lambda: (usual, state.known, usual), anew)


def build(plant: LinearPlant, x0, P0) -> UnknownInput:
    """The estimator for a linear plant, from the estimate ``x0``, ``P0`` before the first row."""
    x0, P0 = jnp.asarray(x0, float), jnp.asarray(P0, float)
    direct, hidden = _over_time(plant, _direct), _over_time(plant, _hidden)
    return UnknownInput(plant, x0, P0, jnp.asarray(direct), jnp.asarray(hidden))


def _names(plant: LinearPlant) -> tuple[tuple[str, ...], ...]:
    return plant.states, plant.attacks, plant.outputs


def _move(m: Matrices) -> Float[Array, "w s"]:
    """(x, d) -> (A x + G d, 0, d): the attack at k-1 is kept beside the one at k."""
    n, nd = m.G.shape
    return jnp.concatenate(
        [
            jnp.concatenate([m.A, m.G], 1),
            jnp.zeros((nd, n + nd)),
            jnp.concatenate([jnp.zeros((nd, n)), jnp.eye(nd)], 1),
        ]
    )


def _new_attack(H, trusted, n: int) -> Float[Array, "w nd"]:
    """The free directions of d_k among (x_k, d_k, d_{k-1}): all, less what is authenticated.

    A trusted output cannot have been attacked, so H d = 0 there, exactly.
    """
    nd = H.shape[1]
    rows = jnp.where(trusted[:, None], H, 0.0)
    free = jax.lax.cond(
        jnp.any(trusted),
        lambda: leftover(jnp.eye(nd), split(rows, jnp.abs(rows))),
        lambda: jnp.eye(nd),
    )
    return jnp.concatenate([jnp.zeros((n, nd)), free, jnp.zeros((nd, nd))])


def _with_unknown(cov: Float[Array, "m m"], unknown: Bool[Array, " m"]) -> Float[Array, "m m"]:
    """The covariance with ``inf`` on the diagonal and 0 beside it where nothing is known."""
    either = unknown[:, None] | unknown[None, :]
    diagonal = jnp.eye(len(unknown), dtype=bool) & unknown[:, None]
    return jnp.where(diagonal, jnp.inf, jnp.where(either, 0.0, cov))


def _row(flags: Bool[Array, "*t"], k) -> Bool[Array, ""]:
    return flags if flags.ndim == 0 else flags[k - 1]


def _over_time(plant: LinearPlant, of: Callable[[Matrices], np.ndarray]) -> np.ndarray:
    """A structural property of the matrices: per step where they are, on every grid point and
    so between them where they are scheduled, else once.
    """
    sources = {name: getattr(plant, name) for name in Matrices._fields}
    lengths = [len(v) for v in sources.values() if not isinstance(v, Table) and v.ndim == 3]

    def entry(source, i) -> Any:
        if isinstance(source, Table):
            return np.asarray(source.values)[i % len(source.values)]
        return np.asarray(source if source.ndim == 2 else source[i])

    if lengths:
        each = range(min(lengths))
    else:
        grids = [len(v.values) for v in sources.values() if isinstance(v, Table)]
        each = range(max(grids, default=1))
    found = np.stack([of(Matrices(*(entry(v, i) for v in sources.values()))) for i in each])
    return found if lengths else np.asarray(np.all(found, 0))


def _rank(rows: np.ndarray) -> int:
    """Rank after scaling rows and columns to unit size: units of a channel do not matter."""
    for axis in (1, 0):
        norms = np.linalg.norm(rows, axis=axis, keepdims=True)
        rows = np.divide(rows, norms, out=np.zeros_like(rows), where=norms > 0)
    return int(np.linalg.matrix_rank(rows, tol=RANK_TOLERANCE)) if rows.size else 0


def _direct(m: Matrices) -> np.ndarray:
    """Which channels' axes lie in the row space of H."""
    H = np.asarray(m.H)
    axes = np.eye(H.shape[1])
    return np.array([_rank(np.vstack([H, axis])) == _rank(H) for axis in axes], bool)


def _hidden(m: Matrices) -> np.ndarray:
    """Whether an attack moves the state and reaches no output of its own row or the next."""
    felt = np.vstack([m.H, m.C @ m.G])
    return np.array(_rank(np.vstack([felt, m.G])) > _rank(felt))
