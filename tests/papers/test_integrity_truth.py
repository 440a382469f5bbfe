"""The counterexamples of INTEGRITY derived again, with NumPy and SciPy alone.

Nothing of `holdfast.numerics` or `holdfast.reach` is called here: the rows come in as numbers.
"""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.optimize import brentq, minimize
from scipy.stats import chi2, ncx2, norm

from holdfast.papers import integrity_algorithm as algorithm
from holdfast.papers import integrity_attackable as attackable
from holdfast.papers import integrity_bounded as bounded
from holdfast.papers import integrity_detection as detection
from holdfast.papers import integrity_model as model
from holdfast.papers import integrity_reach as regions
from holdfast.papers import integrity_sprt as sprt
from holdfast.papers.integrity_systems import VEHICLE, Policy, drawn, under

EPSILON = 1e-3


def alpha(p, h, epsilon=EPSILON):
    """Theorem 1's alpha by SciPy's distribution."""

    def gap(a):
        return ncx2.sf(h, p, a * a) - chi2.sf(h, p) - epsilon

    return brentq(gap, 1e-6, 50.0, xtol=1e-12)


def test_lemma_1_by_scipy():
    bound, rise, beta = detection.lemma_1().ours
    # the bound is made for two samples of variance 1, the test looks at the last one alone
    own = alpha(2, 0.2) / np.sqrt(2.0)
    assert bound == pytest.approx(own, rel=1e-8)
    assert beta == pytest.approx(chi2.sf(0.2, 1), rel=1e-10)
    normal = norm.sf(np.sqrt(0.2) - own) + norm.cdf(-np.sqrt(0.2) - own)
    assert rise == pytest.approx(normal - chi2.sf(0.2, 1), rel=1e-7)
    assert rise > 1.7 * EPSILON


def test_lemma_2_by_scipy():
    bound, last, _ = detection.lemma_2().ours
    assert bound == pytest.approx(alpha(1, 1.0), rel=1e-8)
    # equal weights: the sum of two squares is one non-central chi-square
    assert last == pytest.approx(alpha(2, 1.0), rel=1e-7)
    assert last > 1.2 * bound


def test_weighted_lemmas_by_simulation():
    """The alarm probability of a weighted window, by a million draws: three deviations."""
    rng = np.random.default_rng(0)
    c, p, h = np.array([0.2, 0.4, 0.8]), 2, 5.0
    shifts = np.array([0.3, 0.8, 1.2])
    z = rng.normal(size=(1_000_000, 3, p))
    z[..., 0] += shifts
    rate = np.mean(np.sum(c * np.sum(z**2, -1), -1) > h)
    told = detection.summed_rise(c.tolist(), p, h, shifts) + detection.calm(c.tolist(), p, h)
    assert abs(rate - told) < 3.0 * np.sqrt(told * (1 - told) / 1e6)


def test_the_bound_of_the_sum_by_scipy():
    """Directly up to 10^3; at 10^6 by the normal limit, whose terms of order k^-1/2 are 1e-3."""
    ten, thousand, million = sprt.alpha_grows().ours
    assert ten == pytest.approx(alpha(20, 28.4), rel=1e-6)
    assert thousand == pytest.approx(alpha(2000, 2008.4), rel=1e-4)
    k = 2.0e6
    x = 8.4 / np.sqrt(2.0 * k)
    shift = norm.isf(norm.sf(x) + EPSILON)
    assert million == pytest.approx(np.sqrt((x - shift) * np.sqrt(2.0 * k)), rel=2e-3)


def test_what_wald_s_test_lets_pass_by_simulation():
    """The alarm rates with and without the constant shift, by 2000 runs of 1000 steps."""
    total, _ = sprt.lower_threshold().ours
    shift = np.sqrt(total / 10**4)
    rng = np.random.default_rng(1)
    rates = []
    for moved in (0.0, shift):
        g, alarms = np.zeros(2000), 0
        for _ in range(1000):
            z = rng.normal(size=(2000, 2)) + np.array([moved, 0.0])
            g += 0.5 * np.sum(z**2, 1) - 1.0
            alarms += np.sum(g > 4.2)
            g[(g > 4.2) | (g < -4.2)] = 0.0
        rates.append(alarms / 2e6)
    # two rates of 2 %, each good to 1e-4
    assert rates[1] - rates[0] == pytest.approx(EPSILON, abs=4e-4)


