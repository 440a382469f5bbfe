"""Message authentication: tags, freshness and schedules. Bytes in, verdict out.

Needs the extra ``auth`` (the package `cryptography`). Nothing here reads a clock, a file or a
source of chance: time is an argument, and keys come from the caller.
"""

from holdfast.auth.keys import Key, KeyRing
from holdfast.auth.link import (
    COUNTERS,
    STEPS,
    Clock,
    Received,
    Receiver,
    Transmitter,
    observation,
    with_failures,
)
from holdfast.auth.mavlink import MavlinkSender, MavlinkVerifier
from holdfast.auth.samples import Sensors
from holdfast.auth.schedule import Schedule
from holdfast.auth.scheme import Opened, Outcome, Sender, Verifier
from holdfast.auth.secoc import (
    PROFILE_1,
    PROFILE_2,
    PROFILE_3,
    Profile,
    SecocSender,
    SecocVerifier,
)

__all__ = [
    "COUNTERS",
    "PROFILE_1",
    "PROFILE_2",
    "PROFILE_3",
    "STEPS",
    "Clock",
    "Key",
    "KeyRing",
    "MavlinkSender",
    "MavlinkVerifier",
    "Opened",
    "Outcome",
    "Profile",
    "Received",
    "Receiver",
    "Schedule",
    "SecocSender",
    "SecocVerifier",
    "Sender",
    "Sensors",
    "Transmitter",
    "Verifier",
    "observation",
    "with_failures",
]
