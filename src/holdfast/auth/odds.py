"""What guessing a tag is worth.

A tag of b bits that is guessed is right with probability 2^-b: 5.96e-8 for the 24 bits of SecOC
profile 1, 3.6e-15 for the 48 bits of MAVLink 2. A key that is not known leaves nothing better
than a guess, as long as the code behaves as a random function. Tampering costs the attacker an
alarm for every wrong guess, so two questions differ: how many guesses pass among many, and how
likely a whole series passes without an alarm.

Source: NIST SP 800-38B, Appendix A.2.
"""

import math
from typing import NamedTuple

from holdfast.auth.schedule import Schedule


class Odds(NamedTuple):
    """``tries`` messages that had to be authentic, all guessed: ``each`` passes with this
    probability, ``expected`` of them pass, at least one does with probability ``any``, and
    all of them, without an alarm, with probability ``unnoticed``.
    """

    tries: int
    each: float
    expected: float
    any: float
    unnoticed: float


def forgery(bits: int, attempts: int = 1) -> float:
    """Probability that one guessed tag of ``bits`` bits passes a verifier that tries
    ``attempts`` freshness values: 1 - (1 - 2^-bits)^attempts, at most attempts 2^-bits.
    """
    if bits < 1:  # no tag at all
        return 1.0
    if attempts == 1:
        return 2.0**-bits
    return -math.expm1(attempts * math.log1p(-(2.0**-bits)))


def odds(bits: int, tries: int, attempts: int = 1) -> Odds:
    """What ``tries`` independent guesses come to."""
    each = forgery(bits, attempts)
    some = 1.0 if each == 1.0 and tries else -math.expm1(tries * math.log1p(-each))
    return Odds(tries, each, tries * each, some, each**tries)


def over_lifetime(
    schedule: Schedule, steps: int, bits: int, attempts: int = 1, sensor: int | None = None
) -> Odds:
    """An attacker who guesses every message that a policy wants authentic, of all sensors or of
    one, in the steps 0..steps-1.
    """
    tags = schedule.tags(0, steps)
    return odds(bits, int(tags.sum() if sensor is None else tags[sensor]), attempts)


def bits_needed(tries: int, risk: float, attempts: int = 1) -> int:
    """The shortest tag with which ``tries`` guesses pass at least once with probability at most
    ``risk``: b >= log2(tries attempts / risk).

    Raises `ValueError` for a risk that is not between 0 and 1.

    Source: NIST SP 800-38B, Appendix A.2.
    """
    if not 0 < risk < 1:
        raise ValueError(f"risk: found {risk}, expected a probability between 0 and 1")
    return max(1, math.ceil(math.log2(max(tries, 1)) + math.log2(attempts) - math.log2(risk)))
