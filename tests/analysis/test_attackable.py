"""Who can move the Kalman filter unseen, and which policies prevent it."""

import numpy as np
import pytest

from analysis.models import model
from holdfast.analysis.attackable import (
    LONGEST_PERIOD,
    attackable,
    sensor_wise,
    smallest,
)
from holdfast.analysis.attackable_advice import on_attackable
from holdfast.analysis.observability import observability
from holdfast.numerics.attackable import growth
from holdfast.numerics.steady_state import steady_state
from holdfast.records import Enforcement

DOUBLE = np.array([[1.0, 0.1], [0.0, 1.0]])
QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])
FIRST = np.array([[1.0, 0.0]])


def looked_at(A, C, **noise):
    found = model(A, np.zeros((len(A), 0)), C, **noise)
    return found, steady_state(found.A, found.C, found.Q, found.R)


def asked(A, C, compromised=None, **noise):
    found, steady = looked_at(A, C, **noise)
    return attackable(found, steady, observability(found), compromised)


def said(A, C, compromised=None, **noise):
    n = len(A)
    names = [f"x{i + 1}" for i in range(n)]
    return on_attackable(asked(A, C, compromised, **noise), names)


def policy(every, duration, first):
    return Enforcement.of(every, duration, first)


def test_a_cart_is_moved_through_its_position():
    found = asked(DOUBLE, np.eye(2), (1,))
    assert [case.attackable for case in found.each] == [True, False]
    assert (found.all.attackable, found.all.names) == (True, ("y1", "y2"))
    assert (found.given.names, found.given.attackable, found.given.radius) == (("y2",), False, 0.0)
    ((z, count, directions),) = found.each[0].modes
    assert (z, count) == (1.0, 1)
    np.testing.assert_array_equal(directions, [[1.0], [0.0]])
    assert (found.theorem_4, found.all.corollary_2, found.given.corollary_2) == (1, 1, 0)
    assert found.shields == ("y1",)
    assert found.reason is None


def test_corollary_2_as_printed_counts_too_few_modes():
    """Numerical eigenvectors are e1 and e2: sensor 0 sees both, and so f would be 0."""
    A, C = 1.1 * np.eye(2), np.array([[1.0, 1.0], [1.0, 0.0]])
    vectors = np.linalg.eig(A)[1]
    assert np.all(C[0] @ vectors != 0)
    found = asked(A, C, (1,))
    assert (found.given.attackable, found.given.corollary_2) == (True, 1)


def test_the_smallest_number_of_steps_depends_on_the_period():
    """Theorem 4's f = 2 is needed for every even L, and for no odd one."""
    found, steady = looked_at(QUARTER, FIRST)
    assert [smallest(found, steady, every) for every in (1, 2, 3, 4, 5, 8)] == [1, 2, 1, 2, 1, 2]
    result = asked(QUARTER, FIRST)
    assert result.theorem_4 == 2
    assert (result.duration.usual, set(result.duration.others)) == (2, set(range(3, 101, 2)))
    # a cart whose position is measured: f = 2 by Theorem 4, and 1 is enough for any L
    result = asked(DOUBLE, FIRST)
    assert (result.theorem_4, result.duration) == (2, (1, {}))
    assert smallest(*looked_at(0.5 * DOUBLE, FIRST), 4) == 0


def test_f_of_theorem_4_is_always_enough():
    rng = np.random.default_rng(1)
    needed = 0
    for _ in range(15):
        n, ny = rng.integers(2, 5), rng.integers(1, 3)
        A = rng.integers(-1, 2, (n, n)) * rng.choice([0.9, 1.0, 1.1])
        C = rng.integers(-1, 2, (ny, n)) * (rng.random((ny, n)) < 0.6)
        found, steady = looked_at(A, C)
        if steady.K is None:
            continue
        which = tuple(np.flatnonzero(rng.random(ny) < 0.7).tolist())
        result = attackable(found, steady, observability(found), which)
        for every in (2, 3, 4, 6, 12):
            exact = smallest(found, steady, every, which)
            all_of_them = smallest(found, steady, every)
            assert exact <= all_of_them <= result.theorem_4
            assert exact <= result.given.corollary_2 <= result.theorem_4
            needed += all_of_them == result.theorem_4 > 0
        assert result.each[0].attackable <= result.all.attackable
    assert needed


def test_sensors_in_turn_are_enough_for_one_unstable_mode():
    """The end of Section IV, where it is stated: f_i = 1, one step after another."""
    rng = np.random.default_rng(2)
    for _ in range(10):
        T = rng.normal(size=(3, 3))
        A = T @ np.diag([1.1, 0.5, -0.3]) @ np.linalg.inv(T)
        found, steady = looked_at(A, rng.normal(size=(2, 3)))
        assert sensor_wise(found, steady, policy([7, 7], [1, 1], [7, 8])).bounded
        assert not sensor_wise(found, steady, policy([7, 7], [0, 0], [7, 8])).bounded


