import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import gammaln, ive
from scipy.stats import chi2, ncx2

from holdfast.numerics.chi_square import (
    bessel_table,
    dof_grid,
    log_ratio,
    sum_quantile,
    weighted_quantile,
    weighted_tail,
)


def exponential_mixture(x, weights):
    """The tail of sum w_i chi2_2 with distinct weights: exponentials."""
    total = 0.0
    for i, w in enumerate(weights):
        factor = np.prod([w / (w - v) for j, v in enumerate(weights) if j != i])
        total += factor * np.exp(-x / (2 * w))
    return total


@pytest.mark.parametrize("dof", [1, 2, 3, 7, 50])
@pytest.mark.parametrize("level", [0.99, 0.5, 0.1, 1e-3, 1e-9, 1e-15])
def test_one_term_is_chi_square(dof, level):
    x = 1.7 * chi2.isf(level, dof)
    assert weighted_tail(x, np.array([1.7]), np.array([dof])) == pytest.approx(level, rel=1e-9)


@pytest.mark.parametrize("x", [0.05, 1.0, 3.0, 5.0, 20.0, 90.0])
def test_distinct_weights_with_two_degrees_of_freedom(x):
    weights = [1.0, 0.55, 0.2, 2.3]
    truth = exponential_mixture(x, weights)
    assert weighted_tail(x, np.array(weights), np.full(4, 2)) == pytest.approx(truth, rel=1e-9)


@settings(max_examples=20)
@given(
    st.lists(st.floats(0.05, 3.0), min_size=1, max_size=5),
    st.sampled_from([0.3, 0.01, 1e-6]),
    st.integers(1, 4),
)
def test_the_quantile_inverts_the_tail(weights, level, dof):
    w, nu = np.array(weights), np.full(len(weights), dof)
    x = weighted_quantile(level, w, nu)
    assert weighted_tail(x, w, nu) == pytest.approx(level, rel=1e-8)
    # scaling the weights scales the quantile
    assert weighted_quantile(level, 3 * w, nu) == pytest.approx(3 * x, rel=1e-9)


def test_unequal_degrees_of_freedom_against_simulation():
    rng = np.random.default_rng(0)
    w, nu = np.array([1.0, 0.4, 0.1]), np.array([1, 3, 2])
    draws = rng.chisquare(nu, (1_000_000, 3)) @ w
    x = weighted_quantile(0.02, w, nu)
    error = np.sqrt(0.02 * 0.98 / len(draws))
    assert np.mean(draws > x) == pytest.approx(0.02, abs=4 * error)  # 4 errors are 2.8 %


def test_the_rate_of_the_papers_cusum():
    """CARE (56) with phi = 0.15, alpha = 0.01, two degrees of freedom: 0.00536, not 0.01."""
    weights = 0.15 ** np.arange(12)
    rate = weighted_tail(chi2.isf(0.01, 2) / 0.85, weights, np.full(12, 2))
    assert rate == pytest.approx(0.00536, abs=5e-6)


def at(quantile, weights, dofs):
    powers = [np.sum(weights * (dofs > 0)), *(np.sum(weights**j * dofs) for j in (1, 2, 3))]
    return float(quantile.at(*(jnp.asarray(float(p)) for p in powers)))


@pytest.mark.parametrize("level", [0.2, 0.01, 1e-6])
def test_equal_weights_are_exact_for_any_degrees_of_freedom(level):
    quantile = sum_quantile(level, np.full(8, 0.7), 3)
    for dofs in ([1, 0, 0, 0, 0, 0, 0, 0], [2, 0, 3, 1, 0, 1, 1, 2], [3] * 8):
        found = at(quantile, np.full(8, 0.7), np.array(dofs))
        assert chi2.sf(found / 0.7, sum(dofs)) == pytest.approx(level, rel=2e-3)


@pytest.mark.parametrize("dof", [1, 2, 5, 30])
def test_unequal_weights_are_exact_at_constant_degrees_of_freedom(dof):
    weights = np.array([0.1, 0.2, 0.5, 1.0, 2.0])
    quantile = sum_quantile(0.01, weights, 30)
    found = at(quantile, weights, np.full(5, dof))
    tail = weighted_tail(found, weights, np.full(5, dof))
    assert tail == pytest.approx(0.01, rel=1e-3)


@pytest.mark.parametrize(
    "dofs", [[2, 0, 2, 0, 2], [0, 0, 0, 0, 2], [2, 2, 2, 0, 0], [1, 2, 1, 2, 1]]
)
def test_missing_samples_with_unequal_weights_stay_near_the_level(dofs):
    """Three moments: within 12 % of the level (worst: 8.4 %), and stated as approximate."""
    weights, dofs = np.array([0.1, 0.2, 0.5, 1.0, 2.0]), np.array(dofs)
    found = at(sum_quantile(0.01, weights, 2), weights, dofs)
    some = dofs > 0
    assert weighted_tail(found, weights[some], dofs[some]) == pytest.approx(0.01, rel=0.12)


def test_the_log_ratio_is_that_of_the_densities():
    table = bessel_table(20)
    for dof in (1, 2, 3, 8, 20):
        for shift in (0.2, 1.0, 3.0):
            for s in (1e-3, 0.4, 5.0, 60.0):
                truth = ncx2.logpdf(s, dof, shift**2) - chi2.logpdf(s, dof)
                found = log_ratio(table, jnp.asarray(s), jnp.asarray(dof), jnp.asarray(shift))
                assert float(found) == pytest.approx(truth, abs=1e-6)


@pytest.mark.parametrize("dof", [1, 2, 9, 20])
def test_the_log_ratio_beyond_its_table(dof):
    s, shift, v = 1e4, 2.0, dof / 2 - 1
    x = shift * np.sqrt(s)
    truth = gammaln(v + 1) - v * np.log(x / 2) + np.log(ive(v, x)) + x - shift**2 / 2
    found = log_ratio(bessel_table(20), *map(jnp.asarray, (s, dof, shift)))
    assert float(found) == pytest.approx(truth, abs=5e-3)


def test_no_degrees_of_freedom_carry_no_information():
    found = log_ratio(bessel_table(2), jnp.asarray(0.0), jnp.asarray(0), jnp.asarray(1.0))
    assert float(found) == 0.0


def test_the_grid_of_degrees_of_freedom_covers_its_range():
    assert dof_grid(0).tolist() == [1.0]
    assert dof_grid(3).tolist() == [1.0, 2.0, 3.0]
    assert dof_grid(136)[-1] == 136.0
    assert len(dof_grid(136)) <= 20
