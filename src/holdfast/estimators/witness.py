"""A Kalman filter fed by authenticated samples alone, and how it joins a fusion.

Whatever a sensor has said before, a sample that is authenticated now is true. The filter keeps
what the sensors that may be authenticated can tell of the state, s = U' x, from those samples
only; its error e and the errors of the local estimates come from the same noise, so that their
covariance X is carried along and the fusion weighs both right:

    joint covariance [[W, X], [X', P]],   [zeta; s] = [G; U'] x - errors - [f; 0]
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from holdfast.numerics.blue import absorb_known
from holdfast.numerics.linalg import dot, sandwich, symmetric
from holdfast.numerics.local import Local
from holdfast.numerics.subspaces import scaled, silent
from holdfast.plants.linear import LinearPlant
from holdfast.records import Observation

VAGUE = 1e8
"""Variance, relative to that of the whole fusion, from which the filter starts again about the
secure estimate: a mode that nobody vouches for must not grow out of the range of numbers, and a
weight of 1e-8 decides nothing."""
JITTER = 1e-8
"""What is added to the variances of the filter where they are joined, relative to them: where
every sample is authenticated the filter says what the local estimates say, but for rounding."""


class WitnessState(eqx.Module):
    """s = U' x, its error covariance, and its covariance with the local errors."""

    s: Float[Array, " q"]
    P: Float[Array, "q q"]
    X: Float[Array, "N q"]


class Witness(eqx.Module):
    """The filter of s = U' x: s = A_s s + U' B u, y_i = C_s s for ``members``.

    ``enter`` (N x n) and ``b`` bring process and measurement noise into the local errors.
    """

    plant: LinearPlant
    U: Float[Array, "n q"]
    A_s: Float[Array, "q q"]
    C_s: Float[Array, "m q"]
    members: Bool[Array, " m"]
    S: Float[Array, "d d"]
    b: Float[Array, " d"]
    enter: Float[Array, "N n"]
    G: Float[Array, "N n"]
    W: Float[Array, "N N"]
    vague: Float[Array, "q q"]

    def init(self, x0: Float[Array, " n"], P0: Float[Array, "n n"]) -> WitnessState:
        """What is known before the first row."""
        cross = jnp.zeros((self.W.shape[0], self.U.shape[1]))
        return WitnessState(dot(self.U.T, x0), sandwich(self.U.T, P0), cross)

    def step(
        self, state: WitnessState, x: Float[Array, " n"], observation: Observation
    ) -> WitnessState:
        """One row; ``x`` is the secure estimate before it, for a filter that knows nothing more."""
        lost = jnp.any(jnp.diagonal(state.P) > jnp.diagonal(self.vague))
        s = jnp.where(lost, dot(self.U.T, x), state.s)
        P = jnp.where(lost, self.vague, state.P)
        X = jnp.where(lost, 0.0, state.X)
        u = observation.u
        m = self.plant.at(1, x, u)
        s = dot(self.A_s, s) + dot(dot(self.U.T, m.B), u)
        P = sandwich(self.A_s, P) + sandwich(self.U.T, m.Q)
        X = dot(self._moved(X), self.A_s.T) + dot(self.enter, dot(m.Q, self.U))
        used = observation.trusted & observation.seen & self.members
        whitener, _ = self.plant.whiten(m.R, used)
        gain, P = absorb_known(P, dot(whitener, self.C_s))
        gain = dot(gain, whitener)
        innovation = jnp.where(used, observation.y - dot(m.D, u) - dot(self.C_s, s), 0.0)
        left = jnp.eye(len(s)) - dot(gain, self.C_s)
        shared = jnp.einsum("d,iq->idq", self.b, dot(m.R, gain.T)).reshape(X.shape)
        return WitnessState(s + dot(gain, innovation), P, dot(X, left.T) + shared)

    def joined(self, state: WitnessState) -> tuple[Array, Array, Array]:
        """F, Z and P of the fusion of local estimates and s (`holdfast.numerics.local`)."""
        sizes = jnp.diagonal(state.P) + jnp.diagonal(self.vague) / VAGUE
        P = state.P + JITTER * jnp.diag(sizes)
        W = jnp.block([[self.W, state.X], [state.X.T, P]])
        root = jnp.sqrt(jnp.diagonal(W))
        lower = jnp.linalg.cholesky(symmetric(W / root[:, None] / root[None]))
        G = jnp.concatenate([self.G, self.U.T]) / root[:, None]
        white = jax.scipy.linalg.solve_triangular(lower, G, lower=True)
        q, r = jnp.linalg.qr(white, mode="complete")
        n = G.shape[1]
        back = jax.scipy.linalg.solve_triangular(lower.T, q, lower=False) / root[:, None]
        upper = r[:n]
        F = jax.scipy.linalg.solve_triangular(upper, back[:, :n].T, lower=False)
        half = jax.scipy.linalg.solve_triangular(upper, jnp.eye(n), lower=False)
        return F, back[:, n:], dot(half, half.T)

    def _moved(self, X: Float[Array, "N q"]) -> Float[Array, "N q"]:
        """(I x S) X."""
        local = X.reshape(-1, len(self.b), X.shape[1])
        return jnp.einsum("de,ieq->idq", self.S, local).reshape(X.shape)


def witness(plant: LinearPlant, local: Local, members: Any) -> Witness:
    """The filter over what the outputs ``members`` (their numbers) tell of the state."""
    A, C = np.asarray(plant.A), np.asarray(plant.C)
    chosen = np.isin(np.arange(len(C)), list(members))
    units = scaled(A, np.zeros((len(A), 0)), C[chosen], np.zeros((int(chosen.sum()), 0)))
    U = silent(units)[-1] / units.x[:, None]
    U = np.linalg.qr(U)[0]
    A_s, C_s = U.T @ A @ U, np.where(chosen[:, None], C @ U, 0.0)
    enter = local.G - np.kron(C, local.b[:, None])
    vague = VAGUE * U.T @ local.P @ U
    arrays = (U, A_s, C_s, chosen, local.S, local.b, enter, local.G, local.W, vague)
    return Witness(plant, *map(jnp.asarray, arrays))
