"""A policy in force: what the estimator is given, and when it alarms."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from holdfast.auth import (
    COUNTERS,
    PROFILE_2,
    STEPS,
    KeyRing,
    Outcome,
    Received,
    Receiver,
    Schedule,
    SecocVerifier,
    Transmitter,
    observation,
    with_failures,
)
from holdfast.auth.samples import encode
from holdfast.records import Enforcement, Reason, Status, Verdict, screen

K = 7
ALWAYS, NEVER = Schedule.of(np.ones((9, 1), bool)), Schedule.of(np.zeros((9, 1), bool))


def link(pair, schedule, clock=STEPS, **settings):
    pairs = [pair.with_age(0).of_stream(i + 1) for i in range(schedule.sensors)]
    return (
        Transmitter(schedule, tuple(p.sender for p in pairs), clock),
        Receiver(schedule, tuple(p.verifier for p in pairs), clock, **settings),
    )


def messages(pair):
    """For each outcome a message of step K that has it, for a verifier that accepted step 2."""
    pair = pair.with_age(0).of_stream(1)
    _, good = pair.sender.seal(pair.sender.start(), encode(3.5), STEPS.at(K))
    _, plain = pair.sender.plain(pair.sender.start(), encode(3.5))
    _, replayed = pair.sender.seal(pair.sender.start(), encode(3.5), STEPS.at(2))
    _, held = pair.sender.seal(pair.sender.start(), encode(3.5), STEPS.at(K - 1))
    return {
        Outcome.AUTHENTIC: good,
        Outcome.UNSIGNED: plain,
        Outcome.FORGED: good[:-1] + bytes([good[-1] ^ 1]),
        Outcome.REPLAYED: replayed,
        Outcome.STALE: held,
        Outcome.MALFORMED: b"?",
        Outcome.MISSING: None,
    }


ARRIVE = [
    Outcome.AUTHENTIC, Outcome.UNSIGNED, Outcome.FORGED, Outcome.REPLAYED, Outcome.STALE,
    Outcome.MALFORMED, Outcome.MISSING,
]  # fmt: skip

# seen, trusted, failed: the table at the head of link.py
DEMANDED = dict.fromkeys(Outcome, (False, False, True)) | {
    Outcome.AUTHENTIC: (True, True, False)
}  # fmt: skip
FREE = dict.fromkeys(Outcome, (False, False, True)) | {
    Outcome.AUTHENTIC: (True, True, False),
    Outcome.UNSIGNED: (True, False, False),
    Outcome.MISSING: (False, False, False),
}


@pytest.mark.parametrize("schedule", [ALWAYS, NEVER], ids=["demanded", "free"])
@pytest.mark.parametrize("outcome", ARRIVE)
def test_every_outcome_demanded_or_not(strong, schedule, outcome):
    _, receiver = link(strong, schedule)
    before = tuple(verifier.start(STEPS.at(2)) for verifier in receiver.verifiers)
    if outcome is Outcome.REPLAYED:  # MAVLink remembers links, not one number
        before = receiver.start()
        first, _ = receiver.verifiers[0].open(before[0], messages(strong)[outcome], STEPS.at(2))
        before = (first,)
    after, got = receiver.receive(before, K, [messages(strong)[outcome]])
    assert got.outcome.tolist() == [outcome]
    seen, trusted, failed = (DEMANDED if schedule is ALWAYS else FREE)[outcome]
    assert (got.seen.tolist(), got.trusted.tolist()) == ([seen], [trusted])
    assert (got.failed.tolist(), got.alarm) == ([failed], failed)
    assert got.y.tolist() == [3.5 if seen else 0.0]
    assert (after == before) == (outcome is not Outcome.AUTHENTIC)


def test_a_time_without_a_key_fails_too(pair):
    late = pair.with_keys(KeyRing((pair.key(0),)), KeyRing((pair.key(0, first=100),)))
    sender, receiver = link(late, ALWAYS)
    _, sent = sender.send(sender.start(), K, [1.0])
    _, got = receiver.receive(receiver.start(), K, sent)
    assert got.outcome.tolist() == [Outcome.UNKNOWN_KEY]
    assert got.alarm


def test_what_may_go_missing_is_a_setting(pair):
    _, strict = link(pair, ALWAYS)
    _, lossy = link(pair, ALWAYS, missing_is_alarm=False)
    assert strict.receive(strict.start(), 0, [None])[1].alarm
    got = lossy.receive(lossy.start(), 0, [None])[1]
    assert (got.alarm, got.seen.tolist(), got.trusted.tolist()) == (False, [False], [False])
    # but a message without its tag is no loss
    assert lossy.receive(lossy.start(), 0, [encode(1.0)])[1].alarm


def test_a_policy_end_to_end(pair):
    """Without an attacker: all seen, trusted exactly where demanded, no alarm, tags only there."""
    policy = Enforcement.of([3, 50, 1], [1, 7, 0], [0, 5, 0])
    schedule = Schedule.of(policy)
    sender, receiver = link(pair, schedule)
    sending, receiving = sender.start(), receiver.start()
    y = np.random.default_rng(0).normal(size=(400, 3))
    plain = len(sender.senders[0].plain(sending[0], encode(y[0, 0]))[1])
    for k in range(400):
        sending, sent = sender.send(sending, k, y[k])
        demanded = schedule.mask(k, k + 1)[0]
        assert [len(message) > plain for message in sent] == demanded.tolist()
        receiving, got = receiver.receive(receiving, k, sent)
        np.testing.assert_array_equal(got.y, y[k])
        assert got.seen.all()
        np.testing.assert_array_equal(got.trusted, demanded)
        assert not got.alarm


def test_a_sensor_without_a_sample_sends_nothing(pair):
    sender, _ = link(pair, Schedule.of(np.ones((1, 2), bool)))
    states, sent = sender.send(sender.start(), 0, [1.0, 2.0], seen=[False, True])
    assert sent[0] is None
    assert sent[1] is not None
    assert states[0] == sender.start()[0]


ACTIONS = ["pass", "drop", "flip", "replace", "replay", "swap", "junk"]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(data=st.data())
def test_trusted_is_what_the_sensor_measured_at_this_step(strong, data):
    """Whatever is done to the messages; and none that had to be authentic changes unnoticed."""
    policy = data.draw(st.sampled_from([([1, 2], [1, 1]), ([2, 3], [1, 2]), ([4, 1], [3, 0])]))
    schedule = Schedule.of(Enforcement.of(*policy, 0))
    sender, receiver = link(strong, schedule)
    sending, receiving, heard = sender.start(), receiver.start(), []
    for k in range(data.draw(st.integers(1, 8))):
        y = [k + 0.25, -k - 0.5]
        sending, sent = sender.send(sending, k, y)
        heard += sent
        actions = data.draw(st.lists(st.sampled_from(ACTIONS), min_size=2, max_size=2))
        open_ = [end.plain(end.start(), encode(9.0))[1] for end in sender.senders]
        given_ = [attacked(data, a, sent, i, heard, open_) for i, a in enumerate(actions)]
        receiving, got = receiver.receive(receiving, k, given_)
        for i, demanded in enumerate(schedule.at(k)):
            if got.trusted[i]:
                assert got.y[i] == y[i]
            if demanded:
                assert got.failed[i] == (given_[i] != sent[i])
                assert got.alarm >= got.failed[i]
                assert got.seen[i] == got.trusted[i] == (not got.failed[i])


def attacked(data, action, sent, i, heard, open_):
    message = sent[i]
    if action == "drop":
        return None
    if action == "flip":
        bit = data.draw(st.integers(0, 8 * len(message) - 1))
        return (int.from_bytes(message, "big") ^ 1 << bit).to_bytes(len(message), "big")
    if action == "replace":
        return open_[i]
    if action == "replay":
        return data.draw(st.sampled_from(heard))
    if action == "swap":
        return sent[1 - i]
    return data.draw(st.binary(max_size=40)) if action == "junk" else message


@pytest.mark.parametrize(("clock", "trusted"), [(COUNTERS, True), (STEPS, False)])
def test_without_a_clock_a_message_can_be_held_back(pair, clock, trusted):
    """The counterexample to counters alone: the sample of step 0, trusted at step 1."""
    sender, receiver = link(pair, Schedule.of(np.ones((2, 1), bool)), clock)
    sending, held = sender.send(sender.start(), 0, [1.0])
    receiving, got = receiver.receive(receiver.start(), 0, [None])
    assert got.alarm
    sender.send(sending, 1, [2.0])
    _, got = receiver.receive(receiving, 1, held)
    assert got.trusted.tolist() == [trusted]
    assert got.alarm == (not trusted)
    assert got.y[0] == (1.0 if trusted else 0.0)


def test_a_receiver_takes_up_synchronisation_messages(pair):
    sender, receiver = link(pair, Schedule.of(np.ones((2, 2), bool)), COUNTERS)
    ahead = tuple(end.start(50_000) for end in sender.senders)
    sync = sender.senders[1].sync(ahead[1])
    if sync is None:
        assert receiver.resync(receiver.start(), 1, b"")[1] is Outcome.MALFORMED
        return
    states, outcome = receiver.resync(receiver.start(), 1, sync)
    assert outcome is Outcome.AUTHENTIC
    assert [state.last for state in states] == [0, 50_000]
    _, sent = sender.send(ahead, 0, [1.0, 2.0])
    assert receiver.receive(states, 0, sent)[1].trusted[1]


def test_links_that_cannot_be(pair):
    sender, receiver = link(pair, ALWAYS)
    with pytest.raises(ValueError, match="ends: found 2, expected 1"):
        replace(sender, senders=sender.senders * 2)
    with pytest.raises(ValueError, match="identities"):
        replace(receiver, verifiers=receiver.verifiers * 2, schedule=Schedule.of([[True, True]]))
    unsafe = SecocVerifier(KeyRing.of(bytes(16)), 1, 8, PROFILE_2)
    with pytest.raises(ValueError, match="expected replays to be noticed"):
        Receiver(ALWAYS, (unsafe,))


def test_a_payload_that_is_no_sample_is_malformed(pair):
    if not hasattr(pair.sender, "profile"):
        return  # a MAVLink payload is restored to its length
    short = [replace(end, payload_bytes=4) for end in pair[:2]]
    _, message = short[0].seal(short[0].start(), bytes(4))
    _, got = Receiver(ALWAYS, (short[1],)).receive((short[1].start(),), 0, [message])
    assert got.outcome.tolist() == [Outcome.MALFORMED]
    assert got.alarm


GOT = Received(
    np.array([1.0, 0.0, np.nan]), np.array([True, False, True]), np.array([True, False, True]),
    np.array([0, 2, 0], np.int32), np.array([False, True, False]), True,
)  # fmt: skip


def test_the_record_for_an_estimator():
    record = observation(GOT, [0.5])
    assert record.u.tolist() == [0.5]
    used = screen(record, jnp.zeros(1))
    assert used.seen.tolist() == used.trusted.tolist() == [True, False, False]
    assert used.y.tolist() == [1.0, 0.0, 0.0]
    # the dropped one is a gap, the NaN that a sensor vouched for a fault
    assert Status(int(used.status)) == Status.MISSING | Status.BAD_INPUT


@pytest.mark.parametrize("alarm", [False, True])
def test_a_failure_raises_the_alarm_by_itself(alarm):
    verdict = Verdict(
        jnp.asarray(1.5), jnp.asarray(2.0), jnp.asarray(alarm),
        jnp.asarray(Reason.RESIDUAL if alarm else Reason.NONE, jnp.int32), jnp.zeros(2, bool),
    )  # fmt: skip
    assert with_failures(verdict, GOT._replace(alarm=False)) is verdict
    found = with_failures(verdict, GOT)
    assert (bool(found.alarm), int(found.reason)) == (True, Reason.FORGED)
    assert (float(found.statistic), float(found.threshold)) == (1.5, 2.0)
    assert found.channel_alarms.shape == (2,)
    assert found.reason.dtype == verdict.reason.dtype
