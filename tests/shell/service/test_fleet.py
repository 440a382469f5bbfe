"""A fleet: every plant as if it were alone, whatever becomes of the others."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.loop import replay
from holdfast.records import Observation, Status
from holdfast.shell.flat import FlatMonitor
from holdfast.shell.service.clock import SourceClock
from holdfast.shell.service.fleet.engine import FleetEngine
from holdfast.shell.service.fleet.members import Members
from holdfast.shell.service.fleet.stepping import BLOCK, Stepping
from holdfast.shell.service.fleet.timing import Timing
from holdfast.shell.service.fleet.wire import (
    Batch,
    Told,
    batch_decoder,
    batch_frame,
    estimates_frame,
    read_estimates,
)
from holdfast.shell.service.records import Labels
from live_engines import DT, MONITOR, OUTPUTS, PLANT, spoof, trace_of

MOST = 700
LABELS = Labels.of("vehicle", PLANT, MONITOR.estimator.init()[1])
ATOL = 1e-10
"""A batch adds in another order than a step alone, over some 100 steps of numbers of 10."""
_stepping: list[Stepping] = []


def engine(most=MOST, arrival=False, retire=10**6, after=5, monitor=MONITOR):
    """A fleet at its beginning; those of `MOST` share compiled parts: one at a time."""
    if monitor is MONITOR and most <= MOST:
        if not _stepping:
            _stepping.append(Stepping(FlatMonitor(MONITOR), MOST))
        stepping = _stepping[0]
    else:
        stepping = Stepping(FlatMonitor(monitor), most)
    timing = Timing(DT, 0.0, SourceClock(arrival, 1.0))
    return FleetEngine(LABELS, stepping, timing, Members(most), after, retire)


def plants(count, steps=60):
    """The logs of some plants: an input and outputs for every row, and their replays."""
    rng = np.random.default_rng(count)
    u = 0.3 * rng.normal(size=(count, steps, 1))
    y = rng.normal(size=(count, steps, len(OUTPUTS)))
    return np.concatenate([u, y], axis=2)


def batch(k, ids, values, seen=None, time=None):
    """Row k, from 1, of these plants."""
    there = np.ones(values.shape, bool) if seen is None else seen
    return Batch(k * DT if time is None else time, np.asarray(ids, np.uint64), values, there,
                 np.zeros((len(values), len(OUTPUTS)), bool))  # fmt: skip


def alone(values, seen=None):
    """What `replay` says of a plant's log."""
    there = None if seen is None else seen[:, 1:]
    return replay(MONITOR, Observation.of(values[:, :1], values[:, 1:], there))


class Heard:
    """What a fleet has said, by plant and frame."""

    def __init__(self):
        self.told, self.events = {}, []

    def take(self, worked):
        self.events += worked.events
        for told in worked.rows:
            for i, identity in enumerate(told.ids.tolist()):
                key = identity, int(told.frame[i])
                assert key not in self.told
                self.told[key] = Told(*(a[i] for a in told))
        return self

    def rows(self, identity):
        """The rows of a plant, in order."""
        return [row for (of, _), row in sorted(self.told.items()) if of == identity]


def agrees(rows, trace):
    """The same estimates, spreads, statistics and alarms as a replay."""
    assert len(rows) == len(trace.estimate.x)
    x = np.array([row.x for row in rows])
    np.testing.assert_allclose(x, trace.estimate.x, rtol=0, atol=ATOL)
    sd = np.sqrt(np.diagonal(np.asarray(trace.estimate.x_cov), axis1=1, axis2=2))
    np.testing.assert_allclose([row.x_sd for row in rows], sd, rtol=1e-10)
    statistic = np.asarray(trace.verdict.statistic)
    np.testing.assert_allclose([row.statistic for row in rows], statistic, rtol=1e-8)
    assert [bool(row.alarm) for row in rows] == np.asarray(trace.verdict.alarm).tolist()
    assert [int(row.status) for row in rows] == np.asarray(trace.estimate.status).tolist()


