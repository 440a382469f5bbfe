"""A real Mosquitto on the loopback, with a configuration of its own."""

import asyncio
import getpass
import json
import shutil
import socket
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

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
        # as root Mosquitto would become a user that need not be able to read a test's files
        always = (f"user {getpass.getuser()}", f"listener {self.port} 127.0.0.1",
                  "persistence false", "max_queued_messages 100000")  # fmt: skip
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


def program_of(name):
    """Where a program is that not everybody has."""
    return shutil.which(name) or pytest.skip(f"no {name}: install the distribution's package")


def passwords(folder, user, password):
    """The lines of a broker that knows one user."""
    place = folder / "passwords"
    program = program_of("mosquitto_passwd")
    subprocess.run([program, "-b", "-c", str(place), user, password], check=True)
    return "allow_anonymous false", f"password_file {place}"


class Certified(NamedTuple):
    """The lines of a broker with a certificate for 127.0.0.1; PEM files of who signed it and of
    somebody else.
    """

    lines: tuple[str, ...]
    authority: Path
    other: Path


def certified(folder):
    """Authorities and a broker's certificate, made for this test."""
    program = program_of("openssl")
    authority, other, signed = (folder / f"{n}.pem" for n in ("authority", "other", "broker"))
    request = folder / "broker.csr"
    new = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")

    def openssl(*words):
        subprocess.run([program, *map(str, words)], check=True, capture_output=True)

    for place in (authority, other):
        openssl("req", "-x509", *new, "-days", 2, "-subj", f"/CN={place.stem}",
                "-keyout", f"{place}.key", "-out", place)  # fmt: skip
    openssl("req", *new, "-subj", "/CN=broker", "-keyout", f"{signed}.key", "-out", request)
    (folder / "names").write_text("subjectAltName=IP:127.0.0.1")
    openssl("x509", "-req", "-in", request, "-days", 2, "-extfile", folder / "names",
            "-CA", authority, "-CAkey", f"{authority}.key", "-CAcreateserial",
            "-out", signed)  # fmt: skip
    return Certified((f"certfile {signed}", f"keyfile {signed}.key"), authority, other)


def readable(folder, *topics):
    """The lines of a broker that refuses subscriptions to others than these, by its plugin: the
    rights of an `acl_file` let everybody subscribe, and hand nothing on.
    """
    found = next(Path("/usr/lib").rglob("mosquitto_dynamic_security.so"), None)
    if found is None:
        pytest.skip("no mosquitto_dynamic_security.so")
    rights = [{"acltype": "subscribeLiteral", "topic": t, "allow": True} for t in topics]
    default = {"publishClientSend": True, "publishClientReceive": True, "subscribe": False}
    place = folder / "rights.json"
    place.write_text(json.dumps({
        "defaultACLAccess": default, "clients": [], "anonymousGroup": "all",
        "groups": [{"groupname": "all", "roles": [{"rolename": "reader"}]}],
        "roles": [{"rolename": "reader", "acls": rights}],
    }))  # fmt: skip
    return "allow_anonymous true", f"plugin {found}", f"plugin_opt_config_file {place}"
