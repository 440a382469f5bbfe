"""From the configuration to the parts of the service."""

from typing import Any, NamedTuple

import numpy as np

from holdfast.detectors import chi_square
from holdfast.estimators import extended, kalman
from holdfast.loop import Monitor, Scenario
from holdfast.parts import Estimator
from holdfast.plants.linear import LinearPlant
from holdfast.records import Verdict
from holdfast.shell.calibrating import calibrated_scenario
from holdfast.shell.errors import InputError
from holdfast.shell.live import Live
from holdfast.shell.scenario import read_scenario
from holdfast.shell.service.checkpoint import digest
from holdfast.shell.service.clock import SourceClock
from holdfast.shell.service.config import AuthKeys, LiveConfig, secret
from holdfast.shell.service.engine import Engine
from holdfast.shell.service.estimation import Estimation
from holdfast.shell.service.fallback import Fallback
from holdfast.shell.service.frames import Frames
from holdfast.shell.service.health import Rules
from holdfast.shell.service.records import Labels
from holdfast.shell.service.watching import watch_of


class Built(NamedTuple):
    """The engine, its labels, and whose state a checkpoint of it is."""

    engine: Engine
    labels: Labels
    scenario: Scenario
    owner: str


def build_engine(config: LiveConfig, allow_python: bool) -> Built:
    """Read the scenario, calibrate its detector, compile the step. Raises `InputError`."""
    found = read_scenario(config.scenario, allow_python=allow_python)
    scenario, _ = calibrated_scenario(found)
    monitor = scenario.monitor
    plant = monitor.estimator.plant
    live = Live(monitor)
    labels = Labels.of(config.name, plant, monitor.estimator.init()[1])
    clock, sensors = config.clock, config.sensors
    frames = Frames(
        plant.dt, labels.columns, clock.grace, SourceClock(clock.rule == "arrival", clock.jump)
    )
    refilter = clock.window if clock.late == "refilter" else 0
    estimation = Estimation(
        live, watch_of(plant),
        Rules(sensors.level, sensors.window, sensors.confirm, sensors.probation),
        sensors.enabled, sensors.retry, refilter, _pointed_of(monitor),
    )  # fmt: skip
    authentication = None
    if config.auth is not None:
        authentication = _authentication(config, config.auth, labels, scenario)
    engine = Engine(
        labels, frames, estimation, _fallback(config, monitor), refilter, authentication
    )
    return Built(engine, labels, scenario, digest(found.source, config.source_text))


def _pointed_of(monitor: Monitor) -> Any:
    """Which outputs a verdict points at: a localising detector of residuals names them."""
    ny = len(monitor.estimator.plant.outputs)
    on_outputs = getattr(monitor.detector, "on", "") == "residual"
    nothing = np.zeros(ny, bool)

    def pointed(verdict: Verdict) -> np.ndarray:
        flags = np.asarray(verdict.channel_alarms)
        return flags if on_outputs and flags.shape == (ny,) else nothing

    return pointed


def _fallback(config: LiveConfig, monitor: Monitor) -> Fallback:
    rule, after = config.fallback.rule, config.fallback.after
    estimator = monitor.estimator
    if rule == "none" or isinstance(estimator, kalman.Kalman | extended.Extended):
        # a filter beside itself would fail with it
        return Fallback("none", after, None)
    plant, start = estimator.plant, estimator.init()[1]
    beside: Estimator = (
        kalman.build(plant, start.x, start.x_cov)
        if isinstance(plant, LinearPlant)
        else extended.build(plant, start.x, start.x_cov)
    )
    return Fallback(rule, after, Live(Monitor(beside, chi_square.build(plant, on="residual"))))


def _authentication(config: LiveConfig, keys: AuthKeys, labels: Labels, scenario: Scenario) -> Any:
    try:
        from holdfast.shell.service.authenticating import Authentication, receiver_of
    except ImportError:
        raise InputError(
            config.path, "auth", "no package for message authentication",
            'pip install "holdfast[auth]"',
        ) from None  # fmt: skip
    text = secret(config.path, "auth.key", keys.key_env, keys.key_file, config.folder)
    try:
        receiver = receiver_of(
            labels.outputs, scenario.enforcement, bytes.fromhex(text), keys.missing_is_alarm
        )
    except ValueError:
        raise InputError(config.path, "auth.key", "a key that cannot be used",
                         "16 bytes as 32 hexadecimal digits") from None  # fmt: skip
    return Authentication(receiver, labels.outputs, labels.dt)
