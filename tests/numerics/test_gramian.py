"""Uniform observability against Gramians summed by their definition, and where those fail."""

import numpy as np
import pytest

from holdfast.numerics.gramian import uniformly_observable


def gramian(A, C, k, steps):
    """The definition, with C'C in place of the printed CC' and Phi transposed on the left."""
    n = A[0].shape[0]
    found, through = np.zeros((n, n)), np.eye(n)
    for i in range(k, k + steps + 1):
        found += through.T @ C[i].T @ C[i] @ through
        through = A[i] @ through if i < len(A) else through
    return found


@pytest.mark.parametrize("seed", range(8))
def test_windows_of_random_systems(seed):
    rng = np.random.default_rng(seed)
    n, T = int(rng.integers(2, 5)), 9
    A = [rng.normal(size=(n, n)) for _ in range(T)]
    # some samples show nothing, and the numbers of rows differ
    C = [rng.normal(size=(int(rng.integers(0, 2)), n)) for _ in range(T)]
    found = uniformly_observable(A, C)
    for steps in range(T - 1):
        grams = [gramian(A, C, k, steps) for k in range(T - steps)]
        full = all(np.linalg.matrix_rank(m) == n for m in grams)
        assert full == (found.steps is not None and steps >= found.steps)
        if steps == found.steps:
            values = np.concatenate([np.linalg.eigvalsh(m) for m in grams])
            # the summed Gramian loses its smallest value to rounding of its largest
            assert found.lowest == pytest.approx(values.min(), abs=1e-13 * values.max())
            assert found.highest == pytest.approx(values.max(), rel=1e-12)


def test_constant_systems():
    """A double integrator whose position is measured, and the same without its sensor."""
    A, C = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[2.0, 0.0]])
    found = uniformly_observable(A, C)
    values = np.linalg.eigvalsh(gramian([A, A], [C, C], 0, 1))
    assert found.steps == 1
    np.testing.assert_allclose((found.lowest, found.highest), values, rtol=1e-12)
    blind = uniformly_observable(A, np.array([[0.0, 1.0]]))
    assert (blind.steps, blind.observable) == (None, False)
    assert uniformly_observable(A, np.zeros((0, 2))).steps is None


def test_the_last_step_of_a_window_is_not_used():
    A = [np.eye(2)] * 3
    C = [np.eye(2), np.zeros((0, 2)), np.eye(2), np.eye(2)]
    with_it = uniformly_observable([*A, np.full((2, 2), np.nan)], C)
    assert with_it == uniformly_observable(A, C)
    # one sample is not enough at the second, two are everywhere
    assert with_it.steps == 1


def test_what_a_squared_gramian_loses():
    """Two rows 1e-7 apart: M is singular in double precision, its root is not."""
    C = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-7]])
    found = uniformly_observable(0.5 * np.eye(2), C)
    # singular values of C: 2 and 1e-7 / 2, up to 1e-7 of themselves
    assert found.lowest == pytest.approx(2.5e-15, rel=1e-6)
    assert found.highest == pytest.approx(4.0, rel=1e-6)
    # by eigenvalues of C'C that is under the rounding of its largest
    assert abs(np.linalg.eigvalsh(C.T @ C)[0] - 2.5e-15) > 1e-17


def test_units_do_not_matter():
    rng = np.random.default_rng(4)
    A, C = rng.normal(size=(4, 4)), rng.normal(size=(1, 4))
    unit = np.array([1e-6, 1e4, 1.0, 1e9])
    assert uniformly_observable(A, C).steps == 3
    assert uniformly_observable(A * unit / unit[:, None], 1e-5 * C * unit).steps == 3
    # the third and fourth state are hidden, but for rounding of a change of coordinates
    A[:2, 2:], C[0, 2:] = 0.0, 0.0
    T = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    assert uniformly_observable(T @ A @ T.T, C @ T.T).steps is None
