"""NISE: state and attack of a nonlinear plant under one hypothesis of where the attack enters.

The attack channels of the mode are wholly free, the others 0. On a linear plant this is
`UnknownInput` with those channels alone, and so equals batch least squares with free attacks;
a nonlinear one is predicted with its own f (whatever samples it) and linearised once per step.

Algorithm 1 as it reads after the errata: P_k in lines 11 and 12; C_2 G_1 with M_2; h_2 inside
M_2(.); d_2 = Vbar_1' V_2' d; and d_2, which line 2 takes from z_2 alone, corrected by z_3 like
the state, which makes it the best linear unbiased one. The output decompositions (6)-(8) are
those of `holdfast.numerics.blue`, for whatever samples arrived and any rank of H and C G.

Source: NISME Algorithm 1, (6)-(12), errata 1 to 4 and 8.
"""

from collections.abc import Sequence

import numpy as np

from holdfast.estimators.unknown_input import UnknownInput, UnknownInputState, restricted
from holdfast.parts import Estimator, InvalidValue, Plant
from holdfast.records import Estimate, Observation


class Nise(Estimator):
    """x_k, d_{1,k} and d_{2,k-1} from y up to k, for one ``mode``.

    Every row carries HIDDEN_INPUT where an attack of the mode moves the state and reaches no
    output of its own row: the paper's M_2 = 0 would hide that, and bias the state.
    """

    free: UnknownInput

    @property
    def plant(self) -> Plant:
        """The plant that is watched."""
        return self.free.plant

    def init(self) -> tuple[UnknownInputState, Estimate]:
        """The estimate one sample before the first row; the attacks up to there are free."""
        return self.free.init()

    def step(
        self, state: UnknownInputState, observation: Observation
    ) -> tuple[UnknownInputState, Estimate]:
        """One row: find the attack before it, predict with it, correct, find the attack at it."""
        return self.free.step(state, observation)


def build(plant: Plant, x0, P0, *, mode: Sequence[str] | None = None) -> Nise:
    """The estimator from ``x0``, ``P0`` before the first row, the attacks in ``mode`` active.

    ``mode``: names of attack channels; all of the plant's if not given, none if empty.
    Raises `InvalidValue` for a name that the plant does not have or that comes twice.
    """
    active = active_channels(plant, plant.attacks if mode is None else mode, "mode")
    return Nise(restricted(plant, x0, P0, active, settle=False))  # pyright: ignore[reportCallIssue]


def active_channels(plant: Plant, names: Sequence[str], key: str) -> np.ndarray:
    """Which attack channels are named; raises `InvalidValue` about ``key``."""
    for name in names:
        if name not in plant.attacks:
            known = ", ".join(plant.attacks) or "no name: the plant has no attack channel"
            raise InvalidValue(key, repr(name), f"one of {known}")
    if len(set(names)) != len(names):
        raise InvalidValue(key, list(names), "names that differ")
    return np.array([name in names for name in plant.attacks], bool)
