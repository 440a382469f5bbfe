"""Samples into frames: late, double, out of order, missing, and clocks that jump."""

import json
import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.shell.service.clock import CONFIRMATIONS, SourceClock
from holdfast.shell.service.frames import Frames
from holdfast.shell.service.records import Samples

COLUMNS = ("u:a", "y:g", "y:w")


def frames(grace=0.0, arrival=False, jump=1.0, dt=0.1):
    return Frames(dt, COLUMNS, grace, SourceClock(arrival, jump))


def row(k, dt=0.1, value=None, start=50.0):
    values = {"u:a": 1.0, "y:g": float(k) if value is None else value, "y:w": 2.0}
    return Samples(start + k * dt, values, whole=True)


def part(k, column, value, dt=0.1, shift=0.0):
    return Samples(50.0 + k * dt + shift, {column: value})


def drain(found, now=0.0):
    closed = []
    while (one := found.close(now)) is not None:
        closed.append(one)
    return closed


def ended(found):
    closed = []
    while (one := found.finish()) is not None:
        closed.append(one)
    return closed


def test_whole_rows_close_at_once_with_their_own_time():
    found = frames()
    for k in range(1, 20):
        found.take(row(k), 0.0)
        (closed,) = drain(found)
        assert closed.number == k
        assert closed.time == 50.0 + k * 0.1
        assert closed.frame.values["y:g"] == k


@given(st.integers(0, 10**6), st.integers(0, 5))
def test_reordered_rows_come_out_in_order_and_whole(seed, reach):
    """Up to five places out of order, with a grace of as many periods: nothing is lost."""
    found = frames(grace=0.1 * (reach + 1))
    order = sorted(range(1, 60), key=lambda k: k + random.Random(seed + k).uniform(0, reach))
    closed = []
    for k in order:
        assert found.take(row(k), 0.0) is None
        closed += drain(found)
    closed += ended(found)
    assert [one.frame.values["y:g"] for one in closed] == list(range(1, 60))
    assert [one.number for one in closed] == list(range(1, 60))
    assert found.counts.late == found.counts.empty == found.counts.duplicates == 0


def test_what_does_not_arrive_is_a_frame_without_it():
    found = frames(grace=0.05)
    for k in (1, 2, 5):
        found.take(row(k), 0.0)
    closed = [*drain(found), *ended(found)]
    assert [bool(one.frame.values) for one in closed] == [True, True, False, False, True]
    assert [one.time for one in closed] == pytest.approx([50.1, 50.2, 50.3, 50.4, 50.5], abs=1e-12)
    assert found.counts.empty == 2


def test_a_duplicate_is_counted_and_a_contradiction_is_a_fault():
    found = frames(grace=0.2)
    found.take(part(1, "y:g", 4.0), 0.0)
    found.take(part(1, "y:g", 4.0), 0.0)
    found.take(part(1, "y:w", 1.0), 0.0)
    found.take(part(1, "y:w", 9.0), 0.0)
    (closed,) = ended(found)
    assert closed.frame.values["y:g"] == 4.0
    assert math.isnan(closed.frame.values["y:w"])
    assert (found.counts.duplicates, found.counts.conflicts) == (1, 1)


def test_of_two_samples_of_a_period_the_newer_counts():
    found = frames(grace=0.2)
    found.take(part(1, "y:g", 4.0, shift=0.02), 0.0)
    found.take(part(1, "y:g", 3.0), 0.0)
    found.take(part(1, "y:g", 5.0, shift=0.03), 0.0)
    assert ended(found)[0].frame.values["y:g"] == 5.0


def test_late_samples_are_counted_and_named():
    found = frames()
    for k in (1, 2, 3):
        found.take(row(k), 0.0)
        drain(found)
    assert found.take(part(2, "y:g", 1.0), 0.0) == 2
    assert found.counts.late == 1


def test_by_arrival_a_silent_source_closes_frames_in_time():
    found = frames(arrival=True, grace=0.02)
    found.take(row(1), 10.0)
    assert drain(found, 10.0) == []
    assert found.next_deadline() == pytest.approx(10.07, abs=1e-9)
    assert len(drain(found, 10.071)) == 1
    # a second of silence: ten frames, each when it is due
    assert len(drain(found, 11.071)) == 10
    assert found.counts.empty == 10


