"""Factorisations and the Mahalanobis distance, beside NumPy, small and large alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.numerics.linalg import (
    SMALL,
    dot,
    lower_factor,
    lower_inverse,
    mahalanobis,
    psd_factor,
    solve_lower,
)

jitted_distance = jax.jit(mahalanobis)


@pytest.mark.parametrize("n", [3, SMALL + 4])
def test_dot_is_matrix_multiplication(n):
    rng = np.random.default_rng(n)
    a, b, v = jnp.asarray(rng.normal(size=(n, 4))), jnp.asarray(rng.normal(size=(4, n))), None
    v = jnp.asarray(rng.normal(size=4))
    np.testing.assert_allclose(dot(a, b), np.asarray(a) @ np.asarray(b), atol=1e-13)
    np.testing.assert_allclose(dot(a, v), np.asarray(a) @ np.asarray(v), atol=1e-13)
    np.testing.assert_allclose(dot(v, b), np.asarray(v) @ np.asarray(b), atol=1e-13)


@pytest.mark.parametrize("n", [4, SMALL + 3])
def test_factors_of_a_semidefinite_matrix(n):
    """Rank n - 1: one row is a combination of earlier ones and is marked."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(n, n - 1))
    root[2] = root[0] - 2 * root[1]
    p = jnp.asarray(root @ root.T)
    lower, kept = lower_factor(p)
    np.testing.assert_allclose(lower @ lower.T, p, atol=1e-12)
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(kept)), [2])
    factor = psd_factor(p)
    np.testing.assert_allclose(factor @ factor.T, p, atol=1e-12)


@pytest.mark.parametrize("n", [4, SMALL + 3])
def test_solve_lower_leaves_dependent_rows_out(n):
    rng = np.random.default_rng(1)
    p = rng.normal(size=(n, n))
    p = p @ p.T
    p[1] = p[:, 1] = 0.0
    lower, kept = lower_factor(jnp.asarray(p))
    b = jnp.asarray(rng.normal(size=(n, 2)))
    x = solve_lower(lower, kept, b)
    rows = np.asarray(kept)
    np.testing.assert_allclose((lower @ x)[rows], b[rows], atol=1e-10)
    assert np.all(np.asarray(x)[1] == 0)


@settings(max_examples=25)
@given(st.integers(0, 2**31), st.integers(1, 6), st.integers(0, 6))
def test_mahalanobis_is_the_pseudo_inverse_and_counts(seed, n, rank):
    """v in the range of a covariance of any rank: v' cov^+ v, and the rank."""
    rng = np.random.default_rng(seed)
    rank = min(rank, n)
    root = np.zeros((6, rank)) if rank else np.zeros((6, 1))
    if rank:
        root[:n] = rng.normal(size=(n, rank)) * rng.uniform(0.01, 100, size=(n, 1))
    cov = root @ root.T
    v = root @ rng.normal(size=root.shape[1])
    found, dof = jitted_distance(jnp.asarray(v), jnp.asarray(cov))
    assert dof == rank
    # the pseudo-inverse in the scale of unit variances, where ranks are plain
    scale = np.sqrt(np.maximum(np.diagonal(cov), 1e-300))
    expected = (v / scale) @ np.linalg.pinv(cov / np.outer(scale, scale), rcond=1e-10) @ (v / scale)
    np.testing.assert_allclose(found, expected if rank else 0.0, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("n", [3, SMALL + 2])
def test_mahalanobis_leaves_out_what_has_no_variance_or_an_infinite_one(n):
    v, cov = np.full(n, 2.0), np.eye(n)
    cov[0, 0], cov[1, 1] = 0.0, np.inf
    found, dof = mahalanobis(jnp.asarray(v), jnp.asarray(cov))
    assert dof == n - 2
    np.testing.assert_allclose(found, 4.0 * (n - 2))


def test_batches_of_large_matrices_go_one_at_a_time_and_give_the_same():
    # more than SMALL rows: LAPACK, which must not be batched (two batches can lock one another)
    n = SMALL + 3
    roots = jax.random.normal(jax.random.key(0), (4, n, n))
    cov = roots @ jnp.swapaxes(roots, 1, 2)
    v = roots[:, 0]
    factor = jax.jit(jax.vmap(psd_factor))(cov)
    np.testing.assert_allclose(factor @ jnp.swapaxes(factor, 1, 2), cov, rtol=0, atol=1e-12)
    statistic, dof = jax.jit(jax.vmap(mahalanobis))(v, cov)
    expected = [x @ np.linalg.solve(P, x) for x, P in zip(*map(np.asarray, (v, cov)), strict=True)]
    np.testing.assert_allclose(statistic, expected, rtol=1e-8)
    assert dof.tolist() == [n] * 4
    lower, kept = jax.vmap(lower_factor)(cov)
    solved = jax.jit(jax.vmap(solve_lower))(lower, kept, roots)
    np.testing.assert_allclose(lower @ solved, roots, rtol=0, atol=1e-10)
    np.testing.assert_allclose(
        jax.vmap(lower_inverse)(lower) @ lower, np.broadcast_to(np.eye(n), (4, n, n)), atol=1e-9
    )
    program = jax.jit(jax.vmap(mahalanobis)).lower(v, cov).as_text()
    assert "while" in program
