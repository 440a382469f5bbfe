"""Standard input and standard output: a line each, and no broker needed."""

import asyncio
import os
import sys
import threading
from collections.abc import Callable
from typing import BinaryIO

from holdfast.shell.service.records import Event, Labels, Row, Samples
from holdfast.shell.service.saying import dumps, event_object, row_object
from holdfast.shell.service.sinks import Sink
from holdfast.shell.service.sources import Counters, Source, Take
from holdfast.shell.service.wire import LIMIT

CHUNK = 64 * 1024


class LineSource(Source):
    """Lines of an open file, standard input unless told: JSON objects, or CSV after a header."""

    def __init__(
        self, name: str, decode: Callable[[bytes], Samples | None], file: BinaryIO | None = None
    ):
        self.name, self.counters = name, Counters()
        self._decode, self._file = decode, file

    async def run(self, take: Take) -> None:
        """Hand on every line until the input is closed."""
        loop = asyncio.get_running_loop()
        # two chunks at most wait to be worked on: a fast writer is slowed down, not buffered
        chunks: asyncio.Queue[bytes] = asyncio.Queue(2)
        file = self._file or sys.stdin.buffer

        def read() -> None:
            # a thread of its own that nobody waits for: reading cannot be interrupted
            try:
                while chunk := os.read(file.fileno(), CHUNK):
                    asyncio.run_coroutine_threadsafe(chunks.put(chunk), loop).result()
                asyncio.run_coroutine_threadsafe(chunks.put(b""), loop).result()
            except (OSError, RuntimeError, asyncio.CancelledError):
                return

        threading.Thread(target=read, name=self.name, daemon=True).start()
        rest, skipping = b"", False
        while chunk := await chunks.get():
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                if skipping:
                    skipping = False
                else:
                    self._line(line, take)
            if len(rest) > LIMIT:
                self.counters.rejected += not skipping
                rest, skipping = b"", True
        if rest and not skipping:
            self._line(rest, take)

    def _line(self, line: bytes, take: Take) -> None:
        if not line.strip():
            return
        self.counters.messages += 1
        samples = self._decode(line)
        if samples is None:
            # a header of CSV is no sample and no fault
            self.counters.rejected += not line.lstrip().startswith((b"time,", b'"time"'))
        else:
            take(samples)


class LineSink(Sink):
    """A JSON object per row, and per event, to standard output; stops when nobody reads."""

    def __init__(self, name: str, labels: Labels, closed: Callable[[], None]):
        self.name = name
        self._labels, self._closed = labels, closed
        self._open = True

    def row(self, row: Row) -> None:
        """Write a row's line."""
        self._write(dumps(row_object(row, self._labels)))

    def event(self, event: Event) -> None:
        """Write an event's line: {"event": {..}}."""
        self._write(dumps({"event": event_object(event)}))

    def flush(self) -> None:
        """Hand on what the system holds."""
        if self._open:
            self._guarded(sys.stdout.buffer.flush)

    async def stop(self) -> None:
        """The same, at the end."""
        self.flush()

    def _write(self, line: bytes) -> None:
        if self._open:
            self._guarded(lambda: sys.stdout.buffer.write(line + b"\n"))

    def _guarded(self, write: Callable[[], object]) -> None:
        try:
            write()
        except (BrokenPipeError, ValueError):
            self._open = False
            # the interpreter would complain when it closes the broken pipe
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            self._closed()
