"""The event log: everything once, nothing changed, and what happens when it cannot be written."""

import asyncio
import sqlite3

import pytest

from brokers import until
from holdfast.shell.errors import InputError
from holdfast.shell.service.event_log import PENDING, EventLog
from live_rows import alarm, row


@pytest.fixture
def path(tmp_path):
    return tmp_path / "events.sqlite"


@pytest.fixture
def log(path):
    opened = EventLog(path)
    yield opened
    opened._base.close()


@pytest.fixture
def other(path, log):
    """Another program that has the file open."""
    base = sqlite3.connect(path, isolation_level=None)
    yield base
    base.close()


def test_a_row_that_is_worked_on_again_writes_nothing_twice(log):
    for frame in (1, 2, 1):
        log.event(alarm(frame))
    log.flush()
    log.event(alarm(2))
    assert [event["frame"] for event in log.recent(10)] == [2, 1]


def test_an_event_without_numbers_is_kept(log):
    log.event(alarm(1)._replace(statistic=float("nan"), threshold=float("nan")))
    (event,) = log.recent(1)
    assert event["statistic"] is event["threshold"] is None
    assert event["written"].endswith("+00:00")


def test_events_are_on_the_disk_soon(log, other, monkeypatch):
    now = 100.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    log.event(alarm(1))
    log.row(row(1))
    assert other.execute("SELECT count(*) FROM events").fetchone() == (0,)
    now += 0.3
    log.row(row(2))
    assert other.execute("SELECT count(*) FROM events").fetchone() == (1,)


def test_an_event_need_not_wait_for_a_row(log, other):
    async def play():
        log.event(alarm(1))
        await until(lambda: other.execute("SELECT count(*) FROM events").fetchone() == (1,))

    asyncio.run(play())


@pytest.mark.parametrize("table", ["events", "acknowledgements"])
@pytest.mark.parametrize("change", ["UPDATE {} SET id = 7", "DELETE FROM {}"])
def test_nothing_is_changed_or_removed(log, other, table, change):
    log.event(alarm(1))
    log.flush()
    assert log.acknowledge(1, "Ada")
    with pytest.raises(sqlite3.IntegrityError, match="only added to"):
        other.execute(change.format(table))


def test_acknowledged_once_and_for_good(path, log):
    log.event(alarm(1))
    log.flush()
    assert log.acknowledge(1, "Ada")
    assert not log.acknowledge(1, "Bob")
    assert not log.acknowledge(2, "Ada")
    again = EventLog(path)
    (event,) = again.recent(5)
    again._base.close()
    assert event["acknowledged"]["who"] == "Ada"


def test_older_events_page_by_page(log):
    for frame in range(1, 8):
        log.event(alarm(frame))
    assert [event["frame"] for event in log.recent(3)] == [7, 6, 5]
    assert [event["frame"] for event in log.recent(3, before=5)] == [4, 3, 2]


def test_a_locked_file_is_told_and_nothing_is_lost(log, other):
    other.execute("BEGIN IMMEDIATE")
    log.event(alarm(1))
    log.flush()
    assert "locked" in log.trouble
    other.execute("ROLLBACK")
    log.flush()
    assert (log.trouble, log.lost) == ("", 0)
    assert [event["frame"] for event in log.recent(5)] == [1]


def test_what_is_held_is_bounded(log, monkeypatch):
    monkeypatch.setattr(log, "flush", lambda: None)
    for frame in range(PENDING + 3):
        log.event(alarm(frame))
    assert log.lost == 3
    monkeypatch.undo()
    assert log.recent(1)[0]["frame"] == PENDING - 1


def test_a_file_that_is_no_event_log_is_refused(tmp_path):
    text = tmp_path / "text"
    text.write_text("time,y:gps\n" * 1000)
    foreign = tmp_path / "foreign.sqlite"
    base = sqlite3.connect(foreign)
    base.execute("CREATE TABLE events (what TEXT)")
    base.close()
    for path in (text, foreign, tmp_path / "none" / "events.sqlite"):
        with pytest.raises(InputError, match="an event log"):
            EventLog(path)


def test_another_line_is_not_put_in_the_place_of_one(log, other):
    log.event(alarm(1))
    log.flush()
    assert log.acknowledge(1, "Ada")
    before = log.recent(5)
    other.execute("INSERT OR REPLACE INTO events SELECT id, key, 9, time, kind, subject, state, "
                  "'', statistic, threshold, written FROM events")  # fmt: skip
    other.execute("INSERT OR REPLACE INTO acknowledgements VALUES (1, 1, 'Eve', '')")
    assert log.recent(5) == before


def test_a_locked_file_holds_up_the_service_seldom(log, other, monkeypatch):
    other.execute("BEGIN IMMEDIATE")
    log.event(alarm(1))
    log.flush()
    tried = []
    monkeypatch.setattr(log, "flush", lambda: tried.append(1))
    for frame in range(2, 1000):
        log.event(alarm(frame))
        log.row(row(frame))
    log.recent(5)
    assert not tried
    other.execute("ROLLBACK")


def test_the_database_of_another_program_is_left_alone(tmp_path):
    path = tmp_path / "other.sqlite"
    base = sqlite3.connect(path)
    base.execute("CREATE TABLE recipes (name TEXT)")
    base.close()
    before = path.read_bytes()
    with pytest.raises(InputError, match="something else"):
        EventLog(path)
    assert path.read_bytes() == before


def test_a_damaged_file_is_refused(path, log, tmp_path):
    for frame in range(500):
        log.event(alarm(frame))
    log.flush()
    log._base.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    whole = path.read_bytes()
    damaged = tmp_path / "damaged.sqlite"
    damaged.write_bytes(whole[: len(whole) // 2 // 4096 * 4096])
    with pytest.raises(InputError, match="an event log"):
        EventLog(damaged)
