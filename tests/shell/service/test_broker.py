"""Brokers that want to know who we are, refuse us, keep our messages, or meet a fault of ours."""

import asyncio
import ssl

import pytest

from brokers import Mosquitto, certified, passwords, readable, until
from holdfast.shell.service.broker import Broker
from holdfast.shell.service.mqtt import MqttSink, MqttSource, said_of
from holdfast.shell.service.wire import single
from live_rows import LABELS, alarm, row

SECRET = "correct horse battery staple"


@pytest.fixture
def broker(tmp_path):
    """A broker that is stopped whatever happens."""
    found = Mosquitto(tmp_path)
    yield found
    found.stop()


@pytest.fixture
def guarded(tmp_path, broker):
    """A broker that knows one user."""
    broker.configure(*passwords(tmp_path, "us", SECRET))
    return broker.start()


def source_of(broker, topic="in"):
    return MqttSource("mqtt[1]", broker, {topic: single("y:gps")})


async def cancelled(*tasks):
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def turned_away(broker, times):
    """A source that has tried so often, and is stopped."""
    source = source_of(broker)
    task = asyncio.create_task(source.run(lambda _: None))
    await until(lambda: source.counters.disconnects >= times)
    await cancelled(task)
    return source


async def round_trip(source, sink):
    """A row of the sink's comes to the source; whatever happens both are over then."""
    listening = asyncio.create_task(source.run(lambda _: None))
    await sink.start()
    try:
        await until(lambda: source.connected)
        sink.row(row(1))
        await until(lambda: source.counters.messages, seconds=10)
    finally:
        await sink.stop()
        await cancelled(listening)


def test_a_user_with_a_password(guarded):
    us = Broker(port=guarded.port, username="us", password=SECRET)
    sink = MqttSink("mqtt[1]", us, said_of(LABELS), "out", capacity=60)
    source = source_of(us, "out/estimate")
    asyncio.run(round_trip(source, sink))
    assert source.counters.messages == sink.counters.messages - 2 == 1


@pytest.mark.parametrize("password", [None, "wrong"])
def test_a_user_that_the_broker_does_not_know(guarded, password, capfd):
    """It is told once, without the secret, and tried again."""
    them = Broker(port=guarded.port, username="us", password=password)
    assert not asyncio.run(turned_away(them, 3)).connected
    told = capfd.readouterr().err
    assert told.count("Not authorized; trying again") == 1
    assert f"mqtt[1]: broker 127.0.0.1:{guarded.port}" in told
    assert "wrong" not in told
    assert "wrong" not in repr(them)


async def refusing(reader, writer):
    """As much of a broker as it takes to say no: Mosquitto's own rights let everybody ask."""
    await reader.readuntil(b"MQTT")
    writer.write(bytes.fromhex("20 03 00 00 00"))
    while (await reader.readexactly(1))[0] & 0xF0 != 0x80:
        pass
    await reader.readexactly(1)
    number = await reader.readexactly(2)
    writer.write(bytes.fromhex("90 04") + number + bytes.fromhex("00 87"))
    await reader.read()
    writer.close()


def test_a_topic_that_is_refused_is_no_connection(capfd):
    """Somebody who waits for messages that never come does not know why."""

    async def play():
        async with await asyncio.start_server(refusing, "127.0.0.1", 0) as server:
            return await turned_away(Broker(port=server.sockets[0].getsockname()[1]), 2)

    assert not asyncio.run(play()).connected
    told = capfd.readouterr().err
    assert told.count("no right to subscribe to in: Not authorized; trying again") == 1


def test_a_topic_that_is_refused_is_had_when_the_right_is_given(tmp_path, broker, capfd):
    broker.configure(*readable(tmp_path, "else"))
    broker.start()

    async def play():
        source = source_of(Broker(port=broker.port))
        task = asyncio.create_task(source.run(lambda _: None))
        await until(lambda: source.counters.disconnects >= 2)
        broker.stop()
        readable(tmp_path, "in")
        broker.start()
        await until(lambda: source.connected)
        await cancelled(task)

    asyncio.run(play())
    told = capfd.readouterr().err
    assert told.count("no right to subscribe to in: Not authorized; trying again") == 1
    assert told.endswith(": connected\n")


def failing(calls):
    """What takes messages, and is broken."""

    def take(_):
        calls.append(None)
        raise ZeroDivisionError("a fault of ours")

    return take


async def sent(broker, numbers):
    """Numbers to the topic "in", with qos 1."""
    async with Broker(port=broker.port).connection(lambda *_: None) as sender:
        for number in numbers:
            await sender.publish("in", f"{number}".encode(), 1)


def test_what_a_fault_of_ours_raises_is_not_lost(broker, capfd):
    """Not taken for a broken connection, after which all would go on without the message."""
    broker.start()
    calls = []

    async def play():
        source = source_of(Broker(port=broker.port))
        task = asyncio.create_task(source.run(failing(calls)))
        await until(lambda: source.connected)
        await sent(broker, range(3))
        async with asyncio.timeout(10):
            await task

    with pytest.raises(ZeroDivisionError, match="a fault of ours"):
        asyncio.run(play())
    assert len(calls) == 1
    assert capfd.readouterr().err == ""


