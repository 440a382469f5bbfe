"""A real Mosquitto on the loopback, with a configuration of its own."""

import asyncio
import shutil
import socket
import subprocess
import time

import pytest


class Mosquitto:
    """A broker that can be stopped and started again on the same port."""

    def __init__(self, folder):
        program = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
        if program is None:
            pytest.skip("no mosquitto: install the distribution's package of that name")
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self._config = folder / "mosquitto.conf"
        self.configure("allow_anonymous true")
        self._program, self._running = program, None

    def configure(self, *lines):
        """What is not the same for every test."""
        always = (f"listener {self.port} 127.0.0.1", "persistence false",
                  "max_queued_messages 100000")  # fmt: skip
        self._config.write_text("".join(f"{line}\n" for line in (*always, *lines)))

    def start(self):
        """Start, and wait until it listens."""
        self._running = subprocess.Popen(
            [self._program, "-c", str(self._config)],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        for _ in range(500):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return self
            time.sleep(0.01)
        self.stop()
        raise TimeoutError("mosquitto does not listen")

    def stop(self):
        """Stop at once."""
        if self._running is not None:
            self._running.kill()
            self._running.wait()
            self._running = None


async def until(condition, what="what was waited for has not come", seconds=30.0):
    """Wait for something to be so."""
    try:
        async with asyncio.timeout(seconds):
            while not condition():
                await asyncio.sleep(0.01)
    except TimeoutError:
        raise AssertionError(what) from None
