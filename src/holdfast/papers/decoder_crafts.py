"""The quadrotors of DECODER, Section V, as the paper has them and as the analysis advises."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from holdfast.analysis.correctable import Correctable, correctable
from holdfast.analysis.model import model_at
from holdfast.analysis.remedies import Plan, remedies
from holdfast.controllers import feedback
from holdfast.papers.decoder_flight import Course
from holdfast.plants.library import quadrotor
from holdfast.plants.linear import LinearPlant

WINDOW = 10
"""T of the decoder, and of the windows over which errors are taken."""
Q = 2
"""Attacked sensors per step: one steadily, one at random."""
RESERVE = 5
"""What more redundancy is advised for: a position is then seen by eleven sensors."""
MANY = 60
WEIGHTS: dict[str, Any] = {
    "state_weight": np.diag([1.0, 0.1, 0.1, 0.01] * 2 + [1.0, 0.1]).tolist(),
    "input_weight": np.diag([1.0, 1.0, 0.1]).tolist(),
}
PLACES = (0, 4, 8)
"""The positions among the states."""


class Craft(NamedTuple):
    """A quadrotor, the optimal ``gain`` (3 x 10), what of its sensors is authenticated.

    ``plan``: the advice it was built by; ``found``: what decoders of `WINDOW` rows that know u
    then correct.
    """

    plant: LinearPlant
    gain: np.ndarray
    trusted: tuple[str, ...] = ()
    plan: Plan | None = None

    @property
    def found(self) -> Correctable:
        """By `correctable`, with A_0."""
        places = tuple(self.plant.outputs.index(name) for name in self.trusted)
        return correctable(model_at(self.plant, np.zeros(10)), WINDOW, places)

    @property
    def open(self) -> list[str]:
        """The channels of position sensors that an attacker can reach."""
        free = [name for name in self.plant.outputs if name not in self.trusted]
        return [f"sensor:{name}" for name in free if name.startswith("p_")]


def craft(
    sensors: int | list[str], trusted: tuple[str, ...] = (), plan: Plan | None = None
) -> Craft:
    """With these sensors, steered optimally."""
    plant = quadrotor.build(sensors=sensors)
    return Craft(plant, np.asarray(feedback.build(plant, **WEIGHTS).gain), trusted, plan)


@cache
def as_it_is(sensors: int) -> Craft:
    """The paper's, with 3, 5 or 8 sensors."""
    return craft(sensors)


@cache
def more_sensors(q: int = Q) -> Craft:
    """The paper's five, and what is advised to be measured as well so that l0 corrects q."""
    own = as_it_is(5).plant
    plan = remedies(model_at(own, np.zeros(10)), WINDOW, q, "l0", "measure", MANY)
    return craft([*own.outputs, *plan.names], plan=plan)


@cache
def authenticated(q: int = Q) -> Craft:
    """The paper's five, and beside each sensor advised to be authenticated one that is.

    The first stays open, so that the attack has somewhere to go.
    """
    own = as_it_is(5).plant
    plan = remedies(model_at(own, np.zeros(10)), WINDOW, q, "l0", "authenticate", MANY)
    return craft([*own.outputs, *plan.names], tuple(f"{name}_2" for name in plan.names), plan)


def remedied() -> dict[str, Craft]:
    """The ways out, by name."""
    return {
        "sensors added": more_sensors(),
        "more sensors": more_sensors(RESERVE),
        "authenticated": authenticated(),
    }


def circling(of: Craft, steps: int) -> Course:
    """A climbing circle of 10 m, flown optimally after a target: x_r and the input for it."""
    A, B = (np.asarray(m) for m in (of.plant.A, of.plant.B))
    x, states, inputs = np.zeros(10), [], []
    for k in range(steps):
        angle, aim = 0.2 * k * of.plant.dt, np.zeros(10)
        aim[list(PLACES)] = 10.0 * np.sin(angle), 10.0 * (1.0 - np.cos(angle)), angle
        u = -of.gain @ (x - aim)
        x = A @ x + B @ u
        states.append(x)
        inputs.append(u)
    return Course(np.array(states), np.array(inputs))
