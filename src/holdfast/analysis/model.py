"""The plant that is analysed: its matrices at one point, as NumPy arrays."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from holdfast.parts import Plant, no_attack
from holdfast.plants.linear import LinearPlant, Table
from holdfast.plants.local import motion, sensing

MOST_STEPS = 1000
"""Steps of a plant with per-step matrices that are looked at."""


class Model(NamedTuple):
    """x_k = A x_{k-1} + G d_{k-1} + w,  y_k = C x_k + H d_k + v, with the names.

    ``note`` says of which point or step the matrices are; empty for a constant plant.
    """

    A: np.ndarray
    G: np.ndarray
    C: np.ndarray
    H: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    states: tuple[str, ...]
    outputs: tuple[str, ...]
    attacks: tuple[str, ...]
    note: str

    def measuring(self, state: int) -> "Model":
        """The same plant with one more sensor, which measures this state and no attack."""
        row = np.zeros((1, len(self.states)))
        row[0, state] = 1.0
        # no statement about a sensor that is not there depends on how good it is
        return self._replace(
            C=np.vstack([self.C, row]),
            H=np.vstack([self.H, np.zeros((1, len(self.attacks)))]),
            R=np.pad(self.R, (0, 1)) + np.diag([0.0] * len(self.R) + [1.0]),
            outputs=(*self.outputs, f"{self.states[state]} measured"),
        )


def model_at(plant: Plant, x0: np.ndarray, k: int = 1) -> Model:
    """The plant at step ``k`` and the state ``x0`` (n,), without input and attack.

    A linear plant gives its matrices there, any other its Jacobians (`jax.jacfwd`).
    """
    x, u, d = jnp.asarray(x0, float), jnp.zeros(len(plant.inputs)), no_attack(plant)
    step = jnp.asarray(k, jnp.int32)
    moved, sensed = motion(plant, step, x, u, d), sensing(plant, step, x, u, d)
    found = (moved.A, moved.G, sensed.C, sensed.H, moved.Q, sensed.R)
    return _named(plant, [np.asarray(m, float) for m in found], _note(plant))


def models_over(plant: LinearPlant, x0: np.ndarray) -> list[Model]:
    """The matrices of every step of a plant that has them per step, `MOST_STEPS` at most."""
    x, u, d = jnp.asarray(x0, float), jnp.zeros(len(plant.inputs)), no_attack(plant)

    def one(k):
        moved, sensed = motion(plant, k, x, u, d), sensing(plant, k, x, u, d)
        return moved.A, moved.G, sensed.C, sensed.H, moved.Q, sensed.R

    steps = min(plant.steps or 0, MOST_STEPS)
    stacked = [np.asarray(m) for m in jax.vmap(one)(jnp.arange(1, steps + 1, dtype=jnp.int32))]
    return [_named(plant, [m[k] for m in stacked], f"step {k + 1}") for k in range(steps)]


def _named(plant: Plant, arrays: list[np.ndarray], note: str) -> Model:
    A, G, C, H, Q, R = arrays
    return Model(A, G, C, H, Q, R, plant.states, plant.outputs, plant.attacks, note)


def _note(plant: Plant) -> str:
    if not isinstance(plant, LinearPlant):
        return "linearised at the estimator's x0, without input and attack"
    if plant.steps is not None:
        return f"the matrices of step 1 of {plant.steps}"
    sources = (plant.A, plant.B, plant.C, plant.D, plant.G, plant.H, plant.Q, plant.R)
    if any(isinstance(m, Table) for m in sources):
        return "the matrices scheduled at the estimator's x0, without input"
    return ""
