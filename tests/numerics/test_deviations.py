"""A filter as a deviation from one that believes in no attack, against dense least squares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.numerics.blue import whitener
from holdfast.numerics.deviations import after, deviation, inseparable, shortened
from holdfast.numerics.innovations import correction
from oracles import log_normal
from systems import covariance

SMALLEST = (3, 4, 2, 3)
SIZES = [
    SMALLEST,
    *(pytest.param(*s, marks=pytest.mark.slow) for s in [(12, 6, 5, 4), (4, 3, 0, 3)]),
]
"""States, outputs, columns of uncertainty, attacks."""
LAST = 2
"""Attacks that are found now and go on: the last two columns."""


@jax.jit
def found(P, C, R, X, Y, carried):
    """What a bank does with a row, all gains and no measurement."""
    seen = jnp.ones(C.shape[0], bool)
    common = correction(P, C, R, whitener, seen)
    own = deviation(common.white, common.moves, X, Y, carried.shape[0])
    return common, own, after(own.moves, own.root, carried, LAST)


def problem(seed: int, n: int, p: int, z: int, r: int):
    rng = np.random.default_rng(seed)
    P, C, R = covariance(rng, n), rng.normal(size=(p, n)), covariance(rng, p)
    X, F = rng.normal(size=(n, z + r)), rng.normal(size=(p, r))
    X[:, z + r - LAST :] = 0.0  # an attack on the outputs of the row moves no state
    Y = C @ X
    Y[:, z + r - LAST :] = F[:, r - LAST :]
    return P, C, R, X, Y


def least_squares(P, C, R, X, Y, r, nu):
    """x (by how much it moves), delta, their joint covariance, and S + Y_z Y_z'."""
    z = X.shape[1] - r
    whole = P + X[:, :z] @ X[:, :z].T
    S = C @ P @ C.T + R + Y[:, :z] @ Y[:, :z].T
    across = P @ C.T + X[:, :z] @ Y[:, :z].T
    F = Y[:, z:]
    info = F.T @ np.linalg.solve(S, F)
    delta = np.linalg.solve(info, F.T @ np.linalg.solve(S, nu))
    gain = np.linalg.solve(S, across.T).T
    x = gain @ (nu - F @ delta) + X[:, z:] @ delta
    left = X[:, z:] - gain @ F
    spread = np.linalg.inv(info)
    cov = whole - gain @ across.T + left @ spread @ left.T
    return x, delta, np.block([[cov, left @ spread], [spread @ left.T, spread]]), S


@pytest.mark.parametrize(("n", "p", "z", "r"), SIZES)
def test_it_is_least_squares_with_free_attacks(n, p, z, r):
    for seed in range(3):
        P, C, R, X, Y = problem(seed, n, p, z, r)
        common, own, Z = jax.tree.map(np.asarray, found(P, C, R, X, Y, np.ones(r, bool)))
        nu = np.random.default_rng(seed + 50).normal(size=p)
        x, delta, cov, S = least_squares(P, C, R, X, Y, r, nu)
        # what rounding S and the information by eps may do to their inverses
        F = Y[:, z:]
        condition = np.linalg.cond(S) * np.linalg.cond(F.T @ np.linalg.solve(S, F))
        tolerance = 1e-14 * condition
        assert tolerance < 1e-9
        e = common.white @ nu
        scores = own.scores.T @ e
        ours = np.linalg.solve(own.root @ own.root.T, scores[z:])
        np.testing.assert_allclose(ours, delta, rtol=tolerance, atol=tolerance)
        moved = common.moves @ e + own.moves @ np.concatenate([scores[:z], ours])
        np.testing.assert_allclose(moved, x, rtol=tolerance, atol=tolerance)
        left = Z @ Z.T
        left[:n, :n] += common.cov
        kept = np.r_[0:n, n + r - LAST : n + r]
        wanted = cov[np.ix_(kept, kept)]
        size = max(1.0, np.abs(wanted).max())
        np.testing.assert_allclose(left, wanted, rtol=0, atol=tolerance * size)
        assert not np.any(own.unknown)


@pytest.mark.parametrize(("n", "p", "z", "r"), SIZES)
def test_its_determinants_are_those_of_the_densities(n, p, z, r):
    """Of nu with the prior N(0, I) on the attack, and of the part of nu that no attack explains."""
    P, C, R, X, Y = problem(7, n, p, z, r)
    common, own, _ = jax.tree.map(np.asarray, found(P, C, R, X, Y, np.ones(r, bool)))
    nu = np.random.default_rng(8).normal(size=p)
    S, F = least_squares(P, C, R, X, Y, r, nu)[3], Y[:, z:]
    e = common.white @ nu
    scores = own.scores.T @ e
    rest = e @ e - scores[:z] @ scores[:z]
    known = np.linalg.solve(own.prior, scores[z:])
    size = 2 * np.sum(np.log(np.diag(own.prior)))
    evidence = -0.5 * (rest - known @ known + own.log_det + size + common.log_det)
    assert evidence == pytest.approx(log_normal(nu, S + F @ F.T), rel=1e-11)
    basis = np.linalg.svd(F)[0][:, r:]
    free = np.linalg.solve(own.root, scores[z:])
    whole = own.log_det + own.log_free + common.log_det - r * np.log(2 * np.pi)
    ours = -0.5 * (rest - free @ free + whole)
    wanted = log_normal(basis.T @ nu, basis.T @ S @ basis)
    assert ours == pytest.approx(wanted, rel=1e-10, abs=1e-10)


