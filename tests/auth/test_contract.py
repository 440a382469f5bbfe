"""What every scheme keeps, whatever it sends."""

import copy
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from holdfast.auth import KeyRing, Outcome

PAYLOAD = bytes(range(1, 9))
PAYLOADS = [PAYLOAD, bytes(8), b"\0" * 7 + b"\1", b"\1" + bytes(7), b"\xff" * 8]

# a pair holds settings alone, so one serves all examples
shared = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)


def sealed(pair, count, start=0, now=0):
    """The last state of the sender, and ``count`` messages."""
    state, messages = pair.sender.start(start), []
    for i in range(count):
        state, message = pair.sender.seal(state, PAYLOADS[i % len(PAYLOADS)], now)
        messages.append(message)
    return state, messages


def outcome(pair, message, state=None, now=0):
    state = pair.verifier.start() if state is None else state
    after, opened = pair.verifier.open(state, message, now)
    if opened.outcome is not Outcome.AUTHENTIC:
        assert after == state
        assert (opened.payload is None) == (opened.outcome is not Outcome.UNSIGNED)
    return opened.outcome


def test_what_is_sealed_is_opened(pair):
    _, messages = sealed(pair, 600)
    state = pair.verifier.start()
    for i, message in enumerate(messages):
        state, opened = pair.verifier.open(state, message)
        assert opened == (PAYLOADS[i % len(PAYLOADS)], Outcome.AUTHENTIC, i + 1, 0)


def test_a_plain_message_is_unsigned_and_moves_nothing(pair):
    sending, receiving = pair.sender.start(), pair.verifier.start()
    for payload in PAYLOADS:
        sending, message = pair.sender.plain(sending, payload)
        receiving, opened = pair.verifier.open(receiving, message)
        assert opened == (payload, Outcome.UNSIGNED, None, None)
    _, message = pair.sender.seal(sending, PAYLOAD)
    assert pair.verifier.open(receiving, message)[1].freshness == 1


def test_a_replay_is_noticed_at_once_and_never_accepted_later(pair):
    _, messages = sealed(pair, 20)
    state = pair.verifier.start()
    for i, message in enumerate(messages):
        state, _ = pair.verifier.open(state, message)
        assert outcome(pair, message, state) is Outcome.REPLAYED
        for old in messages[:i]:
            assert outcome(pair, old, state) in (Outcome.REPLAYED, Outcome.FORGED)


def test_a_gap_is_bridged_and_what_was_overtaken_is_lost(pair):
    _, messages = sealed(pair, 2)
    if getattr(getattr(pair.sender, "profile", None), "sent", 1) == 0:
        # with no bit of the freshness value sent, only more attempts bridge a gap
        assert outcome(pair, messages[1]) is Outcome.FORGED
        pair = pair._replace(verifier=replace(pair.verifier, attempts=2))
    state, opened = pair.verifier.open(pair.verifier.start(), messages[1])
    assert opened.outcome is Outcome.AUTHENTIC
    assert outcome(pair, messages[0], state) in (Outcome.REPLAYED, Outcome.FORGED)


def test_a_state_that_was_not_kept_accepts_replays(pair):
    """Why the state must survive a restart."""
    _, (message,) = sealed(pair, 1)
    state, _ = pair.verifier.open(pair.verifier.start(), message)
    assert outcome(pair, message, state) is Outcome.REPLAYED
    assert outcome(pair, message) is Outcome.AUTHENTIC


