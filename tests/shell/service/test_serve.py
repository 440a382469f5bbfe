"""`holdfast live` as it is run: recorded logs and lines in, lines out, killed and gone on with."""

import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from holdfast.loop import replay
from holdfast.shell.errors import InputError
from holdfast.shell.files import load_scenario
from holdfast.shell.logs import read_log
from holdfast.shell.service import serve
from shell_samples import SCENARIO

STEPS = 300
HOLDFAST = str(Path(sys.executable).with_name("holdfast"))


def log_text(steps=STEPS, spoofed=(100, 200)):
    """A vehicle at rest; its GPS is 5 m off for a while, and some cells are empty."""
    rng = random.Random(0)
    lines = ["time,u:accel,y:gps,y:wheel"]
    for k in range(1, steps + 1):
        off = 5.0 if spoofed[0] <= k < spoofed[1] else 0.0
        gps = "" if k % 37 == 0 else repr(rng.gauss(off, 0.5))
        lines.append(f"{k / 10:.1f},{0.0},{gps},{rng.gauss(0, 0.05)!r}")
    return "\n".join(lines) + "\n"


@pytest.fixture
def folder(tmp_path):
    """A scenario and a log."""
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    (tmp_path / "log.csv").write_text(log_text())
    return tmp_path


CONFIG = """\
scenario = "scenario.toml"
events = "events.sqlite"
[clock]
rule = "source"
[checkpoint]
file = "state"
every = 0.05
[[source]]
kind = "recorded"
file = "log.csv"
speed = {speed}
[[sink]]
kind = "stdout"
"""


def written(folder, text=None, speed=0.0):
    """The configuration's path."""
    (folder / "live.toml").write_text(text or CONFIG.format(speed=speed))
    return str(folder / "live.toml")


def split(lines):
    """Rows and events of an output."""
    found = [json.loads(line) for line in lines.splitlines()]
    return [f for f in found if "event" not in f], [f["event"] for f in found if "event" in f]


def events_of(folder):
    """The event log, without the service's own starts."""
    with sqlite3.connect(folder / "events.sqlite") as base:
        return base.execute(
            "SELECT key, frame, time, kind, subject, state, reason, statistic, threshold "
            "FROM events WHERE kind != 'service' ORDER BY frame, key"
        ).fetchall()


def test_a_recorded_log_gives_the_numbers_of_replay(folder, capsysbinary):
    """To the last digit, without a life cycle that leaves samples out."""
    text = CONFIG.format(speed=0.0) + "[sensors]\nenabled = false\n"
    serve.live(written(folder, text), False)
    rows, events = split(capsysbinary.readouterr().out)
    scenario = load_scenario(folder / "scenario.toml")
    log = read_log(folder / "log.csv", scenario.plant)
    expected = replay(scenario.monitor, log.observation)
    assert [row["frame"] for row in rows] == list(range(1, STEPS + 1))
    assert [row["time"] for row in rows] == log.time.tolist()
    for i, name in enumerate(("position", "speed")):
        mine = [row[f"x:{name}"] for row in rows]
        np.testing.assert_allclose(mine, expected.estimate.x[:, i], rtol=1e-12, atol=1e-12)
    mine = [row["statistic"] for row in rows]
    np.testing.assert_allclose(mine, expected.verdict.statistic, rtol=1e-9)
    assert events[0]["state"] == "started"
    assert {event["kind"] for event in events} == {"service", "alarm"}
    assert len(events_of(folder)) == len(events) - 1


def test_the_state_goes_on_where_it_was(folder, capsysbinary):
    """A first half, then the whole log: the second run begins where the first has ended."""
    whole = (folder / "log.csv").read_text()
    serve.live(written(folder), False)
    rows, _ = split(capsysbinary.readouterr().out)
    told = events_of(folder)
    for name in ("state", "events.sqlite"):
        (folder / name).unlink()
    (folder / "log.csv").write_text("".join(whole.splitlines(keepends=True)[:150]))
    serve.live(written(folder), False)
    first, _ = split(capsysbinary.readouterr().out)
    (folder / "log.csv").write_text(whole)
    serve.live(written(folder), False)
    second, events = split(capsysbinary.readouterr().out)
    assert events[0]["state"] == "restarted"
    assert first + second == rows
    assert events_of(folder) == told


