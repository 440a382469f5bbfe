"""Results: the columns, empty cells, exact floats, and files written whole or not at all."""

import csv
import io
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast import loop
from holdfast.plants.build import linear_plant
from holdfast.records import Estimate, Observation, Reason, Status, Trace, Verdict
from holdfast.shell.errors import InputError
from holdfast.shell.files import load_scenario, read_log
from holdfast.shell.results import csv_blocks, write_result
from holdfast.shell.writing import replacing


@pytest.fixture(scope="module")
def plant():
    return linear_plant(
        A=0.5 * np.eye(2), C=np.eye(2), H=np.eye(2), Q=np.eye(2), R=np.eye(2),
        states=["p", "v,x"], outputs=["gps", "wheel"], attacks=["a", "b"], dt=0.1,
    )  # fmt: skip


def trace_of_three_rows():
    inf = np.inf
    x = np.array([[0.1, 0.2], [0.0, 0.0], [1 / 3, -1e-300]])
    x_cov = np.array([np.eye(2), np.eye(2), np.diag([inf, 4.0])])
    d = np.array([[1.0, 2.0], [0.0, 5.0], [3.0, 0.0]])
    d_cov = np.array([np.diag([1.0, 4.0]), np.diag([inf, 9.0]), np.diag([1.0, inf])])
    status = np.array([0, int(Status.NOT_READY), int(Status.MISSING | Status.UNOBSERVABLE)])
    estimate = Estimate(
        *map(jnp.asarray, (x, x_cov, d, d_cov, d, d_cov)),
        jnp.zeros((3, 0, 2)), jnp.zeros((3, 0)), jnp.zeros((3, 2)), jnp.ones((3, 2, 2)),
        jnp.asarray(status, jnp.int32),
    )  # fmt: skip
    verdict = Verdict(
        jnp.array([5.5, 0.0, 12.0]),
        jnp.array([9.0, inf, 9.0]),
        jnp.array([False, False, True]),
        jnp.array([0, 0, int(Reason.ATTACK_CHANNEL)], jnp.int32),
        jnp.array([[False, False], [False, False], [True, True]]),
    )
    return Trace(Observation.of(np.zeros((3, 0)), np.zeros((3, 2))), estimate, verdict)


def rows_of(trace, plant, time):
    return list(csv.DictReader(io.StringIO("".join(csv_blocks(trace, plant, time)))))


def test_columns_and_empty_cells(plant):
    first, second, third = rows_of(trace_of_three_rows(), plant, np.array([0.1, 0.2, 0.3]))
    assert list(first) == [
        "time", "x:p", "x:v,x", "x_sd:p", "x_sd:v,x", "d:a", "d:b", "d_sd:a", "d_sd:b",
        "statistic", "threshold", "alarm", "alarm:a", "alarm:b", "reason", "status",
    ]  # fmt: skip
    assert list(first.values()) == [
        "0.1", "0.1", "0.2", "1.0", "1.0", "1.0", "2.0", "1.0", "2.0", "5.5", "9.0", "0", "0", "0",
        "", "OK",
    ]  # fmt: skip
    # NOT_READY: no state; unobservable: no attack; nothing to test: no statistic
    assert list(second.values()) == [
        "0.2", "", "", "", "", "", "5.0", "", "3.0", "", "", "0", "0", "0", "", "NOT_READY",
    ]  # fmt: skip
    assert (third["x:p"], third["x_sd:p"], third["x:v,x"]) == (repr(1 / 3), "inf", "-1e-300")
    assert (third["d:b"], third["d_sd:b"], third["d:a"]) == ("", "", "3.0")
    assert (third["alarm"], third["alarm:a"], third["reason"]) == ("1", "1", "attack on a+b")
    assert third["status"] == "MISSING+UNOBSERVABLE"


def with_sensor_attack():
    """What an estimator says each sensor's samples are off by: 0 where it believes them."""
    trace = trace_of_three_rows()
    a = jnp.asarray([[0.0, 0.0], [0.0, -2.5], [1 / 3, 0.0]])
    return replace(trace, estimate=replace(trace.estimate, a=a)), np.asarray(a)


def test_sensor_attack_columns(plant):
    """One column per output, after those of the attack channels, in every row."""
    trace, a = with_sensor_attack()
    rows = rows_of(trace, plant, np.array([0.1, 0.2, 0.3]))
    names = list(rows[0])
    at = names.index("d_sd:b") + 1
    assert names[at : at + 3] == ["a:gps", "a:wheel", "statistic"]
    written = [[float(row[f"a:{name}"]) for name in plant.outputs] for row in rows]
    np.testing.assert_array_equal(written, a)
    others = rows_of(trace_of_three_rows(), plant, np.array([0.1, 0.2, 0.3]))
    assert [{k: v for k, v in row.items() if not k.startswith("a:")} for row in rows] == others


