"""Everything that is said of a plant before any data, in one record."""

from typing import NamedTuple

import numpy as np

from holdfast.analysis.attackable import Attackable, attackable
from holdfast.analysis.attacks import Identifiability, identifiability, undetermined_steps
from holdfast.analysis.boundedness import Bounds, bounds
from holdfast.analysis.fusion import Fusion, fusion
from holdfast.analysis.model import Model, model_at, models_over
from holdfast.analysis.observability import Observability, observability, rows_until_observable
from holdfast.analysis.remedies import Decoding, decoding
from holdfast.analysis.windows import noise_weights
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
    without attack channels. ``window``: only for per-step matrices. ``decoding``: of the
    decoders' window, ``attackable``: of the steady-state Kalman filter, whatever the estimator is.
    """

    model: Model
    observability: Observability
    steady: SteadyState
    attacks: Identifiability
    bounds: tuple[Bounds, ...]
    window: Window | None
    fusion: Fusion
    decoding: Decoding
    attackable: Attackable


def analysis(
    plant: Plant,
    x0: np.ndarray,
    P0: np.ndarray,
    window: int | None = None,
    trusted: tuple[int, ...] = (),
    weighted: bool = False,
    compromised: tuple[int, ...] | None = None,
) -> Analysis:
    """What can be said of ``plant`` near ``x0`` (n,), starting from the covariance ``P0``.

    ``window``: steps that a decoder looks at, n if there is none; ``trusted``: outputs that are
    always authenticated; ``weighted``: whether it divides each sample by its deviation;
    ``compromised``: outputs that a stealthy attacker alters, beside all and each alone.
    """
    model = model_at(plant, x0)
    window = len(model.A) if window is None else window
    weight = noise_weights(model, window) if weighted else None
    attacks = identifiability(model)
    delays = sorted({0, attacks.delay}) if model.attacks else []
    seen = observability(model)
    steady = steady_state(model.A, model.C, model.Q, model.R)
    over = None
    if isinstance(plant, LinearPlant) and plant.steps is not None:
        models = models_over(plant, x0)
        over = Window(len(models), rows_until_observable(models), undetermined_steps(models))
    return Analysis(
        model,
        seen,
        steady,
        attacks,
        tuple(bounds(model, P0, delay) for delay in delays),
        over,
        fusion(model, steady),
        decoding(model, window, trusted, weight),
        attackable(model, steady, seen, compromised),
    )
