"""Counters of the service, as Prometheus asks for them.

Everything is added up in plain numbers as rows pass, and turned into metrics when somebody asks:
a row costs a few microseconds.
"""

import bisect
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from holdfast.shell.service.fallback import NORMAL
from holdfast.shell.service.frames import Counts
from holdfast.shell.service.health import HEALTHY, ISOLATED, PROBATION, SUSPECTED
from holdfast.shell.service.records import Event, Labels, Row
from holdfast.shell.service.sinks import Sink
from holdfast.shell.service.sources import Counters

BUCKETS = (1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0)
"""Upper ends of the latency histogram, in seconds."""
FORGETTING = 0.02
"""Weight of a new row in the mean squared innovation."""
STATES = {HEALTHY: 0, SUSPECTED: 1, ISOLATED: 2, PROBATION: 3}


class Metrics(Sink):
    """``sources``, ``frames``: what they have counted, asked for when somebody asks."""

    def __init__(
        self, labels: Labels, sources: Callable[[], Mapping[str, Counters]],
        frames: Callable[[], tuple[Counts, float]],
    ):  # fmt: skip
        self.name = "metrics"
        self._labels, self._sources, self._frames = labels, sources, frames
        self._rows = self._alarms = 0
        self._events: Counter[str] = Counter()
        self._missing = np.zeros(len(labels.outputs), int)
        self._squares = np.ones(len(labels.outputs))
        self._last: Row | None = None
        self._blind = False
        self._latencies = [0] * (len(BUCKETS) + 1)
        self._latency = 0.0

    def row(self, row: Row) -> None:
        """Count a row."""
        self._rows += 1
        self._alarms += bool(row.verdict.alarm)
        residual: Any = row.estimate.residual
        variance = np.diagonal(np.asarray(row.estimate.residual_cov))
        for i, (value, spread, seen) in enumerate(
            zip(residual.tolist(), variance.tolist(), row.measured, strict=True)
        ):
            self._missing[i] += seen is None
            if 0 < spread < math.inf and math.isfinite(value):
                square = value * value / spread
                self._squares[i] += FORGETTING * (square - self._squares[i])
        self._last = row

    def event(self, event: Event) -> None:
        """Count an event."""
        self._events[event.kind] += 1

    def latency(self, seconds: float) -> None:
        """Count how long a message took to be worked on."""
        self._latencies[bisect.bisect_left(BUCKETS, seconds)] += 1
        self._latency += seconds

    def blind(self, blind: bool) -> None:
        """Note whether the detector has had nothing to test for some time."""
        self._blind = blind

    def exposition(self) -> bytes:
        """All metrics as text."""
        from prometheus_client import CollectorRegistry, generate_latest

        registry = CollectorRegistry(auto_describe=False)
        registry.register(_Collected(self._families))
        return generate_latest(registry)

    def _families(self) -> Iterable[Any]:
        from prometheus_client.core import (
            CounterMetricFamily,
            GaugeMetricFamily,
            HistogramMetricFamily,
        )

        def counter(name: str, told: str, value: float) -> Any:
            return CounterMetricFamily(f"holdfast_{name}", told, value=value)

        def gauge(name: str, told: str, value: float) -> Any:
            return GaugeMetricFamily(f"holdfast_{name}", told, value=value)

        def by(kind: Any, name: str, told: str, label: str, values: Mapping[str, float]) -> Any:
            family = kind(f"holdfast_{name}", told, labels=[label])
            for of, value in values.items():
                family.add_metric([of], value)
            return family

        outputs, last = self._labels.outputs, self._last
        yield counter("rows", "Rows told", self._rows)
        yield counter("alarms", "Rows with an alarm", self._alarms)
        yield by(CounterMetricFamily, "events", "Events by kind", "kind", self._events)
        yield by(CounterMetricFamily, "missing", "Samples that did not arrive", "output",
                 dict(zip(outputs, self._missing.tolist(), strict=True)))  # fmt: skip
        yield by(GaugeMetricFamily, "innovation_nis", "Mean squared innovation over its variance",
                 "output", dict(zip(outputs, self._squares.tolist(), strict=True)))  # fmt: skip
        yield gauge("blind", "1: the detector has nothing to test", self._blind)
        if last is not None:
            yield gauge("alarm", "1: an alarm in the last row", bool(last.verdict.alarm))
            yield gauge("degraded", "1: the estimator has failed", last.mode != NORMAL)
            states = {
                name: STATES[state] for name, state in zip(outputs, last.sensors, strict=True)
            }
            told = "0 healthy, 1 suspected, 2 isolated, 3 on probation"
            yield by(GaugeMetricFamily, "sensor_state", told, "output", states)
        sources = self._sources()
        for name in ("messages", "rejected", "disconnects", "lost"):
            values = {of: getattr(counted, name) for of, counted in sources.items()}
            yield by(CounterMetricFamily, f"source_{name}", f"{name} of a source", "source", values)
        counts, drift = self._frames()
        for name in ("late", "duplicates", "conflicts", "put_aside", "jumps", "empty"):
            yield counter(f"frames_{name}", f"Samples or frames: {name}", getattr(counts, name))
        yield gauge("clock_drift", "Seconds a second that the source's clock falls behind", drift)
        ends = [*map(str, BUCKETS), "+Inf"]
        totals = np.cumsum(self._latencies).tolist()
        yield HistogramMetricFamily(
            "holdfast_latency_seconds", "From a message to its rows handed on",
            buckets=list(zip(ends, totals, strict=True)), sum_value=self._latency,
        )  # fmt: skip


class _Collected:
    """What prometheus_client calls a collector."""

    def __init__(self, families: Callable[[], Iterable[Any]]):
        self._families = families

    def collect(self) -> Iterable[Any]:
        """The metrics of this moment."""
        return self._families()
