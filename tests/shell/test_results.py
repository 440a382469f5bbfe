"""Results: the columns, empty cells, exact floats, and files written whole or not at all."""

import csv
import io

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