def test_sensors_in_turn_are_not_enough_for_two():
    """It "can be generalized" only with more steps: what one sees, A^L shows again."""
    found, steady = looked_at(QUARTER, FIRST)
    result = sensor_wise(found, steady, policy([4], [1], [4]))
    assert (result.bounded, result.period) == (False, 4)
    assert result.radius == pytest.approx(1.0, rel=1e-12)
    # before step k = 4 m only what moves to x1 is shown: x2
    np.testing.assert_allclose(np.abs(result.subspace), [[1.0], [0.0]], atol=1e-12)
    assert sensor_wise(found, steady, policy([4], [2], [4])).bounded
    assert sensor_wise(found, steady, policy([5], [1], [4])).bounded
    # a second sensor one step later repeats the first: two axes, one quarter turn apart
    found, steady = looked_at(QUARTER, np.eye(2))
    assert not sensor_wise(found, steady, policy([4, 4], [1, 1], [4, 5])).bounded
    assert sensor_wise(found, steady, policy([4, 4], [1, 1], [4, 4])).bounded


def test_a_policy_is_read_as_the_run_reads_it():
    rng = np.random.default_rng(3)
    for _ in range(20):
        A, C = DOUBLE if rng.random() < 0.5 else QUARTER, rng.integers(0, 2, (2, 2))
        found, steady = looked_at(A, C)
        if steady.K is None:
            continue
        rule = policy(rng.integers(1, 5, 2), rng.integers(0, 3, 2), rng.integers(1, 9, 2))
        result = sensor_wise(found, steady, rule, (0, 1))
        # 240 steps are whole periods, and past every first step
        at = np.asarray(rule.at(np.arange(240, 240 + result.period, dtype=np.int32)))
        whole = growth(found.A, found.C, steady.K, ~at)
        assert (result.bounded, result.radius) == (not whole.unbounded, whole.radius)


def test_long_periods():
    found, steady = looked_at(DOUBLE, np.eye(2))
    primes = policy([9973, 9967], [1, 1], [1, 1])
    result = sensor_wise(found, steady, primes)
    assert result.period == 9973 * 9967 > LONGEST_PERIOD
    assert result.bounded is None
    assert "99400891 steps, over 10000" in result.reason
    # the position is never authenticated: that is enough, however long the period
    never = policy([99991, 9967], [0, 1], [1, 1])
    assert sensor_wise(found, steady, never).bounded is False
    assert sensor_wise(found, steady, primes, (1,)).bounded is True
    # those who do not know the steps are never unbounded
    assert sensor_wise(found, steady, primes, aware=False).bounded is True
    assert sensor_wise(found, steady, policy([9973, 1], [1, 0], [1, 1])).bounded is True


def test_no_gain_no_answer():
    """The position is not measured."""
    C = np.array([[0.0, 1.0]])
    found = asked(DOUBLE, C, (0,))
    assert (found.all.attackable, found.given.attackable, found.theorem_4) == (None, None, None)
    assert "do not see the unstable mode 1" in found.reason
    found, steady = looked_at(DOUBLE, C)
    assert smallest(found, steady, 4) is None
    assert sensor_wise(found, steady, policy([4], [1], [4])).bounded is None
    (sentence,) = said(DOUBLE, C)
    assert sentence.startswith("What a stealthy attacker can do to the filter cannot be said")


UNAWARE = (
    "An attacker who does not know which steps are authenticated cannot do it even so: any step "
    "could expose him."
)


def test_sentences():
    assert said(DOUBLE, np.eye(2), (0,)) == [
        'A stealthy attacker who alters "y1" can move the estimate along x1 without limit '
        "(mode 1).",
        'Authenticating "y1" for 1 step in every L bounds this, for any L up to 100.',
        UNAWARE,
    ]
    assert said(DOUBLE, np.eye(2), (1,)) == [
        'A stealthy attacker who alters "y2" can move the estimate by a bounded amount only: the '
        "other sensors show every unstable mode."
    ]
    assert said(DOUBLE, np.vstack([np.eye(2), np.eye(2)])) == [
        "No single sensor, altered, lets the estimate be moved without limit.",
        "A stealthy attacker who alters all sensors can move the estimate along x1 and x2 without "
        "limit (mode 1).",
        "Authenticating all sensors for 1 step in every L bounds this, for any L up to 100.",
        'Authenticating "y1" or "y3" alone, always, bounds it as well.',
        UNAWARE,
    ]
    assert said(0.5 * DOUBLE, np.eye(2)) == [
        "No stealthy attacker can move the estimate without limit, whichever sensors he alters: "
        "the plant has no unstable mode."
    ]
    moves, enough, _ = said(QUARTER, FIRST)
    assert "along x1 and x2 without limit (mode 0 +- 1i)" in moves
    assert enough == (
        "Authenticating all sensors for 2 steps in a row in every L bounds this; for L = 3, 5, 7 "
        "or 46 more 1 step will do."
    )


def test_many_sensors_and_many_states_in_few_words():
    sentences = said(np.kron(np.eye(5), DOUBLE), np.kron(np.eye(5), FIRST))
    assert sentences[3] == "The like holds of 2 more sensors altered alone."
    assert len(sentences) == 7
    T = np.linalg.qr(np.random.default_rng(4).normal(size=(8, 8)))[0]
    A = T @ np.diag([1.0, *np.full(7, 0.5)]) @ T.T
    (sentence, *_) = said(A, np.eye(8), tuple(range(8)))
    assert "along 1 direction of the state without limit (mode 1)" in sentence
