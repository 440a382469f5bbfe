"""MQTT 5: samples from topics, rows and events to topics; the broker may come and go."""

import asyncio
import contextlib
import dataclasses
import logging
import socket
import ssl
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from itertools import islice
from typing import Any

from holdfast.shell.errors import InputError
from holdfast.shell.service.limits import Backoff, RateLimit
from holdfast.shell.service.records import Event, Labels, Row
from holdfast.shell.service.saying import dumps, event_object, row_object
from holdfast.shell.service.sinks import Sink
from holdfast.shell.service.sources import Counters, Source, Take
from holdfast.shell.service.wire import LIMIT

RATE = 50_000
"""Messages a second that are looked at; more are counted and left alone."""
KEPT = 3600
"""Seconds for which a broker keeps the messages of a client that has an id and asks for qos 1."""
EVENTS = 10_000
"""Events held while there is no broker."""
BATCH = 10
"""Messages of qos 0 published at once, which costs half of one after the other."""
LAST = 2.0
"""Seconds that are taken at the end to send what is held."""


@dataclasses.dataclass(frozen=True)
class Broker:
    """Where the broker is, and who we are to it."""

    host: str = "127.0.0.1"
    port: int = 1883
    client_id: str | None = None
    username: str | None = None
    password: str | None = dataclasses.field(default=None, repr=False)
    tls: ssl.SSLContext | None = None
    qos: int = 0

    def client(self, *, keep: bool, handle: Callable[[Any], None], will: Any = None) -> Any:
        """A client of aiomqtt. ``keep``: the broker holds messages while we are away; ``will``:
        what it says for us when we are gone.

        ``handle`` is given every message as soon as it is read.
        """
        import aiomqtt
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties = Properties(PacketTypes.CONNECT)
        keep = keep and self.qos > 0 and self.client_id is not None
        if keep:
            properties.SessionExpiryInterval = KEPT
        quiet = logging.getLogger("holdfast.mqtt")
        quiet.disabled = True  # what goes wrong is counted and told, not printed
        return aiomqtt.Client(
            self.host, self.port, username=self.username, password=self.password,
            identifier=self.client_id, protocol=aiomqtt.ProtocolVersion.V5, keepalive=10,
            clean_start=not keep, properties=properties, tls_context=self.tls, logger=quiet,
            will=will,
            queue_type=_direct(handle), max_queued_outgoing_messages=0, timeout=10.0,
            # small messages one after the other must not wait for what was sent before
            socket_options=[(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)],
        )  # fmt: skip


def _direct(handle: Callable[[Any], None]) -> type[asyncio.Queue[Any]]:
    """A queue in which nothing waits: to take messages out costs a task and a future each."""

    class Direct(asyncio.Queue[Any]):
        def put_nowait(self, item: Any) -> None:
            handle(item)

    return Direct


async def gone(client: Any) -> None:
    """Wait until the connection breaks, which aiomqtt tells those who wait for messages.

    Always raises its `MqttError`.
    """
    async for _ in client.messages:
        pass


def check_package(file: str, key: str) -> None:
    """Raises `InputError` where the package is not installed."""
    try:
        import aiomqtt  # noqa: F401
    except ImportError:
        raise InputError(file, key, "no package for MQTT", 'pip install "holdfast[mqtt]"') from None


class MqttSource(Source):
    """Messages of topics, each topic with what reads it; ``limit``: bytes of the longest.

    ``topics`` may hold wildcards; where several of them match, the most specific one counts.
    ``connected``: whether messages come in now.
    """

    def __init__(
        self, name: str, broker: Broker, topics: Mapping[str, Callable[[bytes], Any]],
        limit: int = LIMIT,
    ):  # fmt: skip
        self.name, self.counters = name, Counters()
        self._longest = limit
        self.connected = False
        exact_first = sorted(topics, key=lambda t: ("#" in t, t.count("+"), -t.count("/")))
        self._broker, self._topics = broker, {topic: topics[topic] for topic in exact_first}
        self._limit = RateLimit(RATE)

    async def run(self, take: Take) -> None:
        """Hand on messages for ever; connect again whenever the connection breaks."""
        import aiomqtt

        backoff, handle = Backoff(), partial(self._message, take)
        while True:
            try:
                async with self._broker.client(keep=True, handle=handle) as client:
                    for topic in self._topics:
                        await client.subscribe(topic, qos=self._broker.qos)
                    backoff.succeeded()
                    self.connected = True
                    await gone(client)
            except (aiomqtt.MqttError, OSError):
                self.connected = False
                self.counters.disconnects += 1
                await asyncio.sleep(backoff.pause())

    def _message(self, take: Take, message: Any) -> None:
        self.counters.messages += 1
        payload = message.payload
        decode = self._decoder(message.topic)
        samples = None
        if isinstance(payload, bytes) and len(payload) <= self._longest and decode is not None:
            samples = decode(payload) if self._limit.allow(time.monotonic()) else None
        if samples is None:
            self.counters.rejected += 1
        else:
            take(samples)

    def _decoder(self, topic: Any) -> Callable[[bytes], Any] | None:
        found = self._topics.get(topic.value)
        if found is not None:
            return found
        return next((d for pattern, d in self._topics.items() if topic.matches(pattern)), None)


