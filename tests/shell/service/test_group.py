"""Processes that share a fleet over a real broker: one is killed, and its shards live on."""

import asyncio
import json
import subprocess
import sys
from pathlib import Path

import aiomqtt
import numpy as np
import pytest

from brokers import Mosquitto, until
from holdfast.loop import replay
from holdfast.records import Observation
from holdfast.shell.files import load_scenario
from holdfast.shell.service.fleet.wire import Batch, batch_frame, read_estimates
from shell_samples import SCENARIO

HOLDFAST = str(Path(sys.executable).with_name("holdfast"))
SHARDS, PLANTS = 6, 4
CONFIG = f"""\
scenario = "scenario.toml"
[clock]
rule = "source"
jump = 100.0
[fleet]
most = {PLANTS}
shards = {SHARDS}
prefix = "group"
[checkpoint]
file = "state"
every = 0.2
[[source]]
kind = "mqtt"
port = {{port}}
topic = "samples/{{{{shard}}}}"
[[sink]]
kind = "mqtt"
port = {{port}}
prefix = "out"
"""


@pytest.fixture
def broker(tmp_path):
    """A broker that is stopped whatever happens."""
    found = Mosquitto(tmp_path).start()
    yield found
    found.stop()


class Heard:
    """Whose each shard is, and what was said of every plant and frame."""

    def __init__(self):
        self.owners, self.rows, self.repeated = {}, {}, 0
        self.taken = set()

    def take(self, message):
        parts = message.topic.value.split("/")
        if parts[:2] == ["group", "owners"]:
            self.owners[int(parts[2])] = (message.payload or b"").decode()
            self.taken.discard(f"shard {parts[2]}")
        if parts[1:] == ["event", "service"]:
            self.taken.add(json.loads(message.payload)["subject"])
        if parts[1] == "estimates":
            told = read_estimates(message.payload)
            for i, identity in enumerate(told.ids.tolist()):
                key, value = (identity, int(told.frame[i])), told.x[i]
                if key in self.rows:
                    # worked on again after the checkpoint: the same numbers
                    np.testing.assert_array_equal(value, self.rows[key])
                    self.repeated += 1
                self.rows[key] = value

    def shared_by(self, count):
        """Every shard is somebody's, and so many processes have some."""
        names = [self.owners.get(i, "") for i in range(SHARDS)]
        return all(names) and len(set(names)) == count and len(self.taken) == SHARDS


def rows_of(values, k):
    """Row k, from 1, of every shard."""
    there, untrusted = np.ones((PLANTS, 3), bool), np.zeros((PLANTS, 2), bool)
    for shard in range(SHARDS):
        ids = np.arange(PLANTS, dtype=np.uint64) + 100 * shard
        batch = Batch(k * 0.1, ids, values[shard, :, k - 1], there, untrusted)
        yield shard, batch_frame(batch)


async def played(broker, folder, processes, values):
    """Ten rows; one process is killed; ten more; another comes; ten more; all stop."""
    heard = Heard()

    def client():
        return aiomqtt.Client("127.0.0.1", broker.port, protocol=aiomqtt.ProtocolVersion.V5)

    async def listen(ready):
        async with client() as listening:
            await listening.subscribe("out/estimates")
            await listening.subscribe("out/event/service", qos=1)
            await listening.subscribe("group/owners/+", qos=1)
            ready.set()
            async for message in listening.messages:
                heard.take(message)

    def start():
        processes.append(subprocess.Popen([HOLDFAST, "live", folder / "live.toml"]))

    async def send(sender, rows):
        for k in rows:
            for shard, message in rows_of(values, k):
                await sender.publish(f"samples/{shard}", message)
            last = {(100 * shard + i, k) for shard in range(SHARDS) for i in range(PLANTS)}
            await until(lambda: last <= heard.rows.keys(), f"row {k} is not told")  # noqa: B023

    ready = asyncio.Event()
    listening = asyncio.create_task(listen(ready))
    await ready.wait()
    start()
    start()
    async with client() as sender:
        await until(lambda: heard.shared_by(2), "two processes do not share")
        await send(sender, range(1, 11))
        # the checkpoints hold row 10
        await asyncio.sleep(1.0)
        killed = processes[0]
        killed.kill()
        killed.wait()
        await until(lambda: heard.shared_by(1), "the other one has not taken all")
        await send(sender, range(11, 21))
        start()
        await until(lambda: heard.shared_by(2), "the third has none")
        await send(sender, range(21, 31))
    for process in processes[1:]:
        process.terminate()
    assert [process.wait(20) for process in processes[1:]] == [0, 0]
    await until(lambda: not any(heard.owners.values()), "who stops gives its shards back")
    listening.cancel()
    await asyncio.gather(listening, return_exceptions=True)
    return heard


def test_state_follows_when_a_process_dies_and_when_one_comes(broker, tmp_path):
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    (tmp_path / "live.toml").write_text(CONFIG.format(port=broker.port))
    values = np.random.default_rng(0).normal(size=(SHARDS, PLANTS, 30, 3))
    processes = []
    try:
        heard = asyncio.run(played(broker, tmp_path, processes, values))
    finally:
        for process in processes:
            process.kill()
            process.wait()
    scenario = load_scenario(tmp_path / "scenario.toml")
    for shard in range(SHARDS):
        for i in range(PLANTS):
            log = values[shard, i]
            expected = replay(scenario.monitor, Observation.of(log[:, :1], log[:, 1:]))
            mine = [heard.rows[100 * shard + i, k] for k in range(1, 31)]
            np.testing.assert_allclose(mine, expected.estimate.x, rtol=0, atol=1e-10)
