"""A recorded log as a live stream, at the speed of its time, faster, or as fast as it goes."""

import asyncio

import numpy as np

from holdfast.shell.grid import Log
from holdfast.shell.service.records import Labels, Samples
from holdfast.shell.service.sources import Counters, Source, Take

AT_ONCE = 64
"""Rows handed on before anything else gets its turn."""


class RecordedSource(Source):
    """The rows of a log in order; it can go on after any of them.

    ``speed``: seconds of the log per second; 0 for as fast as it goes.
    """

    def __init__(self, name: str, log: Log, labels: Labels, speed: float):
        self.name, self.counters = name, Counters()
        self._time, self._labels, self._speed = log.time, labels, speed
        seen = log.observation
        # as NumPy arrays: rows of JAX arrays would cost more than the filter
        self._u, self._y = np.asarray(seen.u), np.asarray(seen.y)
        self._seen, self._trusted = np.asarray(seen.seen), np.asarray(seen.trusted)
        self._next = 0

    @property
    def position(self) -> int:
        """The number of rows handed on."""
        return self._next

    def resume(self, position: int) -> None:
        """Go on after so many rows."""
        self._next = position

    async def run(self, take: Take) -> None:
        """Hand on every row until the log is over."""
        loop = asyncio.get_running_loop()
        time = self._time
        begun, first = loop.time(), self._next
        while self._next < len(time):
            row = self._next
            if self._speed:
                wait = (time[row] - time[first]) / self._speed - (loop.time() - begun)
                if wait > 0:
                    await asyncio.sleep(wait)
            elif (row - first) % AT_ONCE == 0:
                await asyncio.sleep(0)
            self._next += 1
            self.counters.messages += 1
            take(self._samples(row))

    def _samples(self, row: int) -> Samples:
        outputs, y = self._labels.outputs, self._y[row].tolist()
        u = self._u[row].tolist()
        values = {f"u:{name}": value for name, value in zip(self._labels.inputs, u, strict=True)}
        values |= {f"y:{outputs[i]}": y[i] for i in np.flatnonzero(self._seen[row])}
        named = frozenset(outputs[i] for i in np.flatnonzero(self._trusted[row]))
        return Samples(float(self._time[row]), values, named, {}, True)
