"""The frames of a fleet: one clock for all, and a number for every period.

Frame k stands for the stamps within half a period of ``origin + k dt``. A message is a whole row of
its plants and closes their frame; what has not come by half a period and ``grace`` after the
frame's time, by the source's clock, did not arrive.
"""

import math
from typing import Any

from holdfast.shell.service.clock import Aside, SourceClock
from holdfast.shell.service.fleet.wire import Batch
from holdfast.shell.service.frames import PHASE


class Timing:
    """Every ``now`` is a clock that only goes forward, in seconds."""

    def __init__(self, dt: float, grace: float, clock: SourceClock):
        self.dt, self.grace, self.clock = dt, grace, clock
        self.origin = math.nan
        """The time of frame 0."""
        self.newest = 0
        """The number of the newest frame that a message has come for, or that has closed."""
        self.jumped = 0.0
        """By how much the clock jumped; whoever tells it sets it to 0."""
        self.jumps = 0
        self._aside: Aside[tuple[Batch, float]] = Aside(clock.jump)

    @property
    def put_aside(self) -> int:
        """Messages whose stamp nobody confirmed."""
        return self._aside.given_up

    def take(self, batch: Batch, now: float) -> list[tuple[int, Batch]]:
        """Messages that can be worked on now, with the numbers of their frames."""
        if not self.clock.far(batch.time, now):
            self._aside.clear()
            return [(self._number(batch.time, now), batch)]
        agreed = self._aside.put(batch.time, (batch, now))
        if agreed:
            first = min(waiting.time for waiting, _ in agreed)
            self.jumps += 1
            self.jumped = first - self.clock.newest
            self.clock.forget()
            self.origin = first - (self.newest + 1) * self.dt
        return [(self._number(waiting.time, at), waiting) for waiting, at in agreed]

    def closed(self, now: float) -> int:
        """The number of the last frame whose deadline has passed; -1 if that is not known."""
        time = self.clock.now(now)
        if math.isnan(self.origin) or not math.isfinite(time):
            return -1
        last = math.floor((time - self.grace - self.origin) / self.dt - 0.5)
        self.newest = max(self.newest, last)
        return last

    def next_deadline(self) -> float:
        """Our clock's time when the newest frame closes; inf if that is not known."""
        clock = self.clock
        if not clock.arrival or math.isnan(self.origin) or not math.isfinite(clock.difference):
            return math.inf
        return self.time(self.newest) + self.dt / 2 + self.grace + clock.difference

    def time(self, number: int) -> float:
        """The time of a frame."""
        return self.origin + number * self.dt

    def _number(self, stamp: float, now: float) -> int:
        if math.isnan(self.origin):
            self.origin = stamp - (self.newest + 1) * self.dt
        number = round((stamp - self.origin) / self.dt)
        self.clock.believe(stamp, now)
        self.newest = max(self.newest, number)
        self.origin += PHASE * (stamp - self.time(number))
        return number

    def held(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {
            "origin": None if math.isnan(self.origin) else self.origin,
            "newest": self.newest, "jumps": self.jumps, "put_aside": self.put_aside,
            "clock": self.clock.held(),
        }  # fmt: skip

    def restore(self, held: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.origin = math.nan if held["origin"] is None else float(held["origin"])
        self.newest, self.jumps = int(held["newest"]), int(held["jumps"])
        self._aside.given_up = int(held["put_aside"])
        self.clock.restore(held["clock"])
