"""The operator's page: state, attack, statistic, sensors and events, behind a token.

The page itself holds no secret and is given to anybody; whatever tells or changes something wants
the token, compared in constant time: as `Authorization: Bearer` over HTTP, as the first message
of the WebSocket. A request from another origin is refused, so that no other page in the operator's
browser can use it.
"""

import asyncio
import contextlib
import hmac
import json
import socket
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from holdfast.shell.errors import InputError, one_line
from holdfast.shell.service.event_log import EventLog
from holdfast.shell.service.metrics import Metrics
from holdfast.shell.service.records import Event, Labels, Row
from holdfast.shell.service.saying import row_object
from holdfast.shell.service.sinks import Sink

STATIC = Path(__file__).parent / "static"
KEPT, EVERY = 1200, 0.05
"""Rows that a page that is opened is given, and seconds between two of them at least."""
BATCH = 20
"""Rows of a message to a page at most, beside the first."""
PERIOD = 0.1
"""Seconds between two messages to a page."""
CLIENTS, BODY, EVENTS = 32, 4096, 100
FAILURES, WINDOW = 10, 10.0
"""Wrong tokens in so many seconds after which nobody is let in until they are over."""
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
WRONG_TOKEN, TOO_MANY, FOREIGN = 4401, 4429, 4403
"""Why a WebSocket is closed."""


class Guard:
    """Who is let in."""

    def __init__(self, token: str):
        self._token = token.encode()
        self._failures: deque[float] = deque(maxlen=FAILURES)

    def check(self, given: str) -> int:
        """The HTTP status: 200, 401 for a wrong token, 429 after too many of them."""
        now = time.monotonic()
        if len(self._failures) == FAILURES and now - self._failures[0] < WINDOW:
            return 429
        if hmac.compare_digest(given.encode("utf-8", "replace"), self._token):
            return 200
        self._failures.append(now)
        return 401


def same_origin(headers: Any) -> bool:
    """Whether a browser sends this from our own page; programs send no origin."""
    origin = headers.get("origin")
    return origin is None or origin.split("://")[-1] == headers.get("host")


