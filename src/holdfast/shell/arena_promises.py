"""What is promised of a point of the arena beforehand, from the plant and the channels hit."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from holdfast.analysis.attackable import attackable
from holdfast.analysis.model import Model, model_at
from holdfast.analysis.observability import observability
from holdfast.analysis.promises import Hit, decoupled, of_decoder, of_fusion
from holdfast.estimators.kalman import Kalman
from holdfast.estimators.l1_decoder import L1Decoder
from holdfast.estimators.nise import Nise
from holdfast.estimators.secure_fusion import SecureFusion
from holdfast.estimators.unknown_input import UnknownInput
from holdfast.loop import replay
from holdfast.numerics.local import Unfit, decompose
from holdfast.numerics.steady_state import steady_state
from holdfast.numerics.stealth import Stealth
from holdfast.parts import Estimator, Plant
from holdfast.plants.linear import LinearPlant
from holdfast.plants.watched import watched
from holdfast.reach.bounds import reach
from holdfast.reach.setting import Setting
from holdfast.records import Observation
from holdfast.shell.points import Prepared
from holdfast.shell.study import TRUTH


class Promise(NamedTuple):
    """The root mean square error of each state over a run (n,), at most; ``exact``: just that."""

    bound: np.ndarray
    exact: bool
    why: str


class Promises:
    """What is promised of the points of a study; what several have in common is found once."""

    def __init__(self, prepared: Prepared):
        self._prepared = prepared
        self._known: dict[Any, Any] = {}
        self._true = not any(a.name.startswith(f"{TRUTH}.") for a in prepared.study.axes)

    def of(self, number: int, quiet: int) -> Promise | None:
        """Of point ``number``, ``quiet`` being the same without attack; None: nothing.

        Only of linear plants with constant matrices that are as the estimator believes.
        """
        scenario = self._prepared.cases[number].scenario
        plant, estimator = scenario.plant, scenario.monitor.estimator
        attacks = self._attacks(number)
        kinds = {table["kind"] for table in attacks}
        hit = hit_of(plant, attacks)
        if not self._true or not _constant(plant) or hit is None:
            return None
        if scenario.enforcement is not None:
            return None  # a decoder meets authenticated samples first, noise and all
        if kinds == {"stealthy"} and isinstance(estimator, Kalman):
            return self._of_stealth(number, quiet, attacks[0], hit)
        name = (quiet, *hit.inputs, *hit.outputs, *hit.attacks, hit.at_once)
        if name not in self._known:
            self._known[name] = self._of_channels(estimator, plant, quiet, hit)
        return self._known[name]

    def _of_channels(self, estimator: Estimator, plant: Plant, quiet: int, hit: Hit):
        """What holds whatever is done with the channels hit."""
        if isinstance(estimator, Kalman | UnknownInput | Nise):
            return self._of_covariance(quiet, hit)
        if isinstance(estimator, L1Decoder) and _plain_l1(estimator) and estimator.window.laid:
            weighted = estimator.weights == "noise"
            bound = of_decoder(_model(plant), estimator.window.laid, weighted, hit)
            return Promise(bound, False, "l1 ratio of the window under 1")
        if isinstance(estimator, SecureFusion) and _plain_fusion(estimator):
            return _of_fusion(_model(plant), estimator, hit)
        return None

    def attackable(self, number: int) -> bool | None:
        """Whether undetected lies of the sensors hit can grow without bound; None where other
        channels are hit or it is not known.
        """
        plant = self._prepared.cases[number].scenario.plant
        hit = hit_of(plant, self._attacks(number))
        if not _constant(plant) or hit is None or not hit.sensors_only or not hit.outputs.any():
            return None
        name = ("attackable", *hit.outputs.tolist())
        if name not in self._known:
            model = _model(plant)
            steady = steady_state(model.A, model.C, model.Q, model.R)
            altered = tuple(np.flatnonzero(hit.outputs).tolist())
            found = attackable(model, steady, observability(model), altered).given
            self._known[name] = None if found is None else found.attackable
        return self._known[name]

    def _attacks(self, number: int) -> list[dict[str, Any]]:
        study = self._prepared.study
        return list(study.content_of(study.points[number])[0].get("attack", []))

    def _of_covariance(self, quiet: int, hit: Hit) -> Promise | None:
        """The filter's own covariance over a run, which does not depend on the data."""
        case = self._prepared.cases[quiet]
        plant, estimator = case.scenario.plant, case.scenario.monitor.estimator
        assert isinstance(plant, LinearPlant)
        active = np.zeros(len(plant.attacks), bool)
        if isinstance(estimator, UnknownInput):
            active[:] = True
        elif isinstance(estimator, Nise):
            active = np.asarray(estimator.free.active, bool)
        B, D = np.asarray(plant.B), np.asarray(plant.D)
        if not decoupled(_model(plant), B, D, hit, active):
            return None
        if quiet not in self._known:
            nothing = np.zeros((case.steps, len(plant.inputs)))
            rows = Observation.of(nothing, np.zeros((case.steps, len(plant.outputs))))
            covariance = replay(case.scenario.monitor, rows).estimate.x_cov
            variance = np.asarray(jnp.diagonal(covariance, axis1=1, axis2=2))
            kept = np.isfinite(variance)
            mean = np.sum(np.where(kept, variance, 0.0), 0) / np.maximum(kept.sum(0), 1)
            self._known[quiet] = np.sqrt(np.where(kept.any(0), mean, np.inf))
        return Promise(self._known[quiet], True, "the attack estimate has every channel hit")

    def _of_stealth(
        self, number: int, quiet: int, table: dict[str, Any], hit: Hit
    ) -> Promise | None:
        """What a stealthy attacker reaches at most at every row, added to what noise does over
        the run, its first rows included.

        None where he stops before the end: what is left of his attack then is not promised.
        """
        case = self._prepared.cases[number]
        plant = case.scenario.plant
        first, stop = (round(table[key] / plant.dt) for key in ("start", "stop"))
        if stop <= case.steps:
            return None
        level = table.get("level", 0.01)
        name = ("stealth", quiet, table["epsilon"], level, first, *hit.outputs.tolist())
        if name not in self._known:
            noise = self._of_covariance(quiet, _nobody(plant))
            assert noise is not None, "nobody is hit"
            stealth = Stealth("chi_square", table["epsilon"], level, len(hit.outputs))
            system = watched(plant)
            setting = Setting(system, stealth, hit.outputs, None, np.eye(len(plant.states)))
            reached = np.zeros(case.steps)
            reached[first - 1 :] = reach(setting, case.steps - first + 1).norm
            self._known[name] = np.sqrt(noise.bound**2 + np.mean(reached**2))
        return Promise(self._known[name], False, "what a stealthy attacker reaches at most")


