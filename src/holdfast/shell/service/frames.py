"""Samples into frames, one per period: what came late, twice, out of order, or not at all.

Frame k stands for the stamps within half a period of ``origin + k dt``. It closes

    at once           when all of it is there (a whole row, or every column) and it is the next
    at its deadline   half a period and ``grace`` after its time, by the source's clock

and what has not arrived by then did not arrive. Frames close in order, none is left out, and each
only once; what comes for a closed one is late. Of two samples of one column and frame the newer
stamp counts; two of the same stamp that differ are a fault, because nobody knows which one lies.
"""

import dataclasses
import math
from typing import Any, NamedTuple

from holdfast.shell.service.clock import Aside, SourceClock
from holdfast.shell.service.records import Samples

PHASE = 0.01
"""By how much of what a frame is off the grid follows, so that a period that is not quite ``dt``
never loses or doubles a frame."""
AHEAD = 10_000
"""Frames that a silence can be filled with; a longer one is a jump of the clock."""


@dataclasses.dataclass
class Frame:
    """What arrived for one period, by column; ``stamps`` are the samples' own."""

    values: dict[str, float] = dataclasses.field(default_factory=dict)
    stamps: dict[str, float] = dataclasses.field(default_factory=dict)
    trusted: set[str] = dataclasses.field(default_factory=set)
    secured: dict[str, bytes] = dataclasses.field(default_factory=dict)
    whole: bool = False
    time: float = math.nan
    """The stamp of the newest sample; NaN while there is none."""


class Closed(NamedTuple):
    """A frame that has closed: its number, its time, what it holds."""

    number: int
    time: float
    frame: Frame


@dataclasses.dataclass
class Counts:
    """What the frames have met since the service was first started."""

    late: int = 0
    duplicates: int = 0
    conflicts: int = 0
    put_aside: int = 0
    """Samples whose stamp nobody confirmed."""
    jumps: int = 0
    empty: int = 0
    """Frames in which nothing arrived."""


