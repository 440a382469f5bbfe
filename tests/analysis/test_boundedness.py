"""What the recursion says against what the invariant zeros and closed forms say."""

import numpy as np
import pytest

from analysis.models import model
from holdfast.analysis.boundedness import bounds
from holdfast.analysis.zeros import transfer

DOUBLE = np.array([[1.0, 0.1], [0.0, 1.0]])
GPS = np.array([[1.0], [0.0]])


def test_dead_reckoning_grows():
    """GPS attacked at every sample, speed measured: the position is a random walk."""
    found = bounds(model(DOUBLE, np.zeros((2, 1)), np.eye(2), GPS), np.eye(2), 0)
    assert found.state == {"x1": False, "x2": True}
    assert found.attack == {"d1": False}


def test_a_second_position_sensor_stops_it():
    C = np.vstack([np.eye(2), [[1.0, 0.0]]])
    H = np.array([[1.0], [0.0], [0.0]])
    found = bounds(model(DOUBLE, np.zeros((2, 1)), C, H), np.eye(2), 0)
    assert found.state == {"x1": True, "x2": True}
    assert found.attack == {"d1": True}


def test_the_delay_that_identifies_also_bounds():
    push = model(DOUBLE, np.array([[0.0], [0.1]]), np.array([[1.0, 0.0]]))
    assert bounds(push, np.eye(2), 0).attack == {"d1": False}
    assert bounds(push, np.eye(2), 1).attack == {"d1": True}


def test_a_prior_that_only_fades_is_bounded():
    """A constant without noise: its variance falls like 1 / k and never settles."""
    m = model(np.eye(1), np.zeros((1, 0)), np.eye(1), Q=np.zeros((1, 1)))
    assert bounds(m, np.eye(1), 0).state == {"x1": True}


@pytest.mark.parametrize("zero", [0.5, 0.9, -0.95, 1.0, -1.0, 1.05, -1.5])
def test_the_zero_decides(zero):
    """x2 is unseen, driven by the attack on x1 and moves by itself with the zero."""
    A = np.array([[0.5, 1.0], [0.0, zero]])
    A[1] += [0.3, 0.0]
    m = model(A, np.array([[1.0], [0.0]]), np.array([[1.0, 0.0]]))
    (found,) = transfer(m).zeros
    np.testing.assert_allclose(found.z, zero, rtol=1e-12)
    assert bounds(m, np.eye(2), 0).attack == {"d1": abs(zero) < 1.0}


def test_a_slow_zero_is_told_apart_from_none():
    """At 1 - 1e-4 the variance takes some 50 000 steps to settle, but its growth slows down."""
    A = np.array([[0.5, 1.0], [0.3, 1 - 1e-4]])
    m = model(A, np.array([[1.0], [0.0]]), np.array([[1.0, 0.0]]))
    assert bounds(m, np.eye(2), 0).attack == {"d1": None}
