"""The Kalman filter: time-varying, any sensor missing at any step, no attack assumed."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from holdfast.numerics.blue import absorb_known
from holdfast.numerics.linalg import dot, sandwich
from holdfast.parts import Estimator, step_zero
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
        ny = len(self.plant.outputs)
        state = KalmanState(step_zero(), self.x0, self.P0)
        return state, Estimate.without_attack(
            self.x0, self.P0, jnp.zeros(ny), jnp.zeros((ny, ny)), 0
        )

    def step(
        self, state: KalmanState, observation: Observation
    ) -> tuple[KalmanState, Estimate]:
        """One row of the recursion."""
        k, u = state.k + 1, observation.u
        m = self.plant.at(k, state.x, u)
        x = dot(m.A, state.x) + dot(m.B, u)
        P = sandwich(m.A, state.P) + m.Q
        m = self.plant.at(k, x, u)
        W, _ = self.plant.whiten(m.R, observation.seen)
        innovation = jnp.where(observation.seen, observation.y - dot(m.C, x) - dot(m.D, u), 0.0)
        gain, P_new = absorb_known(P, dot(W, m.C))
        x = x + dot(gain, dot(W, innovation))
        both = observation.seen[:, None] & observation.seen[None, :]
        innovation_cov = jnp.where(both, sandwich(m.C, P) + m.R, 0.0)
        estimate = Estimate.without_attack(
            x, P_new, innovation, innovation_cov, observation.status
        )
        return KalmanState(k, x, P_new), estimate
