"""Bounds on what a stream may ask of the service: how often it speaks, how soon it is called."""

import random
import time


class RateLimit:
    """A bucket of ``rate`` messages that fills in a second; what finds it empty is not let in."""

    def __init__(self, rate: float):
        self._rate, self._left, self._at = rate, rate, time.monotonic()

    def allow(self, now: float) -> bool:
        """Whether a message may pass at ``now`` (`time.monotonic`)."""
        self._left = min(self._rate, self._left + self._rate * (now - self._at))
        self._at = now
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Backoff:
    """Pauses between attempts: from ``first`` on, each about twice as long, at most ``longest``."""

    def __init__(self, first: float = 0.1, longest: float = 10.0):
        self._first, self._longest, self._next = first, longest, first
        self._since: float | None = None

    def pause(self) -> float:
        """Seconds until the next attempt; up to half of it is chance, so that a crowd disperses.

        They are short again after a success that lasted longer than the pause would be: who is
        let in and at once thrown out again must not come back ten times a second.
        """
        if self._since is not None and time.monotonic() - self._since > self._next:
            self._next = self._first
        self._since = None
        found, self._next = self._next, min(2 * self._next, self._longest)
        return found * random.uniform(0.5, 1.0)

    def succeeded(self) -> None:
        """An attempt succeeded, and lasts from now on."""
        if self._since is None:
            self._since = time.monotonic()