def test_the_confidence_of_definition_2_by_simulation():
    rng, inside = np.random.default_rng(2), model.definition_2().ours
    for m, told in zip((0.0, 3.0, 10.0, 100.0), inside, strict=True):
        e = m + rng.normal(size=400_000)
        assert np.mean(e**2 <= m**2 + 9.0) == pytest.approx(told, abs=3e-3)


def steady(A, C, W, R):
    """Gain, innovation and error covariance of the filter."""
    P = solve_discrete_are(A.T, C.T, W, R)
    S = C @ P @ C.T + R
    K = P @ C.T @ np.linalg.inv(S)
    return K, S, (np.eye(len(A)) - K @ C) @ P


def test_the_covariance_of_the_error_by_simulation():
    """(13) on the vehicle: 4000 runs of 100 steps from the filter's own start."""
    A, C, W, R = VEHICLE.A, VEHICLE.C, VEHICLE.W, VEHICLE.R
    K, _, P = steady(A, C, W, R)
    rng = np.random.default_rng(3)
    e = rng.multivariate_normal(np.zeros(2), P, 4000)
    for _ in range(100):
        e = e @ A.T + np.sqrt(W[0, 0]) * rng.normal(size=e.shape)
        z = e @ C.T + np.sqrt(R[0, 0]) * rng.normal(size=e.shape)
        e = e - z @ K.T
    found, said = np.trace(np.cov(e.T)), model.equation_13().paper
    ours = model.equation_13().ours
    assert found == pytest.approx(ours, rel=0.07)  # three deviations of 8000 squares
    assert said > 1.15 * ours


def run(A, C, K, attacks):
    """Shifts of error and residue by (10) and (11)."""
    e, errors, residues = np.zeros(len(A)), [], []
    for attack in attacks:
        z = C @ A @ e + attack(e)
        e = A @ e - K @ z
        errors.append(np.linalg.norm(e))
        residues.append(np.linalg.norm(z))
    return np.array(errors), np.array(residues)


def test_a_repeated_eigenvalue_is_attacked_along_a_combination():
    """A = 1.1 I, C = [1 1; 1 0], sensor 2 alone: the error grows, the residues stay small."""
    A, C = np.diag([1.1, 1.1]), np.array([[1.0, 1.0], [1.0, 0.0]])
    K, _, _ = steady(A, C, np.eye(2), np.eye(2))
    # a_2 keeps the residue at (r, 1) with r what sensor 1 says, which he cannot touch
    errors, residues = run(A, C, K, [lambda e: np.array([0.0, 1.0 - 1.1 * e[0]])] * 150)
    assert np.max(residues) < 3.0
    assert errors[-1] > 1e5
    told, before, after = attackable.theorem_3_each().ours
    assert not told
    assert after > 1e6 * before
    # by symmetry sensor 1 alone is found by the vector (0, 1)
    assert np.linalg.eig(A)[1].tolist() == np.eye(2).tolist()


def test_a_rotation_is_attacked_between_single_authenticated_steps():
    """C = [1 0], every fourth step authenticated: grows; two of four, no more than a few."""
    A, C = np.array([[0.0, -1.0], [1.0, 0.0]]), np.array([[1.0, 0.0]])
    K, _, _ = steady(A, C, np.eye(2), np.eye(1))

    def attack(k):
        # the error is on x_1 after odd steps and on x_2 after the others: pushes along x_1 at odd
        # steps, in the error's own sign, show nothing at the step 0 mod 4, where x_2 is 0 before
        want = {1: 1.0, 3: -1.0}.get(k % 4, 0.0)
        return lambda e: np.array([want - (C @ A @ e)[0]]) if k % 4 else np.zeros(1)

    errors, residues = run(A, C, K, [attack(k) for k in range(400)])
    assert np.max(residues) < 1.0 + 1e-9
    assert errors[-1] == pytest.approx(200 * K[0, 0], rel=1e-9)
    grows, also, other, both = attackable.theorem_4_rotation().ours
    assert min(grows, also) > 15.0
    assert max(other, both) < 3.0


