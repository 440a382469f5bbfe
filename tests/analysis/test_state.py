"""Observability, modes and the steady-state filter against plain NumPy."""

import numpy as np
import pytest

from analysis.batch import determined
from analysis.models import model, plant
from holdfast.analysis.model import models_over
from holdfast.analysis.observability import observability, rows_until_observable
from holdfast.numerics.steady_state import steady_state


def stacked(A, C, count):
    return np.vstack([C @ np.linalg.matrix_power(A, k) for k in range(count)])


def riccati(m):
    return m.A, m.C, m.Q, m.R


def no_attack(A, C, **more):
    return model(A, np.zeros((len(A), 0)), C, **more)


def test_observability_of_integer_systems():
    """Against the observability matrix in exact arithmetic."""
    rng = np.random.default_rng(0)
    kinds = set()
    for _ in range(150):
        n, ny = rng.integers(1, 6), rng.integers(1, 3)
        A = rng.integers(-1, 2, (n, n)) * (rng.random((n, n)) < 0.5)
        C = rng.integers(-1, 2, (ny, n)) * (rng.random((ny, n)) < 0.5)
        found = observability(no_attack(A, C))
        wanted = next((k for k in range(1, n + 1) if determined(stacked(A, C, k)).all()), None)
        assert (found.observable, found.rows) == (wanted is not None, wanted)
        hidden = stacked(A, C, n) @ found.hidden
        # integers of the size of A^5: rounding of products under 1e3
        np.testing.assert_allclose(hidden, np.zeros_like(hidden), atol=1e-9)
        shown = [determined(np.vstack([stacked(A, np.vstack([C, row]), n)])).all()
                 for row in np.eye(n, dtype=int)]  # fmt: skip
        names = tuple(f"x{i + 1}" for i in range(n) if shown[i])
        assert found.sensors == (() if found.observable else names)
        kinds.add(found.rows)
    assert {None, 1, 2, 3} <= kinds


def test_observability_does_not_depend_on_units():
    A = np.eye(4) + np.diag([1e-6, 1e4, 1e-9], 1)
    found = observability(no_attack(A, np.array([[1e-8, 0.0, 0.0, 0.0]])))
    assert (found.observable, found.rows) == (True, 4)


@pytest.mark.parametrize(("modulus", "unstable"), [(1.0, 3), (1 - 1e-9, 3), (1 - 1e-6, 0)])
def test_repeated_modes_are_counted_where_they_are(modulus, unstable):
    """A triple mode in general coordinates: its computed eigenvalues scatter by 1e-5."""
    T = np.random.default_rng(1).normal(size=(3, 3))
    A = T @ (modulus * np.eye(3) + np.eye(3, k=1)) @ np.linalg.inv(T)
    assert observability(no_attack(A, np.eye(3))).unstable == unstable


def test_rows_of_a_plant_that_changes():
    """Two states, one at a time: the first row sees one, the third the other."""
    C = np.zeros((4, 1, 2))
    C[:, 0, 0] = 1.0
    C[2] = [[0.0, 1.0]]
    A = np.tile(np.eye(2), (4, 1, 1))
    changing = plant(A, np.zeros((2, 0)), C)
    models = models_over(changing, np.zeros(2))
    assert rows_until_observable(models) == 3
    assert rows_until_observable(models[:2]) is None


def recursion(m, steps):
    """The Riccati recursion in its textbook form."""
    P = np.eye(len(m.A))
    for _ in range(steps):
        P_pred = m.A @ P @ m.A.T + m.Q
        K = P_pred @ m.C.T @ np.linalg.inv(m.C @ P_pred @ m.C.T + m.R)
        P = P_pred - K @ m.C @ P_pred
    return K, P, P_pred


def test_steady_state_is_where_the_recursion_goes():
    rng = np.random.default_rng(2)
    for _ in range(20):
        n, ny = rng.integers(1, 5), rng.integers(1, 4)
        A = 1.2 * rng.normal(size=(n, n)) / np.sqrt(n)
        root, spread = rng.normal(size=(n, n)), rng.normal(size=(ny, ny))
        R = spread @ spread.T + 0.1 * np.eye(ny)
        m = no_attack(A, rng.normal(size=(ny, n)), Q=root @ root.T + 0.1 * np.eye(n), R=R)
        found = steady_state(*riccati(m))
        assert found.reason is None
        for ours, wanted in zip(found[:3], recursion(m, 2000), strict=True):
            # both sit at the fixed point of a contraction: rounding of numbers of this size
            np.testing.assert_allclose(ours, wanted, rtol=1e-8, atol=1e-8 * np.abs(wanted).max())


def test_no_steady_state_where_a_mode_is_not_seen():
    found = steady_state(*riccati(no_attack(np.diag([1.1, 0.5]), np.array([[0.0, 1.0]]))))
    assert found[:3] == (None, None, None)
    assert "do not see the unstable mode 1.1" in found.reason


def test_no_steady_state_where_a_constant_has_no_noise():
    m = no_attack(np.diag([1.0, 0.5]), np.eye(2), Q=np.diag([0.0, 0.1]))
    assert "no noise excites the mode 1" in steady_state(*riccati(m)).reason


def test_an_unstable_mode_without_noise_settles():
    """P_pred of x' = 2 x, y = x + v without process noise: p = 4 p / (p + 1), so p = 3."""
    found = steady_state(*riccati(no_attack(np.array([[2.0]]), np.eye(1), Q=np.zeros((1, 1)))))
    np.testing.assert_allclose(found.P_pred, [[3.0]], rtol=1e-9)
    np.testing.assert_allclose(found.K, [[0.75]], rtol=1e-9)
