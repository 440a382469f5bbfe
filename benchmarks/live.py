"""The live service over a real broker on the loopback: latency, loss, rows a second.

    cd benchmarks && PYTHONPATH=../src python live.py [SECONDS]

A Mosquitto, `holdfast live` and this sender and listener share the machine. Latency runs from
just before a frame is published to when its estimate has been received here.
"""

import contextlib
import json
import math
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from lean_mqtt import Client

PLANT = """\
[plant]
kind = "linear"
dt = {dt}
A = [[1.0, {dt}, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, {dt}], [0.0, 0.0, 0.0, 1.0]]
C = {C}
Q = [[1e-6, 0, 0, 0], [0, 1e-4, 0, 0], [0, 0, 1e-6, 0], [0, 0, 0, 1e-4]]
R = {R}

[estimator]
kind = "kalman"
x0 = [0, 0, 0, 0]
P0 = [1, 1, 1, 1]
"""
CONFIG = """\
scenario = "plant.toml"
[clock]
grace = 0.05
[[source]]
kind = "mqtt"
port = {port}
{topics}
[[sink]]
kind = "mqtt"
port = {port}
prefix = "out"
"""


PATIENCE = 5.0
"""Seconds after the last frame in which what is on its way may still come."""
START = """\
scenario = "plant.toml"
[[source]]
kind = "stdin"
[[sink]]
kind = "stdout"
"""


def rows(count):
    """Matrices of so many outputs, each one of the four states."""
    C = np.eye(4)[np.arange(count) % 4]
    return C.tolist(), np.diag(np.full(count, 0.25)).tolist()


@contextlib.contextmanager
def broker(folder):
    """A Mosquitto, and its port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    (folder / "broker.conf").write_text(
        f"listener {port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\n"
        "max_queued_messages 0\n"
    )
    program = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
    running = subprocess.Popen([program, "-c", str(folder / "broker.conf")],
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # fmt: skip
    try:
        time.sleep(0.5)
        yield port
    finally:
        running.kill()
        running.wait()


def measure(port, rate, seconds, messages):
    """Send ``rate`` frames a second; how many, and how late what came back was."""
    sent, late, end = {}, [], math.inf
    values = np.random.default_rng(0).normal(scale=0.5, size=(1000, 64))  # as R says
    listener, sender = Client(port), Client(port)
    listener.subscribe("out/estimate")

    def listen():
        for payload in listener.messages(lambda: time.perf_counter() < end and len(late) < count):
            now = time.perf_counter()
            begun = sent.get(round(json.loads(payload)["time"] * rate))
            if begun is not None:
                late.append(now - begun)

    warm, count = 3 * rate, int(rate * seconds)
    listening = threading.Thread(target=listen)
    listening.start()
    # frames until the service has surely subscribed and compiled
    begin = time.perf_counter()
    for k in range(warm + count):
        wait = begin + k / rate - time.perf_counter()
        if wait > 0:
            time.sleep(wait)
        found = messages(7 + k / rate, values[k % 1000])
        if k >= warm:
            sent[7 * rate + k] = time.perf_counter()
        for topic, payload in found:
            sender.publish(topic, payload.encode())
    behind = time.perf_counter() - begin - (warm + count) / rate
    end = time.perf_counter() + PATIENCE
    listening.join()
    if behind > 0.1:
        print(f"the sender was {behind:.1f} s behind at the end", flush=True)
    return count, np.sort(late)


def case(name, rate, seconds, outputs, messages, topics):
    """Run one case and print its line."""
    with tempfile.TemporaryDirectory() as place, broker(Path(place)) as port:
        folder = Path(place)
        C, R = rows(outputs)
        (folder / "plant.toml").write_text(PLANT.format(dt=1 / rate, C=C, R=R))
        (folder / "live.toml").write_text(CONFIG.format(port=port, topics=topics))
        holdfast = Path(sys.executable).with_name("holdfast")
        running = subprocess.Popen([holdfast, "live", folder / "live.toml"])
        try:
            time.sleep(20)
            count, late = measure(port, rate, seconds, messages)
        finally:
            running.terminate()
            running.wait()
    if not len(late):
        print(f"{name}: {count} frames sent, none came back", flush=True)
        return
    p50, p99 = (1e3 * late[int(q * (len(late) - 1))] for q in (0.5, 0.99))
    told = f"p50 {p50:.2f} ms, p99 {p99:.2f} ms, largest {1e3 * late[-1]:.1f} ms"
    print(f"{name}: {count} frames sent, {count - len(late)} lost, {told}", flush=True)


def starts(repeat=5):
    """Seconds from the start of the process to its first estimate, without and with compiled code
    on disk.
    """
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        C, R = rows(4)
        (folder / "plant.toml").write_text(PLANT.format(dt=0.1, C=C, R=R))
        (folder / "live.toml").write_text(START)
        environment = os.environ | {"HOLDFAST_CACHE": str(folder / "cache")}
        holdfast = Path(sys.executable).with_name("holdfast")
        row = json.dumps({"time": 0.1, **{f"y:y{i + 1}": 0.0 for i in range(4)}}) + "\n"
        found = []
        for _ in range(1 + repeat):
            begun = time.perf_counter()
            with subprocess.Popen(
                [holdfast, "live", folder / "live.toml"], env=environment, text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            ) as running:  # fmt: skip
                running.stdin.write(row)
                running.stdin.flush()
                while "status" not in json.loads(running.stdout.readline()):
                    pass  # the event that the service has started
                found.append(time.perf_counter() - begun)
                running.stdin.close()
    told = f"{min(found[1:]):.2f} to {max(found[1:]):.2f} s with compiled code on disk"
    print(f"start to first estimate: {found[0]:.2f} s without, {told}", flush=True)


def main():
    """Start; whole rows at three rates, and twenty signals of their own."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    starts()

    def whole(stamp, values):
        return [("in", json.dumps({"time": stamp, **{f"y:y{i + 1}": values[i] for i in range(4)}}))]

    def single(stamp, values):
        return [(f"in/{i + 1}", json.dumps({"time": stamp, "value": values[i]})) for i in range(20)]

    for rate in (100, 300, 1000):
        case(f"{rate} frames a second, n = 4, one message each", rate, seconds, 4, whole,
             'topic = "in"')  # fmt: skip
    signals = "\n".join(f'"in/{i + 1}" = "y:y{i + 1}"' for i in range(20))
    case("100 frames a second, n = 4, 20 signals a message each", 100, seconds, 20, single,
         f"[source.signals]\n{signals}")  # fmt: skip


if __name__ == "__main__":
    main()
