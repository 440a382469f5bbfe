"""The unscented Kalman filter: a nonlinear plant carried by sigma points, no attack assumed."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from holdfast.estimators.kalman import KalmanState, first
from holdfast.numerics.blue import absorb_known, whitener
from holdfast.numerics.linalg import dot, psd_factor, sandwich, symmetric
from holdfast.parts import Estimator, Plant, no_attack
from holdfast.records import Estimate, Observation


class Unscented(Estimator):
    """Sigma points x +- c F e_i with F F' = P and c^2 = max(n, 3).

    Weights 1 - n/c^2 for the centre and 1/(2 c^2) for the others: none negative, third moments
    exact, fourth moments of a Gaussian matched where n <= 3. The correction regresses h on the
    sigma points: y = h_mean + S xi + e with x = x_pred + F xi; the spread of e that h's
    curvature leaves is added to R, and the row is absorbed as in `Kalman`, in Joseph's form.
    Outputs are compared by `Plant.innovation`: the mean of an angle is taken about that of the
    centre, which is right while the sigma points stay within half a turn of it.
    On a linear plant this is `Kalman`.

    Source: Julier and Uhlmann (2004), symmetric set.
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
        x, slope, rest = regress(
            lambda x: self.plant.transition(k, x, u, none), state.x, psd_factor(state.P)
        )
        P = symmetric(dot(slope, slope.T)) + rest + Q
        factor = psd_factor(P)
        _, R = self.plant.noise(k, x, u)
        mean, slope, rest = regress(
            lambda x: self.plant.output(k, x, u, none), x, factor, self.plant.innovation
        )
        spread = R + rest
        W, _ = whitener(spread, seen)
        innovation = jnp.where(seen, self.plant.innovation(observation.y, mean), 0.0)
        gain, cov = absorb_known(jnp.eye(x.shape[0]), dot(W, slope))
        x = x + dot(factor, dot(gain, dot(W, innovation)))
        P_new = sandwich(factor, cov)
        both = seen[:, None] & seen[None, :]
        innovation_cov = jnp.where(both, symmetric(dot(slope, slope.T)) + spread, 0.0)
        estimate = Estimate.without_attack(x, P_new, innovation, innovation_cov, observation.status)
        return KalmanState(k, x, P_new), estimate


def regress(function, x: Float[Array, " n"], factor: Float[Array, "n n"], apart=lambda a, b: a - b):
    """Mean of function(x + F xi), xi ~ (0, I), its slope on xi, and the spread about that line.

    slope_i = (f_i+ - f_i-) / (2 c); the spread is the sigma points' covariance less
    slope slope': that of the even parts alone, positive semidefinite. ``apart(a, b)`` is what
    takes values of the function from each other.
    """
    n = x.shape[0]
    c = math.sqrt(max(n, 3))
    steps = c * factor.T
    centre = function(x)
    plus = jax.vmap(lambda s: apart(function(x + s), centre))(steps)
    minus = jax.vmap(lambda s: apart(function(x - s), centre))(steps)
    weight = 1.0 / (2.0 * c * c)
    slope = (plus - minus).T / (2.0 * c)
    # second differences: twice the even part of the function at each pair of sigma points
    bend = plus + minus
    shift = weight * jnp.sum(bend, 0)
    even = 0.5 * bend
    rest = 2.0 * weight * dot(even.T, even) - shift[:, None] * shift
    return centre + shift, slope, symmetric(rest)


def build(plant: Plant, x0, P0) -> Unscented:
    """The filter from the estimate ``x0``, ``P0`` before the first row."""
    return Unscented(plant, jnp.asarray(x0, float), jnp.asarray(P0, float))
