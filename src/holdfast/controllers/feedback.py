"""Linear state feedback from the estimate."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from holdfast.numerics.linalg import dot
from holdfast.parts import Controller, InvalidValue, Plant, no_attack, step_zero
from holdfast.plants.constraints import Constraints, Polytope
from holdfast.plants.linear import LinearPlant
from holdfast.records import Estimate

MARGIN = 1e-7
"""How near to the unit circle a mode counts as unstable, and (relative to the plant) how
little of an input counts as none."""


class Weights(NamedTuple):
    """Qx and Ru of the cost x' Qx x + u' Ru u of a sample."""

    state: Float[Array, "n n"]
    input: Float[Array, "nu nu"]


class Feedback(Controller):
    """u = steady - K (x_hat - reference); ``weights``: of the cost that K minimises, None where it
    does not come from one.
    """

    gain: Float[Array, "nu n"]
    reference: Float[Array, " n"]
    steady: Float[Array, " nu"]
    weights: Weights | None = None

    def command(self, estimate: Estimate) -> Float[Array, " nu"]:
        """The input to apply over the next sample."""
        return self.steady - dot(self.gain, jnp.asarray(estimate.x) - self.reference)


def build(
    plant: Plant,
    *,
    state_weight: list[list[float]],
    input_weight: list[list[float]],
    reference: list[float] | None = None,
    command: list[float] | None = None,
) -> Feedback:
    """The feedback that minimises the sum of x' Qx x + u' Ru u (discrete LQR).

    K = (Ru + B' S B)^-1 B' S A with S the stabilising solution of the discrete Riccati
    equation, x and u being deviations from ``reference``, the state to hold (n; default the
    origin), and ``command``, the input that holds it (nu; default 0): the two have to be an
    equilibrium of the plant for the error to vanish. ``state_weight`` (n x n, positive
    semidefinite), ``input_weight`` (nu x nu, positive definite). A nonlinear plant is linearised
    there.

    Raises `InvalidValue` for a linear plant whose matrices change, one without input, that
    (A, B) cannot stabilise, or whose unstable modes ``state_weight`` does not see; for a weight
    of wrong shape or sign.
    """
    found = held(reference, len(plant.states))
    steady = held(command, len(plant.inputs), "command", "input")
    A, B = _matrices(plant, found, steady)
    n, nu = B.shape
    states = _weight("state_weight", state_weight, n)
    inputs = _weight("input_weight", input_weight, nu)
    if np.linalg.eigvalsh(inputs)[0] <= 0:
        raise InvalidValue("input_weight", input_weight, "a positive definite matrix")
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
    weights = Weights(jnp.asarray(states), jnp.asarray(inputs))
    return Feedback(jnp.asarray(K), jnp.asarray(found), jnp.asarray(steady), weights)


def _matrices(plant: Plant, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and B of the plant, or of its linearisation at ``x`` and ``u``."""
    if isinstance(plant, LinearPlant):
        return steered(plant)[1:]
    if not plant.inputs:
        raise InvalidValue("plant", "no inputs", "at least one input to steer with")

    def moved(x, u):
        return plant.transition(step_zero() + 1, x, u, no_attack(plant))

    jacobians = jax.jacfwd(moved, (0, 1))(jnp.asarray(x), jnp.asarray(u))
    A, B = (np.asarray(found, float) for found in jacobians)
    return A, B


def steered(plant: Plant) -> tuple[LinearPlant, np.ndarray, np.ndarray]:
    """The plant, A (n x n) and B (n x nu) of a linear, constant plant with at least one input.

    Raises `InvalidValue` for any other.
    """
    if not (isinstance(plant, LinearPlant) and plant.constant):
        raise InvalidValue("plant", "matrices that change", "a linear plant, A and B constant")
    A, B = np.asarray(plant.A), np.asarray(plant.B)
    if B.shape[1] == 0:
        raise InvalidValue("plant.B", "no inputs", "at least one input to steer with")
    return plant, A, B


def held(
    given: list[float] | None, n: int, key: str = "reference", of: str = "state"
) -> np.ndarray:
    """The state (or input) to hold (n,): 0 unless given; `InvalidValue` where it is none."""
    found = np.zeros(n) if given is None else np.asarray(given, float)
    if found.shape != (n,) or not np.all(np.isfinite(found)):
        raise InvalidValue(key, given, f"{n} finite numbers, one per {of}")
    return found


def closed_loop(plant: Plant, gain: Any) -> LinearPlant:
    """The plant that an observer sees who is not told u, when u = -K x steers it: no inputs.

        x_k = (A - B K) x_{k-1} + G d_{k-1} + w,   y_k = C x_k - D K x_{k-1} + H d_k + v

    for ``gain`` K (nu x n): row k has the input computed from the true state before it, as in
    a loop whose controller is not deceived; x is then the deviation from the reference. Where
    D has columns other than zero, their inputs become states with the inputs' names, behind
    the others: the outputs need what was applied, and x_{k-1} is no function of x_k.

    Attacks, noises and limits are those of the plant. Whoever knows u should use the plant
    itself: what this one hides may be seen there.

    Raises `InvalidValue` for a plant that is not linear and constant or has no inputs, a gain
    of another shape, and limits that move with the input.
    """
    plant, A, B = steered(plant)
    K = np.asarray(gain, float)
    if K.shape != B.shape[::-1] or not np.all(np.isfinite(K)):
        raise InvalidValue("gain", f"shape {K.shape}", "finite numbers, {} x {}".format(*B.T.shape))
    D = np.asarray(plant.D)
    told = np.flatnonzero(np.any(D != 0.0, axis=0))
    more = ((0, len(told)), (0, len(told)))
    A = np.pad(A - B @ K, more)
    A[len(K.T) :, : len(K.T)] = -K[told]
    return replace(
        plant,
        A=jnp.asarray(A),
        B=jnp.zeros((len(A), 0)),
        C=jnp.asarray(np.hstack([np.asarray(plant.C), D[:, told]])),
        D=jnp.zeros((len(D), 0)),
        G=jnp.pad(jnp.asarray(plant.G), (more[0], (0, 0))),
        Q=jnp.pad(jnp.asarray(plant.Q), more),
        constraints=Constraints(
            _unmoved(plant.constraints.state, len(told)), _unmoved(plant.constraints.attack, 0)
        ),
        states=(*plant.states, *(plant.inputs[i] for i in told)),
        inputs=(),
    )


def _unmoved(limits: Polytope, more: int) -> Polytope:
    """The limits of a plant without inputs, and with so many more states that have none."""
    if np.any(np.asarray(limits.bound_u) != 0.0):
        raise InvalidValue("plant.constraints", "a bound that moves with u", "bounds without u")
    matrix = jnp.pad(limits.matrix, [*[(0, 0)] * (limits.matrix.ndim - 1), (0, more)])
    return Polytope(matrix, limits.bound, limits.bound_u[..., :0])


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
