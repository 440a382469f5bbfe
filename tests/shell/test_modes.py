"""Modes through the commands: columns, reduced banks, and what is wrong with a table of modes."""

import csv
import io
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from holdfast import loop
from holdfast.records import Estimate, Observation, Trace, Verdict
from holdfast.shell.calibrating import calibrated_scenario
from holdfast.shell.files import read_scenario
from holdfast.shell.live import Live
from holdfast.shell.results import csv_blocks, write_result
from shell_samples import SCENARIO

CAR = """\
[plant]
kind = "linear"
dt = 0.1
A = [[1.0, 0.1], [0.0, 0.98]]
C = [[1, 0], [1, 0], [0, 1]]
G = [[0, 0.005], [0, 0.1]]
H = [[1, 0], [0, 0], [0, 0]]
Q = [[1e-5, 0], [0, 4e-4]]
R = [[0.25, 0, 0], [0, 0.09, 0], [0, 0, 0.0025]]
states = ["place", "speed"]
outputs = ["gps", "beacon", "wheel"]
attacks = ["spoof", "push"]

[estimator]
kind = "nisme"
x0 = [0, 0]
P0 = [0.01, 0.04]
modes = [[], { name = "gps, lying", attacks = ["spoof"] }, ["push"]]
attack_prior_sd = [20.0, 10.0]

[detector]
kind = "chi_square"
threshold = 13.8

[[attack]]
kind = "bias"
channel = "channel:spoof"
start = 1.0
stop = 3.0
value = 6.0

[run]
steps = 60
"""
"""A car whose GPS lies by 6 m for 2 s."""
OLD = 'modes = [[], { name = "gps, lying", attacks = ["spoof"] }, ["push"]]'
NAMES = ("none", "gps, lying", "push")


@pytest.fixture
def car(folder):
    (folder / "car.toml").write_text(CAR)
    return folder / "car.toml"


def changed(folder, text, *changes):
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "changed.toml").write_text(text)
    return folder / "changed.toml"


def rows_of(text):
    return list(csv.DictReader(io.StringIO(text)))


def two_rows():
    """By hand: two modes weighed, three told apart."""
    two, status = np.zeros((2, 2)), np.zeros(2, np.int32)
    estimate = Estimate(
        two, np.ones((2, 2, 2)), two, np.zeros((2, 2, 2)), two, np.zeros((2, 2, 2)),
        np.zeros((2, 0, 2)), np.zeros((2, 0)), np.zeros((2, 3)), np.zeros((2, 3, 3)), status,
        p=np.array([[0.75, 0.25], [1 / 3, 2 / 3]]), mode=np.array([0, 2], np.int32),
    )  # fmt: skip
    verdict = Verdict(
        np.zeros(2), np.full(2, np.inf), np.zeros(2, bool), status, np.zeros((2, 0), bool)
    )
    observation = Observation.of(np.zeros((2, 0)), np.zeros((2, 3)))
    found = Trace(observation, *jax.tree.map(jnp.asarray, (estimate, verdict)))
    return replace(found, modes=("none", "all, both"), named=("none", "x", "gps, lying"))


def test_columns_of_the_modes(car):
    plant = read_scenario(car).scenario.plant
    text = "".join(csv_blocks(two_rows(), plant, np.array([0.1, 0.2])))
    first, second = rows_of(text)
    assert list(first)[-7:] == [
        "threshold", "alarm", "reason", "mode", "p:none", "p:all, both", "status",
    ]  # fmt: skip
    assert (first["mode"], second["mode"]) == ("none", "gps, lying")
    assert [second["p:none"], second["p:all, both"]] == [repr(1 / 3), repr(2 / 3)]
    # of a channel that the mode does not have
    assert (first["d:spoof"], first["d_sd:spoof"]) == ("0.0", "0.0")


def test_netcdf_names_the_modes(car):
    plant = read_scenario(car).scenario.plant
    write_result(car.parent / "est.nc", two_rows(), plant, np.array([0.1, 0.2]))
    with xr.open_dataset(car.parent / "est.nc", engine="h5netcdf") as data:
        assert data.named.values[data["mode"].values].tolist() == ["none", "gps, lying"]
        np.testing.assert_array_equal(data.p.sel(bank="all, both"), [0.25, 2 / 3])
        assert "true_mode" not in data


