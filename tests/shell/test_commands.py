"""The commands: run, new, info, help; and what surrounds them."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr

from holdfast import __version__, catalog, loop
from holdfast.shell import runtime
from holdfast.shell.errors import InputError
from holdfast.shell.files import load_scenario, read_scenario
from holdfast.shell.simulating import simulated
from holdfast.shell.template import scenario_text

HOLDFAST = [sys.executable, "-c", "from holdfast.shell.cli import main; main()"]


def test_run_writes_a_report(folder, command, monkeypatch):
    # simulated at length elsewhere
    monkeypatch.setattr("holdfast.campaign.blindness.blindness", lambda *_, **__: [])
    path, report = folder / "scenario.toml", folder / "new" / "report"
    code, out, err = command("run", path, "-o", report, "--runs", "3", "--seed", "7")
    assert (code, err) == (0, "")
    assert out.strip() == str(report / "report.html")
    found = {p.name for p in report.iterdir()}
    assert {"report.html", "result.nc", "scores.json", "scenario.toml", "figures"} <= found
    assert (report / "scenario.toml").read_text() == path.read_text()
    scores = json.loads((report / "scores.json").read_text())
    assert (scores["runs"], scores["rows"]) == (3, 30)
    assert scores["attack"] == {"start_s": pytest.approx(1.0), "stop_s": pytest.approx(2.0)}
    scenario = load_scenario(path)
    second = loop.simulate(scenario, jax.random.fold_in(jax.random.key(7), 1), 30)
    with xr.open_dataset(report / "result.nc", engine="h5netcdf") as data:
        assert data.sizes["run"] == 3
        np.testing.assert_allclose(data.time.values, 0.1 * np.arange(1, 31), rtol=1e-15)
        np.testing.assert_allclose(data.x.values[1], second.estimate.x, rtol=0, atol=1e-12)


def test_run_prints_scores(folder, command):
    code, out, err = command("run", folder / "scenario.toml")
    assert (code, err) == (0, "")
    assert "state.position.rmse" in out
    assert "detection.runs" in out
    assert "exact for Gaussian noise" in out


def test_runs_do_not_depend_on_how_many_there_are(folder, monkeypatch):
    scenario = load_scenario(folder / "scenario.toml")
    few, _ = simulated(scenario, 20, 2, 3, "f")
    monkeypatch.setattr("holdfast.shell.simulating.BLOCK_ROWS", 40)
    many, _ = simulated(scenario, 20, 4, 3, "f")
    one, _ = simulated(scenario, 20, 1, 3, "f")
    assert many.observation.y.shape == (4, 20, 2)
    np.testing.assert_array_equal(many.observation.y[:2], few.observation.y)
    np.testing.assert_allclose(one.observation.y, few.observation.y[0], rtol=0, atol=1e-12)
    assert np.all(many.observation.y[2] != many.observation.y[3])


def test_more_than_fits_is_refused_before_it_starts(folder):
    scenario = load_scenario(folder / "scenario.toml")
    with pytest.raises(InputError, match="GiB"):
        simulated(scenario, 10**6, 10**6, 0, "f")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [None, *(k for s in catalog.SECTIONS.values() for k in s)])
def test_a_template_of_every_kind_loads(kind, tmp_path):
    text = scenario_text(kind)
    path = tmp_path / "new.toml"
    path.write_text(text)
    read_scenario(path)
    if kind is not None:
        assert f'kind = "{kind}"' in text
    # what is commented out is real: every key shown can be given
    given = re.sub(
        r"^# (?!state |attack |calibrate )((?:[a-z_]+ = (?!\.\.))|\[enforcement\])",
        r"\1",
        text,
        flags=re.MULTILINE,
    )
    assert "\n# " in text
    path.write_text(given)
    assert read_scenario(path).scenario.enforcement is not None


def test_the_template_runs(tmp_path, command):
    (tmp_path / "new.toml").write_text(command("new")[1])
    code, out, _ = command("run", tmp_path / "new.toml", "--runs", "2")
    assert code == 0
    assert "attack_estimate.accel_attack.rmse" in out


def test_new_of_an_unknown_kind(command):
    code, out, err = command("new", "cusom")
    assert (code, out) == (2, "")
    assert "did you mean 'cusum'" in err
    assert err.count("\n") == 1


def test_info_names_everything(command):
    code, out, _ = command("info")
    assert code == 0
    for word in [__version__, jax.__version__, "float64", "cpu", "HOLDFAST_CACHE"]:
        assert word in out
    for parts in catalog.SECTIONS.values():
        for name in parts:
            assert name in out


def test_help_does_not_wait_for_jax():
    code = (
        "import sys; sys.argv = ['holdfast', '--help']\n"
        "from holdfast.shell.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "assert not {'jax', 'numpy', 'pydantic', 'equinox'} & set(sys.modules)\n"
    )
    start = time.perf_counter()
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    # 0.2 s on a free machine; others may be busy on this one
    assert time.perf_counter() - start < 3.0
    for name in ("replay", "run", "new", "info"):
        assert name in ran.stdout


def test_a_reader_that_leaves_early_is_no_error(folder):
    lines = (folder / "log.csv").read_text().splitlines()
    rows = [f"{0.1 * k:.1f},0,0,0" for k in range(1, 5001)]
    (folder / "long.csv").write_text("\n".join([lines[0], *rows]) + "\n")
    command = [*HOLDFAST, "replay", str(folder / "scenario.toml"), str(folder / "long.csv")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout.readline().startswith(b"time,")
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() in (0, 1)


def test_compiled_code_is_kept_in_a_folder_of_ones_own(tmp_path, monkeypatch):
    monkeypatch.delenv("HOLDFAST_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = runtime.cache_folder()
    assert folder == tmp_path / "holdfast"
    assert folder.stat().st_mode & 0o777 == 0o700
    monkeypatch.setenv("HOLDFAST_CACHE", str(tmp_path / "other"))
    assert runtime.cache_folder() == tmp_path / "other"
    monkeypatch.setenv("HOLDFAST_CACHE", "off")
    assert runtime.cache_folder() is None


def test_a_folder_that_others_can_write_to_is_not_used(tmp_path, monkeypatch):
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    monkeypatch.setenv("HOLDFAST_CACHE", str(shared))
    assert runtime.cache_folder() is None
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HOLDFAST_CACHE", str(tmp_path / "file" / "below"))
    assert runtime.cache_folder() is None


def test_public_names_are_loaded():
    import holdfast

    assert holdfast.load_scenario is load_scenario
    assert Path(holdfast.__file__).parent.name == "holdfast"
