"""Truths: the all-positive Poisson series in 40 digits, Ruben's series, and integrals."""

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import chdtr, chdtrc, chdtri, ndtr
from scipy.stats import ncx2

from holdfast.numerics.chi_square import weighted_rise, weighted_tail, weighted_tails
from holdfast.numerics.noncentral import (
    alpha_chi2,
    alphas,
    excess,
    largest_shift,
    tail,
    weighted_noncentral_tail,
)


def poisson_series(shift, dof, threshold):
    """The excess and its derivative over the shift.

    sum_i g_i P(Poisson(l/2) > i), g_i = y^{a+i} e^{-y} / Gamma(a+i+1), all positive.
    """
    with mp.workdps(40):
        a, y, m = mp.mpf(dof) / 2, mp.mpf(threshold) / 2, mp.mpf(shift) ** 2 / 2
        chance = [mp.exp(-m)]
        for j in range(1, int(m + 30 * mp.sqrt(m) + 60)):
            chance.append(chance[-1] * m / j)
        above = [mp.mpf(0)]
        for c in chance[:0:-1]:
            above.append(above[-1] + c)
        g, total, slope = mp.exp(a * mp.log(y) - y - mp.loggamma(a + 1)), mp.mpf(0), mp.mpf(0)
        for i, (c, more) in enumerate(zip(chance, above[::-1], strict=True)):
            total, slope = total + g * more, slope + g * c
            g *= y / (a + i + 1)
        return total, slope * mp.mpf(shift)


def ruben(x, weights, dof, noncentrality, terms=1500):
    """Both tails as a mixture of central chi-squares, all terms positive (Ruben 1962)."""
    w, nu, l2 = (np.asarray(a, float) for a in (weights, dof, noncentrality))
    scale, k = np.min(w), np.arange(1, terms)[:, None]
    rest = 1 - scale / w
    g = rest**k @ nu + k[:, 0] * (rest ** (k - 1) @ (l2 * (1 - rest)))
    mix = np.zeros(terms)
    mix[0] = np.exp(-0.5 * l2.sum() + 0.5 * nu @ np.log(scale / w))
    for i in range(1, terms):
        mix[i] = g[:i][::-1] @ mix[:i] / (2 * i)
    assert mix.sum() == pytest.approx(1.0, abs=1e-12)
    dofs = nu.sum() + 2 * np.arange(terms)
    return mix @ chdtrc(dofs, x / scale), mix @ chdtr(dofs, x / scale)


def thresholds(dof):
    """Quantiles, and the SPRT's 2h + dof."""
    return [*(float(chdtri(dof, level)) for level in (1e-6, 0.01, 0.5)), dof + 2.0, dof + 40.0]


def check_alpha(dof, threshold, epsilon):
    shift = alpha_chi2(epsilon, dof, threshold)
    truth, slope = poisson_series(shift, dof, threshold)
    # how far the shift is from the root, relative to itself
    assert abs(float((truth - mp.mpf(epsilon)) / (shift * slope))) < 1e-10
    assert abs(float(mp.mpf(excess(shift**2, dof, threshold)) / truth - 1)) < 1e-12


@pytest.mark.parametrize("dof", [1, 2, 5, 79, 80, 100, 1e4, 1e6])
@pytest.mark.parametrize("epsilon", [1e-8, 1e-3, 0.5])
def test_alpha_solves_theorem_1_to_ten_digits(dof, epsilon):
    for threshold in thresholds(dof)[:: 2 if dof < 1e5 else 4]:
        if epsilon < chdtr(dof, threshold) * 0.99:
            check_alpha(dof, threshold, epsilon)


@pytest.mark.slow
@pytest.mark.parametrize("dof", [1, 1.5, 3, 10, 79.5, 81, 317, 1e3, 3e4, 1e5, 1e6])
@pytest.mark.parametrize("epsilon", [1e-8, 1e-5, 1e-3, 0.1, 0.3, 0.5])
def test_alpha_over_a_larger_grid(dof, epsilon):
    for threshold in thresholds(dof):
        if epsilon < chdtr(dof, threshold) * 0.99:
            check_alpha(dof, threshold, epsilon)