Said = Callable[[Any], Iterable[tuple[str, bytes]]]
"""Makes of a row its messages: what follows the prefix in their topics, and what they hold."""


def said_of(labels: Labels) -> Said:
    """Of a plant's row: estimate, attack (where one is estimated) and verdict, as JSON."""
    attacks = tuple(name for of in labels.attacks for name in (f"d:{of}", f"d_sd:{of}"))

    def said(row: Row) -> Iterable[tuple[str, bytes]]:
        found = row_object(row, labels)
        judged = {name: found.pop(name) for name in _JUDGED}
        place = {"frame": row.frame, "time": row.time}
        if attacks:
            yield "attack", dumps(place | {name: found.pop(name) for name in attacks})
        yield "estimate", dumps(found)
        yield "verdict", dumps(place | judged)

    return said


class MqttSink(Sink):
    """What ``said`` makes of every row, under PREFIX/, and PREFIX/event/KIND.

    While there is no broker, ``capacity`` messages of rows are held, and then the oldest are
    given up and counted; events have a place of their own, which rows cannot fill.
    """

    def __init__(self, name: str, broker: Broker, said: Said, prefix: str, capacity: int):
        self.name, self.counters = name, Counters()
        self._broker, self._said, self._prefix = broker, said, prefix
        self._rows: deque[tuple[str, bytes]] = deque()
        self._events: deque[tuple[str, bytes]] = deque()
        self._capacity = capacity
        self._waiting = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Begin to connect; rows are taken from now on."""
        self._task = asyncio.create_task(self._send())

    def row(self, row: Any) -> None:
        """Take a row."""
        for topic, message in self._said(row):
            if len(self._rows) >= self._capacity:
                self._rows.popleft()
                self.counters.lost += 1
            self._rows.append((f"{self._prefix}/{topic}", message))
        self._waiting.set()

    def event(self, event: Event) -> None:
        """Take an event."""
        if len(self._events) >= EVENTS:
            self._events.popleft()
            self.counters.lost += 1
        topic = f"{self._prefix}/event/{event.kind}"
        self._events.append((topic, dumps(event_object(event))))
        self._waiting.set()

    async def stop(self) -> None:
        """Send what is held, if that is soon done."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LAST):
                while self._rows or self._events:
                    await asyncio.sleep(0.01)
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _send(self) -> None:
        import aiomqtt

        backoff = Backoff()
        while True:
            try:
                async with self._broker.client(keep=False, handle=lambda _: None) as client:
                    backoff.succeeded()
                    await self._send_by(client)
            except (aiomqtt.MqttError, OSError):
                self.counters.disconnects += 1
                await asyncio.sleep(backoff.pause())

    async def _send_by(self, client: Any) -> None:
        """Publish whatever comes until the connection breaks."""
        watch = asyncio.create_task(self._until_gone(client))
        try:
            while not watch.done():
                await self._waiting.wait()
                await self._emptied(client)
            await watch
        finally:
            watch.cancel()
            await asyncio.gather(watch, return_exceptions=True)

    async def _until_gone(self, client: Any) -> None:
        """Wait until the connection breaks, and wake the one who sends."""
        try:
            await gone(client)
        finally:
            self._waiting.set()

    async def _emptied(self, client: Any) -> None:
        """Publish all that is held, events first; a message is given up only when it is out."""
        self._waiting.clear()
        while held := self._events or self._rows:
            qos = 1 if held is self._events else self._broker.qos
            # a broker's small acknowledgements wait for each other: none of several at once
            batch = list(islice(held, 1 if qos else BATCH))
            found = await asyncio.gather(
                *(client.publish(*message, qos=qos) for message in batch), return_exceptions=True
            )
            for message, failure in zip(batch, found, strict=True):
                if failure is not None:
                    raise failure
                # a full buffer may have dropped it meanwhile
                if held and held[0] is message:
                    held.popleft()
                self.counters.messages += 1


_JUDGED = ("statistic", "threshold", "alarm", "reason")
