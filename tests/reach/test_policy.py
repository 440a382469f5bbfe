"""The search for the rarest policy, against all policies of its kind one by one."""

import itertools
import math

import numpy as np
import pytest

from attackers import asked, filtered, largest, together, vehicle
from holdfast.parts import InvalidValue
from holdfast.reach.bounds import reach
from holdfast.reach.policy import policy, trade_off
from holdfast.reach.search import greatest
from holdfast.records import Enforcement

VEHICLE = vehicle()
TURNING = filtered([[0.0, 1.0], [-1.0, 0.0]], [[1.0, 0.0]], 0.1 * np.eye(2), [[1.0]])
"""A quarter of a turn a step: every second sample says the same again."""
STEPS = 12


def under(setting, enforcement, steps):
    """The largest error, by the bounds of every step on its own."""
    return float(np.max(reach(setting._replace(enforcement=enforcement), steps).norm))


def plain(found):
    """every, for and first of a policy for all outputs together."""
    held = found.enforcement
    fields = [np.asarray(v) for v in (held.every, held.duration, held.first)]
    assert all(np.all(v == v[0]) for v in fields)
    return tuple(int(v[0]) for v in fields)


# --- the sum constraint: every distance is tried, and none that does is longer -------------------


@pytest.mark.slow
@pytest.mark.parametrize("steps", [90, pytest.param(300, marks=pytest.mark.slow)])
def test_sums_over_a_horizon(steps):
    setting = asked(VEHICLE, "sprt")
    reached = np.array([under(setting, together(2, L), steps) for L in range(1, 401)])
    found = policy(setting, 0.7, steps)
    every = int(np.flatnonzero(reached <= 0.7)[-1]) + 1
    assert plain(found) == (every, 1, every)
    assert (found.proof, found.steps, found.limit) == ("horizon", steps, 0.7)
    assert found.worst == pytest.approx(reached[every - 1], rel=1e-12)
    assert (found.share, found.cost) == (1 / every, 2 / every)


def test_the_paper_s_limit():
    """Once in 30 holds over three blocks and not over ten, once in 35 not even over three."""
    setting = asked(VEHICLE, "sprt")
    worst = [
        under(setting, together(2, L), blocks * L) for L, blocks in ((20, 3), (30, 3), (35, 3))
    ]
    np.testing.assert_allclose(worst, [0.609, 0.683, 0.716], atol=5e-4)
    assert under(setting, together(2, 30), 300) == pytest.approx(0.816, abs=5e-4)


def test_sums_for_ever_have_no_limit():
    with pytest.raises(InvalidValue, match="steps: found none with the detector sprt"):
        policy(asked(VEHICLE, "sprt"), 0.7)


# --- each residual bounded ------------------------------------------------------------------------


@pytest.mark.slow
def test_for_ever():
    setting = asked(VEHICLE, "chi_square")
    found = policy(setting, 0.7)
    assert plain(found) == (3, 1, 3)
    assert (found.proof, found.steps) == ("period", None)
    assert found.worst <= 0.7
    held = setting._replace(enforcement=together(2, 3))
    assert np.max(reach(held, 24).lower) <= found.worst
    assert greatest(setting._replace(enforcement=together(2, 4)), None).value > 0.7


@pytest.mark.slow
def test_for_ever_at_a_generous_limit():
    setting = asked(VEHICLE, "chi_square")
    found = policy(setting, 2.0)
    assert plain(found) == (31, 1, 31)
    assert found.worst <= 2.0
    held = setting._replace(enforcement=found.enforcement)
    assert np.max(reach(held, 100).lower) <= found.worst
    assert greatest(setting._replace(enforcement=together(2, 32)), None).value > 2.0


@pytest.fixture(scope="module")
def turns():
    """By duration and distance what is reached where the plant turns, over a few steps."""
    setting = asked(TURNING, "chi_square")
    return {(L, f): under(setting, together(1, L, f), STEPS) for f in (1, 2) for L in range(f, 13)}


@pytest.mark.slow
def test_a_turning_plant_is_not_monotone(turns):
    setting = asked(TURNING, "chi_square", together(1, 4))
    assert turns[4, 1] > 1.2 * turns[5, 1]
    assert turns[4, 1] > turns[7, 1]
    # from the definition, at the step where it is largest
    norm = reach(setting, STEPS).norm
    k = int(np.argmax(norm)) + 1
    assert largest(setting, k) == pytest.approx(norm[k - 1], rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "limit",
    [0.29, *(pytest.param(limit, marks=pytest.mark.slow) for limit in (0.1, 0.21, 0.26, 0.3))],
)
def test_the_rarest_of_a_turning_plant(turns, limit):
    found = policy(asked(TURNING, "chi_square"), limit, STEPS)
    every, duration, first = plain(found)
    best = min((f / L, f) for (L, f), value in turns.items() if value <= limit)
    # the search's bounds may be 2e-4 above, no limit here is that close
    assert (duration / every, duration) == pytest.approx(best)
    assert first == every
    assert turns[every, duration] <= found.worst * (1 + 1e-9)
    assert found.worst <= limit


@pytest.mark.slow
def test_longer_blocks_where_they_are_needed(turns):
    """Single samples do up to every third step, pairs every ninth, though not every eighth."""
    assert max(L for (L, f), value in turns.items() if f == 1 and value <= 0.29) == 3
    assert turns[8, 2] > 0.29 > turns[9, 2]


def test_even_distances_never_do():
    setting = asked(TURNING, "chi_square")
    for every in (2, 4, 10):
        held = setting._replace(enforcement=together(1, every))
        assert greatest(held, None).value == math.inf


