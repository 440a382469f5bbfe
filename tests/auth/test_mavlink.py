from dataclasses import replace

import pytest

from holdfast.auth import KeyRing, MavlinkSender, MavlinkVerifier, Outcome
from holdfast.auth.mavlink import MINUTE, TOP, VerifierState, crc, route

# a signed heartbeat from the tests of rust-mavlink (mavlink/tests/signing.rs and test_shared)
KEY = bytes.fromhex(
    "0001f2e3d4c5b6a7980070763432001622420 0ccff7a0052757374004d4156b3".replace(" ", "")
)
HEARTBEAT = bytes.fromhex("fd090100ef0102000000050000000203590303c98b00ffffffffffff2718b168ccf5")
STREAM = {"system": 1, "component": 2, "message": 0, "crc_extra": 50, "payload_bytes": 9}
RING = KeyRing.of(KEY)
PAYLOAD = bytes(range(1, 10))


def ends(**settings):
    return MavlinkSender(RING, **STREAM), MavlinkVerifier(RING, **STREAM, **settings)


def test_the_checksum_is_mcrf4xx():
    assert crc(b"123456789") == 0x6F91
    assert crc(b"") == 0xFFFF
    value = 0xFFFF  # bit by bit, as the polynomial says
    for byte in bytes(range(256)):
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0x8408 if value & 1 else 0)
    assert crc(bytes(range(256))) == value


def test_a_signed_frame_of_another_implementation():
    sender, verifier = ends()
    state, opened = verifier.open(verifier.start(), HEARTBEAT)
    assert opened == (HEARTBEAT[10:19], Outcome.AUTHENTIC, TOP, 0)
    assert verifier.open(state, HEARTBEAT)[1].outcome is Outcome.REPLAYED
    # and the same bytes from here: sequence number 239, newest timestamp
    _, frame = sender.seal(sender.start(TOP - 1)._replace(sequence=0xEF), HEARTBEAT[10:19])
    assert frame == HEARTBEAT


def test_sequence_numbers_count_all_frames_and_wrap():
    sender, _ = ends()
    state = sender.start()
    for i in range(300):
        call = sender.seal if i % 3 else sender.plain
        state, frame = call(state, PAYLOAD)
        assert frame[4] == i % 256


@pytest.mark.parametrize(
    ("payload", "sent"),
    [(PAYLOAD, 9), (b"\1" + bytes(8), 1), (bytes(9), 1), (b"\0\1" + bytes(7), 2)],
)
def test_zeros_at_the_end_are_not_sent_but_restored(payload, sent):
    sender, verifier = ends()
    for call in (sender.seal, sender.plain):
        _, frame = call(sender.start(), payload)
        assert frame[1] == sent
        assert verifier.open(verifier.start(), frame)[1].payload == payload


def test_a_sender_that_keeps_its_zeros_is_understood():
    verifier = ends()[1]
    frame = bytes.fromhex("fd0900000001020000000100000000000000 00")
    frame += crc(frame[1:] + b"\x32").to_bytes(2, "little")
    opened = verifier.open(verifier.start(), frame)[1]
    assert opened == (b"\1" + bytes(8), Outcome.UNSIGNED, None, None)


def test_each_link_has_its_own_timestamps():
    sender, verifier = ends()
    other = replace(sender, link=1)
    state = verifier.start()
    _, early = sender.seal(sender.start(100), PAYLOAD)
    _, late = other.seal(other.start(500), PAYLOAD)
    state, opened = verifier.open(state, late)
    assert opened.outcome is Outcome.AUTHENTIC
    state, opened = verifier.open(state, early)
    assert opened.outcome is Outcome.AUTHENTIC
    assert state == VerifierState(501, {1: 501, 0: 101})
    for frame in (early, late):
        assert verifier.open(state, frame)[1].outcome is Outcome.REPLAYED


@pytest.mark.parametrize("seen", [False, True])
def test_nothing_older_than_a_minute(seen):
    """Neither the first frame of a link nor, against holding back, a later one."""
    sender, verifier = ends()
    now = 10 * MINUTE
    state = VerifierState(5, {0: 5} if seen else {})
    for behind, expected in [(0, Outcome.AUTHENTIC), (MINUTE, Outcome.AUTHENTIC),
                             (MINUTE + 1, Outcome.STALE)]:  # fmt: skip
        _, frame = sender.seal(sender.start(now - behind - 1), PAYLOAD)
        assert verifier.open(state, frame, now)[1].outcome is expected


def test_the_own_timestamp_follows_what_is_accepted_and_nothing_else():
    sender, verifier = ends()
    _, ahead = sender.seal(sender.start(10 * MINUTE), PAYLOAD)
    state, _ = verifier.open(verifier.start(), ahead[:-1] + bytes([ahead[-1] ^ 1]))
    assert state.own == 0
    state, _ = verifier.open(state, ahead)
    assert state.own == 10 * MINUTE + 1
    _, old = replace(sender, link=9).seal(sender.start(8 * MINUTE), PAYLOAD)
    assert verifier.open(state, old)[1].outcome is Outcome.STALE


def test_a_stripped_signature_is_a_plain_frame():
    """Anybody can make one: only the schedule tells that it should have been signed."""
    sender, verifier = ends()
    _, frame = sender.seal(sender.start(), PAYLOAD)
    plain = frame[:2] + b"\0" + frame[3:19]
    plain += crc(plain[1:] + b"\x32").to_bytes(2, "little")
    assert verifier.open(verifier.start(), plain)[1].outcome is Outcome.UNSIGNED


@pytest.mark.parametrize("flags", [0x02, 0x03, 0x80])
def test_flags_that_are_not_understood_are_refused(flags):
    sender, verifier = ends()
    _, frame = (sender.seal if flags & 1 else sender.plain)(sender.start(), PAYLOAD)
    frame = frame[:2] + bytes([flags]) + frame[3:]
    frame = frame[:19] + crc(frame[1:19] + b"\x32").to_bytes(2, "little") + frame[21:]
    assert verifier.open(verifier.start(), frame)[1].outcome is Outcome.MALFORMED


def test_another_definition_of_the_message_is_refused():
    sender, verifier = ends()
    _, frame = sender.seal(sender.start(), PAYLOAD)
    for change in ({"crc_extra": 51}, {"payload_bytes": 8}, {"message": 1}, {"system": 2}):
        other = replace(verifier, **change)
        assert other.open(other.start(), frame)[1].outcome is Outcome.MALFORMED


def test_frames_tell_where_they_claim_to_belong():
    assert route(HEARTBEAT) == (1, 2, 0)
    assert route(HEARTBEAT[:11]) is None
    assert route(b"\xfe" + HEARTBEAT[1:]) is None
    assert ends()[0].sync(None) is None
    assert ends()[1].resync(None, HEARTBEAT) == (None, Outcome.MALFORMED)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"system": 256}, "system: found 256, expected 0 to 255"),
        ({"message": 1 << 24}, "message: found 16777216"),
        ({"payload_bytes": 0}, "payload_bytes: found 0"),
        ({"crc_extra": -1}, "crc_extra: found -1"),
        ({"link": 256}, "link: found 256"),
        ({"keys": KeyRing.of(bytes(16))}, "key 0: found 16 bytes, expected 32"),
    ],
)
def test_settings_that_cannot_be(settings, words):
    with pytest.raises(ValueError, match=words):
        replace(ends()[0], **settings)
    with pytest.raises(ValueError, match="age: found -1"):
        ends(age=-1)
