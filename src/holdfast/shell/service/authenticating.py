"""Messages with tags on a live stream: opened frame by frame, and held to the schedule.

The step of a frame, which its tags are bound to and the schedule is asked for, is the frame's
time over the period, rounded: the same number at both ends if both stamp by the same clock.
"""

from typing import Any

import numpy as np

from holdfast.auth import (
    PROFILE_1,
    STEPS,
    Key,
    KeyRing,
    Receiver,
    Schedule,
    SecocVerifier,
    Sensors,
    with_failures,
)
from holdfast.auth.link import States
from holdfast.auth.samples import PAYLOAD_BYTES
from holdfast.records import Enforcement, Verdict
from holdfast.shell.service.frames import Closed


def receiver_of(names: tuple[str, ...], enforcement: Enforcement | None, secret: bytes,
                missing_is_alarm: bool) -> Receiver:  # fmt: skip
    """The receiving end for these outputs, in order: data ids from 1, SecOC profile 1, one key.

    Without ``enforcement`` no message has to carry a tag, and one that does is trusted. Raises
    `ValueError` for a key without 16 bytes.
    """
    sensors = Sensors.of(names)
    ring = KeyRing((Key(0, secret),))
    verifiers = tuple(
        SecocVerifier(keys=ring, data_id=data_id, payload_bytes=PAYLOAD_BYTES, profile=PROFILE_1)
        for data_id in sensors.data_ids
    )
    never = Enforcement.of([1] * len(names), 0, 1)
    schedule = Schedule.of(never if enforcement is None else enforcement)
    return Receiver(schedule, verifiers, STEPS, missing_is_alarm)


class Authentication:
    """The state of the receiving end of one stream."""

    def __init__(self, receiver: Receiver, names: tuple[str, ...], dt: float):
        self._receiver, self._names, self._dt = receiver, names, dt
        self._states: States = receiver.start()
        self._last: Any = None

    def open(self, closed: Closed) -> tuple[dict[str, float], set[str], list[str]]:
        """The values of a frame with those that were in messages, who is trusted, who failed.

        A bare value of an output that must be authenticated now is dropped.
        """
        frame = closed.frame
        step = round(closed.time / self._dt)
        messages = [frame.secured.get(name) for name in self._names]
        self._states, received = self._receiver.receive(self._states, step, messages)
        demanded = self._receiver.schedule.at(step)
        values, trusted = dict(frame.values), set(frame.trusted)
        for i, name in enumerate(self._names):
            if received.seen[i]:
                values[f"y:{name}"] = float(received.y[i])
            elif demanded[i] or messages[i] is not None:
                values.pop(f"y:{name}", None)
            if received.trusted[i]:
                trusted.add(name)
            elif messages[i] is not None:
                trusted.discard(name)
        self._last = received
        return values, trusted, [self._names[i] for i in np.flatnonzero(received.failed)]

    def judged(self, verdict: Verdict) -> Verdict:
        """The verdict on the frame opened last, with an alarm if a message failed."""
        return with_failures(verdict, self._last)

    def held(self) -> list[int]:
        """What a checkpoint keeps: the newest freshness value accepted of each output."""
        return [state.last for state in self._states]

    def restore(self, held: list[int]) -> None:
        """Go on from a checkpoint: a tag that was accepted before it is not accepted again."""
        states = zip(self._receiver.verifiers, held, strict=True)
        self._states = tuple(verifier.start(int(last)) for verifier, last in states)
