"""The Kalman filter with Huber's loss: a sample that is far off pulls, but no harder for it."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from holdfast.estimators.kalman import KalmanState, correct, first
from holdfast.numerics.blue import whitener
from holdfast.numerics.innovations import correction
from holdfast.numerics.lasso import cold, lasso
from holdfast.numerics.linalg import dot, sandwich
from holdfast.parts import Estimator, InvalidValue
from holdfast.plants.linear import LinearPlant
from holdfast.records import Estimate, Observation, Status

NORMAL = 1.345
"""Standard deviations from which a sample counts as far off: 95 % of the efficiency of least
squares where all samples are sound (Huber 1981)."""
CONVERGED = 1e-9
"""Residual of the optimality conditions up to which a row's answer is taken for exact."""


class Huber(Estimator):
    """x minimises (x - x_pred)' P^-1 (x - x_pred) / 2 + sum_i rho((y_i - C_i x) / sd_i).

    rho(e) = e^2 / 2 up to the ``threshold``, straight beyond. The same, for uncorrelated noise:
    least squares with an outlier o_i of every sample at a price,

        minimise over o   (nu - o)' S^-1 (nu - o) / 2 + threshold sum_i |o_i| / sd_i,

    a LASSO, solved exactly (`holdfast.numerics.lasso`); x = x_pred + K (nu - o), and the
    outliers are `Estimate.a`. The covariance is that of the samples weighed as Huber's loss
    weighs them, sd_i^2 divided by 1 - o_i / (y_i - C_i x). What is authenticated has no outlier.

    Source: Huber, Robust Statistics (1981), 7.3 and 7.8; Boncelet and Dickinson, CDC 1983.
    """

    plant: LinearPlant
    x0: Float[Array, " n"]
    P0: Float[Array, "n n"]
    threshold: Float[Array, ""]

    def init(self) -> tuple[KalmanState, Estimate]:
        """The estimate one sample before the first row."""
        state, estimate = first(self.plant, self.x0, self.P0)
        return state, replace(estimate, a=jnp.zeros(estimate.residual.shape))

    def step(self, state: KalmanState, observation: Observation) -> tuple[KalmanState, Estimate]:
        """One row of the recursion."""
        k, u, seen = state.k + 1, observation.u, observation.seen
        m = self.plant.at(k, state.x, u)
        x = dot(m.A, state.x) + dot(m.B, u)
        P = sandwich(m.A, state.P) + m.Q
        m = self.plant.at(k, x, u)
        nu = jnp.where(seen, observation.y - (dot(m.C, x) + dot(m.D, u)), 0.0)
        found = correction(P, m.C, m.R, self.plant.whiten, seen)
        sd = jnp.where(seen & ~observation.trusted, jnp.sqrt(jnp.diagonal(m.R)), 0.0)
        # a row of zeros has no outlier: what did not arrive, and what is authenticated
        Z = (found.white * sd).T
        price = jnp.full(sd.shape, self.threshold)
        solved, _ = lasso(Z, price, dot(found.white, nu), cold(Z))
        outlier = sd * solved.f
        at = x + dot(found.moves, dot(found.white, nu - outlier))
        left = jnp.where(seen, observation.y - (dot(m.C, at) + dot(m.D, u)), 0.0)
        off = outlier != 0
        weight = jnp.where(off, 1.0 - outlier / jnp.where(off, left, 1.0), 1.0)
        root = jnp.sqrt(jnp.clip(weight, 1e-12, 1.0))
        W, _ = whitener(m.R / (root[:, None] * root[None, :]), seen)
        after, estimate = correct(KalmanState(k, x, P), m.C, m.R, W, nu, observation)
        solved_all = solved.residual <= CONVERGED
        status = estimate.status | jnp.where(solved_all, 0, int(Status.NOT_CONVERGED))
        return KalmanState(k, at, after.P), replace(estimate, x=at, a=outlier, status=status)


def build(plant: LinearPlant, x0, P0, *, threshold: float = NORMAL) -> Huber:
    """The filter for a linear plant, from the estimate ``x0``, ``P0`` before the first row.

    ``threshold``: standard deviations of its noise from which a sample counts as far off; the
    smaller it is, the less a lie moves the estimate, and the more is lost without one.

    Raises `InvalidValue` for a threshold that is not above 0.
    """
    if not 0 < threshold < float("inf"):
        raise InvalidValue("threshold", threshold, "a number above 0, in standard deviations")
    start = jnp.asarray(x0, float), jnp.asarray(P0, float)
    return Huber(plant, *start, jnp.asarray(float(threshold)))
