"""DECODER's statements of Sections II and III-B that small whole-number systems decide.

Every check is a function of its inputs. ``cases`` are those of `decoder_exact`.
"""

import itertools

import numpy as np
from numpy.random import default_rng

from holdfast.papers.decoder_exact import Case, case, supports
from holdfast.papers.rows import Row, claim, read_only

ROUNDING = 1e-9
"""Relative size under which a difference is rounding."""
MATRICES = 400
"""Random matrices for Lemma 1."""
SUBSETS = 3_000
"""Sets of columns of Q2' that are tried for one system."""


def definitions() -> list[Row]:
    """What is only defined."""
    return [
        read_only(
            "Definition 1", "q errors are correctable, the attacked sensors being fixed", None,
            "A definition; judged with Proposition 1 and (2).",
        ),
        read_only(
            "Definition 2", "q errors are correctable, the attacked sensors changing", None,
            "A definition; judged with (13), Propositions 2 to 4 and Section III-E.",
        ),
    ]  # fmt: skip


def definition_2(found: list[Case], more: int = 0) -> Row:
    """By "some decoder corrects": some step, or all steps together, must have more than 2 q."""
    tally = [0, 0, 0, 0]
    for one in [*found, *short_windows(found)]:
        stays = one.together > 2 * (one.q + more)
        changes = np.min(np.max(np.sum(one.seen, 2), 1)) > 2 * one.q
        tally[2 * stays + changes] += 1
    return claim(
        "Definition 2, beside Definition 1", "what is correctable where sensors change is so where "
        "they are fixed: systems with both, fixed only, changing only", ["-", "-", 0],
        [tally[3], tally[2], tally[1]], tally[1] == 0 and tally[2] > 0,
        "A fixed set is one way of choosing the sensors at every step; for some decoder, not the "
        "same one.",
    )  # fmt: skip


def proposition_1(found: list[Case], factor: int = 2) -> Row:
    """Ranks of the sensors that are left without any 2 q of them, against the supports."""
    tally = np.zeros((2, 2), int)
    for one in found:
        Phi, p = unit_rows(one.Phi), len(one.C)
        told = True
        for lost in itertools.combinations(range(p), min(2 * one.q, p)):
            kept = [t * p + i for t in range(one.T) for i in range(p) if i not in lost]
            told = told and rank(Phi[kept]) == len(one.values)
        tally[int(told), int(one.together > factor * one.q)] += 1
    wrong = int(tally[0, 1] + tally[1, 0])
    return claim(
        "Proposition 1", "some decoder corrects q fixed sensors iff |union of supp(C A^t z)| > 2q: "
        "systems with both, with neither, with one", ["-", "-", 0],
        [tally[1, 1], tally[0, 0], wrong], wrong == 0 and tally[0, 0] > 0 and tally[1, 1] > 0,
        "A decoder exists iff the state is determined without any 2q sensors; by ranks.",
    )  # fmt: skip


def rank(matrix: np.ndarray) -> int:
    """Of floating-point rows of length 1."""
    return int(np.linalg.matrix_rank(matrix, tol=1e-8)) if matrix.size else 0


def unit_rows(matrix: np.ndarray) -> np.ndarray:
    """Rows of length 1, which see what they saw; zero ones stay."""
    length = np.linalg.norm(matrix, axis=1, keepdims=True)
    return matrix / np.where(length > 0, length, 1.0)


def fewest_units(blocks: np.ndarray, y: np.ndarray, limit: int) -> list[np.ndarray]:
    """The different x that leave the fewest units of (units x rows x n), at most ``limit``, out."""
    units, _, n = blocks.shape
    for count in range(limit + 1):
        x: list[np.ndarray] = []
        for out in itertools.combinations(range(units), count):
            kept = [i for i in range(units) if i not in out]
            rows, target = blocks[kept].reshape(-1, n), y[kept].ravel()
            one = np.linalg.lstsq(rows, target, rcond=None)[0]
            off = np.max(np.abs(rows @ one - target), initial=0.0)
            new = all(np.max(np.abs(one - other)) > 1e-6 for other in x)
            if off <= ROUNDING * max(1.0, float(np.max(np.abs(target)))) and new:
                x.append(one)
        if x:
            return x
    return []


