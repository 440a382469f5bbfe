"""CAN: signals of messages that a DBC file describes."""

import asyncio
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from holdfast.shell.errors import InputError, one_of, shown
from holdfast.shell.reading import read_bytes
from holdfast.shell.service.limits import Backoff
from holdfast.shell.service.records import Samples
from holdfast.shell.service.sources import Counters, Source, Take

DBC_LIMIT = 32 * 1024 * 1024
"""Bytes of a DBC file."""
PATIENCE = 0.2
"""Seconds that the reader waits for a message before it looks whether to go on."""
BATCH = 256
"""Messages that are handed over at once."""


class CanSource(Source):
    """Signals of a CAN bus. ``signals``: "MESSAGE.SIGNAL" by column; physical values.

    Raises `InputError` for a DBC file that cannot be read, and for an interface, a message or a
    signal that there is not.
    """

    def __init__(
        self, name: str, interface: str, channel: str, dbc: Path, signals: Mapping[str, str],
        file: str, key: str,
    ):  # fmt: skip
        self.name, self.counters = name, Counters()
        try:
            import can
            import cantools  # noqa: F401
        except ImportError:
            raise InputError(
                file, key, "no package for CAN", 'pip install "holdfast[can]"'
            ) from None
        if interface not in can.VALID_INTERFACES:
            expected = one_of(sorted(can.VALID_INTERFACES), interface)
            raise InputError(file, f"{key}.interface", shown(interface), expected)
        self._wanted = _wanted(_database(dbc), signals, file, f"{key}.signals")
        filters = [
            {"can_id": number, "can_mask": 0x1FFFFFFF if extended else 0x7FF, "extended": extended}
            for number, extended in self._wanted
        ]
        self._open = partial(can.Bus, channel, interface, can_filters=filters)

    async def run(self, take: Take) -> None:
        """Hand on messages for ever; open the bus again whenever it fails."""
        from can import CanError

        backoff = Backoff()
        while True:
            # all that is done to a bus is done by one thread, one after the other
            thread = ThreadPoolExecutor(1, self.name)
            try:
                await self._read(thread, take, backoff)
            except (CanError, OSError):
                self.counters.disconnects += 1
                await asyncio.sleep(backoff.pause())
            finally:
                thread.shutdown(wait=False)

    async def _read(self, thread: ThreadPoolExecutor, take: Take, backoff: Backoff) -> None:
        """Read until the bus fails."""
        loop = asyncio.get_running_loop()
        opening = thread.submit(self._open)
        try:
            bus = await asyncio.wrap_future(opening)
            while True:
                messages = await loop.run_in_executor(thread, _batch, bus)
                if messages:
                    backoff.succeeded()
                for message in messages:
                    self._message(message, take)
        finally:
            # a bus that is still being opened is closed as well
            thread.submit(_close, opening)

    def _message(self, message: Any, take: Take) -> None:
        self.counters.messages += 1
        known = self._wanted.get((message.arbitration_id, message.is_extended_id))
        values = None
        if known is not None and not message.is_error_frame and not message.is_remote_frame:
            values = _values(*known, bytes(message.data))
        if values:
            take(Samples(message.timestamp, values))
        else:
            self.counters.rejected += 1


def _batch(bus: Any) -> list[Any]:
    """What has arrived, up to `BATCH` messages; waits for the first."""
    found = [bus.recv(PATIENCE)]
    while found[-1] is not None and len(found) < BATCH:
        found.append(bus.recv(0))
    return [message for message in found if message is not None]


def _close(opening: Any) -> None:
    if opening.exception() is None:
        opening.result().shutdown()


def _values(described: Any, columns: Mapping[str, str], data: bytes) -> dict[str, float] | None:
    """The columns that a message holds; None where it cannot be read."""
    from cantools.database import DecodeError

    try:
        found = described.decode(data, decode_choices=False)
    except (DecodeError, ValueError, KeyError, OverflowError):
        return None
    # a multiplexed message holds some of its signals
    return {column: float(found[name]) for column, name in columns.items() if name in found}


def _database(dbc: Path) -> Any:
    import cantools

    # names are ASCII; units and comments are in whatever encoding, and nobody reads them
    text = read_bytes(dbc, DBC_LIMIT, "a DBC file").decode("utf-8-sig", "replace")
    try:
        return cantools.database.load_string(text, "dbc")
    except (cantools.database.Error, ValueError, KeyError) as error:
        raise InputError(dbc, "", f"what cannot be read ({error})", "a DBC file") from None


def _wanted(
    database: Any, signals: Mapping[str, str], file: str, key: str
) -> dict[tuple[int, bool], tuple[Any, dict[str, str]]]:
    """By id and kind of id: the message, and its signals by column."""
    known = {message.name: message for message in database.messages if not message.is_container}
    found: dict[tuple[int, bool], tuple[Any, dict[str, str]]] = {}
    for column, wanted in signals.items():
        name, _, signal = wanted.partition(".")
        message = known.get(name)
        if message is None:
            raise InputError(file, f"{key}.{wanted}", f"message {shown(name)}", one_of(known, name))
        names = [one.name for one in message.signals]
        if signal not in names:
            expected = one_of(names, signal)
            raise InputError(file, f"{key}.{wanted}", f"signal {shown(signal)}", expected)
        number = (message.frame_id, message.is_extended_frame)
        found.setdefault(number, (message, {}))[1][column] = signal
    return found
