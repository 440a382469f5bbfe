"""INTEGRITY, Section IV: why intermittent enforcement bounds the error, and for whom.

Lemma 3 with its proof, Theorems 5 and 6, Corollary 2, and sensors authenticated one after the
other.
"""

from collections.abc import Sequence
from math import comb

import numpy as np
from numpy.random import default_rng
from scipy.linalg import schur

from holdfast.numerics.quadratic_reach import largest
from holdfast.papers.integrity_attackable import (
    PERIODS,
    grows,
    held,
    hidden,
    sizes,
    some,
    unbounded,
)
from holdfast.papers.integrity_systems import (
    QUARTER,
    REAL,
    ROUNDING,
    STABLE,
    TWICE,
    System,
    drawn,
    maps,
    moved,
    null,
    rank,
    rotation,
    sure,
)
from holdfast.papers.rows import Row, claim

IDENTITY = sure(rotation(1.0, np.pi / 2), np.eye(2), values=(1j, -1j))
"""The rotation by 90 degrees with both coordinates measured: psi = 1."""
DOUBLE = sure([[1.0, 1.0], [0.0, 1.0]], [[1.0, 0.0]], values=(1.0, 1.0))
"""A double integrator whose position is measured."""
UNSTABLE = (0, 1, 2, 4, 5, 6, 7, 8, 9)
"""Of the blocks that plants are drawn from."""


def lemma_3(count: int = 40, seed: int = 19, on: bool = True) -> Row:
    """The coordinates along the stable modes, where the error grows; or along all (not ``on``)."""
    most, rising = 0.0, 0
    for of in drawn(count, seed, [UNSTABLE, STABLE]):
        free = np.ones((1, len(of.C)), bool)
        left = np.vstack([null((of.A - z * np.eye(len(of.A))).T).T for z in of.values
                          if abs(z) < 1.0])  # fmt: skip
        rows = np.vstack([np.real(left), np.imag(left)]) if on else np.eye(len(of.A))
        # longer, and the rounding of what grows is larger than what does not
        before, after = sizes(of, free, rows, 20)
        most = max(most, after / before)
        rising += grows(sizes(of, free))
    return claim(
        "Lemma 3", "an unbounded error is unbounded along unstable modes alone: random plants, "
        "those it grows on, growth along stable ones from 20 to 40 steps",
        [count, count, 1.0], [count, rising, most], most < 1.0 + 1e-6 and rising == count,
    )  # fmt: skip


def lemma_3_limit(peaks: int = 50, back: bool = True) -> Row:
    """A = C = 1: up m steps and down again, m = 1, 2, ..; residues of size 1."""
    of = sure([[1.0]], [[1.0]])
    z = np.concatenate([np.repeat([-1.0, 1.0 if back else -1.0], m) for m in range(1, peaks + 1)])
    e = -np.cumsum(of.K[0, 0] * z)
    found = [float(np.max(np.abs(e))), float(abs(e[-1]))]
    return claim(
        "Lemma 3, alpha_i tends to infinity", "an unbounded error has an alpha_i with limit "
        "infinity: A = C = 1, |dz| = 1, largest |alpha| of 2550 steps, and the last", "grows",
        found, found[1] > 0.5 * found[0],
        "The attack goes up ever further and back to 0: the error is unbounded and has no limit. "
        "Unbounded is what Theorem 5 uses.",
    )  # fmt: skip


def equation_67(of: System = QUARTER) -> Row:
    """Coordinates of a real error in the eigenvectors."""
    vectors = np.linalg.eig(of.A)[1]
    along = vectors * np.linalg.solve(vectors, np.eye(len(of.A))[0])
    part = float(np.max(np.abs(np.imag(along))))
    return claim(
        "(67), real coefficients", "alpha_i and phi_i are real and the v_i span R^n: largest "
        "imaginary part along the modes of a rotation", 0.0, part, part < ROUNDING,
        "Of complex pairs they are complex; the moduli of (71) and (73) are bounded all the same.",
    )  # fmt: skip


def equation_69(
    corrected: bool = False, count: int = 20, off: float = 0.0, plants: Sequence[System] = ()
) -> Row:
    """The sum over powers of A against (10)."""
    rng, worst = default_rng(20), 0.0
    for of in plants or drawn(count, 20):
        e, z = moved(of, rng.normal(size=(8, len(of.C))))
        back = np.eye(len(of.A)) if corrected else np.linalg.inv(of.A)
        summed = -sum(
            np.linalg.matrix_power(of.A, j) @ back @ of.K @ z[-1 - j] for j in range(len(z))
        )
        worst = max(worst, float(np.max(np.abs((1.0 + off) * summed - e[-1]))))
    power = "j" if corrected else "j-1"
    return claim(
        f"(69), A^{'j' if corrected else '(j-1)'}", f"the sum of A^({power}) K dz_(k-j) over j = 0 "
        ".. k-1 is the error: largest difference on random plants", 0.0, worst, worst < 1e-7,
        "" if corrected else "(66) is right; (69) to (71) lose a power.",
    )  # fmt: skip


