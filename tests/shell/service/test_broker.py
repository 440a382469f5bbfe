"""Brokers that want to know who we are, refuse us, keep our messages, or meet a fault of ours."""

import asyncio
import getpass
import shutil
import ssl
import subprocess

import pytest

from brokers import Mosquitto, until
from holdfast.shell.service.broker import Broker
from holdfast.shell.service.mqtt import MqttSink, MqttSource, said_of
from holdfast.shell.service.wire import single
from live_rows import LABELS, row

SECRET = "correct horse battery staple"


def program_of(name):
    """Where a program is that not everybody has."""
    return shutil.which(name) or pytest.skip(f"no {name}: install the distribution's package")


def mosquitto(folder, *lines):
    """A broker with these lines of configuration, and with the right to read a test's files."""
    found = Mosquitto(folder)
    found.configure(f"user {getpass.getuser()}", *(lines or ["allow_anonymous true"]))
    return found.start()


@pytest.fixture
def guarded(tmp_path):
    """A broker that knows one user."""
    passwords = tmp_path / "passwords"
    subprocess.run(
        [program_of("mosquitto_passwd"), "-b", "-c", str(passwords), "us", SECRET], check=True
    )
    found = mosquitto(tmp_path, "allow_anonymous false", f"password_file {passwords}")
    yield found
    found.stop()


def source_of(broker, topic="in"):
    return MqttSource("mqtt[1]", broker, {topic: single("y:gps")})


async def cancelled(*tasks):
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


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

    async def play():
        source = source_of(them)
        task = asyncio.create_task(source.run(lambda _: None))
        await until(lambda: source.counters.disconnects >= 3)
        await cancelled(task)
        return source

    assert not asyncio.run(play()).connected
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
            source = source_of(Broker(port=server.sockets[0].getsockname()[1]))
            task = asyncio.create_task(source.run(lambda _: None))
            await until(lambda: source.counters.disconnects >= 2)
            await cancelled(task)
        return source

    assert not asyncio.run(play()).connected
    told = capfd.readouterr().err
    assert told.count("no right to subscribe to in: Not authorized; trying again") == 1


def test_what_a_fault_of_ours_raises_is_not_lost(tmp_path):
    """Not taken for a broken connection, after which all would go on without the message."""
    broker = mosquitto(tmp_path)

    def take(_):
        raise ZeroDivisionError("a fault of ours")

    async def play():
        here = Broker(port=broker.port)
        source = source_of(here)
        task = asyncio.create_task(source.run(take))
        await until(lambda: source.connected)
        async with here.connection(lambda *_: None) as sender:
            await sender.publish("in", b"1.5", 0)
            async with asyncio.timeout(10):
                await task

    try:
        with pytest.raises(ZeroDivisionError, match="a fault of ours"):
            asyncio.run(play())
    finally:
        broker.stop()


def test_what_comes_while_we_are_away_is_kept(tmp_path):
    """With a name and qos 1, as docs/live.md says."""
    broker = mosquitto(tmp_path)
    us = Broker(port=broker.port, client_id="holdfast-1", qos=1)

    async def play():
        taken = []
        for round_ in range(3):
            source = source_of(us)
            task = asyncio.create_task(source.run(lambda s: taken.append(s.values["y:gps"])))
            await until(lambda s=source: s.connected)
            await until(lambda n=20 * round_: len(taken) == n)
            async with Broker(port=broker.port).connection(lambda *_: None) as sender:
                for number in range(10):
                    await sender.publish("in", f"{20 * round_ + number}".encode(), 1)
                await until(lambda n=20 * round_ + 10: len(taken) == n)
                await cancelled(task)
                for number in range(10, 20):
                    await sender.publish("in", f"{20 * round_ + number}".encode(), 1)
        return taken

    try:
        assert asyncio.run(play()) == list(range(50))
    finally:
        broker.stop()


@pytest.fixture
def certified(tmp_path):
    """A broker with a certificate for 127.0.0.1, and the authority that signed it."""
    key, request = tmp_path / "broker.key", tmp_path / "broker.csr"
    authority, signed = tmp_path / "authority.pem", tmp_path / "broker.pem"

    program = program_of("openssl")

    def openssl(*words):
        subprocess.run([program, *map(str, words)], check=True, capture_output=True)

    def made(place, name):
        openssl("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
                "-nodes", "-days", 2, "-subj", f"/CN={name}", "-keyout", f"{place}.key",
                "-out", place)  # fmt: skip

    made(authority, "a test's authority")
    made(tmp_path / "other.pem", "another authority")
    openssl("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes",
            "-subj", "/CN=broker", "-keyout", key, "-out", request)  # fmt: skip
    (tmp_path / "names").write_text("subjectAltName=IP:127.0.0.1")
    openssl("x509", "-req", "-in", request, "-CA", authority, "-CAkey", f"{authority}.key",
            "-CAcreateserial", "-days", 2, "-extfile", tmp_path / "names",
            "-out", signed)  # fmt: skip
    found = mosquitto(tmp_path, "allow_anonymous true", f"certfile {signed}", f"keyfile {key}")
    yield found, authority, tmp_path / "other.pem"
    found.stop()


def test_an_encrypted_broker(certified):
    broker, authority, _ = certified
    us = Broker(port=broker.port, tls=ssl.create_default_context(cafile=str(authority)))
    sink = MqttSink("mqtt[1]", us, said_of(LABELS), "out", capacity=60)
    source = source_of(us, "out/estimate")
    asyncio.run(round_trip(source, sink))
    assert source.counters.messages == 1


# paho leaves the socket of a failed handshake to the garbage collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_broker_that_nobody_vouches_for(certified, capfd):
    broker, _, other = certified

    async def play():
        source = source_of(
            Broker(port=broker.port, tls=ssl.create_default_context(cafile=str(other)))
        )
        task = asyncio.create_task(source.run(lambda _: None))
        await until(lambda: source.counters.disconnects >= 2)
        await cancelled(task)
        return source

    assert not asyncio.run(play()).connected
    assert "CERTIFICATE_VERIFY_FAILED" in capfd.readouterr().err
