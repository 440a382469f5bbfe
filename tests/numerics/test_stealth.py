"""What a detector allows, against enumeration of its windows and against exact probabilities."""

import functools

import numpy as np
import pytest
from scipy.stats import chi2, ncx2

from attackers import alpha
from holdfast.numerics.noncentral import alphas, largest_shift, weighted_noncentral_tail
from holdfast.numerics.stealth import Stealth

WEIGHTS = {
    "equal": (1.0, 1.0, 1.0),
    "one": (2.0,),
    "with a gap": (0.5, 0.0, 0.5, 0.5),
    "fading": (0.2, 0.5, 1.0),
    "fading with gaps": (0.3, 0.0, 0.6, 0.0, 1.0),
    "longer than the attack": (0.1,) * 3 + (0.4,) * 9,
}
CASES = [("chi_square", "equal"), ("sprt", "equal"), *(("windowed", name) for name in WEIGHTS)]


def made(detector, name, level=0.015, epsilon=1e-3, dof=2):
    return Stealth(detector, epsilon, level, dof, WEIGHTS[name])


def counted(stealth, end, last_first):
    """The steps tested at ``end``, by walking back from it; ``last_first``: before the attack."""
    if stealth.detector == "chi_square":
        return [end]
    if stealth.detector == "sprt":
        return list(range(last_first + 1, end + 1))
    steps = zip(range(end, -1, -1), stealth.weights[::-1], strict=False)
    return [i for i, c in steps if c > 0 and i > last_first]


def enumerated(stealth, last, first, blocks, tight):
    """All rows (over the residuals, then over those ahead) and their bounds, as a set."""
    steps = last - first
    found = set()

    def add(real, ahead, end):
        row = np.zeros((steps, 1 + blocks), int)
        for i in real:
            row[i - first - 1, 0] = 1
        for i, j in ahead:
            row[i - first - 1, 1 + j] = 1
        if np.any(row):
            found.add((tuple(row[:, 0]), tuple(row[:, 1:].reshape(-1)), bound(stealth, end)))

    every = stealth.detector != "sprt" or tight
    for end in range(first + 1, last + 1) if every else [last]:
        add(counted(stealth, end, first), [], end)
    for i in range(first + 1, last + 1):
        for j in range(blocks):
            # the residuals of i .. i + j are those of an authenticated block instead
            inside = counted(stealth, i + j, first)
            ahead = [(i, step - i) for step in inside if step >= i]
            add([step for step in inside if step < i], ahead, i + j)
    return found


@functools.cache
def bound(stealth, end):
    end = end if stealth.detector == "sprt" else 1
    return round(float(stealth.alpha(np.array([end]))[0]) ** 2, 8)


def as_set(stealth, limits, steps, blocks):
    rows, found = limits.w.toarray(), set()
    extra = stealth.detector == "windowed" and np.ptp([c for c in stealth.weights if c > 0]) > 0
    rows, b = (x[: len(x) - steps * extra] for x in (rows, limits.b))
    for row, value in zip(rows, b, strict=True):
        assert set(row) <= {0.0, 1.0}
        if np.any(row):
            found.add((tuple(row[:steps].astype(int)), tuple(row[steps:].astype(int)),
                       round(float(value), 8)))  # fmt: skip
    return found


@pytest.mark.parametrize(("detector", "name"), CASES)
@pytest.mark.parametrize(
    ("blocks", "last", "first"), [(0, 1, 0), (0, 7, 0), (0, 9, 4), (1, 5, 0), (3, 8, 2)]
)
def test_the_limits_are_all_windows(detector, name, blocks, last, first):
    for tight in (False, True)[: 1 + (detector == "sprt")]:
        all_windows(made(detector, name), blocks, last, first, tight)


def all_windows(stealth, blocks, last, first, tight):
    limits = stealth.limits(last, first, blocks, tight)
    assert limits.w.shape == (len(limits.b), (last - first) * (1 + blocks))
    found = as_set(stealth, limits, last - first, blocks)
    assert found == enumerated(stealth, last, first, blocks, tight)
    # whatever is not bounded could be anything
    assert np.all(np.sum(limits.w.toarray(), 0) > 0)
    assert np.all(np.isfinite(limits.b))


