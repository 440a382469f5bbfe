"""From the configuration to a fleet, its source and its sinks."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from holdfast.shell.calibrating import calibrated_scenario
from holdfast.shell.errors import InputError
from holdfast.shell.flat import FlatMonitor
from holdfast.shell.scenario import read_scenario
from holdfast.shell.schema import Table
from holdfast.shell.service.checkpoint import digest
from holdfast.shell.service.clock import SourceClock
from holdfast.shell.service.config import FleetKeys, LiveConfig
from holdfast.shell.service.fleet.engine import FleetEngine
from holdfast.shell.service.fleet.members import Members
from holdfast.shell.service.fleet.stepping import Stepping
from holdfast.shell.service.fleet.timing import Timing
from holdfast.shell.service.fleet.wire import LIMIT, Told, batch_decoder, estimates_frame
from holdfast.shell.service.parts import (
    BrokerKeys,
    MqttSinkKeys,
    Parts,
    broker_of,
    check_topic,
)
from holdfast.shell.service.records import Labels
from holdfast.shell.service.saying import dumps
from holdfast.shell.service.sinks import Sink
from holdfast.shell.service.sources import Source

MOST_BYTES = 4 * 2**30
"""Bytes of all plants' states that are allowed."""
STATUS = 1.0
"""Seconds between two words on how the fleet does."""


class _SourceKeys(BrokerKeys):
    topic: str = Field(description="the topic of batches, wildcards allowed")
    trust: bool = False


class BuiltFleet(NamedTuple):
    """The engine, its labels, and whose state a checkpoint of it is."""

    engine: FleetEngine
    labels: Labels
    owner: str


def build_fleet(config: LiveConfig, keys: FleetKeys, allow_python: bool) -> BuiltFleet:
    """Read the scenario, calibrate its detector, compile the step. Raises `InputError`."""
    found = read_scenario(config.scenario, allow_python=allow_python)
    monitor = calibrated_scenario(found)[0].monitor
    plant = monitor.estimator.plant
    labels = Labels.of(config.name, plant, monitor.estimator.init()[1])
    flat = FlatMonitor(monitor)
    size = keys.most * flat.start.nbytes
    if size > MOST_BYTES:
        most = MOST_BYTES // flat.start.nbytes
        raise InputError(
            config.path, "fleet.most", f"{keys.most}, which takes {size / 2**30:.1f} GiB",
            f"{most} plants or fewer",
        )  # fmt: skip
    clock = config.clock
    timing = Timing(plant.dt, clock.grace, SourceClock(clock.rule == "arrival", clock.jump))
    retire = math.ceil(keys.retire / plant.dt)
    engine = FleetEngine(
        labels, Stepping(flat, keys.most), timing, Members(keys.most), config.fallback.after, retire
    )
    return BuiltFleet(engine, labels, digest(found.source, config.source_text))


def build_fleet_parts(config: LiveConfig, built: BuiltFleet, stop: Callable[[], None]) -> Parts:
    """Everything that the configuration names. Raises `InputError`."""
    sources = tuple(
        _source(table, i, built.labels, config) for i, table in enumerate(config.sources, 1)
    )
    sinks = [_sink(table, i, built, config) for i, table in enumerate(config.sinks, 1)]
    if config.events is not None:
        from holdfast.shell.service.event_log import EventLog

        sinks.append(EventLog(config.events))
    return Parts(sources, tuple(sinks), None, ())


def _source(table: Table, number: int, labels: Labels, config: LiveConfig) -> Source:
    from holdfast.shell.service.mqtt import MqttSource

    kind = table.kind(["mqtt"])
    keys: Any = table.checked(_SourceKeys)
    broker = broker_of(table, keys, config)
    check_topic(table, keys.topic)
    return MqttSource(
        f"{kind}[{number}]", broker, {keys.topic: batch_decoder(labels, keys.trust)}, LIMIT
    )


def _sink(table: Table, number: int, built: BuiltFleet, config: LiveConfig) -> Sink:
    from holdfast.shell.service.mqtt import MqttSink

    kind = table.kind(["mqtt"])
    keys: Any = table.checked(MqttSinkKeys)
    broker = broker_of(table, keys, config)
    return MqttSink(
        f"{kind}[{number}]",
        broker,
        partial(_said, built.engine, _Due()),
        keys.prefix,
        keys.capacity,
    )


class _Due:
    """Whether it is time for a word again."""

    def __init__(self) -> None:
        self._next = -math.inf

    def __call__(self) -> bool:
        now = time.monotonic()
        if now < self._next:
            return False
        self._next = now + STATUS
        return True


def _said(engine: FleetEngine, due: _Due, told: Told) -> Iterable[tuple[str, bytes]]:
    yield "estimates", estimates_frame(told)
    if due():
        yield "status", dumps(status_of(engine, told))


def status_of(engine: FleetEngine, told: Told) -> dict[str, Any]:
    """How the fleet does, in a few numbers; ``told``: its last rows."""
    at, timing = engine.members.taken, engine.timing
    return {
        "frame": engine.closed,
        "plants": len(at),
        "alarms": int(np.sum(engine.alarms.open[at])),
        "silent": int(np.sum(engine.silent.open[at])),
        "blind": int(np.sum(~np.isfinite(told.threshold))),
        **dataclasses.asdict(engine.counts),
        "put_aside": timing.put_aside,
        "jumps": timing.jumps,
        "clock_drift": timing.clock.drift,
    }
