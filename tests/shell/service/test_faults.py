"""What a stream must stand: all faults at once, a million messages of rubbish, a broker that
dies."""

import asyncio
import json
import os
import random
import signal
from functools import partial

import aiomqtt
import numpy as np
import pytest

from brokers import Mosquitto, until
from holdfast.loop import replay
from holdfast.records import Observation, Status
from holdfast.shell.service.building import build_engine
from holdfast.shell.service.config import read_config
from holdfast.shell.service.parts import build_parts
from holdfast.shell.service.serve import Service
from holdfast.shell.service.wire import LIMIT, binary_decoder, binary_frame, json_decoder
from live_engines import DT, MONITOR, OUTPUTS, engine, stream, trace_of
from shell_samples import SCENARIO

REACH = 5
"""Frames by which messages are out of order."""
SILENT = 600
"""Rows without the radar: a minute."""
NOT_NUMBERS = [float("nan"), float("inf"), -float("inf"), "off", True, [1], {"a": 1}]


def test_all_faults_at_once_are_counted_and_change_nothing_else():
    """10 % lost, 10 % twice, up to five frames out of order, samples that are no numbers, a sensor
    silent for a minute, a clock that jumps back an hour: the estimates are those of a replay of
    what arrived.
    """
    rng, steps = random.Random(0), 1500
    trace = trace_of(steps)
    u, y = np.array(trace.observation.u), np.array(trace.observation.y)
    seen, lost, bad = np.ones(y.shape, bool), set(), 0
    seen[200 : 200 + SILENT, OUTPUTS.index("radar")] = False
    sent = []
    for k, samples in enumerate(stream(trace)):
        # the clock goes back in the middle; around that nothing is lost, which would be told
        # from a jump by nobody, nor out of order
        calm = abs(k - 1000) < 2 * REACH or k < REACH
        time = samples.time - (3600.0 if k >= 1000 else 0.0)
        found = {"time": time, **samples.values}
        if not seen[k, OUTPUTS.index("radar")]:
            del found["y:radar"]
        if not calm and rng.random() < 0.1:
            lost.add(k)
            seen[k] = False
            continue
        if rng.random() < 0.05:
            i = rng.randrange(5)
            if seen[k, i]:
                found[f"y:{OUTPUTS[i]}"] = rng.choice(NOT_NUMBERS)
                y[k, i], bad = np.nan, bad + 1
        place = k + (0.0 if calm else rng.uniform(0, REACH))
        message = json.dumps(found).encode()
        sent.append((place, message))
        if not calm and rng.random() < 0.1:
            sent.append((place + rng.uniform(0, REACH), message))
    twice = len(sent) - (steps - len(lost))
    running = engine(grace=2 * (REACH + 1) * DT, active=False)
    decode, counts = json_decoder(running.labels), running.frames.counts
    rows, events, again = [], [], 0
    for _, message in sorted(sent):
        before = counts.late + counts.duplicates
        worked = running.take(decode(message), 0.0)
        again += counts.late + counts.duplicates > before
        rows += worked.rows
        events += worked.events
    rows += running.finish().rows

    assert again == twice
    assert (counts.conflicts, counts.put_aside, counts.jumps) == (0, 0, 1)
    assert counts.empty == len(lost)
    assert len(rows) == steps
    assert sum(bool(int(r.estimate.status) & Status.BAD_INPUT) for r in rows) == bad
    assert [e.subject for e in events if e.kind == "source" and e.state == "begin"] == ["radar"]
    held, before = u.copy(), np.zeros(1)
    for k in range(steps):
        held[k] = before = before if k in lost else held[k]
    expected = replay(MONITOR, Observation.of(held, y, seen))
    mine = np.array([row.estimate.x for row in rows])
    np.testing.assert_allclose(mine, expected.estimate.x, rtol=1e-11, atol=1e-11)


def rubbish(rng, messages):
    """A message that somebody has damaged, cut, glued together or made up."""
    message = bytearray(rng.choice(messages))
    deed = rng.randrange(6)
    if deed == 0:
        return bytes(message[: rng.randrange(len(message))])
    if deed == 1:
        return rng.randbytes(rng.randrange(200))
    if deed == 2:
        return bytes(message) + bytes(rng.choice(messages))
    if deed == 3:
        return b"[" * rng.randrange(1, 3000)
    if deed == 4:
        return b"x" * (LIMIT + rng.randrange(3))
    for _ in range(rng.randrange(1, 8)):
        message[rng.randrange(len(message))] = rng.randrange(256)
    return bytes(message)


