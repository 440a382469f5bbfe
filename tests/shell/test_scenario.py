"""Scenario files: what every table can say, and that it arrives in the parts."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io

from holdfast import catalog
from holdfast.attacks import bias
from holdfast.attacks.window import Window
from holdfast.detectors.chi_square import ChiSquare
from holdfast.estimators.kalman import Kalman
from holdfast.loop import simulate
from holdfast.parts import Plant
from holdfast.plants.linear import Table
from holdfast.records import Enforcement
from holdfast.shell.errors import InputError
from holdfast.shell.files import load_scenario, read_scenario
from holdfast.shell.schema import model_of
from holdfast.shell.template import scenario_text
from shell_samples import SCENARIO

A = [[1.0, 0.1], [0.0, 1.0]]
INLINE = "A = [[1.0, 0.1], [0.0, 1.0]]"


def load(folder, *changes, **options):
    text = SCENARIO
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "changed.toml").write_text(text)
    return read_scenario(folder / "changed.toml", **options)


def test_the_parts_are_what_the_file_says(folder):
    found = load(folder, ('["accel_attack"]', '["accel_attack"]\nx0 = [1.0, 2.0]'))
    scenario = found.scenario
    plant = scenario.plant
    np.testing.assert_array_equal(plant.A, A)
    np.testing.assert_array_equal(plant.D, np.zeros((2, 1)))
    assert (plant.dt, plant.states, plant.outputs) == (0.1, ("position", "speed"), ("gps", "wheel"))
    assert isinstance(scenario.monitor.estimator, Kalman)
    assert isinstance(scenario.monitor.detector, ChiSquare)
    assert float(scenario.monitor.detector.level) == 0.01
    np.testing.assert_array_equal(scenario.x0, [1.0, 2.0])
    assert [type(a) for a in scenario.attacks] == [Window]
    assert (found.run.steps, found.run.runs, found.run.seed) == (30, 1, 0)
    assert scenario.controller is None
    assert scenario.enforcement is None


def test_defaults(folder):
    sections = SCENARIO.split("\n\n")
    (folder / "short.toml").write_text("\n\n".join(sections[:2]))
    found = read_scenario(folder / "short.toml")
    detector = found.scenario.monitor.detector
    assert isinstance(detector, ChiSquare)
    assert (float(detector.level), detector.on) == (0.01, "residual")
    np.testing.assert_array_equal(found.scenario.x0, [0.0, 0.0])
    assert found.scenario.attacks == ()
    assert (found.run.steps, found.run.runs, found.run.seed) == (1000, 1, 0)


@pytest.mark.parametrize(
    ("estimator", "given", "on"),
    [
        ("kalman", "", "residual"),
        ("unknown_input", "", "attack"),
        ("unknown_input", 'on = "residual"\n', "residual"),
    ],
)
def test_what_the_detector_judges(estimator, given, on, folder):
    found = load(folder, ('"kalman"', f'"{estimator}"'), ("level =", f"{given}level ="))
    assert found.scenario.monitor.detector.on == on


def test_a_detector_with_nothing_to_judge_is_worth_a_warning(folder):
    with pytest.warns(UserWarning, match="estimates no attack"):
        load(folder, ("level =", 'on = "attack"\nlevel ='))


@pytest.mark.parametrize("kind", ["mat", "npz", "csv"])
def test_matrices_from_files(kind, folder):
    value = np.array(A) * np.pi
    (folder / "data").mkdir()
    path = folder / "data" / f"plant.{kind}"
    if kind == "mat":
        scipy.io.savemat(path, {"A": value, "B": np.zeros(3)})
    elif kind == "npz":
        np.savez(path, A=value, B=np.zeros(3))
    else:
        np.savetxt(path, value, delimiter=",", fmt="%.17g")
    name = "" if kind == "csv" else ', name = "A"'
    found = load(folder, (INLINE, f'A = {{ file = "data/plant.{kind}"{name} }}'))
    np.testing.assert_array_equal(found.scenario.plant.A, value)


def test_covariance_from_a_file(folder):
    np.savetxt(folder / "P0.csv", [[4.0, 1.0], [1.0, 9.0]], delimiter=",")
    found = load(folder, ("P0 = [[1.0, 0.0], [0.0, 1.0]]", 'P0 = { file = "P0.csv" }'))
    np.testing.assert_array_equal(found.scenario.monitor.estimator.P0, [[4, 1], [1, 9]])


def test_per_step_matrices(folder, command):
    series = np.stack([np.array(A) * (1 - 0.01 * k) for k in range(12)])
    np.savez(folder / "series.npz", A=series)
    found = load(folder, (INLINE, 'A = { file = "series.npz", name = "A" }'))
    np.testing.assert_array_equal(found.scenario.plant.A, series)
    changed = folder / "changed.toml"
    assert command("replay", changed, folder / "log.csv")[0] == 0
    code, _, err = command("run", changed)
    assert code == 2
    assert "matrices for 12 steps, expected 30" in err


def test_scheduled_matrices(folder):
    table = "A = { grid = [0.0, 10.0], values = [[[1.0, 0.1], [0.0, 1.0]], [[1, 0.2], [0, 0.5]]] }"
    found = load(folder, (INLINE, f'scheduling = "speed"\n{table}'))
    plant = found.scenario.plant
    assert isinstance(plant.A, Table)
    assert plant.schedule == ("state", 1)
    at = plant.at(1, jnp.array([0.0, 5.0]), jnp.zeros(1))
    np.testing.assert_allclose(at.A, [[1.0, 0.15], [0.0, 0.75]], rtol=1e-15)


def test_constraints(folder):
    text = (
        "[plant.constraints]\nstate = { matrix = [[1, 0]], bound = [20] }\n"
        "attack = { matrix = [[1], [-1]], bound = [3.5, 2.5], bound_u = [[-1], [1]] }\n[estimator]"
    )
    limits = load(folder, ("[estimator]", text)).scenario.plant.constraints
    np.testing.assert_array_equal(limits.state.matrix, [[1, 0]])
    np.testing.assert_array_equal(limits.attack.bound, [3.5, 2.5])
    np.testing.assert_array_equal(limits.attack.bound_u, [[-1], [1]])


def test_controller(folder):
    text = (
        '[controller]\nkind = "lqr"\nstate_weight = [[1, 0], [0, 1]]\ninput_weight = [[2]]\n[run]'
    )
    controller = load(folder, ("[run]", text)).scenario.controller
    assert controller.gain.shape == (1, 2)


# a table, and every, for, first for gps and for wheel
ENFORCEMENTS = {
    "every alone": ("every = 20", [(20, 1, 20), (20, 1, 20)]),
    "all keys": ("every = 20\nfor = 3\nfirst = 7", [(20, 3, 7), (20, 3, 7)]),
    "always": ("every = 1\nfor = 5", [(1, 5, 1), (1, 5, 1)]),
    "one sensor": ("[enforcement.sensors.wheel]\nevery = 4\nfor = 2", [(1, 0, 1), (4, 2, 4)]),
    "each its own": (
        "[enforcement.sensors.wheel]\nevery = 4\nfirst = 1\n[enforcement.sensors.gps]\nevery = 9",
        [(9, 1, 9), (4, 1, 1)],
    ),
    "one on its own": (
        "every = 20\nfor = 3\nfirst = 7\n[enforcement.sensors.gps]\nevery = 5",
        [(5, 1, 5), (20, 3, 7)],
    ),
}


@pytest.mark.parametrize("which", ENFORCEMENTS)
def test_enforcement(which, folder):
    text, wanted = ENFORCEMENTS[which]
    found = load(folder, ("[run]", f"[enforcement]\n{text}\n\n[run]")).scenario.enforcement
    np.testing.assert_array_equal(found.every, [row[0] for row in wanted])
    np.testing.assert_array_equal(found.duration, [row[1] for row in wanted])
    np.testing.assert_array_equal(found.first, [row[2] for row in wanted])
    k = np.arange(1, 60, dtype=np.int32)
    on = [[n >= first and (n - first) % every < count for every, count, first in wanted] for n in k]
    np.testing.assert_array_equal(found.at(k), on)


def test_enforcement_reaches_the_run(folder):
    """A lie of 5 for ten rows, of which every other one cannot be told."""
    found = load(folder, ("[run]", "[enforcement]\nevery = 2\n\n[run]"))
    trace = simulate(found.scenario, jax.random.key(0), found.run.steps)
    k = np.arange(1, 31)
    injected = np.where((k >= 10) & (k < 20) & (k % 2 == 1), 5.0, 0.0)
    np.testing.assert_array_equal(np.asarray(trace.injection.y)[:, 0], injected)
    np.testing.assert_array_equal(np.asarray(trace.observation.trusted)[:, 0], k % 2 == 0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["enforcement.every", "nothing", "a whole number from 1 up"]),
        ("for = 2", ["enforcement.every", "nothing", "a whole number from 1 up"]),
        ("every = 0", ["enforcement.every", "found 0", "a whole number from 1 up"]),
        ("every = 2.0", ["enforcement.every", "found 2.0", "a whole number from 1 up"]),
        ("every = true", ["enforcement.every", "found True", "a whole number from 1 up"]),
        ("every = 2\nfor = 0", ["enforcement.for", "found 0", "a whole number from 1 up"]),
        ("every = 2\nfor = 'a'", ["enforcement.for", "found 'a'", "a whole number from 1 up"]),
        ("every = 2\nfirst = -1", ["enforcement.first", "found -1", "a whole number from 1 up"]),
        ("every = 3000000000", ["enforcement.every", "found 3000000000"]),
        ("evry = 2", ["enforcement.evry", "an unknown key", "did you mean 'every'"]),
        ("every = 2\nduration = 1", ["enforcement.duration", "unknown key", "'every', 'for'"]),
        ("sensors = {}", ["enforcement.every", "nothing"]),
        ("sensors = 3", ["enforcement.sensors", "found 3", "[enforcement.sensors.NAME]"]),
        ("sensors = { gps = 3 }", ["enforcement.sensors", "[enforcement.sensors.NAME]"]),
        (
            "[enforcement.sensors.gsp]\nevery = 2",
            ["enforcement.sensors.gsp", "an unknown sensor", "'gps', 'wheel'", "mean 'gps'"],
        ),
        ("[enforcement.sensors.gps]\nfor = 2", ["enforcement.sensors.gps.every", "nothing"]),
        (
            "[enforcement.sensors.gps]\nevery = 2\nform = 1",
            ["enforcement.sensors.gps.form", "an unknown key", "did you mean 'for'"],
        ),
        ("every = 5\n[enforcement.sensors.gps]\nevery = 0", ["sensors.gps.every", "found 0"]),
    ],
)
def test_enforcement_that_cannot_be(text, words, folder, command):
    (folder / "changed.toml").write_text(SCENARIO.replace("[run]", f"[enforcement]\n{text}\n[run]"))
    code, out, err = command("run", folder / "changed.toml")
    assert (code, out, err.count("\n")) == (2, "", 1)
    for word in ["changed.toml", "found", "expected", *words]:
        assert word in err


def test_an_attack_may_ask_for_the_enforcement(folder, monkeypatch):
    """What a builder's parameter ``enforcement`` gets is the scenario's, and no table sets it."""
    given = []

    def build(plant: Plant, *, value: float, enforcement: Enforcement | None, channel: str):
        given.append(enforcement)
        return bias.build(plant, value=value, channel=channel)

    monkeypatch.setitem(catalog.ATTACKS, "aware", build)
    aware = (
        '"bias"\nchannel = "sensor:gps"\nstart = 1.0\nstop = 2.0',
        '"aware"\nchannel = "sensor:gps"',
    )
    load(folder, aware)
    found = load(folder, aware, ("[run]", "[enforcement]\nevery = 3\n\n[run]"))
    assert given[0] is None
    assert given[1] is found.scenario.enforcement
    assert "enforcement" not in model_of(build, 1).model_fields
    assert "\nenforcement" not in scenario_text("aware")
    with pytest.raises(InputError, match=r"attack\[1\].enforcement: found an unknown key"):
        load(folder, aware, ("value = 5.0", "value = 5.0\nenforcement = { every = 2 }"))


def test_python_target(folder):
    (folder / "my_plant.py").write_text(
        "from holdfast.plants.build import linear_plant\n"
        "import numpy as np\n"
        "def make(*, gain: float = 0.5):\n"
        "    return linear_plant(A=gain * np.eye(2), C=np.eye(2), Q=np.eye(2), R=np.eye(2),\n"
        "                        outputs=['gps', 'wheel'])\n"
    )
    start, end = SCENARIO.index("kind"), SCENARIO.index("[estimator]")
    plant = 'kind = "python"\ntarget = "my_plant:make"\ngain = 0.25\n'
    text = SCENARIO[:start] + plant + SCENARIO[end:]
    path = folder / "python.toml"
    path.write_text(text)
    with pytest.raises(InputError, match="--allow-python"):
        read_scenario(path)
    found = read_scenario(path, allow_python=True)
    np.testing.assert_array_equal(found.scenario.plant.A, 0.25 * np.eye(2))
    assert sys.path[0] != str(folder)
    for old, new, word in [
        ("gain = 0.25", "gian = 0.25", "did you mean 'gain'"),
        ("gain = 0.25", 'gain = "a"', "a number"),
        ("my_plant:make", "my_plant:mk", "a function 'mk'"),
        ("my_plant:make", "no_such_module:make", "no_such_module"),
        ("my_plant:make", "my_plant:np", "a function 'np'"),
        ("my_plant:make", "rm -rf", "package.module:function"),
    ]:
        path.write_text(text.replace(old, new))
        with pytest.raises(InputError, match=word):
            read_scenario(path, allow_python=True)


def test_a_threshold_is_calibrated_on_a_log(folder):
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(400, 2)) * 50
    text = "time,u:accel,y:gps,y:wheel\n" + "".join(
        f"{0.1 * k:.1f},0,{a},{b}\n" for k, (a, b) in enumerate(rows.tolist(), 1)
    )
    (folder / "benign.csv").write_text(text)
    found = load(folder, ("level = 0.01", 'level = 0.05\ncalibrate = "benign.csv"'))
    assert found.calibrate == folder / "benign.csv"
    scenario = load_scenario(folder / "changed.toml")
    # the log is far noisier than the plant says, so its quantile lies far above the textbook's
    assert float(scenario.monitor.detector.factor) > 10.0


def test_a_simulated_calibration_is_kept(folder, monkeypatch):
    monkeypatch.setenv("HOLDFAST_CACHE", str(folder / "cache"))
    changes = (
        ('"chi_square"', '"cusum"'),
        ('"kalman"', '"unknown_input"'),
        ("0.01\n\n[[", "0.2\n\n[["),
    )
    load(folder, *changes)
    first = load_scenario(folder / "changed.toml")
    (kept,) = (folder / "cache").glob("calibration-*.json")
    monkeypatch.setattr("holdfast.shell.calibrating.calibrated", None)
    second = load_scenario(folder / "changed.toml")
    assert float(second.monitor.detector.factor) == float(first.monitor.detector.factor)
    monkeypatch.undo()
    monkeypatch.setenv("HOLDFAST_CACHE", str(folder / "cache"))
    kept.write_text("damaged")
    third = load_scenario(folder / "changed.toml")
    assert float(third.monitor.detector.factor) == float(first.monitor.detector.factor)


def test_warnings_take_one_line(folder):
    text = SCENARIO.replace(INLINE, "A = [[0.0, 0.1], [0.0, 0.0]]")
    (folder / "changed.toml").write_text(text)
    code = "from holdfast.shell.cli import main; main()"
    arguments = ["replay", str(folder / "changed.toml"), str(folder / "log.csv")]
    ran = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True
    )
    assert ran.stderr.startswith("warning: A is taken as discrete")
    assert ran.stderr.count("\n") == 1
    assert ran.stdout.count("\n") == 13
