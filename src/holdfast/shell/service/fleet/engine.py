"""Batches in, batches and events out: a plant's estimate is what `replay` gives it alone.

No clock, no network, no file: time is an argument. A fleet has no life cycle of sensors and no
filter beside the estimator: a plant whose estimate has failed begins anew, and says so.
"""

import dataclasses
import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from holdfast.records import Reason, Status
from holdfast.shell.service.engine import SILENT, SILENT_ROWS
from holdfast.shell.service.episodes import event
from holdfast.shell.service.fallback import FAILED
from holdfast.shell.service.fleet.conditions import Conditions
from holdfast.shell.service.fleet.members import Members
from holdfast.shell.service.fleet.stepping import Stepping
from holdfast.shell.service.fleet.timing import Timing
from holdfast.shell.service.fleet.wire import Batch, Told
from holdfast.shell.service.records import Event, Labels

CAUGHT_UP = 10**7
"""Rows of plants that a silence before a restart may be made up for with."""
SHOWN = 5
"""Plants that an event about many of them names."""


@dataclasses.dataclass
class Counts:
    """What the fleet has met since the service was first started, in plants' rows."""

    rows: int = 0
    late: int = 0
    """Rows for a frame that had closed, or that came twice."""
    empty: int = 0
    """Frames of a plant in which nothing arrived."""
    turned_away: int = 0
    """Rows of plants for which there is no place."""
    begun_anew: int = 0


class Worked(NamedTuple):
    """What a call came to."""

    rows: list[Told]
    events: list[Event]


