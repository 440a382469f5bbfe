"""The Kalman filter: time-varying, any sensor missing at any step, no attack assumed."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from holdfast.numerics.blue import absorb_known
from holdfast.numerics.linalg import dot, sandwich
from holdfast.parts import Estimator, Plant, step_zero
from holdfast.plants.linear import LinearPlant
from holdfast.records import Estimate, Observation


class KalmanState(eqx.Module):
    """Step number, state estimate and its covariance."""

    k: Int[Array, ""]
    x: Float[Array, " n"]
    P: Float[Array, "n n"]


class Kalman(Estimator):
    """x_pred = A x + B u, P_pred = A P A' + Q;  x = x_pred + K (y - C x_pred - D u).

    Samples that did not arrive are left out of K; what arrived is absorbed row by row in
    Joseph's form (`holdfast.numerics.blue`).
    """

    plant: LinearPlant
    x0: Float[Array, " n"]
    P0: Float[Array, "n n"]

    def init(self) -> tuple[KalmanState, Estimate]:
        """The estimate one sample before the first row."""
        return first(self.plant, self.x0, self.P0)

    def step(self, state: KalmanState, observation: Observation) -> tuple[KalmanState, Estimate]:
        """One row of the recursion."""
        k, u = state.k + 1, observation.u
        m = self.plant.at(k, state.x, u)
        x = dot(m.A, state.x) + dot(m.B, u)
        P = sandwich(m.A, state.P) + m.Q
        m = self.plant.at(k, x, u)
        W, _ = self.plant.whiten(m.R, observation.seen)
        apart = observation.y - (dot(m.C, x) + dot(m.D, u))
        return correct(KalmanState(k, x, P), m.C, m.R, W, apart, observation)


def correct(
    predicted: KalmanState, C, R, W, apart: Float[Array, " ny"], observation: Observation
) -> tuple[KalmanState, Estimate]:
    """Correct a prediction by how far ``apart`` what was seen is from what was expected.

    W whitens R where a sample is to be used and is 0 elsewhere, C is h's (local) slope.
    """
    k, x, P = predicted.k, predicted.x, predicted.P
    seen = observation.seen
    innovation = jnp.where(seen, apart, 0.0)
    gain, P_new = absorb_known(P, dot(W, C))
    x = x + dot(gain, dot(W, innovation))
    both = seen[:, None] & seen[None, :]
    spread = jnp.where(both, sandwich(C, P) + R, 0.0)
    estimate = Estimate.without_attack(x, P_new, innovation, spread, observation.status)
    return KalmanState(k, x, P_new), estimate


def first(plant: Plant, x0, P0) -> tuple[KalmanState, Estimate]:
    """State and record one sample before the first row, for filters that assume no attack."""
    ny = len(plant.outputs)
    nothing = jnp.zeros(ny), jnp.zeros((ny, ny))
    estimate = Estimate.without_attack(x0, P0, *nothing, jnp.asarray(0, jnp.int32))
    return KalmanState(step_zero(), x0, P0), estimate


def build(plant: LinearPlant, x0, P0) -> Kalman:
    """The filter for a linear plant, from the estimate ``x0``, ``P0`` before the first row."""
    return Kalman(plant, jnp.asarray(x0, float), jnp.asarray(P0, float))
