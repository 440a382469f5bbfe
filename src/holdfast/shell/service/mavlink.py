"""MAVLink 2 over UDP: fields of messages of the common dialect, signed ones verified."""

import asyncio
import math
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from holdfast.shell.errors import InputError, one_of, shown
from holdfast.shell.service.limits import Backoff, RateLimit
from holdfast.shell.service.records import Samples
from holdfast.shell.service.sources import Counters, Source, Take
from holdfast.shell.service.wire import as_float

RATE = 5_000
"""Frames a second that are read; more are counted and left alone."""
DATAGRAM = 4096
"""Bytes of a datagram; longer ones are not read."""
EPOCH = 1_420_070_400
"""2015-01-01, from where the timestamps of signatures count, in Unix time."""
_MARK, _HEADER, _CRC, _SIGNATURE, _SIGNED = 0xFD, 10, 2, 13, 0x01


class _Wanted(NamedTuple):
    """A message of the dialect, and its fields by column."""

    kind: Any
    columns: dict[str, str]


class MavlinkSource(Source):
    """Datagrams of MAVLink 2 frames. ``signals``: "MESSAGE.FIELD" by column, in MAVLink's units.

    The time is the message's ``time_boot_ms`` or ``time_usec``. With ``key_bytes`` the outputs
    of an authentic message are trusted, those of an unsigned one are not, and what is forged,
    replayed or more than a minute old by this machine's clock is rejected.

    Raises `InputError` for a message or field that there is not.
    """

    def __init__(
        self, name: str, host: str, port: int, signals: Mapping[str, str], file: str, key: str,
        key_bytes: bytes | None,
    ):  # fmt: skip
        self.name, self.counters = name, Counters()
        self._address = (host, port)
        try:
            from pymavlink.dialects.v20 import common
        except ImportError:
            expected = 'pip install "holdfast[mavlink]"'
            raise InputError(file, key, "no package for MAVLink", expected) from None
        self._wanted = _wanted(common.mavlink_map, signals, file, f"{key}.signals")
        self._codec: Any = common.MAVLink(None)
        self._unreadable = common.MAVError
        self._signatures = None if key_bytes is None else _Signatures(key_bytes, file, key)
        self._limit = RateLimit(RATE)

    async def run(self, take: Take) -> None:
        """Hand on messages for ever; bind again whenever the socket fails."""
        loop = asyncio.get_running_loop()
        backoff = Backoff()
        while True:
            lost: asyncio.Future[None] = loop.create_future()
            try:
                transport, _ = await loop.create_datagram_endpoint(
                    lambda: _Datagrams(lambda data: self._datagram(data, take), lost),  # noqa: B023
                    local_addr=self._address,
                )
                backoff.succeeded()
                try:
                    await lost
                finally:
                    transport.close()
            except OSError:
                pass
            self.counters.disconnects += 1
            await asyncio.sleep(backoff.pause())

    def held(self) -> Any:
        """The newest signatures accepted of every stream."""
        return None if self._signatures is None else self._signatures.held()

    def restore(self, held: Any) -> None:
        """Go on from a checkpoint: what was accepted before it is not accepted again."""
        if self._signatures is not None:
            self._signatures.restore(held)

    def _datagram(self, data: bytes, take: Take) -> None:
        for frame in _frames(data) if len(data) <= DATAGRAM else (None,):
            self.counters.messages += 1
            samples = None
            if frame is not None and self._limit.allow(time.monotonic()):
                wanted = self._wanted.get(int.from_bytes(frame[7:10], "little"))
                if wanted is None:
                    continue  # nobody's signals: what a vehicle sends besides is no fault
                samples = self._samples(frame, wanted)
            if samples is None:
                self.counters.rejected += 1
            else:
                take(samples)

    def _samples(self, frame: bytes, wanted: _Wanted) -> Samples | None:
        """What a frame says; None where it is damaged or its signature is not right."""
        try:
            message = self._codec.decode(bytearray(frame))
        except self._unreadable:
            return None
        trusted: frozenset[str] = frozenset()
        if self._signatures is not None:
            authentic = self._signatures.authentic(frame, wanted.kind)
            if authentic is None:
                return None
            if authentic:
                trusted = frozenset(name[2:] for name in wanted.columns if name[0] == "y")
        values = {column: as_float(getattr(message, field))
                  for column, field in wanted.columns.items()}  # fmt: skip
        return Samples(_time(message), values, trusted)