class Page(Sink):
    """Serves the page; ``port`` tells the real one after `start` where 0 was asked for."""

    def __init__(
        self, labels: Labels, log: EventLog, metrics: Metrics, token: str,
        reset: Callable[[], None], host: str, port: int, certificate: Path | None,
        key: Path | None,
    ):  # fmt: skip
        self.name, self.host, self.port = "page", host, port
        self._labels, self._log, self._metrics, self._reset = labels, log, metrics, reset
        self._guard = Guard(token)
        self._tls = (certificate, key)
        self._rows: deque[tuple[int, Row]] = deque(maxlen=KEPT)
        self._count, self._told, self._at = 0, 0, 0.0
        self._look: tuple[Any, ...] = ()
        self._clients = 0
        self._server: Any = None
        self._task: asyncio.Task[None] | None = None

    def row(self, row: Row) -> None:
        """Keep a row now and then, and every one in which something changes."""
        now = time.monotonic()
        look = (bool(row.verdict.alarm), row.sensors, row.mode)
        if now - self._at >= EVERY or look != self._look:
            self._count += 1
            self._rows.append((self._count, row))
            self._at, self._look = now, look

    def event(self, event: Event) -> None:
        """Note that there are events to tell; the log has them."""
        self._told += 1

    async def start(self) -> None:
        """Listen. Raises `InputError` where the port cannot be had."""
        try:
            import uvicorn
            import websockets  # noqa: F401

            app = self._app()
        except ImportError:
            raise InputError(
                f"{self.host}:{self.port}", "", "no package for the page",
                'pip install "holdfast[dashboard]"',
            ) from None  # fmt: skip
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        listening = socket.socket(family)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((self.host, self.port))
        except OSError as error:
            listening.close()
            raise InputError(
                f"{self.host}:{self.port}", "", str(error.strerror or error), "a free port"
            ) from None
        self.port = listening.getsockname()[1]
        certificate, key = self._tls
        config = uvicorn.Config(
            app, log_config=None, log_level="critical", access_log=False, lifespan="off",
            ws="websockets-sansio", ws_max_size=BODY, server_header=False,
            ssl_certfile=certificate, ssl_keyfile=key,
        )  # fmt: skip

        class Server(uvicorn.Server):
            @contextlib.contextmanager
            def capture_signals(self) -> Any:
                yield  # the service as a whole takes them

        self._server = Server(config)
        self._task = asyncio.create_task(self._server.serve(sockets=[listening]))
        while not self._server.started and not self._task.done():
            await asyncio.sleep(0.005)
        if not self._server.started:
            listening.close()
            failed = self._task.exception()
            raise InputError(f"{self.host}:{self.port}", "", f"no way to serve ({failed})",
                             "a certificate and its key, as PEM files")  # fmt: skip

    async def stop(self) -> None:
        """Close every connection."""
        if self._task is not None:
            self._server.should_exit = self._server.force_exit = True
            await asyncio.gather(self._task, return_exceptions=True)

    def _app(self) -> Any:
        from starlette.applications import Starlette
        from starlette.responses import FileResponse, PlainTextResponse
        from starlette.routing import Mount, Route, WebSocketRoute
        from starlette.staticfiles import StaticFiles

        async def index(_: Any) -> Any:
            return FileResponse(STATIC / "index.html", headers=HEADERS)

        async def health(_: Any) -> Any:
            return PlainTextResponse("ok\n", headers=HEADERS)

        class Files(StaticFiles):
            async def get_response(self, path: str, scope: Any) -> Any:
                found = await super().get_response(path, scope)
                found.headers.update(HEADERS)
                return found

        return Starlette(
            routes=[
                Route("/", index),
                Route("/healthz", health),
                Route("/api/state", self._guarded(self._api_state)),
                Route("/api/events", self._guarded(self._api_events)),
                Route("/api/acknowledge", self._guarded(self._api_acknowledge), methods=["POST"]),
                Route("/api/reset", self._guarded(self._api_reset), methods=["POST"]),
                Route("/metrics", self._guarded(self._api_metrics)),
                WebSocketRoute("/ws", self._socket),
                Mount("/static", Files(directory=STATIC)),
            ]
        )

    def _guarded(self, answer: Callable[[Any, dict[str, Any]], Any]) -> Any:
        """The route, for who has the token; its body as JSON, if that is small enough."""
        from starlette.responses import Response

        async def route(request: Any) -> Any:
            if not same_origin(request.headers):
                return Response(status_code=403, headers=HEADERS)
            scheme, _, given = request.headers.get("authorization", "").partition(" ")
            code = self._guard.check(given if scheme.lower() == "bearer" else "")
            if code != 200:
                return Response(status_code=code, headers=HEADERS)
            body = b""
            async for chunk in request.stream():
                body += chunk
                if len(body) > BODY:
                    return Response(status_code=413, headers=HEADERS)
            try:
                content = json.loads(body) if body else {}
            except (ValueError, RecursionError):
                return Response(status_code=400, headers=HEADERS)
            found = answer(request, content if isinstance(content, dict) else {})
            kind = "text/plain; version=0.0.4" if isinstance(found, bytes) else "application/json"
            content = found if isinstance(found, bytes) else json.dumps(found)
            return Response(content, media_type=kind, headers=HEADERS)

        return route

    def _api_state(self, _: Any, __: dict[str, Any]) -> Any:
        return self._state()

    def _api_events(self, request: Any, _: dict[str, Any]) -> Any:
        before = request.query_params.get("before", "")
        known = before.isdecimal() and len(before) < 19  # what SQLite can hold
        return {"events": self._log.recent(EVENTS, int(before) if known else None)}

    def _api_acknowledge(self, _: Any, content: dict[str, Any]) -> Any:
        number, who = content.get("id"), content.get("who")
        done = False
        name = one_line(who).strip()[:100] if isinstance(who, str) else ""
        if type(number) is int and 0 < number < 2**62 and name:
            done = self._log.acknowledge(number, name)
            self._told += 1
        return {"acknowledged": done}

    def _api_reset(self, _: Any, __: dict[str, Any]) -> Any:
        self._reset()
        return {"reset": True}

    def _api_metrics(self, _: Any, __: dict[str, Any]) -> Any:
        return self._metrics.exposition()

    def _state(self) -> dict[str, Any]:
        """All that a page needs that has just been opened."""
        return {
            "labels": self._labels._asdict(),
            "rows": [row_object(row, self._labels) for _, row in self._rows],
            **self._events(),
        }

    def _events(self) -> dict[str, Any]:
        return {"events": self._log.recent(EVENTS), "trouble": self._log.trouble}

    async def _socket(self, connection: Any) -> None:
        """Rows and events as they come, to who says the token first."""
        from starlette.websockets import WebSocketDisconnect

        await connection.accept()
        if not same_origin(connection.headers):
            await connection.close(FOREIGN)
            return
        code = 401
        with contextlib.suppress(ValueError, TimeoutError, KeyError, WebSocketDisconnect):
            said = json.loads(await asyncio.wait_for(connection.receive_text(), 5.0))
            code = self._guard.check(str(said["token"])) if isinstance(said, dict) else 401
        if code != 200 or self._clients >= CLIENTS:
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                await connection.close(WRONG_TOKEN if code == 401 else TOO_MANY)
            return
        self._clients += 1
        feeding = asyncio.create_task(self._feed(connection))
        try:
            while True:  # what a page says later is read and not needed
                await connection.receive_text()
        except (WebSocketDisconnect, KeyError):
            pass
        finally:
            feeding.cancel()
            await asyncio.gather(feeding, return_exceptions=True)
            self._clients -= 1

    async def _feed(self, connection: Any) -> None:
        """Send what is new every `PERIOD`; a slow page gets fewer messages, and none pile up."""
        count, told = self._count, self._told
        await connection.send_json(self._state())
        while True:
            await asyncio.sleep(PERIOD)
            message: dict[str, Any] = {}
            if self._count != count:
                new = _thinned([row for number, row in self._rows if number > count])
                count = self._count
                message["rows"] = [row_object(row, self._labels) for row in new]
            if self._told != told:
                told = self._told
                message |= self._events()
            if message:
                await connection.send_json(message)


def _thinned(rows: list[Row]) -> list[Row]:
    """At most `BATCH` of them, spread evenly; the newest is always one."""
    every = -(-len(rows) // BATCH)
    return rows[::-1][:: max(every, 1)][::-1]