def test_a_fault_in_messages_that_were_kept_is_not_lost(broker, capfd):
    """They come with the connection itself, before the topics have been asked for again."""
    broker.start()
    us = Broker(port=broker.port, client_id="holdfast-1", qos=1)
    calls, taken = [], []

    async def play():
        source = source_of(us)
        task = asyncio.create_task(source.run(taken.append))
        await until(lambda: source.connected)
        await cancelled(task)
        await sent(broker, range(3))
        with pytest.raises(ZeroDivisionError):
            async with asyncio.timeout(5):
                await source_of(us).run(failing(calls))
        # nobody has said that it was had
        task = asyncio.create_task(source_of(us).run(taken.append))
        await until(lambda: len(taken) == 3)
        await cancelled(task)

    asyncio.run(play())
    assert len(calls) == 1
    assert [one.values["y:gps"] for one in taken] == [0, 1, 2]
    assert capfd.readouterr().err == ""


async def closing(reader, writer):
    """A broker that lets everybody in and out at once."""
    await reader.readuntil(b"MQTT")
    writer.write(bytes.fromhex("20 03 00 00 00"))
    writer.close()


def test_a_connection_that_is_closed_as_it_opens_is_noticed(capfd):
    """aiomqtt forgets such a one, and would wait for ever."""

    async def play():
        async with await asyncio.start_server(closing, "127.0.0.1", 0) as server:
            here = Broker(port=server.sockets[0].getsockname()[1])
            sink = MqttSink("mqtt[1]", here, said_of(LABELS), "out", capacity=60)
            await sink.start()
            sink.row(row(1))
            await until(lambda: sink.counters.disconnects >= 2, seconds=5)
            await cancelled(sink._task)

    asyncio.run(play())
    assert capfd.readouterr().err.count("connection closed; trying again") == 1


def test_a_broker_that_dies_before_it_has_said_that_it_had_an_event(capfd):
    """It is noticed at once, not when the time for an answer is over; the event is sent again."""
    got = []

    async def deaf(reader, writer):
        await reader.readuntil(b"MQTT")
        writer.write(bytes.fromhex("20 03 00 00 00"))
        await reader.readuntil(b"out/event/alarm")
        got.append(None)
        writer.close()

    async def play():
        async with await asyncio.start_server(deaf, "127.0.0.1", 0) as server:
            here = Broker(port=server.sockets[0].getsockname()[1])
            sink = MqttSink("mqtt[1]", here, said_of(LABELS), "out", capacity=60)
            await sink.start()
            sink.event(alarm(1))
            await until(lambda: len(got) >= 2, seconds=5)
            await cancelled(sink._task)

    asyncio.run(play())


def test_what_comes_while_we_are_away_is_kept(broker):
    """With a name and qos 1, as docs/live.md says."""
    broker.start()
    us = Broker(port=broker.port, client_id="holdfast-1", qos=1)

    async def play():
        taken = []
        for first in (0, 20, 40):
            source = source_of(us)
            task = asyncio.create_task(source.run(lambda s: taken.append(s.values["y:gps"])))
            await until(lambda s=source: s.connected)
            await until(lambda n=first: len(taken) == n)
            await sent(broker, range(first, first + 10))
            await until(lambda n=first + 10: len(taken) == n)
            await cancelled(task)
            await sent(broker, range(first + 10, first + 20))
        return taken

    assert asyncio.run(play()) == list(range(50))


@pytest.fixture
def encrypted(tmp_path, broker):
    """A broker with a certificate for 127.0.0.1, who signed it, and somebody else."""
    found = certified(tmp_path)
    broker.configure("allow_anonymous true", *found.lines)
    broker.start()
    return broker, found.authority, found.other


def test_an_encrypted_broker(encrypted):
    broker, authority, _ = encrypted
    us = Broker(port=broker.port, tls=ssl.create_default_context(cafile=str(authority)))
    sink = MqttSink("mqtt[1]", us, said_of(LABELS), "out", capacity=60)
    source = source_of(us, "out/estimate")
    asyncio.run(round_trip(source, sink))
    assert source.counters.messages == 1


# paho leaves the socket of a failed handshake to the garbage collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(("host", "right", "why"), [
    ("127.0.0.1", False, "unable to get local issuer certificate"),
    ("localhost", True, "Hostname mismatch"),
])  # fmt: skip
def test_a_broker_that_nobody_vouches_for(encrypted, capfd, host, right, why):
    """By the wrong authority, or under another name."""
    broker, authority, other = encrypted
    tls = ssl.create_default_context(cafile=str(authority if right else other))

    assert not asyncio.run(turned_away(Broker(host, broker.port, tls=tls), 2)).connected
    told = capfd.readouterr().err
    assert told.count("CERTIFICATE_VERIFY_FAILED") == told.count(why) == 1