def test_attacks_that_are_not_carried_leave_the_state_uncertain_all_the_same():
    P, C, R, X, Y = problem(3, *SMALLEST)
    every = np.asarray(found(P, C, R, X, Y, np.ones(3, bool))[2])
    one = np.asarray(found(P, C, R, X, Y, np.array([True, False, True]))[2])
    np.testing.assert_array_equal(one[:3], every[:3])
    np.testing.assert_array_equal(one[3], np.zeros(every.shape[1]))
    np.testing.assert_array_equal(one[4], every[4])


separable = jax.jit(inseparable)


def told(F, scale):
    Sigma = (F * scale).T @ (F * scale)
    dependent, unknown = separable(Sigma, np.diag(Sigma))
    return np.flatnonzero(dependent).tolist(), np.flatnonzero(unknown).tolist()


@pytest.mark.parametrize("scale", [1.0, np.array([1e-9, 1e6, 1.0, 1e3])])
def test_which_directions_can_be_told_apart(scale):
    """Of four: none like another, two alike, one the sum of two, one without effect."""
    F = np.random.default_rng(0).normal(size=(5, 4))
    assert told(F, scale) == ([], [])
    F[:, 2] = -3 * F[:, 0]
    assert told(F, scale) == ([2], [0, 2])
    F[:, 2] = F[:, 0] + F[:, 1]
    assert told(F, scale) == ([2], [0, 1, 2])
    F[:, 1], F[:, 2] = 0, F[:, 0]
    assert told(F, scale) == ([1, 2], [0, 1, 2])


def test_directions_alike_but_for_a_little_can_still_be_told():
    """1e-3 of an effect is its own: found; 1e-7: taken for the same."""
    F = np.random.default_rng(1).normal(size=(5, 4))
    own = F[:, 3].copy()
    F[:, 3] = F[:, 0] + 1e-3 * own
    assert told(F, 1.0) == ([], [])
    F[:, 3] = F[:, 0] + 1e-7 * own
    assert told(F, 1.0) == ([3], [0, 3])


def test_an_effect_shared_by_two_attacks_is_free_whichever_of_them_it_is():
    """The second has its prior, the first none: x is as if there were one, wholly free."""
    n, p, z, r = SMALLEST
    P, C, R, X, Y = problem(5, n, p, z, r)
    X[:, z + 1], Y[:, z + 1] = 2 * X[:, z], 2 * Y[:, z]
    common, own, Z = jax.tree.map(np.asarray, found(P, C, R, X, Y, np.ones(r, bool)))
    alone = np.delete(np.arange(z + r), z + 1)
    nu = np.random.default_rng(2).normal(size=p)
    x, _, cov, _ = least_squares(P, C, R, X[:, alone], Y[:, alone], r - 1, nu)
    e = common.white @ nu
    scores = own.scores.T @ e
    delta = np.linalg.solve(own.root @ own.root.T, scores[z:])
    moved = common.moves @ e + own.moves @ np.concatenate([scores[:z], delta])
    np.testing.assert_allclose(moved, x, rtol=1e-10, atol=1e-10)
    spread = common.cov + Z[:n] @ Z[:n].T
    np.testing.assert_allclose(spread, cov[:n, :n], rtol=1e-10, atol=1e-10)
    assert own.unknown.tolist() == [True, True, False]


def test_a_factor_is_shortened_without_loss_or_by_the_least():
    rng = np.random.default_rng(4)
    Z = rng.normal(size=(4, 9))
    for columns in (12, 4):
        kept, lost = jax.jit(shortened, static_argnums=1)(Z, columns)
        assert kept.shape == (4, columns)
        np.testing.assert_allclose(kept @ kept.T, Z @ Z.T, rtol=1e-13, atol=1e-13)
        assert lost == 0
    kept, lost = jax.jit(shortened, static_argnums=1)(Z, 2)
    values = np.linalg.eigvalsh(Z @ Z.T)
    left = np.linalg.eigvalsh(Z @ Z.T - np.asarray(kept @ kept.T))
    # the two smallest of four parts, none of it gained
    np.testing.assert_allclose(left, [0, 0, *values[:2]], rtol=0, atol=1e-13 * values[-1])
    np.testing.assert_allclose(lost, values[:2].sum() / values.sum(), rtol=1e-11)


def test_an_uncertainty_far_beyond_the_noise_is_still_measured():
    """Columns of 1e7 beside noise of 1, in directions that differ by 1e-4 of them: what the row
    leaves of each is near its noise. A relative test of pivots would call the second known.
    """
    n, p, z, r = SMALLEST
    P, C, R, X, Y = problem(6, n, p, z, r)
    X[:, 1] = X[:, 0] + 1e-6 * X[:, 1]
    X[:, :z] *= 1e7
    Y[:, :z] = C @ X[:, :z]
    common, own, Z = jax.tree.map(np.asarray, found(P, C, R, X, Y, np.ones(r, bool)))
    e = common.white @ np.random.default_rng(3).normal(size=p)
    S = np.eye(p) + (common.white @ Y[:, :z]) @ (common.white @ Y[:, :z]).T
    sign, size = np.linalg.slogdet(S)
    assert sign > 0
    # a condition of 1e14 leaves two digits of what the second column alone measures
    assert own.log_det == pytest.approx(size, abs=0.1)
    z_scores = own.scores[:, :z].T @ e
    assert e @ e - z_scores @ z_scores == pytest.approx(e @ np.linalg.solve(S, e), rel=0.1)
    assert np.all(np.isfinite(Z))
