"""Ten minutes of everything at once, in which the service must not grow."""

import asyncio
import json
import os
import random
import socket
import subprocess
import sys
import time
from pathlib import Path

import aiomqtt
import pytest

from brokers import Mosquitto, until
from shell_samples import SCENARIO

HOLDFAST = str(Path(sys.executable).with_name("holdfast"))
SECONDS, WARM, RATE = 600, 90, 100
"""Seconds, those until buffers are full, rows a second."""
FLAT = 1.05
CONFIG = """\
scenario = "scenario.toml"
events = "events.sqlite"
[checkpoint]
file = "state"
every = 2.0
[page]
port = {page}
token_env = "HOLDFAST_SOAK"
[[source]]
kind = "mqtt"
port = {port}
topic = "in"
[[sink]]
kind = "mqtt"
port = {port}
prefix = "out"
"""


def memory(process):
    """Bytes that a process has in memory now."""
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def row_of(k, rng):
    """A row at rest; a lie now and then, rows lost, samples that are no numbers."""
    row = {"time": 0.1 * k, "u:accel": 0.0, "y:gps": rng.gauss(0.0, 0.5),
           "y:wheel": rng.gauss(0.0, 0.05)}  # fmt: skip
    if k % 1000 < 100:
        row["y:gps"] += 20.0
    if rng.random() < 0.02:
        row["y:wheel"] = rng.choice([None, "off", [1.0], True])
    return None if rng.random() < 0.02 else json.dumps(row)


async def soak(process, broker):
    """Rows for so long; memory second by second, and how many rows came back."""
    back, sizes, rng = 0, [], random.Random(0)

    async def count(listening):
        nonlocal back
        async for _ in listening.messages:
            back += 1

    client = [aiomqtt.Client("127.0.0.1", broker.port) for _ in range(2)]
    async with client[0] as sender, client[1] as listening:
        await listening.subscribe("out/estimate")
        counting = asyncio.create_task(count(listening))
        k = 0
        while back == 0:  # until it has subscribed
            k += 1
            await sender.publish("in", row_of(k, rng) or row_of(k + 1, rng) or "{}")
            await asyncio.sleep(0.05)
            assert process.poll() is None
        start, first = time.monotonic(), k
        while (passed := time.monotonic() - start) < SECONDS:
            k += 1
            row = row_of(k, rng)
            if row is not None:
                await sender.publish("in", row)
            if passed >= len(sizes):
                sizes.append(memory(process))
                assert process.poll() is None
            await asyncio.sleep(max(start + (k - first) / RATE - time.monotonic(), 0.0))
        await until(lambda: back >= 0.99 * (k - first), f"{back} of {k - first} rows came back")
        counting.cancel()
        await asyncio.gather(counting, return_exceptions=True)
    return sizes


@pytest.mark.slow
@pytest.mark.whole
def test_memory_is_flat(tmp_path):
    """Within 5 % from when its buffers are full, with alarms, faults and checkpoints all along."""
    broker = Mosquitto(tmp_path).start()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        page = probe.getsockname()[1]
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    (tmp_path / "live.toml").write_text(CONFIG.format(port=broker.port, page=page))
    environment = os.environ | {"HOLDFAST_SOAK": "a token that is long enough"}
    process = subprocess.Popen([HOLDFAST, "live", tmp_path / "live.toml"], env=environment)
    try:
        sizes = asyncio.run(soak(process, broker))
    finally:
        process.terminate()
        process.wait()
        broker.stop()
    settled = sizes[WARM:]
    print([round(size / 2**20, 1) for size in sizes[::30]])
    assert len(settled) >= SECONDS - WARM - 5
    assert max(settled) <= FLAT * settled[0]
