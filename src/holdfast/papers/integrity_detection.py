"""INTEGRITY, Sections II and III: what a shift of the residue does to the alarm probability.

The tests are judged by the exact distributions: SciPy's non-central chi-square, and the product's
weighted sums (`numerics.noncentral`) where weights differ.
"""

from collections.abc import Sequence

import numpy as np
from numpy.random import default_rng
from scipy.optimize import root_scalar
from scipy.special import chdtri, chndtr

from holdfast.numerics.noncentral import (
    alpha_chi2,
    largest_shift,
    weighted_noncentral_tail,
)
from holdfast.papers.integrity_systems import EPSILON, ROUNDING, System, drawn, moved
from holdfast.papers.rows import Row, claim

TESTS = [
    (p, level, epsilon)
    for p in (1, 2, 5, 20)
    for level in (0.5, 0.05, 0.0035, 1e-5)
    for epsilon in (0.1, EPSILON)
]
"""Degrees of freedom, false-alarm rate without attack, epsilon."""
LEVELS = (0.65, 0.5, 0.3, 0.1, 0.01)
WEIGHTS = ((1.0, 1.0), (0.5, 1.0), (1.0, 0.5), (0.0, 1.0), (0.2, 0.4, 0.8))


def risen(shift2: float, dof: float, h: float) -> float:
    """By how much the alarm probability rises: SciPy's own distributions."""
    return float(chndtr(h, dof, 0.0) - chndtr(h, dof, shift2))


def theorem_1(tests: Sequence[tuple] = TESTS, off: float = 1.0) -> Row:
    """The rise at alpha, and on which side of epsilon it is beside alpha."""
    gap, sides = 0.0, True
    for p, level, epsilon in tests:
        h = float(chdtri(p, level))
        alpha = off * alpha_chi2(epsilon, p, h)
        gap = max(gap, abs(risen(alpha**2, p, h) / epsilon - 1.0))
        shares = np.linspace(0.01, 3.0, 60) * alpha
        stealthy = np.array([risen(s * s, p, h) <= epsilon for s in shares])
        sides &= bool(np.all(stealthy == (shares <= alpha)))
    return claim(
        "Theorem 1", "alarms rise by epsilon at most if and only if |dz| <= alpha: 32 tests, "
        "largest relative distance of the rise at alpha from epsilon", 0.0, gap,
        gap < 1e-6 and sides, "Shifts from 0.01 to 3 alpha lie on the right side, all of them.",
    )  # fmt: skip


def theorem_1_equal(h: float = 2.0, p: int = 1, room: Sequence[float] = (1e-2, 1e-4, 1e-8)) -> Row:
    """Alpha as epsilon approaches 1 - beta."""
    beta = 1.0 - chndtr(h, p, 0.0)
    found = [alpha_chi2((1.0 - beta) * (1.0 - r), p, h) for r in room]
    settled = found[-1] < 1.05 * found[-2]
    return claim(
        "Theorem 1, epsilon = 1 - beta", "a unique alpha exists for every epsilon <= 1 - beta: "
        "alpha at (1 - 1e-2, 1 - 1e-4, 1 - 1e-8) (1 - beta)", "finite", found, settled,
        "With equality every attack is stealthy and no alpha is the largest: it must be <.",
    )  # fmt: skip


def equation_20(tests: Sequence[tuple] = TESTS, sign: float = 1.0) -> Row:
    """Differences of the distribution function over the non-centrality."""
    lambdas = np.linspace(0.0, 10.0, 101)
    most = -np.inf
    for p, level, _ in tests:
        values = chndtr(float(chdtri(p, level)), p, lambdas)
        most = max(most, sign * float(np.max(np.diff(values) / values[:-1])))
    return claim(
        "(20), F decreases", "F_ncx2(h; p, lambda) decreases in lambda: largest relative change "
        "over a step of 0.1, lambda up to 10", "< 0", most, most < 0.0,
    )  # fmt: skip


def remark_2(tests: Sequence[tuple] = TESTS, beyond: float = 1.001) -> Row:
    """The rise a little above alpha."""
    least = min(
        risen((beyond * alpha_chi2(epsilon, p, h)) ** 2, p, h) / epsilon
        for p, level, epsilon in tests
        for h in [float(chdtri(p, level))]
    )
    return claim(
        "Remark 2", "the two conditions are equivalent, not only the one sufficient: least rise "
        "over epsilon of a shift of 1.001 alpha", "> 1", least, least > 1.0,
    )  # fmt: skip


