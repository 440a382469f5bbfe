"""Full records of a campaign in a Zarr store: those of `single`, whole or not there."""

import json
import sys

import jax
import numpy as np
import pytest
import xarray as xr

from holdfast.campaign import blocks
from holdfast.campaign.blocks import single
from holdfast.report import campaign_figures, campaign_page
from holdfast.shell import traces
from holdfast.shell.block_files import BlockFiles
from holdfast.shell.errors import InputError
from holdfast.shell.points import prepare
from holdfast.shell.study import read_study
from holdfast.shell.writing import replacing_folder
from studied import documented, scenario_text, study_text

AXES = """
"estimator" = [{ label = "plain", kind = "kalman", x0 = [0, 0], P0 = [1, 1] },
               { kind = "nisme", x0 = [0, 0], P0 = [1, 1], attack_prior_sd = [20.0, 10.0] }]
"attack.value" = [0.5, 2.0]
"""
FEW = '"attack.value" = [0.5, 2.0]'


@pytest.fixture
def study(tmp_path, monkeypatch):
    monkeypatch.setattr(campaign_figures, "figures", lambda found: {})
    monkeypatch.setattr(campaign_page, "page", lambda found: "")
    (tmp_path / "scenario.toml").write_text(scenario_text())

    def write(axes=FEW, runs=5, steps=30, **settings):
        path = tmp_path / "study.toml"
        path.write_text(study_text(axes, runs=runs, steps=steps, **{"traces": 3} | settings))
        return path

    return write


@pytest.fixture
def ran(command):
    """The store of a study in a folder of its own."""

    def run(study):
        place = study.parent / "out"
        code, _, err = command("campaign", study, "-o", place)
        assert code == 0, err
        return place / traces.STORE

    return run


def written(path):
    """A study and its store alone, without the blocks."""
    ready = prepare(read_study(path), False)
    files = BlockFiles(path.parent / "out", ready.study)
    files.begin()
    traces.write_traces(files, ready)
    return ready, files.folder / traces.STORE


def files_of(store):
    return {
        p.relative_to(store): (p.stat().st_mtime_ns, p.read_bytes())
        for p in store.rglob("*")
        if p.is_file()
    }


def bytes_of(store):
    return {name: content for name, (_, content) in files_of(store).items()}


def sd(cov):
    return np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0))


@pytest.mark.slow
def test_every_record_is_that_of_the_run_alone(study, monkeypatch):
    path = study(AXES)
    ready, store = written(path)
    assert len(ready.cases) == 4
    for number, (case, key) in enumerate(zip(ready.cases, ready.keys, strict=True)):
        found = xr.open_zarr(store, group=str(number)).load()
        assert found.attrs == ready.study.labels_of(ready.study.points[number])
        assert dict(found.sizes)["run"] == 3
        np.testing.assert_array_equal(found.time, 0.1 * np.arange(1, 31))
        assert found.state.values.tolist() == ["place", "speed"]
        for run in range(3):
            trace = jax.tree.map(np.asarray, single(case, key, run))
            o, e, v, i = trace.observation, trace.estimate, trace.verdict, trace.injection
            wanted = {
                "true_x": trace.x, "u": o.u, "y": o.y, "seen": o.seen, "trusted": o.trusted,
                "x": e.x, "x_sd": sd(e.x_cov), "status": e.status, "statistic": v.statistic,
                "threshold": v.threshold, "alarm": v.alarm, "injected_u": i.u,
                "injected_y": i.y, "injected_d": i.d,
            }  # fmt: skip
            if number >= 2:
                wanted |= {"d": e.d, "d_sd": sd(e.d_cov), "p": e.p, "mode": e.mode}
                assert found.bank.values.tolist() == list(trace.modes)
                assert found.named.values.tolist() == list(trace.named)
            assert set(found.data_vars) == set(wanted)
            for name, values in wanted.items():
                one = found[name].isel(run=run)
                assert one.dtype == values.dtype, name
                np.testing.assert_array_equal(one.values, values, err_msg=name)
        assert found.injected_d.dims == ("run", "time", "attack")
        assert found.status.dims == ("run", "time")
        assert np.any(found.injected_d.sel(attack="gps_spoof"))
    monkeypatch.chdir(path.parent)
    names = {"xarray": xr}
    exec(documented("open_zarr"), names)
    assert names["found"].attrs == {"estimator": "nisme", "attack.value": 2.0}


