"""A window of rows as one regression, against the matrices written out and simulated sums."""

import jax
import numpy as np
import pytest

from holdfast.numerics.stacked import forced, stacked, stacked_noise

T, P, N = 5, 2, 3
CLOSE = 1e-11
"""Rounding, times powers of A of 1e2 and, in the singular cases, pseudo-inverses of 1e3."""
OF = jax.jit(stacked)
PUSHED = jax.jit(forced)
NOISE = jax.jit(stacked_noise)
KINDS = ("constant", "per step", "singular", "per step, singular", "nilpotent", "identity")


def matrices(kind, seed):
    """A, C, Q, R of every row."""
    rng = np.random.default_rng(seed)
    each = kind.startswith("per step")
    count = T if each else 1
    A = rng.normal(size=(count, N, N))
    A = A / np.max(np.abs(np.linalg.eigvals(A)), 1)[:, None, None]
    if kind.endswith("singular"):
        A[-1, :, 0] = A[-1, :, 1]
    elif kind == "nilpotent":
        A = np.diag(np.ones(N - 1), 1)[None]
    elif kind == "identity":
        A = np.eye(N)[None]
    C = rng.normal(size=(count, P, N))
    Q, R = rng.normal(size=(count, N, N)), rng.normal(size=(count, P, P))
    Q[:, 2] = Q[:, 1]  # a process noise that does not move all
    Q, R = Q @ np.swapaxes(Q, 1, 2), R @ np.swapaxes(R, 1, 2)
    return tuple(np.array(np.broadcast_to(m, (T, *m.shape[1:]))) for m in (A, C, Q, R))


def power(A, start, stop):
    """From row ``start`` to row ``stop``."""
    found = np.eye(N)
    for i in range(start + 1, stop + 1):
        found = A[i] @ found
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_rows(kind):
    A, C, _, _ = matrices(kind, 0)
    found = OF(A, C)
    for i in range(T):
        np.testing.assert_allclose(found.rows[i], C[i] @ power(A, 0, i), atol=CLOSE)
    np.testing.assert_allclose(found.last, power(A, 0, T - 1), atol=CLOSE)


@pytest.mark.parametrize("kind", KINDS)
def test_known_inputs_go_where_the_plant_takes_them(kind):
    """A plant stepped row by row is the free one and the forced response together."""
    A, C, _, _ = matrices(kind, 1)
    rng = np.random.default_rng(2)
    push, direct, first = rng.normal(size=(T, N)), rng.normal(size=(T, P)), rng.normal(size=N)
    outputs, last = PUSHED(A, C, push, direct)
    free = OF(A, C)
    x = first
    for i in range(T):
        x = A[i] @ x + push[i] if i else x
        y = C[i] @ x + direct[i]
        np.testing.assert_allclose(free.rows[i] @ first + outputs[i], y, atol=CLOSE)
    np.testing.assert_allclose(free.last @ first + last, x, atol=CLOSE)


def written_out(A, C, Q, R):
    """Covariances of all noise in the rows and in the last state: (T P + N) square."""
    into = np.zeros((T * P + N, T * N + T * P))
    for i in range(T):
        for s in range(1, i + 1):
            into[i * P : (i + 1) * P, s * N : (s + 1) * N] = C[i] @ power(A, s, i)
        into[i * P : (i + 1) * P, T * N + i * P : T * N + (i + 1) * P] = np.eye(P)
    for s in range(1, T):
        into[T * P :, s * N : (s + 1) * N] = power(A, s, T - 1)
    cov = np.zeros((T * N + T * P,) * 2)
    for i in range(T):
        cov[i * N : (i + 1) * N, i * N : (i + 1) * N] = Q[i]
        at = T * N + i * P
        cov[at : at + P, at : at + P] = R[i]
    return into @ cov @ into.T


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_noise(kind, seed):
    """About the first state x_0 + M^+ w_last, with w_last the noise in the last state.

    Where M is singular any of the M^+ will do, which differ by states that die out: what the rows
    say apart from these is the same.
    """
    A, C, Q, R = matrices(kind, seed)
    found = jax.tree.map(np.asarray, NOISE(A, C, Q, R))
    joint = written_out(A, C, Q, R)
    Phi = np.concatenate([C[i] @ power(A, 0, i) for i in range(T)])
    M = power(A, 0, T - 1)
    values = np.linalg.svd(M)[1]
    rank = np.sum(values > 1e-9)
    inverse = np.linalg.pinv(M, rcond=1e-9 / max(values[0], 1e-9))
    outside = np.eye(N) - M @ inverse
    turn = np.block([[np.eye(T * P), -Phi @ inverse], [np.zeros((N, T * P)), outside]])
    expected = turn @ joint @ turn.T
    # what tells no states apart that die out
    dying = Phi @ np.linalg.svd(M)[2][rank:].T
    left = np.eye(T * P) - dying @ np.linalg.pinv(dying, rcond=1e-9)
    size = np.max(np.abs(expected))
    m = T * P
    np.testing.assert_allclose(left @ found.cov @ left, left @ expected[:m, :m] @ left,
                               atol=CLOSE * size)  # fmt: skip
    np.testing.assert_allclose(found.extra, expected[m:, m:], atol=CLOSE * size)
    np.testing.assert_allclose(left @ found.cross, left @ expected[:m, m:], atol=CLOSE * size)
    np.testing.assert_array_equal(found.cov, found.cov.T)
    if rank == N:
        np.testing.assert_allclose(found.cov, expected[:m, :m], atol=CLOSE * size)
        np.testing.assert_allclose(found.extra, 0.0, atol=CLOSE * size)
    assert np.linalg.eigvalsh(found.cov)[0] > -1e-12 * size


def test_one_row():
    """No process noise, no input that moves."""
    A, C, Q, R = (m[:1] for m in matrices("per step", 0))
    found = jax.jit(stacked_noise)(A, C, Q, R)
    np.testing.assert_array_equal(found.cov, R[0])
    assert not np.any(found.extra)
    outputs, last = jax.jit(forced)(A, C, np.ones((1, N)), np.ones((1, P)))
    np.testing.assert_array_equal(outputs, np.ones((1, P)))
    assert not np.any(last)
