import numpy as np
import pytest

from holdfast.auth import Schedule
from holdfast.auth.odds import bits_needed, forgery, odds, over_lifetime
from holdfast.records import Enforcement


def test_one_guess():
    assert forgery(24) == 2.0**-24
    assert forgery(48) == 2.0**-48
    assert forgery(128) == pytest.approx(2.0**-128, rel=1e-12)  # 1 - 2^-128 rounds to 1
    assert forgery(8, attempts=3) == pytest.approx(1 - (255 / 256) ** 3, rel=1e-12)
    assert forgery(24, attempts=5) == pytest.approx(5 * 2.0**-24, rel=1e-6)
    assert forgery(0) == 1.0


def test_many_guesses():
    found = odds(8, 1000)
    assert found.expected == 1000 / 256
    assert found.any == pytest.approx(1 - (255 / 256) ** 1000, rel=1e-12)
    assert odds(24, 3).unnoticed == 2.0**-72
    assert odds(24, 0) == (0, 2.0**-24, 0.0, 0.0, 1.0)
    assert odds(0, 5) == (5, 1.0, 5.0, 1.0, 1.0)


def test_a_policy_over_its_lifetime():
    """One tag in ten, two sensors, a day at 100 Hz: the attacker has 864 000 each."""
    schedule = Schedule.of(Enforcement.of([10, 10], [1, 1], [0, 5]))
    found = over_lifetime(schedule, 8_640_00, 24)
    assert found.tries == 172_800
    assert found.expected == pytest.approx(172_800 * 2.0**-24)
    assert over_lifetime(schedule, 8_640_00, 24, sensor=1).tries == 86_400


@pytest.mark.parametrize(("tries", "risk"), [(1, 1e-3), (1000, 1e-6), (10**9, 0.5)])
@pytest.mark.parametrize("attempts", [1, 2])
def test_the_shortest_tag_for_a_risk(tries, risk, attempts):
    bits = bits_needed(tries, risk, attempts)
    assert odds(bits, tries, attempts).any <= risk
    # the bound by the sum is met within two bits
    assert bits < 3 or odds(bits - 2, tries, attempts).any > risk


def test_nist_example():
    """SP 800-38B, Appendix A.2: 2^10 failures tolerated, a risk of 2^-20: 30 bits."""
    assert bits_needed(2**10, 2.0**-20) == 30
    for risk in (0.0, 1.0, np.nan):
        with pytest.raises(ValueError, match="risk: found"):
            bits_needed(10, risk)