@pytest.mark.parametrize(
    ("shift", "dof", "threshold"),
    [(1, 1, 1400), (0.01, 1, 1300), (30, 3, 2000), (5, 1e3, 3e3), (80, 1e6, 1.05e6)],
)
def test_a_tail_as_small_as_1e_300_keeps_its_digits(shift, dof, threshold):
    truth, _ = poisson_series(shift, dof, threshold)
    central = mp.gammainc(mp.mpf(dof) / 2, mp.mpf(threshold) / 2, mp.inf, regularized=True)
    found = tail(shift**2, dof, threshold)
    assert abs(float(mp.mpf(found) / (truth + central) - 1)) < 1e-12


@pytest.mark.parametrize(
    ("shift", "dof", "threshold"),
    [
        (100, 5, 200),
        (50, 2, 1e-6),
        (45, 1e3, 900),
        (1e-8, 4, 3),
        (1, 1e10, 1e10 + 7e5),
        pytest.param(300, 1e6, 1.09e6, marks=pytest.mark.slow),
    ],
)
def test_excess_far_beyond_the_threshold_and_next_to_nothing(shift, dof, threshold):
    truth, _ = poisson_series(shift, dof, threshold)
    assert abs(float(mp.mpf(excess(shift**2, dof, threshold)) / truth - 1)) < 1e-12


@pytest.mark.parametrize("threshold", [1e-4, 1.0, 30.0, 1e6])
@pytest.mark.parametrize("beyond", [-5.0, 0.0, 4.0])
def test_one_degree_of_freedom_is_a_normal_variable(threshold, beyond):
    root = np.sqrt(threshold)
    shift = abs(root + beyond)
    truth = ndtr(shift - root) + ndtr(-shift - root)
    assert tail(shift**2, 1, threshold) == pytest.approx(truth, rel=2e-12)


def test_tails_agree_with_scipy():
    for dof in (1, 2, 7, 40, 90):
        for l2 in (0.1, 3.0, 50.0):
            for x in (0.5 * dof, dof + 1.0, dof + l2 + 9.0):
                assert tail(l2, dof, x) == pytest.approx(ncx2.sf(x, dof, l2), rel=1e-9)
        assert tail(0.0, dof, 3.0) == chdtrc(dof, 3.0)


@settings(max_examples=15)
@given(
    st.floats(1.0, 1e5),
    st.floats(1e-6, 0.99),
    st.floats(1e-6, 0.999),
    st.floats(1.001, 3.0),
)
def test_the_bound_rises_with_epsilon_and_the_tail_with_the_shift(dof, level, share, more):
    threshold = float(chdtri(dof, level))
    epsilon = share * float(chdtr(dof, threshold))
    shift = alpha_chi2(epsilon, dof, threshold)
    assert shift > 0
    assert excess(shift**2, dof, threshold) == pytest.approx(epsilon, rel=1e-10)
    assert alpha_chi2(epsilon / more, dof, threshold) < shift
    assert excess((shift / more) ** 2, dof, threshold) < epsilon
    assert tail(shift**2, dof, threshold * more) < tail(shift**2, dof, threshold)


def test_the_bound_next_to_what_there_is():
    """A rise of all but 1e-9 of the room: nothing but certain detection."""
    room = float(chdtr(2, 9.0))
    shift = alpha_chi2(room * (1 - 1e-9), 2, 9.0)
    assert 7.0 < shift < 9.0 + 6.0
    assert ncx2.cdf(9.0, 2, shift**2) == pytest.approx(1e-9 * room, rel=1e-5)


def test_a_threshold_that_noise_never_reaches():
    """A false alarm rate that is 0 in any float: the shift alone decides."""
    for dof, threshold in ((3, 2000.0), (1e3, 4e3)):
        shift = alpha_chi2(0.3, dof, threshold)
        truth, slope = poisson_series(shift, dof, threshold)
        assert abs(float((truth - mp.mpf(0.3)) / (shift * slope))) < 1e-10


def test_a_sequence_is_solved_entry_by_entry():
    rng = np.random.default_rng(3)
    dof = 2.0 * np.arange(1, 1201)
    rough = chdtri(dof, rng.uniform(1e-6, 0.5, len(dof)))
    for thresholds_, epsilon in ((dof + 8.4, 1e-3), (rough, 0.2)):
        found = alphas(epsilon, dof, thresholds_)
        for i in [0, 1, 38, 39, 40, 41, *rng.choice(1200, 15)]:
            assert found[i] == pytest.approx(alpha_chi2(epsilon, dof[i], thresholds_[i]), rel=2e-11)
    # the order of the entries does not matter, nor that some are equal
    mixed = np.concatenate([rng.permutation(1200), rng.permutation(1200)])
    assert np.allclose(alphas(0.2, dof[mixed], rough[mixed]), found[mixed], rtol=2e-11, atol=0)
    assert alphas(0.2, np.zeros(0), np.zeros(0)).shape == (0,)


