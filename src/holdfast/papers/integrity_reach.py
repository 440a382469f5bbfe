"""INTEGRITY, Section V-A: the matrices of (44) to (61), the regions, and what they leave out."""

from collections.abc import Sequence

import numpy as np
from numpy.random import default_rng
from scipy.special import chdtrc

from holdfast.numerics.noncentral import alpha_chi2
from holdfast.numerics.quadratic_reach import largest
from holdfast.numerics.stealth import Stealth
from holdfast.papers.integrity_systems import (
    EPSILON,
    ROUNDING,
    VEHICLE,
    Policy,
    System,
    alpha,
    drawn,
    ellipsoids,
    forwards,
    maps,
    moved,
    norms,
    step,
    sure,
    theta,
    under,
)
from holdfast.papers.rows import Row, claim
from holdfast.reach.bounds import reach
from holdfast.reach.setting import Setting, Watched
from holdfast.records import Enforcement

H = 4.2
SCALAR = sure([[1.0]], [[1.0]], 0.1, 1.0)
"""A random walk."""
POLICY = Policy(2, 4)


def cases(count: int, seed: int, T: int = 9) -> list[tuple[System, np.ndarray]]:
    """Random plants and what can be altered over T steps: random sensors, `POLICY`."""
    rng, found = default_rng(seed), []
    for of in drawn(count, seed):
        can = rng.random(len(of.C)) < 0.7
        can[rng.integers(len(can))] = True
        found.append((of, POLICY.free(T, len(can)) & can))
    return found


def equation_44(count: int = 20, off: float = 0.0) -> Row:
    """(44) and (45) against (10) and (11)."""
    rng, worst = default_rng(30), 0.0
    for of, free in cases(count, 30):
        a = rng.normal(size=free.shape) * free
        M, N = maps(of, free)
        e, z = moved(of, a)
        chosen = (1.0 + off) * a[free]
        worst = max(worst, float(np.max(np.abs(M @ chosen + e))))
        worst = max(worst, float(np.max(np.abs(N @ chosen - z))))
    return claim(
        "(44), (45)", "de_k = -M_k a and dz_k = N_k a, with columns of what can be altered alone: "
        "largest difference from (10), (11)", 0.0, worst, worst < 1e-8,
    )  # fmt: skip


def equation_48(count: int = 20, off: float = 0.0) -> Row:
    """The norm by Theta_k against the sum of the residues."""
    rng, worst = default_rng(31), 0.0
    for of, free in cases(count, 31):
        a = rng.normal(size=free.shape) * free
        z = moved(of, a)[1]
        summed = float(np.sum(z * np.linalg.solve(of.S, z.T).T))
        chosen = a[free]
        norm = (1.0 + off) * float(chosen @ theta(of, maps(of, free)[1]) @ chosen)
        worst = max(worst, abs(norm / summed - 1.0))
    return claim(
        "(48), (49)", "the squared norm of the attack by Theta_k is the sum of dz'Q^-1 dz: largest "
        "relative difference", 0.0, worst, worst < ROUNDING,
    )  # fmt: skip


def lemma_4(count: int = 50, seed: int = 32, moved_by: float = 0.0) -> Row:
    """The least eigenvalue of every Theta_k."""
    least = np.inf
    for of, free in cases(count, seed):
        N, counts = maps(of, free)[1], np.cumsum(np.sum(free, 1))
        for k in range(1, len(free) + 1):
            own = theta(of, N[:k, :, : counts[k - 1]]) - moved_by * np.eye(counts[k - 1])
            least = min(least, float(np.linalg.eigvalsh(own)[0]))
    return claim(
        "Lemma 4", "Theta_k is positive definite: its least eigenvalue over random plants, subsets "
        "of their sensors, f = 2, L = 4, k = 1 to 9", "> 0", least, least > 0.0,
        "With K empty, or all steps up to k authenticated, it has no rows and says nothing.",
    )  # fmt: skip