def test_replay_says_which_mode_it_is(car, command):
    """From a log on disk: the GPS is off by 6 m from row 10 to 29; of a mode's own channels
    alone there is an estimate.
    """
    rng = np.random.default_rng(0)
    y = rng.normal(size=(40, 3)) * [0.5, 0.3, 0.05]
    y[9:29, 0] += 6.0
    lines = ["time,y:gps,y:beacon,y:wheel"]
    lines += [",".join(map(repr, [0.1 * k, *map(float, row)])) for k, row in enumerate(y, 1)]
    (car.parent / "car.csv").write_text("\n".join(lines) + "\n")
    code, out, err = command("replay", car, car.parent / "car.csv")
    assert (code, err) == (0, "")
    rows = rows_of(out)
    believed = [row["mode"] for row in rows]
    assert believed[2:28] == ["none"] * 7 + ["gps, lying"] * 19
    p = np.array([[float(row[f"p:{name}"]) for name in NAMES] for row in rows])
    np.testing.assert_allclose(np.sum(p, 1), 1.0, rtol=0, atol=1e-12)
    assert [NAMES[i] for i in np.argmax(p, 1)] == believed
    for row in rows:
        for name, mode in (("spoof", "gps, lying"), ("push", "push")):
            nothing = (float(row[f"d:{name}"]), float(row[f"d_sd:{name}"])) == (0.0, 0.0)
            assert nothing == (row["mode"] != mode)


def test_a_bank_too_dear_to_simulate_says_so(folder):
    """Twelve states: the quantile, and a line about it."""
    A, C, P0 = (0.5 * np.eye(12)).tolist(), np.eye(12)[:3].tolist(), [1.0] * 12
    text = CAR.replace("A = [[1.0, 0.1], [0.0, 0.98]]", f"A = {A}")
    text = text.replace("C = [[1, 0], [1, 0], [0, 1]]", f"C = {C}")
    text = re.sub("G = .*", f"G = {np.eye(12)[:, :2].tolist()}", text)
    text = re.sub("Q = .*", f"Q = {np.eye(12).tolist()}", text)
    text = text.replace('states = ["place", "speed"]\n', "")
    text = text.replace("x0 = [0, 0]", f"x0 = {[0] * 12}")
    path = changed(folder, text, ("P0 = [0.01, 0.04]", f"P0 = {P0}"), ("threshold = 13.8", ""))
    with pytest.warns(UserWarning, match="a bank on 12 states is too dear to simulate"):
        scenario, how = calibrated_scenario(read_scenario(path))
    assert (how.method, how.level) == ("given", 0.01)
    assert float(scenario.monitor.detector.factor) == 1.0
    given = changed(folder, path.read_text(), ("chi_square", 'chi_square"\nthreshold = "paper'))
    assert "the paper's formula" in calibrated_scenario(read_scenario(given))[1].sentence