@pytest.mark.slow
@pytest.mark.parametrize("epsilon", [1e-8, 1e-3, 0.3])
def test_a_hundred_thousand_steps_of_the_sprt(epsilon):
    dof = 2.0 * np.arange(1, 100_001)
    found = alphas(epsilon, dof, dof + 8.4)
    for i in [0, 7, 50, 999, 31_622, 99_999]:
        truth, slope = poisson_series(found[i], dof[i], dof[i] + 8.4)
        assert abs(float((truth - mp.mpf(epsilon)) / (found[i] * slope))) < 1e-10


def test_the_bound_of_the_sprt_grows_without_limit():
    """INTEGRITY (47), epsilon = 0.001, h = 4.2, p = 2: 0.18, 0.40, 2.24, like k^{1/4}."""
    t = np.array([10.0, 1e3, 1e6, 1e8])
    found = alphas(1e-3, 2 * t, 2 * t + 8.4)
    assert np.round(found[:3], 2).tolist() == [0.18, 0.40, 2.24]
    assert found[3] / found[2] == pytest.approx(10**0.5, rel=1e-2)


def test_the_statistic_of_the_sprt_has_no_false_alarm_level():
    """P(chi2_kp > kp + 2h) without attack, h = 4.2, p = 2: .10, .33, on to 1/2."""
    k = np.array([10.0, 100.0, 1e8])
    found = [tail(0.0, 2 * n, 2 * n + 8.4) for n in k]
    assert np.round(found, 2).tolist() == [0.10, 0.33, 0.50]
    assert np.all(np.diff(found) > 0)


@pytest.mark.parametrize(
    ("epsilon", "dof", "threshold", "says"),
    [
        (0.0, 2, 3.0, "not by 0"),
        (-0.1, 2, 3.0, "not by -0.1"),
        (0.78, 2, 3.0, "less than what it leaves, 0.77687"),
        (np.nan, 2, 3.0, "not by nan"),
        (0.1, 0.5, 3.0, "at least 1, not 0.5"),
        (0.1, np.nan, 3.0, "at least 1, not nan"),
        (0.1, 2, 0.0, "positive and finite, not 0"),
        (0.1, 2, np.inf, "positive and finite, not inf"),
    ],
)
def test_arguments_without_an_answer_are_refused(epsilon, dof, threshold, says):
    with pytest.raises(ValueError, match=says):
        alpha_chi2(epsilon, dof, threshold)


def test_other_arguments_without_an_answer():
    with pytest.raises(ValueError, match="one length"):
        alphas(0.1, np.ones(2), np.ones(3))
    with pytest.raises(ValueError, match="at least 0, not -1"):
        excess(-1.0, 2, 3.0)
    with pytest.raises(ValueError, match="at least 0"):
        weighted_noncentral_tail(1.0, [1.0, -1.0], 1.0, 0.0)
    with pytest.raises(ValueError, match="probability rises"):
        largest_shift(0.5, [1.0, 1.0], 1.0, 1.0, 0)  # P(chi2_2 <= 1) = 0.39
    with pytest.raises(ValueError, match="threshold"):
        largest_shift(0.5, [1.0, 1.0], 1.0, 0.0, 0)


@pytest.mark.parametrize("dof", [1, 2, 5, 100, 1e4])
@pytest.mark.parametrize("l2", [0.0, 1e-4, 1.0, 30.0, 1e3])
def test_equal_weights_are_one_noncentral_chi_square(dof, l2):
    for level in (0.99, 0.5, 0.45, 1e-3, 1e-12):
        x = float(chdtri(dof + 3, level))
        truth = tail(l2, dof + 3, x)
        found = weighted_noncentral_tail(0.3 * x, [0.3], [dof + 3], [l2])
        split = weighted_noncentral_tail(
            1.7 * x, [1.7, 0, 1.7], [dof, 2, 3], [0.25 * l2, 9, 0.75 * l2]
        )
        # rounding, of exponents as large as dof and l2
        assert found == pytest.approx(truth, rel=1e-10)
        assert split == pytest.approx(truth, rel=1e-10)
        if l2 > 0:
            rise = weighted_rise(x, np.ones(1), np.array([dof + 3]), np.array([l2]))
            assert rise == pytest.approx(excess(l2, dof + 3, x), rel=1e-10)


