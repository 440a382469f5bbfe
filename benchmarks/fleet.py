"""A fleet of 10,000 plants at 10 Hz over a real broker, and the engine alone.

    cd benchmarks && PYTHONPATH=../src python fleet.py [SECONDS]

A Mosquitto, `holdfast live`, this sender and listener share the machine. Each plant has four states
and four sensors; ten gateways send a batch of 1,000 plants every 0.1 s, one after the other.
"""

import math
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from lean_mqtt import Client
from live import PATIENCE, PLANT, broker, rows

from holdfast.shell import runtime
from holdfast.shell.service.config import read_config
from holdfast.shell.service.fleet.building import build_fleet
from holdfast.shell.service.fleet.wire import Batch, batch_frame, estimates_frame, read_estimates

PLANTS, GATEWAYS, DT = 10_000, 10, 0.1
CONFIG = """\
scenario = "plant.toml"
[clock]
grace = 0.2
[fleet]
most = {plants}
[[source]]
kind = "mqtt"
port = {port}
topic = "in/+"
[[sink]]
kind = "mqtt"
port = {port}
prefix = "out"
"""


def written(folder, port):
    """The configuration's path."""
    C, R = rows(4)
    (folder / "plant.toml").write_text(PLANT.format(dt=DT, C=C, R=R))
    (folder / "live.toml").write_text(CONFIG.format(port=port, plants=PLANTS))
    return folder / "live.toml"


def batches(k):
    """Row k of all plants, a batch for every gateway."""
    rng = np.random.default_rng(k)
    each = PLANTS // GATEWAYS
    for gateway in range(GATEWAYS):
        ids = np.arange(gateway * each, (gateway + 1) * each, dtype=np.uint64)
        values = rng.normal(size=(each, 4))
        yield Batch(k * DT, ids, values, np.ones((each, 4), bool), np.zeros((each, 4), bool))


def alone(path):
    """Rows a second of the engine, without a broker: reading, stepping, writing."""
    config = read_config(str(path))
    built = build_fleet(config, config.fleet, False)
    from holdfast.shell.service.fleet.wire import batch_decoder

    decode = batch_decoder(built.labels)
    sent = [[batch_frame(batch) for batch in batches(k)] for k in range(1, 31)]
    begun, used = time.perf_counter(), time.process_time()
    for k, messages in enumerate(sent):
        if k == 10:
            begun, used = time.perf_counter(), time.process_time()
        for message in messages:
            for told in built.engine.take(decode(message), k * DT).rows:
                estimates_frame(told)
    wall, cpu = time.perf_counter() - begun, time.process_time() - used
    rate = 20 * PLANTS / wall
    print(f"engine alone: {rate:,.0f} rows of a plant a second, {wall / cpu:.2f} s of wall time a "
          f"second of processor time: {rate * DT:,.0f} plants at 10 Hz", flush=True)  # fmt: skip


def measured(port, seconds):
    """Send for so long; how many rows came back, and how late."""
    begun, late, counted, end = {}, [], set(), math.inf
    listener, sender = Client(port), Client(port)
    listener.subscribe("out/estimates")

    def listen():
        for payload in listener.messages(lambda: time.perf_counter() < end):
            now, found = time.perf_counter(), read_estimates(payload)
            row = round(float(found.time[0]) / DT)
            gateway = int(found.ids[0]) // (PLANTS // GATEWAYS)
            whole = np.all((found.status & 1) == 0) and len(found.ids) == PLANTS // GATEWAYS
            if (row, gateway) in begun and whole:
                late.append(now - begun[row, gateway])
                counted.add((row, gateway))

    listening = threading.Thread(target=listen)
    listening.start()
    count, warm = round(seconds / DT), 20
    start = time.perf_counter()
    for k in range(1, warm + count + 1):
        for i, batch in enumerate(batches(k)):
            wait = start + (k + i / GATEWAYS) * DT - time.perf_counter()
            message = batch_frame(batch)
            if wait > 0:
                time.sleep(wait)
            if k > warm:
                begun[k, i] = time.perf_counter()
            sender.publish(f"in/{i}", message)
    end = time.perf_counter() + PATIENCE
    listening.join()
    return count * GATEWAYS, len(counted), np.sort(late)


def main():
    """The engine alone, then over the broker."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    runtime.configure()
    with tempfile.TemporaryDirectory() as place, broker(Path(place)) as port:
        path = written(Path(place), port)
        alone(path)
        running = subprocess.Popen([Path(sys.executable).with_name("holdfast"), "live", path])
        try:
            time.sleep(20)
            sent, back, late = measured(port, seconds)
        finally:
            running.terminate()
            running.wait()
    p50, p99 = (1e3 * late[int(q * (len(late) - 1))] for q in (0.5, 0.99))
    lost = f"{sent} batches sent, {sent - back} lost"
    told = f"p50 {p50:.1f} ms, p99 {p99:.1f} ms, largest {1e3 * late[-1]:.0f} ms"
    print(f"{PLANTS:,} plants at 10 Hz for {seconds:g} s: {lost}, {told}", flush=True)


if __name__ == "__main__":
    main()