def test_sensors_one_after_the_other_miss_a_rotation():
    """C = I, sensor 1 at 0 mod 4, sensor 2 a step later: the same direction is hidden from both."""
    A, C = np.array([[0.0, -1.0], [1.0, 0.0]]), np.eye(2)
    K, _, _ = steady(A, C, np.eye(2), np.eye(2))

    def attack(k):
        def move(e):
            told = A @ e
            if k % 4 == 0:
                return np.array([0.0, -told[1]])
            if k % 4 == 1:
                return np.array([-told[0], 0.0])
            # at 3 mod 4 push along what step 0 turns into x_2
            return (np.array([1.0, 0.0]) if k % 4 == 3 else np.zeros(2)) - told

        return move

    errors, residues = run(A, C, K, [attack(k) for k in range(400)])
    assert np.max(residues) < 1.0 + 1e-9
    assert errors[-1] > 50 * np.linalg.norm(K, 2)
    before, after = bounded.sensor_wise_general().ours
    assert after > 1.3 * before


def dense(A, C, K, S, free):
    """e_k and whitened residues as rows of the attacks, by impulses through (10) and (11)."""
    T, p = free.shape
    places = np.argwhere(free)
    half = np.linalg.inv(np.linalg.cholesky(S))
    E, Z = np.zeros((T, len(A), len(places))), np.zeros((T, p, len(places)))
    for column, (step, sensor) in enumerate(places):
        e = np.zeros(len(A))
        for k in range(T):
            z = C @ A @ e
            z[sensor] += float(k == step)
            e = A @ e - K @ z
            E[k, :, column], Z[k, :, column] = e, half @ z
    return E, Z


def largest(e, told, bound):
    """The largest norm of e theta over theta' told theta <= bound^2."""
    return bound * np.sqrt(np.linalg.norm(e @ np.linalg.solve(told, e.T), 2))


def test_the_algorithm_stops_too_early():
    """The first three blocks and the sixtieth of the vehicle with loud noise, by impulses."""
    block, error, later = algorithm.terminating().ours
    assert block == 2
    assert error == pytest.approx(1.1985, abs=5e-5)  # erratum 3
    assert later == pytest.approx(1.695, abs=5e-4)
    A, C = algorithm.LOUD.A, np.eye(2)
    K, S, _ = steady(A, C, 3.1966 * np.eye(2), 0.03 * np.eye(2))
    found = []
    for blocks in (1, 2, 3):
        t = 20 * blocks
        free = np.repeat((np.arange(1, t + 1) % 20 != 0)[:, None], 2, 1)
        E, Z = dense(A, C, K, S, free)
        told = np.einsum("tpi,tpj->ij", Z, Z)
        bound = alpha(2 * t, 16.8 + 2 * t)
        k = range(t - 20, t)
        found += [
            bound * np.sqrt(np.linalg.norm(E[i] @ np.linalg.solve(told, E[i].T), 2)) for i in k
        ]
    # the bound falls at first
    assert max(found[:20]) == pytest.approx(error, rel=1e-6)
    assert max(found[20:]) < error


def test_theorem_7_is_not_tight_by_a_general_solver():
    """The sums up to every step bounded: SLSQP on the first 40 steps of the random walk."""
    row = regions.theorem_7_tight(t=40, h=1.0)
    A = C = np.eye(1)
    K, S, _ = steady(A, C, 0.1 * np.eye(1), np.eye(1))
    free = (np.arange(1, 41) != 40)[:, None]
    E, Z = dense(A, C, K, S, free)
    Z = Z[:, 0]
    limits = np.array([alpha(k, 2.0 + k) for k in range(1, 41)])

    def room(x):
        return 1.0 - np.cumsum((Z @ x) ** 2) / limits**2

    def slopes(x):
        return -2.0 * np.cumsum((Z @ x)[:, None] * Z, 0) / limits[:, None] ** 2

    scale = 1.0 / abs(E[0, 0, 0])
    best = minimize(
        lambda x: scale * E[0, 0] @ x, np.zeros(39), jac=lambda x: scale * E[0, 0],
        constraints=[{"type": "ineq", "fun": room, "jac": slopes}], method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )  # fmt: skip
    assert best.success
    said, exact = row.ours
    assert -best.fun / scale == pytest.approx(exact, rel=1e-4)
    assert said > 1.5 * exact