@pytest.mark.parametrize("dof", [1e3, 1e4, 1e6])
def test_many_degrees_of_freedom_near_the_mean(dof):
    """Helstrom's parabola, bent by the pole at 0, gave up to 1e65 and no number here."""
    for level in (0.5, 0.4, 0.1):
        x = float(chdtri(dof, level))
        assert weighted_tail(x, np.ones(1), np.array([dof])) == pytest.approx(level, rel=1e-10)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(0.1, 1.0), st.integers(1, 6), st.floats(0.0, 40.0)),
        min_size=1,
        max_size=6,
    ),
    st.sampled_from([-2.0, -0.5, 0.0, 0.3, 2.0, 8.0]),
)
def test_weighted_tails_are_those_of_rubens_series(terms, deviations):
    w, nu, l2 = np.array(terms).T
    mean, deviation = w @ (nu + l2), np.sqrt(2 * w**2 @ (nu + 2 * l2))
    x = max(mean + deviations * deviation, 0.05 * mean)
    assert weighted_tails(x, w, nu, l2) == pytest.approx(ruben(x, w, nu, l2), rel=1e-11)


@pytest.mark.parametrize("x", [0.2, 5.0, 9.0, 60.0])
def test_two_terms_by_integration(x):
    """2 chi'2_3(4) + 0.7 chi2_2: the tail of the second is an exponential."""
    l2, w = mp.mpf(4), mp.mpf("0.7")

    def density(t):
        return mp.exp(-(t + l2) / 2) * mp.sqrt(t) * mp.hyp0f1(1.5, l2 * t / 4) / mp.sqrt(2 * mp.pi)

    x = mp.mpf(x)
    inside = mp.quad(lambda t: density(t) * mp.exp(-(x - 2 * t) / (2 * w)), [0, x / 4, x / 2])
    beyond = mp.quad(density, [x / 2, x / 2 + 8, x / 2 + 30, mp.inf])
    found = weighted_noncentral_tail(float(x), [2.0, 0.7], [3, 2], [4.0, 0.0])
    assert found == pytest.approx(float(inside + beyond), rel=1e-11)


def test_a_heavy_and_a_light_term():
    """A heavy term near its singularity, and a light one that is almost Gaussian."""
    w, nu, l2 = np.array([0.03, 0.0017, 0.0066]), np.array([1.0, 1.0, 3.0]), np.array([0, 368, 0])
    truth = ruben(0.75, w, nu, l2, 4000)
    assert weighted_tails(0.75, w, nu, l2) == pytest.approx(truth, rel=1e-11)


def test_a_window_against_simulation():
    rng = np.random.default_rng(0)
    w, shifts = 0.8 ** np.arange(4), np.array([0.0, 1.5, 0.3, 2.0])
    draws = (rng.standard_normal((400_000, 4)) + shifts) ** 2 @ w
    found = weighted_noncentral_tail(9.0, w, 1, shifts**2)
    error = np.sqrt(found * (1 - found) / len(draws))
    assert np.mean(draws > 9.0) == pytest.approx(found, abs=4 * error)


def test_thresholds_and_weights_at_the_ends():
    assert weighted_noncentral_tail(0.0, [1.0], [1], [0.0]) == 1.0
    assert weighted_noncentral_tail(0.0, [0.0], [1], [2.0]) == 0.0
    assert weighted_noncentral_tail(-1.0, [0.0], [1], [2.0]) == 1.0
    assert largest_shift(0.1, [0.0, 1.0], [1, 1], 4.0, 0) == np.inf
    assert weighted_rise(0.0, np.ones(1), np.ones(1), np.ones(1)) == 0.0


@pytest.mark.parametrize("dof", [1, 2, 5, 100])
@pytest.mark.parametrize("epsilon", [1e-8, 1e-3, 0.4])
def test_the_largest_shift_under_equal_weights_is_alpha(dof, epsilon):
    for level in (1e-6, 0.3):
        x = float(chdtri(2 * dof, level))
        truth = alpha_chi2(epsilon, 2 * dof, x)
        found = largest_shift(epsilon, [0.6, 0.6, 0.0], [dof] * 3, 0.6 * x, 1)
        assert found == pytest.approx(truth, rel=1e-10)


