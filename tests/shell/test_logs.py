"""Logs: what each format says, gaps and faults, and time."""

import time

import jax
import numpy as np
import pytest
import xarray as xr

from holdfast import loop
from holdfast.records import Status
from holdfast.shell.errors import InputError
from holdfast.shell.files import load_scenario, read_log
from holdfast.shell.results import write_result

HEADER = "time,u:accel,y:gps,y:wheel,trusted:gps\n"


@pytest.fixture
def plant(folder):
    return load_scenario(folder / "scenario.toml").plant


def read(folder, plant, text, name="given.csv"):
    (folder / name).write_text(text)
    return read_log(folder / name, plant)


def test_gaps_faults_and_trust(folder, plant):
    log = read(
        folder,
        plant,
        HEADER + "5.0,,1.5,nan,1\n5.1,2.5,,3.5,\n5.2,nan,inf,4.5,0\n5.3,,6.5,7.5,1\n",
    )
    o = log.observation
    np.testing.assert_array_equal(log.time, [5.0, 5.1, 5.2, 5.3])
    # an empty u is held (0 before the first), a nan stays for the screen to judge
    np.testing.assert_array_equal(o.u[:, 0], [0.0, 2.5, np.nan, 2.5])
    np.testing.assert_array_equal(o.seen, [[1, 1], [0, 1], [1, 1], [1, 1]])
    np.testing.assert_array_equal(o.y, [[1.5, np.nan], [0, 3.5], [np.inf, 4.5], [6.5, 7.5]])
    np.testing.assert_array_equal(o.trusted, [[1, 0], [0, 0], [0, 0], [1, 0]])
    missing = int(Status.MISSING)
    np.testing.assert_array_equal(o.status, [missing, 0, 0, missing])
    assert not np.any(log.filled)


def test_statuses_of_a_replay(folder):
    scenario = load_scenario(folder / "scenario.toml")
    log = read(
        folder,
        scenario.plant,
        "time,u:accel,y:gps,y:wheel\n0.1,1,2,3\n0.2,1,,3\n0.3,1,nan,3\n0.4,,1,3\n0.5,inf,,3\n",
    )
    found = loop.replay(scenario.monitor, log.observation).estimate.status
    words = [Status(int(s)).words for s in found]
    assert words == ["OK", "MISSING", "BAD_INPUT", "MISSING", "MISSING+BAD_INPUT"]


def test_rows_that_are_absent_are_filled(folder, plant):
    log = read(folder, plant, "time,u:accel,y:gps,y:wheel\n1.0,1,2,3\n1.4,5,6,7\n1.5,8,9,1\n")
    np.testing.assert_allclose(log.time, [1.0, 1.1, 1.2, 1.3, 1.4, 1.5], rtol=1e-15)
    np.testing.assert_array_equal(log.filled, [0, 1, 1, 1, 0, 0])
    o = log.observation
    np.testing.assert_array_equal(o.u[:, 0], [1, 1, 1, 1, 5, 8])
    np.testing.assert_array_equal(o.seen[:, 0], [1, 0, 0, 0, 1, 1])
    np.testing.assert_array_equal(o.y[:, 1], [3, 0, 0, 0, 7, 1])
    np.testing.assert_array_equal(o.status, np.array([0, 1, 1, 1, 0, 0]) * int(Status.MISSING))


def test_stamps_may_scatter_and_drift_by_ten_per_cent(folder, plant):
    rng = np.random.default_rng(1)
    scatter = 0.1 * np.arange(1, 200) + rng.uniform(-0.0099, 0.0099, 199)
    scatter[0] = 0.1
    drift = 0.1 * 1.09 * np.arange(1, 200)
    for stamps in (scatter, drift):
        lines = "".join(f"{t!r},0,0,0\n" for t in stamps.tolist())
        log = read(folder, plant, "time,u:accel,y:gps,y:wheel\n" + lines)
        assert len(log.time) == 199
        np.testing.assert_array_equal(log.time, stamps)