def corollary_1(count: int = 200, seed: int = 0, factor: float = 1.0) -> Row:
    """Random attacks: stealthy at all steps, or within alpha at all steps."""
    rng, steps, h, epsilon = default_rng(seed), 6, 5.0, 0.02
    wrong = stealthy = 0
    for of in drawn(count, seed):
        p = len(of.C)
        alpha = alpha_chi2(epsilon, p, h)
        half = np.linalg.cholesky(of.S)
        z = rng.normal(size=(steps, p))
        z *= alpha / np.max(np.linalg.norm(z, axis=1)) * rng.uniform(0.9, 1.1)
        residues = moved(of, _attack(of, z @ half.T))[1]
        sizes = np.linalg.norm(np.linalg.solve(half, residues.T), axis=0)
        unseen = all(risen(s * s, p, h) <= epsilon for s in sizes)
        stealthy += unseen
        wrong += unseen != bool(np.all(sizes <= factor * alpha))
    return claim(
        "Corollary 1", "A_k is the set of the attacks with |dz| <= alpha at every step: random "
        "attacks, stealthy ones, those on which the two differ", [count, "some", 0],
        [count, stealthy, wrong], wrong == 0 and 0 < stealthy < count,
    )  # fmt: skip


def _attack(of: System, z: np.ndarray) -> np.ndarray:
    """The a_k that make the residues shift by z."""
    e, found = np.zeros(len(of.A)), []
    for one in z:
        found.append(one - of.C @ of.A @ e)
        e = of.A @ e - of.K @ one
    return np.array(found)


def calm(c: Sequence[float], p: int, h: float) -> float:
    """The alarm rate of the weighted sum without attack."""
    return weighted_noncentral_tail(h, np.asarray(c, float), p, np.zeros(len(c)))


def last_alone(c: Sequence[float], p: int, h: float) -> float:
    """The largest stealthy shift of the last step, the others being 0."""
    return largest_shift(EPSILON, np.asarray(c, float), np.full(len(c), p), h, len(c) - 1)


def under(c: Sequence[float], p: int, h: float, epsilon: float = EPSILON) -> float:
    """Lemma 1's bound as printed."""
    T = len(c)
    return alpha_chi2(epsilon, T * p, h / max(c)) / np.sqrt(T)


def summed_rise(
    c: Sequence[float], p: int, h: float, shifts: Sequence[float] | np.ndarray
) -> float:
    """By how much the alarm probability of the weighted sum rises."""
    kept = np.asarray(c) > 0
    w, s = np.asarray(c)[kept], np.asarray(shifts, float)[kept]
    before = weighted_noncentral_tail(h, w, p, 0.0 * w)
    return weighted_noncentral_tail(h, w, p, s**2) - before


def lemma_1(c: Sequence[float] = (0.0, 1.0), p: int = 1, h: float = 0.2) -> Row:
    """All shifts at the bound."""
    bound = under(c, p, h)
    rise = summed_rise(c, p, h, [bound] * len(c))
    beta = calm(c, p, h)
    return claim(
        "Lemma 1", "shifts within the lower alpha are stealthy, c = (0, 1), p = 1, h = 0.2: alpha, "
        "rise of the alarm probability at it, beta", [None, f"<= {EPSILON}", None],
        [bound, rise, beta], rise <= EPSILON * (1.0 + 1e-6),
        "(26) compares with the alarms of c_max times the sum: those are more, and epsilon on "
        "top of them is not epsilon on top of beta.",
    )  # fmt: skip


def lemma_1_equal(lengths: Sequence[int] = (1, 2, 5, 20), p: int = 2, off: float = 1.0) -> Row:
    """Equal weights, where the printed alpha is the largest there is."""
    gap = 0.0
    for T in lengths:
        h = float(chdtri(T * p, 0.01))
        bound = off * under([1.0] * T, p, h)
        gap = max(gap, abs(risen(T * bound**2, T * p, h) / EPSILON - 1.0))
    return claim(
        "Lemma 1, equal weights", "with equal c_i all shifts at the lower alpha raise the alarms "
        "by just epsilon: largest relative distance", 0.0, gap, gap < 1e-6,
    )  # fmt: skip


def lemma_1_levels(levels: Sequence[float] = LEVELS, bound: float = 0.3) -> Row:
    """The same counterexample by false-alarm rate."""
    rises = [
        summed_rise((0.0, 1.0), 1, h, [under((0.0, 1.0), 1, h)] * 2) / EPSILON
        for h in (float(chdtri(1, level)) for level in levels)
    ]
    harmless = all(rise <= 1.0 for rise, level in zip(rises, levels, strict=True) if level <= bound)
    return claim(
        "Lemma 1, by false-alarm rate", "c = (0, 1), p = 1 at beta = .65, .5, .3, .1, .01: rise "
        "over epsilon, at most 1 for beta up to .3", None, rises, harmless,
        "Not a claim of the paper. The lemma goes wrong only where a test alarms all the time.",
    )  # fmt: skip


def equation_23(cmax: float = 2.0, p: int = 2, T: int = 3, h: float = 12.0) -> Row:
    """T times the square of Lemma 1's alpha against what (23) says it is."""
    ours = T * under([cmax] * T, p, h) ** 2
    printed = alpha_chi2(EPSILON, T * p, h) ** 2
    return claim(
        "(23)", "T alpha^2 with Lemma 1's alpha is alpha^2(epsilon, Tp, h): both for c_max = 2, "
        "T = 3, p = 2, h = 12", "equal", [ours, printed], abs(ours / printed - 1) < ROUNDING,
        "The threshold must be h / c_max, as in (26).",
    )  # fmt: skip


