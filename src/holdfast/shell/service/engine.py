"""Samples in, rows and events out: frames, estimation, fallback and what an operator is told.

No clock, no network, no file: time is an argument, so that a recorded stream gives the same rows
and the same events whenever it is played.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from holdfast.records import Observation, Reason, Status, Verdict
from holdfast.shell.service.episodes import Episodes, event
from holdfast.shell.service.estimation import Estimation
from holdfast.shell.service.fallback import Fallback
from holdfast.shell.service.frames import AHEAD, Closed, Frames
from holdfast.shell.service.records import Event, Labels, Row, Samples

if TYPE_CHECKING:  # needs the extra "auth"
    from holdfast.shell.service.authenticating import Authentication
else:
    Authentication = Any

INERT = 20
"""Rows in a row without anything to test from which on the detector is called inert."""
SILENT = 1.0
"""Seconds without a sample from which on a sensor is called silent (at least `SILENT_ROWS`)."""
SILENT_ROWS = 5


class Worked(NamedTuple):
    """What a call came to."""

    rows: list[Row]
    events: list[Event]


class Engine:
    """One plant's stream. Every ``now`` is a clock that only goes forward, in seconds."""

    def __init__(
        self, labels: Labels, frames: Frames, estimation: Estimation, fallback: Fallback,
        refilter: int, authentication: Authentication | None = None,
    ):  # fmt: skip
        self.labels, self.frames = labels, frames
        self.refiltered = 0
        self._estimation, self._fallback, self._refilter = estimation, fallback, refilter
        self._authentication = authentication
        hold = max(10, round(SILENT / labels.dt))
        self._episodes = Episodes(hold)
        self._silent_rows = max(SILENT_ROWS, math.ceil(SILENT / labels.dt))
        self._unheard = np.zeros(len(labels.outputs), int)
        self._u = [0.0] * len(labels.inputs)
        """The last inputs that were numbers."""
        self._inert = 0
        self._reset_asked = False

    @property
    def closed(self) -> int:
        """The number of the last frame that closed."""
        return self.frames.closed

    @property
    def newest(self) -> float:
        """The newest stamp that was believed."""
        return self.frames.clock.newest

    def next_deadline(self) -> float:
        """Our clock's time when the next frame closes whatever comes; inf if that is not known."""
        return self.frames.next_deadline()

    def take(self, samples: Samples, now: float) -> Worked:
        """Take a message; the frames that it closes."""
        late = self.frames.take(samples, now)
        if late is not None and self._refilter:
            self._revise(late, samples)
        # by the newest stamp alone: while messages wait to be read our clock is ahead of them
        return self.advance(-math.inf)

    def advance(self, now: float) -> Worked:
        """The frames that time has closed."""
        return self._work(lambda: self.frames.close(now))

    def finish(self) -> Worked:
        """What is left when no more will come."""
        return self._work(self.frames.finish)

    def ask_reset(self) -> None:
        """Begin the estimate anew with the next row, as an operator wants it."""
        self._reset_asked = True

    def _work(self, following: Callable[[], Closed | None]) -> Worked:
        rows: list[Row] = []
        events: list[Event] = []
        while (closed := following()) is not None:
            rows.append(self._row(closed, events))
        return Worked(rows, events)

    def _row(self, closed: Closed, events: list[Event]) -> Row:
        number, time = closed.number, closed.time
        self._tell_clock(number, time, events)
        if self._reset_asked:
            self._reset_asked = False
            self._estimation.reset()
            self._fallback.reset()
            events.append(event(number, time, "service", "", "reset", "an operator asked for it"))
        observation, held, forged = self._observed(closed)
        outcome, changes = self._estimation.step(observation)
        names = self.labels.outputs
        for sensor, state, reason, statistic in changes:
            events.append(
                event(number, time, "sensor", names[sensor], state, reason, statistic,
                      self._estimation.health.threshold)
            )  # fmt: skip
        degraded = self._fallback.degraded
        estimate, verdict = self._fallback.choose(*outcome, observation)
        if held:
            status: Any = np.array(int(estimate.status) | int(Status.MISSING), np.int32)
            estimate = dataclasses.replace(estimate, status=status)
        if self._fallback.degraded != degraded:
            events.append(
                event(number, time, "mode", "", self._fallback.mode, self._fallback.reason)
            )
        if forged and self._authentication is not None:
            verdict = self._authentication.judged(verdict)
        self._tell_alarm(number, time, verdict, forged, events)
        self._tell_silence(number, time, observation, events)
        self._tell_inert(number, time, verdict, events)
        events.extend(self._episodes.ended(number, time))
        seen, y = observation.seen.tolist(), observation.y.tolist()
        measured = tuple(value if here else None for value, here in zip(y, seen, strict=True))
        sensors = tuple(self._estimation.health.states)
        return Row(number, time, estimate, verdict, sensors, self._fallback.mode, measured)

    def _observed(self, closed: Closed) -> tuple[Observation, bool, list[str]]:
        """A frame as the estimator is given it, whether an input had to be held, and the outputs
        whose messages were forged.
        """
        frame, labels = closed.frame, self.labels
        forged: list[str] = []
        values, trusted = frame.values, frame.trusted
        if self._authentication is not None:
            values, trusted, forged = self._authentication.open(closed)
        given = [values.get(f"u:{name}") for name in labels.inputs]
        u = np.array(
            [before if now is None else now for now, before in zip(given, self._u, strict=True)]
        )
        self._u = [
            now if math.isfinite(now) else before
            for now, before in zip(u.tolist(), self._u, strict=True)
        ]
        seen = np.array([f"y:{name}" in values for name in labels.outputs], bool)
        y = np.array([values.get(f"y:{name}", 0.0) for name in labels.outputs])
        believed = np.array([name in trusted for name in labels.outputs], bool)
        return Observation.of(u, y, seen, believed), None in given, forged

    def _revise(self, number: int, samples: Samples) -> None:
        """Put late samples into the row that they belong to, if it is still kept."""
        back = self.frames.closed - number
        if back >= self._refilter or (before := self._estimation.seen(back)) is None:
            return
        y, seen = np.array(before.y), np.array(before.seen)
        u, trusted = np.array(before.u), np.array(before.trusted)
        new = False
        for i, name in enumerate(self.labels.outputs):
            value = samples.values.get(f"y:{name}")
            if value is not None and not seen[i]:
                y[i], seen[i], trusted[i], new = value, True, name in samples.trusted, True
        for i, name in enumerate(self.labels.inputs):
            value = samples.values.get(f"u:{name}")
            if value is not None and not np.isfinite(u[i]):
                u[i], new = value, True
        if new and self._estimation.revise(back, Observation.of(u, y, seen, trusted)) is not None:
            self.refiltered += 1

    def _tell_clock(self, number: int, time: float, events: list[Event]) -> None:
        if self.frames.jumped:
            reason = f"the source's clock jumped by {self.frames.jumped:.6g} s"
            events.append(event(number, time, "clock", "", "jumped", reason))
            self.frames.jumped = 0.0

    def _tell_alarm(
        self, number: int, time: float, verdict: Verdict, forged: list[str], events: list[Event]
    ) -> None:
        if not verdict.alarm:
            return
        reason = Reason(int(verdict.reason)).words
        subject = "+".join(forged)
        events.extend(
            self._episodes.met(number, time, "alarm", subject, reason,
                               float(verdict.statistic), float(verdict.threshold))
        )  # fmt: skip

    def _tell_silence(
        self, number: int, time: float, observation: Observation, events: list[Event]
    ) -> None:
        if observation.seen.all():
            self._unheard[:] = 0
            return
        self._unheard = np.where(observation.seen, 0, self._unheard + 1)
        for i in np.flatnonzero(self._unheard >= self._silent_rows):
            reason = f"no sample for {self._silent_rows * self.labels.dt:.3g} s"
            name = self.labels.outputs[i]
            events.extend(self._episodes.met(number, time, "source", name, reason))

    def _tell_inert(self, number: int, time: float, verdict: Verdict, events: list[Event]) -> None:
        self._inert = 0 if math.isfinite(float(verdict.threshold)) else self._inert + 1
        if self._inert >= INERT:
            reason = f"the detector has had nothing to test for {INERT} rows: it is blind"
            events.extend(self._episodes.met(number, time, "mode", "detector", reason))

    @property
    def blind(self) -> bool:
        """Whether the detector has had nothing to test for some time."""
        return self._inert >= INERT

    def held(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """What a checkpoint keeps: words and numbers, and arrays."""
        estimation, arrays = self._estimation.held()
        fallback, beside = self._fallback.held()
        words = {
            "frames": self.frames.held(),
            "estimation": estimation,
            "fallback": fallback,
            "episodes": self._episodes.held(),
            "u": self._u,
            "unheard": self._unheard.tolist(),
            "inert": self._inert,
            "refiltered": self.refiltered,
            "authentication": self._authentication.held() if self._authentication else None,
        }
        return words, arrays | {"beside": beside}

    def restore(self, words: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        """Go on from a checkpoint."""
        self.frames.restore(words["frames"])
        self._estimation.restore(words["estimation"], arrays)
        self._fallback.restore(words["fallback"], arrays["beside"])
        self._episodes.restore(words["episodes"])
        self._u = [float(value) for value in words["u"]]
        self._unheard = np.array(words["unheard"], int)
        self._inert, self.refiltered = int(words["inert"]), int(words["refiltered"])
        if self._authentication is not None:
            self._authentication.restore(words["authentication"])

    def resume(self, now: float, elapsed: float) -> None:
        """After `restore`: the plant has gone on for so many seconds, which become rows in which
        nothing arrived; after too many of them its clock counts as one that jumped.
        """
        if 0 <= elapsed <= AHEAD * self.labels.dt:
            self.frames.clock.resume(now, elapsed)
