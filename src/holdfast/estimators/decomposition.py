"""The steady-state Kalman filter as a sum of one local filter per sensor.

zeta_i = S zeta_i,before + b (y_i - D_i u) + (G_i - b C_i) B u,   x = sum_i F_i zeta_i.

It gives the numbers of the fixed-gain filter, and what a lying sensor does stays in its own
zeta_i: `holdfast.estimators.secure_fusion` builds on that.

Source: DECOMPOSE (7) to (12), Theorem 1; the basis is that of `holdfast.numerics.local`.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from holdfast.numerics.h_infinity import h_infinity_gain
from holdfast.numerics.linalg import dot, sandwich
from holdfast.numerics.local import Local, Unfit, decompose
from holdfast.numerics.steady_state import steady_state
from holdfast.parts import Estimator, InvalidValue
from holdfast.plants.linear import LinearPlant
from holdfast.records import Estimate, Observation


class Bank(eqx.Module):
    """One local filter per sensor, and what joins them.

    ``S`` (d x d), ``b`` (d,); ``F`` (n x m d) and ``G`` (m d x n) stacked by sensor, ``enter``
    (m d x nu) how the input comes in; ``K`` the gain of the whole.
    """

    S: Float[Array, "d d"]
    b: Float[Array, " d"]
    F: Float[Array, "n N"]
    G: Float[Array, "N n"]
    enter: Float[Array, "N nu"]
    K: Float[Array, "n m"]

    def init(self, x0: Float[Array, " n"]) -> Float[Array, " N"]:
        """zeta_i = G_i x0, so that the sum of F_i zeta_i is x0."""
        return dot(self.G, x0)

    def step(self, zeta: Float[Array, " N"], u, y: Float[Array, " m"]) -> Float[Array, " N"]:
        """Every local filter moved on by its own sample, D u taken off."""
        local = zeta.reshape(-1, len(self.b))
        moved = dot(local, self.S.T) + y[:, None] * self.b
        return moved.reshape(-1) + dot(self.enter, u)


class Expected(eqx.Module):
    """What the estimate before says of a row: state, outputs, and the error covariances."""

    x: Float[Array, " n"]
    y: Float[Array, " m"]
    P: Float[Array, "n n"]
    spread: Float[Array, "m m"]


class DecompositionState(eqx.Module):
    """The local estimates (m d,), their sum and its covariance, which gaps make larger."""

    zeta: Float[Array, " N"]
    x: Float[Array, " n"]
    P: Float[Array, "n n"]


class Decomposition(Estimator):
    """x = sum F_i zeta_i with a fixed gain; see the module.

    A sensor that misses a sample is given what the estimate predicts for it: the innovation is
    then zero, as in the fixed-gain filter. The covariance is that of this filter from ``P0``,
    gaps included.
    """

    plant: LinearPlant
    bank: Bank
    x0: Float[Array, " n"]
    P0: Float[Array, "n n"]

    def init(self) -> tuple[DecompositionState, Estimate]:
        """The estimate one sample before the first row."""
        ny = len(self.plant.outputs)
        estimate = Estimate.without_attack(
            self.x0, self.P0, jnp.zeros(ny), jnp.zeros((ny, ny)), jnp.asarray(0)
        )
        return DecompositionState(self.bank.init(self.x0), self.x0, self.P0), estimate

    def step(
        self, state: DecompositionState, observation: Observation
    ) -> tuple[DecompositionState, Estimate]:
        """One row of every local filter, and their sum."""
        expected = expect(self.plant, state.x, state.P, observation.u)
        zeta, innovation, spread, P = advance(
            self.plant, self.bank, state.zeta, expected, observation
        )
        x = dot(self.bank.F, zeta)
        estimate = Estimate.without_attack(x, P, innovation, spread, observation.status)
        return DecompositionState(zeta, x, P), estimate


def expect(plant: LinearPlant, x, P, u) -> Expected:
    """The row that follows ``x`` with covariance ``P``."""
    m = plant.at(1, x, u)
    x = dot(m.A, x) + dot(m.B, u)
    P = sandwich(m.A, P) + m.Q
    return Expected(x, dot(m.C, x) + dot(m.D, u), P, sandwich(m.C, P) + m.R)


def advance(
    plant: LinearPlant, bank: Bank, zeta, expected: Expected, observation: Observation
) -> tuple[Array, Array, Array, Array]:
    """The local estimates, the innovation with its covariance, and the fixed gain's new P."""
    seen, u = observation.seen, observation.u
    m = plant.at(1, expected.x, u)
    y = jnp.where(seen, observation.y, expected.y)
    zeta = bank.step(zeta, u, y - dot(m.D, u))
    gain = jnp.where(seen, bank.K, 0.0)
    left = jnp.eye(len(expected.x)) - dot(gain, m.C)
    P = sandwich(left, expected.P) + sandwich(gain, m.R)
    both = seen[:, None] & seen[None, :]
    return zeta, y - expected.y, jnp.where(both, expected.spread, 0.0), P


