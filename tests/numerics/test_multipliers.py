"""Bounds by multipliers against the problem written out, which has an exact answer."""

import numpy as np
import pytest

from attackers import asked, drawn, furthest, horizon, together, vehicle, written
from holdfast.numerics.attack_sets import attacks
from holdfast.numerics.multipliers import CLOSE, certificate, descended, factors
from holdfast.numerics.quadratic_reach import largest
from holdfast.reach.pieces import Piece, stretch

DETECTORS = ("chi_square", "windowed", "sprt")


def problem(seed, detector, t=8, aware=True, start=None):
    """A stretch of a random plant with two outputs, authenticated every fourth step."""
    setting = asked(drawn(seed, 2, 2), detector, together(2, 4), aware=aware)
    return setting, stretch(setting, Piece(0, t, start), tight=True)


def exact(of, k, functional=None):
    found = attacks(of)
    B = found.errors[k - 1] if functional is None else functional @ found.errors[k - 1]
    return largest(found.Z, found.w, found.b, B)


def shares(of, held):
    """What a certificate takes: non-negative multipliers mu with mu'b = 1."""
    return held.share[:-1] / of.b


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("aware", [True, False])
def test_both_bounds_close_in_on_the_exact_value(detector, aware):
    closing(range(1), detector, aware, (3, 7), 100)


@pytest.mark.slow
@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("aware", [True, False])
def test_both_bounds_close_in_on_more_plants(detector, aware):
    closing(range(1, 3), detector, aware, (1, 4, 6, 8), 200)


def closing(seeds, detector, aware, places, rounds):
    for seed in seeds:
        for start in (None, np.random.default_rng(seed).normal(size=(2, 2))):
            setting, of = problem(seed, detector, aware=aware, start=start)
            for k in places:
                closes(setting, of, k, rounds)


def closes(setting, of, k, rounds):
    truth = exact(of, k)
    few = descended(of, setting.functional, k, rounds=3)
    many = descended(of, setting.functional, k, rounds=rounds)
    for found in (few, many):
        assert found.upper >= truth.lower * (1 - 1e-9)
        assert found.lower <= truth.upper * (1 + 1e-9)
        assert found.lower <= found.upper * (1 + 1e-12)
        played(setting, of, found.path, k, found.lower)
    assert few.upper >= many.upper
    # like one over the rounds; of several longest axes the attack found is one, or a bad one
    assert many.upper <= truth.upper * (1 + 8.0 / rounds)
    assert many.lower >= truth.lower * 0.8


def played(setting, of, path, k, value):
    """The attack as the filter sees it: within every limit, and as far as it says."""
    A, C, K, Q = setting.system[:4]
    e = np.zeros(len(A)) if of.start is None else of.start @ path.first
    assert np.linalg.norm(path.first) <= 1 + 1e-9
    costs = []
    ahead = np.asarray(of.m.ahead)
    alterable = setting.alterable(len(of.sets))
    for i, a in enumerate(path.a):
        assert not np.any(a[~alterable[i]])
        told = np.sum((ahead @ e) ** 2, 1)
        z = C @ A @ e + a
        e = A @ e - K @ z
        costs.append([z @ np.linalg.solve(Q, z), *told])
        if i + 1 == k:
            assert np.linalg.norm(setting.functional @ e) == pytest.approx(value, rel=1e-9)
    costs = np.array(costs)
    spent = of.w @ np.concatenate([costs[:, 0], costs[:, 1:].reshape(-1)])
    assert np.max(spent / of.b) <= 1 + 1e-9


