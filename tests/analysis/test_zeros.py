"""Invariant zeros against systems that are built to have given ones."""

import numpy as np
import pytest
from scipy.linalg import eigvals

from analysis.models import model
from holdfast.analysis.zeros import transfer


def assert_same(values, wanted, atol):
    """The same numbers in any order."""
    ours, theirs = (sorted(v, key=lambda z: (round(z.real, 5), z.imag)) for v in (values, wanted))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=atol)


def companion(poles, numerator):
    """Controllable canonical form of numerator(z) / prod(z - poles): its zeros are the roots."""
    n = len(poles)
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = -np.poly(poles)[:0:-1]
    C = np.zeros((1, n))
    C[0, : len(numerator)] = numerator[::-1]
    return A, np.eye(n)[:, -1:], C


@pytest.mark.parametrize(
    "zeros", [[], [0.5], [1.25], [-1.0, 0.3], [0.6 + 0.8j, 0.6 - 0.8j], [2.0, 2.0], [0.9, 0.9, 0.9]]
)
def test_zeros_of_one_output_are_roots_of_its_numerator(zeros):
    A, G, C = companion([0.1, -0.4, 0.7, 0.2], np.atleast_1d(np.poly(zeros)).real)
    found = transfer(model(A, G, C))
    values = [z.z for z in found.zeros for _ in range(z.multiplicity)]
    # simple zeros to rounding; repeated ones are put together at their mean, as exact
    assert_same(values, np.array(zeros, complex), 1e-9)
    for zero in found.zeros:
        assert zero.unstable == (abs(zero.z) >= 1 - 1e-7)


def built(rng, n, ny, nd, inner):
    """A system whose zeros are the eigenvalues of ``inner``, in general coordinates.

    Beside a random non-square system, which has none, stand modes that no output sees (more
    outputs than attacks) or that no attack reaches (fewer). They are then hidden by feedback of
    all states to the attack, output injection and a change of coordinates: all three leave
    invariant zeros where they are.
    """
    m = len(inner)
    A = np.zeros((n + m, n + m))
    A[:n, :n], A[n:, n:] = rng.normal(size=(n, n)), inner
    tall = ny > nd
    A[n:, :n], A[:n, n:] = tall * rng.normal(size=(m, n)), (not tall) * rng.normal(size=(n, m))
    G = np.vstack([rng.normal(size=(n, nd)), np.zeros((m, nd))])
    C = np.hstack([rng.normal(size=(ny, n)), (not tall) * rng.normal(size=(ny, m))])
    H = rng.normal(size=(ny, nd)) * (rng.random() < 0.5)
    feedback = rng.normal(size=(nd, n + m))
    A, C = A + G @ feedback, C + H @ feedback
    inject = rng.normal(size=(n + m, ny))
    A, G = A + inject @ C, G + inject @ H
    T = rng.normal(size=(n + m, n + m))
    return T @ A @ np.linalg.inv(T), T @ G, C @ np.linalg.inv(T), H


INNER = {
    "none": np.zeros((0, 0)),
    "stable": np.diag([0.5, -0.2]),
    "circle": np.diag([1.0, 0.3]),
    "pair": np.array([[1.2, 0.5], [-0.5, 1.2]]),
    "jordan": np.array([[1.0, 1.0], [0.0, 1.0]]),
    "twice": np.eye(2),
}


@pytest.mark.parametrize("kind", INNER)
@pytest.mark.parametrize(("ny", "nd"), [(3, 1), (3, 2), (1, 2), (2, 3)])
def test_zeros_of_non_square_systems(kind, ny, nd):
    rng = np.random.default_rng([list(INNER).index(kind), ny, nd])
    for _ in range(5):
        A, G, C, H = built(rng, 3, ny, nd, INNER[kind])
        found = transfer(model(A, G, C, H))
        values = [z.z for z in found.zeros for _ in range(z.multiplicity)]
        wanted = np.linalg.eigvals(INNER[kind])
        # rounding times the condition number of the random change of coordinates, under 1e4
        assert_same(values, wanted.astype(complex), 1e-8)
        assert found.rank == min(ny, nd)
        assert found.lost.shape[1] == nd - found.rank
        for zero in found.zeros:
            at = zero.z * np.eye(len(A))
            for x, d in zip(zero.state.T, zero.attack.T, strict=True):
                size = np.linalg.norm(x) + np.linalg.norm(d)
                # what the definition says: the pencil maps the pair to zero (as above)
                moved = (A - at) @ x + G @ d
                assert np.linalg.norm(moved) < 1e-7 * size * np.linalg.norm(A)
                assert np.linalg.norm(C @ x + H @ d) < 1e-7 * size * np.linalg.norm(C)


def test_square_systems_against_the_generalised_eigenvalues():
    rng = np.random.default_rng(3)
    for _ in range(20):
        A, G, C, H = (rng.normal(size=s) for s in ((4, 4), (4, 2), (2, 4), (2, 2)))
        pencil = eigvals(np.block([[A, G], [C, H]]), np.diag([1, 1, 1, 1, 0, 0]))
        finite = pencil[np.isfinite(pencil) & (abs(pencil) < 1e6)]
        found = [z.z for z in transfer(model(A, G, C, H)).zeros]
        # both are backward stable; random zeros have condition numbers up to some 1e4
        assert_same(found, finite, 1e-8)


def test_what_hides_is_named():
    """A position that may be falsified at every sample hides a shift of the position."""
    A = np.array([[1.0, 0.1], [0.0, 1.0]])
    (zero,) = transfer(model(A, np.zeros((2, 1)), np.eye(2), np.array([[1.0], [0.0]]))).zeros
    assert zero.unstable
    np.testing.assert_allclose(zero.attack, [[1.0]])
    # 1e-12: a few roundings of numbers of size 1
    np.testing.assert_allclose(zero.state, [[-1.0], [0.0]], atol=1e-12)


def test_what_no_output_shows_is_a_zero_without_attack():
    A = np.array([[1.0, 0.1], [0.0, 1.0]])
    (zero,) = transfer(model(A, np.array([[0.0], [0.1]]), np.array([[0.0, 1.0]]))).zeros
    np.testing.assert_allclose(zero.attack, [[0.0]])
    np.testing.assert_allclose(zero.state, [[1.0], [0.0]], atol=1e-12)
