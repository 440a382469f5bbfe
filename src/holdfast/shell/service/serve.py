"""`holdfast live`: sources to engine to sinks, in one event loop, until told to stop."""

import asyncio
import math
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from holdfast import __version__
from holdfast.shell import runtime
from holdfast.shell.errors import InputError
from holdfast.shell.service.building import build_engine
from holdfast.shell.service.checkpoint import read_checkpoint, write_checkpoint
from holdfast.shell.service.config import LiveConfig, read_config
from holdfast.shell.service.episodes import event
from holdfast.shell.service.parts import Parts, build_parts
from holdfast.shell.service.sinks import Sink
from holdfast.shell.service.sources import Source
from holdfast.shell.service.stopping import stop_on_signals

TICK = 0.05
"""Seconds between two looks at the deadlines where none is known to come sooner."""
SOONEST = 0.0005


def live(path: str, allow_python: bool) -> None:
    """Run the service that a file describes. Raises `InputError`."""
    runtime.configure()
    config = read_config(path)
    if config.fleet is None:
        built = build_engine(config, allow_python)
        asyncio.run(Service(config, built, partial(build_parts, config, built)).run())
        return
    from holdfast.shell.service.fleet.building import (
        build_fleet,
        build_fleet_parts,
        build_group,
    )

    if config.fleet.shards is not None:
        group = build_group(config, config.fleet, config.fleet.shards, allow_python)
        asyncio.run(group.run())
        return
    fleet = build_fleet(config, config.fleet, allow_python)
    asyncio.run(Service(config, fleet, partial(build_fleet_parts, config, fleet)).run())


class Service:
    """What holds the parts together while it runs.

    ``built``: one plant or a fleet. ``parts_of`` makes sources and sinks, given what stops us.
    """

    def __init__(
        self, config: LiveConfig, built: Any, parts_of: Callable[[Callable[[], None]], Parts]
    ):
        self._config, self._owner, self._engine = config, built.owner, built.engine
        self._stop = asyncio.Event()
        self._parts = parts_of(self._stop.set)
        self._sources: Sequence[Source] = self._parts.sources
        self._sinks: Sequence[Sink] = self._parts.sinks

    async def run(self) -> None:
        """Until every source has ended, or a signal comes; the state is kept at the end."""
        stop_on_signals(self._stop)
        resumed = self._resume()
        for sink in self._sinks:
            await sink.start()
        self._greet(resumed)
        sources = [asyncio.create_task(self._sourced(source)) for source in self._sources]
        watches = [asyncio.create_task(self._deadlines()), asyncio.create_task(self._stop.wait())]
        if self._config.checkpoint is not None:
            watches.append(asyncio.create_task(self._checkpoints(self._config.checkpoint.every)))
        try:
            await self._until_over(sources, watches)
        finally:
            ended: list[asyncio.Task[Any]] = [*sources, *watches]
            for task in ended:
                task.cancel()
            await asyncio.gather(*ended, return_exceptions=True)
            self._checkpoint()
            for sink in reversed(self._sinks):
                await sink.stop()

    async def _until_over(
        self, sources: list[asyncio.Task[None]], watches: list[asyncio.Task[Any]]
    ) -> None:
        """Until all sources have ended, somebody says stop, or a part of ours fails."""
        waiting = {*sources, *watches}
        while waiting.intersection(sources):
            done, waiting = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()  # what a part of ours raised is a fault to be seen
            if not done.issubset(sources):
                return
        self._hand_on(self._engine.finish(), time.monotonic())

    async def _sourced(self, source: Source) -> None:
        def take(message: Any) -> None:
            now = time.monotonic()
            self._hand_on(self._engine.take(message, now), now)

        await source.run(take)

    async def _deadlines(self) -> None:
        """Close the frames that nothing completes, unless newer stamps come in: they tell the time
        better than our clock, which does not know what waits to be read.
        """
        newest = -math.inf
        while True:
            now = time.monotonic()
            if self._engine.newest == newest:
                self._hand_on(self._engine.advance(now), now)
            newest = self._engine.newest
            wait = self._engine.next_deadline() - time.monotonic()
            await asyncio.sleep(min(max(wait, SOONEST), TICK))

    async def _checkpoints(self, every: float) -> None:
        while True:
            await asyncio.sleep(every)
            self._checkpoint()

    def _hand_on(self, worked: Any, since: float) -> None:
        if not worked.rows:
            return
        metrics = self._parts.metrics
        if metrics is not None:
            metrics.blind(self._engine.blind)
        for found in worked.events:
            for sink in self._sinks:
                sink.event(found)
        for row in worked.rows:
            for sink in self._sinks:
                sink.row(row)
        if metrics is not None:
            metrics.latency(time.monotonic() - since)

    def _checkpoint(self) -> None:
        keys = self._config.checkpoint
        if keys is None:
            return
        # what the checkpoint calls done must be out before it
        for sink in self._sinks:
            sink.flush()
        words, arrays = self._engine.held()
        positions = {source.name: source.position for source in self._sources}
        beside = {source.name: source.held() for source in self._sources}
        head = {"version": __version__, "positions": positions, "sources": beside,
                "engine": words, "written": time.time()}  # fmt: skip
        try:
            write_checkpoint(self._config.folder / keys.file, self._owner, head, arrays)
        except InputError as error:
            print(f"warning: no checkpoint: {error}", file=sys.stderr)

    def _resume(self) -> bool:
        keys = self._config.checkpoint
        if keys is None:
            return False
        found = read_checkpoint(self._config.folder / keys.file, self._owner)
        if found is None:
            return False
        words, arrays = found
        self._engine.restore(words["engine"], arrays)
        if not any(source.position is not None for source in self._sources):
            # in a log that was played no time has passed
            self._engine.resume(time.monotonic(), time.time() - words["written"])
        for source in self._sources:
            position = words["positions"].get(source.name)
            if position is not None and source.position is not None:
                source.resume(position)
            held = words.get("sources", {}).get(source.name)
            if held is not None:
                source.restore(held)
        return True

    def _greet(self, resumed: bool) -> None:
        frame = self._engine.closed
        state = "restarted" if resumed else "started"
        reason = f"after frame {frame}" if resumed else f"holdfast {__version__}"
        found = event(frame, math.nan, "service", "", state, reason)
        # every start is an event of its own
        found = found._replace(key=f"{found.key}/{time.time_ns()}")
        for sink in self._sinks:
            sink.event(found)
        for line in self._parts.told:
            print(line, file=sys.stderr)
