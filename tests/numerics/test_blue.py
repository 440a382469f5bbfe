"""The update with undetermined directions: extreme scales, structure, and one truth beside it."""

import jax
import jax.numpy as jnp
import numpy as np

import oracles
from holdfast.numerics.blue import absorb_known, echelon, leftover, split, whitener

absorb_jit = jax.jit(absorb_known)


def wide_update(P, C, R):
    """Gain and covariance by the information form in extended precision."""
    P, C, R = (np.asarray(m, oracles.WIDE) for m in (P, C, R))
    n = len(P)
    eye = np.eye(n, dtype=oracles.WIDE)
    rows = np.vstack(
        [oracles.forward(oracles.cholesky(P), eye), oracles.forward(oracles.cholesky(R), C)]
    )
    return oracles.least_squares(rows, np.zeros(len(rows), oracles.WIDE)).cov


def test_vague_prior_next_to_redundant_precise_sensors():
    """P0 = 1e8 and R = 1e-8: C P C' + R is singular to working precision, and its Cholesky
    factor does not exist; row by row the answer keeps 12 digits.
    """
    P = np.diag([1e8, 1e8])
    C = np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    R = np.diag([1e-8, 2e-8, 1e-8])
    W, _ = whitener(jnp.asarray(R), jnp.ones(3, bool))
    gain, cov = absorb_jit(jnp.asarray(P), W @ C)
    truth = wide_update(P, C, R)
    scale = np.sqrt(np.outer(np.diagonal(truth), np.diagonal(truth)))
    assert np.max(np.abs(np.asarray(cov) - truth) / scale) < 1e-12
    expected = truth @ C.T @ np.linalg.inv(R)
    np.testing.assert_allclose(gain @ W, expected.astype(float), atol=1e-12)


def test_whitener_of_what_was_seen():
    rng = np.random.default_rng(0)
    R = rng.normal(size=(4, 4))
    R = R @ R.T + 0.1 * np.eye(4)
    seen = np.array([True, False, True, True])
    W, back = whitener(jnp.asarray(R), jnp.asarray(seen))
    np.testing.assert_allclose(W @ R @ W.T, np.diag(seen.astype(float)), atol=1e-13)
    np.testing.assert_allclose(back @ W, np.diag(seen.astype(float)), atol=1e-13)


def test_split_finds_structural_rank_whatever_the_units():
    """Columns in units 1e12 apart, one a combination of two others: three pivots."""
    rng = np.random.default_rng(1)
    T = rng.normal(size=(5, 4)) * np.array([1e-6, 1.0, 1e6, 1.0])
    T[:, 3] = T[:, 1] - 3e-6 * T[:, 2]
    parts = split(jnp.asarray(T), jnp.abs(jnp.asarray(T)))
    assert np.sum(parts.pivot) == 3
    np.testing.assert_allclose(parts.rotation @ parts.rotation.T, np.eye(5), atol=1e-14)
    size = np.linalg.norm(T, axis=0)
    np.testing.assert_allclose((parts.rotation @ T - parts.map) / size, 0.0, atol=1e-9)


def test_leftover_is_the_null_space():
    """N = I: what stays free under T is the null space of T, with exact zeros elsewhere."""
    T = np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0]])
    left = np.asarray(leftover(jnp.eye(4), split(jnp.asarray(T), jnp.abs(jnp.asarray(T)))))
    np.testing.assert_allclose(T @ left, 0.0, atol=1e-14)
    assert np.linalg.matrix_rank(left) == 2
    assert np.all(left[2] == 0)
    basis = np.asarray(echelon(jnp.asarray(left)))
    assert np.linalg.matrix_rank(basis) == 2
    assert np.sum(np.any(basis != 0, 0)) == 2
    joint = np.column_stack([left, basis])
    assert np.linalg.matrix_rank(joint) == 2
