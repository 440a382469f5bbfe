"""A whole service on a broker that wants a password and TLS, and keeps what comes meanwhile."""

import asyncio
import json
import os
import signal
import ssl
from functools import partial

import numpy as np
import pytest

from brokers import Mosquitto, certified, passwords, until
from holdfast.loop import replay
from holdfast.records import Observation, Status
from holdfast.shell.errors import InputError
from holdfast.shell.files import load_scenario
from holdfast.shell.schema import Table
from holdfast.shell.service.broker import Broker
from holdfast.shell.service.building import build_engine
from holdfast.shell.service.config import read_config
from holdfast.shell.service.parts import BrokerKeys, broker_of, build_parts
from holdfast.shell.service.serve import Service
from shell_samples import SCENARIO

SECRET = "correct horse battery staple"
CONFIG = """\
scenario = "scenario.toml"
[clock]
rule = "source"
[sensors]
enabled = false
[checkpoint]
file = "state"
[[source]]
kind = "mqtt"
port = {port}
topic = "in"
client_id = "holdfast-1"
qos = 1
username = "us"
password_env = "BROKER_PASSWORD"
authority = "authority.pem"
[[sink]]
kind = "mqtt"
port = {port}
prefix = "out"
qos = 1
username = "us"
password_file = "password"
authority = "authority.pem"
"""


@pytest.fixture
def broker(tmp_path, monkeypatch):
    """A broker with all its locks, and beside it a scenario and a configuration."""
    found, certificates = Mosquitto(tmp_path), certified(tmp_path)
    found.configure(*passwords(tmp_path, "us", SECRET), *certificates.lines)
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    (tmp_path / "live.toml").write_text(CONFIG.format(port=found.port))
    (tmp_path / "password").write_text(SECRET)
    (tmp_path / "password").chmod(0o600)
    monkeypatch.setenv("BROKER_PASSWORD", SECRET)
    yield found.start()
    found.stop()


def service_of(folder):
    """What `holdfast live` runs."""
    config = read_config(str(folder / "live.toml"))
    built = build_engine(config, False)
    return Service(config, built, partial(build_parts, config, built))


def somebody(broker, folder, handle=lambda *_: None):
    """A connection of a sender or a listener."""
    tls = ssl.create_default_context(cafile=str(folder / "authority.pem"))
    return Broker(port=broker.port, username="us", password=SECRET, tls=tls).connection(handle)


def values(steps):
    """Inputs and outputs by row."""
    rng = np.random.default_rng(0)
    return np.zeros((steps, 1)), rng.normal(size=(steps, 2)) * [0.5, 0.05]


async def played(broker, folder, stops):
    """Services one after the other while a sender goes on: rows by frame, and what they raised.

    ``stops``: up to which row each is there, and what its engine raises at the next one.
    """
    rows, raised, begun = {}, [], 0
    u, y = values(stops[-1][0] + 10)

    def told(topic, payload):
        if topic == "out/estimate":
            row = json.loads(payload)
            rows[row["frame"]] = row

    async def send(client, first, last):
        for k in range(first, last):
            row = {"time": (k + 1) / 10, "u:accel": u[k, 0], "y:gps": y[k, 0], "y:wheel": y[k, 1]}
            await client.publish("in", json.dumps(row).encode(), 1)

    async with somebody(broker, folder, told) as client:
        await client.subscribe(["out/estimate"], 1)
        for last, failure in stops:
            service = service_of(folder)
            running = asyncio.create_task(service.run())
            await until(lambda s=service: s._sources[0].connected)
            await send(client, begun, last)
            # the last row waits for the next: no stamp says that its time is over
            await until(lambda n=last: len(rows) >= n - 1, f"{len(rows)} rows of {last}")
            if failure is None:
                os.kill(os.getpid(), signal.SIGTERM)
            else:
                service._engine.take = failure
                await send(client, last, last + 1)
            raised += await asyncio.gather(running, return_exceptions=True)
            # while nobody is there
            begun = last + 10
            await send(client, last + (failure is not None), begun)
    return [rows[frame] for frame in sorted(rows)], raised


def broken(samples, now):
    """An engine's `take` with a fault."""
    raise ZeroDivisionError("a fault of ours")


@pytest.mark.slow
def test_a_service_goes_on_with_what_was_kept(broker, tmp_path, capfd):
    """After a stop, and after a fault of ours, which ends it with its state kept: no row lacks
    anything, and all are those of a replay.
    """
    stops = [(5, None), (20, broken), (40, None)]
    rows, raised = asyncio.run(played(broker, tmp_path, stops))
    assert [type(one) for one in raised] == [type(None), ZeroDivisionError, type(None)]
    assert [row["frame"] for row in rows] == list(range(1, len(rows) + 1))
    assert len(rows) >= 39
    scenario = load_scenario(tmp_path / "scenario.toml")
    expected = replay(scenario.monitor, Observation.of(*values(len(rows))))
    status = [Status(int(one)).words for one in expected.estimate.status]
    assert [row["status"] for row in rows] == status
    mine = [[row["x:position"], row["x:speed"]] for row in rows]
    np.testing.assert_allclose(mine, expected.estimate.x, rtol=1e-12, atol=1e-12)
    assert SECRET not in "".join(capfd.readouterr())


@pytest.mark.parametrize(("keys", "words"), [
    ({"password_env": "BROKER_PASSWORD"}, ["source[1].username", "whose"]),
    ({"username": "us", "password_env": "NOT_SET"}, ["source[1].password_env", "NOT_SET"]),
    ({"username": "us", "password_file": "open"}, ["open", "chmod 600"]),
    ({"authority": "open"}, ["source[1].authority", "PEM"]),
    ({"authority": "nobody"}, ["source[1].authority", "PEM"]),
])  # fmt: skip
def test_locks_that_do_not_fit_are_named(tmp_path, monkeypatch, keys, words):
    monkeypatch.setenv("BROKER_PASSWORD", SECRET)
    (tmp_path / "open").write_text(SECRET)
    (tmp_path / "open").chmod(0o644)
    (tmp_path / "live.toml").write_text(CONFIG.format(port=1))
    config = read_config(str(tmp_path / "live.toml"))
    table = Table(config.path, "source[1]", {}, tmp_path)
    with pytest.raises(InputError) as refused:
        broker_of(table, BrokerKeys(**keys), config)
    for word in words:
        assert word in str(refused.value)
    assert SECRET not in str(refused.value)