def test_a_per_step_bound_in_the_sum_s_recursion_is_too_small():
    """One attack: residues of alpha in one direction at every step, on the vehicle."""
    K, S, _ = steady(VEHICLE.A, VEHICLE.C, VEHICLE.W, VEHICLE.R)
    bound = alpha(2, 8.399)
    for T, told in zip((5, 10, 15), regions.per_step().ours, strict=True):
        E, Z = dense(VEHICLE.A, VEHICLE.C, K, S, np.ones((T, 2), bool))
        toward = np.linalg.cholesky(S).T @ K.T @ [1.0, 0.0]
        z = np.tile(bound * toward / np.linalg.norm(toward), (T, 1))
        attack = np.linalg.solve(Z.reshape(2 * T, -1), z.ravel())
        reached = abs(E[-1, 0] @ attack)
        whole = np.einsum("tpi,tpj->ij", Z, Z)
        by_sum = bound * np.sqrt(E[-1, 0] @ np.linalg.solve(whole, E[-1, 0]))
        assert 1.9 < reached / by_sum <= told + 1e-9


def test_errors_do_not_grow_with_the_distance_of_blocks():
    """Rotation by 18 degrees, f = 2: L = 10 is worse than 14, over the first two blocks already."""
    of = algorithm.SLOW
    worst = {}
    for L in (10, 14):
        blocks = 40 // L
        t = blocks * L + 1
        free = ((np.arange(1, t + 1) < L) | (np.arange(1, t + 1) % L > 1))[:, None]
        K, S, _ = steady(of.A, of.C, 0.1 * np.eye(2), np.eye(1))
        E, Z = dense(of.A, of.C, K, S, free)
        told = np.einsum("tpi,tpj->ij", Z, Z)
        bound = alpha(t, 8.4 + t)
        first = t - L
        worst[L] = max(largest(e, told, bound) for e in E[first:])
        own = under(of, Policy(2, L), blocks, 4.2)[first:]
        sizes = np.sqrt(np.linalg.norm(own, 2, axis=(1, 2)))
        assert worst[L] == pytest.approx(np.max(sizes), rel=1e-6)
    assert worst[10] > 1.1 * worst[14]
    assert algorithm.largest_L().ours == [9, 18]


def test_the_plants_that_are_drawn_are_what_they_say():
    """Eigenvalues, filters that stabilise, and psi and q_un by other means."""
    for of in drawn(40, 99):
        K, S, P = steady(of.A, of.C, of.W, of.R)
        np.testing.assert_allclose(of.K, K, atol=1e-7)
        np.testing.assert_allclose(of.S, S, rtol=1e-6)
        np.testing.assert_allclose(of.P, P, atol=1e-6)
        assert np.max(np.abs(np.linalg.eigvals(of.A - K @ of.C @ of.A))) < 1.0
        assert of.unstable == int(np.sum(np.abs(np.linalg.eigvals(of.A)) > 0.9))
        grams = [of.C.T @ of.C]
        for _ in range(len(of.A) - 1):
            grams.append(of.C.T @ of.C + of.A.T @ grams[-1] @ of.A)
        full = [np.linalg.eigvalsh(g)[0] > 1e-10 for g in grams]
        assert of.observability_index == full.index(True) + 1


def test_the_dense_form_is_lost_where_a_is_unstable():
    """Theta of A = 1.2 in exact arithmetic: its condition grows like A^2k."""
    errors = regions.dense().ours
    assert abs(errors[0]) < 1e-9
    assert abs(errors[-1]) > 0.1  # what rounding leaves of it
    K, S, _ = steady(np.array([[1.2]]), np.eye(1), np.eye(1), np.eye(1))
    _, Z = dense(np.array([[1.2]]), np.eye(1), K, S, np.ones((60, 1), bool))
    assert np.linalg.cond(Z[:, 0]) ** 2 > 1e8
