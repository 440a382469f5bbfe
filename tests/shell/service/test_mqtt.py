"""Samples from a real broker and rows to it; it goes away, and it is lied to."""

import asyncio
import json

import aiomqtt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brokers import Mosquitto, until
from holdfast.shell.service.broker import Broker
from holdfast.shell.service.limits import RateLimit
from holdfast.shell.service.mqtt import MqttSink, MqttSource, said_of
from holdfast.shell.service.records import Samples
from holdfast.shell.service.wire import binary_decoder, binary_frame, json_decoder, single
from live_rows import LABELS, alarm, row

NAMES = st.sampled_from(["time", "trusted", "secured", "partial", "u:accel", "y:gps", "y:flow"])
VALUES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
JSON = st.dictionaries(NAMES, VALUES | st.lists(VALUES, max_size=3), max_size=5) | VALUES


@pytest.fixture
def broker(tmp_path):
    """A broker that is stopped whatever happens."""
    found = Mosquitto(tmp_path).start()
    yield found
    found.stop()


def client(broker):
    return aiomqtt.Client("127.0.0.1", broker.port, protocol=aiomqtt.ProtocolVersion.V5)


async def received_by(broker, topics, messages):
    """What a source of these topics takes of these messages, and its counters."""
    source, taken = MqttSource("mqtt", Broker(port=broker.port), topics), []
    task = asyncio.create_task(source.run(taken.append))
    async with client(broker) as sender:
        await until(lambda: source.connected)
        for message in messages:
            await sender.publish(*message)
        await until(lambda: source.counters.messages == len(messages))
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    return taken, source.counters


def test_rows_signals_and_rubbish(broker):
    frame = Samples(2.0, {"u:accel": 0.5, "y:gps": 4.25, "y:flow": -1.0}, frozenset({"gps"}),
                    {}, True)  # fmt: skip
    messages = [
        ("rows", b'{"time": 1.0, "u:accel": 0.1, "y:gps": 7, "y:flow": null}'),
        ("frames", binary_frame(LABELS, frame)),
        ("one/gps", b'{"time": 3.0, "value": 8.5}'),
        ("one/gps", b"9.5"),
        ("rows", b'{"time": 4.0, "y:gps": "off", "y:flow": true}'),
        ("rows", b"\xff\xfe"),
        ("rows", b"[" * 50_000),
        ("rows", b'{"time": 1e999, "y:gps": 1}'),
        ("rows", b"x" * 70_000),
        ("frames", binary_frame(LABELS, frame)[:-1]),
        ("one/gps", b"{}"),
    ]
    topics = {
        "rows": json_decoder(LABELS),
        "frames": binary_decoder(LABELS, trust=True),
        "one/+": single("y:gps"),
    }
    taken, counters = asyncio.run(received_by(broker, topics, messages))
    taken = taken[-5:]
    assert taken[0] == Samples(1.0, {"u:accel": 0.1, "y:gps": 7.0}, whole=True)
    assert taken[1] == frame
    assert taken[2] == Samples(3.0, {"y:gps": 8.5})
    assert taken[3].values == {"y:gps": 9.5}
    assert [str(value) for value in taken[4].values.values()] == ["nan", "nan"]
    assert counters.rejected == 6


