"""From the configuration to a fleet, its source and its sinks."""

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from holdfast.shell.calibrating import calibrated_scenario
from holdfast.shell.errors import InputError, shown
from holdfast.shell.flat import FlatMonitor
from holdfast.shell.scenario import read_scenario
from holdfast.shell.schema import Table
from holdfast.shell.service.checkpoint import digest
from holdfast.shell.service.clock import SourceClock
from holdfast.shell.service.config import FleetKeys, LiveConfig
from holdfast.shell.service.fleet.engine import FleetEngine
from holdfast.shell.service.fleet.group import Group
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
from holdfast.shell.service.sources import Counters, Source

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
    begin, labels, owner = _prepared(config, keys, allow_python)
    return BuiltFleet(begin(), labels, owner)


def build_fleet_parts(config: LiveConfig, built: BuiltFleet, stop: Callable[[], None]) -> Parts:
    """Everything that the configuration names. Raises `InputError`."""
    sources = tuple(
        _source(table, i, built.labels, config) for i, table in enumerate(config.sources, 1)
    )
    counters = [source.counters for source in sources]
    return Parts(sources, _sinks(config, [built.engine], counters), None, ())


def build_group(config: LiveConfig, keys: FleetKeys, shards: int, allow_python: bool) -> Group:
    """One process of several that share the fleet. Raises `InputError`."""
    begin, labels, owner = _prepared(config, keys, allow_python)
    table, *more = config.sources
    if more:
        raise InputError(config.path, "source", f"{len(config.sources)} of them", "one")
    source: Any = _checked_source(table, config)
    if source.topic.count("{shard}") != 1:
        raise table.error("topic", shown(source.topic), "a topic with {shard} in it")
    # both checked with the file
    assert config.checkpoint is not None
    assert keys.prefix is not None
    check_topic(table, keys.prefix)
    at_work: list[FleetEngine] = []
    counters = Counters()
    return Group(
        broker_of(table, source, config), source.topic, keys.prefix, shards,
        config.folder / config.checkpoint.file, config.checkpoint.every, owner, begin,
        batch_decoder(labels, source.trust), list(_sinks(config, at_work, [counters])), at_work,
        counters,
    )  # fmt: skip


def _prepared(
    config: LiveConfig, keys: FleetKeys, allow_python: bool
) -> tuple[Callable[[], FleetEngine], Labels, str]:
    """What makes engines that share a compiled step, their labels, and whose their state is."""
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
    clock, retire = config.clock, math.ceil(keys.retire / plant.dt)
    stepping = Stepping(flat, keys.most)

    def begin() -> FleetEngine:
        timing = Timing(plant.dt, clock.grace, SourceClock(clock.rule == "arrival", clock.jump))
        return FleetEngine(
            labels, stepping.beside(), timing, Members(keys.most), config.fallback.after, retire
        )

    return begin, labels, digest(found.source, config.source_text)


def _checked_source(table: Table, config: LiveConfig) -> Any:
    table.kind(["mqtt"])
    return table.checked(_SourceKeys)


def _source(table: Table, number: int, labels: Labels, config: LiveConfig) -> Source:
    from holdfast.shell.service.mqtt import MqttSource

    keys = _checked_source(table, config)
    broker = broker_of(table, keys, config)
    check_topic(table, keys.topic)
    topics = {keys.topic: batch_decoder(labels, keys.trust)}
    return MqttSource(f"mqtt[{number}]", broker, topics, LIMIT)


def _sinks(
    config: LiveConfig, engines: list[FleetEngine], counters: list[Counters]
) -> tuple[Sink, ...]:
    from holdfast.shell.service.mqtt import MqttSink

    sinks: list[Sink] = []
    for number, table in enumerate(config.sinks, 1):
        kind = table.kind(["mqtt"])
        keys: Any = table.checked(MqttSinkKeys)
        said = partial(_said, engines, counters, _Due())
        broker = broker_of(table, keys, config)
        sinks.append(MqttSink(f"{kind}[{number}]", broker, said, keys.prefix, keys.capacity))
    if config.events is not None:
        from holdfast.shell.service.event_log import EventLog

        sinks.append(EventLog(config.events))
    return tuple(sinks)


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


def _said(
    engines: list[FleetEngine], counters: list[Counters], due: _Due, told: Told
) -> Iterable[tuple[str, bytes]]:
    yield "estimates", estimates_frame(told)
    if due():
        yield "status", dumps(status_of(engines, counters, told))


def status_of(engines: list[FleetEngine], counters: list[Counters], told: Told) -> dict[str, Any]:
    """How the fleet does, in a few numbers; ``told``: its last rows."""
    found: Counter[str] = Counter(plants=0, alarms=0, silent=0, put_aside=0, jumps=0)
    for engine in engines:
        at = engine.members.taken
        found["plants"] += len(at)
        found["alarms"] += int(np.sum(engine.alarms.open[at]))
        found["silent"] += int(np.sum(engine.silent.open[at]))
        found["put_aside"] += engine.timing.put_aside
        found["jumps"] += engine.timing.jumps
        found.update(dataclasses.asdict(engine.counts))
    for counted in counters:
        found.update(dataclasses.asdict(counted))
    blind = int(np.sum(~np.isfinite(told.threshold)))
    return {"frame": int(told.frame[0]), "shards": len(engines), "blind": blind, **found}