def fixed_gain(plant: LinearPlant, gain: Any, bound: float | None) -> np.ndarray:
    """The gain given, or that of the H-infinity filter for ``bound``, or the Kalman filter's."""
    A, C, Q, R = constant_matrices(plant)
    if gain is not None:
        if bound is not None:
            raise InvalidValue("bound", bound, "no bound beside a gain that is given")
        K = np.asarray(gain, float)
        if K.shape != C.T.shape:
            expected = f"{C.shape[1]} x {C.shape[0]}: x = x_pred + gain residual"
            raise InvalidValue("gain", " x ".join(map(str, K.shape)), expected)
        if not np.all(np.isfinite(K)):
            raise InvalidValue("gain", "NaN or infinity", "finite numbers")
        return K
    if bound is not None:
        K = h_infinity_gain(A, C, Q, R, bound) if bound > 0 else None
        if K is None:
            raise InvalidValue("bound", bound, "a larger one: no filter stays below it")
        return K
    steady = steady_state(A, C, Q, R)
    if steady.K is None:
        raise InvalidValue("kind", f"a plant where {steady.reason}", "a steady-state filter")
    return steady.K


def constant_matrices(plant: LinearPlant) -> list[np.ndarray]:
    """A, C, Q, R of a plant that must be constant, with an output at least."""
    if not plant.constant or plant.sampling is not None:
        raise InvalidValue("kind", "a plant that varies in time", "a constant one")
    if not plant.outputs:
        raise InvalidValue("kind", "a plant without outputs", "sensors")
    m = plant.at(1, jnp.zeros(len(plant.states)), jnp.zeros(len(plant.inputs)))
    return [np.asarray(one) for one in (m.A, m.C, m.Q, m.R)]


def local_bank(plant: LinearPlant, gain: Any, bound: float | None) -> tuple[Bank, Local]:
    """The bank of a plant, and the numbers behind it; `InvalidValue` where it has none."""
    A, C, Q, R = constant_matrices(plant)
    K = fixed_gain(plant, gain, bound)
    try:
        local = decompose(A, C, Q, R, K)
    except Unfit as error:
        raise InvalidValue("kind", f"a plant without a decomposition: {error}", "another") from None
    B = np.asarray(plant.B, float)
    enter = local.G @ B - np.kron(C @ B, local.b[:, None])
    arrays = (local.S, local.b, local.F, local.G, enter, K)
    return Bank(*map(jnp.asarray, arrays)), local


def start(plant: LinearPlant, x0, P0, P: np.ndarray) -> tuple[Array, Array]:
    """The estimate before the first row: zeros and the steady covariance unless given."""
    x0 = jnp.zeros(len(plant.states)) if x0 is None else jnp.asarray(x0, float)
    return x0, jnp.asarray(P if P0 is None else P0, float)


def build(
    plant: LinearPlant, x0=None, P0=None, *, gain: Any = None, bound: float | None = None
) -> Decomposition:
    """The bank for a constant plant, by default with the steady-state Kalman gain.

    ``gain`` (n x m): another one, x = x_pred + gain residual. ``bound``: the gain of the
    H-infinity filter that amplifies disturbances by less. Raises `InvalidValue` where there is
    no such gain or the plant has no decomposition, and says why.
    """
    bank, local = local_bank(plant, gain, bound)
    return Decomposition(plant, bank, *start(plant, x0, P0, local.P))
