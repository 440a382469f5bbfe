"""What an injection does to a linear plant: state and outputs, as functions of all channels."""

from typing import NamedTuple

import numpy as np

from holdfast.parts import InvalidValue, Plant
from holdfast.plants.linear import LinearPlant


class Effect(NamedTuple):
    """x^a_{k+1} = A x^a_k + G a_k moves the state, C x^a_k + H a_k the outputs.

    a = (u, y, d) as in `holdfast.attacks.channels.Channels.hit`: G (n x nz) = [B, 0, G],
    H (ny x nz) = [D, I, H].
    """

    A: np.ndarray
    G: np.ndarray
    C: np.ndarray
    H: np.ndarray


def effect(plant: Plant, attack: str) -> Effect:
    """The matrices, for the attack of this name.

    Raises `InvalidValue` for a plant that is not linear, or not constant: the attacker computes
    with one model of it.
    """
    if not isinstance(plant, LinearPlant):
        raise InvalidValue(
            "kind", f"a {type(plant).__name__}", f"a linear plant: {attack} needs its matrices"
        )
    if not plant.constant or plant.sampling is not None:
        raise InvalidValue("kind", "a plant that varies in time", f"a constant one for {attack}")
    A, B, C, D, G, H = (
        np.asarray(m, float) for m in (plant.A, plant.B, plant.C, plant.D, plant.G, plant.H)
    )
    n, ny = len(A), len(C)
    return Effect(A, np.hstack([B, np.zeros((n, ny)), G]), C, np.hstack([D, np.eye(ny), H]))
