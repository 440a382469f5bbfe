"""CARE's statements against plain NumPy and small cases made by hand."""

import numpy as np
import pytest

from analysis.models import model
from holdfast.analysis.constrained import bias, blue_gain, rank_condition, unbiased
from holdfast.analysis.stability import care_step, stability
from holdfast.estimators import unknown_input
from systems import covariance, estimates, quiet_plant


def random_case(seed, n=4, ny=3, nd=2):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
    G, C = rng.normal(size=(n, nd)), rng.normal(size=(ny, n))
    return A, G, C, covariance(rng, n), covariance(rng, ny), rng


def test_the_gain_is_unbiased_and_any_other_is_told():
    for seed in range(20):
        A, G, C, Q, R, rng = random_case(seed)
        M = blue_gain(C, G, A @ A.T + Q, R)
        assert unbiased(M, C, G).holds
        found = unbiased(M + 1e-6 * rng.normal(size=M.shape), C, G)
        assert not found.holds
        assert 1e-8 < found.error < 1e-3


def test_the_gain_is_the_best_of_the_unbiased():
    """Gauss-Markov: M plus anything that keeps M C G = I has a larger covariance."""
    for seed in range(20):
        A, G, C, Q, R, rng = random_case(seed)
        S = C @ (A @ A.T + Q) @ C.T + R
        M = blue_gain(C, G, A @ A.T + Q, R)
        unseen = np.linalg.svd(C @ G)[0][:, 2:].T
        other = M + rng.normal(size=(2, 1)) @ unseen
        assert unbiased(other, C, G).holds
        # rounding of covariances of size 1e2
        assert np.linalg.eigvalsh(other @ S @ other.T - M @ S @ M.T)[0] > -1e-9
        assert np.trace(other @ S @ other.T) > np.trace(M @ S @ M.T)


def test_the_directions_without_rank_are_named():
    C, G = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.eye(3)[:, [0, 0, 2]]
    G[:, 1] *= 2.0
    found = rank_condition(C, G)
    assert (found.holds, found.rank) == (False, 1)
    # d1 + 2 d2 is felt, so (-2, 1) is not; d3 moves a state that no output reads
    np.testing.assert_allclose(C @ G @ found.hidden, np.zeros((2, 2)), atol=1e-12)
    assert np.linalg.matrix_rank(found.hidden) == 2


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_rank_does_not_depend_on_units(unit):
    C, G = np.array([[unit, 0.0], [0.0, 1.0]]), np.array([[1.0, 1.0], [0.0, 1 / unit]])
    assert rank_condition(C, G).holds
    assert not rank_condition(C[:1], G).holds


def test_the_bias_of_a_projection():
    """Projections in the metric of cov, their mean over 200 000 draws of one active set."""
    rng = np.random.default_rng(4)
    cov = covariance(rng, 3)
    rows, bound, truth = rng.normal(size=(2, 3)), rng.normal(size=2), rng.normal(size=3)
    draws = truth + rng.normal(size=(200_000, 3)) @ np.linalg.cholesky(cov).T
    weight = np.linalg.inv(cov)
    kkt = np.block([[weight, rows.T], [rows, np.zeros((2, 2))]])
    right = np.hstack([draws @ weight, np.tile(bound, (len(draws), 1))])
    errors = truth - np.linalg.solve(kkt, right.T).T[:, :3]
    # five standard errors of the mean
    margin = 5 * np.sqrt(np.max(np.linalg.eigvalsh(cov)) / len(draws))
    np.testing.assert_allclose(bias(cov, rows, bound, truth), errors.mean(0), atol=margin)
    on_the_face = truth + np.linalg.pinv(rows) @ (bound - rows @ truth)
    np.testing.assert_allclose(bias(cov, rows, bound, on_the_face), np.zeros(3), atol=1e-12)


def test_one_step_is_the_unknown_input_filter():
    """Algorithm 1 as printed, + Q in line 9, against the joint estimate of state and attack."""
    for seed in range(3):
        A, G, C, Q, R, rng = random_case(seed)
        m, P = model(A, G, C, Q=Q, R=R), covariance(rng, 4)
        estimator = unknown_input.build(quiet_plant(A=A, G=G, C=C, Q=Q, R=R), np.zeros(4), P)
        log = np.zeros((5, 0)), np.zeros((5, 3)), np.ones((5, 3), bool)
        wanted = estimates(estimator, *log).x_cov
        for k in range(5):
            P = care_step(m, P).P
            # two algorithms, covariances of size 1e2 at most, condition numbers to 1e3
            np.testing.assert_allclose(P, wanted[k], rtol=1e-9, atol=1e-9 * np.abs(P).max())


