"""`holdfast campaign`: the same numbers whoever computes them, and however often it is stopped."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest
import xarray as xr

from holdfast.campaign.blocks import single
from holdfast.report import campaign_figures, campaign_page
from holdfast.shell import block_files, campaigning, executors, writing
from holdfast.shell.points import prepare
from holdfast.shell.study import read_study
from studied import KALMAN, documented, scenario_text, study_text

AXES = '"attack.value" = [0.5, 2.0]'
SEEN = "state_rmse", "detection_delay", "false_alarms", "missed", "nees"


@pytest.fixture
def study(tmp_path):
    (tmp_path / "scenario.toml").write_text(scenario_text())
    path = tmp_path / "study.toml"
    path.write_text(study_text(AXES, runs=600, steps=30))
    return path


@pytest.fixture
def ran(study, command):
    """The result of the study in a folder of its own, after the options given."""

    def run(*options, folder="out"):
        place = study.parent / folder
        code, _, err = command("campaign", study, "-o", place, *options)
        assert code == 0, err
        return result_of(place)

    return run


@pytest.fixture(autouse=True)
def undrawn(request, monkeypatch):
    """Figures take longer than these runs: drawn where they are looked for."""
    if request.function is not test_what_is_written:
        monkeypatch.setattr(campaign_figures, "figures", lambda found: {})
        monkeypatch.setattr(campaign_page, "page", lambda found: "")


def result_of(folder):
    with xr.open_dataset(Path(folder) / "result.nc", engine="h5netcdf") as found:
        return found.load()


def same(one, two):
    assert set(one.data_vars) == set(two.data_vars)
    for name in one.data_vars:
        np.testing.assert_array_equal(one[name].values, two[name].values, err_msg=name)


def test_what_is_written(ran, study):
    found = ran("--workers", "2")
    folder = study.parent / "out"
    assert found.sizes["run"] == 600
    assert found["attack.value"].values.tolist() == [0.5, 2.0]
    assert found.state_rmse.dims == ("attack.value", "run", "state")
    mean = found.summary.sel(score="state_rmse:place", statistic="mean").values
    np.testing.assert_allclose(mean, found.state_rmse.sel(state="place").mean("run").values)
    assert mean[1] > mean[0]
    assert found.attrs["command"] == "holdfast campaign study.toml -o out"
    table = pd.read_csv(folder / "summary.csv")
    assert set(table["attack.value"]) == {0.5, 2.0}
    manifest = json.loads((folder / "manifest.json").read_text())
    files = sorted(p.name for p in (folder / "blocks").iterdir())
    assert sorted(manifest["blocks"]) == files
    assert manifest["versions"]["jax"] == jax.__version__
    assert (folder / "study.toml").read_text() == study.read_text()
    assert "<html" in (folder / "report.html").read_text()


def test_a_run_alone_is_the_run_of_the_campaign(ran, study):
    found, prepared = ran(), prepare(read_study(study), False)
    for point, number in ((0, 0), (1, 255), (1, 599)):
        case, key = prepared.cases[point], prepared.keys[point]
        trace = single(case, key, number)
        kept = sum(leaf.nbytes for leaf in jax.tree.leaves(trace))
        assert found.attrs["bytes_per_step"] == pytest.approx(kept / case.steps)
        error = np.asarray(trace.estimate.x - trace.x)
        ours = found.state_rmse.isel({"attack.value": point, "run": number}).values
        np.testing.assert_allclose(ours, np.sqrt(np.mean(error**2, 0)), rtol=1e-12)
        alarms = np.asarray(trace.verdict.alarm)[:20]  # before the attack
        before = found.false_alarms.isel({"attack.value": point, "run": number})
        assert before == alarms[:19].sum()


@pytest.mark.filterwarnings("always:.*damaged")
def test_workers_files_and_stops_change_nothing(ran, study, command, monkeypatch):
    whole = ran("--workers", "1")
    same(whole, ran("--workers", "2", folder="two"))
    monkeypatch.setattr(campaigning, "FILES_PER_POINT", 1)
    same(whole, ran(folder="one_file"))
    # what is missing or damaged is made again, and nothing else
    place = study.parent / "out"
    files = sorted((place / "blocks").iterdir())
    files[0].unlink()
    files[3].write_bytes(files[3].read_bytes()[:-7])
    (place / "result.nc").unlink()
    times = {p: p.stat().st_mtime_ns for p in files if p not in (files[0], files[3])}
    code, _, err = command("campaign", study, "-o", place)
    assert code == 0
    assert "damaged; its runs are made again" in err
    same(whole, result_of(place))
    assert {p: p.stat().st_mtime_ns for p in times} == times


def test_more_runs_and_more_values_go_on(ran, study):
    first = ran()
    study.write_text(study_text('"attack.value" = [0.5, 1.0, 2.0]', runs=700, steps=30))
    more = ran()
    assert dict(more.sizes)["run"] == 700
    old = more.sel({"attack.value": [0.5, 2.0]}).isel(run=slice(0, 600))
    for name in SEEN:
        np.testing.assert_array_equal(old[name].values, first[name].values)
    study.write_text(study_text(AXES, runs=300, steps=30))
    fewer = ran()
    np.testing.assert_array_equal(
        fewer.state_rmse.values, first.state_rmse.isel(run=slice(0, 300)).values
    )


LQR = """
[controller]
kind = "lqr"
state_weight = [[1.0, 0.0], [0.0, 1.0]]
input_weight = [[1.0]]
"""


@pytest.mark.slow
def test_the_control_cost_lost_is_that_of_pairs_of_runs(ran, study, monkeypatch):
    """As the documentation computes it: run by run, the same noise with the attack and without."""
    (study.parent / "scenario.toml").write_text(scenario_text(KALMAN, LQR))
    pushed = '{ kind = "bias", channel = "actuator:accel", start = 1, value = 0.02 }'
    study.write_text(study_text(f'"attack" = [[], {pushed}]', runs=40, common_noise="true"))
    ran()
    monkeypatch.chdir(study.parent)
    names = {"xarray": xr}
    exec(documented("control_cost"), names)
    cost, lost = names["cost"], names["lost"]
    assert cost.dims == ("attack", "run")
    assert lost.dims == ("run",)
    prepared = prepare(read_study(study), False)
    for run in (0, 39):
        one, two = (single(c, prepared.keys[0], run) for c in prepared.cases)
        without, under = (
            float(np.mean(np.sum(np.square(t.x), 1) + np.square(t.observation.u[:, 0])))
            for t in (one, two)
        )
        np.testing.assert_allclose(lost.isel(run=run), under - without, rtol=1e-9)
    # of a weak attack the difference of a pair varies far less than the costs do
    assert lost.std() < 0.3 * cost.sel(attack="none").std()
    mean = result_of(study.parent / "out").summary.sel(score="control_cost", statistic="mean")
    np.testing.assert_allclose(mean, cost.mean("run"), rtol=1e-12)


def test_the_summary_without_a_folder(study, command):
    code, out, err = command("campaign", study)
    assert code == 0
    assert "2 points of 600 runs, 30 steps; 1 program to compile" in err
    assert "state_rmse:place" in out
    assert "detected_share" in out


def test_a_folder_of_something_else(ran, study, command):
    ran()
    study.write_text(study_text(AXES, runs=600, steps=31))
    code, out, err = command("campaign", study, "-o", study.parent / "out")
    assert (code, out) == (2, "")
    assert "another scenario or other settings" in err
    code, _, err = command("campaign", study, "-o", study.parent)
    assert code == 2
    assert "holds something else" in err
    (study.parent / "file").write_text("")
    code, _, err = command("campaign", study, "-o", study.parent / "file" / "out")
    assert code == 2
    assert not (study.parent / "other").exists()


def test_other_versions_are_not_mixed(ran, study, command):
    ran()
    path = study.parent / "out" / "manifest.json"
    path.write_text(path.read_text().replace(f'"jax": "{jax.__version__}"', '"jax": "0.1"'))
    code, _, err = command("campaign", study, "-o", study.parent / "out")
    assert code == 2
    assert "blocks made with jax 0.1" in err


def test_a_full_disk_keeps_what_is_finished(ran, study, command, monkeypatch):
    """The third block cannot be written: a line, exit code 2, nothing half-written."""
    replace, count = os.replace, 0

    def full(source, target):
        nonlocal count
        if Path(target).suffix == ".npz":
            count += 1
            if count == 3:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(writing.os, "replace", full)
        code, _, err = command("campaign", study, "-o", study.parent / "out", "--workers", "1")
    assert code == 2
    assert "No space left" in err
    assert err.count("\n") == 3  # what is run, in two lines, and what went wrong
    blocks = study.parent / "out" / "blocks"
    assert len(list(blocks.iterdir())) == 2
    assert not (study.parent / "out" / "result.nc").exists()
    same(ran(), ran(folder="again"))


def test_an_interrupt_keeps_what_is_finished(ran, study, command, monkeypatch):
    write, count = block_files.BlockFiles.write, 0

    def interrupted(self, *args):
        nonlocal count
        count += 1
        if count == 3:
            raise KeyboardInterrupt
        write(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(block_files.BlockFiles, "write", interrupted)
        code, _, err = command("campaign", study, "-o", study.parent / "out", "--workers", "1")
    assert code == 130
    assert "the same command goes on" in err
    same(ran(), ran(folder="again"))


def test_a_scheduler_that_is_not_there(study, command, monkeypatch):
    monkeypatch.setattr(executors, "TIMEOUT_S", 1.0)
    code, out, err = command(
        "campaign", study, "-o", study.parent / "out", "--scheduler", "tcp://127.0.0.1:9"
    )
    assert (code, out) == (2, "")
    assert "--scheduler" in err
    assert "the address of a running scheduler" in err
    assert not (study.parent / "out").exists()


@pytest.mark.slow
def test_killed_and_resumed(ran, study):
    """kill -9 at a moment when some blocks are there and others are not, again and again."""
    study.write_text(study_text(AXES, runs=20_000, steps=30))
    folder = study.parent / "killed"
    program = Path(sys.executable).with_name("holdfast")
    line = [str(program), "campaign", str(study), "-o", str(folder)]
    kills = 0
    for wanted in (1, 6, 15):
        process = subprocess.Popen(line, stderr=subprocess.DEVNULL)
        while process.poll() is None and len(finished(folder)) < wanted:
            time.sleep(0.002)
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
            kills += 1
        process.wait()
    assert kills == 3
    before = {p: p.stat().st_mtime_ns for p in finished(folder)}
    assert len(before) >= 15
    assert subprocess.run(line, check=False, capture_output=True).returncode == 0
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert len(finished(folder)) == len({p.name.rsplit("-", 1)[0] for p in finished(folder)})
    same(result_of(folder), ran("--workers", "1"))


def finished(folder):
    """Blocks that are there, those that are being written left out."""
    return [p for p in (folder / "blocks").glob("*.npz") if not p.name.startswith(".")]


@pytest.mark.slow
@pytest.mark.parametrize(
    "workers", [*(pytest.param(n, marks=pytest.mark.whole) for n in (1, 2)), 4]
)
def test_a_cluster_gives_the_same(ran, study, workers):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=workers, threads_per_worker=1, dashboard_address="127.0.0.1:0"
    ) as cluster:
        same(ran(folder="here"), ran("--scheduler", cluster.scheduler_address))


@pytest.mark.slow
def test_a_worker_that_is_killed_is_made_up_for(ran, study, monkeypatch):
    distributed = pytest.importorskip("distributed")
    study.write_text(study_text(AXES, runs=20_000, steps=30))
    write, killed = block_files.BlockFiles.write, []
    with distributed.LocalCluster(
        n_workers=3, threads_per_worker=1, dashboard_address="127.0.0.1:0"
    ) as cluster:

        def killing(self, *args):
            write(self, *args)
            if not killed:
                process = next(iter(cluster.workers.values())).process.process
                killed.append(process.pid)
                os.kill(process.pid, signal.SIGKILL)

        with monkeypatch.context() as patch:
            patch.setattr(block_files.BlockFiles, "write", killing)
            found = ran("--scheduler", cluster.scheduler_address)
    assert killed
    same(found, ran(folder="here"))


@pytest.mark.slow
def test_a_scheduler_that_dies_keeps_what_is_finished(ran, study, command, monkeypatch):
    pytest.importorskip("distributed")
    study.write_text(study_text(AXES, runs=100_000, steps=30))
    python = [sys.executable, "-m"]
    port = 18_786 + os.getpid() % 1000
    address = f"tcp://127.0.0.1:{port}"
    scheduler = subprocess.Popen(
        [*python, "distributed.cli.dask_scheduler", "--port", str(port), "--no-dashboard"],
        stderr=subprocess.DEVNULL,
    )
    worker = subprocess.Popen(
        [*python, "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"],
        stderr=subprocess.DEVNULL,
    )
    write, count = block_files.BlockFiles.write, 0

    def killing(self, *args):
        nonlocal count
        write(self, *args)
        count += 1
        if count == 3:
            scheduler.kill()

    try:
        monkeypatch.setattr(block_files.BlockFiles, "write", killing)
        time.sleep(5)
        code, out, err = command(
            "campaign", study, "-o", study.parent / "out", "--scheduler", address
        )
    finally:
        for process in (worker, scheduler):
            process.kill()
            process.wait()
    assert (code, out) == (2, "")
    assert "a scheduler that went away" in err
    assert len(finished(study.parent / "out")) >= 3
