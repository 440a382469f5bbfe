"""A process of several that share a fleet: it works on the shards that `Shares` says are its own.

A shard is what comes on one topic. Its state lies in a checkpoint of its own, in a folder that all
processes share, and follows the shard: when a process dies, another reads the checkpoint and goes
on.
"""

import asyncio
import contextlib
import secrets
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from holdfast import __version__
from holdfast.shell.errors import InputError
from holdfast.shell.service.broker import Attempts, Broken, Broker, Connection
from holdfast.shell.service.checkpoint import (
    checkpoint_words,
    read_checkpoint,
    write_checkpoint,
)
from holdfast.shell.service.episodes import event
from holdfast.shell.service.fleet.engine import FleetEngine, Worked
from holdfast.shell.service.fleet.shares import Action, Shares
from holdfast.shell.service.fleet.wire import LIMIT, Batch
from holdfast.shell.service.sinks import Sink
from holdfast.shell.service.sources import Counters
from holdfast.shell.service.stopping import stop_on_signals

TICK = 0.02
"""Seconds between two looks at the deadlines."""
OFFERS = 0.5
"""Seconds between two looks at what nobody owns."""
SETTLED = 1.0
"""Seconds after a connection by which what the broker retains has been heard."""
LAST_WORDS = 1.0
"""Seconds that a process waits for its own words when it leaves."""
NOBODY = b""


class Shard:
    """One shard at work: its engine, and where its state is kept."""

    def __init__(self, engine: FleetEngine, path: Path, owner: str):
        self.engine, self._path, self._owner = engine, path, owner
        found = read_checkpoint(path, owner)
        self.turn = 1 if found is None else int(found[0]["turn"]) + 1
        """How many processes have had this shard, we among them."""
        if found is not None:
            engine.restore(found[0]["engine"], found[1])
            engine.resume(time.monotonic(), time.time() - found[0]["written"])

    def keep(self) -> bool:
        """Write the checkpoint; False where another has the shard by now."""
        found = checkpoint_words(self._path)
        if found is not None and int(found.get("turn", 0)) > self.turn:
            return False
        words, arrays = self.engine.held()
        head = {"version": __version__, "engine": words, "written": time.time(), "turn": self.turn}
        write_checkpoint(self._path, self._owner, head, arrays)
        return True


