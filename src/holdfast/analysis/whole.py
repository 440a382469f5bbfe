"""Everything that is said of a plant before any data, in one record."""

from typing import NamedTuple

import numpy as np

from holdfast.analysis.attacks import Identifiability, identifiability, undetermined_steps
from holdfast.analysis.boundedness import Bounds, bounds
from holdfast.analysis.fusion import Fusion, fusion
from holdfast.analysis.model import Model, model_at, models_over
from holdfast.analysis.observability import Observability, observability, rows_until_observable
from holdfast.numerics.steady_state import SteadyState, steady_state
from holdfast.parts import Plant
from holdfast.plants.linear import LinearPlant


class Window(NamedTuple):
    """Of per-step matrices: the steps looked at, the rows from the first that determine the
    state before them (None: all do not), and at how many steps each attack channel is not
    determined by its own row.
    """

    steps: int
    rows: int | None
    undetermined: dict[str, int]


class Analysis(NamedTuple):
    """``bounds``: at delay 0 and at the smallest delay that identifies what can be; none
    without attack channels. ``window``: only for per-step matrices.
    """

    model: Model
    observability: Observability
    steady: SteadyState
    attacks: Identifiability
    bounds: tuple[Bounds, ...]
    window: Window | None
    fusion: Fusion


def analysis(plant: Plant, x0: np.ndarray, P0: np.ndarray) -> Analysis:
    """What can be said of ``plant`` near ``x0`` (n,), starting from the covariance ``P0``."""
    model = model_at(plant, x0)
    attacks = identifiability(model)
    delays = sorted({0, attacks.delay}) if model.attacks else []
    steady = steady_state(model.A, model.C, model.Q, model.R)
    window = None
    if isinstance(plant, LinearPlant) and plant.steps is not None:
        models = models_over(plant, x0)
        window = Window(len(models), rows_until_observable(models), undetermined_steps(models))
    return Analysis(
        model,
        observability(model),
        steady,
        attacks,
        tuple(bounds(model, P0, delay) for delay in delays),
        window,
        fusion(model, steady),
    )
