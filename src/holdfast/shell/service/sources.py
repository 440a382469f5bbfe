"""The interface of every source, and what counts what came in."""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from holdfast.shell.service.records import Samples

Take = Callable[[Samples], None]
"""Takes what one message brought; cheap, never waits, never raises."""


@dataclasses.dataclass
class Counters:
    """What a source has met, since the service was first started."""

    messages: int = 0
    """Messages that were read."""
    rejected: int = 0
    """Messages that could not be read, were too long, or came too fast."""
    disconnects: int = 0
    """Connections that broke."""
    lost: int = 0
    """Messages that a full buffer had to leave out."""


class Source(ABC):
    """Where samples come from. ``name`` tells it from others in events and metrics."""

    name: str
    counters: Counters

    @abstractmethod
    async def run(self, take: Take) -> None:
        """Hand on every message until the source ends; reconnect by itself.

        Ends by returning (a log that is over, an input that is closed); is cancelled when the
        service stops. Messages that cannot be read are counted, never raised.
        """

    @property
    def position(self) -> int | None:
        """Up to where the samples handed on go; None where the source cannot go back."""
        return None

    def resume(self, position: int) -> None:
        """Start after this position. Called before `run`, where ``position`` is not None."""
        raise NotImplementedError(f"{self.name} cannot go back")

    def held(self) -> Any:
        """What a checkpoint keeps beside the position, as JSON has it."""
        return None

    def restore(self, held: Any) -> None:
        """Go on from a checkpoint that kept something. Called before `run`."""
        raise NotImplementedError(f"{self.name} keeps nothing")
