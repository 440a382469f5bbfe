"""Conditions that come and go, as events with a begin and an end."""

import math
from typing import Any

from holdfast.shell.service.records import Event


class Episodes:
    """Which conditions hold: each begins when it is first met and ends ``hold`` rows after it was
    last met, so that one that flickers is one event and not hundreds.
    """

    def __init__(self, hold: int):
        self._hold = hold
        self._last: dict[tuple[str, str], int] = {}

    @property
    def open(self) -> list[tuple[str, str]]:
        """Kind and subject of the conditions that hold."""
        return list(self._last)

    def met(
        self, frame: int, time: float, kind: str, subject: str, reason: str,
        statistic: float = math.nan, threshold: float = math.nan,
    ) -> list[Event]:  # fmt: skip
        """The condition holds in this row; the event that it begins, if it does."""
        known = (kind, subject) in self._last
        self._last[kind, subject] = frame
        if known:
            return []
        return [event(frame, time, kind, subject, "begin", reason, statistic, threshold)]

    def ended(self, frame: int, time: float) -> list[Event]:
        """The events of conditions that have ended by this row."""
        over = [who for who, last in self._last.items() if frame - last >= self._hold]
        for who in over:
            del self._last[who]
        return [event(frame, time, kind, subject, "end", "") for kind, subject in over]

    def held(self) -> list[Any]:
        """What a checkpoint keeps."""
        return [[*who, last] for who, last in self._last.items()]

    def restore(self, held: list[Any]) -> None:
        """Go on from a checkpoint."""
        self._last = {(str(kind), str(subject)): int(last) for kind, subject, last in held}


def event(
    frame: int, time: float, kind: str, subject: str, state: str, reason: str,
    statistic: float = math.nan, threshold: float = math.nan,
) -> Event:  # fmt: skip
    """An event with the key that it has whenever this row is worked on."""
    key = f"{frame}/{kind}/{subject}/{state}"
    return Event(key, frame, time, kind, subject, state, reason, statistic, threshold)
