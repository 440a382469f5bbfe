"""The keys of `l1_decoder` and `l1_kalman`: what cannot be is refused by name."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from holdfast.parts import InvalidValue
from holdfast.plants.linear import LinearPlant

Norm = Literal["l1", "l1l2", "l1linf", "l0"]
Weights = Literal["none", "noise"]
Positions = Literal["hopping", "fixed"]
Suspects = Literal["subtract", "gate", "inflate"]

NORMS: tuple[Norm, ...] = ("l1", "l1l2", "l1linf", "l0")
WEIGHTS: tuple[Weights, ...] = ("none", "noise")
POSITIONS: tuple[Positions, ...] = ("hopping", "fixed")
SUSPECTS: tuple[Suspects, ...] = ("subtract", "gate", "inflate")


def check_decoder(plant, window, weights, threshold, norm, positions, nodes) -> None:
    """The first key that cannot be, as `InvalidValue`."""
    if not isinstance(plant, LinearPlant):
        raise InvalidValue("plant", type(plant).__name__, "a linear plant")
    if window is not None and not window >= 1:
        raise InvalidValue("window", window, "a number of rows, 1 or more")
    for key, value, allowed in (
        ("weights", weights, WEIGHTS),
        ("norm", norm, NORMS),
        ("positions", positions, POSITIONS),
    ):
        if value not in (None, *allowed):
            raise InvalidValue(key, repr(value), " or ".join(map(repr, allowed)))
    if not (np.isfinite(threshold) and threshold >= 0):
        raise InvalidValue("threshold", threshold, "a number of standard deviations, 0 or more")
    if positions is not None and norm != "l0":
        raise InvalidValue("positions", repr(positions), 'no positions without norm = "l0"')
    if not nodes >= 1:
        raise InvalidValue("nodes", nodes, "a number of branches, 1 or more")


def honest(plant: LinearPlant, names: Sequence[str]) -> np.ndarray:
    """Which outputs the names of the key ``trusted`` are (p,)."""
    for name in names:
        if name not in plant.outputs:
            raise InvalidValue("trusted", repr(name), f"one of {', '.join(plant.outputs)}")
    return np.array([name in names for name in plant.outputs])
