"""The least squares and the integer plants that NISME's statements are judged by."""

import numpy as np
import pytest
from numpy.random import default_rng

from analysis.batch import reduced
from holdfast.papers.nisme_modes import integers, observed
from holdfast.papers.nisme_systems import EPSILON, STEPS, batch, drawn, nise, simulated, split
from oracles import batch_estimate


@pytest.mark.parametrize("size", [(3, 4, 2, 1), (4, 6, 4, 2)])
def test_batch_against_elimination_in_extended_precision(size):
    """Without input, and with all attacks free from the first: constant matrices."""
    (s,), rng = drawn(1, 5, size, moving=False), default_rng(6)
    data = simulated(s, rng, u=0.0)
    n, nd = size[0], size[2]
    m = s.F, s.B, s.C[0], s.D, EPSILON * s.G, s.H, EPSILON**2 * s.Q, s.R
    seen = np.ones((STEPS, size[1]), bool)
    exact = batch_estimate(m, s.x0, s.P0, np.zeros((STEPS, 2)), data.y[1:], seen)
    found, at = batch(s, data, start=False), split(s, STEPS)
    before = exact.value[n : n + nd]
    # 1e-9: rounding times the condition of the least squares, under 1e6
    np.testing.assert_allclose(found.x, exact.value[:n].astype(float), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.P, exact.cov[:n, :n].astype(float), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        found.d2, (at.V2 @ at.Vbar).T @ before.astype(float), rtol=1e-9, atol=1e-9
    )


def test_the_filter_is_biased_by_nothing():
    """Without noise, from the true state, every estimate is the truth whatever the attack."""
    for s in drawn(5, 7):
        quiet = s._replace(Q=1e-20 * s.Q, R=1e-20 * s.R, P0=1e-20 * s.P0)
        data = simulated(quiet, default_rng(8), attack=100.0)
        found = nise(quiet, data)
        # noise of 1e-10, times gains of a few hundred
        np.testing.assert_allclose(found.x, data.x[-1], atol=1e-6)
        np.testing.assert_allclose(found.d1, found.split.V1.T @ data.d[-1], atol=1e-6)


def test_the_attack_free_set_by_exact_ranks():
    """Without attack C_3 = C and Abar = A, integers: ranks modulo a prime."""
    answers = set()
    for m in integers(20):
        A, rows = m.A.astype(np.int64), [m.C.astype(np.int64)]
        for _ in range(len(A) - 1):
            rows.append(rows[-1] @ A)
        answers.add(observed(m, ()))
        assert observed(m, ()) == (len(reduced(np.vstack(rows))[1]) == len(A))
    assert answers == {True, False}