def _plain_l1(estimator: L1Decoder) -> bool:
    """Whether it minimises the l1 norm and trusts nobody beforehand."""
    return estimator.norm == "l1" and not np.any(np.asarray(estimator.window.honest))


def _nobody(plant: Plant) -> Hit:
    return Hit(
        np.zeros(len(plant.inputs), bool),
        np.zeros(len(plant.outputs), bool),
        np.zeros(len(plant.attacks), bool),
    )


def _constant(plant: Plant) -> bool:
    return isinstance(plant, LinearPlant) and plant.constant


def _model(plant: Plant) -> Model:
    return model_at(plant, np.zeros(len(plant.states)))


def _of_fusion(model: Model, estimator: SecureFusion, hit: Hit) -> Promise | None:
    steady = steady_state(model.A, model.C, model.Q, model.R)
    if steady.K is None:
        return None
    try:
        local = decompose(model.A, model.C, model.Q, model.R, steady.K)
    except Unfit:
        return None
    return Promise(of_fusion(local, estimator.gamma, hit), False, "ratio of the fusion under 1")


def _plain_fusion(estimator: SecureFusion) -> bool:
    """Whether it is the paper's: the Kalman gain, its own norm, nobody trusted or left out."""
    return estimator.kalman and estimator.plain and not estimator.refit and (
        estimator.witness is None and len(estimator.group) == len(estimator.bank.b) * len(
            estimator.plant.outputs)
    )  # fmt: skip


def hit_of(plant: Plant, attacks: list[dict[str, Any]]) -> Hit | None:
    """The channels that the attacks of a scenario use; None where one throws a switch, or takes
    channels that it does not name.
    """
    sizes = [len(v) for v in (plant.inputs, plant.outputs, plant.attacks)]
    masks = [np.zeros(size, bool) for size in sizes]
    kinds = {"actuator": (0, plant.inputs), "sensor": (1, plant.outputs),
             "channel": (2, plant.attacks)}  # fmt: skip
    few = None
    for table in attacks:
        if table["kind"] in ("switch", "covert"):
            return None
        named = table.get("channels") or [table["channel"]]
        for name in named:
            kind, _, rest = name.partition(":")
            place, names = kinds[kind]
            masks[place][names.index(rest)] = True
        if table["kind"] == "hopping" and len(attacks) == 1 and table["count"] < len(named):
            few = int(table["count"])
    inputs, outputs, channels = masks
    return Hit(inputs, outputs, channels, few)
