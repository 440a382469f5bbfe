"""DECODER's statements on how many samples see a state: Sections III-C to III-E and IV-A.

All of them are about supports, that is about the decoder that leaves out the fewest samples.
"""

import math
from fractions import Fraction

import numpy as np
from numpy.random import default_rng

from holdfast.controllers.pole_placement import placed
from holdfast.papers.decoder_exact import Case, bound, case, relation, window
from holdfast.papers.rows import Row, claim

POLES = (0.3, 0.5, 0.7, 0.9)
ZERO = 1e-7
"""An entry of C v this small, relative to the largest, is zero."""
NEAR = 1e-6
"""What placing poles is off by."""


def equation_13(found: list[Case], T: int = 1) -> Row:
    """(i) and (ii) of (13) at T = 1."""
    ones = [one.over(T) for one in found]
    both = [(one.together > 2 * one.q, one.fewest > 2 * one.q * T) for one in ones]
    differ = sum(i != ii for i, ii in both)
    return claim(
        "(13)", "(i) and (ii) are one condition at T = 1: systems with it, without it, where the "
        "two differ", ["-", "-", 0],
        [sum(i and ii for i, ii in both), sum(not (i or ii) for i, ii in both), differ],
        differ == 0,
        "|supp(Phi z)| is the sum over the steps by definition.",
    )  # fmt: skip


def equation_13_needed(second: tuple[int, int] = (1, -1)) -> Row:
    """A window on which a decoder exists and (ii) fails; ``second``: the second sensor."""
    one = case([1, 2], [[1, -1], list(second), [1, 1]], 1, 2)
    most = int(np.min(np.max(np.sum(one.seen, 2), 1)))
    return claim(
        "(13), (ii) as a condition for a decoder to exist", "it is needed: A = diag(1, 2), C = "
        "(1 -1; 1 -1; 1 1), T = 2, q = 1: largest step of any z, least |supp(Phi z)|",
        ["> 2 only if", "> 4"], [most, one.fewest], most <= 2 or one.fewest > 4,
        "It is enough (Proposition 2), not needed: every z is seen by three sensors at some step, "
        "where one lie of two states cannot hide. Needed is > 2q at some step.",
    )  # fmt: skip


def lemma_3(found: list[Case], factor: int = 2) -> Row:
    """Unions of supports over T >= n against eigenvectors."""
    tally = np.zeros((2, 2), int)
    for one in found:
        n = len(one.values)
        long = one.over(max(one.T, n))
        tally[int(long.together > 2 * one.q), int(np.min(one.s) > factor * one.q)] += 1
    return _equivalent(
        "Lemma 3", "|union of supp(C A^t z)| > 2q for all z iff |supp(C v)| > 2q: systems with "
        "both, with neither, with one", tally,
        "For fixed sensors. Distinct eigenvalues of any sign would do.",
    )  # fmt: skip


def _equivalent(id: str, what: str, tally: np.ndarray, note: str) -> Row:
    wrong = int(tally[0, 1] + tally[1, 0])
    return claim(
        id, what, ["-", "-", 0], [tally[1, 1], tally[0, 0], wrong],
        wrong == 0 and min(tally[1, 1], tally[0, 0]) > 0, note,
    )  # fmt: skip


def theorem_1(found: list[Case], factor: int = 2) -> Row:
    """(i), (ii) and (iii) at the least T that is allowed."""
    tally, apart = np.zeros((2, 2), int), 0
    for one in found:
        along = one.T * int(np.min(one.s)) > 2 * one.q * one.T
        apart += along != one.guaranteed
        tally[int(one.guaranteed), int(one.fewest > factor * one.q * one.T)] += 1
    tally[0, 1] += apart
    return _equivalent(
        "Theorem 1", "|supp(C v)| > 2q iff |supp(Phi z)| > 2qT for all z, at the least T: systems "
        "with both, with neither, with one", tally,
        "Half of them with sensors that cancel at as many steps as they can. S is a multiset. "
        "Observability follows; C need not have full rank. Where (i) fails, so does (iii), "
        "whatever T is (the bound then has no value). Uniqueness is l0's.",
    )  # fmt: skip


def theorem_1_set(T: int = 1) -> Row:
    """The two-state plant of equal supports; S read as a set leaves T = ``T``."""
    one = case([1, 2], [[1, 1], [1, -1], [1, 2]], 1, T)
    return claim(
        "Theorem 1, S as a set", f"{{3, 3}} is {{3}}, has no two elements and asks nothing of T: "
        f"n = 2, p = 3, q = 1, T = {T}: |supp(Phi z)|, 2qT", [">", 2 * T], [one.fewest, 2 * T],
        one.fewest > 2 * T, "As a multiset it asks for T > 3.",
    )  # fmt: skip