def equation_2(found: list[Case], more: int = 0) -> Row:
    """Every set of q sensors attacked by what makes another x look as good as possible."""
    rng, tried, wrong = default_rng(1), 0, 0
    for one in found:
        if one.together <= 2 * one.q or one.T > 8:
            continue
        p, T, n = len(one.C), one.T, len(one.values)
        # a step scaled as a whole keeps numbers apart; which rows are zero does not change
        Phi = unit_rows(one.Phi).reshape(T, p, n)
        blocks, x = np.swapaxes(Phi, 0, 1), rng.standard_normal(n)
        z = one.rays[np.argmin(np.sum(one.rays.astype(bool), 1))].astype(float)
        z = z / np.linalg.norm(z)
        for lying in itertools.combinations(range(p), min(one.q + more, p)):
            y = blocks @ x
            y[list(lying)] += blocks[list(lying)] @ z
            answer = fewest_units(blocks, y, one.q + more)
            tried += 1
            wrong += len(answer) != 1 or np.max(np.abs(answer[0] - x)) > 1e-6
    return claim(
        "(2)", "corrects q fixed sensors where Proposition 1 allows it: attacks tried, those that "
        "it does not correct", ["-", 0], [tried, wrong], wrong == 0 and tried > 0,
        "Every set of q sensors, attacked as if another state were true.",
    )  # fmt: skip


def one_step(sensors: int = 2) -> Row:
    """T = 1 with fewer sensors than states."""
    C = np.array([[1, 2, -1], [2, 1, 1], [1, -1, 1], [3, 1, 2], [1, 1, 4]], object)[:sensors]
    least = int(np.min(np.sum(supports(C), 1)))
    return claim(
        "Section II-A, T = 1", f"with fewer sensors than states (2) corrects nothing at T = 1: "
        f"least |supp(C z)|, {sensors} sensors, 3 states", 0, least, least == 0,
    )  # fmt: skip


def hopping(cycled: bool = True) -> Row:
    """(2) where one of four sensors is attacked at each of four steps, another each time."""
    one = case([1, 2], [[1, 1], [1, -1], [1, 2], [2, 1]], 1, 4)
    Phi, x = one.Phi.reshape(4, 4, 2), np.array([1.0, 1.0])
    y = Phi @ x
    for t in range(4):
        y[t, t if cycled else 0] += 5.0
    cost = [int(np.sum(np.any(np.abs(y - Phi @ z) > ROUNDING, 0))) for z in (x, 0.0 * x)]
    return claim(
        "Section II-A, attacked sensors that change", "one of four sensors at a time, each in "
        "turn: (2) cannot tell: its objective at the true x and at x = 0", "equal", cost,
        cost[0] >= cost[1],
    )  # fmt: skip


def lemma_1(short: int = 0) -> Row:
    """Sparsest solutions of b = A x by enumeration; the condition asked of ``short`` fewer."""
    tally = [0, 0, 0]
    for A, q, meets in _matrices(short):
        several = _second(A, q)
        tally[0] += meets
        tally[1] += meets and several
        tally[2] += not meets and several
    return claim(
        "Lemma 1", "a q-sparse solution is the only one if all 2q columns are independent: "
        "matrices that meet it, with a second solution, others with one", ["-", 0, "-"], tally,
        tally[1] == 0 and min(tally[0], tally[2]) > 0,
        "Whole numbers, 3 x 5 with q = 1 and 4 x 6 with q = 2.",
    )  # fmt: skip


