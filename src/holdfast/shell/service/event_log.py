"""The event log: one SQLite file that is only ever added to.

Table `events` holds every event once, by its key, so that a row that is worked on again after a
restart writes nothing twice; `acknowledgements` says who has seen which. Triggers refuse to change
or remove a line of either, or to put another in its place.
"""

import asyncio
import contextlib
import datetime
import math
import sqlite3
import time
from collections import deque
from pathlib import Path
from typing import Any

from holdfast.shell.errors import InputError
from holdfast.shell.service.records import Event
from holdfast.shell.service.sinks import Sink

PENDING = 10_000
"""Events held while the file cannot be written; more are lost, and counted."""
AT_ONCE, SOON = 256, 0.2
"""Events, or seconds since the first of them, after which they are written."""
AGAIN = 5.0
"""Seconds until the next attempt after one that failed: each may hold up the service."""
OWNER = 0x48464556
"""The application id that our files carry."""
_COLUMNS = "id, key, frame, time, kind, subject, state, reason, statistic, threshold, written"
_SCHEMA = """
CREATE TABLE IF NOT EXISTS events (
    id INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT UNIQUE NOT NULL, frame INTEGER NOT NULL,
    time REAL, kind TEXT NOT NULL, subject TEXT NOT NULL, state TEXT NOT NULL,
    reason TEXT NOT NULL, statistic REAL, threshold REAL, written TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS acknowledgements (
    id INTEGER PRIMARY KEY AUTOINCREMENT, event INTEGER UNIQUE NOT NULL REFERENCES events(id),
    who TEXT NOT NULL, at TEXT NOT NULL);
CREATE TRIGGER IF NOT EXISTS events_once BEFORE INSERT ON events
    WHEN EXISTS (SELECT 1 FROM events WHERE id = NEW.id OR key = NEW.key)
    BEGIN SELECT RAISE(IGNORE); END;
CREATE TRIGGER IF NOT EXISTS acknowledgements_once BEFORE INSERT ON acknowledgements
    WHEN EXISTS (SELECT 1 FROM acknowledgements WHERE id = NEW.id OR event = NEW.event)
    BEGIN SELECT RAISE(IGNORE); END;
CREATE TRIGGER IF NOT EXISTS events_stay BEFORE UPDATE ON events
    BEGIN SELECT RAISE(ABORT, 'the event log is only added to'); END;
CREATE TRIGGER IF NOT EXISTS events_remain BEFORE DELETE ON events
    BEGIN SELECT RAISE(ABORT, 'the event log is only added to'); END;
CREATE TRIGGER IF NOT EXISTS acknowledgements_stay BEFORE UPDATE ON acknowledgements
    BEGIN SELECT RAISE(ABORT, 'the event log is only added to'); END;
CREATE TRIGGER IF NOT EXISTS acknowledgements_remain BEFORE DELETE ON acknowledgements
    BEGIN SELECT RAISE(ABORT, 'the event log is only added to'); END;
"""


class EventLog(Sink):
    """Writes events to a file, and reads them for the page. Used from one thread.

    ``trouble``: why nothing can be written just now, "" where it can. ``lost``: events that
    were dropped because of that. Raises `InputError` for a file that is no event log.
    """

    def __init__(self, path: Path):
        self.name = f"events in {path.name}"
        self.trouble, self.lost = "", 0
        self._pending: deque[Event] = deque()
        self._due = math.inf
        try:
            self._base = sqlite3.connect(path, isolation_level=None)
            self._base.execute("PRAGMA busy_timeout = 200")
            _check_owner(self._base)
            self._base.execute("PRAGMA journal_mode = WAL")
            self._base.execute("PRAGMA synchronous = FULL")
            self._base.executescript(_SCHEMA)
            self._base.execute(f"PRAGMA application_id = {OWNER}")
        except sqlite3.Error as error:
            raise InputError(path, "", f"no usable file ({error})", "an event log") from None

    def row(self, row: Any) -> None:
        """Write what has waited long enough."""
        if time.monotonic() >= self._due:
            self.flush()

    def _wait(self, seconds: float) -> None:
        """Write then: with the next row, or by the clock where no more rows come."""
        self._due = time.monotonic() + seconds
        with contextlib.suppress(RuntimeError):  # nobody waits where there is no event loop
            asyncio.get_running_loop().call_later(1.1 * seconds, self.row, None)

    def event(self, event: Event) -> None:
        """Take an event; it is written soon."""
        if len(self._pending) >= PENDING:
            self.lost += 1
            return
        if not self._pending:
            self._wait(SOON)
        self._pending.append(event)
        if len(self._pending) >= AT_ONCE and not self.trouble:
            self.flush()

    def flush(self) -> None:
        """Write all that is held, in one transaction that is on the disk when this returns."""
        self._due = math.inf
        if not self._pending:
            return
        now = _now()
        rows = [
            (*(None if isinstance(v, float) and math.isnan(v) else v for v in event), now)
            for event in self._pending
        ]
        try:
            with self._base:
                self._base.execute("BEGIN")
                self._base.executemany(
                    f"INSERT OR IGNORE INTO events ({_COLUMNS[4:]}) VALUES ({_marks(rows[0])})",
                    rows,
                )
        except sqlite3.Error as error:
            self.trouble = f"the event log cannot be written: {error}"
            self._wait(AGAIN)
            return
        self._pending.clear()
        self.trouble = ""

    async def stop(self) -> None:
        """Write what is held, and close."""
        self.flush()
        self._base.close()

    def recent(self, count: int, before: int | None = None) -> list[dict[str, Any]]:
        """The newest events (those with a smaller id than ``before``), the newest first."""
        if not self.trouble:
            self.flush()
        found = self._base.execute(
            f"SELECT events.id, {_COLUMNS[4:]}, who, at FROM events LEFT JOIN acknowledgements "
            "ON event = events.id WHERE events.id < ? ORDER BY events.id DESC LIMIT ?",
            (2**62 if before is None else before, count),
        )
        names = [*_COLUMNS.split(", "), "who", "at"]
        return [_read(dict(zip(names, row, strict=True))) for row in found]

    def acknowledge(self, number: int, who: str) -> bool:
        """Note who has seen an event; False if there is none, or somebody has before."""
        self.flush()
        try:
            with self._base:
                done = self._base.execute(
                    "INSERT OR IGNORE INTO acknowledgements (event, who, at) "
                    "SELECT id, ?, ? FROM events WHERE id = ?", (who, _now(), number),
                )  # fmt: skip
        except sqlite3.Error as error:
            self.trouble = f"the event log cannot be written: {error}"
            return False
        self.trouble = ""
        return done.rowcount == 1


def _check_owner(base: sqlite3.Connection) -> None:
    """Raise `sqlite3.DatabaseError` for a file of somebody else, or one that is damaged."""
    owner = base.execute("PRAGMA application_id").fetchone()[0]
    empty = base.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
    if owner != OWNER and not (owner == 0 and empty):
        raise sqlite3.DatabaseError("a database of something else")
    found = base.execute("PRAGMA quick_check(1)").fetchone()[0]
    if found != "ok":
        raise sqlite3.DatabaseError(found)


def _read(row: dict[str, Any]) -> dict[str, Any]:
    who, at = row.pop("who"), row.pop("at")
    return row | {"acknowledged": None if who is None else {"who": who, "at": at}}


def _marks(row: tuple) -> str:
    return ", ".join("?" * len(row))


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