def theorem_1_signs(second: int = -1) -> Row:
    """The same claim with an eigenvalue of the other sign."""
    C = [[1, 1], [1, -1], [1, 1], [1, -1]]
    least = [case([1, second], C, 1, T).fewest - 2 * T for T in (1, 3, 5)]
    return claim(
        "Theorem 1, positive eigenvalues", f"are needed: A = diag(1, {second}), C = (1 1; 1 -1; 1 "
        "1; 1 -1), q = 1: least |supp(Phi z)| - 2qT at T = 1, 3, 5", "<= 0", least, least[-1] <= 0,
        "A sensor can miss a state at every other step.",
    )  # fmt: skip


def proposition_3(found: list[Case], short: bool = False) -> Row:
    """(i) after n steps or more and (ii) after Theorem 1's T; ``short``: after two steps."""
    tally = np.zeros((2, 2), int)
    for one in found:
        T = max(one.T, len(one.values))
        stays, changes = one.over(T), one.over(2 if short else T)
        tally[int(stays.together > 2 * one.q), int(changes.fewest > 2 * one.q * changes.T)] += 1
    return _equivalent(
        "Proposition 3", "the condition for fixed and for changing sensors is one, but for T: "
        "systems with both, with neither, with one", tally, "T of Theorem 1, n at least.",
    )  # fmt: skip


def even(n: int = 8, p: int = 10) -> Row:
    """Theorem 1's bound where all sensors see all eigenvectors."""
    found = [bound([q] * m, q, q // 2 - 1) - Fraction((m - 1) * q, 2) for m in (2, 4, n)
             for q in (4, 6, p)]  # fmt: skip
    return claim(
        "Section III-D, even p", "T > (n - 1) p / 2 if all |supp(C v)| = p and q is largest: "
        "largest difference from Theorem 1's bound", 0.0, float(max(map(abs, found))),
        all(x == 0 for x in found),
        "For odd p it is T > (n - 1) p, twice as much.",
    )  # fmt: skip


ROTATION = np.array([[0.0, -1.0], [1.0, 0.0]])
FOUR = np.array([[1.0, 1.0], [1.0, -1.0], [1.0, 1.0], [1.0, -1.0]])


def complex_pair(A: np.ndarray = ROTATION) -> Row:
    """|supp(Phi z)| - 2 q T of z = (1, 1) over windows of all lengths up to 1000."""
    z, seen, left = np.ones(2), 0, []
    for T in range(1, 1001):
        seen += int(np.sum(np.abs(FOUR @ z) > 1e-9))
        z = A @ z
        z = z / np.max(np.abs(z))
        left.append(seen - 2 * T)
    return claim(
        "Section III-D, complex eigenvalues", "\"the same results apply\": 90-degree rotation, C = "
        "(1 1; 1 -1; 1 1; 1 -1), q = 1: |supp(Phi z)| - 2qT at T = 1, 10, 1000", "> 0 from some T",
        [left[0], left[9], left[999]], left[999] > 0,
        "Re v and Im v are each seen by all four sensors; z = (1, 1) by two at every step, for "
        "ever. The last formula is true and says nothing: its sum grows with T.",
    )  # fmt: skip


def proposition_4(zero: bool = False, count: int = 20) -> Row:
    """Poles and supports; ``zero`` puts a pole where an input does not reach sensor 1."""
    rng, least, off = default_rng(7), 4, 0.0
    for _ in range(count):
        A, B = rng.standard_normal((4, 4)), rng.standard_normal((4, 2))
        C = np.eye(4)[rng.permutation(4)]
        poles, inputs = np.array(POLES), B
        if zero:
            # one input, and the first pole at a zero of what it does to sensor 1
            inputs = B[:, :1]
            poles[0] = _zero(A, inputs, C[:1])
            if not np.isfinite(poles[0]):
                continue
        values, V = np.linalg.eig(A - inputs @ placed(A, inputs, poles))
        off = max(off, float(np.max(np.abs(np.sort_complex(values) - np.sort(poles)))))
        seen = np.abs(C @ V)
        least = min(least, int(np.min(np.sum(seen > ZERO * np.max(seen, 0), 0))))
    return claim(
        "Proposition 4", "G exists that places positive poles and gives |supp(C v)| = p = 4, so "
        "that q = 1: least support, largest error of a pole", [4, 0.0], [least, off],
        least == 4 and off < NEAR,
        "Random plants; Theorem 1 does the rest, for l0. F has the poles where no input reaches a "
        "sensor. Not every G will do: poles alone do not decide with several inputs. The proof's "
        "A_0 + B lacks G.",
    )  # fmt: skip


def _zero(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> float:
    """A real positive zero of C (s I - A)^-1 B with one input and one output; NaN if none."""
    # det(s - A + B C) = det(s - A) (1 + C (s - A)^-1 B)
    numerator = np.poly(A - B @ C) - np.poly(A)
    roots = np.roots(np.trim_zeros(np.where(np.abs(numerator) < 1e-12, 0.0, numerator), "f"))
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.02) & (roots.real < 5.0)]
    real = [r for r in real if min(abs(r - p) for p in POLES[1:]) > 0.05]
    return float(real[0]) if real else math.nan


