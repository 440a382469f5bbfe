"""The H-infinity gain: its limit, the norm it reaches by a sweep over frequencies, its bounds."""

import numpy as np
import pytest

from holdfast.numerics.h_infinity import h_infinity_gain
from holdfast.numerics.steady_state import steady_state

FREQUENCIES = np.exp(1j * np.linspace(0, np.pi, 1001))


def system(seed):
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 4))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.5, 1.2) / np.max(np.abs(np.linalg.eigvals(A)))
    root = rng.normal(size=(m, m))
    return A, rng.normal(size=(m, n)), 0.5 * np.eye(n) + 0.1, root @ root.T + np.eye(m)


def norm(A, C, Q, R, K):
    """sup over frequencies of the error's gain from (w, v), both of unit weight; inf if unstable.

    e = M e_before + (I - K C) w - K v. On the grid, which can only miss some of a peak.
    """
    left = np.eye(len(A)) - K @ C
    M = left @ A
    if np.max(np.abs(np.linalg.eigvals(M))) >= 1:
        return np.inf
    enters = np.hstack([left @ np.linalg.cholesky(Q), -K @ np.linalg.cholesky(R)])
    answers = np.linalg.solve(np.eye(len(A)) - M / FREQUENCIES[:, None, None], enters[None])
    return float(np.max(np.linalg.norm(answers, 2, axis=(1, 2))))


def least_bound(A, C, Q, R):
    """By bisection, to 1 %."""
    low, high = 1e-3, 1e3
    while high > 1.01 * low:
        middle = np.sqrt(low * high)
        if h_infinity_gain(A, C, Q, R, middle) is None:
            low = middle
        else:
            high = middle
    return high


@pytest.mark.parametrize("seed", range(8))
def test_a_large_bound_gives_the_kalman_gain(seed):
    """bound^-2 = 1e-10 changes P by some 1e-10 of |P|^2, which is under 1e3 here."""
    given = system(seed)
    K = h_infinity_gain(*given, 1e5)
    np.testing.assert_allclose(K, steady_state(*given).K, atol=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_the_norm_stays_below_the_bound(seed):
    """For every bound for which there is a gain; with small ones it beats the Kalman filter.

    (With the gain of the one-step predictor it would not: on half of such systems that is over
    the bound at 1.05 times the least one, or unstable.)
    """
    given = system(seed)
    least, kalman = least_bound(*given), norm(*given, steady_state(*given).K)
    for factor in (1.0, 1.05, 1.3, 3.0):
        assert norm(*given, h_infinity_gain(*given, factor * least)) < factor * least
    assert norm(*given, h_infinity_gain(*given, 1.02 * least)) <= kalman * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_no_bound_is_below_what_is_possible(seed):
    """No gain whatever has a smaller norm than the least bound, to the 1 % of the bisection."""
    given = system(seed)
    least = least_bound(*given)
    assert h_infinity_gain(*given, 0.98 * least) is None
    K = h_infinity_gain(*given, least)
    rng = np.random.default_rng(seed)
    for scale in (1e-3, 1e-2, 1e-1):
        for _ in range(10):
            other = K + scale * np.max(np.abs(K)) * rng.normal(size=K.shape)
            assert norm(*given, other) > 0.98 * least


def test_nothing_to_settle_on():
    """No bound, an unstable mode that is not seen, no noise at all: None, and no exception."""
    one = np.eye(1)
    assert h_infinity_gain(0.5 * one, one, one, one, 0.01) is None
    assert h_infinity_gain(2.0 * one, 0.0 * one, one, one, 10.0) is None
    assert h_infinity_gain(0.5 * one, one, 0.0 * one, one, 10.0) is None


def test_singular_process_noise():
    """One of two states is driven: Q + 1e-12, as the Kalman gain to the same."""
    A, C, Q = np.array([[0.9, 1.0], [0.0, 0.5]]), np.array([[1.0, 0.0]]), np.diag([0.0, 1.0])
    found = h_infinity_gain(A, C, Q, np.eye(1), 1e5)
    np.testing.assert_allclose(found, steady_state(A, C, Q, np.eye(1)).K, atol=1e-6)
