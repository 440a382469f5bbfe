"""MAVLink 2 message signing, for one message of one component.

    frame = FD | length | flags | 00 | sequence | system | component | message (24 bits)
            | payload | CRC
    signed frame = frame | link id | timestamp (48 bits) | signature (48 bits)
    signature = first 48 bits of SHA-256(key (32 bytes) | frame | link id | timestamp)

all little endian. The freshness value is the timestamp: 10 us units since 2015-01-01.

Source: MAVLink Developer Guide, Packet Serialization and Message Signing.
"""

from binascii import crc_hqx
from dataclasses import dataclass
from hashlib import sha256
from typing import NamedTuple

from holdfast.auth.keys import KeyRing
from holdfast.auth.mac import same
from holdfast.auth.scheme import Opened, Outcome, Sender, Verifier, checked, fitting

KEY_BYTES = 32
HEADER = 10
SIGNATURE = 13
SIGNED = 0x01
MINUTE = 6_000_000
"""One minute in units of the timestamp."""
TOP = (1 << 48) - 1

_MIRRORED = bytes(int(f"{i:08b}"[::-1], 2) for i in range(256))


def crc(data: bytes) -> int:
    """CRC-16/MCRF4XX: polynomial 0x1021 mirrored, start 0xFFFF.

    The standard library has the unmirrored one, in C: mirror what goes in and what comes out.

    Source: MAVLink Developer Guide, Packet Serialization, Checksum.
    """
    value = crc_hqx(data.translate(_MIRRORED), 0xFFFF)
    return _MIRRORED[value >> 8] | _MIRRORED[value & 0xFF] << 8


def route(frame: bytes) -> tuple[int, int, int] | None:
    """System, component and message of a MAVLink 2 frame: to which stream it says it belongs.
    None if it is too short or none. Nothing is verified.
    """
    if len(frame) < HEADER + 2 or frame[0] != 0xFD:
        return None
    return frame[5], frame[6], int.from_bytes(frame[7:10], "little")


class SenderState(NamedTuple):
    """The newest timestamp used, and the sequence number of the next frame."""

    last: int
    sequence: int


class VerifierState(NamedTuple):
    """The verifier's own timestamp, and the newest accepted one of each link id."""

    own: int
    links: dict[int, int]


@dataclass(frozen=True)
class _Stream:
    keys: KeyRing
    system: int
    component: int
    message: int
    crc_extra: int
    payload_bytes: int

    def __post_init__(self):
        self.keys.sized(KEY_BYTES)
        for name, high in (("system", 255), ("component", 255), ("message", 0xFFFFFF)):
            checked(name, getattr(self, name), 0, high)
        checked("crc_extra", self.crc_extra, 0, 255)
        checked("payload_bytes", self.payload_bytes, 1, 255)

    @property
    def identity(self) -> tuple[int, ...]:
        """System, component and message."""
        return self.system, self.component, self.message

    def _crc(self, head: bytes) -> bytes:
        return crc(head[1:] + bytes((self.crc_extra,))).to_bytes(2, "little")


def _signature(secret: bytes, signed: bytes) -> bytes:
    return sha256(secret + signed).digest()[:6]