@pytest.mark.whole
@pytest.mark.slow
def test_a_turning_plant_for_ever():
    setting = asked(TURNING, "chi_square")
    found = policy(setting, 0.9)
    every, duration, _ = plain(found)
    assert duration == 2 or every % 2 == 1
    held = setting._replace(enforcement=found.enforcement)
    assert np.max(reach(held, 24).lower) <= found.worst <= 0.9


# --- the ends of the scale ------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [None, 8])
def test_nothing_is_needed_where_nothing_can_be_done(steps):
    calm = filtered([[0.5, 0.1], [0.0, 0.4]], np.eye(2), np.eye(2), np.eye(2))
    found = policy(asked(calm, "chi_square"), 50.0, steps)
    assert found.enforcement is None
    assert (found.share, found.cost, found.tried) == (0.0, 0.0, 1)
    assert found.worst <= 50.0
    assert found.proof == ("period" if steps is None else "horizon")
    assert np.max(reach(asked(calm, "chi_square"), 8).lower) <= found.worst * (1 + 1e-9)
    assert trade_off(asked(calm, "chi_square"), found, steps) == [found]


@pytest.mark.parametrize("steps", [8, pytest.param(None, marks=pytest.mark.slow)])
def test_always_on_where_nothing_less_does(steps):
    setting = asked(VEHICLE, "chi_square")
    found = policy(setting, 1e-4, steps)
    assert plain(found) == (1, 1, 1)
    assert (found.worst, found.share, found.cost) == (0.0, 1.0, 2.0)
    points = trade_off(setting, found, steps)
    assert points[0].worst == 0.0
    assert points[0].share == 1.0


# --- every output its own schedule ----------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("costs", [None, [1.0, 20.0], [20.0, 1.0]])
def test_schedules_of_their_own_cost_no_more(costs):
    setting = asked(VEHICLE, "chi_square")
    both = policy(setting, 0.6, 12, costs)
    found = policy(setting, 0.6, 12, costs, per_sensor=True)
    price = np.ones(2) if costs is None else np.array(costs)
    held = found.enforcement
    share = np.asarray(held.duration) / np.asarray(held.every)
    assert found.cost == pytest.approx(float(share @ price), rel=1e-12)
    assert found.share == pytest.approx(float(np.mean(share)), rel=1e-12)
    assert found.cost <= both.cost * (1 + 1e-12)
    assert found.tried > both.tried
    # the bounds of every step on its own, and attacks from the definition
    again = setting._replace(enforcement=held)
    assert under(setting, held, 12) <= 0.6
    worst = int(np.argmax(reach(again, 12).norm)) + 1
    assert largest(again, worst, starts=3) <= found.worst * (1 + 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("costs", [[1.0, 3.0], [3.0, 1.0]])
def test_the_cheaper_of_two_that_tell_the_same(costs):
    twice = filtered([[1.0]], [[1.0], [1.0]], [[0.1]], np.eye(2))
    setting = asked(twice, "chi_square")
    both = policy(setting, 0.5, 12, costs)
    found = policy(setting, 0.5, 12, costs, per_sensor=True)
    held = found.enforcement
    cheap = int(np.argmin(costs))
    assert held.duration[1 - cheap] == 0
    assert held.duration[cheap] == 1
    assert found.cost == 1 / held.every[cheap]
    assert found.cost < both.cost
    assert found.tried > both.tried
    assert under(setting, held, 12) <= found.worst * (1 + 1e-9)
    # the next longer distance does not do
    longer = Enforcement.of(held.every + 1, held.duration, held.first + held.duration)
    assert under(setting, longer, 12) > 0.5


def test_an_output_that_is_not_attacked_is_not_checked():
    setting = asked(VEHICLE, "chi_square", compromised=[True, False])
    found = policy(setting, 0.3, 12, per_sensor=True)
    held = found.enforcement
    assert held.duration[1] == 0
    assert held.duration[0] > 0
    assert under(setting, held, 12) <= 0.3


# --- error against share --------------------------------------------------------------------------


@pytest.mark.slow
def test_what_more_and_less_would_do():
    setting = asked(VEHICLE, "chi_square")
    best = policy(setting, 0.6, 20)
    points = trade_off(setting, best, 20)
    assert len(points) > 3
    assert any(
        point.share == best.share and point.worst == pytest.approx(best.worst, rel=1e-3)
        for point in points
    )
    points = sorted(points, key=lambda point: point.share)
    for rarer, denser in itertools.pairwise(points):
        # bounds up to 2e-4 above the largest one
        assert denser.worst <= rarer.worst * (1 + 1e-3)
    for point in points:
        assert (point.limit, point.steps, point.proof) == (0.6, 20, "horizon")
        held = setting._replace(enforcement=point.enforcement)
        assert np.max(reach(held, 20).lower) <= point.worst * (1 + 1e-9)


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"limit": 0.0}, "limit: found 0.0, expected a positive number"),
        ({"limit": -1.0}, "limit: found -1.0"),
        ({"limit": math.nan}, "limit: found nan"),
        ({"limit": math.inf}, "limit: found inf"),
        ({"costs": [1.0]}, "cost: found [1.0], expected 2 positive numbers"),
        ({"costs": [1.0, 0.0]}, "cost: found [1.0, 0.0]"),
        ({"costs": [1.0, -2.0]}, "cost: found [1.0, -2.0]"),
        ({"costs": [1.0, math.nan]}, "cost: found [1.0, nan]"),
        ({"costs": [1.0, math.inf]}, "cost: found [1.0, inf]"),
    ],
)
def test_wrong_questions_are_named(keys, message):
    with pytest.raises(InvalidValue) as caught:
        policy(asked(VEHICLE, "chi_square"), **{"limit": 1.0, **keys})
    assert message in str(caught.value)