def equation_72(z: complex = 1.1 * np.exp(0.3j), size: int = 4, off: float = 0.0) -> Row:
    """A^j of the last vector of a chain."""
    J, worst = z * np.eye(size) + np.eye(size, k=1), 0.0
    for j in range(12):
        told = np.zeros(size, complex)
        for m in range(min(j, size - 1) + 1):
            told[size - 1 - m] = comb(j, m) * (z + off) ** (j - m)
        worst = max(worst, float(np.max(np.abs(np.linalg.matrix_power(J, j)[:, -1] - told))))
    return claim(
        "(72)", "A^j v_(i+L) is the sum of binom(j, l) lambda^(j-l) v_(i+L-l): largest difference "
        "on a chain of four", 0.0, worst, worst < ROUNDING,
    )  # fmt: skip


def theorem_5(count: int = 200, seed: int = 21, less: int = 0) -> Row:
    """What O_f A leaves of the unstable subspace."""
    lost = wanted = 0
    for of in drawn(count, seed):
        if of.unstable:
            _, basis, *number = schur(of.A, output="real", sort=lambda re, im: re**2 + im**2 > 0.8)
            q = int(number[0])
            powers = [of.C @ np.linalg.matrix_power(of.A, k + 1) for k in range(of.f - less)]
            seen = rank(np.vstack(powers) @ basis[:, :q]) if powers else 0
            lost, wanted = lost + (seen < q), wanted + 1
    return claim(
        "Theorem 5", "CA e_k, .., CA e_(k+f-1) bounded make e_(k+f) bounded: random plants, those "
        "on which O_f A misses some unstable direction", [wanted, 0], [wanted, lost], lost == 0,
    )  # fmt: skip


def projection_vectors(J: np.ndarray = TWICE.A) -> Row:
    """Whether each eigenvalue of a Jordan matrix has one eigenvector."""
    free = [null(J - z * np.eye(len(J))).shape[1] for z in np.diag(J)]
    return claim(
        "Theorem 5, projection vectors", "each eigenvector of a Jordan matrix J_1 is a vector i_j: "
        "dimension of the eigenspaces, J_1 = 1.1 I", 1, free, max(free) == 1,
        "(1, 1) is one as well. The conclusion stands: C v = 0 for any eigenvector of J_1 would "
        "make (A, C) unobservable.",
    )  # fmt: skip


def equation_33(count: int = 20, seed: int = 22, off: float = 0.0) -> Row:
    """(33), the sum that follows it, and (39)."""
    rng, worst, f = default_rng(seed), 0.0, 5
    for of in drawn(count, seed):
        e, z = moved(of, rng.normal(size=(f + 3, len(of.C))))
        k, A = 2, of.A
        power = [np.linalg.matrix_power(A, j) for j in range(f + 1)]
        pushed = sum(power[f - j] @ of.K @ z[k + j] for j in range(1, f))
        left = (1.0 + off) * power[f] @ e[k] - pushed
        worst = max(worst, float(np.max(np.abs(left - A @ e[k + f - 1]))))
        worst = max(worst, float(np.max(np.abs(left - of.K @ z[k + f] - e[k + f]))))
    return claim(
        "(33)", "e_(k+f) = A e_(k+f-1) - K dz_(k+f), and A e_(k+f-1) = A^f e_k - sum A^(f-j) K "
        "dz_(k+j), which is (39): largest difference", 0.0, worst, worst < 1e-7,
    )  # fmt: skip


def equation_40(count: int = 20, seed: int = 23, size: float = 1.0) -> Row:
    """Errors that residues of size 1 or less make, over the bound."""
    rng, most = default_rng(seed), 0.0
    for of in drawn(count, seed):
        z = rng.normal(size=(10, len(of.C)))
        z *= size / np.linalg.norm(z, axis=1, keepdims=True)
        e = rng.normal(size=len(of.A))
        bound = float(np.linalg.norm(e))
        a, k = np.linalg.norm(of.A, 2), np.linalg.norm(of.K, 2)
        for one in z:
            e, bound = of.A @ e - of.K @ one, a * bound + k
            most = max(most, float(np.linalg.norm(e)) / bound)
    return claim(
        "(40)", "|e_j| <= |A|^m |e_t| + sum |A|^(m-l) |K|, m = j - t: largest share of the bound, "
        "random attacks", "<= 1", most, most <= 1.0 + ROUNDING,
    )  # fmt: skip


