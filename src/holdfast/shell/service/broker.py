"""A broker of MQTT 5: who we are to it, a connection, and what it says when it refuses."""

import asyncio
import contextlib
import dataclasses
import logging
import socket
import ssl
import sys
from collections.abc import Callable, Coroutine, Iterable
from typing import Any, TypeVar

from holdfast.shell.errors import InputError
from holdfast.shell.service.limits import Backoff
from holdfast.shell.service.sources import Counters

KEPT = 3600
"""Seconds for which a broker keeps the messages of a client that has an id and asks for qos 1."""
REFUSED = 128
"""Reason codes from which on the broker has said no."""

Result = TypeVar("Result")
Handle = Callable[[str, bytes], None]
"""Takes a message's topic and what it holds."""


class Broken(Exception):
    """There is no connection, or no longer, and why in words."""


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

    def connection(self, handle: Handle, *, keep: bool = False, will: Any = None) -> "Connection":
        """A connection, to be entered. ``handle`` is given every message as soon as it is read.

        ``keep``: the broker holds messages while we are away; ``will``: what it says for us when
        we are gone.
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
        client = aiomqtt.Client(
            self.host, self.port, username=self.username, password=self.password,
            identifier=self.client_id, protocol=aiomqtt.ProtocolVersion.V5, keepalive=10,
            clean_start=not keep, properties=properties, tls_context=self.tls, logger=quiet,
            will=will, max_queued_outgoing_messages=0, timeout=10.0,
            # small messages one after the other must not wait for what was sent before
            socket_options=[(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)],
        )  # fmt: skip
        return Connection(client, handle)


class Connection:
    """A connection, from entering it to leaving it.

    Whatever breaks it inside leaves as `Broken`; what ``handle`` raises, which is a fault of ours,
    as it is.
    """

    def __init__(self, client: Any, handle: Handle):
        self._client, self._handle = client, handle
        self._failure: Exception | None = None
        # paho's own client: aiomqtt makes a task, a future or an object of its own of every
        # message, which costs as much as a row of the estimator
        self._paho = client._client
        self._paho.on_message = self._received

    async def __aenter__(self) -> "Connection":
        from aiomqtt import MqttError

        ended = self._client._disconnected
        try:
            await self._client.__aenter__()
        except (MqttError, OSError) as error:
            self._paho._sock_close()  # of a broker that does not answer nobody else closes it
            raise Broken(_words(error)) from None
        if ended.done():
            # it broke as soon as it was there: aiomqtt has forgotten, and would wait for ever
            self._paho._sock_close()
            why = ended.exception()
            raise self._failure or Broken("connection closed" if why is None else _words(why))
        # aiomqtt asks for the socket later, when it may have been closed, and its number be that
        # of the next connection: an event loop that has lost its way
        self._paho.on_socket_register_write = self._wants_to_write
        return self

    async def __aexit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        from aiomqtt import MqttError

        ours = self._failure
        if ours is not None:
            # without a farewell, after which the broker would not say our will; aiomqtt takes it
            # for closed, and it would be read for ever
            self._paho._sock_close()
        try:
            await self._client.__aexit__(kind, error, trace)
        except (MqttError, OSError) as beside:
            error = error or beside
        finally:
            ended = self._client._disconnected
            if ended.done() and not ended.cancelled():
                ended.exception()  # or asyncio prints what nobody asked for
        # whoever cancels us wants no more
        if ours is not None and (error is None or isinstance(error, Exception)):
            raise ours
        if isinstance(error, MqttError | OSError):
            raise Broken(_words(error.__cause__ or error)) from None

    async def subscribe(self, topics: Iterable[str], qos: int) -> None:
        """Ask for messages. Raises `Broken` for a topic that the broker refuses."""
        for topic in topics:
            for code in await self.unless_gone(self._client.subscribe(topic, qos=qos)):
                if getattr(code, "value", code) >= REFUSED:
                    raise Broken(f"no right to subscribe to {topic}: {code}")

    async def unsubscribe(self, topic: str) -> None:
        """Ask for no more."""
        await self._client.unsubscribe(topic)

    async def publish(self, topic: str, payload: bytes, qos: int, retain: bool = False) -> None:
        """Send a message; over when it is out (qos 0), or when the broker has it."""
        await self._client.publish(topic, payload, qos=qos, retain=retain)

    def hand_over(self, topic: str, payload: bytes) -> Callable[[], bool]:
        """Put a message (qos 0) where `write` finds it; whether it is out can be asked later."""
        info = self._paho.publish(topic, payload, 0)
        return lambda: info.rc <= 0 and info.is_published()

    def write(self) -> None:
        """Write what the network takes now; the rest follows by itself."""
        with contextlib.suppress(OSError):  # whoever waits for messages notices as well
            self._paho.loop_write()

    async def gone(self) -> None:
        """Wait until the connection breaks, which it always does by raising."""
        try:
            async for _ in self._client.messages:
                pass
        finally:
            if self._failure is not None:
                raise self._failure

    async def unless_gone(self, doing: Coroutine[Any, Any, Result]) -> Result:
        """Do something that waits for the broker; raises as `gone` where that comes first."""
        task, gone = asyncio.create_task(doing), asyncio.create_task(self.gone())
        try:
            await asyncio.wait((task, gone), return_when=asyncio.FIRST_COMPLETED)
            if gone.done():
                gone.result()
            return task.result()
        finally:
            task.cancel()
            gone.cancel()
            await asyncio.gather(task, gone, return_exceptions=True)

    def _wants_to_write(self, client: Any, data: Any, sock: socket.socket) -> None:
        asyncio.get_running_loop().add_writer(sock.fileno(), self.write)

    def _received(self, client: Any, data: Any, message: Any) -> None:
        try:
            topic = message.topic
        except UnicodeDecodeError:
            topic = ""  # nobody's, like others that were not asked for
        try:
            self._handle(topic, message.payload)
        except Exception as error:
            # paho takes it for a broken connection, so that the broker keeps the message; reading
            # on would bring the same one for ever
            self._failure = error
            asyncio.get_running_loop().remove_reader(client.socket().fileno())
            raise


class Attempts:
    """Connecting again and again: what fails is counted, told once, and waited for."""

    def __init__(self, name: str, broker: Broker, counters: Counters):
        self._name = f"{name}: broker {broker.host}:{broker.port}"
        self._counters, self._backoff = counters, Backoff()
        self._told = ""

    def succeeded(self) -> None:
        """Connected, and heard where that was wanted."""
        self._backoff.succeeded()
        if self._told:
            print(f"{self._name}: connected", file=sys.stderr)
        self._told = ""

    async def failed(self, error: Broken, stop: asyncio.Event | None = None) -> None:
        """Count it, say why where that is new, and wait for the next attempt or for ``stop``."""
        self._counters.disconnects += 1
        if self._told != str(error):
            self._told = str(error)
            print(f"warning: {self._name}: {error}; trying again", file=sys.stderr)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for((stop or asyncio.Event()).wait(), self._backoff.pause())


def _words(error: BaseException) -> str:
    if getattr(getattr(error, "rc", None), "value", None) == REFUSED:
        return "connection closed"  # paho's "Unspecified error": it was told no reason
    if str(error) == "Operation timed out":
        return "no answer, which is what one that wants TLS gives without it"
    return str(error) or type(error).__name__


def check_package(file: str, key: str) -> None:
    """Raises `InputError` where the package is not installed."""
    try:
        import aiomqtt  # noqa: F401
    except ImportError:
        raise InputError(file, key, "no package for MQTT", 'pip install "holdfast[mqtt]"') from None
