"""Modes in a report: which was true, the scores, the figure and the words about it."""

import dataclasses
import json
from types import SimpleNamespace
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import demo
from holdfast.plants.build import linear_plant
from holdfast.records import Injection
from holdfast.report import figures, mode_figures, page, words
from holdfast.report.mode_scores import mode_scores
from holdfast.report.tables import dataset, summary
from holdfast.report.truth import true_mode

NAMED = ("none", "spoof, then push", "push", "open")
MODES = SimpleNamespace(
    position=np.array([0, 0, 0, 1]),
    active=np.array([[False, False], [True, True], [False, True], [False, False]]),
)
"""Four modes of two channels and a switch."""
STEPS = 60
TIME = 0.1 * np.arange(1, STEPS + 1)


@pytest.fixture(scope="module")
def plant():
    return linear_plant(
        A=[[0.9, 0.1], [0.0, 0.8]], B=[[0.0], [2.0]], C=np.eye(2), G=[[0, 0], [0, 1]],
        H=[[1, 0], [0, 0]], Q=np.eye(2), R=np.eye(2), dt=0.1, attacks=["spoof", "push"],
    )  # fmt: skip


def weighed(plant, *, simulated=True):
    """Push from row 11 to 20, both from 31 to 40, the switch thrown from 46 to 55 (from 1 on)."""
    k = np.arange(1, STEPS + 1)
    d = np.zeros((STEPS, 2))
    d[(k > 10) & (k <= 20), 1] = 2.0
    d[(k > 30) & (k <= 40)] = [1.0, -1.0]
    switch = np.where((k > 45) & (k <= 55), 1, 0).astype(np.int32)
    mode = np.zeros(STEPS, np.int32)
    mode[13:21], mode[31:41], mode[47:55] = 2, 1, 3
    p = np.where(np.arange(3) == np.minimum(mode, 2)[:, None], 0.98, 0.01)
    trace = demo.blank(plant, STEPS, 2)
    estimate = dataclasses.replace(trace.estimate, p=jnp.asarray(p), mode=jnp.asarray(mode))
    y, u = np.zeros((STEPS, 2)), np.zeros((STEPS, 1))
    injection = Injection(*map(jnp.asarray, (u, y, d, switch)))
    return dataclasses.replace(
        trace,
        estimate=estimate,
        x=trace.x if simulated else None,
        injection=injection if simulated else None,
        modes=("none", "both", "rest"),
        named=NAMED,
    )


def truth_of(trace, truth):
    return true_mode(trace, truth, MODES).tolist()


def test_the_true_mode_is_what_was_injected_when_it_acted(plant):
    """A push at k moves the state to k+1, a spoof falsifies sample k; a throw spoils its row."""
    data = dataset(weighed(plant), plant, TIME, modes=MODES)
    wanted = np.zeros(STEPS, int)
    wanted[11:21], wanted[31:40], wanted[46:55] = 2, 1, 3
    wanted[30] = -1  # the spoof alone, which is none of the modes
    wanted[40] = 2  # the push of row 40 is felt in row 41
    wanted[[45, 55]] = -1
    np.testing.assert_array_equal(data.true_mode.values, wanted)


def test_what_no_channel_can_say_is_no_mode(plant):
    trace = weighed(plant)
    truth = np.zeros((STEPS, 2))
    truth[5] = np.nan
    assert truth_of(trace, truth)[4:7] == [0, -1, 0]
    bare = SimpleNamespace(position=np.array([0, 1]), active=np.zeros((2, 0), bool))
    hidden = dataclasses.replace(trace.injection, y=trace.injection.y.at[7, 0].set(1.0))
    found = true_mode(dataclasses.replace(trace, injection=hidden), None, bare)
    assert found[[6, 7, 8, 45, 46]].tolist() == [0, -1, 0, -1, 1]
    assert true_mode(weighed(plant, simulated=False), truth, MODES) is None


@pytest.fixture(scope="module")
def found(plant):
    return summary(weighed(plant), plant, TIME, modes=MODES)


