"""The extended Kalman filter: a nonlinear plant linearised at every step, no attack assumed."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from scipy.special import ndtri

from holdfast.estimators.kalman import KalmanState, correct, first
from holdfast.numerics.blue import whitener
from holdfast.numerics.linalg import sandwich
from holdfast.parts import Estimator, InvalidValue, Plant, no_attack
from holdfast.records import Estimate, Observation


class Extended(Estimator):
    """Predict with f, correct with the Jacobians A of f at x_{k-1} and C of h at x_pred.

    P_pred = A P A' + Q,  x = x_pred + K (y - h(x_pred)); the Jacobians are exact
    (`jax.jacfwd`). On a linear plant this is `Kalman`. ``limit``: standard deviations of its
    innovation beyond which a sample is left out of K; None for no such gate.
    """

    plant: Plant
    x0: Float[Array, " n"]
    P0: Float[Array, "n n"]
    limit: Float[Array, ""] | None = None

    def init(self) -> tuple[KalmanState, Estimate]:
        """The estimate one sample before the first row."""
        state, estimate = first(self.plant, self.x0, self.P0)
        return state, self._telling(estimate, jnp.zeros(estimate.residual.shape, bool))

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
        apart = self.plant.innovation(observation.y, self.plant.output(k, x, u, none))
        doubted = jnp.zeros(seen.shape, bool)
        if self.limit is not None:
            sd = jnp.sqrt(jnp.diagonal(sandwich(C, P) + R))
            doubted = seen & ~observation.trusted & (jnp.abs(apart) > self.limit * sd)
        W, _ = whitener(R, seen & ~doubted)
        after, estimate = correct(KalmanState(k, x, P), C, R, W, apart, observation)
        return after, self._telling(estimate, doubted)

    def _telling(self, estimate: Estimate, doubted) -> Estimate:
        """The record with what the samples that the gate left out are off by."""
        if self.limit is None:
            return estimate
        off = jnp.where(doubted, estimate.residual, 0.0)
        return eqx.tree_at(lambda e: e.a, estimate, off, is_leaf=lambda leaf: leaf is None)


def build(plant: Plant, x0, P0, *, gate: float | None = None) -> Extended:
    """The filter from the estimate ``x0``, ``P0`` before the first row.

    ``gate``: the probability that a sound sample is left out. A sample whose innovation is
    further from 0 than a Gaussian of its standard deviation is with that probability corrects
    nothing; the innovation is reported all the same, and ``Estimate.a`` says of each sample
    left out by how much it is off. An authenticated sample is never left out.

    Raises `InvalidValue` for a ``gate`` that is no probability.
    """
    if gate is not None and not 0 < gate < 1:
        raise InvalidValue("gate", gate, "a probability between 0 and 1")
    limit = None if gate is None else jnp.asarray(float(-ndtri(gate / 2)))
    return Extended(plant, jnp.asarray(x0, float), jnp.asarray(P0, float), limit)