def equation_26(c: Sequence[float] = (0.5, 1.0), p: int = 1, level: float = 0.05) -> Row:
    """The rise of the upper sum's alarms over beta_k where (26) has equality."""
    h = float(np.asarray(_threshold(c, p, level)))
    dof, alpha = len(c) * p, alpha_chi2(EPSILON, len(c) * p, h / max(c))
    upper = 1.0 - chndtr(h / max(c), dof, alpha**2)
    gap = (upper - level) / EPSILON
    return claim(
        "(26)", "alarms of c_max times the sum exceed beta_k by epsilon at most up to alpha: "
        "excess over epsilon at alpha, c = (.5, 1), beta 5 %", 1.0, gap, abs(gap - 1.0) < 1e-3,
        "beta_k must be the upper sum's own alarm rate; then Lemma 1 does not follow.",
    )  # fmt: skip


def _threshold(c: Sequence[float], p: int, level: float) -> float:
    """The quantile of the weighted sum."""

    def off(h: float) -> float:
        return calm(c, p, h) - level

    return float(root_scalar(off, bracket=(1e-6, 200.0 * sum(c))).root)


def lemma_1_corrected(weights: Sequence = WEIGHTS, p: int = 2, off: float = 1.0) -> Row:
    """The shift that, at all steps of the window, raises the sum's alarms by epsilon."""
    rng, most = default_rng(1), 0.0
    for c in weights:
        h = _threshold(c, p, 0.05)

        def gap(a: float, c=c, h=h) -> float:
            return summed_rise(c, p, h, [a] * len(c)) / EPSILON - 1.0

        bound = off * float(root_scalar(gap, bracket=(1e-3, 20.0)).root)
        for _ in range(2):
            shifts = bound * rng.uniform(0.0, 1.0, len(c))
            most = max(most, summed_rise(c, p, h, shifts) / EPSILON)
        most = max(most, summed_rise(c, p, h, [bound] * len(c)) / EPSILON)
    return claim(
        "Lemma 1, corrected", "alpha from the sum's own distribution, all T shifts at it: largest "
        "rise over epsilon of shifts within it, five weightings", "<= 1", most,
        most <= 1.0 + 1e-6, "Such an alpha > 0 always exists, which is all that Theorem 2 needs.",
    )  # fmt: skip


def lemma_2(c: Sequence[float] = (1.0, 1.0), p: int = 1, h: float = 1.0) -> Row:
    """The largest stealthy shift of one step against the printed bound."""
    bound = alpha_chi2(EPSILON, p, h / c[-1])
    last = last_alone(c, p, h)
    beta = calm(c, p, h)
    return claim(
        "Lemma 2", "stealthy shifts are within the upper alpha, c = (1, 1), p = 1, h = 1: alpha, "
        "a stealthy shift of one step alone, beta", [None, "<= alpha", None],
        [bound, last, beta], last <= bound * (1.0 + 1e-9),
        "The last sample's own alarms are fewer than beta_k: epsilon above beta_k is more than "
        "epsilon above them.",
    )  # fmt: skip


def lemma_2_levels(levels: Sequence[float] = LEVELS, bound: float = 0.1) -> Row:
    """The same by false-alarm rate."""
    found = []
    for level in levels:
        h = float(chdtri(2, level))
        found.append(last_alone((1.0, 1.0), 1, h) / alpha_chi2(EPSILON, 1, h))
    harmless = all(x <= 1.0 for x, level in zip(found, levels, strict=True) if level <= bound)
    return claim(
        "Lemma 2, by false-alarm rate", "c = (1, 1), p = 1 at beta = .65, .5, .3, .1, .01: largest "
        "stealthy shift of a step over alpha, at most 1 up to .1", None, found, harmless,
        "Not a claim of the paper.",
    )  # fmt: skip


def lemma_2_corrected(weights: Sequence = WEIGHTS, p: int = 2, off: float = 1.0) -> Row:
    """Shifts just within epsilon, drawn at random, against the largest one of the last step."""
    rng, most = default_rng(2), 0.0
    for c in weights:
        h = _threshold(c, p, 0.05)
        bound = off * last_alone(c, p, h)
        for _ in range(2):
            others = 0.3 * bound * rng.uniform(0.0, 1.0, len(c) - 1)

            def gap(s: float, c=c, h=h, others=others) -> float:
                return summed_rise(c, p, h, [*others, s]) / EPSILON - 1.0

            if gap(0.0) < 0.0:
                last = float(root_scalar(gap, bracket=(0.0, 50.0), xtol=1e-9).root)
                most = max(most, last / bound)
    return claim(
        "Lemma 2, corrected", "alpha of the last step alone by the sum's own distribution: largest "
        "share of it that a step of a stealthy window has", "<= 1", most, 0 < most <= 1.0 + 1e-6,
        "Five weightings, random shifts before it. Finite, which is all that Theorem 2 needs.",
    )  # fmt: skip