def _matrices(short: int = 0, shapes=((3, 5, 1), (4, 6, 2))):
    """Matrices of whole numbers, q, and whether all sets of 2q columns are independent."""
    rng = default_rng(2)
    for m, n, q in shapes:
        for A in rng.integers(-3, 4, (MATRICES // len(shapes), m, n)).astype(float):
            few = 2 * q - short
            yield (
                A,
                q,
                all(
                    np.linalg.matrix_rank(A[:, list(c)]) == few
                    for c in itertools.combinations(range(n), few)
                ),
            )


def _second(A: np.ndarray, q: int) -> bool:
    """Whether two different x of q small whole numbers, and zeros, have the same A x."""
    n, few = A.shape[1], []
    for where in itertools.combinations(range(n), q):
        x = np.zeros((5**q, n))
        x[:, where] = list(itertools.product(range(-2, 3), repeat=q))
        few.append(x)
    x = np.unique(np.concatenate(few), axis=0)
    return len(np.unique(np.round(x @ A.T), axis=0)) < len(x)


def lemma_1_rows(shape: tuple[int, int, int] = (3, 6, 2), short: int = 0) -> Row:
    """Whether m >= 2q asks for more than the columns do."""
    met = sum(meets for _, _, meets in _matrices(short, (shape,)))
    return claim(
        "Lemma 1, m >= 2q", "it asks for something more: of 400 matrices with m < 2q, those whose "
        "sets of 2q columns are all independent", "> 0 for some", met, met > 0,
        "2q columns of m < 2q rows are never independent.",
    )  # fmt: skip


def equation_4(off: float = 0.0) -> Row:
    """F (C x + e) = F e with F = Q2' of C."""
    rng = default_rng(3)
    C, x, e = rng.standard_normal((8, 3)), rng.standard_normal(3), np.eye(8)[2] * 50.0
    F = np.linalg.qr(C, mode="complete")[0][:, 3:].T + off
    gap = float(np.max(np.abs(F @ (C @ x + e) - F @ e)))
    return claim("(4)", "F y = F e: largest difference", 0.0, gap, gap < ROUNDING)


def equation_5(inputs: int = 4, sensors: int = 10) -> Row:
    """The second line as printed."""
    return claim(
        "(5)", "its second line is u^(t) = C x^(t) + e^(t): entries of u and of C x + e in the "
        "systems of Fig. 1", "equal", [inputs, sensors], inputs == sensors,
        "It must be y^(t). The same misprint is in (14).",
    )  # fmt: skip


def equation_6(off: float = 0.0) -> Row:
    """The stacked window against the plant run step by step."""
    rng = default_rng(4)
    A, C, x = rng.standard_normal((4, 4)) / 2, rng.standard_normal((3, 4)), rng.standard_normal(4)
    e, y, state = rng.standard_normal((5, 3)), [], x
    for t in range(5):
        y.append(C @ state + e[t])
        state = (A + off) @ state
    Phi = np.concatenate([C @ np.linalg.matrix_power(A, t) for t in range(5)])
    gap = float(np.max(np.abs(np.ravel(y) - Phi @ x - e.ravel())))
    return claim(
        "(6)", "Y = Phi x + E of a plant run for five steps: largest difference", 0.0, gap,
        gap < ROUNDING,
    )  # fmt: skip


def feedback(gain: tuple[float, float] = (-0.5, -1.5)) -> Row:
    """Ranks of controllability and observability before and after a feedback."""
    A, B, C = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.0], [1.0]]), np.ones((1, 2))
    loops = (A, A + B @ np.array([gain]))
    control = [int(np.linalg.matrix_rank(np.hstack([B, M @ B]))) for M in loops]
    see = [int(np.linalg.matrix_rank(np.vstack([C, C @ M]))) for M in loops]
    return claim(
        "Section III-B, feedback", "keeps controllability and may cost observability: ranks of "
        "both before and after", [2, 2, 2, "< 2"], [*control, *see],
        control == [2, 2] and see[0] == 2 > see[1],
        "A known input is removed from the window first, which needs the open loop observable.",
    )  # fmt: skip


def inverse_map(q: int = 1, T: int = 8, p: int = 10) -> Row:
    """The size of the identity in [Phi I]."""
    return claim(
        "Section III-B, the map [Phi I]", "[Phi, I_{qT}] takes (x, E) to Y: columns of its "
        "identity and entries of E", "equal", [q * T, p * T], q == p,
        "The identity has p T columns; E is sparse, not short.",
    )  # fmt: skip


def proposition_2(found: list[Case], factor: int = 2) -> Row:
    """Ranks of sets of columns of Q2' against supports, on windows that are short enough."""
    tally = np.zeros((2, 2), int)
    for one in short_windows(found):
        Phi, N = unit_rows(one.Phi), one.T * len(one.C)
        if rank(Phi) < Phi.shape[1]:
            continue
        few = 2 * one.q * one.T
        Q2 = np.linalg.qr(Phi, mode="complete")[0][:, Phi.shape[1] :]
        sets = np.array(list(itertools.islice(itertools.combinations(range(N), few), SUBSETS)))
        least = np.linalg.svd(np.swapaxes(Q2[sets], 1, 2), compute_uv=False)[:, -1]
        free = few <= N - Phi.shape[1] and float(np.min(least)) > 1e-8
        tally[int(free), int(one.fewest > factor * one.q * one.T)] += 1
    wrong = int(tally[0, 1] + tally[1, 0])
    return claim(
        "Proposition 2", "all 2s columns of Q2' are independent iff |supp(Phi z)| > 2s for all z: "
        "windows with both, with neither, with one", ["-", "-", 0],
        [tally[1, 1], tally[0, 0], wrong], wrong == 0 and tally[0, 0] > 0 and tally[1, 1] > 0,
        "Either makes (6) unique for the l0 decoder; see the row on (12).",
    )  # fmt: skip


def short_windows(found: list[Case]) -> list[Case]:
    """The systems that have few sensors, over two and three steps."""
    return [one.over(T) for one in found if len(one.C) < 5 for T in (2, 3)]


def proposition_2_rows(found: list[Case], less: int = 0) -> Row:
    """Whether 2 q T <= p T - n asks for more; ``less`` is taken off its right side."""
    met = 0
    for one in short_windows(found):
        right = one.T * len(one.C) - len(one.values) - less
        met += one.fewest > 2 * one.q * one.T > right
    return claim(
        "Proposition 2, 2qT <= pT - n", "it asks for something more: windows with (ii) that do not "
        "meet it", "> 0 for some", met, met > 0,
        "Some z is zero on n - 1 rows at least, so that (ii) gives 2s <= p T - n. (9) has it too.",
    )  # fmt: skip