def dense(A: float = 1.2, steps: Sequence[int] = (20, 60, 100)) -> Row:
    """(59) as printed without enforcement, against its closed form: W_k = K^2 Q sum A^2j."""
    of, errors, least = sure([[A]], [[1.0]]), [], 0.0
    for k in steps:
        M, N = maps(of, np.ones((k, 1), bool))
        told = theta(of, N)
        Y = (M[-1] @ np.linalg.inv(told) @ M[-1].T)[0, 0]
        exact = of.K[0, 0] ** 2 * of.S[0, 0] * sum(A ** (2 * j) for j in range(k))
        errors.append(float(Y / exact - 1.0))
        least = float(np.linalg.eigvalsh(told)[0])
    return claim(
        "Section V-A, efficient", "(59) evaluates regions efficiently for any k: relative error of "
        "Y_k in double precision, A = 1.2, no enforcement, k = 20, 60, 100", 0.0, errors,
        abs(errors[-1]) < 1e-3,
        f"Theta_k is p k by p k and its least eigenvalue falls like A^(-2k), to {least:.1g} where "
        "it is lost in rounding, silently. The recursion of the product does not form it.",
    )  # fmt: skip


def product(count: int = 12, seed: int = 33, h: float = H) -> Row:
    """The product's recursion against (59) with the dense Theta_t: one size of plant."""
    ends, worst = POLICY.ends(3), 0.0
    for of in [one for one in drawn(10 * count, seed) if one.A.shape == (2, 2)][:count]:
        p = len(of.C)
        can = np.arange(p) != 1
        T = int(ends[-1])
        names = [[f"{kind}{i}" for i in range(k)] for kind, k in (("x", 2), ("y", p))]
        setting = Setting(
            Watched(of.A, of.C, of.K, of.S, of.P, tuple(names[0]), tuple(names[1])),
            Stealth("sprt", EPSILON, float(chdtrc(p, h)), p),
            can, Enforcement.of([POLICY.L] * p, POLICY.f, POLICY.L), np.eye(2),
        )  # fmt: skip
        shape = reach(setting, T).shape
        for k in range(1, T + 1):
            Y = _printed(of, POLICY.free(T, p) & can, k, int(ends[np.searchsorted(ends, k)]))
            worst = max(worst, float(np.max(np.abs(shape[k - 1] - Y)) / np.max(np.abs(Y))))
    return claim(
        "(59), by recursion", "the product's recursion in O(k n^3) is (59): largest relative "
        "difference from the dense form, random plants and subsets, f = 2, L = 4", 0.0, worst,
        worst < 1e-8, "Not a claim of the paper.",
    )  # fmt: skip


def _printed(of: System, free: np.ndarray, k: int, t: int) -> np.ndarray:
    """(59) without gamma Sigma."""
    M, N = maps(of, free[:t])
    bound = float(alpha(np.array([t]), len(of.C), H)[0])
    return bound**2 * M[k - 1] @ np.linalg.solve(theta(of, N), M[k - 1].T)


def equation_51(
    corrected: bool = False, count: int = 20, off: float = 1.0, plants: Sequence[System] = ()
) -> Row:
    """The printed blocks of Theta~_k against what (50) defines."""
    worst = 0.0
    own_free = [(of, np.ones((3, len(of.C)), bool)) for of in plants]
    for of, free in own_free or cases(count, 34, 3):
        M, N = maps(of, free)
        last = int(np.sum(free[-1]))
        CAM = (of.C @ of.A @ M[-2])[:, : M.shape[2] - last]
        P = np.eye(len(of.C))[:, free[-1]]
        sign = -off if corrected else off
        cross = sign * CAM.T @ np.linalg.solve(of.S, P)
        printed = np.block([
            [CAM.T @ np.linalg.solve(of.S, CAM), cross],
            [cross.T, P.T @ np.linalg.solve(of.S, P)],
        ])  # fmt: skip
        own = N[-1].T @ np.linalg.solve(of.S, N[-1])
        worst = max(worst, float(np.max(np.abs(printed - own)) / np.max(np.abs(own))))
    id, sign = ("(51), minus", "minus") if corrected else ("(51)", "plus")
    return claim(
        id, f"the blocks of Theta~_k, those beside the diagonal with a {sign}: largest relative "
        "difference from N_k'Q^-1 N_k", 0.0, worst, worst < ROUNDING,
        "" if corrected else "N_k is [-CAM_(k-1), I]. Lemma 4 uses the last block alone.",
    )  # fmt: skip


