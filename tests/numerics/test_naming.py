"""The channels that a z-test names, against probabilities of independent and correlated normals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from holdfast.detectors.settings import by_dof
from holdfast.numerics.naming import named, sidak

LIMITS = by_dof(sidak(0.01, 6))
DRAWS = 200_000


@pytest.mark.parametrize("m", range(1, 7))
def test_the_budget_is_spent_exactly_by_independent_channels(m):
    limit = float(LIMITS[m])
    inside = (norm.cdf(limit) - norm.cdf(-limit)) ** m
    # rounding of a number near 1, next to 0.01
    assert 1.0 - inside == pytest.approx(0.01, rel=1e-12)


@pytest.mark.parametrize("rho", [0.5, 0.95])
def test_correlated_channels_spend_less(rho):
    box = multivariate_normal(np.zeros(2), np.array([[1.0, rho], [rho, 1.0]]))
    limit = np.full(2, float(LIMITS[2]))
    # scipy's quadrature is good to 1e-5; what is not spent is ten times that
    assert 1.0 - box.cdf(limit, lower_limit=-limit) < 0.0099


def test_names_by_their_probability():
    """Three channels of four active, one undetermined: two are tested, the budget is for two."""
    variance = jnp.array([4.0, jnp.inf, 0.25, 1.0])
    active = jnp.array([True, True, True, False])
    mean = np.array([0.0, 0.0, 1.2, 50.0])
    sd = np.array([2.0, 1.0, 0.5, 1.0])
    d = mean + sd * np.random.default_rng(5).normal(size=(DRAWS, 4))
    found = np.asarray(jax.jit(jax.vmap(lambda d: named(d, variance, active, LIMITS)))(d))
    limit = float(LIMITS[2])
    shift = 1.2 / 0.5
    power = norm.sf(limit - shift) + norm.cdf(-limit - shift)
    wanted = np.array([2.0 * norm.sf(limit), 0.0, power, 0.0])
    # four standard deviations of a binomial share
    assert np.all(np.abs(found.mean(0) - wanted) <= 4 * np.sqrt(wanted * (1 - wanted) / DRAWS))


def test_nothing_is_named_where_nothing_is_tested():
    d = jnp.array([9.0, 9.0])
    none = jnp.zeros(2, bool)
    assert not np.any(named(d, jnp.ones(2), none, LIMITS))
    assert not np.any(named(d, jnp.array([0.0, jnp.inf]), ~none, LIMITS))
