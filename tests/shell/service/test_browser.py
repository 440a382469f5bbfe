"""The page in a real browser: an alarm appears, is acknowledged by keyboard, and stays so."""

import asyncio
import shutil

import pytest

from holdfast.shell.service.episodes import event
from live_pages import TOKEN, served
from live_rows import LABELS, alarm, row


@pytest.fixture(scope="module")
def chromium():
    found = shutil.which("chromium")
    if found is None:
        pytest.skip("no chromium: install the distribution's package of that name")
    return found


class Operator:
    """A browser with one page open, what it complains of, and what it is asked."""

    def __init__(self, chromium, **settings):
        self._chromium, self._settings = chromium, settings
        self.complaints = []

    async def __aenter__(self):
        from playwright.async_api import async_playwright

        self._driver = await async_playwright().start()
        self._browser = await self._driver.chromium.launch(
            executable_path=self._chromium, args=["--no-sandbox"]
        )
        context = await self._browser.new_context(**self._settings)
        self.tab = await context.new_page()
        self.tab.on("console", self._said)
        self.tab.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.tab.set_default_timeout(10_000)
        return self

    def _said(self, message):
        if message.type in ("error", "warning"):
            self.complaints.append(message.text)

    async def __aexit__(self, *_):
        await self._browser.close()
        await self._driver.stop()


def feed(page, metrics, frames, **changes):
    for frame in frames:
        for sink in (page, metrics):
            sink.row(row(frame, **changes))


def test_an_alarm_is_seen_acknowledged_and_found_acknowledged(tmp_path, chromium):
    async def play():
        async with served(tmp_path) as (page, log, metrics, resets), Operator(chromium) as operator:
            tab = operator.tab
            feed(page, metrics, range(1, 4))
            await tab.goto(f"http://127.0.0.1:{page.port}/#token={TOKEN}")
            await tab.wait_for_selector("text=● live")
            assert "token" not in tab.url
            assert await tab.inner_text("#plant") == "drone"
            assert await tab.locator("#alarm").is_hidden()
            feed(page, metrics, [4], alarm=True, sensors=("isolated", "healthy"))
            for sink in (log, page):
                sink.event(alarm(4))
                sink.event(event(4, 0.4, "sensor", "gps", "isolated", "innovations too large"))
            await tab.wait_for_selector("#alarm:has-text('measurements contradict the model')")
            await tab.wait_for_selector("#sensors .isolated:has-text('gps')")
            # a row without an alarm between two with one does not take it away
            feed(page, metrics, range(5, 9))
            await asyncio.sleep(0.6)
            assert not await tab.locator("#alarm").is_hidden()
            await asyncio.sleep(0.5)
            feed(page, metrics, [9 + max(10, round(1 / LABELS.dt))])
            await tab.wait_for_selector("#alarm", state="hidden")
            await tab.wait_for_selector("#event-rows button")
            tab.on("dialog", lambda dialog: asyncio.ensure_future(dialog.accept("Ada")))
            # by keyboard alone
            await tab.locator("#event-rows tr:has-text('Alarm') button").focus()
            await tab.keyboard.press("Enter")
            await tab.wait_for_selector("#event-rows tr:has-text('Alarm') >> text=Ada")
            await tab.reload()
            await tab.wait_for_selector("#event-rows tr:has-text('Alarm') >> text=Ada")
            assert await tab.locator("#event-rows button").count() == 1
            await tab.locator("#reset").click()
            async with asyncio.timeout(5):
                while not resets:
                    await asyncio.sleep(0.01)
            assert operator.complaints == []

    asyncio.run(play())


def test_a_wrong_token_opens_nothing(tmp_path, chromium):
    async def play():
        async with served(tmp_path) as (page, _, metrics, _), Operator(chromium) as operator:
            tab = operator.tab
            feed(page, metrics, range(1, 4))
            await tab.goto(f"http://127.0.0.1:{page.port}/")
            await tab.fill("#token", "wrong")
            await tab.keyboard.press("Enter")
            await tab.wait_for_selector("text=That is not the token.")
            assert await tab.locator("#content").is_hidden()
            assert "drone" not in await tab.content()
            await tab.fill("#token", TOKEN)
            await tab.keyboard.press("Enter")
            await tab.wait_for_selector("text=● live")
            assert operator.complaints == []

    asyncio.run(play())


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone_shows_it_without_scrolling_sideways(tmp_path, chromium, scheme):
    async def play():
        async with (
            served(tmp_path) as (page, log, metrics, _),
            Operator(chromium, viewport={"width": 390, "height": 844}, color_scheme=scheme)
            as operator,
        ):  # fmt: skip
            tab = operator.tab
            feed(page, metrics, range(1, 4), alarm=True)
            log.event(alarm(3))
            await tab.goto(f"http://127.0.0.1:{page.port}/#token={TOKEN}")
            await tab.wait_for_selector("#event-rows button")
            wide = await tab.evaluate(
                "document.documentElement.scrollWidth - document.documentElement.clientWidth"
            )
            assert wide <= 0
            sizes = await tab.evaluate(
                "[...document.querySelectorAll('button')].filter(b => b.offsetParent)"
                ".map(b => b.offsetHeight)"
            )
            assert min(sizes) >= 44
            assert operator.complaints == []

    asyncio.run(play())
