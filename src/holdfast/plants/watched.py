"""A plant as an attacker sees it who knows its filter: in the steady state."""

from typing import NamedTuple

import numpy as np

from holdfast.numerics.steady_state import steady_state
from holdfast.parts import InvalidValue, Plant
from holdfast.plants.linear import LinearPlant


class Watched(NamedTuple):
    """A constant linear plant and its steady-state Kalman filter.

    x = x_pred + K z with the innovation z ~ N(0, Q); P is the covariance after the measurement.
    """

    A: np.ndarray
    C: np.ndarray
    K: np.ndarray
    Q: np.ndarray
    P: np.ndarray
    states: tuple[str, ...]
    outputs: tuple[str, ...]


def watched(plant: Plant) -> Watched:
    """The plant and its filter in the long run.

    Raises `InvalidValue` for a plant that is not linear and constant, or has no such filter.
    """
    if not (isinstance(plant, LinearPlant) and plant.constant):
        raise InvalidValue("kind", "a plant that changes", "a linear plant with constant matrices")
    A, C, Q, R = (np.asarray(m, float) for m in (plant.A, plant.C, plant.Q, plant.R))
    steady = steady_state(A, C, Q, R)
    if steady.K is None or steady.P is None or steady.P_pred is None:
        raise InvalidValue(
            "kind", f"no steady-state Kalman filter: {steady.reason}", "a plant that has one"
        )
    spread = C @ steady.P_pred @ C.T + R
    return Watched(A, C, steady.K, spread, steady.P, plant.states, plant.outputs)
