"""The page: odd requests, too many rows, what it cannot be served with."""

import asyncio
import sys
from pathlib import Path

import httpx
import pytest

from holdfast.shell.errors import InputError
from holdfast.shell.service.event_log import EventLog
from holdfast.shell.service.frames import Counts
from holdfast.shell.service.metrics import Metrics
from holdfast.shell.service.page import BATCH, Page, _thinned
from live_rows import LABELS, alarm, row

TOKEN = "a-token-that-nobody-guesses"


def page_of(log, certificate=None, key=None):
    metrics = Metrics(LABELS, dict, lambda: (Counts(), 0.0))
    return Page(LABELS, log, metrics, TOKEN, lambda: None, "127.0.0.1", 0, certificate, key)


def asked(log, method, path, **sent):
    """What one request is answered."""

    async def play():
        page = page_of(log)
        await page.start()
        page.row(row(1))
        heads = {"Authorization": f"Bearer {TOKEN}"}
        url = f"http://127.0.0.1:{page.port}{path}"
        try:
            async with httpx.AsyncClient() as asking:
                return await asking.request(method, url, headers=heads, **sent)
        finally:
            await page.stop()

    return asyncio.run(play())


@pytest.mark.parametrize("before", ["9" * 20, "9" * 5000, "-1", "x"])
def test_odd_numbers_are_not_asked_for(tmp_path, before):
    log = EventLog(tmp_path / "events.sqlite")
    log.event(alarm(1))
    answer = asked(log, "GET", f"/api/events?before={before}")
    log._base.close()
    assert [event["frame"] for event in answer.json()["events"]] == [1]


def test_a_name_that_is_no_text_is_not_written(tmp_path):
    log = EventLog(tmp_path / "events.sqlite")
    log.event(alarm(1))
    answer = asked(log, "POST", "/api/acknowledge", content=b'{"id": 1, "who": "\\ud800"}')
    log._base.close()
    assert answer.json() == {"acknowledged": False}


@pytest.mark.parametrize("count", [1, BATCH, BATCH + 1, 1000])
def test_a_message_holds_a_few_rows_and_the_newest(count):
    told = [one.frame for one in _thinned([row(frame) for frame in range(count)])]
    assert told[-1] == count - 1
    assert min(count, BATCH // 2) <= len(told) <= BATCH
    assert told == sorted(told)


def test_what_is_missing_is_told(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="a certificate"):
        asyncio.run(
            page_of(EventLog(Path(":memory:")), tmp_path / "no.pem", tmp_path / "no.key").start()
        )
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    with pytest.raises(InputError, match=r"holdfast\[dashboard\]"):
        asyncio.run(page_of(EventLog(Path(":memory:"))).start())
