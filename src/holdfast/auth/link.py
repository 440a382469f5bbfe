"""A policy put into force: samples to messages at one end, messages to trusted samples at the
other.

    demanded, authentic          seen, trusted
    demanded, anything else      dropped, alarm
    not demanded, unsigned       seen, not trusted
    not demanded, authentic      seen, trusted
    not demanded, wrong tag      dropped, alarm
    not demanded, nothing came   a gap
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from holdfast.auth.samples import decode, encode
from holdfast.auth.schedule import Schedule
from holdfast.auth.scheme import Opened, Outcome, Sender, Verifier
from holdfast.records import Observation, Reason, Verdict

States = tuple[Any, ...]
"""One state for each sensor."""


class Clock(NamedTuple):
    """Step k in the units of the freshness value: first + k * per_step, the same at both ends.

    For MAVLink: the timestamp of step 0, and 100 000 times the step's length in seconds.
    """

    first: int
    per_step: int

    def at(self, k: int) -> int:
        """The time of step ``k``."""
        return self.first + k * self.per_step


STEPS = Clock(1, 1)
"""The step number is the clock, as SecOC's freshness values can take it."""
COUNTERS = Clock(0, 0)
"""No clock: freshness values only count. Then a message that was held back is still fresh, and
passes as the sample of a later step if the one it stands in for is dropped.
"""


class Received(NamedTuple):
    """What a step's messages came to, sensor by sensor.

    ``y`` is 0 where not ``seen``. ``failed``: a message was not what the schedule demands, or
    carried a wrong tag; ``alarm``: any has failed. ``outcome`` holds the codes of `Outcome`.
    """

    y: Float[np.ndarray, " ny"]
    seen: Bool[np.ndarray, " ny"]
    trusted: Bool[np.ndarray, " ny"]
    outcome: Int[np.ndarray, " ny"]
    failed: Bool[np.ndarray, " ny"]
    alarm: bool


def _check(schedule: Schedule, ends: Sequence[Sender] | Sequence[Verifier]) -> None:
    if schedule.sensors != len(ends):
        raise ValueError(f"ends: found {len(ends)}, expected {schedule.sensors} as in the schedule")
    names = [end.identity for end in ends]
    if len(set(names)) < len(names):
        raise ValueError(f"identities: found {names}, expected each once: messages of two sensors "
                         "with the same one could be exchanged")  # fmt: skip


@dataclass(frozen=True)
class Transmitter:
    """The end with the sensors: tags what the schedule demands, and nothing else.

    Raises `ValueError` if schedule and senders differ in number, or two share an identity.
    """

    schedule: Schedule
    senders: tuple[Sender, ...]
    clock: Clock = STEPS

    def __post_init__(self):
        _check(self.schedule, self.senders)

    def start(self) -> States:
        """The states of senders that have sent nothing."""
        return tuple(sender.start() for sender in self.senders)

    def send(
        self, states: States, k: int, y: Sequence[float] | np.ndarray, seen: Any = None
    ) -> tuple[States, list[bytes | None]]:
        """The messages of step ``k``, one for each sensor; None where there is no sample.

        Raises `OverflowError` when a sender runs out of freshness values.
        """
        now, demanded = self.clock.at(k), self.schedule.at(k)
        after = list(states)
        messages: list[bytes | None] = [None] * len(states)
        for i, sender in enumerate(self.senders):
            if seen is not None and not seen[i]:
                continue
            payload = encode(y[i])
            if demanded[i]:
                after[i], messages[i] = sender.seal(states[i], payload, now)
            else:
                after[i], messages[i] = sender.plain(states[i], payload)
        return tuple(after), messages


@dataclass(frozen=True)
class Receiver:
    """The end with the estimator: opens messages and holds them to the schedule.

    ``missing_is_alarm``: whether a demanded message that did not arrive has failed. True is
    the safe reading, because an attacker may drop what he cannot forge. Where a link loses
    messages by itself, that is an alarm for every loss; False then makes it a gap, and leaves
    a jammed sensor to whoever watches gaps. The sample is lost to the estimator either way.

    Raises `ValueError` as `Transmitter`, and for a scheme without freshness: a replayed sample
    would be trusted.
    """

    schedule: Schedule
    verifiers: tuple[Verifier, ...]
    clock: Clock = STEPS
    missing_is_alarm: bool = True

    def __post_init__(self):
        _check(self.schedule, self.verifiers)
        if not all(verifier.fresh for verifier in self.verifiers):
            raise ValueError("verifiers: found one without freshness values, expected replays "
                             "to be noticed")  # fmt: skip

    def start(self) -> States:
        """The states of verifiers that have accepted nothing."""
        return tuple(verifier.start() for verifier in self.verifiers)

    def receive(
        self, states: States, k: int, messages: Sequence[bytes | None]
    ) -> tuple[States, Received]:
        """What the messages of step ``k`` come to, one for each sensor; None: nothing came."""
        now, demanded = self.clock.at(k), self.schedule.at(k)
        after = list(states)
        y, seen, trusted, outcomes, failed = [], [], [], [], []
        for i, verifier in enumerate(self.verifiers):
            message = messages[i]
            if message is None:
                value, outcome = None, Outcome.MISSING
            else:
                after[i], opened = verifier.open(states[i], message, now)
                value, outcome = _read(opened)
            authentic = outcome is Outcome.AUTHENTIC
            used = authentic or (outcome is Outcome.UNSIGNED and not demanded[i])
            gap = outcome is Outcome.MISSING and not (demanded[i] and self.missing_is_alarm)
            y.append(value if used else 0.0)
            seen.append(used)
            trusted.append(authentic)
            outcomes.append(int(outcome))
            failed.append(not (used or gap))
        return tuple(after), Received(
            np.array(y, float), np.array(seen, bool), np.array(trusted, bool),
            np.array(outcomes, np.int32), np.array(failed, bool), any(failed),
        )  # fmt: skip

    def resync(self, states: States, sensor: int, message: bytes) -> tuple[States, Outcome]:
        """Take up a synchronisation message of one sensor."""
        state, outcome = self.verifiers[sensor].resync(states[sensor], message)
        return (*states[:sensor], state, *states[sensor + 1 :]), outcome


def _read(opened: Opened) -> tuple[float | None, Outcome]:
    """The sample; a payload that is none makes the message malformed."""
    value = None if opened.payload is None else decode(opened.payload)
    if value is None and opened.outcome in (Outcome.AUTHENTIC, Outcome.UNSIGNED):
        return None, Outcome.MALFORMED
    return value, opened.outcome


def observation(received: Received, u: Any) -> Observation:
    """The step's record for an estimator, with the input ``u``."""
    return Observation.of(u, received.y, received.seen, received.trusted)


def with_failures(verdict: Verdict, received: Received) -> Verdict:
    """The detector's verdict, with an alarm for the reason FORGED if a message failed.

    A broken tag is evidence and not statistics, so it takes the place of the detector's
    reason; ``statistic``, ``threshold`` and the channels stay the detector's.
    """
    if not received.alarm:
        return verdict
    # arrays of no dimension, also where a live step gives plain numbers
    statistic, threshold, alarm, reason = (
        np.asarray(value)
        for value in (verdict.statistic, verdict.threshold, verdict.alarm, verdict.reason)
    )
    found: Any = (
        statistic,
        threshold,
        np.ones_like(alarm),
        np.full_like(reason, int(Reason.FORGED)),
        verdict.channel_alarms,
    )
    return Verdict(*found)