class Group:
    """``topic``: of the shards' samples, with {shard}; ``prefix``: of what the processes say.

    ``begin`` makes the engine of a shard; ``decode`` reads a message; ``every``: seconds between
    checkpoints, which lie at ``state`` with the shard's number behind it; ``engines`` is kept a
    list of those at work, for whoever tells of them.
    """

    def __init__(
        self, broker: Broker, topic: str, prefix: str, shards: int, state: Path, every: float,
        owner: str, begin: Callable[[], FleetEngine], decode: Callable[[bytes], Batch | None],
        sinks: list[Sink], engines: list[FleetEngine], counters: Counters,
    ):  # fmt: skip
        self.counters = counters
        self.at_work: dict[int, Shard] = {}
        self._engines = engines
        self._broker, self._prefix, self._shards = broker, prefix, shards
        self._state, self._every, self._owner = state, every, owner
        self._begin, self._decode, self._sinks = begin, decode, sinks
        self._topics = {topic.replace("{shard}", str(i)): i for i in range(shards)}
        self._topic_of = {shard: name for name, shard in self._topics.items()}
        self._stop = asyncio.Event()

    async def run(self) -> None:
        """Until a signal comes."""
        stop_on_signals(self._stop)
        for sink in self._sinks:
            await sink.start()
        attempts = Attempts("fleet", self._broker, self.counters)
        try:
            while not self._stop.is_set():
                try:
                    await self._connected(attempts.succeeded)
                except Broken as error:
                    await attempts.failed(error, self._stop)
        finally:
            for sink in reversed(self._sinks):
                await sink.stop()

    async def _connected(self, succeeded: Callable[[], None]) -> None:
        """A connection: a new name, because the broker has said of the old one that it is gone."""
        import aiomqtt

        # words in the order of the broker's, dealt with one after the other
        words: asyncio.Queue[tuple[str, str, bytes]] = asyncio.Queue()
        name = f"{socket.gethostname()}-{secrets.token_hex(6)}"
        shares = Shares(name, self._shards)
        here = f"{self._prefix}/processes/{name}"
        will = aiomqtt.Will(here, NOBODY, qos=1, retain=True)

        def handle(topic: str, payload: bytes) -> None:
            shard = self._topics.get(topic)
            if shard is not None:
                self._take(shard, payload)
            elif topic.startswith(f"{self._prefix}/"):
                kind, of = topic.rsplit("/", 2)[1:]
                words.put_nowait((kind, of, bytes(payload or b"")))

        async with self._broker.connection(handle, will=will) as client:
            await client.publish(here, b"here", qos=1, retain=True)
            patterns = (
                f"{self._prefix}/processes/+", f"{self._prefix}/owners/+",
                f"$share/holdfast/{self._prefix}/offers/+",
            )  # fmt: skip
            await client.subscribe(patterns, 1)
            succeeded()
            tasks = [
                asyncio.create_task(task)
                for task in (
                    self._listen(client, shares, words), self._offer(client, shares),
                    self._deadlines(), self._checkpoints(shares), client.gone(),
                    self._stop.wait(),
                )
            ]  # fmt: skip
            try:
                done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                if self._stop.is_set():
                    await self._leave(client, shares, here)
                for task in done:
                    task.result()
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
                # whoever takes them over has their state, and ours is an old one
                self._gave_up(*self.at_work)

    async def _leave(self, client: Connection, shares: Shares, here: str) -> None:
        """Keep every state, and say that it can be had."""
        await self._do(client, shares, shares.leave())
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LAST_WORDS):
                while shares.waiting:  # what was on its way comes back through `_listen`
                    await asyncio.sleep(TICK)
        await client.publish(here, NOBODY, qos=1, retain=True)

    async def _listen(
        self, client: Connection, shares: Shares, words: "asyncio.Queue[tuple[str, str, bytes]]"
    ) -> None:
        while True:
            kind, of, payload = await words.get()
            if kind == "processes":
                actions = shares.hear_presence(of, payload != NOBODY)
            elif not of.isdecimal() or int(of) >= self._shards:
                continue
            elif kind == "owners":
                actions = shares.hear_owner(int(of), payload.decode("utf-8", "replace"))
            else:
                actions = shares.hear_offer(int(of))
            await self._do(client, shares, actions)

    async def _offer(self, client: Connection, shares: Shares) -> None:
        await asyncio.sleep(SETTLED)
        while True:
            await self._do(client, shares, shares.tick(time.monotonic()))
            await asyncio.sleep(OFFERS)

    async def _do(self, client: Connection, shares: Shares, actions: list[Action]) -> None:
        for kind, shard in actions:
            owner = f"{self._prefix}/owners/{shard}"
            if kind == "offer":
                await client.publish(f"{self._prefix}/offers/{shard}", b"", qos=1)
            elif kind == "claim":
                await client.publish(owner, shares.name.encode(), qos=1, retain=True)
            elif kind == "begin":
                found = self._work_on(shard)
                await client.subscribe([self._topic_of[shard]], self._broker.qos)
                self._tell_taken(shard, found)
            else:
                await client.unsubscribe(self._topic_of[shard])
                dropped = self._gave_up(shard)
                shares.dropped(shard)
                if shares.owns(shard):
                    for was in dropped:
                        self._keep(shard, was)
                    await client.publish(owner, NOBODY, qos=1, retain=True)

    def _work_on(self, shard: int) -> Shard:
        path = self._state.with_name(f"{self._state.name}.{shard}")
        found = self.at_work[shard] = Shard(self._begin(), path, self._owner)
        self._engines.append(found.engine)
        return found

    def _tell_taken(self, shard: int, found: Shard) -> None:
        told = event(found.engine.closed, found.engine.timing.clock.newest, "service",
                     f"shard {shard}", "taken", f"its process number {found.turn}")  # fmt: skip
        told = told._replace(key=f"{told.key}/{found.turn}")
        for sink in self._sinks:
            sink.event(told)

    def _gave_up(self, *shards: int) -> list[Shard]:
        found = [self.at_work.pop(shard) for shard in shards if shard in self.at_work]
        self._engines[:] = [shard.engine for shard in self.at_work.values()]
        return found

    def _take(self, shard: int, payload: Any) -> None:
        self.counters.messages += 1
        at_work = self.at_work.get(shard)
        fits = isinstance(payload, bytes) and len(payload) <= LIMIT
        batch = self._decode(payload) if fits else None
        if batch is None or at_work is None:
            self.counters.rejected += 1
            return
        self._hand_on(at_work.engine.take(batch, time.monotonic()))

    async def _deadlines(self) -> None:
        newest: dict[int, float] = {}
        while True:
            now = time.monotonic()
            for number, shard in list(self.at_work.items()):
                # newer stamps tell the time better than our clock, which does not know what
                # waits to be read
                if newest.get(number) == shard.engine.newest:
                    self._hand_on(shard.engine.advance(now))
                newest[number] = shard.engine.newest
            await asyncio.sleep(TICK)

    async def _checkpoints(self, shares: Shares) -> None:
        while True:
            await asyncio.sleep(self._every)
            for sink in self._sinks:
                sink.flush()
            for number, shard in list(self.at_work.items()):
                if not self._keep(number, shard):
                    # another has it, and this process has not heard of it yet
                    self._gave_up(number)
                    shares.dropped(number)

    def _keep(self, number: int, shard: Shard) -> bool:
        try:
            return shard.keep()
        except InputError as error:
            print(f"warning: no checkpoint of shard {number}: {error}", file=sys.stderr)
            return True

    def _hand_on(self, worked: Worked) -> None:
        for sink in self._sinks:
            for found in worked.events:
                sink.event(found)
            for told in worked.rows:
                sink.row(told)