@pytest.mark.parametrize("count", [1, 3, BLOCK + 5])
def test_every_plant_is_its_replay(count):
    values, heard, found = plants(count), Heard(), engine()
    ids = np.arange(count) * 7 + 2**40
    order = np.random.default_rng(0)
    for k in range(1, values.shape[1] + 1):
        mixed = order.permutation(count)
        # in two messages, in any order
        for part in np.array_split(mixed, 2):
            heard.take(found.take(batch(k, ids[part], values[part, k - 1]), 0.0))
    for i in {0, count // 2, count - 1}:
        agrees(heard.rows(int(ids[i])), alone(values[i]))
    assert found.counts.rows == count * values.shape[1]
    assert (found.counts.late, found.counts.empty) == (0, 0)


@settings(max_examples=20)
@given(data=st.data())
def test_what_is_lost_late_twice_or_forged_is_as_if_the_plant_were_alone(data):
    """Rows left out, samples left out, rows again: each plant is the replay of what came."""
    count, steps = 4, 15
    values = plants(count, steps)
    seed = data.draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    came = rng.random((steps, count)) < 0.7
    came[0] = came[-1] = True
    seen = (rng.random(values.shape) < 0.8) & came.T[:, :, None]
    seen[:, :, 0] = came.T  # a missing input is held: tested below
    found, heard, late = engine(), Heard(), 0
    for k in range(1, steps + 1):
        at = np.flatnonzero(came[k - 1])
        message = batch(k, at, values[at, k - 1], seen[at, k - 1])
        heard.take(found.take(message, 0.0))
        if rng.random() < 0.3:
            late += len(at)
            heard.take(found.take(message, 0.0))
    assert found.counts.late == late
    assert found.counts.empty == int(np.sum(~came))
    for i in range(count):
        held, before = values[i].copy(), 0.0
        for k in range(steps):
            held[k, 0] = before = held[k, 0] if came[k, i] else before
        trace = alone(held, seen[i])
        status = np.asarray(trace.estimate.status) | np.where(came[:, i], 0, int(Status.MISSING))
        estimate = dataclasses.replace(trace.estimate, status=status)
        agrees(heard.rows(i), dataclasses.replace(trace, estimate=estimate))


def test_bad_samples_poison_nobody():
    values, heard, found = plants(3, 20), Heard(), engine()
    values[1, 7, 2], values[1, 8, 0], values[1, 9, 1] = np.nan, np.inf, -np.inf
    for k in range(1, 21):
        heard.take(found.take(batch(k, [0, 1, 2], values[:, k - 1]), 0.0))
    for i in range(3):
        agrees(heard.rows(i), alone(values[i]))
    assert int(heard.rows(1)[7].status) & Status.BAD_INPUT


def episodes(alarms, hold=10):
    """Begins and ends of rows with alarms: an end comes ten rows after the last one."""
    found, last = [], None
    for frame, alarm in enumerate(np.asarray(alarms).tolist(), 1):
        if alarm and last is None:
            found.append(("begin", frame))
        if last is not None and not alarm and frame - last >= hold:
            found.append(("end", frame))
            last = None
        if alarm:
            last = frame
    return found


def test_a_spoof_is_the_alarm_of_that_plant_alone():
    quiet, attacked = trace_of(230, seed=3), trace_of(230, seed=4, attacks=[spoof()])
    heard, found = Heard(), engine()
    logs = [np.concatenate([t.observation.u, t.observation.y], axis=1) for t in (quiet, attacked)]
    for k in range(1, 231):
        heard.take(found.take(batch(k, [5, 6], np.array([log[k - 1] for log in logs])), 0.0))
    agrees(heard.rows(5), quiet)
    said = [(e.state, e.frame) for e in heard.events if (e.kind, e.subject) == ("alarm", "6")]
    assert said == episodes(attacked.verdict.alarm)
    first = next(e for e in heard.events if e.subject == "6" and e.frame >= 100)
    assert first.frame <= 102
    assert first.reason == "measurements contradict the model"
    assert first.statistic > first.threshold
    assert len({e.key for e in heard.events}) == len(heard.events)


def test_a_silent_plant_is_predicted_told_and_at_last_given_up():
    values, heard = plants(2, 60), Heard()
    found = engine(retire=30)
    for k in range(1, 61):
        who = [0, 1] if k <= 20 else [0]
        heard.take(found.take(batch(k, who, values[who, k - 1]), 0.0))
        heard.take(found.advance(0.0))
    states = [(e.state, e.frame) for e in heard.events if e.kind == "source" and e.subject == "1"]
    assert states == [("begin", 30), ("retired", 50)]
    last = heard.rows(1)
    assert len(last) == 50
    assert last[49].x_sd[0] > 2 * last[19].x_sd[0]
    assert len(found.members) == 1
    agrees(heard.rows(0), alone(values[0]))
    # it comes back as a new one
    heard.take(found.take(batch(61, [1], values[[1], 0]), 0.0))
    agrees(heard.rows(1)[50:], alone(values[1, :1]))


def test_deadlines_close_what_nobody_sends():
    found, heard, values = engine(arrival=True), Heard(), plants(2, 3)
    heard.take(found.take(batch(1, [0, 1], values[:, 0]), 100.0))
    heard.take(found.take(batch(2, [0], values[[0], 1]), 100.1))
    assert len(heard.rows(1)) == 1
    # half a period after its time
    heard.take(found.advance(100.149))
    assert len(heard.rows(1)) == 1
    assert found.next_deadline() == pytest.approx(100.15)
    heard.take(found.advance(100.151))
    assert [int(row.frame) for row in heard.rows(1)] == [1, 2]
    assert len(heard.rows(0)) == 2


def test_no_more_plants_than_there_are_places():
    found, values = engine(most=3), plants(5, 2)
    worked = found.take(batch(1, [0, 1, 2, 3, 4], values[:, 0]), 0.0)
    assert [len(told.ids) for told in worked.rows] == [3]
    assert found.counts.turned_away == 2
    # two rows of one plant in a message: the first counts
    again = found.take(batch(2, [0, 0], values[:2, 1]), 0.0)
    assert len(again.rows[0].ids) == 1
    assert found.counts.late == 1


def test_a_clock_that_jumps_back_an_hour_and_stamps_that_are_forged():
    values, heard, found = plants(1, 40), Heard(), engine()
    for k in range(1, 21):
        heard.take(found.take(batch(k, [0], values[:, k - 1]), 0.0))
        if k == 10:
            heard.take(found.take(batch(0, [0], values[:, 0], time=1e9), 0.0))
    assert found.timing.put_aside == 1
    for k in range(21, 41):
        heard.take(found.take(batch(k, [0], values[:, k - 1], time=k * DT - 3600.0), 0.0))
    assert [e.state for e in heard.events if e.kind == "clock"] == ["jumped"]
    agrees(heard.rows(0), alone(values[0]))


@pytest.mark.parametrize("cut", [1, 17, 38])
def test_a_checkpoint_goes_on_bit_for_bit(cut):
    values = plants(3, 60)
    seen = np.random.default_rng(1).random(values.shape) < 0.8

    def played(found, rows):
        heard = Heard()
        for k in rows:
            who = [0, 1, 2] if k < 20 or k % 7 else [0, 2]
            heard.take(found.take(batch(k, who, values[who, k - 1], seen[who, k - 1]), 0.0))
        return heard

    undisturbed = engine()
    whole = played(undisturbed, range(1, 61))
    counts = dataclasses.replace(undisturbed.counts)
    first = engine()
    begun = played(first, range(1, cut + 1))
    words, arrays = first.held()
    second = engine()
    second.restore(words, arrays)
    rest = played(second, range(cut + 1, 61))
    assert begun.events + rest.events == whole.events
    both = begun.told | rest.told
    assert both.keys() == whole.told.keys()
    for key, row in whole.told.items():
        for a, b in zip(row, both[key], strict=True):
            np.testing.assert_array_equal(a, b)
    assert second.counts == counts


def test_messages_go_there_and_back():
    values = plants(4, 1)[:, 0]
    seen = np.random.default_rng(2).random(values.shape) < 0.5
    trusted = np.random.default_rng(3).random((4, len(OUTPUTS))) < 0.5
    sent = Batch(12.5, np.array([1, 2, 2**63, 4], np.uint64), values, seen, trusted)
    message = batch_frame(sent)
    got = batch_decoder(LABELS, trust=True)(message)
    for a, b in zip(got[:4], sent[:4], strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(got.trusted, trusted & seen[:, 1:])
    assert not batch_decoder(LABELS)(message).trusted.any()
    told = engine().take(sent, 0.0).rows[0]
    for a, b in zip(read_estimates(estimates_frame(told)), told, strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="no batch"):
        read_estimates(message)


@settings(max_examples=200)
@given(
    cut=st.integers(0, 300), noise=st.binary(max_size=40), at=st.integers(0, 299),
    time=st.floats(),
)  # fmt: skip
def test_rubbish_is_no_batch_and_raises_nothing(cut, noise, at, time):
    message = batch_frame(batch(1, [0, 1], np.zeros((2, 1 + len(OUTPUTS))), time=time))
    decode = batch_decoder(LABELS)
    damaged = message[:at] + noise + message[at + len(noise) :]
    for found in (decode(damaged), decode(message[:cut]), decode(noise)):
        if found is not None:
            engine().take(found, 0.0)
