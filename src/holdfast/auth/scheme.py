"""What every scheme of message authentication offers: seal and open, with the state passed on.

A sender or verifier is settings alone and serves one stream (one sensor). Its state holds what
must survive a restart: the newest freshness value. A verifier that comes back with an older
state accepts what it has accepted before.
"""

from abc import ABC, abstractmethod
from enum import IntEnum
from typing import Any, NamedTuple


class Outcome(IntEnum):
    """What a verifier says of one message; only AUTHENTIC and UNSIGNED hand on a payload."""

    AUTHENTIC = 0
    """The tag is right and the freshness value is new."""
    UNSIGNED = 1
    """A well-formed message without a tag: readable, and anybody's."""
    FORGED = 2
    """A tag that no acceptable freshness value and key explains."""
    REPLAYED = 3
    """The tag is right, but the freshness value is not newer than the last accepted one."""
    STALE = 4
    """The tag is right and never accepted before, but the message is older than allowed."""
    ROLLED_BACK = 5
    """An authentic synchronisation message that would move the freshness value back."""
    UNKNOWN_KEY = 6
    """No key is active at the freshness value of the message."""
    MALFORMED = 7
    """Not a message of this stream."""
    MISSING = 8
    """Nothing arrived (said by the link, never by a verifier)."""

    @property
    def words(self) -> str:
        """The outcome as a report prints it."""
        return self.name.lower().replace("_", " ")


class Opened(NamedTuple):
    """What a message held: ``payload`` is None unless it is AUTHENTIC or UNSIGNED.

    ``freshness`` and ``key``: the value and the id of the key that the tag belongs to, None
    where no tag was right.
    """

    payload: bytes | None
    outcome: Outcome
    freshness: int | None = None
    key: int | None = None


class Sender(ABC):
    """The sending end of one stream. ``now`` is a clock in the units of the freshness value:
    a tag carries the larger of ``now`` and the last value + 1. Left 0, values only count.
    """

    @property
    @abstractmethod
    def identity(self) -> tuple[int, ...]:
        """What the tag binds a message to beside its content; different for every stream."""

    @abstractmethod
    def start(self, last: int = 0) -> Any:
        """The state in which ``last`` was the newest freshness value used."""

    @abstractmethod
    def seal(self, state: Any, payload: bytes, now: int = 0) -> tuple[Any, bytes]:
        """The message with a tag. Raises `ValueError` if the payload has the wrong length and
        `OverflowError` if there is no freshness value left.
        """

    @abstractmethod
    def plain(self, state: Any, payload: bytes) -> tuple[Any, bytes]:
        """The message without a tag. Raises `ValueError` if the payload has the wrong length."""

    def sync(self, state: Any) -> bytes | None:
        """An authentic statement of the freshness value; None if every message carries it."""
        return None


class Verifier(ABC):
    """The receiving end of one stream. Never raises on a message; one that is not accepted
    leaves the state as it was.
    """

    @property
    @abstractmethod
    def identity(self) -> tuple[int, ...]:
        """As the sender's."""

    @property
    @abstractmethod
    def fresh(self) -> bool:
        """Whether a message that is accepted cannot have been accepted before."""

    @abstractmethod
    def start(self, last: int = 0) -> Any:
        """The state in which ``last`` was the newest freshness value accepted."""

    @abstractmethod
    def open(self, state: Any, message: bytes, now: int = 0) -> tuple[Any, Opened]:
        """What the message holds. ``now``: the verifier's clock, 0 for none."""

    def resync(self, state: Any, message: bytes) -> tuple[Any, Outcome]:
        """Take up a `Sender.sync`; MALFORMED in a scheme that has none."""
        return state, Outcome.MALFORMED


def checked(name: str, found: int, low: int, high: int) -> int:
    """``found`` if it lies in low..high; raises `ValueError` naming the setting if not."""
    if not low <= found <= high:
        raise ValueError(f"{name}: found {found}, expected {low} to {high}")
    return found


def fitting(payload: bytes, length: int) -> bytes:
    """The payload, if it has the stream's length; raises `ValueError` if not."""
    if len(payload) != length:
        raise ValueError(f"payload: found {len(payload)} bytes, expected {length}")
    return payload