class Frames:
    """Assembles samples; every ``now`` is a clock that only goes forward, in seconds."""

    def __init__(self, dt: float, columns: tuple[str, ...], grace: float, clock: SourceClock):
        self.dt, self.grace, self.clock = dt, grace, clock
        self.counts = Counts()
        self.origin = math.nan
        """The time of frame 0."""
        self.closed = 0
        """The number of the last frame that closed."""
        self.jumped = 0.0
        """By how much the clock jumped before the next frame; whoever tells it sets it to 0."""
        self._columns = frozenset(columns)
        self._open: dict[int, Frame] = {}
        self._started = False
        self._aside: Aside[tuple[Samples, float]] = Aside(clock.jump)

    def take(self, samples: Samples, now: float) -> int | None:
        """Put what a message brought into its frame; the frame's number if it had closed."""
        stamp = samples.time
        if math.isnan(stamp):
            stamp = self.clock.now(now)
            stamp = stamp if math.isfinite(stamp) else now
        if self.clock.far(stamp, now):
            agreed = self._aside.put(stamp, (samples._replace(time=stamp), now))
            self.counts.put_aside = self._aside.given_up
            self._settle(agreed)
            return None
        self._aside.clear()
        self.counts.put_aside = self._aside.given_up
        return self._place(samples, stamp, now)

    def due(self, now: float) -> bool:
        """Whether a frame can close now."""
        return bool(self._open or self._started) and self._next_closes(now)

    def next_deadline(self) -> float:
        """Our clock's time when the next frame closes whatever comes; inf if that is not known."""
        clock = self.clock
        if not clock.arrival or math.isnan(self.origin) or not math.isfinite(clock.difference):
            return math.inf
        return self._deadline(self._first()) + clock.difference

    def close(self, now: float) -> Closed | None:
        """The next frame if it closes now. Ask again until there is none."""
        if not self.due(now):
            return None
        return self._take_out()

    def finish(self) -> Closed | None:
        """The next frame that anything has arrived for, when no more will come."""
        self._settle(self._aside.take())
        return self._take_out() if self._open else None

    def _place(self, samples: Samples, stamp: float, now: float) -> int | None:
        if math.isnan(self.origin):
            self.origin = stamp - (self.closed + 1) * self.dt
        number = round((stamp - self.origin) / self.dt)
        self.clock.believe(stamp, now)
        if self._started and number <= self.closed:
            self.counts.late += 1
            return number
        frame = self._open.setdefault(number, Frame())
        self._merge(frame, samples, stamp)
        return None

    def _merge(self, frame: Frame, samples: Samples, stamp: float) -> None:
        for column, value in samples.values.items():
            before = frame.stamps.get(column)
            if before is not None and before >= stamp:
                same = frame.values[column]
                if before == stamp and same != value and not (same != same and value != value):
                    self.counts.conflicts += 1
                    frame.values[column] = math.nan
                    frame.trusted.discard(column[2:])
                else:
                    self.counts.duplicates += 1
                continue
            frame.values[column] = value
            frame.stamps[column] = stamp
            if column[:2] == "y:":
                (frame.trusted.add if column[2:] in samples.trusted else frame.trusted.discard)(
                    column[2:]
                )
        for name, message in samples.secured.items():
            frame.secured.setdefault(name, message)
        frame.whole = frame.whole or samples.whole or self._columns <= frame.values.keys()
        frame.time = stamp if math.isnan(frame.time) else max(frame.time, stamp)

    def _first(self) -> int:
        """The number of the next frame to close; before the first one the earliest seen."""
        return self.closed + 1 if self._started or not self._open else min(self._open)

    def _deadline(self, number: int) -> float:
        return self.origin + (number + 0.5) * self.dt + self.grace

    def _next_closes(self, now: float) -> bool:
        number = self._first()
        frame = self._open.get(number)
        if self._started and frame is not None and frame.whole:
            return True
        # the first of all waits for its deadline too: an earlier one may still be on its way
        first_at_once = not self._started and frame is not None and frame.whole and not self.grace
        return first_at_once or self.clock.now(now) >= self._deadline(number)

    def _take_out(self) -> Closed:
        if not self._started:
            self._start()
        number = self.closed + 1
        frame = self._open.pop(number, None)
        nominal = self.origin + number * self.dt
        self.closed = number
        if frame is None:
            self.counts.empty += 1
            return Closed(number, nominal, Frame())
        off = frame.time - nominal
        if abs(off) <= self.dt:  # not a frame that was open when the clock jumped
            self.origin += PHASE * off
        return Closed(number, frame.time, frame)

    def _start(self) -> None:
        """Number the frames so that the earliest that was seen is the next."""
        shift = min(self._open) - (self.closed + 1)
        self.origin += shift * self.dt
        self._open = {number - shift: frame for number, frame in self._open.items()}
        self._started = True

    def _settle(self, waiting: list[tuple[Samples, float]]) -> None:
        """Believe samples put aside: a silence that ends, or a clock that has jumped."""
        if not waiting:
            return
        first = min(samples.time for samples, _ in waiting)
        ahead = (first - self.clock.newest) / self.dt
        silence = not self.clock.arrival and 0 < ahead <= AHEAD
        if not silence:
            self.counts.jumps += 1
            self.jumped = first - self.clock.newest
            self.clock.forget()
            last = max(self._open, default=self.closed)
            # what was open keeps its place; the new time goes on after it
            self.origin = first - (last + 1) * self.dt
        for samples, now in waiting:
            self._place(samples, samples.time, now)

    def held(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {
            "origin": None if math.isnan(self.origin) else self.origin,
            "closed": self.closed,
            "started": self._started,
            "jumped": self.jumped,
            "counts": dataclasses.asdict(self.counts),
            "clock": self.clock.held(),
            "open": {str(number): _as_json(frame) for number, frame in self._open.items()},
        }

    def restore(self, held: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.origin = math.nan if held["origin"] is None else float(held["origin"])
        self.closed, self._started = int(held["closed"]), bool(held["started"])
        self.jumped = float(held["jumped"])
        self.counts = Counts(**held["counts"])
        self.clock.restore(held["clock"])
        self._open = {int(number): _from_json(frame) for number, frame in held["open"].items()}
        self._aside.take()
        self._aside.given_up = self.counts.put_aside


def _as_json(frame: Frame) -> dict[str, Any]:
    return {
        "values": {name: repr(value) for name, value in frame.values.items()},
        "stamps": frame.stamps,
        "trusted": sorted(frame.trusted),
        "secured": {name: message.hex() for name, message in frame.secured.items()},
        "whole": frame.whole,
        "time": frame.time,
    }


def _from_json(held: dict[str, Any]) -> Frame:
    return Frame(
        {name: float(text) for name, text in held["values"].items()},
        {name: float(stamp) for name, stamp in held["stamps"].items()},
        set(held["trusted"]),
        {name: bytes.fromhex(text) for name, text in held["secured"].items()},
        bool(held["whole"]),
        float(held["time"]),
    )