def test_spaces_order_other_columns_and_a_byte_order_mark(folder, plant):
    text = "\ufeffnote,y:wheel, u:accel ,y:gps,time,x:position\r\nfine, 3 ,1,2,0.1,9\r\n\r\n"
    o = read(folder, plant, text).observation
    assert (o.u.tolist(), o.y.tolist()) == ([[1.0]], [[2.0, 3.0]])


def test_standard_input(folder, command):
    text = (folder / "log.csv").read_bytes()
    _, from_file, _ = command("replay", folder / "scenario.toml", folder / "log.csv")
    code, out, err = command("replay", folder / "scenario.toml", "-", stdin=text)
    assert (code, out, err) == (0, from_file, "")


def test_npz_says_what_csv_says(folder, plant):
    csv = read(folder, plant, HEADER + "0.1,,2,3,1\n0.2,1,,nan,0\n0.4,2,4,5,\n")
    nan = np.nan
    np.savez(
        folder / "log.npz",
        **{
            "time": [0.1, 0.2, 0.4], "u:accel": [7.0, 1, 2], "sent:accel": [0, 1, 1],
            "y:gps": [2.0, 9, 4], "seen:gps": [True, False, True], "y:wheel": [3, nan, 5],
            "trusted:gps": [1, 0, 0],
        },
    )  # fmt: skip
    npz = read_log(folder / "log.npz", plant)
    jax.tree.map(np.testing.assert_array_equal, csv.observation, npz.observation)
    np.testing.assert_array_equal(csv.time, npz.time)


def test_result_is_again_a_log(folder):
    scenario = load_scenario(folder / "scenario.toml")
    log = read(
        folder, scenario.plant, HEADER + "0.1,1,2,3,1\n0.2,1,,4,0\n0.3,1,nan,4,\n0.5,2,4,5,0\n"
    )
    trace = loop.replay(scenario.monitor, log.observation)
    write_result(folder / "est.nc", trace, scenario.plant, log.time)
    again = read_log(folder / "est.nc", scenario.plant)
    np.testing.assert_array_equal(again.time, log.time)
    for name in ("u", "y", "seen", "trusted"):
        np.testing.assert_array_equal(
            getattr(again.observation, name), getattr(log.observation, name), err_msg=name
        )
    repeated = loop.replay(scenario.monitor, again.observation)
    for name in ("x", "x_cov", "status"):
        np.testing.assert_array_equal(
            getattr(repeated.estimate, name), getattr(trace.estimate, name), err_msg=name
        )


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda d: d.drop_vars("y"), ["y", "no such variable"]),
        (lambda d: d.isel(output=[0]), ["y, output", "no 'wheel'"]),
        (lambda d: d.transpose(), ["numbers (time, "]),
        (lambda d: d.drop_dims("time"), ["time", "no times"]),
        (lambda d: xr.concat([d, d], "run"), ["run", "2 runs"]),
    ],
)
def test_netcdf_that_is_no_log(folder, plant, spoil, words):
    data = xr.Dataset(
        {"u": (("time", "input"), np.ones((2, 1))), "y": (("time", "output"), np.ones((2, 2)))},
        {"time": [0.1, 0.2], "input": ["accel"], "output": ["gps", "wheel"]},
    )
    data.to_netcdf(folder / "log.nc", engine="h5netcdf")
    assert read_log(folder / "log.nc", plant).observation.y.shape == (2, 2)
    spoil(data).to_netcdf(folder / "bad.nc", engine="h5netcdf")
    with pytest.raises(InputError) as error:
        read_log(folder / "bad.nc", plant)
    for word in [*words, "bad.nc"]:
        assert word in str(error.value)


def test_a_large_log_is_read_fast(folder, plant):
    rows = np.random.default_rng(0).normal(size=(100_000, 3))
    lines = (f"{0.1 * k:.1f},{a},{b},{c},1\n" for k, (a, b, c) in enumerate(rows.tolist(), 1))
    (folder / "large.csv").write_text(HEADER + "".join(lines))
    start = time.process_time()
    log = read_log(folder / "large.csv", plant)
    assert time.process_time() - start < 1.5
    np.testing.assert_array_equal(log.observation.y, rows[:, 1:])
