"""Rows and events of a stream: the numbers of `replay`, sensors that lie, late samples."""

import json
import math

import jax
import numpy as np
import pytest

from holdfast.attacks import ramp
from holdfast.loop import replay
from holdfast.records import Status
from holdfast.shell.service.records import Samples
from live_engines import DT, MONITOR, OUTPUTS, PLANT, engine, played, spoof, stream, trace_of


def states(events, sensor):
    return [one.state for one in events if one.kind == "sensor" and one.subject == sensor]


def errors(rows, trace):
    return np.array([row.estimate.x for row in rows]) - np.asarray(trace.x)


def test_a_stream_gives_the_numbers_of_replay():
    """Gaps, faults, inputs that are missing: to 1e-12, statistic and threshold included."""
    trace = trace_of(120)
    messages = list(stream(trace))
    for k in (20, 21, 60):
        del messages[k].values["y:gps"]
    messages[30].values["y:radar"] = math.nan
    messages[31].values["y:flow"] = math.inf
    rows, _ = played(engine(active=False), messages)
    seen = np.ones((120, 5), bool)
    seen[[20, 21, 60], 0] = False
    y = np.array(trace.observation.y)
    y[30, 1], y[31, 4] = np.nan, np.inf
    log = type(trace.observation).of(np.asarray(trace.observation.u), y, seen)
    expected = replay(MONITOR, log)
    for name in ("x", "x_cov", "residual", "residual_cov"):
        mine = np.array([getattr(row.estimate, name) for row in rows])
        np.testing.assert_allclose(mine, getattr(expected.estimate, name), rtol=1e-12, atol=1e-12)
    status = [int(row.estimate.status) for row in rows]
    assert status == np.asarray(expected.estimate.status).tolist()
    for name in ("statistic", "threshold", "alarm"):
        mine = np.array([getattr(row.verdict, name) for row in rows])
        np.testing.assert_allclose(mine, getattr(expected.verdict, name), rtol=1e-12)


def test_an_input_that_does_not_come_is_held_and_told():
    messages = list(stream(trace_of(10)))
    messages[3].values["u:accel"] = 2.0
    del messages[4].values["u:accel"]
    rows, _ = played(engine(active=False), messages)
    assert Status.MISSING in Status(int(rows[4].estimate.status))
    messages[4].values["u:accel"] = 2.0
    again, _ = played(engine(active=False), messages)
    np.testing.assert_array_equal(rows[4].estimate.x, again[4].estimate.x)


@pytest.mark.parametrize("sensor", OUTPUTS)
def test_the_sensor_that_lies_is_isolated_and_comes_back(sensor):
    size = 15.0 if sensor in ("gps", "radar", "beacon") else 3.0
    trace = trace_of(600, 1, [spoof(f"sensor:{sensor}", value=size)])
    rows, events = played(engine(), stream(trace))
    assert states(events, sensor) == ["suspected", "isolated", "probation", "healthy"]
    others = [one.state for one in events if one.kind == "sensor" and one.subject != sensor]
    assert "isolated" not in others
    isolated = next(one for one in events if one.state == "isolated")
    assert 100 < isolated.frame < 110
    assert isolated.statistic > isolated.threshold
    # the lie was taken back: from its isolation on the estimate is that of the other sensors
    clean = trace_of(600, 1)
    messages = [s for s in stream(clean)]
    for samples in messages[:]:
        k = round(samples.time / DT)
        if isolated.frame - 25 < k <= 300:
            del samples.values[f"y:{sensor}"]
    without, _ = played(engine(active=False), messages)
    for row, other in zip(rows[isolated.frame : 200], without[isolated.frame : 200], strict=True):
        np.testing.assert_allclose(row.estimate.x, other.estimate.x, rtol=0, atol=1e-9)


def test_sound_sensors_are_left_alone():
    """4000 rows, five sensors, a level of 1e-6: nothing is isolated."""
    rows, events = played(engine(), stream(trace_of(4000, 3)))
    assert not [one for one in events if one.kind == "sensor" and one.state == "isolated"]
    assert len(rows) == 4000


def test_an_authenticated_sample_of_an_isolated_sensor_is_fused():
    trace = trace_of(200, 1, [spoof(stop=1e9)])
    messages = list(stream(trace))
    true = np.asarray(trace.x)
    for k in range(150, 200):
        messages[k].values["y:gps"] = float(true[k, 0])
        messages[k] = messages[k]._replace(trusted=frozenset({"gps"}))
    rows, _ = played(engine(), messages)
    assert rows[199].sensors[0] in ("isolated", "probation")
    assert rows[199].estimate.x_cov[0, 0] < 0.95 * rows[149].estimate.x_cov[0, 0]


