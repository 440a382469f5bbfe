"""The extended Kalman filter: a nonlinear plant linearised at every step, no attack assumed."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from holdfast.estimators.kalman import KalmanState, correct, first
from holdfast.numerics.blue import whitener
from holdfast.numerics.linalg import sandwich
from holdfast.parts import Estimator, Plant, no_attack
from holdfast.records import Estimate, Observation


class Extended(Estimator):
    """Predict with f, correct with the Jacobians A of f at x_{k-1} and C of h at x_pred.

    P_pred = A P A' + Q,  x = x_pred + K (y - h(x_pred)); the Jacobians are exact
    (`jax.jacfwd`). On a linear plant this is `Kalman`.
    """

    plant: Plant
    x0: Float[Array, " n"]
    P0: Float[Array, "n n"]

    def init(self) -> tuple[KalmanState, Estimate]:
        """The estimate one sample before the first row."""
        return first(self.plant, self.x0, self.P0)

    def step(self, state: KalmanState, observation: Observation) -> tuple[KalmanState, Estimate]:
        """One row of the recursion."""
        k, u, seen = state.k + 1, observation.u, observation.seen
        none = no_attack(self.plant)
        Q, _ = self.plant.noise(k, state.x, u)
        A = jax.jacfwd(lambda x: self.plant.transition(k, x, u, none))(state.x)
        x = self.plant.transition(k, state.x, u, none)
        P = sandwich(A, state.P) + Q
        _, R = self.plant.noise(k, x, u)
        C = jax.jacfwd(lambda x: self.plant.output(k, x, u, none))(x)
        W, _ = whitener(R, seen)
        expected = self.plant.output(k, x, u, none)
        return correct(KalmanState(k, x, P), C, R, W, expected, observation)


def build(plant: Plant, x0, P0) -> Extended:
    """The filter from the estimate ``x0``, ``P0`` before the first row."""
    return Extended(plant, jnp.asarray(x0, float), jnp.asarray(P0, float))