def test_one_program_for_all_runs_and_points(study, monkeypatch):
    ready, traced, simulate = prepare(read_study(study(steps=23)), False), 0, blocks.simulate

    def counting(*args):
        nonlocal traced
        traced += 1
        return simulate(*args)

    monkeypatch.setattr(blocks, "simulate", counting)
    for case, key in zip(ready.cases, ready.keys, strict=True):
        for run in range(3):
            single(case, key, run)
    assert traced == 1


@pytest.mark.filterwarnings("always:.*damaged")
def test_what_is_finished_is_kept_and_all_else_made_again(study, ran, command):
    store = ran(study())
    first = files_of(store)
    manifest = store.parent / "manifest.json"
    said = json.loads(manifest.read_text())["traces"]
    assert (said["store"], said["runs"]) == (traces.STORE, 3)
    # more runs of every point are other scores and the same records
    assert files_of(ran(study(runs=7))) == first
    # none wanted: what is there stays, and the manifest goes on mentioning it
    assert files_of(ran(study(traces=0))) == first
    assert json.loads(manifest.read_text())["traces"] == said
    chunk = next(p for p in sorted(store.rglob("*")) if p.name == "0.0.0")
    chunk.unlink()
    code, _, err = command("campaign", study(), "-o", store.parent)
    assert code == 0
    assert "damaged; it is made again" in err
    assert bytes_of(store) == {name: content for name, (_, content) in first.items()}
    more = ran(study(traces=4))
    assert xr.open_zarr(more, group="1").sizes["run"] == 4
    ran(study('"attack.value" = [2.0]'))
    assert sorted(p.name for p in store.iterdir() if p.is_dir()) == ["0"]
    assert xr.open_zarr(store, group="0").attrs == {"attack.value": 2.0}


def test_one_that_is_interrupted_is_not_there_and_made_by_the_same_command(
    study, ran, command, monkeypatch
):
    put, count = traces._put, 0

    def interrupted(*args):
        nonlocal count
        count += 1
        if count == 2:
            raise KeyboardInterrupt
        put(*args)

    path = study()
    folder = path.parent / "out"
    with monkeypatch.context() as patch:
        patch.setattr(traces, "_put", interrupted)
        code, _, err = command("campaign", path, "-o", folder)
    assert code == 130
    assert "the same command goes on" in err
    assert [p.name for p in folder.iterdir() if "zarr" in p.name] == []
    killed = folder / f".{traces.STORE}.killed" / "new"  # what kill -9 would have left
    killed.mkdir(parents=True)
    whole = bytes_of(ran(path))
    assert [p.name for p in folder.iterdir() if "zarr" in p.name] == [traces.STORE]
    # between the name and the manifest: it is not known to be whole, and made again, the same
    manifest = folder / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"traces": None}))
    assert bytes_of(ran(path)) == whole


def test_the_old_folder_stays_where_the_new_one_fails(tmp_path):
    place = tmp_path / "a"
    for text in ("one", "two"):
        with replacing_folder(place) as temporary:
            (temporary / text).write_text(text)
        assert [p.name for p in place.iterdir()] == [text]

    def failing():
        with replacing_folder(place) as temporary:
            (temporary / "three").write_text("")
            raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match="No space left"):
        failing()
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    assert [p.name for p in place.iterdir()] == ["two"]
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="found a file"), replacing_folder(tmp_path / "file"):
        pass


def refused(command, study, *options):
    code, out, err = command("campaign", study, *options)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert not (study.parent / "out").exists()
    return err


def test_what_cannot_be_is_said_before_anything_is_run(study, command, monkeypatch):
    path = study()
    out = ("-o", path.parent / "out")
    assert "study.traces: found 3 and no folder" in refused(command, path)
    monkeypatch.setattr(traces, "MOST", 1000)
    assert "study.traces: found records of" in refused(command, path, *out)
    monkeypatch.setitem(sys.modules, "zarr", None)
    assert 'pip install "holdfast[zarr]"' in refused(command, path, *out)
    assert "found 6, expected at most 5" in refused(command, study(traces=6), *out)
    assert "study.traces: found -1" in refused(command, study(traces=-1), *out)


def test_the_size_stated_is_that_of_the_arrays(study):
    """But for variables so small that their files count."""
    ready, store = written(study(runs=20, steps=400, traces=20))
    sizes = [
        max(v.nbytes, traces.SMALL)
        for number in ("0", "1")
        for v in xr.open_zarr(store, group=number).data_vars.values()
    ]
    assert traces.store_bytes(ready) == sum(sizes)
