"""INTEGRITY, Sections III-A and IV: which errors can grow without limit, and what stops them.

The truth is the set of errors that attacks of one unit of energy reach, after 200 and 400 steps,
by the plain recursion; where many policies are asked, the product's decision by subspaces.
"""

from collections.abc import Sequence

import numpy as np
from numpy.random import default_rng

from holdfast.numerics.attackable import growth
from holdfast.papers.integrity_systems import (
    QUARTER,
    TWICE,
    System,
    drawn,
    forwards,
    null,
    rank,
    step,
    sure,
)
from holdfast.papers.rows import Row, claim

STEPS = 200
DOUBLE = 1.5
"""Energy reached grows at least in proportion to time where it grows at all."""
PERIODS = range(2, 9)


def sizes(
    of: System, free: np.ndarray, functional: np.ndarray | None = None, steps: int = STEPS
) -> list[float]:
    """The largest error after about ``steps`` and twice as many of a policy ``free`` (L x p)."""
    kinds = [step(of, row) for row in free]
    half = -(-steps // len(kinds)) * len(kinds)
    W = forwards([kinds[k % len(kinds)] for k in range(2 * half)])
    on = np.eye(len(of.A)) if functional is None else functional
    return [float(np.sqrt(np.linalg.norm(on @ W[k] @ on.T, 2))) for k in (half - 1, -1)]


def grows(found: Sequence[float]) -> bool:
    """Whether sizes are those of an error without bound."""
    return found[1] ** 2 > DOUBLE * found[0] ** 2


def held(p: int, f: int, L: int) -> np.ndarray:
    """All sensors authenticated at the first f of L steps: what can be altered (L x p)."""
    return np.repeat((np.arange(L) >= f)[:, None], p, 1)


def unbounded(of: System, free: np.ndarray, aware: bool = True) -> bool:
    """The product's decision."""
    return growth(of.A, of.C, of.K, free, aware=aware).unbounded


def hidden(of: System, can: np.ndarray, modulus: float = 1.0) -> dict[complex, np.ndarray]:
    """Per unstable eigenvalue its whole eigenspace with supp(C v) within ``can`` (p,)."""
    found = {}
    for z in of.values:
        if abs(z) >= modulus - 1e-9 and not any(abs(z - other) < 1e-9 for other in found):
            found[z] = null(np.vstack([of.A - z * np.eye(len(of.A)), of.C[~can]]))
    return found


def reachable(of: System, can: np.ndarray) -> np.ndarray:
    """The states that (10) reaches by the sensors ``can``, as columns."""
    F, found = of.A - of.K @ of.C @ of.A, [of.K[:, can]]
    for _ in range(len(of.A) - 1):
        found.append(F @ found[-1])
    return np.hstack(found)


def some(count: int, seed: int) -> list[tuple[System, np.ndarray]]:
    """Random plants, a random set of sensors attacked on each."""
    rng = default_rng(seed)
    return [(of, rng.random(len(of.C)) < 0.6) for of in drawn(count, seed)]


def theorem_3(count: int = 100, seed: int = 10, modulus: float = 1.0) -> Row:
    """Eigenvectors that are not seen, and reached, against what is reached."""
    attackable = wrong = 0
    for of, can in some(count, seed):
        told = False
        for vectors in hidden(of, can, modulus).values():
            if vectors.shape[1]:
                both = np.hstack([vectors, reachable(of, can)])
                told |= vectors.shape[1] + rank(both[:, vectors.shape[1] :]) > rank(both)
        truth = grows(sizes(of, can[None]))
        attackable, wrong = attackable + truth, wrong + (told != truth)
    return claim(
        "Theorem 3", "perfectly attackable iff an unstable eigenvector v has supp(Cv) in K and is "
        "reached: random plants, attackable ones, those decided wrongly", [count, "some", 0],
        [count, attackable, wrong], wrong == 0 and 0 < attackable < count,
        "Every eigenvector of a repeated eigenvalue has been looked at, defective ones too.",
    )  # fmt: skip


def theorem_3_each(of: System = TWICE, sensor: int = 1) -> Row:
    """One eigenvector for each eigenvalue, as a machine gives them."""
    can = np.arange(len(of.C)) == sensor
    values, vectors = np.linalg.eig(of.A)
    seen = np.abs(of.C @ vectors) > 1e-9
    told = bool(np.any((np.abs(values) >= 1.0) & np.all(~seen | can[:, None], 0)))
    found = sizes(of, can[None])
    return claim(
        "Theorem 3, one eigenvector each", "enough for A = 1.1 I, C = [1 1; 1 0], sensor 2 "
        "attacked: whether one of n qualifies, largest error after 200, 400 steps",
        "they decide", [told, *found], told == grows(found),
        "v = (1, -1) is an eigenvector as well, and sensor 1 does not see it.",
    )  # fmt: skip


def theorem_3_reached(count: int = 300, seed: int = 11, gain: float = 1.0) -> Row:
    """Whether an unseen unstable eigenvector was ever out of reach."""
    there = missed = 0
    for of, can in some(count, seed):
        known = of._replace(K=gain * of.K)
        for vectors in hidden(known, can).values():
            r = vectors.shape[1]
            reach = rank(reachable(known, can)) if np.any(can) else 0
            both = rank(np.hstack([vectors, reachable(known, can)])) if r else 0
            there, missed = there + r, missed + max(0, both - reach)
    return claim(
        "Theorem 3, v reachable", "asking that v be reachable rules something out: unseen unstable "
        "eigenvectors of random plants, those out of reach", [None, "> 0"], [there, missed],
        missed > 0, "One out of reach would be a mode of A - KCA, which is stable.",
    )  # fmt: skip


def arbitrary(A: Sequence[float] = (1.1, 0.5)) -> Row:
    """A perfectly attackable plant, state by state."""
    of, can = sure(np.diag(A), np.eye(2), values=A), np.ones((1, 2), bool)
    found = [sizes(of, can, row[None]) for row in np.eye(2)]
    return claim(
        "Section III-A, arbitrary changes", "in a perfectly attackable plant any change of the "
        "states can be made: largest shift of each after 200, 400 steps, A = diag(1.1, .5)",
        "all grow", [one for pair in found for one in pair], all(map(grows, found)),
        "Only along unseen unstable modes.",
    )  # fmt: skip


def definition_4(corrected: bool = False, of: System = QUARTER, L: int = 4, f: int = 2) -> Row:
    """The steps t_k, t_{k+1}, .. are the starts of blocks; t_k, t_k + 1, .. the blocks."""
    starts = np.arange(0, 10 * L, L)
    steps = {int(s) + j for s in starts for j in range(f)} if corrected else set(starts.tolist())
    free = np.array([[k not in steps] * len(of.C) for k in range(L)])
    found = sizes(of, free)
    index = "t^i_k + 1" if corrected else "t^i_(k+1)"
    return claim(
        f"Definition 4, {index}", f"steps t^i_k, {index}, .. of a sensor make a block of f_i: "
        "rotation by 90 degrees, f_i = 2, L_i = 4, largest error after 200, 400 steps",
        "bounded", found, not grows(found),
        "" if corrected else "As printed only the starts of blocks are authenticated.",
    )  # fmt: skip


def remark_4(f: int = 3, every: Sequence[int] = (1, 2, 3, 4, 5), late: int = 0) -> Row:
    """Steps after t_0 at which something can be altered."""
    shares = []
    for L in every:
        steps = {t + j for t in range(0, 100 * L, L + late) for j in range(f)}
        shares.append(sum(k not in steps for k in range(50 * L)) / (50 * L))
    continuous = [share == 0.0 for share in shares]
    return claim(
        "Remark 4", "L <= f is continuous enforcement: share of the steps after t_0 that can be "
        "altered, f = 3, L = 1 to 5", [0, 0, 0, 0.25, 0.4], shares,
        continuous == [f >= L for L in every],
    )  # fmt: skip


def theorem_4(count: int = 60, seed: int = 12, less: int = 0) -> Row:
    """The f of (31) against what is reached, every sensor attacked."""
    tried = bad = 0
    for of in drawn(count, seed):
        f = max(of.f - less, 0)
        for L in (2, 3, 4, 6):
            if f < L:
                tried += 1
                bad += grows(sizes(of, held(len(of.C), f, L)))
    return claim(
        "Theorem 4", "f = min(psi, q_un) bounds the error: random plants with L = 2, 3, 4, 6, all "
        "sensors attacked, those whose error grows", [tried, 0], [tried, bad], bad == 0,
    )  # fmt: skip


def theorem_4_less(
    count: int = 150, seed: int = 13, distinct: bool = False, less: int | None = None
) -> Row:
    """Policies of f - 1, or as many steps as there are different unstable eigenvalues."""
    less = (0 if distinct else 1) if less is None else less
    tried = fine = fewer = 0
    for of in drawn(count, seed):
        different = len(hidden(of, np.ones(len(of.C), bool)))
        f = (min(of.observability_index, different) if distinct else of.f) - less
        fewer += f < of.f
        for L in PERIODS:
            if (f > 0 or not distinct) and L > f >= 0:
                tried += 1
                fine += not unbounded(of, held(len(of.C), f, L))
    if distinct:
        return claim(
            "Theorem 4, distinct eigenvalues", "q_un may count equal unstable eigenvalues once: "
            "random plants and L, those bounded; plants where f is then smaller",
            [tried, tried, None], [tried, fine, fewer], fine == tried and fewer > 0,
            "Not a claim of the paper; for periodic policies, by eigenvectors of A^L and a "
            "Vandermonde matrix.",
        )  # fmt: skip
    return claim(
        "Theorem 4, f - 1", "f is sufficient, not necessary: random plants and L = 2 to 8, those "
        "that f - 1 bounds as well", None, [tried, fine], 0 < fine < tried,
        "Not a claim of the paper.",
    )  # fmt: skip


def theorem_4_rotation(of: System = QUARTER) -> Row:
    """One and two authenticated steps, where A^4 = I."""
    cases = [sizes(of, held(len(of.C), f, L)) for f, L in ((1, 2), (1, 4), (1, 3), (2, 4))]
    told = [grows(one) for one in cases]
    return claim(
        "Theorem 4, f - 1 on a rotation", "by 90 degrees, C = [1 0]: largest error after 400 steps "
        "with f, L = 1, 2; 1, 4; 1, 3; 2, 4, where f = 2: the first two grow",
        ["grows", "grows", "bounded", "bounded"], [one[1] for one in cases],
        told == [True, True, False, False], "Not a claim of the paper: here f is needed.",
    )  # fmt: skip


def theorem_4_gaps(of: System = QUARTER, f: int = 2, gaps: Sequence[int] = (2, 3, 4)) -> Row:
    """Blocks at random distances."""
    rng, p = default_rng(14), len(of.C)
    L = rng.choice(list(gaps), 400)
    free = np.vstack([held(p, f, int(one)) for one in L])
    kinds = {row.tobytes(): step(of, row) for row in free}
    W = forwards([kinds[row.tobytes()] for row in free])
    size = np.sqrt(np.linalg.norm(W, 2, axis=(1, 2)))
    found = [float(np.max(half)) for half in np.array_split(size, 2)]
    return claim(
        "Theorem 4, gaps that vary", "L is a bound, not a period: rotation by 90 degrees, f = 2, "
        "gaps of 2, 3 and 4 at random, largest error in two halves of 400 blocks", "bounded",
        found, not grows(found),
    )  # fmt: skip


def remark_5(count: int = 300, seed: int = 15, spare: int = 0) -> Row:
    """Both sides of the inequality on whole-number plants."""
    rng, found = default_rng(seed), []
    while len(found) < count:
        n, p = int(rng.integers(2, 7)), int(rng.integers(1, 4))
        A, C = rng.integers(-1, 2, (n, n)).astype(float), rng.integers(-1, 2, (p, n)).astype(float)
        blocks = [C]
        for _ in range(n - 1):
            blocks.append(blocks[-1] @ A)
        ranks = [rank(np.vstack(blocks[: k + 1])) for k in range(n)]
        if ranks[-1] == n:
            found.append((ranks.index(n) + 1, n - ranks[0] + 1 - spare))
    broken = sum(psi > bound for psi, bound in found)
    below = sum(psi < bound for psi, bound in found)
    return claim(
        "Remark 5", "psi <= nullity(C) + 1, so that (31) asks for no more than [7]: random plants, "
        "those that break it, those where psi is smaller", [count, 0, "some"],
        [count, broken, below], broken == 0 and below > 0,
    )  # fmt: skip


def corollary_2_each(of: System = TWICE, sensor: int = 1) -> Row:
    """The same with one eigenvector for each eigenvalue."""
    can = np.arange(len(of.C)) == sensor
    values, vectors = np.linalg.eig(of.A)
    seen = np.abs(of.C @ vectors) > 1e-9
    count = int(np.sum((np.abs(values) >= 1.0) & np.all(~seen | can[:, None], 0)))
    f = min(of.observability_index, count)
    found = sizes(of, can & held(len(of.C), f, 4))
    return claim(
        "Corollary 2, one eigenvector each", "enough for A = 1.1 I, C = [1 1; 1 0], sensor 2 "
        "attacked: f, largest error after 200, 400 steps with it, L = 4", "bounded", [f, *found],
        not grows(found), "As in Theorem 3.",
    )  # fmt: skip