def test_netcdf_keeps_the_sensor_attack(folder, plant):
    import xarray as xr

    trace, a = with_sensor_attack()
    time = np.array([0.1, 0.2, 0.3])
    write_result(folder / "with.nc", trace, plant, time)
    write_result(folder / "without.nc", trace_of_three_rows(), plant, time)
    with xr.open_dataset(folder / "with.nc", engine="h5netcdf") as data:
        np.testing.assert_array_equal(data.sensor_attack.values, a)
        assert data.sensor_attack.dims == ("time", "output")
        assert list(data.output.values) == list(plant.outputs)
    with xr.open_dataset(folder / "without.nc", engine="h5netcdf") as data:
        assert "sensor_attack" not in data


FUSING = """
[plant]
kind = "linear"
A = [[1.0, 0.1], [0.0, 0.97]]
C = [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, -1.0]]
Q = [[0.02, 0.01], [0.01, 0.03]]
R = [[0.1, 0, 0, 0], [0, 0.1, 0, 0], [0, 0, 0.1, 0], [0, 0, 0, 0.1]]
outputs = ["gps", "wheel", "flow", "radar"]
dt = 0.1
[estimator]
kind = "secure_fusion"
gamma = 2.0
[detector]
kind = "chi_square"
threshold = 13.0
"""


def test_replay_names_the_lying_sensor(folder, command):
    """From a log on disk: gps is off by 50 from row 40 on, and the others are believed."""
    (folder / "fusing.toml").write_text(FUSING)
    rng = np.random.default_rng(0)
    y = 0.3 * rng.normal(size=(80, 4))
    y[40:, 0] += 50.0
    lines = ["time,y:gps,y:wheel,y:flow,y:radar"]
    lines += [",".join(map(repr, [0.1 * (k + 1), *map(float, row)])) for k, row in enumerate(y)]
    (folder / "fusing.csv").write_text("\n".join(lines) + "\n")
    code, out, err = command("replay", folder / "fusing.toml", folder / "fusing.csv")
    assert (code, err) == (0, "")
    rows = list(csv.DictReader(io.StringIO(out)))
    a = np.array(
        [[float(row[f"a:{n}"]) for n in ("gps", "wheel", "flow", "radar")] for row in rows]
    )
    assert not np.any(a[:40])
    assert not np.any(a[:, 1:])
    # a sample and the estimate of the others, 0.3 and less each: 5 of them
    np.testing.assert_allclose(a[45:, 0], 50.0, atol=5 * np.hypot(0.3, 0.3))


def test_replay_writes_exactly_what_the_loop_says(folder, command):
    scenario = load_scenario(folder / "scenario.toml")
    log = read_log(folder / "log.csv", scenario.plant)
    trace = loop.replay(scenario.monitor, log.observation)
    code, out, err = command(
        "replay", folder / "scenario.toml", folder / "log.csv", "-o", folder / "est.csv"
    )
    assert (code, out, err) == (0, "", "")
    text = (folder / "est.csv").read_text()
    assert text == command("replay", folder / "scenario.toml", folder / "log.csv")[1]
    rows = list(csv.DictReader(io.StringIO(text)))
    x = [[float(row["x:position"]), float(row["x:speed"])] for row in rows]
    sd = [[float(row["x_sd:position"]), float(row["x_sd:speed"])] for row in rows]
    np.testing.assert_array_equal(x, trace.estimate.x)
    variances = np.diagonal(trace.estimate.x_cov, axis1=1, axis2=2)
    np.testing.assert_array_equal(sd, np.sqrt(variances))
    np.testing.assert_array_equal(
        [float(row["statistic"]) for row in rows], trace.verdict.statistic
    )
    assert not any(name.startswith("d:") for name in rows[0])


def test_many_rows_are_written_in_blocks(monkeypatch, plant):
    monkeypatch.setattr("holdfast.shell.results.BLOCK", 2)
    trace = trace_of_three_rows()
    assert len(rows_of(trace, plant, np.arange(3.0))) == 3
    longer = jax.tree.map(lambda a: jnp.concatenate([a] * 5), trace)
    assert [r["time"] for r in rows_of(longer, plant, np.arange(15.0))] == [
        repr(float(k)) for k in range(15)
    ]


def test_netcdf_keeps_covariances(folder, plant):
    import xarray as xr

    trace = trace_of_three_rows()
    write_result(folder / "est.nc", trace, plant, np.array([0.1, 0.2, 0.3]))
    with xr.open_dataset(folder / "est.nc", engine="h5netcdf") as data:
        np.testing.assert_array_equal(data.x_cov.values, trace.estimate.x_cov)
        assert list(data.state.values) == list(plant.states)


def test_a_failure_leaves_the_old_file_alone(tmp_path):
    target = tmp_path / "est.csv"
    target.write_text("old")

    def fail():
        with replacing(target) as temporary:
            temporary.write_text("new, but not who")
            raise ValueError("halfway")

    with pytest.raises(ValueError, match="halfway"):
        fail()
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["est.csv"]


def test_a_link_is_written_through(tmp_path):
    (tmp_path / "real.csv").write_text("old")
    (tmp_path / "link.csv").symlink_to("real.csv")
    with replacing(tmp_path / "link.csv") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link.csv").is_symlink()
    assert (tmp_path / "real.csv").read_text() == "new"


def test_no_space_is_an_error_of_one_line(tmp_path):
    with pytest.raises(InputError, match="No space"), replacing(tmp_path / "est.csv"):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.iterdir()) == []
