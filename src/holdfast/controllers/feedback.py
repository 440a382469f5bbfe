"""Linear state feedback from the estimate."""

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from holdfast.numerics.linalg import dot
from holdfast.parts import Controller, InvalidValue, Plant
from holdfast.plants.linear import LinearPlant
from holdfast.records import Estimate

MARGIN = 1e-7
"""How near to the unit circle a mode counts as unstable, and (relative to the plant) how
little of an input counts as none."""


class Feedback(Controller):
    """u = -K (x_hat - reference)."""

    gain: Float[Array, "nu n"]
    reference: Float[Array, " n"]

    def command(self, estimate: Estimate) -> Float[Array, " nu"]:
        """The input to apply over the next sample."""
        return -dot(self.gain, jnp.asarray(estimate.x) - self.reference)


def build(
    plant: Plant,
    *,
    state_weight: list[list[float]],
    input_weight: list[list[float]],
    reference: list[float] | None = None,
) -> Feedback:
    """The feedback that minimises the sum of x' Qx x + u' Ru u (discrete LQR).

    K = (Ru + B' S B)^-1 B' S A with S the stabilising solution of the discrete Riccati
    equation. ``state_weight`` (n x n, positive semidefinite), ``input_weight`` (nu x nu,
    positive definite), ``reference`` the state to hold (n; default the origin), which has to
    be an equilibrium of the plant without input for the error to vanish.

    Raises `InvalidValue` for a plant that is not linear and constant, that (A, B) cannot
    stabilise, or whose unstable modes ``state_weight`` does not see; for a weight of wrong
    shape or sign.
    """
    if not (isinstance(plant, LinearPlant) and plant.constant):
        raise InvalidValue("plant", "matrices that change", "a linear plant, A and B constant")
    A, B = np.asarray(plant.A), np.asarray(plant.B)
    n, nu = B.shape
    if nu == 0:
        raise InvalidValue("plant.B", "no inputs", "at least one input to steer with")
    states = _weight("state_weight", state_weight, n)
    inputs = _weight("input_weight", input_weight, nu)
    if np.linalg.eigvalsh(inputs)[0] <= 0:
        raise InvalidValue("input_weight", input_weight, "a positive definite matrix")
    found = np.zeros(n) if reference is None else np.asarray(reference, float)
    if found.shape != (n,) or not np.all(np.isfinite(found)):
        raise InvalidValue("reference", reference, f"{n} finite numbers, one per state")
    stuck = _unreached(A, B)
    if stuck is not None:
        raise InvalidValue(
            "plant.B", f"no input that reaches the mode {stuck:.4g}", "a stabilisable pair (A, B)"
        )
    blind = _unreached(A.T, states)
    if blind is not None:
        raise InvalidValue(
            "state_weight", f"no weight on the mode {blind:.4g}", "weight on every unstable mode"
        )
    S = scipy.linalg.solve_discrete_are(A, B, states, inputs)
    K = np.linalg.solve(inputs + B.T @ S @ B, B.T @ S @ A)
    return Feedback(jnp.asarray(K), jnp.asarray(found))


def _weight(key: str, value: list[list[float]], size: int) -> np.ndarray:
    weight = np.asarray(value, float)
    if weight.shape != (size, size) or not np.all(np.isfinite(weight)):
        raise InvalidValue(key, f"shape {weight.shape}", f"a finite {size} x {size} matrix")
    if not np.allclose(weight, weight.T, rtol=1e-8, atol=0.0):
        raise InvalidValue(key, "a matrix that is not symmetric", "a symmetric matrix")
    if np.linalg.eigvalsh(weight)[0] < -1e-8 * np.max(np.abs(weight)):
        raise InvalidValue(key, "a negative eigenvalue", "a positive semidefinite matrix")
    return weight


def _unreached(A: np.ndarray, B: np.ndarray) -> complex | None:
    """An eigenvalue on or outside the unit circle that (A, B) cannot move (Popov-Hautus)."""
    size = max(np.linalg.norm(A), np.linalg.norm(B), 1.0)
    for mode in np.linalg.eigvals(A):
        if abs(mode) < 1.0 - MARGIN:
            continue
        pencil = np.hstack([A - mode * np.eye(len(A)), B])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < MARGIN * size:
            return mode
    return None