@pytest.mark.parametrize("back", [-3600.0, 3600.0])
def test_a_clock_that_jumps_is_followed_without_losing_a_frame(back):
    found = frames(arrival=True, grace=0.01)
    closed = []
    for k in range(1, 101):
        stamp = 50.0 + 0.1 * k + (back if k > 50 else 0.0)
        values = {"u:a": 0.0, "y:g": float(k), "y:w": 0.0}
        found.take(Samples(stamp, values, whole=True), 0.1 * k)
        closed += drain(found, 0.1 * k)
    closed += ended(found)
    assert found.counts.jumps == 1
    assert found.jumped == pytest.approx(back, abs=1.0)
    seen = [one.frame.values["y:g"] for one in closed if one.frame.values]
    assert seen == list(range(1, 101))
    assert [one.number for one in closed] == list(range(1, len(closed) + 1))
    # while nobody knew what time it was, time went on
    assert found.counts.empty <= CONFIRMATIONS


@pytest.mark.parametrize("arrival", [True, False])
@pytest.mark.parametrize("off", [1e3, -1e3, 1e12])
def test_a_forged_stamp_moves_nothing(arrival, off):
    found = frames(arrival=arrival, grace=0.0)
    closed = []
    for k in range(1, 60):
        found.take(row(k), 0.1 * k)
        if k % 5 == 0:
            found.take(Samples(50.0 + 0.1 * k + off, {"y:g": 99.0}), 0.1 * k)
        closed += drain(found, 0.1 * k)
    closed += ended(found)
    assert [one.frame.values.get("y:g") for one in closed][:58] == list(range(1, 59))
    assert found.counts.jumps == 0
    assert found.counts.put_aside >= 10


def test_a_silence_of_a_minute_is_filled_where_only_stamps_tell_the_time():
    found = frames(arrival=False)
    closed = []
    for k in [*range(1, 11), *range(611, 625)]:
        found.take(row(k), 0.0)
        closed += drain(found)
    closed += ended(found)
    assert len(closed) == 624
    assert found.counts.empty == 600
    assert found.counts.jumps == 0


def test_a_period_that_is_not_quite_dt_loses_no_frame():
    """500 ppm off for 10 000 frames is five periods; every row still has a frame of its own."""
    found = frames()
    closed = []
    for k in range(1, 10_001):
        found.take(row(k, dt=0.1 * (1 + 5e-4)), 0.0)
        closed += drain(found)
    closed += ended(found)
    assert len(closed) == 10_000
    assert found.counts.empty == found.counts.late == 0


def test_a_path_that_becomes_slower_is_followed():
    """Half a second more from one row on: late for two seconds, and no longer."""
    found = frames(arrival=True, grace=0.05)
    late = []
    for k in range(1, 201):
        now = 0.1 * k + (0.5 if k > 100 else 0.0)
        if found.take(row(k), now) is not None:
            late.append(k)
        drain(found, now)
    assert all(100 < k <= 126 for k in late)
    assert found.closed >= 198


def test_drift_is_told():
    clock = SourceClock(True, 1.0)
    for k in range(20_000):
        clock.believe(0.01 * k, 5.0 + 0.01 * k * (1 + 3e-5))
    assert clock.drift == pytest.approx(3e-5, rel=0.05)


@given(st.data())
def test_no_stream_breaks_it_and_a_checkpoint_goes_on_alike(data):
    """Any order of any stamps: frames are numbered without a gap, and a restored copy agrees."""
    stamp = st.floats(-1e9, 1e9) | st.floats(49.0, 55.0) | st.just(math.nan)
    stamps = data.draw(st.lists(stamp, min_size=1, max_size=60))
    arrival = data.draw(st.booleans())
    found, numbers = frames(grace=0.1, arrival=arrival), []
    now = 0.0
    for i, stamp in enumerate(stamps):
        now += 0.05
        found.take(Samples(stamp, {"y:g": float(i)}), now)
        for _ in range(200):
            closed = found.close(now)
            if closed is None:
                break
            numbers.append(closed.number)
    assert numbers == list(range(1, len(numbers) + 1))
    copy = frames(grace=0.1, arrival=arrival)
    copy.restore(json.loads(json.dumps(found.held())))
    assert copy.held() == found.held()
    assert len(ended(copy)) <= len(ended(found)) + CONFIRMATIONS
