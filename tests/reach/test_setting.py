"""Which outputs can be altered, and which step's constraint counts, against counting steps."""

import numpy as np
import pytest

from attackers import asked, authenticated, drawn, horizon, together
from holdfast.parts import InvalidValue
from holdfast.plants.library import bicycle, dcacc
from holdfast.plants.watched import watched
from holdfast.records import Enforcement
from systems import quiet_plant

SYSTEM = drawn(0, 2, 3)
POLICIES = {
    "together": together(3, 4),
    "blocks": together(3, 5, 2),
    "from the start": together(3, 5, 2, 1),
    "late": together(3, 4, 1, 11),
    "staggered": Enforcement.of([6, 6, 6], 1, [2, 4, 6]),
    "each its own": Enforcement.of([3, 4, 5], [1, 2, 1], [3, 2, 7]),
    "one never": Enforcement.of([4, 4, 4], [1, 0, 1], [4, 1, 2]),
    "one always": Enforcement.of([4, 1, 4], [1, 1, 1], [4, 1, 2]),
    "one always in the end": Enforcement.of([4, 2, 4], [1, 3, 1], [4, 9, 2]),
    "always": together(3, 1),
}


@pytest.mark.parametrize("name", POLICIES)
@pytest.mark.parametrize("hit", [(True, True, True), (False, True, True), (False, False, False)])
def test_a_policy_step_by_step(name, hit):
    setting = asked(SYSTEM, "chi_square", POLICIES[name], hit)
    free = np.array([setting.compromised & ~authenticated(setting, k) for k in range(1, 31)])
    np.testing.assert_array_equal(setting.alterable(30), free)
    np.testing.assert_array_equal(setting.alterable(7, 13), free[13:20])
    np.testing.assert_array_equal(setting.horizons(20), [horizon(setting, k) for k in range(1, 21)])


@pytest.mark.parametrize("name", POLICIES)
def test_the_policy_is_periodic_from_some_step_on(name):
    setting = asked(SYSTEM, "chi_square", POLICIES[name], (True, False, True))
    after, period = setting.after, setting.period
    once = setting.alterable(period, after)
    np.testing.assert_array_equal(setting.alterable(period, after + period), once)
    np.testing.assert_array_equal(setting.alterable(period, after + 5 * period), once)


def test_a_table_ends():
    table = np.zeros((7, 3), bool)
    table[[1, 2, 5], 0] = table[[3], 2] = True
    setting = asked(SYSTEM, "chi_square", enforced=table, compromised=(True, True, False))
    np.testing.assert_array_equal(~setting.alterable(9)[:, 0], [*table[:, 0], False, False])
    assert np.all(setting.alterable(9)[:, 1])
    assert not np.any(setting.alterable(9)[:, 2])
    np.testing.assert_array_equal(setting.horizons(9), [3, 3, 3, 6, 6, 6, 7, 8, 9])


def test_without_a_policy_and_all_at_once():
    assert list(asked(SYSTEM, "sprt").horizons(4)) == [1, 2, 3, 4]
    assert list(asked(SYSTEM, "sprt", together(3, 4, 2, 3)).horizons(6)) == [4, 4, 4, 4, 8, 8]


@pytest.mark.parametrize(
    ("enforcement", "hit", "blocks"),
    [
        (None, (True, True, True), 1),
        (together(3, 5, 2), (True, True, True), 2),
        (Enforcement.of([6, 6, 6], [1, 3, 2], 6), (True, False, True), 2),
        (together(3, 5, 2), (False, False, False), 1),
    ],
)
def test_who_does_not_know_the_policy_is_ready_for_a_block(enforcement, hit, blocks):
    setting = asked(SYSTEM, "chi_square", enforcement, hit, aware=False)
    assert setting.blocks == blocks
    known = setting._replace(aware=True)
    np.testing.assert_array_equal(setting.horizons(9), known.horizons(9) + blocks)


def test_a_plant_under_its_filter():
    plant = dcacc.build()
    A, C, K, Q, P, *names = watched(plant)
    ahead = A @ P @ A.T + plant.Q
    np.testing.assert_allclose(Q, C @ ahead @ C.T + plant.R, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(K @ Q, ahead @ C.T, rtol=1e-9, atol=1e-15)
    # of the error after the measurement, (I - K C) Sigma, not Sigma as in (13) and (53)
    np.testing.assert_allclose(P, ahead - K @ C @ ahead, rtol=1e-9, atol=1e-15)
    assert names == [plant.states, plant.outputs]


def test_a_plant_without_such_a_filter():
    with pytest.raises(InvalidValue, match="constant matrices"):
        watched(bicycle.build())
    with pytest.raises(InvalidValue, match="steady-state"):
        watched(quiet_plant(A=[[2.0]], C=[[0.0]], Q=[[1.0]], R=[[1.0]]))
