"""A page that is served for a test."""

import contextlib

from holdfast.shell.service.event_log import EventLog
from holdfast.shell.service.frames import Counts
from holdfast.shell.service.metrics import Metrics
from holdfast.shell.service.page import Page
from holdfast.shell.service.sources import Counters
from live_rows import LABELS

TOKEN = "a-token-that-nobody-guesses"


@contextlib.asynccontextmanager
async def served(tmp_path, **changes):
    """A page, its log, and how often a reset was asked for."""
    log, resets = EventLog(tmp_path / "events.sqlite"), []
    metrics = Metrics(
        LABELS, lambda: {"mqtt[1]": Counters(5, 1, 0, 0)}, lambda: (Counts(late=3), 1e-5)
    )
    page = Page(LABELS, log, metrics, TOKEN, lambda: resets.append(1), "127.0.0.1",
                changes.get("port", 0), None, None)  # fmt: skip
    await page.start()
    try:
        yield page, log, metrics, resets
    finally:
        await page.stop()
        await log.stop()
