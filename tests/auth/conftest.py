"""The schemes that every test of the common contract runs over."""

from dataclasses import replace
from typing import NamedTuple

import pytest

from holdfast.auth import (
    PROFILE_1,
    PROFILE_3,
    Key,
    KeyRing,
    MavlinkSender,
    MavlinkVerifier,
    Profile,
    SecocSender,
    SecocVerifier,
    Sender,
    Verifier,
)


class Pair(NamedTuple):
    """Both ends of one scheme; ``key`` makes keys of its length."""

    sender: Sender
    verifier: Verifier
    key_bytes: int

    def key(self, number: int, first: int = 0) -> Key:
        return Key(number, bytes([number + 1]) * self.key_bytes, first)

    def with_keys(self, sender: KeyRing, verifier: KeyRing | None = None) -> "Pair":
        both = replace(self.sender, keys=sender), replace(self.verifier, keys=verifier or sender)
        return Pair(*both, self.key_bytes)

    def of_stream(self, number: int) -> "Pair":
        field = "data_id" if isinstance(self.sender, SecocSender) else "component"
        both = (replace(end, **{field: number}) for end in (self.sender, self.verifier))
        return Pair(*both, self.key_bytes)

    def with_age(self, age: int) -> "Pair":
        return self._replace(verifier=replace(self.verifier, age=age))


def secoc(profile: Profile) -> Pair:
    keys = KeyRing.of(bytes(range(16)))
    common = {"keys": keys, "data_id": 0x0123, "payload_bytes": 8, "profile": profile}
    return Pair(SecocSender(**common), SecocVerifier(**common), 16)


def mavlink() -> Pair:
    keys = KeyRing.of(bytes(range(32)))
    common = {
        "keys": keys, "system": 1, "component": 7, "message": 0x0102A3, "crc_extra": 50,
        "payload_bytes": 8,
    }  # fmt: skip
    return Pair(MavlinkSender(**common, link=3), MavlinkVerifier(**common), 32)


SCHEMES = {
    "secoc-1": secoc(PROFILE_1),
    "secoc-3": secoc(PROFILE_3),
    "secoc-long": secoc(Profile(tag=128, sent=64)),
    "secoc-odd": secoc(Profile(tag=61, sent=6, freshness=24)),
    "secoc-nothing-sent": secoc(Profile(tag=64, sent=0)),
    "mavlink": mavlink(),
}


@pytest.fixture(params=SCHEMES)
def pair(request):
    return SCHEMES[request.param]


@pytest.fixture(params=["secoc-long", "mavlink"])
def strong(request):
    """Tags so long that no test ever meets a lucky forgery."""
    return SCHEMES[request.param]
