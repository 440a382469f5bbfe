"""The dataset and the summary against the trace they are made of."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import demo
from holdfast.plants.build import linear_plant
from holdfast.records import Injection, Reason, Status
from holdfast.report.tables import channel_names, dataset, summary


def test_round_trip_through_netcdf_is_exact(tmp_path, plant, flight, log):
    runs = jax.tree.map(lambda a: jnp.stack([a, a]), flight)
    for i, trace in enumerate((flight, log, runs)):
        data = dataset(trace, plant, demo.time_of(flight), units=demo.UNITS)
        path = tmp_path / f"{i}.nc"
        data.to_netcdf(path, engine="h5netcdf")
        with xr.open_dataset(path, engine="h5netcdf") as back:
            xr.testing.assert_identical(data, back.load())
            assert {k: v.dtype for k, v in back.items()} == {k: v.dtype for k, v in data.items()}


def test_a_plant_without_inputs_and_attacks_can_be_written(tmp_path):
    bare = linear_plant(A=[[0.5]], C=[[1.0]], Q=[[1.0]], R=[[1.0]])
    data = dataset(demo.blank(bare, 5, 0), bare, np.arange(1.0, 6.0))
    data.to_netcdf(tmp_path / "bare.nc", engine="h5netcdf")
    assert data.sizes["input"] == 0
    assert "d" not in data


def test_the_dataset_holds_the_trace_with_gaps_marked(plant, log):
    data = dataset(log, plant, demo.time_of(log))
    assert data.x.dims == ("time", "state")
    assert data.x_cov.dims == ("time", "state", "state_")
    assert data.residual_cov.dims == ("time", "output", "output_")
    np.testing.assert_array_equal(data.x, log.estimate.x)
    assert data.attrs["Conventions"].startswith("CF")
    at = data.isel(time=5)  # no GPS: its attack is not determined, nothing was tested
    assert np.all(np.isnan(at.d))
    assert np.all(np.isinf(np.diagonal(at.d_cov)))
    assert np.isnan(at.statistic)
    assert np.isinf(at.threshold)
    assert at.y.isnull().values.tolist() == [True, True, False, False]
    assert Status.UNOBSERVABLE in Status(int(at.status))
    assert "true_x" not in data
    assert data["sample"].values[1].tolist() == [1, 1, 0, 0]
    assert data["sample"].values[100].tolist() == [0, 0, 2, 0]
    assert set(data.status.attrs["flag_meanings"].split()) == {s.name for s in Status if s}


def test_a_state_that_is_not_ready_is_empty(plant, flight):
    early = eqx.tree_at(
        lambda t: t.estimate.status,
        flight,
        flight.estimate.status.at[:3].set(int(Status.NOT_READY)),
    )
    data = dataset(early, plant, demo.time_of(flight))
    assert np.all(np.isnan(data.x[:3]))
    assert np.all(np.isfinite(data.x[3:]))


def test_channels_are_named_after_what_the_detector_tests(plant, flight):
    assert channel_names(flight, plant) == plant.attacks
    four = eqx.tree_at(lambda t: t.verdict.channel_alarms, flight, jnp.zeros((600, 4), bool))
    assert channel_names(four, plant) == plant.outputs


def test_truth_of_the_attack_is_at_the_time_of_the_estimate():
    """Channels in the dynamics are seen a row late, channels in the outputs at once."""
    plant = linear_plant(
        A=[[0.9, 0.1], [0.0, 0.8]], B=[[0.0], [2.0]], C=np.eye(2), G=[[0.0, 0.0], [1.0, 0.0]],
        H=[[0.0, 0.5], [0.0, 0.0]], Q=0.01 * np.eye(2), R=0.01 * np.eye(2),
    )  # fmt: skip
    u, y, d = np.zeros((4, 1)), np.zeros((4, 2)), np.zeros((4, 2))
    u[1], y[2, 0], y[3, 1], d[0] = 3.0, 1.0, 7.0, [5.0, 6.0]
    trace = dataclasses.replace(
        demo.blank(plant, 4, 2), injection=Injection(*map(jnp.asarray, (u, y, d)))
    )
    found = dataset(trace, plant, np.arange(1.0, 5.0)).true_d.values
    # y[3, 1] is no combination of channels: unknown at output 1's channel there
    np.testing.assert_allclose(found[:3], [[0, 6], [5, 0], [6, 2]], atol=1e-9)
    assert np.isnan(found[3, 1])


def test_summary_of_a_simulated_attack(plant, flight):
    time = demo.time_of(flight)
    found = summary(flight, plant, time)
    json.dumps(found, allow_nan=False)
    assert found["attack"] == {"start_s": time[299], "stop_s": time[499]}
    alarm = np.asarray(flight.verdict.alarm)
    first = np.flatnonzero(alarm & (time >= 30 - 1e-9))[0]
    assert found["per_run"][0]["delay_s"] == pytest.approx(time[first] - 30)
    hit = found["per_run"][0]["detection"]
    assert (hit["channel"], hit["channel_kind"]) == ("spoof_north", "attack")
    assert hit["estimate"] == float(flight.estimate.d[first, 0])
    assert found["detection"]["missed_rows"]["hits"] == int((~alarm[299:499]).sum())
    assert found["false_alarms"]["rows"]["of"] == 299
    assert found["false_alarms"]["episodes"]["duration"] == pytest.approx(29.9)
    error = np.asarray(flight.estimate.x - flight.x)
    assert found["state"]["north"]["rmse"] == pytest.approx(np.sqrt(np.mean(error[:, 0] ** 2)))
    spoof = np.asarray(flight.estimate.d - flight.injection.y[:, :2])
    assert found["attack_estimate"]["spoof_north"]["worst"] == pytest.approx(
        np.abs(spoof[:, 0]).max()
    )
    assert found["status"] == {"OK": 600}


def test_summary_of_a_log_judges_false_alarms_only_where_an_attack_is_stated(plant, log):
    time = demo.time_of(log)
    found = summary(log, plant, time)
    assert found["attack"] is None
    assert found["false_alarms"] is None
    assert found["state"] is None
    assert found["tested"]["hits"] == 60
    assert found["data"]["gps_north"] == {"missing": 540, "faulty": 0, "missing_or_faulty": 0}
    assert found["data"]["doppler_north"]["faulty"] == 1
    stated = summary(log, plant, time, (30.0, 50.0))
    assert stated["attack"] == {"start_s": time[299], "stop_s": time[499]}
    assert stated["detection"]["missed_tested_rows"]["of"] == 20
    assert stated["detection"]["missed_rows"]["of"] == 200
    assert stated["false_alarms"]["rows"]["of"] == 30


def test_summary_of_runs_pools_them(plant, flight):
    quiet = eqx.tree_at(lambda t: t.verdict.alarm, flight, jnp.zeros(600, bool))
    both = jax.tree.map(lambda *a: jnp.stack(a), flight, quiet)
    found = summary(both, plant, demo.time_of(flight))
    json.dumps(found, allow_nan=False)
    assert found["runs"] == 2
    assert found["detection"]["runs"]["hits"] == 1
    assert found["detection"]["largest_delay_s"] is None
    assert found["per_run"][1]["detection"] is None
    assert found["false_alarms"]["episodes"]["duration"] == pytest.approx(59.8)


def test_an_alarm_on_residuals_points_at_an_output(plant):
    watch = demo.monitor(plant, "residual")
    trace = demo.run(plant, watch, slope=1.0)
    hit = summary(trace, plant, demo.time_of(trace))["per_run"][0]["detection"]
    assert (hit["channel"], hit["channel_kind"]) == ("gps_north", "output")
    assert hit["reason"] == Reason.RESIDUAL.name
    assert "estimate" not in hit
