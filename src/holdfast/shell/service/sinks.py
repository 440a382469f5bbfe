"""The interface of every sink."""

from abc import ABC, abstractmethod
from typing import Any

from holdfast.shell.service.records import Event


class Sink(ABC):
    """Where rows and events go. ``name`` tells it from others in events and metrics."""

    name: str

    async def start(self) -> None:  # noqa: B027  (most need nothing)
        """Open what is needed. Raises `InputError` where that cannot be."""

    @abstractmethod
    def row(self, row: Any) -> None:
        """Take a row, of a plant (`Row`) or of a fleet (`Told`); never waits, and never raises on
        what happens outside.
        """

    @abstractmethod
    def event(self, event: Event) -> None:
        """Take an event; the same."""

    def flush(self) -> None:  # noqa: B027
        """Make what was taken durable: called before a checkpoint says that it was."""

    async def stop(self) -> None:  # noqa: B027
        """Send on what is held, and close."""