def test_scores_of_the_modes(found):
    json.dumps(found, allow_nan=False)
    modes = found["modes"]
    # of 57 rows with a true mode: two too late at the push, one more at the throw; row 41
    # would be push alone
    assert (modes["accuracy"]["hits"], modes["accuracy"]["of"]) == (53, 57)
    assert (modes["unlisted"]["hits"], modes["unlisted"]["of"]) == (3, 60)
    assert modes["believed"]["push"]["hits"] == 8
    assert list(modes["true"]) == list(NAMED)
    assert modes["true"]["push"]["accuracy"]["of"] == 11
    assert modes["true"]["push"]["spells"] == 1  # row 41 is no spell
    assert modes["true"]["push"]["median_delay_s"] == pytest.approx(0.2)
    assert modes["true"]["open"]["median_delay_s"] == pytest.approx(0.1)
    spells = found["per_run"][0]["modes"]
    assert [s["mode"] for s in spells] == [
        "none", "push", "none", "spoof, then push", "none", "open", "none",
    ]  # fmt: skip
    assert (spells[1]["begin_s"], spells[1]["accuracy"]) == (pytest.approx(1.2), 0.8)
    assert found["attack"] == {"start_s": TIME[10], "stop_s": TIME[55]}
    assert "93" in words.modes(found)
    assert "in 3 more" in words.modes(found)


def test_scores_pool_the_runs(plant):
    both = jax.tree.map(lambda a: jnp.stack([a, a]), weighed(plant))
    found = mode_scores(dataset(both, plant, TIME, modes=MODES))
    assert found["true"]["push"]["spells"] == 2
    assert found["accuracy"].of == 114


def test_a_log_says_what_was_believed_in_alone(plant):
    data = dataset(weighed(plant, simulated=False), plant, TIME, modes=MODES)
    found = mode_scores(data.expand_dims("run"))
    assert (found["accuracy"], found["true"]) == (None, None)
    assert found["believed"]["none"].hits == 34
    assert words.modes({"modes": found}) is None
    blank = dataset(demo.blank(plant, 5, 2), plant, np.arange(5.0))
    assert mode_scores(blank) is None


def test_the_dataset_comes_back_from_a_file(tmp_path, plant):
    data = dataset(weighed(plant), plant, TIME, modes=MODES)
    data.to_netcdf(tmp_path / "modes.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "modes.nc", engine="h5netcdf") as back:
        xr.testing.assert_identical(back.load(), data)
    assert data.p.dims == ("time", "bank")
    assert list(data.named.values) == list(NAMED)
    assert list(data.position.values) == ["normal"]


@pytest.mark.parametrize("simulated", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_page_shows_the_modes(tmp_path, plant, found, simulated):
    trace = weighed(plant, simulated=simulated)
    if not simulated:
        found = summary(trace, plant, TIME, modes=MODES)
    path = page.write_report(
        tmp_path, trace=trace, plant=plant, time=TIME, title="Modes", scenario_text="",
        summary=found, modes=MODES,
    )  # fmt: skip
    text = path.read_text("utf-8")
    assert (tmp_path / "figures" / "modes.svg").is_file()
    assert 'href="#modes"' in text
    assert ("True mode" in text) is simulated
    assert "Mode believed in" in text
    drawn = (tmp_path / "figures" / "modes.svg").read_text()
    assert (">true<" in drawn) is simulated


def test_of_many_modes_the_foremost_are_named(plant):
    """Nine modes, of which seven come up: six by name and the rest as one."""
    trace = weighed(plant, simulated=False)
    names = tuple(f"mode {i} " + "x" * 40 * (i == 3) for i in range(9))
    mode = np.repeat(np.arange(7), [20, 10, 8, 7, 6, 5, 4]).astype(np.int32)
    p = np.where(np.arange(9) == mode[:, None], 1.0, 0.0)
    estimate = dataclasses.replace(trace.estimate, p=jnp.asarray(p), mode=jnp.asarray(mode))
    trace = dataclasses.replace(trace, estimate=estimate, modes=names, named=names)
    data = dataset(trace, plant, TIME)
    for layout in (figures.WIDE, figures.NARROW):
        figure = mode_figures.modes(data, layout)
        ElementTree.fromstring(figures.svg(figure))
        labels = [text.get_text() for text in figure.legends[0].get_texts()]
        assert labels[:3] == ["mode 0 ", "mode 1 ", "mode 2 "]
        assert labels[3] == names[3][:37] + "..."
        assert labels[4:] == ["mode 4 ", "mode 5 ", "others"]
        # the stack fills the panel: its last piece ends at 1
        assert figure.axes[1].patches[-1].get_data().values.max() == 1.0
