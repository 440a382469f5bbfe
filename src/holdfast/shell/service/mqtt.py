"""MQTT 5: samples from topics, rows and events to topics; the broker may come and go."""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from holdfast.shell.service.broker import Attempts, Broken, Broker, Connection
from holdfast.shell.service.limits import RateLimit
from holdfast.shell.service.records import Event, Labels, Row
from holdfast.shell.service.saying import dumps, event_object, row_object
from holdfast.shell.service.sinks import Sink
from holdfast.shell.service.sources import Counters, Source, Take
from holdfast.shell.service.wire import LIMIT

RATE = 50_000
"""Messages a second that are looked at; more are counted and left alone."""
EVENTS = 10_000
"""Events held while there is no broker."""
UNDER_WAY = 64
"""Messages of rows given to the network that are not out yet, at most."""
SOON = 0.005
"""Seconds until a network that was full is tried again."""
LAST = 2.0
"""Seconds that are taken at the end to send what is held."""


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
        # a share of a subscription: $share/NAME/PATTERN
        self._patterns = {
            topic.split("/", 2)[2] if topic.startswith("$share/") else topic: decode
            for topic, decode in self._topics.items()
        }
        self._limit = RateLimit(RATE)

    async def run(self, take: Take) -> None:
        """Hand on messages for ever; connect again whenever the connection breaks.

        Raises what ``take`` raises, which is a fault of ours.
        """
        attempts = Attempts(self.name, self._broker, self.counters)
        handle = partial(self._message, take)
        while True:
            try:
                async with self._broker.connection(handle, keep=True) as connection:
                    await connection.subscribe(self._topics, self._broker.qos)
                    attempts.succeeded()
                    self.connected = True
                    await connection.gone()
            except Broken as error:
                self.connected = False
                await attempts.failed(error)

    def _message(self, take: Take, topic: str, payload: bytes) -> None:
        self.counters.messages += 1
        decode = self._decoder(topic)
        samples = None
        if isinstance(payload, bytes) and len(payload) <= self._longest and decode is not None:
            samples = decode(payload) if self._limit.allow(time.monotonic()) else None
        if samples is None:
            self.counters.rejected += 1
        else:
            take(samples)

    def _decoder(self, topic: str) -> Callable[[bytes], Any] | None:
        found = self._topics.get(topic)
        return found if found is not None else self._by_pattern(topic)

    def _by_pattern(self, topic: str) -> Callable[[bytes], Any] | None:
        from paho.mqtt.client import topic_matches_sub

        return next((d for p, d in self._patterns.items() if topic_matches_sub(p, topic)), None)


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
        self._under_way: deque[tuple[tuple[str, bytes], Callable[[], bool]]] = deque()
        """Messages of rows given to the network, with what tells whether they are out."""
        self._events: deque[tuple[str, bytes]] = deque()
        self._capacity = capacity
        self._waiting = asyncio.Event()
        self._connection: Connection | None = None
        self._coming_back = False
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Begin to connect; rows are taken from now on."""
        self._task = asyncio.create_task(self._send())

    def row(self, row: Any) -> None:
        """Take a row, and send it at once where that can be."""
        for topic, message in self._said(row):
            if len(self._rows) + len(self._under_way) >= self._capacity and self._rows:
                self._rows.popleft()
                self.counters.lost += 1
            self._rows.append((f"{self._prefix}/{topic}", message))
        if self._broker.qos:
            self._waiting.set()
        else:
            self._write_rows()

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
                while self._rows or self._events or self._under_way:
                    self._write_rows()
                    await asyncio.sleep(0.01)
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _send(self) -> None:
        attempts = Attempts(self.name, self._broker, self.counters)
        while True:
            try:
                async with self._broker.connection(lambda *_: None) as connection:
                    attempts.succeeded()
                    await self._send_by(connection)
            except Broken as error:
                await attempts.failed(error)

    async def _send_by(self, connection: Connection) -> None:
        """Publish whatever comes until the connection breaks."""
        try:
            await connection.unless_gone(self._publish(connection))
        finally:
            self._connection = None
            self._take_back()

    async def _publish(self, connection: Connection) -> None:
        await self._emptied(connection)  # the oldest news
        self._connection = connection
        self._write_rows()
        while True:
            await self._waiting.wait()
            await self._emptied(connection)

    def _write_rows(self) -> None:
        """Give rows to the network without waiting for it: a task for every message would cost
        more than the row, and would wait until those who read pause.
        """
        connection = self._connection
        if connection is None or self._broker.qos:
            return
        while self._rows and len(self._under_way) < UNDER_WAY:
            message = self._rows.popleft()
            self._under_way.append((message, connection.hand_over(*message)))
        connection.write()
        self._count_out()
        if self._under_way and not self._coming_back:
            self._coming_back = True
            asyncio.get_running_loop().call_later(SOON, self._come_back)

    def _come_back(self) -> None:
        self._coming_back = False
        self._write_rows()

    def _count_out(self) -> None:
        while self._under_way and self._under_way[0][1]():
            self._under_way.popleft()
            self.counters.messages += 1

    def _take_back(self) -> None:
        """What was given to a connection that is gone is to be sent again."""
        self._count_out()
        self._rows.extendleft(message for message, _ in reversed(self._under_way))
        self._under_way.clear()

    async def _emptied(self, connection: Connection) -> None:
        """Publish what waits for acknowledgements, events first; each is given up only when it is
        out. One at a time: a broker's small acknowledgements wait for each other.
        """
        self._waiting.clear()
        while held := self._events or (self._rows if self._broker.qos else None):
            message = held[0]
            await connection.publish(*message, qos=1 if held is self._events else self._broker.qos)
            # a full buffer may have dropped it meanwhile
            if held and held[0] is message:
                held.popleft()
            self.counters.messages += 1


_JUDGED = ("statistic", "threshold", "alarm", "reason")