@pytest.mark.parametrize(
    "count",
    [
        20_000,
        pytest.param(10**6, marks=[pytest.mark.slow, pytest.mark.whole]),
    ],
)
def test_rubbish_does_no_harm(count):
    """Between the rows of a stream: what cannot be read leaves no trace; what can is a stream of
    its own, which may say anything and breaks nothing.
    """
    rng, trace = random.Random(1), trace_of(200)
    labels = engine().labels
    samples = list(stream(trace))
    texts = [json.dumps({"time": s.time, **s.values}).encode() for s in samples]
    frames = [binary_frame(labels, s) for s in samples]
    kinds = [(texts, json_decoder(labels)), (frames, binary_decoder(labels))]
    read, refused, believed = 0, 0, []
    for _ in range(count):
        messages, decode = rng.choice(kinds)
        found = decode(rubbish(rng, messages))
        refused += found is None
        read += found is not None
        if found is not None and len(believed) < 20_000:
            believed.append(found)
    assert refused + read == count
    assert refused > count / 2
    running, now = engine(arrival=True), 0.0
    for found in believed:
        now += DT
        for row in running.take(found, now).rows:
            status = int(row.estimate.status)
            assert np.all(np.isfinite(row.estimate.x)) or status & Status.DIVERGED
    again = engine(active=False)
    clean = [row for s in samples for row in again.take(s, 0.0).rows] + again.finish().rows
    expected = replay(MONITOR, trace.observation)
    mine = np.array([row.estimate.x for row in clean])
    np.testing.assert_allclose(mine, expected.estimate.x, rtol=1e-12, atol=1e-12)


CONFIG = """\
scenario = "scenario.toml"
[clock]
rule = "source"
jump = 1000.0
[sensors]
enabled = false
[[source]]
kind = "mqtt"
port = {port}
topic = "in"
[[sink]]
kind = "mqtt"
port = {port}
prefix = "out"
"""
ROUNDS, EACH = 20, 5


async def through(broker, folder, rounds):
    """Rows, the broker's death, rows, and so on; what came out, and how often it was gone."""
    config = read_config(str(folder / "live.toml"))
    built = build_engine(config, False)
    service = Service(config, built, partial(build_parts, config, built))
    running = asyncio.create_task(service.run())
    source, sink = service._sources[0], service._sinks[0]
    got, k = {}, 0
    for turn in range(rounds):
        client = aiomqtt.Client("127.0.0.1", broker.port, protocol=aiomqtt.ProtocolVersion.V5)
        async with client:
            await client.subscribe("out/estimate", qos=1)

            async def listen(client=client):
                async for message in client.messages:
                    row = json.loads(message.payload)
                    got[row["frame"]] = row

            listening = asyncio.create_task(listen())
            await until(lambda: source.connected, "the source is not there again")
            await until(lambda n=sink.counters: n.disconnects >= turn, "the sink has not noticed")  # noqa: B023
            for _ in range(EACH):
                k += 1
                row = {"time": k / 10, "u:accel": 0.0, "y:gps": 0.1 * k, "y:wheel": 0.0}
                await client.publish("in", json.dumps(row))
            # the last row of a round waits for the next: no stamp says that its time is over
            await until(lambda: len(got) >= k - 1, f"{len(got)} rows of {k}")  # noqa: B023
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)
        if turn < rounds - 1:
            broker.stop()
            await until(lambda: not source.connected, "the source has not noticed")
            broker.start()
    os.kill(os.getpid(), signal.SIGTERM)
    await running
    return got, source.counters, sink.counters


@pytest.mark.parametrize(
    "rounds", [3, pytest.param(ROUNDS + 1, marks=[pytest.mark.slow, pytest.mark.whole])]
)
def test_a_broker_that_is_restarted_again_and_again(rounds, tmp_path):
    """Whatever it was given while it was there comes out, once."""
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    broker = Mosquitto(tmp_path).start()
    (tmp_path / "live.toml").write_text(CONFIG.format(port=broker.port))
    try:
        got, source, sink = asyncio.run(through(broker, tmp_path, rounds))
    finally:
        broker.stop()
    assert sorted(got) == list(range(1, rounds * EACH + 1))[: len(got)]
    assert len(got) >= rounds * EACH - 1
    assert (source.messages, source.rejected, source.lost) == (rounds * EACH, 0, 0)
    assert source.disconnects >= rounds - 1
    assert sink.lost == 0
