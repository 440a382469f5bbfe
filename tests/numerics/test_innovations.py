"""A correction kept as matrices, against the textbook's inverse of S."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.numerics.blue import whitener
from holdfast.numerics.innovations import correction
from systems import covariance

corrected = jax.jit(lambda P, C, R, seen: correction(P, C, R, whitener, seen))


def problem(seed: int, n: int, p: int):
    rng = np.random.default_rng(seed)
    return covariance(rng, n), rng.normal(size=(p, n)), covariance(rng, p), rng.random(p) < 0.6


@pytest.mark.parametrize(("n", "p"), [(4, 3), (12, 5)])
@pytest.mark.parametrize("prior", [0.0, 1.0, 1e8])
def test_it_is_the_kalman_correction_by_what_was_seen(n, p, prior):
    for seed in range(4):
        P, C, R, seen = problem(seed, n, p)
        P = prior * P
        seen = np.ones(p, bool) if seed == 0 else np.zeros(p, bool) if seed == 1 else seen
        got = jax.tree.map(np.asarray, corrected(P, C, R, seen))
        C, R = C[seen], R[np.ix_(seen, seen)]
        S = C @ P @ C.T + R
        gain = np.linalg.solve(S, C @ P).T
        left = np.eye(n) - gain @ C
        cov = left @ P @ left.T + gain @ R @ gain.T
        white, moves = got.white[:, seen], got.moves
        # S is rounded to eps times its size before it is inverted, here by both
        tolerance = 1e-12 * (np.linalg.cond(S) if seen.any() else 1.0)
        T = white[seen]
        np.testing.assert_allclose(T @ S @ T.T, np.eye(seen.sum()), rtol=0, atol=tolerance)
        size = max(1.0, np.max(np.abs(gain), initial=0.0))
        np.testing.assert_allclose(moves @ white, gain, rtol=0, atol=tolerance * size)
        size = max(1.0, np.max(np.abs(cov)))
        np.testing.assert_allclose(got.cov, cov, rtol=0, atol=tolerance * size)
        whole = np.linalg.slogdet(S)[1] + seen.sum() * np.log(2 * np.pi)
        np.testing.assert_allclose(got.log_det, whole, rtol=0, atol=tolerance)
        assert np.all(got.white[~seen] == 0)
        assert np.all(got.white[:, ~seen] == 0)
        assert np.all(got.moves[:, ~seen] == 0)


def test_a_vague_prior_beside_a_fine_sensor_loses_nothing():
    """P = 1e8 and R = 1e-16, one at a time: variances near R, not P's rounding of 1e-8."""
    P, C, R = 1e8 * np.eye(3), np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), 1e-16 * np.eye(2)
    got = corrected(P, C, R, np.ones(2, bool))
    np.testing.assert_allclose(np.diag(got.cov), [1e-16, 0.25e-16, 1e8], rtol=1e-9)
    assert jnp.all(jnp.linalg.eigvalsh(got.cov) >= 0)