def theorem_6(count: int = 200, seed: int = 24, aware: bool = False) -> Row:
    """Perfectly attackable plants, and the attacker who does not know the steps."""
    there = bad = 0
    for of in drawn(count, seed):
        free = np.ones((1, len(of.C)), bool)
        if unbounded(of, free):
            there, bad = there + 1, bad + unbounded(of, free, aware)
    return claim(
        "Theorem 6", "f = 1 is enough against one who does not know the steps: perfectly "
        "attackable random plants, those he moves without limit", [there, 0], [there, bad],
        bad == 0,
    )  # fmt: skip


def theorem_6_sizes(of: System = DOUBLE, aware: bool = False) -> Row:
    """The exact largest position error under (30), with |C A e| <= 1 at every step or without."""
    F, p = of.A - of.K @ of.C @ of.A, len(of.C)
    powers = [np.linalg.norm(np.linalg.matrix_power(F, j) @ of.K, 2) for j in range(400)]
    bound, found = 2.0 * float(np.sum(powers)), []
    for T in (10, 20, 40):
        M, N = maps(of, np.ones((T, p), bool))
        limits = N if aware else np.concatenate([N, of.C @ of.A @ M])
        count = len(limits)
        found.append(largest(limits, np.eye(count), np.ones(count), M[-1][:1]).upper)
    return claim(
        "Theorem 6, its bound", "|CA e| <= 1 at every step bounds the error by 2 sum |(A-KCA)^j K|:"
        " double integrator, largest error of it after 10, 20, 40 steps, bound", "settles",
        [*found, bound], found[-1] <= bound and found[2] < 1.02 * found[1],
        "No enforcement is needed for it, the threat is enough. Known steps: it grows on.",
    )  # fmt: skip


def corollary_2(count: int = 150, seed: int = 16, less: int = 0) -> Row:
    """Blocks as long as there are independent unseen unstable eigenvectors."""
    tried = bad = fewer = 0
    for of, can in some(count, seed):
        f = min(of.observability_index, sum(v.shape[1] for v in hidden(of, can).values())) - less
        fewer += f < of.f
        for L in PERIODS:
            if L > f >= 0:
                tried += 1
                bad += unbounded(of, can & held(len(of.C), f, L))
    return claim(
        "Corollary 2", "with q*_un of the eigenvectors with supp(Cv) in K: random plants and L, "
        "those whose error grows; plants where f is smaller than by (31)", [None, 0, "some"],
        [tried, bad, fewer], bad == 0 and fewer > 0,
        "q*_un: independent eigenvectors of whole eigenspaces.",
    )  # fmt: skip


def staggered(p: int, f: int, L: int) -> np.ndarray:
    """Sensor i authenticated at f steps from step i on, every L (L x p)."""
    since = (np.arange(L)[:, None] - np.arange(p)) % L
    return since >= f


def sensor_wise(count: int = 150, seed: int = 17, every: bool = True) -> Row:
    """One unstable eigenvalue, the sensors one after the other."""
    tried = bad = 0
    for of in drawn(count, seed, [REAL, STABLE]):
        for L in PERIODS:
            free = staggered(len(of.C), 1, L)
            free[:, 0] |= not every
            tried, bad = tried + 1, bad + unbounded(of, free)
    return claim(
        "Section IV, 1)", "one unstable eigenvalue, f_i = 1, each sensor one step after the one "
        "before: random plants and L, those whose error grows", [tried, 0], [tried, bad], bad == 0,
    )  # fmt: skip


def sensor_wise_general(of: System = IDENTITY, L: int = 4) -> Row:
    """Theorem 4's f for each sensor, one sensor after the other."""
    found = sizes(of, staggered(len(of.C), of.f, L))
    return claim(
        "Section IV, 1), more unstable eigenvalues", "the result can be generalized, with f of "
        "(31) for each sensor: rotation by 90 degrees, C = I, f_i = 1, L = 4, as above", "bounded",
        found, not grows(found),
        "psi = 1 needs both sensors at one step: one after the other they see the same direction.",
    )  # fmt: skip


def sensor_wise_enough(count: int = 150, seed: int = 18, less: int = 0) -> Row:
    """Per sensor as many steps as there are different unstable eigenvalues."""
    tried = bad = 0
    for of in drawn(count, seed):
        f = len(hidden(of, np.ones(len(of.C), bool))) - less
        for L in PERIODS:
            if L > f >= 0:
                tried += 1
                bad += unbounded(of, staggered(len(of.C), f, L))
    return claim(
        "Section IV, 1), q_un steps each", "as many steps for each sensor as different unstable "
        "eigenvalues: random plants and L, those whose error grows", [tried, 0], [tried, bad],
        bad == 0, "Not a claim of the paper: a generalisation that holds.",
    )  # fmt: skip
