"""Calibration of a scenario's detector: exact, simulated (kept on disk) or from a log."""

import contextlib
import dataclasses
import json
import math
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx

from holdfast import __version__
from holdfast.campaign.calibrate import (
    Calibratable,
    Calibration,
    calibrated,
    content_key,
    from_log,
    with_value,
)
from holdfast.estimators.bank import one_by_one
from holdfast.estimators.care import Care
from holdfast.estimators.l1_decoder import L1Decoder
from holdfast.estimators.l1_kalman import L1Kalman
from holdfast.estimators.nisme import Nisme
from holdfast.estimators.secure_fusion import SecureFusion
from holdfast.estimators.unknown_input import UnknownInput
from holdfast.loop import Monitor, Scenario
from holdfast.parts import InvalidValue
from holdfast.plants.linear import LinearPlant
from holdfast.shell.errors import InputError
from holdfast.shell.logs import read_log
from holdfast.shell.runtime import cache_folder
from holdfast.shell.scenario import ScenarioFile
from holdfast.shell.writing import write_text

COSTLY_RUNS, DEAR_RUNS = 1000, 100
"""Runs behind a calibration where each is dear, or very dear: 4000 or 400 false alarms at a level
of 0.01."""
FEW_ALARMS = 80
"""False alarms that such a calibration expects at least: the rate is then known to 11 %."""
ROWS = 400
"""Rows of a run that count."""


def calibrated_scenario(found: ScenarioFile, *, alone: bool = True) -> tuple[Scenario, Calibration]:
    """The scenario with its detector calibrated as [detector] asks, and how that was done.

    ``alone``: whether nothing else says on the terminal how far it is. Raises `InputError`.
    """
    monitor, controller = found.scenario.monitor, found.scenario.controller
    try:
        if found.calibrate is not None:
            log = read_log(found.calibrate, found.scenario.plant)
            monitor, how = from_log(monitor, log.observation)
        elif found.threshold == "calibrated" and _large_bank(monitor):
            how = _not_simulated(monitor)
            warnings.warn(f"{found.path}: detector.threshold: {how.sentence}", stacklevel=2)
        else:
            kept = _kept(content_key((monitor, controller), (__version__,)))
            how = _read(kept)
            if how is None:
                runs = _runs(monitor)
                with busy("calibrating the threshold") if alone else contextlib.nullcontext():
                    monitor, how = calibrated(monitor, controller=controller, runs=runs)
                _keep(kept, how)
            else:
                monitor = with_value(monitor, how.value)
    except InvalidValue as error:
        key = f"detector.{error.key}"
        raise InputError(found.path, key, str(error.found), error.expected) from None
    return eqx.tree_at(lambda s: s.monitor, found.scenario, monitor), how


def _large_bank(monitor: Monitor) -> bool:
    """Whether a row takes milliseconds, so that thousands of runs would take hours."""
    estimator = monitor.estimator
    return (
        isinstance(estimator, Nisme)
        and isinstance(monitor.detector, Calibratable)
        and not one_by_one(estimator.plant, estimator.group)
    )


def _not_simulated(monitor: Monitor) -> Calibration:
    level = float(getattr(monitor.detector, "level", math.nan))
    sentence = (
        f"Threshold from the quantile at {level:g}, exact for the true mode, and not calibrated: "
        f"a bank on {len(monitor.estimator.plant.states)} states is too dear to simulate; "
        'threshold = "paper" asks for just this, calibrate = "LOG" takes a log without attack.'
    )
    return Calibration("given", level, 1.0, sentence)


def dear(monitor: Monitor) -> str | None:
    """Why a row costs a thousand times what a Kalman filter's does; None if it does not."""
    estimator = monitor.estimator
    if isinstance(estimator, L1Decoder | L1Kalman):
        return "a window is decoded at every row of every run"
    if isinstance(estimator, UnknownInput | Care) and not isinstance(estimator.plant, LinearPlant):
        return "a nonlinear plant is linearised up to six times at every row of every run"
    if isinstance(estimator, Nisme):
        return f"a bank of {len(estimator.modes)} modes is run at every row of every run"
    return None


def _runs(monitor: Monitor) -> int | None:
    """Fewer runs where a row costs ten to a thousand times what a Kalman filter's does."""
    estimator = monitor.estimator
    if dear(monitor):
        runs = DEAR_RUNS
    elif isinstance(estimator, SecureFusion):
        runs = COSTLY_RUNS if estimator.quick else DEAR_RUNS
    else:
        return None
    level = float(getattr(monitor.detector, "level", 1.0))
    return max(runs, math.ceil(FEW_ALARMS / (level * ROWS)))


@contextlib.contextmanager
def busy(words: str) -> Iterator[None]:
    """Say on standard error what takes long, where somebody watches."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(words):
        yield


def _kept(name: str) -> Path | None:
    folder = cache_folder()
    return None if folder is None else folder / f"calibration-{name}.json"


def _read(path: Path | None) -> Calibration | None:
    if path is None or not path.is_file():
        return None
    try:
        return Calibration(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None  # a damaged entry is made anew


def _keep(path: Path | None, how: Calibration) -> None:
    # what is exact or given costs nothing to find again
    if path is not None and how.method == "simulated":
        with contextlib.suppress(InputError):
            write_text(path, json.dumps(dataclasses.asdict(how)))
