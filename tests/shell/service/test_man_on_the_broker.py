"""A second client on a real broker that hands on altered messages: how far he gets, and when he is
noticed. He knows the plant, the filter and the schedule, and has the worst stealthy attack.
"""

import asyncio
import json
import os
import signal
from functools import partial

import aiomqtt
import numpy as np
import pytest

from brokers import Mosquitto
from holdfast.attacks import stealthy
from holdfast.auth import (
    PROFILE_1,
    Key,
    KeyRing,
    Schedule,
    SecocSender,
    Sensors,
    Transmitter,
)
from holdfast.auth.samples import PAYLOAD_BYTES, decode, encode
from holdfast.numerics.stealth import Stealth
from holdfast.plants.library import vehicle_tracking
from holdfast.plants.watched import watched
from holdfast.reach.bounds import reach
from holdfast.reach.setting import Setting
from holdfast.records import Enforcement
from holdfast.shell.service.building import build_engine
from holdfast.shell.service.config import read_config
from holdfast.shell.service.parts import build_parts
from holdfast.shell.service.serve import Service

EPSILON, LEVEL, STEPS, EVERY, FORGED_AT, SENSORS = 0.001, 0.015, 60, 3, 48, 2
PLANT = vehicle_tracking.build()
SYSTEM, DT = watched(PLANT), float(PLANT.dt)
SECRET = bytes(range(16))
POLICY = Enforcement.of([EVERY] * SENSORS, 1, EVERY)
SCENARIO = """\
[plant]
kind = "vehicle_tracking"
[estimator]
kind = "kalman"
x0 = [0.0, 0.0]
P0 = {P}
[detector]
kind = "chi_square"
level = {level}
[enforcement]
every = {every}
"""
CONFIG = """\
scenario = "scenario.toml"
[clock]
rule = "source"
[sensors]
enabled = false
[auth]
key_env = "HOLDFAST_TEST_KEY"
[[source]]
kind = "mqtt"
port = {port}
topic = "plant"
[[sink]]
kind = "mqtt"
port = {port}
prefix = "out"
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A broker, a scenario with the filter's own covariance, a configuration."""
    monkeypatch.setenv("HOLDFAST_TEST_KEY", SECRET.hex())
    found = Mosquitto(tmp_path).start()
    text = SCENARIO.format(P=np.asarray(SYSTEM.P).tolist(), level=LEVEL, every=EVERY)
    (tmp_path / "scenario.toml").write_text(text)
    (tmp_path / "live.toml").write_text(CONFIG.format(port=found.port))
    yield tmp_path, found.port
    found.stop()


def measured():
    """What the sensors measure while nobody steers."""
    rng = np.random.default_rng(0)
    A, C, Q, R = (np.asarray(m) for m in (PLANT.A, PLANT.C, PLANT.Q, PLANT.R))
    x, y = np.zeros(2), np.zeros((STEPS, SENSORS))
    for k in range(STEPS):
        x = A @ x + np.sqrt(np.diag(Q)) * rng.normal(size=2)
        y[k] = C @ x + np.sqrt(np.diag(R)) * rng.normal(size=SENSORS)
    return y


def sealed(y):
    """A message for every row, tags where the policy wants them."""
    ids, keys = Sensors.of(PLANT.outputs).data_ids, KeyRing((Key(0, SECRET),))
    senders = tuple(
        SecocSender(keys=keys, data_id=i, payload_bytes=PAYLOAD_BYTES, profile=PROFILE_1)
        for i in ids
    )
    sender = Transmitter(Schedule.of(POLICY), senders)
    states = sender.start()
    for k, row in enumerate(y, 1):
        states, messages = sender.send(states, k, row)
        secured = dict(zip(PLANT.outputs, (m.hex() for m in messages), strict=True))
        yield json.dumps({"time": k * DT, "u:accel": 0.0, "secured": secured})


def altered(text, k, plan):
    """The plan's row on what has no tag; once, on what has one as well."""
    found = json.loads(text)
    for i, name in enumerate(PLANT.outputs):
        message = bytes.fromhex(found["secured"][name])
        if len(message) == PAYLOAD_BYTES or k == FORGED_AT:
            value = decode(message[:PAYLOAD_BYTES]) + plan[k - 1, i] + 0.5 * (k == FORGED_AT)
            found["secured"][name] = (encode(value) + message[PAYLOAD_BYTES:]).hex()
    return json.dumps(found)


async def told(folder, port, plan):
    """Rows of the service, when every message passes through the man."""
    config = read_config(str(folder / "live.toml"))
    built = build_engine(config, False)
    service = Service(config, built, partial(build_parts, config, built))
    running = asyncio.create_task(service.run())
    rows, alarms, ready = {}, [], asyncio.Event()

    def client():
        return aiomqtt.Client("127.0.0.1", port, protocol=aiomqtt.ProtocolVersion.V5)

    async def man():
        async with client() as he:
            await he.subscribe("field", qos=1)
            ready.set()
            k = 0
            async for message in he.messages:
                k += 1
                await he.publish("plant", altered(message.payload, k, plan), qos=1)

    async def listen(heard):
        async with client() as listening:
            await listening.subscribe("out/#", qos=1)
            heard.set()
            async for message in listening.messages:
                found = json.loads(message.payload)
                if message.topic.value == "out/estimate":
                    rows[found["frame"]] = [found["x:position"], found["x:speed"]]
                elif message.topic.value == "out/event/alarm":
                    alarms.append(found)

    heard = asyncio.Event()
    tasks = [asyncio.create_task(man()), asyncio.create_task(listen(heard))]
    async with asyncio.timeout(60.0), client() as sensors:
        await ready.wait()
        await heard.wait()
        while not service._sources[0].connected:
            await asyncio.sleep(0.01)
        for text in sealed(measured()):
            await sensors.publish("field", text, qos=1)
        # no stamp says that the last row's time is over
        while len(rows) < STEPS - 1:
            await asyncio.sleep(0.01)
    os.kill(os.getpid(), signal.SIGTERM)
    await running
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return np.array([rows[k] for k in range(1, STEPS)]), alarms


def test_he_stays_under_the_designed_bound_until_he_is_noticed(folder):
    stealth = Stealth("chi_square", EPSILON, LEVEL, SENSORS)
    setting = Setting(SYSTEM, stealth, np.ones(SENSORS, bool), POLICY, np.eye(2))
    bound = reach(setting, STEPS).norm
    at = int(np.argmax(bound[: FORGED_AT - 1])) + 1
    attack = stealthy.build(
        PLANT, epsilon=EPSILON, level=LEVEL, detector="chi_square", enforcement=POLICY,
        channels=[f"sensor:{name}" for name in PLANT.outputs],
        start=DT, stop=(STEPS + 1) * DT, at=at * DT,
    ).attack  # fmt: skip
    plan = np.asarray(attack.plan)[:STEPS]
    calm, false = asyncio.run(told(*folder, np.zeros_like(plan)))
    attacked, alarms = asyncio.run(told(*folder, plan))
    gap = np.linalg.norm(attacked - calm, axis=1)
    before = slice(0, FORGED_AT - 1)
    assert np.all(gap[before] <= bound[before] * (1 + 1e-9) + 1e-9)
    # no straw man
    assert gap[before].max() > 0.5 * bound[before].max()

    def forged(events):
        return [e for e in events if "authenticated" in e["reason"] and e["state"] == "begin"]

    # with a plan of nothing he forges at that row too, and is seen in it both times
    for events in (false, alarms):
        (one,) = forged(events)
        assert one["frame"] == FORGED_AT
        assert one["subject"] == "+".join(PLANT.outputs)
