"""Samples from a real broker and rows to it; it goes away, and it is lied to."""

import asyncio
import json

import aiomqtt
import pytest

from brokers import Mosquitto
from holdfast.shell.service.mqtt import Broker, MqttSink, MqttSource
from holdfast.shell.service.records import Samples
from holdfast.shell.service.wire import binary_decoder, binary_frame, json_decoder, single
from live_rows import LABELS, alarm, row


@pytest.fixture
def broker(tmp_path):
    """A broker that is stopped whatever happens."""
    found = Mosquitto(tmp_path).start()
    yield found
    found.stop()


async def until(condition, seconds=10.0):
    """Wait for something to be so."""
    async with asyncio.timeout(seconds):
        while not condition():
            await asyncio.sleep(0.005)


def client(broker):
    return aiomqtt.Client("127.0.0.1", broker.port, protocol=aiomqtt.ProtocolVersion.V5)


async def received_by(broker, topics, messages):
    """What a source of these topics takes of these messages, and its counters."""
    source, taken = MqttSource("mqtt", Broker(port=broker.port), topics), []
    task = asyncio.create_task(source.run(taken.append))
    async with client(broker) as sender:
        ready = asyncio.create_task(until(lambda: taken))
        while not ready.done():  # until it has subscribed
            await sender.publish(*messages[0])
            await asyncio.sleep(0.02)
        await ready
        before = source.counters.messages
        for message in messages:
            await sender.publish(*message)
        await until(lambda: source.counters.messages >= before + len(messages))
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

    async def play():
        got = []

        async def listen():
            async with client(broker) as listener:
                await listener.subscribe("drone/#", qos=1)
                got.append("listening")
                async for message in listener.messages:
                    got.append((message.topic.value, json.loads(message.payload)))

        sink = MqttSink("mqtt", Broker(port=broker.port), LABELS, "drone", capacity=60)
        await sink.start()
        listening = asyncio.create_task(listen())
        await until(lambda: got)
        sink.row(row(1))
        await until(lambda: len(got) == 4)
        broker.stop()
        await asyncio.gather(listening, return_exceptions=True)
        await until(lambda: sink.counters.disconnects)
        got.clear()
        sink.event(alarm(2))
        for frame in range(2, 52):
            sink.row(row(frame))
        broker.start()
        listening = asyncio.create_task(listen())
        await until(lambda: sum(type(one) is tuple for one in got) >= 1 or not sink._rows)
        await sink.stop()
        listening.cancel()
        await asyncio.gather(listening, return_exceptions=True)
        return got, sink.counters

    got, counters = asyncio.run(play())
    # 50 rows are 150 messages; 60 were held
    assert counters.lost == 90
    assert counters.disconnects >= 1
    frames = [content["frame"] for topic, content in got[1:] if topic == "drone/estimate"]
    assert frames == sorted(frames)


def test_a_row_is_an_estimate_an_attack_and_a_verdict(broker):
    async def play():
        got = {}
        sink = MqttSink("mqtt", Broker(port=broker.port), LABELS, "drone", capacity=60)
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
