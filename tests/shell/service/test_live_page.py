"""The page: who is let in, what is told, and what is kept out."""

import asyncio
import json

import httpx
import pytest
import websockets

from holdfast.shell.errors import InputError
from holdfast.shell.service.page import BODY, FAILURES
from live_pages import TOKEN, served
from live_rows import alarm, row

CLOSED = ["/api/state", "/api/events", "/metrics"]


def client(page, token=TOKEN):
    return httpx.AsyncClient(
        base_url=f"http://127.0.0.1:{page.port}", headers={"Authorization": f"Bearer {token}"}
    )


def test_without_the_token_nothing_is_told(tmp_path):
    async def play():
        async with served(tmp_path) as (page, _, _, resets):
            page.row(row(1))
            async with httpx.AsyncClient() as asking:
                answer = await asking.get(f"http://127.0.0.1:{page.port}/api/state")
                assert (answer.status_code, answer.content) == (401, b"")
            for token in ("wrong", TOKEN[:-1]):
                async with client(page, token) as asking:
                    for path in CLOSED:
                        answer = await asking.get(path)
                        assert (answer.status_code, answer.content) == (401, b"")
                    answer = await asking.post("/api/reset")
                    assert answer.status_code == 401
            assert not resets
            url = f"ws://127.0.0.1:{page.port}/ws"
            for said in ('{"token": "wrong"}', "[]"):
                async with websockets.connect(url) as socket:
                    await socket.send(said)
                    with pytest.raises(websockets.ConnectionClosed) as closed:
                        await socket.recv()
                    assert closed.value.rcvd.code in (4401, 4429)
            # the page itself holds nothing
            async with httpx.AsyncClient() as asking:
                answer = await asking.get(f"http://127.0.0.1:{page.port}/")
                assert answer.status_code == 200
                assert "drone" not in answer.text
                assert "default-src 'self'" in answer.headers["content-security-policy"]

    asyncio.run(play())


def test_guessing_is_slowed_down(tmp_path):
    async def play():
        async with served(tmp_path) as (page, *_):
            async with client(page, "guess") as asking:
                codes = [(await asking.get("/metrics")).status_code for _ in range(FAILURES + 2)]
            assert codes == [401] * FAILURES + [429] * 2
            async with client(page) as asking:
                assert (await asking.get("/metrics")).status_code == 429

    asyncio.run(play())


def test_state_events_and_metrics(tmp_path):
    async def play():
        async with served(tmp_path) as (page, log, metrics, resets), client(page) as asking:
            for frame in range(1, 4):
                for sink in (page, metrics):
                    sink.row(row(frame, alarm=frame == 3))
                await asyncio.sleep(0.06)
            log.event(alarm(3))
            metrics.event(alarm(3))
            metrics.latency(0.002)
            state = (await asking.get("/api/state")).json()
            assert [one["frame"] for one in state["rows"]] == [1, 2, 3]
            assert state["labels"]["states"] == ["north", "east"]
            (event,) = state["events"]
            assert event["acknowledged"] is None
            for wanted in (True, False):  # nobody acknowledges it twice
                answer = await asking.post(
                    "/api/acknowledge", json={"id": event["id"], "who": "Ada"}
                )
                assert answer.json() == {"acknowledged": wanted}
            for bad in ({"id": 99, "who": "Ada"}, {"id": True, "who": "Ada"}, {"id": 1}, {}):
                answer = await asking.post("/api/acknowledge", json=bad)
                assert answer.json() == {"acknowledged": False}
            (event,) = (await asking.get("/api/events")).json()["events"]
            assert event["acknowledged"]["who"] == "Ada"
            await asking.post("/api/reset")
            assert resets == [1]
            text = (await asking.get("/metrics")).text
            for line in (
                "holdfast_rows_total 3.0", "holdfast_alarms_total 1.0", "holdfast_alarm 1.0",
                'holdfast_missing_total{output="flow"} 3.0',
                'holdfast_source_rejected_total{source="mqtt[1]"} 1.0',
                "holdfast_frames_late_total 3.0", 'holdfast_events_total{kind="alarm"} 1.0',
                'holdfast_latency_seconds_bucket{le="0.0025"} 1.0',
                'holdfast_sensor_state{output="gps"} 0.0', "holdfast_clock_drift 1e-05",
            ):  # fmt: skip
                assert line in text, line

    asyncio.run(play())


def test_what_is_too_large_or_from_elsewhere_is_refused(tmp_path):
    async def play():
        async with served(tmp_path) as (page, _, _, resets), client(page) as asking:
            answer = await asking.post("/api/acknowledge", content=b"x" * (BODY + 1))
            assert answer.status_code == 413
            assert (await asking.post("/api/acknowledge", content=b"{")).status_code == 400
            foreign = {"Origin": "http://elsewhere.example"}
            assert (await asking.post("/api/reset", headers=foreign)).status_code == 403
            assert not resets
            own = {"Origin": f"http://127.0.0.1:{page.port}"}
            assert (await asking.post("/api/reset", headers=own)).status_code == 200
            url = f"ws://127.0.0.1:{page.port}/ws"
            async with websockets.connect(url, origin="http://elsewhere.example") as socket:
                with pytest.raises(websockets.ConnectionClosed) as closed:
                    await socket.recv()
                assert closed.value.rcvd.code == 4403
            assert (await asking.get("/static/../page.py")).status_code == 404

    asyncio.run(play())


def test_rows_and_events_are_pushed(tmp_path):
    async def play():
        async with served(tmp_path) as (page, log, *_):
            page.row(row(1))
            url = f"ws://127.0.0.1:{page.port}/ws"
            async with websockets.connect(url) as socket, asyncio.timeout(10):
                await socket.send(json.dumps({"token": TOKEN}))
                first = json.loads(await socket.recv())
                assert [one["frame"] for one in first["rows"]] == [1]
                for frame in range(2, 1000):  # a thousand a second are thinned
                    page.row(row(frame))
                page.row(row(1000, alarm=True))
                for sink in (log, page):
                    sink.event(alarm(1000))
                found = {}
                while not {"rows", "events"} <= found.keys():
                    found |= json.loads(await socket.recv())
                assert found["rows"][-1]["frame"] == 1000
                assert len(found["rows"]) < 20
                assert found["events"][0]["frame"] == 1000

    asyncio.run(play())


def test_a_port_that_is_taken_is_told(tmp_path):
    async def play():
        async with served(tmp_path) as (page, *_):
            with pytest.raises(InputError, match="free port"):
                async with served(tmp_path, port=page.port):
                    pass

    asyncio.run(play())