class FleetEngine:
    """Every ``now`` is a clock that only goes forward, in seconds.

    ``after``: rows after which a failed estimate begins anew; ``retire``: rows without a sample
    after which a plant is given up.
    """

    def __init__(
        self, labels: Labels, stepping: Stepping, timing: Timing, members: Members,
        after: int, retire: int,
    ):  # fmt: skip
        self.labels, self.timing, self.members = labels, timing, members
        self.counts = Counts()
        self._stepping, self._flat = stepping, stepping.flat
        self._after, self._retire = after, retire
        most, nu = members.most, len(labels.inputs)
        hold = max(10, round(SILENT / labels.dt))
        self.alarms, self.silent = Conditions(most, hold), Conditions(most, hold)
        self._silent_rows = max(SILENT_ROWS, math.ceil(SILENT / labels.dt))
        self._last = np.zeros(most, int)
        """The number of each plant's last frame."""
        self._u = np.zeros((most, nu))
        """The last inputs that were numbers."""
        self._unheard = np.zeros(most, int)
        self._failed = np.zeros(most, int)

    @property
    def closed(self) -> int:
        """The number of the newest frame."""
        return self.timing.newest

    @property
    def newest(self) -> float:
        """The newest stamp that was believed."""
        return self.timing.clock.newest

    def next_deadline(self) -> float:
        """Our clock's time when a frame closes whatever comes; inf if that is not known."""
        return self.timing.next_deadline()

    def take(self, batch: Batch, now: float) -> Worked:
        """Take a message; the rows that it closes."""
        worked = Worked([], [])
        for number, believed in self.timing.take(batch, now):
            self._tell_jump(number, believed.time, worked)
            self._place(number, believed, worked)
        # by the newest stamp alone: while messages wait to be read our clock is ahead of them
        self._close(-math.inf, worked)
        return worked

    def advance(self, now: float) -> Worked:
        """The rows that time has closed."""
        worked = Worked([], [])
        self._close(now, worked)
        return worked

    def finish(self) -> Worked:
        """Nothing is held back: every message closes its rows."""
        return Worked([], [])

    def _place(self, number: int, batch: Batch, worked: Worked) -> None:
        # of two rows of one plant in a message the first counts
        _, first = np.unique(batch.ids, return_index=True)
        places, new = self.members.places(batch.ids[first])
        self._join(number, batch.time, places[new], worked)
        room = places >= 0
        self.counts.turned_away += int(np.sum(~room))
        self.counts.late += len(batch.ids) - len(first)
        places, first = places[room], first[room]
        self._fill(places, number - 1, worked)
        ahead = self._last[places] < number
        self.counts.late += int(np.sum(~ahead))
        places, first = places[ahead], first[ahead]
        nu = len(self.labels.inputs)
        seen, values = batch.seen[first], batch.values[first]
        u = np.where(seen[:, :nu], values[:, :nu], self._u[places])
        held = np.any(~seen[:, :nu], axis=1, keepdims=True)[:, 0]
        self._step(places, number, batch.time, u, held, values[:, nu:], seen[:, nu:],
                   batch.trusted[first], worked)  # fmt: skip

    def _join(self, number: int, time: float, places: np.ndarray, worked: Worked) -> None:
        if not len(places):
            return
        self._stepping.begin(places)
        self._last[places] = number - 1
        self._u[places] = 0.0
        self._unheard[places] = self._failed[places] = 0
        self.alarms.forget(places)
        self.silent.forget(places)
        worked.events.append(self._event_of_many(number, time, places, "joined", "new"))

    def _close(self, now: float, worked: Worked) -> None:
        self._fill(self.members.taken, self.timing.closed(now), worked)

    def _fill(self, places: np.ndarray, number: int, worked: Worked) -> None:
        """Nothing arrived for these plants in the frames up to ``number`` that they lack."""
        ny = len(self.labels.outputs)
        while len(places := places[self._last[places] < number]):
            frame = int(self._last[places].min()) + 1
            at = places[self._last[places] == frame - 1]
            nothing = np.zeros((len(at), ny), bool)
            held = np.full(len(at), bool(self.labels.inputs))
            self.counts.empty += len(at)
            self._step(at, frame, self.timing.time(frame), self._u[at], held,
                       np.zeros((len(at), ny)), nothing, nothing, worked)  # fmt: skip

    def _step(
        self, places: np.ndarray, number: int, time: float, u: np.ndarray, held: np.ndarray,
        y: np.ndarray, seen: np.ndarray, trusted: np.ndarray, worked: Worked,
    ) -> None:  # fmt: skip
        if not len(places):
            return
        self._u[places] = np.where(np.isfinite(u), u, self._u[places])
        self._last[places] = number
        self.counts.rows += len(places)
        outcomes = self._stepping.step(places, np.concatenate([u, y, seen, trusted], axis=1))
        told = self._told(places, number, time, outcomes, held)
        worked.rows.append(told)
        self._tell_alarms(places, number, time, told, worked)
        self._tell_silence(places, number, time, seen, worked)
        self._begin_failed_anew(places, number, time, told, worked)

    def _told(
        self, places: np.ndarray, number: int, time: float, outcomes: np.ndarray, held: np.ndarray
    ) -> Told:
        def field(name: str) -> np.ndarray:
            return self._flat.field(outcomes, name)

        def spread(name: str) -> np.ndarray:
            return np.sqrt(np.maximum(np.diagonal(field(name), axis1=1, axis2=2), 0.0))

        def known(values: np.ndarray, sd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            told = np.isfinite(sd)
            return np.where(told, values, math.nan), np.where(told, sd, math.nan)

        count = len(places)
        x, x_sd = known(field("x"), spread("x_cov"))
        d, d_sd = known(field("d"), spread("d_cov"))
        status = field("status") | np.where(held, int(Status.MISSING), 0)
        return Told(
            self.members.ids[places], np.full(count, number), np.full(count, time), x, x_sd,
            d, d_sd, field("statistic"), field("threshold"), status, field("alarm"),
            field("reason"),
        )  # fmt: skip

    def _tell_jump(self, number: int, time: float, worked: Worked) -> None:
        if self.timing.jumped:
            reason = f"the source's clock jumped by {self.timing.jumped:.6g} s"
            worked.events.append(event(number, time, "clock", "", "jumped", reason))
            self.timing.jumped = 0.0

    def _tell_alarms(
        self, places: np.ndarray, number: int, time: float, told: Told, worked: Worked
    ) -> None:
        begins, ends = self.alarms.take(places, told.frame, told.alarm)
        for i in np.flatnonzero(begins):
            reason = Reason(int(told.reason[i])).words
            worked.events.append(
                event(number, time, "alarm", str(told.ids[i]), "begin", reason,
                      float(told.statistic[i]), float(told.threshold[i]))
            )  # fmt: skip
        self._tell_ends(number, time, "alarm", told.ids[ends], worked)

    def _tell_silence(
        self, places: np.ndarray, number: int, time: float, seen: np.ndarray, worked: Worked
    ) -> None:
        self._unheard[places] = np.where(seen.any(axis=1), 0, self._unheard[places] + 1)
        quiet = self._unheard[places] >= self._silent_rows
        frames = np.full(len(places), number)
        begins, ends = self.silent.take(places, frames, quiet)
        reason = f"no sample for {self._silent_rows * self.labels.dt:.3g} s"
        for identity in self.members.ids[places[begins]]:
            worked.events.append(event(number, time, "source", str(identity), "begin", reason))
        self._tell_ends(number, time, "source", self.members.ids[places[ends]], worked)
        gone = places[self._unheard[places] >= self._retire]
        if len(gone):
            worked.events.append(self._event_of_many(number, time, gone, "retired", "silent"))
            self.members.leave(gone)

    def _tell_ends(
        self, number: int, time: float, kind: str, ids: Iterable[Any], worked: Worked
    ) -> None:
        worked.events.extend(event(number, time, kind, str(i), "end", "") for i in ids)

    def _begin_failed_anew(
        self, places: np.ndarray, number: int, time: float, told: Told, worked: Worked
    ) -> None:
        failed = (told.status & FAILED) != 0
        self._failed[places] = np.where(failed, self._failed[places] + 1, 0)
        anew = self._failed[places] >= self._after
        if not anew.any():
            return
        self._stepping.begin(places[anew])
        self._failed[places[anew]] = 0
        self.counts.begun_anew += int(np.sum(anew))
        for identity, status in zip(told.ids[anew], told.status[anew], strict=True):
            reason = Status(int(status) & FAILED).words
            worked.events.append(event(number, time, "mode", str(identity), "reset", reason))

    def _event_of_many(
        self, number: int, time: float, places: np.ndarray, state: str, word: str
    ) -> Event:
        ids = self.members.ids[places]
        names = ", ".join(map(str, ids[:SHOWN])) + (", ..." if len(ids) > SHOWN else "")
        # several messages of one frame may each bring some
        subject = str(ids[0]) if len(ids) == 1 else f"{ids[0]} and {len(ids) - 1} more"
        return event(number, time, "source", subject, state, f"{len(ids)} {word}: {names}")

    def held(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """What a checkpoint keeps: words and numbers, and arrays."""
        at = self.members.taken
        arrays = {
            "places": at, "ids": self.members.ids[at], "states": self._stepping.held(at),
            "last": self._last[at], "u": self._u[at], "unheard": self._unheard[at],
            "failed": self._failed[at], "alarm": self.alarms.open[at],
            "alarm_last": self.alarms.last[at], "silent": self.silent.open[at],
            "silent_last": self.silent.last[at],
        }  # fmt: skip
        return {"timing": self.timing.held(), "counts": dataclasses.asdict(self.counts)}, arrays

    def restore(self, words: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        """Go on from a checkpoint."""
        self.timing.restore(words["timing"])
        self.counts = Counts(**words["counts"])
        at = arrays["places"]
        self.members.restore(arrays["ids"], at)
        self._stepping.restore(at, arrays["states"])
        self._last[at], self._u[at] = arrays["last"], arrays["u"]
        self._unheard[at], self._failed[at] = arrays["unheard"], arrays["failed"]
        self.alarms.open[at], self.alarms.last[at] = arrays["alarm"], arrays["alarm_last"]
        self.silent.open[at], self.silent.last[at] = arrays["silent"], arrays["silent_last"]

    def resume(self, now: float, elapsed: float) -> None:
        """After `restore`: the plants have gone on for so many seconds, which become rows in which
        nothing arrived; after too many of them their clock counts as one that jumped.
        """
        if 0 <= elapsed / self.labels.dt * len(self.members) <= CAUGHT_UP:
            self.timing.clock.resume(now, elapsed)