@pytest.mark.parametrize("epsilon", [1e-3, 0.1])
def test_the_bounds_are_those_of_scipy(epsilon):
    ends = np.array([1, 2, 5, 40])
    for level in (0.015, 0.2):
        h = chi2.isf(level, 2)
        made_ = [made(name, "equal", level, epsilon) for name in ("sprt", "chi_square", "windowed")]
        truth = [alpha(epsilon, 2 * k, 2 * h + 2 * k) for k in ends]
        np.testing.assert_allclose(made_[0].alpha(ends), truth, rtol=1e-8)
        np.testing.assert_allclose(made_[1].alpha(ends), alpha(epsilon, 2, h), rtol=1e-8)
        window = alpha(epsilon, 6, chi2.isf(level, 6))
        np.testing.assert_allclose(made_[2].alpha(ends), window, rtol=1e-8)
        assert made_[0].threshold == pytest.approx(h, rel=1e-12)
        found = alphas(epsilon, 2.0 * ends, 2.0 * h + 2.0 * ends)
        np.testing.assert_allclose(made_[0].alpha(ends), found, rtol=1e-12)


def test_an_attack_at_the_bound_raises_the_alarms_by_epsilon():
    """Theorem 1, and (47) with its threshold 2 h + k p."""
    for detector, dof, threshold in (
        ("chi_square", 2, chi2.isf(0.015, 2)),
        ("windowed", 6, chi2.isf(0.015, 6)),
        ("sprt", 14, 2 * chi2.isf(0.015, 2) + 14),
    ):
        size = made(detector, "equal").alpha(np.array([7]))[0]
        rise = ncx2.sf(threshold, dof, size**2) - chi2.sf(threshold, dof)
        assert rise == pytest.approx(1e-3, rel=1e-7)


def test_the_sum_bounds_more_and_more():
    """It grows like k^(1/4): no bound for ever follows from (48)."""
    stealth = made("sprt", "equal")
    found = stealth.alpha(np.array([10, 10**3, 10**5]))
    assert found[0] < found[1]
    assert found[2] > 2.5 * found[1]


def windows(stealth, squares):
    """The exact alarm probability of every window that ends within the attack or behind it."""
    c = np.array(stealth.weights)
    padded = np.concatenate([np.zeros(len(c) - 1), squares])
    for end in range(len(squares)):
        seen = padded[end : end + len(c)]
        yield weighted_noncentral_tail(stealth.window_threshold, c, stealth.dof, seen)


@pytest.mark.parametrize("name", ["with a gap", "fading"])
def test_no_attack_that_stays_unnoticed_is_left_out(name):
    unnoticed(name, 0.015, steps=4, turns=2)


@pytest.mark.slow
@pytest.mark.parametrize("name", WEIGHTS)
@pytest.mark.parametrize("level", [0.015, 0.2])
def test_no_attack_that_stays_unnoticed_is_left_out_of_others(name, level):
    unnoticed(name, level, steps=7, turns=3)


def unnoticed(name, level, steps, turns):
    """Random attacks at the edge of what the exact probability allows satisfy every limit."""
    stealth, rng, tight = made("windowed", name, level), np.random.default_rng(3), 0.0
    limits = stealth.limits(steps)
    for turn in range(turns):
        squares = rng.exponential(size=steps) * (rng.random(steps) < (0.9, 0.3)[turn % 2])
        squares[rng.integers(steps)] += 1.0
        squares /= np.max(limits.w @ squares / limits.b)
        # beyond the limits by 1 % nothing is unnoticed; with equal weights what is within is
        assert max(windows(stealth, 1.01 * squares)) > level + stealth.epsilon
        quiet = max(windows(stealth, 0.99 * squares)) <= level + stealth.epsilon
        tight = max(tight, float(quiet))
    if len({c for c in stealth.weights if c > 0}) == 1:
        assert tight == 1.0


def test_a_residual_alone_by_the_heaviest_weight_that_meets_it():
    stealth = made("windowed", "fading")
    limits, c = stealth.limits(5), np.array([0.2, 0.5, 1.0])
    alone = [largest_shift(1e-3, c, [2, 2, 2], stealth.window_threshold, i) for i in range(3)]
    assert alone[2] < alone[1] < alone[0]
    # the newest weight is the heaviest, and every residual is once the newest
    np.testing.assert_allclose(limits.b[-5:], alone[2] ** 2, rtol=1e-8)
    backward = Stealth("windowed", 1e-3, 0.015, 2, (1.0, 0.5, 0.2))
    shifts = np.sqrt(backward.limits(5).b[-5:])
    np.testing.assert_allclose(shifts, [*alone[2:] * 3, alone[1], alone[0]], rtol=1e-8)