@pytest.mark.parametrize("detector", DETECTORS)
def test_a_row_against_cone_programs(detector):
    setting, of = problem(4, detector)
    functional = np.array([[1.0, -0.5]])
    for k in (2, 8):
        found = descended(of, functional, k, rounds=150)
        program = written(setting, 8, k, tight=True)
        c = (functional @ program.errors[k])[0]
        truth = c @ furthest(program, c)
        assert truth * (1 - 1e-7) <= found.upper <= truth * 1.01
        assert found.lower == pytest.approx(truth, rel=1e-2)


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("aware", [True, False])
def test_any_shares_give_a_bound(detector, aware):
    """Whatever they are: as they come, one alone, unnormalised, zero."""
    _, of = problem(7, detector, aware=aware)
    rng = np.random.default_rng(1)
    found, n = attacks(of), len(of.b)
    tries = [rng.exponential(size=n + 1), np.eye(n + 1)[2], 1e6 * np.ones(n + 1), np.zeros(n + 1)]
    truth = [exact(of, k).lower for k in range(1, 9)]
    for share in tries:
        held = certificate(of, share)
        assert np.sum(held.share) == pytest.approx(1.0, rel=1e-14)
        assert np.all(held.share[:-1] > 0)
        assert held.share[-1] == 0
        assert shares(of, held) @ of.b == pytest.approx(1.0, rel=1e-13)
        # its weights are the sum of the limits by these multipliers
        costs = rng.exponential(size=of.w.shape[1])
        weighted = held.weights[:, 0] @ costs[:8]
        weighted += held.weights[:, 1:].reshape(-1) @ costs[8:]
        assert weighted == pytest.approx(shares(of, held) @ (of.w @ costs), rel=1e-12)
        halves = factors(of, held)
        for value, half in zip(truth, halves, strict=True):
            assert value <= np.linalg.norm(half, 2) * (1 + 1e-9)
        # and every attack within the limits stays in these ellipsoids
        theta = rng.normal(size=found.Z.shape[2])
        theta /= np.sqrt(np.max((found.w @ np.sum((found.Z @ theta) ** 2, 1)) / found.b))
        for half, errors in zip(halves, found.errors, strict=True):
            xi, *_ = np.linalg.lstsq(half, errors @ theta, rcond=None)
            np.testing.assert_allclose(half @ xi, errors @ theta, atol=1e-9)
            assert np.linalg.norm(xi) <= 1 + 1e-9


def test_the_first_ellipsoid_is_a_limit_like_the_others():
    start = np.array([[2.0, 0.0], [1.0, 0.5]])
    setting, of = problem(3, "chi_square", start=start)
    tries = (np.zeros(len(of.b) + 1), np.append(np.ones(len(of.b)), 0.0))
    for share in tries:
        held = certificate(of, share)
        assert held.share[-1] > 0
        np.testing.assert_allclose(held.start * np.sqrt(held.share[-1]), start, rtol=1e-12)
    # multipliers of a stretch that began at 0 do not say how much of it there is: it is found
    cold, warm = (descended(of, setting.functional, 3, share, 0.0, 150) for share in (None, share))
    assert warm.upper == pytest.approx(cold.upper, rel=1e-2)
    assert cold.upper == pytest.approx(exact(of, 3).upper, rel=1e-2)


def test_it_stops_where_enough_is_shown():
    setting, of = problem(2, "chi_square")
    best = descended(of, setting.functional, 5, rounds=150)
    assert best.upper <= best.lower * (1 + 1e-2)
    first = descended(of, setting.functional, 5, rounds=1)
    enough = 0.5 * (best.upper + first.upper)
    shown = descended(of, setting.functional, 5, enough=enough)
    assert best.upper * (1 - CLOSE) <= shown.upper <= enough
    again = descended(of, setting.functional, 5, shown.held.share, rounds=1)
    assert again.upper == pytest.approx(shown.upper, rel=1e-9)


def test_the_vehicle_over_five_blocks():
    """A stretch too long to be written out as a habit; its ends meet to a thousandth."""
    setting = asked(vehicle(), "chi_square", together(2, 20))
    of = stretch(setting, Piece(0, 100, None))
    for k in (12, 53, 99):
        assert horizon(setting, k) <= 100
        found = descended(of, setting.functional, k)
        assert found.lower <= found.upper <= found.lower * 1.002
        played(setting, of, found.path, k, found.lower)


def test_nothing_that_can_be_moved():
    setting = asked(drawn(0, 2, 2), "chi_square", compromised=[False, False])
    of = stretch(setting, Piece(0, 4, None))
    found = descended(of, setting.functional, 3)
    assert found.upper == found.lower == 0.0