def test_lines_of_json_and_of_csv(folder):
    """A pipe of either kind, with rubbish among it, gives the same rows."""
    text = CONFIG.format(speed=0.0).replace('kind = "recorded"', 'kind = "stdin"')
    text = "".join(
        line
        for line in text.splitlines(True)
        if not line.startswith(
            ("events", 'file = "log', "speed", "[checkpoint]", 'file = "state', "every")
        )
    )
    path = written(folder, text)
    csv = (folder / "log.csv").read_bytes()
    header, *lines = csv.decode().splitlines()
    names = header.split(",")
    objects = [
        json.dumps({name: float(cell) for name, cell in zip(names, line.split(","), strict=True)
                    if cell})
        for line in lines
    ]  # fmt: skip
    rubbish = ["{", "[1]", "nonsense", '{"y:gps": 1, "time": "late"}', "x" * 200_000, "\x00\xff"]
    mixed = [*objects[:50], *rubbish, *objects[50:]]
    outputs = []
    for fed in (csv, "\n".join(mixed).encode("latin-1")):
        done = subprocess.run(
            [HOLDFAST, "live", path], input=fed, capture_output=True,
            timeout=120, check=True,
        )  # fmt: skip
        outputs.append(split(done.stdout)[0])
    assert len(outputs[0]) == STEPS
    assert outputs[0] == outputs[1]


@pytest.mark.parametrize(("found", "instead", "said"), [
    ('kind = "recorded"', 'kind = "carrier pigeon"', "source[1].kind"),
    ("speed = 0.0", "speed = -1.0", "source[1].speed"),
    ("speed = 0.0", 'speeed = 1.0', "source[1].speeed"),
    ('rule = "source"', 'rule = "moon"', "clock.rule"),
    ('file = "log.csv"', 'file = "no.csv"', "no.csv"),
    ('scenario = "scenario.toml"', 'scenario = "none.toml"', "none.toml"),
    ("[clock]", "[[clock]]", "clock"),
    (
        'kind = "recorded"\nfile = "log.csv"\nspeed = 0.0',
        'kind = "mqtt"\ntopic = "a/#/b"',
        "source[1].topic",
    ),
    ("[checkpoint]", '[page]\ntoken_env = "NO_SUCH"\n[checkpoint]', "page.token_env"),
    ("[checkpoint]", '[page]\n[checkpoint]', "page.token_env, page.token_file"),
])  # fmt: skip
def test_a_bad_configuration_is_named(folder, found, instead, said):
    text = CONFIG.format(speed=0.0)
    assert found in text
    with pytest.raises(InputError) as caught:
        serve.live(written(folder, text.replace(found, instead, 1)), False)
    assert said in str(caught.value)
    assert not (folder / "state").exists()


def test_a_secret_that_others_can_read_is_refused(folder):
    (folder / "token").write_text("a-token-that-is-long-enough")
    (folder / "token").chmod(0o644)
    text = CONFIG.format(speed=0.0) + '[page]\ntoken_file = "token"\n'
    with pytest.raises(InputError, match="600"):
        serve.live(written(folder, text), False)


def test_the_state_of_another_scenario_is_refused(folder, capsysbinary):
    serve.live(written(folder), False)
    (folder / "scenario.toml").write_text(SCENARIO.replace("0.25", "0.26"))
    with pytest.raises(InputError, match="another scenario"):
        serve.live(written(folder), False)
    good = (folder / "state").read_bytes()
    (folder / "scenario.toml").write_text(SCENARIO)
    (folder / "state").write_bytes(good[:-9] + b"123456789")
    with pytest.raises(InputError, match="damaged"):
        serve.live(written(folder), False)
    (folder / "state").write_bytes(b"something else\n")
    with pytest.raises(InputError, match="something else"):
        serve.live(written(folder), False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("speed", "least"), [(3.0, 1), pytest.param(0.5, 100, marks=pytest.mark.whole)]
)
def test_kills_lose_and_double_nothing(folder, speed, least):
    """kill -9 at random moments: the rows from every checkpoint on, and all events, are those of
    a run that nobody disturbed.
    """
    path = written(folder, speed=0.0)
    command = [HOLDFAST, "live", path]
    environment = os.environ | {"HOLDFAST_CACHE": str(folder / "cache")}
    (folder / "cache").mkdir(mode=0o700)

    def fresh():
        for name in ("state", "events.sqlite"):
            (folder / name).unlink(missing_ok=True)

    for _ in range(2):  # the second time everything has been compiled
        fresh()
        begun = time.monotonic()
        done = subprocess.run(command, capture_output=True, check=True, env=environment)
        up = time.monotonic() - begun
    rows, _ = split(done.stdout)
    told = events_of(folder)
    fresh()
    written(folder, speed=speed)  # 30 s of log
    rng, kills, seen = random.Random(1), 0, {}
    while True:
        with (folder / "out").open("wb") as out:
            running = subprocess.Popen(command, stdout=out, env=environment)
            try:
                # it takes about so long to come up
                running.wait(up + rng.uniform(-0.2, 0.7))
            except subprocess.TimeoutExpired:
                running.send_signal(signal.SIGKILL)
                running.wait()
                kills += 1
        for line in (folder / "out").read_bytes().split(b"\n")[:-1]:
            found = json.loads(line)
            if "event" not in found:
                before = seen.setdefault(found["frame"], found)
                assert before == found
        if running.returncode == 0:
            break
        assert kills < 2000
    assert kills >= least
    assert [seen[frame] for frame in sorted(seen)] == rows
    assert events_of(folder) == told
