"""Messages with tags on a live stream, and a man in the middle who alters them."""

import json

import numpy as np
import pytest

from holdfast.auth import (
    PROFILE_1,
    Key,
    KeyRing,
    Schedule,
    SecocSender,
    Sensors,
    Transmitter,
)
from holdfast.auth.samples import PAYLOAD_BYTES
from holdfast.records import Enforcement
from holdfast.shell.service.authenticating import Authentication, receiver_of
from holdfast.shell.service.records import Samples
from live_engines import DT, OUTPUTS, engine, played, states_of, stream, trace_of

SECRET = bytes(range(16))
EVERY_THIRD = Enforcement.of([3] * 5, 1, 3)


def authentication(enforcement=EVERY_THIRD, missing_is_alarm=True):
    receiver = receiver_of(OUTPUTS, enforcement, SECRET, missing_is_alarm)
    return Authentication(receiver, OUTPUTS, DT)


def sealed(trace, enforcement=EVERY_THIRD, key=SECRET):
    """The trace's rows as messages, those that must be with a tag."""
    senders = tuple(
        SecocSender(keys=KeyRing((Key(0, key),)), data_id=data_id, payload_bytes=PAYLOAD_BYTES,
                    profile=PROFILE_1)
        for data_id in Sensors.of(OUTPUTS).data_ids
    )  # fmt: skip
    sender = Transmitter(Schedule.of(enforcement), senders)
    states, found = sender.start(), []
    y = np.asarray(trace.observation.y)
    for k, samples in enumerate(stream(trace), 1):
        states, messages = sender.send(states, k, y[k - 1])
        secured = {n: m for n, m in zip(OUTPUTS, messages, strict=True) if m is not None}
        u = {"u:accel": samples.values["u:accel"]}
        found.append(Samples(samples.time, u, secured=secured, whole=True))
    return found


def altered(samples, sensor, by):
    """What a man in the middle hands on: the payload shifted, the tag as it was."""
    message = samples.secured[sensor]
    value = np.frombuffer(message[:8], ">f8")[0] + by
    forged = np.array(value, ">f8").tobytes() + message[8:]
    return samples._replace(secured={**samples.secured, sensor: forged})


def test_authentic_messages_are_the_samples_and_trusted():
    trace = trace_of(60)
    rows, events = played(engine(authentication=authentication(), active=False), sealed(trace))
    plain, _ = played(engine(active=False), stream(trace))
    for mine, theirs in zip(rows, plain, strict=True):
        np.testing.assert_array_equal(mine.estimate.x, theirs.estimate.x)
    assert not [one for one in events if one.kind == "alarm" and "authenticated" in one.reason]


@pytest.mark.parametrize("attack", ["alter", "replay", "strip", "other key"])
def test_a_man_in_the_middle_is_noticed_in_the_row_he_acts_in(attack):
    """And what he sent in a row that must be authentic is not fused."""
    trace = trace_of(60)
    messages = sealed(trace)
    at = 29  # row 30 must carry tags
    if attack == "alter":
        messages[at] = altered(messages[at], "gps", 9.0)
    elif attack == "replay":
        old = messages[at - 3].secured["gps"]
        messages[at] = messages[at]._replace(secured={**messages[at].secured, "gps": old})
    elif attack == "other key":
        messages[at] = sealed(trace, key=bytes(16))[at]
    else:
        rest = {n: m for n, m in messages[at].secured.items() if n != "gps"}
        values = {**messages[at].values, "y:gps": 99.0}
        messages[at] = messages[at]._replace(values=values, secured=rest)
    rows, events = played(engine(authentication=authentication(), active=False), messages)
    (forged,) = [one for one in events if one.kind == "alarm" and "authenticated" in one.reason
                 and one.state == "begin"]  # fmt: skip
    assert forged.frame == 30
    assert "gps" in forged.subject
    assert rows[29].verdict.alarm
    assert rows[29].measured[0] is None


def test_between_two_checks_he_moves_the_estimate_no_further_than_without_detection():
    """He alters the rows that need no tag; at every third the truth comes through."""
    trace = trace_of(300, 4)
    messages = sealed(trace)
    lied = [
        altered(samples, "gps", 1.0) if (k + 1) % 3 else samples
        for k, samples in enumerate(messages)
    ]
    found = engine(authentication=authentication(), active=False)
    attacked, _ = played(found, lied)
    calm, _ = played(engine(active=False), stream(trace))
    unchecked = [
        s._replace(values={**s.values, "y:gps": s.values["y:gps"] + 1.0}) for s in stream(trace)
    ]
    free, _ = played(engine(active=False), unchecked)
    moved = np.abs(states_of(attacked) - states_of(calm))[-100:, 0].max()
    free_moved = np.abs(states_of(free) - states_of(calm))[-100:, 0].max()
    assert moved < 0.8 * free_moved


def test_a_restart_accepts_no_tag_twice():
    trace = trace_of(40)
    messages = sealed(trace)
    first = engine(authentication=authentication(), active=False)
    for samples in messages[:30]:
        first.take(samples, 0.0)
    words, arrays = first.held()
    second = engine(authentication=authentication(), active=False)
    second.restore(json.loads(json.dumps(words)), arrays)
    old = messages[29].secured
    messages[32] = messages[32]._replace(secured=old)  # row 33 must carry tags
    _, events = played(second, messages[30:])
    (forged,) = [one for one in events if one.state == "begin" and one.kind == "alarm"
                 and "authenticated" in one.reason]  # fmt: skip
    assert forged.frame == 33