def statements(found):
    return {s.name: s for s in (*found.assumptions, *found.claims)}


def test_constants_that_hold_bound_the_error():
    """The exact second moment of the error of the steady filter, from any start, stays below
    a exp(-b k) E|e_0|^2 + c_x; and delta is not larger than it must be."""
    settled = 0
    for seed in range(5):
        A, G, C, Q, R, rng = random_case(seed)
        m = model(A, G, C, Q=Q, R=R)
        found = stability(m, np.eye(4), np.zeros((0, 4)))
        if found.holding is None:
            continue  # a random zero outside the unit circle: the recursion grows
        settled += 1
        step, bound = care_step(m, found.P), found.holding
        assert 0 < bound.delta < 1
        spread = 1e4 * covariance(rng, 4)
        start = np.trace(spread)
        for k in range(1, 60):
            spread = step.loop @ spread @ step.loop.T + step.noise
            allowed = bound.a * np.exp(-bound.b * k) * start + bound.c_x
            assert np.trace(spread) <= allowed * (1 + 1e-9)
        # V itself: one step from the worst direction is exactly delta V + c
        white = np.linalg.cholesky(found.P)
        factor = np.linalg.solve(white, step.loop @ white)
        np.testing.assert_allclose(np.linalg.norm(factor, 2) ** 2, bound.delta, rtol=1e-8)
    assert settled >= 2


def test_the_printed_constants_and_what_they_rest_on():
    """The paper's vehicle at 18.8 m/s with its limits on x, y and speed."""
    v, step = 18.8, 0.01
    A = np.eye(4)
    A[0, 3], A[1, 2] = step, v * step
    G = np.array([[0, 0], [v * step, 0], [v * step / 1.5, 0], [0, step]])
    m = model(
        A, G, np.eye(4),
        Q=np.diag([0.1, 0.1, 0.001, 0.0001]), R=np.diag([0.01, 0.01, 0.001, 0.00001]),
    )  # fmt: skip
    rows = np.kron(np.eye(4)[[0, 1, 3]], [[1.0], [-1.0]])
    found = stability(m, np.eye(4), rows)
    said = statements(found)
    assert all(s.holds is True for s in found.assumptions)
    assert all(type(s.value) in (int, float) for s in (*found.assumptions, *found.claims))
    # (I - G M C) G = 0: its smallest eigenvalue is rounding
    assert not said["Claim 14: Qbar >= q' I with q' > 0"].holds
    assert not said["Claim 14: ||I - gamma B|| = 1"].holds
    assert said["Claim 14: ||I - gamma B|| = 1"].value > 1.0 + 1e-6
    printed = found.printed
    a, g, q, bar = np.linalg.norm(A, 2), np.linalg.norm(G, 2), 1e-4, said["P <= p_bar I"].value
    gains, P = [], np.eye(4)
    for _ in range(200):
        gains.append(care_step(m, P))
        P = gains[-1].P
    largest_M = max(np.linalg.norm(one.M, 2) for one in gains)
    share = q / ((a * (1 + g * largest_M)) ** 2 * bar)
    np.testing.assert_allclose(printed.delta, 1 / (share + 1), rtol=1e-12)
    np.testing.assert_allclose(printed.b, np.log1p(share), rtol=1e-12)
    np.testing.assert_allclose(printed.a, bar / said["P >= p I"].value, rtol=1e-12)
    np.testing.assert_allclose(printed.c_x, printed.c * bar / (1 - printed.delta), rtol=1e-12)
    assert found.holding.delta < printed.delta < 1


def test_a_spherical_projection_has_norm_one():
    m = model(0.5 * np.eye(2), np.zeros((2, 0)), np.eye(2), Q=np.eye(2), R=np.eye(2))
    found = stability(m, np.eye(2), np.array([[1.0, 0.0]]))
    assert statements(found)["Claim 14: ||I - gamma B|| = 1"].holds
    assert statements(found)["Claim 14: Qbar >= q' I with q' > 0"].holds


def test_what_does_not_hold_is_said():
    felt = model(np.eye(2), np.eye(2), np.array([[1.0, 0.0]]))
    assert not statements(stability(felt, np.eye(2), np.zeros((0, 2))))["rank(C G) = nd"].holds
    full = model(0.5 * np.eye(2), np.eye(2)[:, :1], np.eye(2))
    assert not statements(stability(full, np.eye(2), np.eye(2)))["rank(B) < n"].holds
    grows = model(np.diag([0.5, 1.1]), np.eye(2)[:, :1], np.array([[1.0, 0.0]]))
    found = stability(grows, np.eye(2), np.zeros((0, 2)))
    assert (found.printed, found.holding) == (None, None)
    assert not statements(found)["P <= p_bar I"].holds
