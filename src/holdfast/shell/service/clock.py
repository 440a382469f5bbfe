"""The source's time and ours: what time the source has now, how its clock drifts, when it jumps.

The source stamps its samples; the service has a clock that only goes forward. The smallest
difference of the two is a message that nothing held up, so that the source's time now is at least

    max(newest stamp, our clock - smallest difference)

which is what a frame's deadline is held against. A stamp further than ``jump`` from that is put
aside; when ``CONFIRMATIONS`` in a row agree on a new time the clock has jumped, and a single
forged stamp moves nothing.
"""

import math
from typing import Any, Generic, TypeVar

T = TypeVar("T")

CONFIRMATIONS = 5
"""Samples that have to agree on a new time before it is believed."""
WINDOW = 1.0
"""Seconds after which a smallest difference is forgotten if it is not met again (at most twice as
many): a path that has become slower would make every sample late for ever."""
DRIFT_AFTER = 10.0
"""Seconds that a drift is measured over before it is told."""


class Aside(Generic[T]):
    """What came with stamps that nobody expected, until `CONFIRMATIONS` in a row agree."""

    def __init__(self, jump: float):
        self._jump = jump
        self._waiting: list[tuple[float, T]] = []
        self.given_up = 0
        """How many nobody confirmed."""

    def put(self, stamp: float, item: T) -> list[T]:
        """Add one that is no more than ``jump`` from the one before; all of them, if they are
        enough to be believed.
        """
        if self._waiting and abs(stamp - self._waiting[-1][0]) > self._jump:
            self.clear()
        self._waiting.append((stamp, item))
        return self.take() if len(self._waiting) >= CONFIRMATIONS else []

    def take(self) -> list[T]:
        """All that wait, which are believed now."""
        found = [item for _, item in self._waiting]
        self._waiting = []
        return found

    def clear(self) -> None:
        """A stamp that was expected came between: those that wait are false."""
        self.given_up += len(self._waiting)
        self._waiting = []


class SourceClock:
    """Of one stream of stamps. Every argument ``now`` is our clock, in seconds."""

    def __init__(self, arrival: bool, jump: float):
        self.arrival, self.jump = arrival, jump
        self.newest = -math.inf
        """The newest stamp that was believed."""
        self.difference = math.inf
        """The smallest of our clock less the stamp, of late."""
        self._before, self._since, self._begun = math.inf, math.inf, -math.inf
        """Of the window before, of this one, and when this one began."""
        self._first: tuple[float, float] | None = None
        self._drift = 0.0

    def now(self, now: float) -> float:
        """The time that the source has now, as far as is known; -inf before the first stamp."""
        if not self.arrival or not math.isfinite(self.difference):
            return self.newest
        return max(self.newest, now - self.difference)

    def far(self, stamp: float, now: float) -> float:
        """How far a stamp is from the time expected, beyond what is allowed; 0 where it is not."""
        if not math.isfinite(self.newest):
            return 0.0
        apart = stamp - self.now(now)
        return apart if abs(apart) > self.jump else 0.0

    def believe(self, stamp: float, now: float) -> None:
        """Take up a stamp."""
        self.newest = max(self.newest, stamp)
        difference = now - stamp
        if now - self._begun > WINDOW:
            self._before, self._since, self._begun = self._since, math.inf, now
        self._since = min(self._since, difference)
        self.difference = min(self._before, self._since)
        if self._first is None:
            self._first = (stamp, difference)
        elif stamp - self._first[0] >= DRIFT_AFTER:
            self._drift = (self.difference - self._first[1]) / (stamp - self._first[0])

    @property
    def drift(self) -> float:
        """Seconds a second by which the source's clock falls behind ours; 0 until known."""
        return self._drift

    def forget(self) -> None:
        """Start anew, after a jump."""
        self.newest, self.difference = -math.inf, math.inf
        self._before, self._since, self._begun = math.inf, math.inf, -math.inf
        self._first, self._drift = None, 0.0

    def resume(self, now: float, elapsed: float) -> None:
        """After `restore`: so many seconds have passed since the state was kept."""
        if math.isfinite(self.newest):
            self.difference = self._since = now - self.newest - elapsed
            self._begun = now

    def held(self) -> dict[str, Any]:
        """What a checkpoint keeps: our clock is another one after a restart, the stamps are not."""
        return {"newest": self.newest if math.isfinite(self.newest) else None}

    def restore(self, held: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.forget()
        if held["newest"] is not None:
            self.newest = float(held["newest"])