@pytest.mark.whole
@pytest.mark.slow
def test_simulated_replayed_and_live_believe_the_same(car):
    scenario = read_scenario(car).scenario
    trace = loop.simulate(scenario, jax.random.key(1), 60)
    again = loop.replay(scenario.monitor, trace.observation)
    assert (again.modes, again.named) == (trace.modes, trace.named) == (NAMES, NAMES)
    live = Live(scenario.monitor)
    said = [live.push(Observation.of(np.zeros(0), y))[0] for y in np.asarray(trace.observation.y)]
    for p, mode in ((again.estimate.p, again.estimate.mode),
                    (np.stack([e.p for e in said]), np.stack([e.mode for e in said]))):  # fmt: skip
        np.testing.assert_allclose(p, trace.estimate.p, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(mode, trace.estimate.mode)


def test_a_reduced_bank_has_the_largest_sets(car):
    """Two channels that can be assumed together; of those listed only."""
    folder, bank = car.parent, 'bank = "reduced"\nwindow = 5'
    both = read_scenario(changed(folder, CAR, (OLD, f'modes = "all"\n{bank}')))
    estimator = both.scenario.monitor.estimator
    assert estimator.modes == ("spoof+push",)
    assert estimator.named == ("none", "spoof", "push", "spoof+push")
    listed = read_scenario(changed(folder, CAR, (OLD, f'modes = [[], ["push"]]\n{bank}')))
    assert listed.scenario.monitor.estimator.modes == ("push",)
    np.testing.assert_array_equal(listed.scenario.monitor.estimator.P0, np.diag([0.01, 0.04]))


WIDE = "G = [" + ", ".join([str([0.0] * 17)] * 2) + "]"
WRONG = {
    "unknown attack": (OLD, 'modes = [["spof"]]', ["estimator.modes", "'spof'", "mean 'spoof'"]),
    "attack twice": (OLD, 'modes = [["push", "push"]]', ["estimator.modes", "names that differ"]),
    "mode twice": (OLD, 'modes = [["push"], ["push"]]', ["estimator.modes", "'push'", "differ"]),
    "same mode": (OLD, 'modes = [["push"], { name = "a", attacks = ["push"] }]', ["'a'", "differ"]),
    "unknown switch": (OLD, 'modes = [[], { switch = "open" }]', ["'open'", "one of normal"]),
    "unknown key": (OLD, "modes = [{ attack = [] }]", ["key 'attack'", "one of name, attacks"]),
    "no mode": (OLD, "modes = []", ["estimator.modes", "an empty list"]),
    "modes no list": (OLD, "modes = 3", ["estimator.modes", "found 3", "a list, or one of"]),
    "modes word": (OLD, 'modes = "sinlge"', ["'sinlge'", "did you mean 'single'"]),
    "floor too large": (OLD, f"{OLD}\nfloor = 0.4", ["estimator.floor", "0.4", "under 1/3"]),
    "prior": (OLD, f"{OLD}\ntransition = 2.0", ["estimator.transition", "2.0"]),
    "bank word": (OLD, f'{OLD}\nbank = "redused"', ["estimator.bank", "'redused'", '"reduced"']),
    "bank attack": (OLD, f'{OLD}\nbank = [["psh"]]', ["estimator.bank", "mean 'push'"]),
    "window alone": (OLD, f"{OLD}\nwindow = 5", ["estimator.window", "found 5", '"reduced"']),
    "window": (OLD, f'{OLD}\nbank = "reduced"\nwindow = 2', ["estimator.window", "from 3 up"]),
    "P0 too short": ("P0 = [0.01, 0.04]", "P0 = [0.01]", ["1 numbers", "2 x 2 or 2 numbers"]),
    "P0 negative": ("P0 = [0.01, 0.04]", "P0 = [0.01, -1]", ["estimator.P0", "eigenvalue -1"]),
}  # fmt: skip


def refused(outcome, words):
    code, out, err = outcome
    assert (code, out, err.count("\n")) == (2, "", 1), err
    for word in words:
        assert word in err, err


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_with_modes_takes_one_line(case, folder, command):
    old, new, words = WRONG[case]
    path = changed(folder, CAR, (old, new))
    refused(command("run", path), ["changed.toml", "found", "expected", *words])


def test_more_channels_than_can_be_examined(folder, command):
    text = SCENARIO.replace("G = [[0.005], [0.1]]", WIDE).replace(
        'attacks = ["accel_attack"]\n', ""
    )
    path = changed(folder, text, ('kind = "kalman"', 'kind = "nisme"\nbank = "reduced"'))
    refused(command("run", path), ["estimator.bank", '"reduced"', "17 attack channels, over 16"])


NETWORK = """\
[plant]
kind = "swing"
lines = [[1, 2], [2, 3], [1, 3]]
generators = [1]
attacks = ["actuator:1", "sensor:P_elec:2"]
switches = [["1-3"]]
x0 = [0.3, -0.4, 0.1, 0, 0, 0]

[estimator]
kind = "nisme"
x0 = [0.3, -0.4, 0.1, 0, 0, 0]
P0 = [1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4]
attack_prior_sd = [0.5, 0.01]

[detector]
kind = "chi_square"
threshold = "paper"

[[attack]]
kind = "switch"
to = "1-3"
start = 0.5
stop = 1.5

[run]
steps = 200
"""


def test_a_bank_whose_switch_is_in_no_mode(folder, command):
    path = changed(
        folder, NETWORK, ("attack_prior", 'modes = [[]]\nbank = [{ switch = "1-3" }]\n#')
    )
    refused(command("run", path), ["estimator.bank", "'1-3'", "one that is in modes"])


@pytest.mark.whole
@pytest.mark.slow
def test_a_thrown_switch_is_named_through_the_commands(folder, command, monkeypatch):
    """A line opened for 1 s: by `run`, and by `replay` of what it recorded."""
    monkeypatch.setattr("holdfast.campaign.blindness.blindness", lambda *_, **__: [])
    path, report = changed(folder, NETWORK), folder / "report"
    code, out, err = command("run", path, "-o", report)
    assert (code, err) == (0, "")
    with xr.open_dataset(report / "result.nc", engine="h5netcdf") as data:
        truth, believed = data["true_mode"].values, data["mode"].values
        assert data.position.values.tolist() == ["normal", "1-3"]
        assert data.named.values.tolist() == ["none", "actuator:1", "sensor:P_elec:2", "1-3"]
        np.testing.assert_array_equal(data["injected_switch"].values[48:51], [0, 1, 1])
        # the switch is seen by what the flow does to a frequency, within 0.1 s
        assert np.all((believed == truth)[60:149])
        assert np.all((believed == truth)[160:])
    code, out, err = command("replay", path, report / "result.nc")
    assert (code, err) == (0, "")
    rows = rows_of(out)
    assert [row["mode"] for row in rows[60:140]] == ["1-3"] * 80
    code, out, _ = command("run", path)
    assert re.search(r"modes.accuracy +0.9", out)


@pytest.mark.slow
@pytest.mark.parametrize("modes", ['"all"', '[[], { switch = "1-3" }]'])
def test_a_reduced_bank_of_a_network(modes, folder):
    """Along the motion from x0, at every position that is in the modes."""
    new = f'modes = {modes}\nbank = "reduced"\nwindow = 5\nattack_prior'
    found = read_scenario(changed(folder, NETWORK, ("attack_prior", new)))
    both = "actuator:1+sensor:P_elec:2"
    wanted = (both, f"{both}+1-3") if "all" in modes else ("none", "1-3")
    assert found.scenario.monitor.estimator.modes == wanted


SWITCHED = """\
import jax.numpy as jnp
import numpy as np
from holdfast.plants.switched import switched_plant

FRICTION = jnp.array([0.02, 0.1])


def f(x, u, d, position):
    return jnp.stack([x[0] + 0.1 * x[1], (1 - FRICTION[position]) * x[1] + 0.1 * (u[0] + d[0])])


def h(x, u, d, position):
    return x


def make():
    return switched_plant(f, h, positions=["free", "braked"], Q=1e-4 * np.eye(2),
                          R=1e-4 * np.eye(2), dt=0.1, states=["place", "speed"],
                          outputs=["gps", "wheel"], inputs=["push"], attacks=["kick"])
"""
DRIVEN = """\
[plant]
kind = "python"
target = "brakes:make"
x0 = [0, 5]

[estimator]
kind = "nisme"
x0 = [0, 5]
P0 = [0.01, 0.01]
attack_prior_sd = 5.0

[detector]
kind = "chi_square"
threshold = "paper"

[[attack]]
kind = "switch"
to = "braked"
start = 2.0
stop = 3.5

[run]
steps = 40
"""


@pytest.mark.slow
def test_a_plant_of_ones_own_with_a_switch(folder, command):
    """Somebody brakes. At first it looks like a kick, and the filter that believed in brakes
    all along must find the speed again, which takes it half a second.
    """
    (folder / "brakes.py").write_text(SWITCHED)
    path = changed(folder, DRIVEN)
    code, out, err = command("run", path, "--allow-python")
    assert (code, err) == (0, "")
    delay = re.search(r"modes.true.braked.largest_delay_s +(\S+)", out)
    assert float(delay[1]) == pytest.approx(0.6, abs=0.3)
    none = re.search(r"modes.true.none.accuracy +(\S+)", out)
    assert float(none[1]) > 0.9