def relaxed(found: list[Case], more: int = 0) -> Row:
    """Any q T attacked samples: half of the smallest support must be more."""
    good = [one for one in found if one.guaranteed]
    wrong = sum(2 * (one.q * one.T + more) >= one.fewest for one in good)
    return claim(
        "Section III-E, relaxed sum", "any qT samples of the window may be attacked: systems with "
        "Theorem 1's conditions, those where some qT samples beat l0", ["-", 0],
        [len(good), wrong], wrong == 0 and bool(good),
        "l0's least support of Phi z is over 2qT, however the samples are spread. Not so for (12).",
    )  # fmt: skip


def relaxed_alone(T: int = 2) -> Row:
    """A plant and a window where l0 corrects q per step, but not q T anywhere."""
    one = case([1, 2], [[1, -1]] * 5 + [[1, 1]], 2, T)
    steps = np.sum(one.seen, 2)
    certain = int(np.min(np.sum(steps, 1) - 2 * np.sum(np.minimum(one.q, steps), 1)))
    return claim(
        "Section III-E, a decoder that corrects q per step", "corrects qT anywhere: A = diag(1, 2),"
        f" C = 5 x (1 -1) and (1 1), T = {T}, q = 2: l0's margin per step, |supp(Phi z)|, 2qT",
        ["> 0", "> 2qT"], [certain, one.fewest, 2 * one.q * T],
        certain <= 0 or one.fewest > 2 * one.q * T,
        "l0 corrects q at every step iff sum s_t > 2 sum min(q, s_t). The relaxed claim needs "
        "(iii) of Theorem 1; Definition 2 is not enough.",
    )  # fmt: skip


def largest(down: bool = False, blind: int = 0) -> Row:
    """ceil(p/2 - 1), or Section V-C2's floor, against one state seen by all but ``blind``."""
    sensors, true = [3] if down else list(range(2, 13)), []
    for p in sensors:
        seen = case([1], [[int(i >= blind)] for i in range(p)], 0, 1).fewest
        true.append(max(q for q in range(p) if 2 * q < seen))
    told = [(math.floor if down else math.ceil)(p / 2 - 1) for p in sensors]
    id, what = (
        "Section III-E, q_max",
        "is ceil(p/2 - 1): sensors p, that formula, largest q of one state that all see",
    )
    note = "With 2q >= p half of C A^t z at each step makes z of 0: no decoder corrects that."
    if down:
        id, what = (
            "Section V-C2, q_max",
            "is floor(p/2 - 1), 1 for p = 3: that formula, largest q of one state that all see",
        )
        note = "Proposition 4's is the ceiling."
    ours = [told[0], true[0]] if down else [sensors, told, true]
    return claim(id, what, "equal", ours, told == true, note)


def over_q(factor: int = 1) -> Row:
    """All |supp(C v)| over ``factor`` q and not over 2 q."""
    one = case([1, 2], [[1, 0], [1, 0], [0, 1], [0, 1]], 1, 40)
    s = int(np.min(one.s))
    guaranteed = s > factor * one.q
    return claim(
        "Section IV-A, |supp(C v)| > q", "is enough for q = 1: four sensors, two on each mode: "
        "|supp(C v)|, bound, least |supp(Phi z)|, 2qT at T = 40", ["> q", 1, "> 2qT", 80],
        [s, factor, one.fewest, 2 * one.T], (not guaranteed) or one.fewest > 2 * one.T,
        "> 2q, as in Theorem 1 and item 5 of the same section. Section V-B repeats > q.",
    )  # fmt: skip


def at_the_bound(T: int = 35) -> Row:
    """Eight eigenvalues, ten sensors that see them all, each missing z at seven steps of 35."""
    values, rows = list(range(1, 9)), []
    for layer in range(2):
        for k in range(5):
            steps = range(7 * k, 7 * k + 7) if layer else range(k, 35, 5)
            rows.append(relation(values, list(steps)))
    C = np.array(rows, object)
    Phi = window(np.array(values, object), C, T)
    seen = int(np.sum(Phi @ np.ones(8, object) != 0))
    each, unit = int(np.min(np.sum(C != 0, 0))), C.astype(float)
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    full = int(np.linalg.matrix_rank(unit, tol=1e-12))
    return claim(
        "Section IV-B, T = 35", f"Theorem 1 asks for T = 35 (n = 8, p = 10, q = 4): a plant, T = "
        f"{T}: |supp(C v)|, rank of C, |supp(Phi z)|, 2qT", [10, 8, ">", 8 * T],
        [each, full, seen, 8 * T], seen > 8 * T,
        "The bound is strict: 36. Whole numbers, A = diag(1, .., 8), z the sum of all "
        "eigenvectors. So it cannot be lowered, either, for a guarantee.",
    )  # fmt: skip