def test_a_broker_that_comes_and_goes(broker):
    """Rows within the bound all arrive, in order; events are never pushed out; loss is counted."""
    here = Broker(port=broker.port)

    async def play():
        sink, got = MqttSink("mqtt", here, said_of(LABELS), "drone", capacity=60), []
        await sink.start()
        sink.row(row(1))
        await until(lambda: sink.counters.messages == 3)
        # until somebody listens, it looks for the broker where there is none
        sink._broker = Broker(port=1)
        broker.stop()
        await until(lambda: sink.counters.disconnects)
        sink.event(alarm(2))
        for frame in range(2, 52):
            sink.row(row(frame))
        broker.start()
        async with client(broker) as listener:
            await listener.subscribe("drone/#", qos=1)
            sink._broker = here
            async with asyncio.timeout(10):
                async for message in listener.messages:
                    got.append((message.topic.value, json.loads(message.payload)["frame"]))
                    if len(got) == 61:
                        break
        await sink.stop()
        return got, sink.counters

    got, counters = asyncio.run(play())
    # 50 rows are 150 messages; 60 were held, and an event
    assert counters.lost == 90
    assert counters.disconnects >= 1
    assert counters.messages == 64
    assert got[0] == ("drone/event/alarm", 2)
    kinds = ("attack", "estimate", "verdict")
    assert got[1:] == [(f"drone/{kind}", frame) for frame in range(32, 52) for kind in kinds]


def test_the_most_specific_topic_counts():
    topics = {"#": single("y:flow"), "one/+": single("y:gps"), "one/two": single("u:accel")}
    source, taken = MqttSource("mqtt", Broker(), topics), []
    for topic in ("one/two", "one/three", "three", "one/two/three"):
        source._message(taken.append, topic, b"1.0")
    assert [list(one.values) for one in taken] == [["u:accel"], ["y:gps"], ["y:flow"], ["y:flow"]]


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=200) | JSON.map(lambda value: json.dumps(value).encode()))
def test_no_message_does_harm(payload):
    source, taken = MqttSource("mqtt", Broker(), {"rows": json_decoder(LABELS)}), []
    for topic in ("rows", "other"):
        source._message(taken.append, topic, payload)
    assert source.counters.messages == 2
    assert source.counters.rejected + len(taken) == 2
    assert all(set(one.values) <= set(LABELS.columns) for one in taken)


def test_what_comes_too_fast_is_not_read():
    source, taken = MqttSource("mqtt", Broker(), {"one": single("y:gps")}), []
    source._limit = RateLimit(5)
    for _ in range(10):
        source._message(taken.append, "one", b"1.0")
    assert len(taken) == source.counters.rejected == 5


def test_a_row_is_an_estimate_an_attack_and_a_verdict(broker):
    async def play():
        got = {}
        sink = MqttSink("mqtt", Broker(port=broker.port), said_of(LABELS), "drone", capacity=60)
        async with client(broker) as listener:
            await listener.subscribe("drone/#", qos=1)
            await sink.start()
            sink.row(row(3, alarm=True))
            sink.event(alarm(3))
            async with asyncio.timeout(10):
                async for message in listener.messages:
                    got[message.topic.value] = json.loads(message.payload)
                    if len(got) == 4:
                        break
            await sink.stop()
        return got

    got = asyncio.run(play())
    assert got["drone/estimate"]["x:north"] == 3.0
    assert got["drone/estimate"]["x_sd:north"] == 0.5
    assert got["drone/attack"] == {"frame": 3, "time": pytest.approx(0.3), "d:spoof": 0.5,
                                   "d_sd:spoof": 1.0}  # fmt: skip
    assert got["drone/verdict"]["alarm"] == 1
    assert got["drone/verdict"]["reason"] == "measurements contradict the model"
    assert got["drone/event/alarm"]["key"] == "3/alarm/gps/begin"


def test_a_source_finds_its_broker_again(broker):
    async def play():
        source, taken = MqttSource("mqtt", Broker(port=broker.port), {"one": single("y:gps")}), []
        task = asyncio.create_task(source.run(taken.append))
        for round_ in range(3):
            wanted = len(taken) + 1

            async def send(wanted=wanted):
                async with client(broker) as sender:
                    while len(taken) < wanted:
                        await sender.publish("one", b"1.5")
                        await asyncio.sleep(0.02)

            async with asyncio.timeout(20):
                await send()
            if round_ < 2:
                broker.stop()
                await until(lambda k=round_: source.counters.disconnects > k)
                broker.start()
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        return source.counters

    assert asyncio.run(play()).disconnects >= 2
