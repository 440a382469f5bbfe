"""Three states seen by five sensors, none of which sees them all: where a liar can be outvoted."""

from collections.abc import Sequence

import numpy as np

from holdfast.plants.build import linear_plant
from holdfast.plants.linear import LinearPlant
from holdfast.plants.named import channels

MODES, CALM = (1.0, 1.0, -2.0), 0.8
SENSORS = (
    (1.0, 0.0, 0.0),
    (1.0, 1.0, -1.0),
    (1.0, 2.0, 1.0),
    (1.0, -1.0, -0.5),
    (-0.5, 1.0, 1.0),
)
OUTPUTS = ("y1", "y2", "y3", "y4", "y5")


def build(*, stable: bool = False, attacks: Sequence[str] = ()) -> LinearPlant:
    """The example of the DECOMPOSE paper: A = diag(1, 1, -2), Q = I, R = I, no input.

        C = [[1, 0, 0], [1, 1, -1], [1, 2, 1], [1, -1, -0.5], [-0.5, 1, 1]]

    The third state doubles at every step: after some 50 steps nothing is left of the digits of
    an error of order 1. ``stable`` puts 0.8 in the place of -2 (and so has other gains), for
    long runs. No sensor alone observes the state, whatever two of them are missing the others do.

    states x1 .. x3, outputs y1 .. y5. ``attacks``: the attack channels, of "sensor:y1" ..
    "sensor:y5" (`holdfast.plants.named`).

    Raises `InvalidValue` for another attack.

    Source: DECOMPOSE, Section VI.
    """
    modes = (*MODES[:2], CALM) if stable else MODES
    _, sens = channels(attacks, (), OUTPUTS)
    return linear_plant(
        A=np.diag(modes),
        C=np.array(SENSORS),
        H=sens,
        Q=np.eye(3),
        R=np.eye(5),
        states=["x1", "x2", "x3"],
        outputs=OUTPUTS,
        attacks=attacks,
    )