def test_the_largest_shift_of_a_sample_raises_the_alarm_by_epsilon():
    w = 0.7 ** np.arange(5)[::-1]
    before = weighted_noncentral_tail(11.0, w, 2, 0.0)
    shifts = np.array([largest_shift(0.05, w, 2, 11.0, i) for i in range(5)])
    for i, shift in enumerate(shifts):
        after = weighted_noncentral_tail(11.0, w, 2, shift**2 * (np.arange(5) == i))
        assert after - before == pytest.approx(0.05, rel=1e-9)
    assert np.all(np.diff(shifts) < 0)  # the more a sample weighs, the less it can take


def lemma_1_rise(epsilon, c, p, threshold):
    """What the attack that Lemma 1 calls stealthy adds, every sample at its bound."""
    c = np.array(c, float)
    shift2 = alpha_chi2(epsilon, p * len(c), threshold / max(c)) ** 2 / len(c)
    before = weighted_noncentral_tail(threshold, c, p, 0.0)
    return weighted_noncentral_tail(threshold, c, p, shift2) - before


@pytest.mark.parametrize("epsilon", [1e-4, 1e-3, 0.01, 0.09])
def test_lemma_1_fails_at_a_high_rate_of_false_alarms(epsilon):
    """INTEGRITY, Lemma 1: c = (0, 1), T = 2, p = 1, h = 0.2, a false alarm rate of .65.

    Its proof compares with the false alarms of c_max sum |z_i|^2, not of sum c_i |z_i|^2:
    the alarm probability rises by 1.78 to 2.9 epsilon. Right is the largest shift itself.
    """
    assert weighted_noncentral_tail(0.2, [0, 1], 1, 0.0) == pytest.approx(0.6547, abs=1e-4)
    assert lemma_1_rise(epsilon, (0, 1), 1, 0.2) > 1.78 * epsilon
    stated = alpha_chi2(epsilon, 2, 0.2) / np.sqrt(2)
    allowed = largest_shift(epsilon, [0, 1], [1, 1], 0.2, 1)
    assert allowed == pytest.approx(alpha_chi2(epsilon, 1, 0.2), rel=1e-10)
    assert stated > 1.33 * allowed


def test_lemma_1_holds_there_from_a_threshold_of_2_over_pi():
    """For small epsilon: false alarm rates up to .4249. For epsilon = 0.1 up to .3802."""
    for epsilon, threshold, rate in ((1e-6, 2 / np.pi, 0.4249), (0.1, 0.77012, 0.3802)):
        assert chdtrc(1, threshold) == pytest.approx(rate, abs=1e-4)
        assert lemma_1_rise(epsilon, (0, 1), 1, 0.999 * threshold) > epsilon
        assert lemma_1_rise(epsilon, (0, 1), 1, 1.001 * threshold) < epsilon


@pytest.mark.parametrize("epsilon", [1e-4, 1e-3, 0.01, 0.3])
def test_lemma_2_fails_at_a_high_rate_of_false_alarms(epsilon):
    """INTEGRITY, Lemma 2: c = (1, 1), p = 1, h = 1, a false alarm rate of .61.

    A stealthy attack on the last sample alone is 1.26 times the lemma's bound and more: its
    proof takes the false alarms of the whole window for those of the last sample.
    """
    assert weighted_noncentral_tail(1.0, [1, 1], 1, 0.0) == pytest.approx(0.6065, abs=1e-4)
    stated = alpha_chi2(epsilon, 1, 1.0)
    stealthy = largest_shift(epsilon, [1, 1], [1, 1], 1.0, 1)
    assert stealthy > 1.26 * stated


def test_lemma_2_holds_there_from_a_threshold_of_8_over_pi():
    """For small epsilon: false alarm rates up to .2799. For epsilon = 0.1 up to .2579."""
    for epsilon, threshold, rate in ((1e-6, 8 / np.pi, 0.2799), (0.1, 2.71061, 0.2579)):
        assert chdtrc(2, threshold) == pytest.approx(rate, abs=1e-4)
        for factor, holds in ((0.999, False), (1.001, True)):
            stated = alpha_chi2(epsilon, 1, factor * threshold)
            stealthy = largest_shift(epsilon, [1, 1], [1, 1], factor * threshold, 1)
            assert (stealthy <= stated) == holds