def test_the_majority_gets_the_estimate_back():
    """One that lies slowly has the estimate and four honest ones are out: a trial ends that."""
    drag = ramp.build(PLANT, channel="sensor:gps", start=0.0, stop=1e9, rate=0.6)
    trace = trace_of(1500, 5, [drag])
    found = engine(retry=100)
    for sensor in (1, 2, 3, 4):
        found._estimation.health.isolate(sensor)
    rows, events = played(found, stream(trace))
    assert np.abs(errors(rows, trace)[95, 0]) > 4.0
    assert rows[-1].sensors == ("isolated", "healthy", "healthy", "healthy", "healthy")
    assert np.abs(errors(rows, trace)[-300:, 0]).max() < 3.0
    assert any(one.reason.startswith("most sensors") for one in events)


def test_late_samples_are_filtered_in():
    """Rows up to five late, no grace: with re-filtering the estimate is that of the whole log."""
    trace = trace_of(200, 2)
    messages = list(stream(trace))
    gps = []
    for k, samples in enumerate(messages):
        gps.append(Samples(samples.time, {"y:gps": samples.values["y:gps"]}))
        if k % 3 == 0:
            del samples.values["y:gps"]
    late = []
    for k, samples in enumerate(messages):
        late.append(samples)
        if k >= 4 and (k - 4) % 3 == 0:
            late.append(gps[k - 4])
    found = engine(refilter=10, active=False)
    rows, _ = played(found, late)
    expected = replay(MONITOR, trace.observation)
    assert found.refiltered == 66
    # rows that were told before their late sample came are what was known then; the last few
    # rows' samples never came, so what is compared is the first row after everything has
    k = 196
    np.testing.assert_allclose(rows[k].estimate.x, expected.estimate.x[k], rtol=0, atol=0.2)
    complete = [*late, *(gps[j] for j in (198,))]
    found = engine(refilter=10, active=False)
    played(found, complete)
    final = found._estimation._live.snapshot()
    whole = engine(active=False)
    played(whole, stream(trace))
    np.testing.assert_allclose(final, whole._estimation._live.snapshot(), rtol=1e-9, atol=1e-12)


def test_a_checkpoint_goes_on_bit_for_bit():
    """Cut anywhere, through an isolation and a trial: the same rows and the same events."""
    trace = trace_of(500, 1, [spoof()])
    messages = list(stream(trace))
    rows, events = played(engine(retry=30), messages)
    for cut in (1, 90, 103, 107, 150, 250, 333):
        first = engine(retry=30)
        before, told = [], []
        for samples in messages[:cut]:
            worked = first.take(samples, 0.0)
            before += worked.rows
            told += worked.events
        words, arrays = first.held()
        words = json.loads(json.dumps(words))
        second = engine(retry=30)
        second.restore(words, {name: np.array(value) for name, value in arrays.items()})
        after, more = played(second, messages[cut:])
        assert [one.key for one in told + more] == [one.key for one in events]
        for mine, theirs in zip(before + after, rows, strict=True):
            assert (mine.frame, mine.sensors, mine.mode) == (
                theirs.frame, theirs.sensors, theirs.mode,
            )  # fmt: skip
            for a, b in zip(
                jax.tree.leaves((mine.estimate, mine.verdict)),
                jax.tree.leaves((theirs.estimate, theirs.verdict)),
                strict=True,
            ):
                np.testing.assert_array_equal(a, b)


def test_a_silent_sensor_and_an_alarm_are_events_with_an_end():
    trace = trace_of(400, 1, [spoof()])
    messages = list(stream(trace))
    for samples in messages[300:360]:
        del samples.values["y:wheel"]
    _, events = played(engine(), messages)
    silence = [(one.state, one.frame) for one in events if one.kind == "source"]
    assert [state for state, _ in silence] == ["begin", "end"]
    assert 305 < silence[0][1] < 315
    assert silence[1][1] < 375
    alarms = [one for one in events if one.kind == "alarm" and one.frame > 95]
    assert alarms[0].state == "begin"
    assert 100 <= alarms[0].frame <= 103
    assert alarms[0].reason == "measurements contradict the model"
    assert len({one.key for one in events}) == len(events)


def test_a_reset_begins_anew_and_is_told():
    messages = list(stream(trace_of(60)))
    found = engine(active=False)
    for samples in messages[:30]:
        found.take(samples, 0.0)
    found.ask_reset()
    rows, events = played(found, messages[30:])
    fresh, _ = played(engine(active=False), messages[30:])
    assert [one.state for one in events] == ["reset"]
    assert rows[0].frame == 31
    for mine, theirs in zip(rows, fresh, strict=True):
        np.testing.assert_array_equal(mine.estimate.x, theirs.estimate.x)