def test_every_single_bit_counts(pair):
    _, (message,) = sealed(pair, 1)
    for bit in range(8 * len(message)):
        altered = bytearray(message)
        altered[bit // 8] ^= 1 << bit % 8
        assert outcome(pair, bytes(altered)) in (
            Outcome.FORGED, Outcome.REPLAYED, Outcome.UNKNOWN_KEY, Outcome.MALFORMED,
        )  # fmt: skip


@shared
@given(data=st.data(), payload=st.binary(min_size=8, max_size=8), last=st.integers(0, 2**40))
def test_a_flipped_bit_is_never_accepted(strong, data, payload, last):
    _, message = strong.sender.seal(strong.sender.start(last), payload)
    bits = data.draw(st.sets(st.integers(0, 8 * len(message) - 1), min_size=1, max_size=3))
    altered = bytearray(message)
    for bit in bits:
        altered[bit // 8] ^= 1 << bit % 8
    before = strong.verifier.start(last)
    assert outcome(strong, message, before) is Outcome.AUTHENTIC
    assert outcome(strong, bytes(altered), before) not in (Outcome.AUTHENTIC, Outcome.UNSIGNED)


@shared
@given(message=st.binary(max_size=60), last=st.integers(0, 2**20), now=st.integers(0, 2**20))
def test_no_message_raises(pair, message, last, now):
    found = outcome(pair, message, pair.verifier.start(last), now)
    assert found in (Outcome.MALFORMED, Outcome.UNSIGNED, Outcome.FORGED)


def test_a_part_of_a_message_has_no_tag(pair):
    _, (message,) = sealed(pair, 1)
    for size in range(len(message)):
        assert outcome(pair, message[:size]) in (Outcome.MALFORMED, Outcome.UNSIGNED)
    assert outcome(pair, message + b"\0") is Outcome.MALFORMED


def test_another_stream_or_key_does_not_pass(pair):
    _, (message,) = sealed(pair, 1)
    assert outcome(pair.of_stream(9), message) in (Outcome.FORGED, Outcome.MALFORMED)
    other = pair.with_keys(KeyRing((pair.key(5),)))
    assert outcome(other, message) is Outcome.FORGED
    assert pair.sender.identity == pair.verifier.identity != pair.of_stream(9).sender.identity


def test_with_a_clock_what_is_held_back_goes_stale(pair):
    _, message = pair.sender.seal(pair.sender.start(), PAYLOAD, now=1000)
    before = pair.verifier.start(999)
    for age, now, expected in [
        (0, 1000, Outcome.AUTHENTIC),
        (0, 1001, Outcome.STALE),
        (1, 1001, Outcome.AUTHENTIC),
        (1, 1002, Outcome.STALE),
    ]:
        assert outcome(pair.with_age(age), message, before, now) is expected


def test_a_clock_makes_up_for_any_number_of_lost_messages(pair):
    _, message = pair.sender.seal(pair.sender.start(), PAYLOAD, now=123_456)
    assert outcome(pair.with_age(0), message, now=123_456) is Outcome.AUTHENTIC


def test_the_key_changes_at_the_same_message_at_both_ends(pair):
    old = KeyRing((pair.key(1),))
    rotated = pair.with_keys(old.rotated(pair.key(2, first=11)))
    _, messages = sealed(rotated, 20)
    state, ids = rotated.verifier.start(), []
    for message in messages:
        state, opened = rotated.verifier.open(state, message)
        assert opened.outcome is Outcome.AUTHENTIC
        ids.append(opened.key)
    assert ids == [1] * 10 + [2] * 10


@pytest.mark.parametrize("behind", ["sender", "verifier"])
def test_an_end_without_the_next_key_is_cut_off(pair, behind):
    """From the first message of the new key on, and not before."""
    old = KeyRing((pair.key(1),))
    new = old.rotated(pair.key(2, first=11))
    ends = pair.with_keys(*((old, new) if behind == "sender" else (new, old)))
    _, messages = sealed(ends, 12)
    state = ends.verifier.start()
    for message in messages[:10]:
        state, opened = ends.verifier.open(state, message)
        assert opened.outcome is Outcome.AUTHENTIC
    assert outcome(ends, messages[10], state) is Outcome.FORGED
    # and the next key, as soon as it is there, opens what follows
    both = pair.with_keys(new)
    _, messages = sealed(both, 11)
    assert outcome(both, messages[10], state) is Outcome.AUTHENTIC


def test_a_retired_key_never_comes_back(pair):
    old = KeyRing((pair.key(1),))
    new = pair.with_keys(old.rotated(pair.key(2, first=11)))
    leaked = pair.with_keys(old)
    state = new.verifier.start(10)
    for last in range(10, 40):
        _, message = leaked.sender.seal(leaked.sender.start(last), PAYLOAD)
        assert outcome(new, message, state) is Outcome.FORGED


def test_a_time_without_a_key_has_no_authentic_message(pair):
    late = KeyRing((pair.key(1, first=100),))
    _, messages = sealed(pair, 1)
    assert outcome(pair.with_keys(late), messages[0]) is Outcome.UNKNOWN_KEY
    with pytest.raises(OverflowError, match="no key"):
        sealed(pair.with_keys(late), 1)


def test_nothing_is_changed_in_place(pair):
    _, (message,) = sealed(pair, 1)
    for end, call in [(pair.sender, "seal"), (pair.sender, "plain"), (pair.verifier, "open")]:
        state = end.start()
        kept = copy.deepcopy(state)
        content = message if call == "open" else PAYLOAD
        first, second = (getattr(end, call)(state, content) for _ in range(2))
        assert first == second
        assert state == kept


@pytest.mark.parametrize("length", [0, 7, 9])
def test_a_payload_of_another_length_is_refused(pair, length):
    for call in (pair.sender.seal, pair.sender.plain):
        with pytest.raises(ValueError, match=f"payload: found {length} bytes, expected 8"):
            call(pair.sender.start(), bytes(length))


def test_the_freshness_value_does_not_wrap(pair):
    top = getattr(getattr(pair.sender, "profile", None), "top", 2**48 - 1)
    state, message = pair.sender.seal(pair.sender.start(top - 1), PAYLOAD)
    assert outcome(pair, message, pair.verifier.start(top - 1)) is Outcome.AUTHENTIC
    with pytest.raises(OverflowError, match="none left"):
        pair.sender.seal(state, PAYLOAD)
    after, _ = pair.verifier.open(pair.verifier.start(top - 1), message)
    assert outcome(pair, message, after) is Outcome.REPLAYED


def test_keys_do_not_show(pair):
    assert "secret" not in repr(pair.sender)
    assert repr(bytes(range(16)))[2:-1] not in repr(pair.verifier)