@dataclass(frozen=True)
class MavlinkSender(_Stream, Sender):
    """Frames and signs payloads of ``payload_bytes`` bytes as one message.

    ``crc_extra`` is the seed of the message's definition. Raises `ValueError` for a setting
    out of range or a key without 32 bytes.
    """

    link: int = 0

    def __post_init__(self):
        super().__post_init__()
        checked("link", self.link, 0, 255)

    def start(self, last: int = 0) -> SenderState:
        """The state after timestamp ``last``, which must not be behind any that was used."""
        return SenderState(last, 0)

    def seal(self, state: SenderState, payload: bytes, now: int = 0) -> tuple[SenderState, bytes]:
        """A signed frame with the timestamp max(now, last + 1)."""
        stamp = max(state.last + 1, now)
        key = self.keys.at(stamp)
        if stamp > TOP or key is None:
            raise OverflowError(f"timestamp {stamp}: none left, or no key active there")
        frame = self._frame(state, payload, SIGNED)
        frame += bytes((self.link,)) + stamp.to_bytes(6, "little")
        state = SenderState(stamp, (state.sequence + 1) & 0xFF)
        return state, frame + _signature(key.secret, frame)

    def plain(self, state: SenderState, payload: bytes) -> tuple[SenderState, bytes]:
        """A frame without a signature."""
        frame = self._frame(state, payload, 0)
        return SenderState(state.last, (state.sequence + 1) & 0xFF), frame

    def _frame(self, state: SenderState, payload: bytes, flags: int) -> bytes:
        # zeros at the end are not sent, but the first byte always is
        kept = fitting(payload, self.payload_bytes).rstrip(b"\0") or payload[:1]
        head = bytes((0xFD, len(kept), flags, 0, state.sequence, self.system, self.component))
        head += self.message.to_bytes(3, "little") + kept
        return head + self._crc(head)


@dataclass(frozen=True)
class MavlinkVerifier(_Stream, Verifier):
    """Opens the frames of one message of one component, over any number of links.

    Timestamps must rise for each link id, and none may lie more than ``age`` behind the
    verifier's own timestamp, which is the larger of ``now`` and the newest one accepted. The
    guide asks this of every frame, the C library only of the first of a link: there, a frame
    that was held back can be delivered at any later time. A smaller ``age`` allows less.

    Raises `ValueError` for a setting out of range or a key without 32 bytes.

    Source: MAVLink Developer Guide, Message Signing, Timestamp Handling and Accepting Signed
    Packets.
    """

    age: int = MINUTE

    def __post_init__(self):
        super().__post_init__()
        checked("age", self.age, 0, TOP)

    @property
    def fresh(self) -> bool:
        """True."""
        return True

    def start(self, last: int = 0) -> VerifierState:
        """The state with an own timestamp of ``last`` and no link seen. A restored one is
        better: with this, what a link sent in the last minute is accepted once more.
        """
        return VerifierState(last, {})

    def open(
        self, state: VerifierState, message: bytes, now: int = 0
    ) -> tuple[VerifierState, Opened]:
        """Payload, with its zeros restored, and outcome."""
        size = self._size(message)
        if size is None:
            return state, Opened(None, Outcome.MALFORMED)
        payload = message[HEADER : HEADER + size].ljust(self.payload_bytes, b"\0")
        if not message[2]:
            return state, Opened(payload, Outcome.UNSIGNED)
        link, stamp = message[-13], int.from_bytes(message[-12:-6], "little")
        key = self.keys.at(stamp)
        if key is None:
            return state, Opened(None, Outcome.UNKNOWN_KEY)
        if not same(_signature(key.secret, message[:-6]), message[-6:]):
            return state, Opened(None, Outcome.FORGED)
        if stamp <= state.links.get(link, -1):
            return state, Opened(None, Outcome.REPLAYED, stamp, key.id)
        if stamp < max(now, state.own) - self.age:
            return state, Opened(None, Outcome.STALE, stamp, key.id)
        moved = VerifierState(max(state.own, stamp), {**state.links, link: stamp})
        return moved, Opened(payload, Outcome.AUTHENTIC, stamp, key.id)

    def _size(self, frame: bytes) -> int | None:
        """Length of the payload as sent, if this is a sound frame of this stream."""
        if route(frame) != self.identity or frame[2] & ~SIGNED:
            return None
        size = frame[1]
        end = HEADER + size
        if not 1 <= size <= self.payload_bytes:
            return None
        if len(frame) != end + 2 + (SIGNATURE if frame[2] else 0):
            return None
        return size if self._crc(frame[:end]) == frame[end : end + 2] else None