class _Signatures:
    """The streams whose signatures have been right, and how far each has come."""

    def __init__(self, key_bytes: bytes, file: str, key: str):
        try:
            from holdfast.auth import KeyRing
        except ImportError:
            expected = 'pip install "holdfast[auth]"'
            raise InputError(file, key, "no package for signatures", expected) from None
        self._ring = KeyRing.of(key_bytes)
        # what is not authentic leaves no trace, so nobody else can make it grow
        self._states: dict[tuple[int, int, int], Any] = {}
        self._verifiers: dict[tuple[int, int, int], Any] = {}

    def held(self) -> list[list[Any]]:
        """Of every stream its name, its own timestamp, and the newest of each link."""
        return [
            [*stream, state.own, [*state.links.items()]] for stream, state in self._states.items()
        ]

    def restore(self, held: list[list[Any]]) -> None:
        """Go on from there."""
        from holdfast.auth.mavlink import VerifierState

        for system, component, kind, own, links in held:
            stamps = {int(link): int(stamp) for link, stamp in links}
            self._states[int(system), int(component), int(kind)] = VerifierState(int(own), stamps)

    def authentic(self, frame: bytes, kind: Any) -> bool | None:
        """Whether a frame is signed rightly, for the first time; None if it claims to be."""
        from holdfast.auth import MavlinkVerifier, Outcome

        stream = frame[5], frame[6], kind.id
        verifier = self._verifiers.get(stream)
        if verifier is None:
            verifier = MavlinkVerifier(self._ring, *stream, kind.crc_extra, kind.unpacker.size)
        state = self._states.get(stream) or verifier.start()
        state, opened = verifier.open(state, frame, int((time.time() - EPOCH) * 1e5))
        if opened.outcome is Outcome.UNSIGNED:
            return False
        if opened.outcome is not Outcome.AUTHENTIC:
            return None
        self._states[stream], self._verifiers[stream] = state, verifier
        return True


class _Datagrams(asyncio.DatagramProtocol):
    """Hands on each datagram, and says when the socket is gone."""

    def __init__(self, received: Callable[[bytes], None], lost: asyncio.Future[None]):
        self._received, self._lost = received, lost

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Hand on."""
        self._received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Say so."""
        if not self._lost.done():
            self._lost.set_result(None)


def _frames(data: bytes) -> Iterator[bytes | None]:
    """The frames of a datagram; None for a rest that is none, after which nothing is looked for."""
    at = 0
    while at < len(data):
        length = _HEADER + _CRC
        if len(data) - at >= length and data[at] == _MARK:
            length += data[at + 1] + (_SIGNATURE if data[at + 2] & _SIGNED else 0)
        frame = data[at : at + length]
        if len(frame) < length or frame[0] != _MARK or frame[2] & ~_SIGNED:
            yield None
            return
        yield frame
        at += length


def _time(message: Any) -> float:
    """In seconds, by whichever clock the message gives; NaN where it gives none."""
    milliseconds = getattr(message, "time_boot_ms", None)
    if milliseconds is not None:
        return milliseconds / 1e3
    return getattr(message, "time_usec", math.nan) / 1e6


def _wanted(
    known: Mapping[int, Any], signals: Mapping[str, str], file: str, key: str
) -> dict[int, _Wanted]:
    """The messages by number, with the fields that are asked for."""
    kinds = {kind.msgname: kind for kind in known.values()}
    found: dict[int, _Wanted] = {}
    for column, wanted in signals.items():
        name, _, field = wanted.partition(".")
        kind = kinds.get(name)
        if kind is None:
            raise InputError(file, f"{key}.{wanted}", f"message {shown(name)}", one_of(kinds, name))
        fields = _numbers(kind)
        if field not in fields:
            expected = one_of(fields, field)
            raise InputError(file, f"{key}.{wanted}", f"field {shown(field)}", expected)
        found.setdefault(kind.id, _Wanted(kind, {})).columns[column] = field
    return found


def _numbers(kind: Any) -> list[str]:
    """The fields of a message that are one number each."""
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    types = zip(kind.fieldnames, kind.fieldtypes, strict=True)
    return [name for name, kind_ in types if lengths[name] == 0 and kind_ != "char"]