def theorem_7(count: int = 25, seed: int = 35, shrink: float = 1.0) -> Row:
    """Stealthy policy-aware attacks, each all the sums at their bounds, and the region."""
    rng, most = default_rng(seed), 0.0
    ends = POLICY.ends(2)
    T = int(ends[-1])
    horizon = ends[np.searchsorted(ends, np.arange(1, T + 1))]
    for of, free in cases(count, seed, T):
        p, N = len(of.C), maps(of, free)[1]
        Y = ellipsoids(of, free, horizon, H)
        bounds = alpha(np.arange(1, T + 1), p, H)
        for _ in range(20):
            chosen = rng.normal(size=N.shape[2])
            z = N @ chosen
            sums = np.sqrt(np.cumsum(np.sum(z * np.linalg.solve(of.S, z.T).T, 1)))
            chosen = chosen * np.min(bounds[sums > 0] / sums[sums > 0])
            e = -maps(of, free)[0] @ chosen
            inside = [float(x @ np.linalg.pinv(shrink * W) @ x) for x, W in zip(e, Y, strict=True)]
            most = max(most, *inside)
    return claim(
        "Theorem 7", "every error of a stealthy attack is in (53), gamma = 0: largest e'Y_k^-1 e "
        "of random attacks with a sum at its bound", "<= 1", most, 0 < most <= 1.0 + 1e-6,
        "Sound; equality is judged in the next rows.",
    )  # fmt: skip


def theorem_7_tight(of: System = SCALAR, t: int = 100, k: int = 1, h: float = H) -> Row:
    """(61), corrected, against the exact maximum with the sums up to every step bounded."""
    free = Policy(1, t).free(t, len(of.C))
    said = float(norms(ellipsoids(of, free, np.full(t, t), h))[k - 1])
    M, N = maps(of, free)
    bounds = alpha(np.arange(1, t + 1), len(of.C), h)
    half = np.linalg.cholesky(of.S)
    exact = largest(np.linalg.solve(half, N), np.tril(np.ones((t, t))), bounds**2, M[k - 1])
    return claim(
        "Theorem 7, the whole of (47)", "(53) is the region: random walk, first block ends at "
        "t = 100, largest |e_1| by (53), and with (47) at every step", "equal",
        [said, exact.upper], said <= exact.upper * (1.0 + 1e-6),
        "Only the constraint at t is in it, and alpha(k) < alpha(t): an over-approximation.",
    )  # fmt: skip


def per_step(of: System = VEHICLE, steps: Sequence[int] = (5, 10, 15), h: float = 8.399) -> Row:
    """The exact largest position error under the chi-square test, over the one by (59)."""
    p, found = len(of.C), []
    bound = alpha_chi2(EPSILON, p, h)
    for T in steps:
        M, N = maps(of, np.ones((T, p), bool))
        white = np.linalg.solve(np.linalg.cholesky(of.S), N)
        exact = largest(white, np.eye(T), np.full(T, bound**2), M[-1][:1]).upper
        by_sum = bound * np.sqrt(M[-1] @ np.linalg.solve(theta(of, N), M[-1].T))[0, 0]
        found.append(float(exact / by_sum))
    return claim(
        "Theorem 7, chi-square test", "with alpha of the per-step test (59) holds its attacks: "
        "exact largest position error over that, vehicle, k = 5, 10, 15", "<= 1", found,
        max(found) <= 1.0 + 1e-6,
        "That test bounds every residue, not their sum; cone programs bound its errors.",
    )  # fmt: skip


