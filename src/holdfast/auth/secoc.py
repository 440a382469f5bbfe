"""AUTOSAR SecOC: AES-CMAC with truncated tag and truncated freshness value.

    Secured I-PDU = payload | low bits of the freshness value | high bits of the MAC
    MAC = AES-128-CMAC(key, data id (16 bits) | payload | whole freshness value)

all big endian, the last byte filled up with zeros. The verifier completes the freshness value
to the smallest one that is new and ends in the bits it received.

Source: AUTOSAR SWS Secure Onboard Communication (document 654), Sections 7.1.1.2 (data to the
authenticator), 7.1.1.3 (freshness) and 7.3 (profiles); AUTOSAR PRS SecOC Protocol (document
969).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from holdfast.auth.keys import KeyRing
from holdfast.auth.mac import KEY_BYTES, MAC_BYTES, Mac, by_value, same
from holdfast.auth.scheme import Opened, Outcome, Sender, Verifier, checked, fitting


@dataclass(frozen=True)
class Profile:
    """Lengths in bits: the whole freshness value (a multiple of 8, at most 64; 0 for none), how
    many of its low bits are sent, and the tag. Raises `ValueError` for others.

    Source: SWS SecOC, SecOCFreshnessValueLength, SecOCFreshnessValueTxLength (...TruncLength in
    later releases) and SecOCAuthInfoTxLength.
    """

    tag: int = 24
    sent: int = 8
    freshness: int = 64

    def __post_init__(self):
        checked("tag", self.tag, 1, 8 * MAC_BYTES)
        checked("freshness", self.freshness, 0, 64)
        checked("sent", self.sent, 0, self.freshness)
        if self.freshness % 8:
            # the standard leaves open on which side an odd value is filled up for the MAC
            raise ValueError(f"freshness: found {self.freshness}, expected a multiple of 8")

    @property
    def trailer(self) -> int:
        """The bytes that a tag adds to a message."""
        return (self.sent + self.tag + 7) // 8

    @property
    def top(self) -> int:
        """The largest freshness value of a message; the one above, all ones, marks a sync."""
        return (1 << self.freshness) - 2


PROFILE_1 = Profile(tag=24, sent=8)
"""24Bit-CMAC-8Bit-FV. Source: SWS_SecOC_00192."""
PROFILE_2 = Profile(tag=24, sent=0, freshness=0)
"""24Bit-CMAC-No-FV: a replay is not noticed, so a link refuses it. Source: SWS_SecOC_00193."""
PROFILE_3 = Profile(tag=28, sent=4)
"""JASPAR. Source: SWS_SecOC_00194."""


class Counter(NamedTuple):
    """The newest freshness value used or accepted; 0 if none."""

    last: int


@dataclass(frozen=True)
class _Stream:
    keys: KeyRing
    data_id: int
    payload_bytes: int
    profile: Profile = PROFILE_1
    _macs: tuple[tuple[int, int, Mac], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        checked("data_id", self.data_id, 0, 0xFFFF)
        checked("payload_bytes", self.payload_bytes, 0, 0xFFFF)
        object.__setattr__(self, "_macs", by_value(self.keys.sized(KEY_BYTES)))

    @property
    def identity(self) -> tuple[int, ...]:
        """The data id."""
        return (self.data_id,)

    def start(self, last: int = 0) -> Counter:
        """The state after freshness value ``last``; 0: none yet. After a restart a sender's
        must be at least the newest value it used, a verifier's the newest it accepted.
        """
        return Counter(last)

    def _key(self, value: int) -> tuple[int, Mac] | None:
        for first, name, mac in self._macs:
            if value >= first:
                return name, mac
        return None

    def _mac(self, mac: Mac, payload: bytes, value: int) -> bytes:
        whole = value.to_bytes(self.profile.freshness // 8, "big")
        return mac(self.data_id.to_bytes(2, "big") + payload + whole)

    def _trailer(self, mac: Mac, payload: bytes, value: int) -> bytes:
        """Low bits of the value, high bits of the MAC, zeros up to a whole byte."""
        p = self.profile
        tag = int.from_bytes(self._mac(mac, payload, value), "big") >> 8 * MAC_BYTES - p.tag
        bits = (value & (1 << p.sent) - 1) << p.tag | tag
        return (bits << 8 * p.trailer - p.sent - p.tag).to_bytes(p.trailer, "big")

    def _statement(self, mac: Mac, value: int) -> bytes:
        """A sync message: the value and a whole tag. Its MAC is that of a message with the
        value as payload and the reserved freshness value, so it is never that of another.
        """
        stated = value.to_bytes(self.profile.freshness // 8, "big")
        return stated + self._mac(mac, stated, self.profile.top + 1)


@dataclass(frozen=True)
class SecocSender(_Stream, Sender):
    """Seals the payloads of one data id, all of ``payload_bytes`` bytes.

    Raises `ValueError` for a setting out of range or a key without 16 bytes.
    """

    def seal(self, state: Counter, payload: bytes, now: int = 0) -> tuple[Counter, bytes]:
        """Payload, truncated freshness value and truncated tag."""
        fitting(payload, self.payload_bytes)
        value = max(state.last + 1, now) if self.profile.freshness else 0
        key = self._key(value)
        if value > max(self.profile.top, 0) or key is None:
            raise OverflowError(f"freshness value {value}: none left, or no key active there")
        return Counter(value), payload + self._trailer(key[1], payload, value)

    def plain(self, state: Counter, payload: bytes) -> tuple[Counter, bytes]:
        """The payload as it is; the freshness value does not move."""
        return state, fitting(payload, self.payload_bytes)

    def sync(self, state: Counter) -> bytes | None:
        """The newest freshness value used, whole, with a whole tag; None if there is none, in
        the profile or from a key.
        """
        key = self._key(state.last)
        if not self.profile.freshness or key is None:
            return None
        return self._statement(key[1], state.last)


@dataclass(frozen=True)
class SecocVerifier(_Stream, Verifier):
    """Opens the messages of one data id.

    ``attempts``: how many completions of the freshness value are tried, each 2^sent above the
    one before. Up to attempts * 2^sent - 1 messages may be lost before only a sync message
    helps; every attempt is one more chance for a guessed tag (`odds.forgery`).

    ``age``: how far a value may lie behind ``now``, where a clock is given. With both ends on
    one clock and 0, a message that was held back is STALE in the next tick, and no number of
    lost messages needs a sync.

    Whether a message has a tag is told by its length, as a payload of fixed length allows.
    Raises `ValueError` for a setting out of range or a key without 16 bytes.

    Source: SWS SecOC, Section 7.1.1.3 and the annex on freshness management: received bits
    above the last ones keep the high part of the last value, others increase it.
    """

    attempts: int = 1
    age: int = 0

    def __post_init__(self):
        super().__post_init__()
        checked("attempts", self.attempts, 1, 1 << 16)
        checked("age", self.age, 0, 1 << 64)

    @property
    def fresh(self) -> bool:
        """False only without a freshness value (profile 2)."""
        return self.profile.freshness > 0

    def open(self, state: Counter, message: bytes, now: int = 0) -> tuple[Counter, Opened]:
        """Payload and outcome; moves on to the message's freshness value if it is authentic."""
        payload, trailer = message[: self.payload_bytes], message[self.payload_bytes :]
        if len(message) == self.payload_bytes:
            return state, Opened(message, Outcome.UNSIGNED)
        if len(message) != self.payload_bytes + self.profile.trailer:
            return state, Opened(None, Outcome.MALFORMED)
        floor = max(state.last + 1, now - self.age) if self.fresh else 0
        step = 1 << self.profile.sent
        received = int.from_bytes(trailer, "big") >> 8 * len(trailer) - self.profile.sent
        value = floor + (received - floor) % step
        found = Outcome.FORGED
        for candidate in self._candidates(value, step):
            key = self._key(candidate)
            found = Outcome.UNKNOWN_KEY if key is None else Outcome.FORGED
            if key and same(self._trailer(key[1], payload, candidate), trailer):
                return Counter(candidate), Opened(payload, Outcome.AUTHENTIC, candidate, key[0])
        return state, self._refused(state, payload, trailer, value - step, found)

    def _candidates(self, value: int, step: int) -> Iterator[int]:
        for _ in range(self.attempts if self.fresh else 1):
            if value > max(self.profile.top, 0):
                return
            yield value
            value += step

    def _refused(
        self, state: Counter, payload: bytes, trailer: bytes, value: int, found: Outcome
    ) -> Opened:
        """Why: the tag may belong to the last value below that ends in these bits. It is not
        accepted either way; further back, a replay cannot be told from a forgery.
        """
        key = self._key(value) if self.fresh and value > 0 else None
        if key is not None and same(self._trailer(key[1], payload, value), trailer):
            late = Outcome.STALE if value > state.last else Outcome.REPLAYED
            return Opened(None, late, value, key[0])
        return Opened(None, found)

    def resync(self, state: Counter, message: bytes) -> tuple[Counter, Outcome]:
        """Take up the sender's freshness value: forwards only. AUTHENTIC if it is not behind."""
        size = self.profile.freshness // 8
        if not size or len(message) != size + MAC_BYTES:
            return state, Outcome.MALFORMED
        value = int.from_bytes(message[:size], "big")
        if value > self.profile.top:
            return state, Outcome.MALFORMED
        key = self._key(value)
        if key is None:
            return state, Outcome.UNKNOWN_KEY
        if not same(self._statement(key[1], value), message):
            return state, Outcome.FORGED
        if value < state.last:
            return state, Outcome.ROLLED_BACK
        return Counter(value), Outcome.AUTHENTIC
