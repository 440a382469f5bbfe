"""What flows through the service: samples in, rows and events out."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from holdfast.parts import Plant
from holdfast.records import Estimate, Verdict


class Samples(NamedTuple):
    """What one message brought.

    ``time``: the source's stamp in seconds, NaN where it gives none (then the time of arrival
    counts). ``values``: by column as in a log, `u:NAME` and `y:NAME`; a value that is not
    finite is a fault. ``trusted``: outputs that were authenticated. ``secured``: messages of
    outputs that `holdfast.auth` has to open. ``whole``: the message is a whole row, so that
    what it does not hold did not arrive.
    """

    time: float
    values: Mapping[str, float]
    trusted: frozenset[str] = frozenset()
    secured: Mapping[str, bytes] = {}
    whole: bool = False


class Row(NamedTuple):
    """One frame's outcome: ``frame`` counts from 1 and never goes back, ``time`` is the source's.

    ``estimate``, ``verdict``: NumPy arrays. ``sensors``: the state of each output's life cycle in
    words. ``mode``: "normal", or by which rule the service is degraded. ``measured``: what
    arrived, None where nothing did.
    """

    frame: int
    time: float
    estimate: Estimate
    verdict: Verdict
    sensors: tuple[str, ...]
    mode: str
    measured: tuple[float | None, ...]


class Event(NamedTuple):
    """Something that an operator has to know; it goes to the event log and is never changed.

    ``key`` is the same whenever the same row is worked on again, so that a restart writes no
    event twice. ``kind``: "alarm", "sensor", "clock", "source", "mode" or "service".
    ``subject``: the sensor, source or channel, or "". ``state``: "begin", "end", or the name of
    a state that begins. ``statistic`` and ``threshold`` are NaN where there is none.
    """

    key: str
    frame: int
    time: float
    kind: str
    subject: str
    state: str
    reason: str
    statistic: float = math.nan
    threshold: float = math.nan


class Labels(NamedTuple):
    """The names that go with a row's arrays."""

    plant: str
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attacks: tuple[str, ...]
    """Channels of the estimated attack: none where the estimator estimates none."""

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns that a sample may have."""
        return (*(f"u:{name}" for name in self.inputs), *(f"y:{name}" for name in self.outputs))

    @classmethod
    def of(cls, name: str, plant: Plant, estimate: Any) -> "Labels":
        """Of a plant, and of an estimate of it."""
        channels = plant.attacks[: estimate.d.shape[-1]]
        return cls(name, plant.dt, plant.states, plant.inputs, plant.outputs, channels)