def equation_56(p: int = 2, k: int = 20, t: int = 40, h: float = H) -> Row:
    """Whether the bound at t implies the one at k < t."""
    before, after = alpha(np.array([k, t]), p, h)
    return claim(
        "(56), prior attacks", "the constraint at t implies those before it: alpha(k) and alpha(t) "
        "for k = 20, t = 40, p = 2, h = 4.2", "alpha(t) <= alpha(k)", [before, after],
        bool(after <= before), "An attack that spends alpha(t) by k breaks (47) at k.",
    )  # fmt: skip


def definition_6(of: System = SCALAR, t: int = 200, h: float = H, k: int = 10) -> Row:
    """Regions by (53) with and without a policy that is still to come."""
    free = Policy(1, t).free(t, len(of.C))
    aware = float(norms(ellipsoids(of, free, np.full(t, t), h))[k - 1])
    plain = float(norms(ellipsoids(of, free[:k], np.full(k, k), h))[-1])
    return claim(
        "Definition 6, by (53)", "R^mu is within R: random walk, first block at t = 200, largest "
        "|e_10| by (53) with t = 200, and without the policy, t = 10", "<=", [aware, plain],
        aware <= plain * (1.0 + ROUNDING),
        "True of the definitions. By (53) a later t allows more, as alpha grows.",
    )  # fmt: skip


def equation_60(of: System = VEHICLE, sensor: int = 0, k: int = 1) -> Row:
    """The rank of Y~_k early on."""
    free = np.repeat(np.arange(len(of.C))[None] == sensor, k, 0)
    values = np.linalg.eigvalsh(forwards([step(of, row) for row in free])[-1])
    ratio = float(values[0] / values[-1])
    return claim(
        "(60), gamma = 0", "Y_k is positive definite: vehicle, the position sensor alone attacked, "
        "ratio of the eigenvalues of Y_1", "> 0", ratio, ratio > 1e-12,
        "True with gamma > 0. Otherwise where k |K| < n there is no inverse; the support form "
        "c'Y c needs none.",
    )  # fmt: skip


def corollary_3(
    corrected: bool = False, of: System = VEHICLE, k: int = 10, off: float = 1.0
) -> Row:
    """The largest norm at k by an attack that reaches it, against the formula."""
    policy = Policy(1, 20)
    t = int(policy.ends(1)[0])
    free = policy.free(t, len(of.C))
    M, N = maps(of, free)
    bound = float(alpha(np.array([t]), len(of.C), 8.399)[0])
    told = theta(of, N)
    top = float(np.linalg.eigvalsh(under(of, policy, 1, 8.399)[k - 1])[-1])
    said = np.sqrt(top) if corrected else 1.0 / np.sqrt(top)
    best = np.linalg.svd(M[k - 1] @ np.linalg.inv(np.linalg.cholesky(told)).T)
    attack = np.linalg.solve(told, M[k - 1].T @ best[0][:, 0])
    attack *= bound / np.sqrt(attack @ told @ attack)
    reached = off * float(np.linalg.norm(M[k - 1] @ attack))
    id, name = (
        ("(61), sqrt(lambda_max)", "sqrt(lambda_max)")
        if corrected
        else ("Corollary 3", "1/sqrt(lambda_max), (61),")
    )
    return claim(
        id, f"the largest norm is {name} of Y~_k: that of an attack at the bound of (48), vehicle, "
        "k = 10, t = 20", said, reached, abs(reached / said - 1.0) < 1e-8,
        "Over the attacks that (48) bounds at t alone." if corrected else "It is the root itself.",
    )  # fmt: skip
