"""A fleet as it is run: batches from a real broker, batches to it, state that goes on."""

import asyncio
import json
import os
import signal
import sqlite3
from functools import partial

import aiomqtt
import numpy as np
import pytest

from brokers import Mosquitto, until
from holdfast.loop import replay
from holdfast.records import Observation
from holdfast.shell.errors import InputError
from holdfast.shell.files import load_scenario
from holdfast.shell.service.config import read_config
from holdfast.shell.service.fleet.building import build_fleet, build_fleet_parts
from holdfast.shell.service.fleet.wire import Batch, batch_frame, read_estimates
from holdfast.shell.service.serve import Service
from shell_samples import SCENARIO

CONFIG = """\
scenario = "scenario.toml"
events = "events.sqlite"
[clock]
rule = "source"
[fleet]
most = 50
[checkpoint]
file = "state"
[[source]]
kind = "mqtt"
port = {port}
topic = "fleet/+/samples"
[[sink]]
kind = "mqtt"
port = {port}
prefix = "out"
"""
PLANTS, STEPS = 20, 40


@pytest.fixture
def broker(tmp_path):
    """A broker that is stopped whatever happens."""
    found = Mosquitto(tmp_path).start()
    yield found
    found.stop()


@pytest.fixture
def folder(tmp_path, broker):
    """A scenario and a configuration."""
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    (tmp_path / "live.toml").write_text(CONFIG.format(port=broker.port))
    return tmp_path


def logs():
    """For every plant, inputs and outputs row by row; one has a GPS that is 5 m off at the end."""
    rng = np.random.default_rng(0)
    values = np.concatenate(
        [np.zeros((PLANTS, STEPS, 1)), rng.normal(size=(PLANTS, STEPS, 1)) * 0.5,
         rng.normal(size=(PLANTS, STEPS, 1)) * 0.05], axis=2,
    )  # fmt: skip
    values[3, 25:, 1] += 5.0
    return values


async def played(broker, folder, values, rows, rubbish=()):
    """A service that gets these rows in two messages each; what it said."""
    config = read_config(str(folder / "live.toml"))
    built = build_fleet(config, config.fleet, False)
    service = Service(config, built, partial(build_fleet_parts, config, built))
    running = asyncio.create_task(service.run())
    told, events, status = {}, [], []

    def client():
        return aiomqtt.Client("127.0.0.1", broker.port, protocol=aiomqtt.ProtocolVersion.V5)

    async def listen(ready):
        async with client() as listening:
            await listening.subscribe("out/#")
            ready.set()
            async for message in listening.messages:
                kind = message.topic.value.split("/")[1]
                if kind == "estimates":
                    found = read_estimates(message.payload)
                    for i, identity in enumerate(found.ids.tolist()):
                        told[identity, int(found.frame[i])] = found.x[i], bool(found.alarm[i])
                else:
                    (events if kind == "event" else status).append(message.payload)

    ready = asyncio.Event()
    listening = asyncio.create_task(listen(ready))
    await ready.wait()
    async with client() as sender:
        await until(lambda: service._sources[0].connected)
        for message in rubbish:
            await sender.publish("fleet/bad/samples", message)
        for k in rows:
            for part in (range(0, PLANTS, 2), range(1, PLANTS, 2)):
                at = np.array(part)
                all_there, none = np.ones((len(at), 3), bool), np.zeros((len(at), 2), bool)
                ids = at.astype(np.uint64)
                batch = Batch(k * 0.1, ids, values[at, k - 1], all_there, none)
                await sender.publish(f"fleet/{at[0]}/samples", batch_frame(batch))
        await until(lambda: len(told) == PLANTS * len(rows))
    rejected = service._sources[0].counters.rejected
    os.kill(os.getpid(), signal.SIGTERM)
    await running
    listening.cancel()
    await asyncio.gather(listening, return_exceptions=True)
    return told, rejected, status


def test_through_a_broker_and_after_a_restart_every_plant_is_its_replay(broker, folder):
    values = logs()
    first, rejected, status = asyncio.run(
        played(broker, folder, values, range(1, 21), [b"", b"HFF1", b"x" * 100])
    )
    assert rejected == 3
    status = json.loads(status[0])
    assert (status["plants"], status["rejected"]) == (PLANTS / 2, 3)
    second, _, _ = asyncio.run(played(broker, folder, values, range(21, STEPS + 1)))
    scenario = load_scenario(folder / "scenario.toml")
    for i in range(PLANTS):
        expected = replay(scenario.monitor, Observation.of(values[i, :, :1], values[i, :, 1:]))
        both = [(first | second)[i, k] for k in range(1, STEPS + 1)]
        np.testing.assert_allclose([x for x, _ in both], expected.estimate.x, rtol=0, atol=1e-10)
        assert [alarm for _, alarm in both] == np.asarray(expected.verdict.alarm).tolist()
    with sqlite3.connect(folder / "events.sqlite") as base:
        spoofed = base.execute(
            "SELECT frame FROM events WHERE kind = 'alarm' AND subject = '3' AND state = 'begin' "
            "AND frame >= 25"
        ).fetchall()
        states = base.execute("SELECT state FROM events WHERE kind = 'service' ORDER BY id")
        assert [state for (state,) in states] == ["started", "restarted"]
    assert [frame for (frame,) in spoofed] == [26]


def prepared(folder):
    """All that is done before anything is started."""
    config = read_config(str(folder / "live.toml"))
    built = build_fleet(config, config.fleet, False)
    return build_fleet_parts(config, built, lambda: None)


@pytest.mark.parametrize(("old", "new", "words"), [
    ("most = 50", "most = 0", ["fleet.most", "0"]),
    ("most = 50", "mosd = 50", ["fleet.mosd", "most"]),
    ("most = 50", "most = 10000000", ["fleet.most", "GiB", "or fewer"]),
    ("most = 50", 'prefix = "group"', ["fleet.shards", "no prefix"]),
    ("[checkpoint]", "[sensors]\nlevel = 1e-3\n[checkpoint]", ["sensors", "a fleet has"]),
    ('rule = "source"', 'late = "refilter"', ["clock.late", "a fleet has"]),
    ('topic = "fleet/+/samples"', "", ["source[1].topic"]),
    ('topic = "fleet/+/samples"', 'topic = "a+b"', ["source[1].topic", "wildcards"]),
    ('kind = "mqtt"\nport = {port}\ntopic = "fleet/+/samples"', 'kind = "stdin"',
     ["source[1].kind", "mqtt"]),
])  # fmt: skip
def test_bad_configuration_is_refused(tmp_path, monkeypatch, old, new, words):
    monkeypatch.setattr("holdfast.shell.service.fleet.building.MOST_BYTES", 10**8)
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    assert old in CONFIG
    (tmp_path / "live.toml").write_text(CONFIG.replace(old, new).replace("{port}", "1"))
    with pytest.raises(InputError) as refused:
        prepared(tmp_path)
    for word in words:
        assert word in str(refused.value)
