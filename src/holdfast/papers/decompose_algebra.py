"""DECOMPOSE's statements about local estimates (Sections II and III), each computed.

Every check is a function of its inputs; the defaults are the paper's example, small plants with
complex, defective and repeated eigenvalues, or the counterexample.
"""

from collections.abc import Sequence

import numpy as np

from holdfast.papers.decompose_example import DEFECTIVE, EVERY, EXAMPLE, REPEATED, Given, gap
from holdfast.papers.rows import Row, claim

ROUNDING = 1e-9
"""Relative size under which a difference is rounding."""
SINGULAR = np.array([[0.5, 0.2, 0.0], [1.0, 0.4, 0.0], [0.1, 0.3, 0.9]])
STEPS = 30


def assumption_1(A: np.ndarray = EXAMPLE.A) -> Row:
    """Smallest singular value of A."""
    least = float(np.linalg.svd(A, compute_uv=False)[-1])
    return claim(
        "Assumption 1", "the example's A is nonsingular: its smallest singular value", "> 0",
        least, least > ROUNDING,
    )  # fmt: skip


def assumption_1_beside(A: np.ndarray = SINGULAR, given: Given = EXAMPLE) -> Row:
    """How near an eigenvalue of A comes to one of A - K C A, for a singular A and any gain."""
    distance = _apart(A, A - given.K @ given.C @ A)
    return claim(
        "Assumption 1, beside Assumption 2", "it asks for something more than Assumption 2: "
        "distance of the eigenvalues of a singular A and of its A - K C A", "> 0 for some",
        distance, distance > ROUNDING,
        "If A v = 0 then (A - K C A) v = 0: a singular A shares the eigenvalue 0, so that "
        "Assumption 2 implies Assumption 1.",
    )  # fmt: skip


def _apart(A: np.ndarray, M: np.ndarray) -> float:
    of_A, of_M = np.linalg.eigvals(A), np.linalg.eigvals(M)
    return float(np.min(np.abs(of_A[:, None] - of_M)))


def assumption_2(given: Given = EXAMPLE) -> Row:
    """The same distance on the example."""
    distance = _apart(given.A, given.M)
    return claim(
        "Assumption 2", "the example's A and A - K C A share no eigenvalue: their distance", "> 0",
        distance, distance > ROUNDING,
        "A mode that is not seen, that no noise excites or that is forgotten in one step is "
        "shared: the product names it.",
    )  # fmt: skip


def _gains(given: Given, start: np.ndarray, steps: int) -> list[np.ndarray]:
    """K(0), K(1), .. of the Kalman filter with P(0|-1) = ``start``."""
    P, found = start, []
    for _ in range(steps):
        K = np.linalg.solve(given.C @ P @ given.C.T + given.R, given.C @ P).T
        found.append(K)
        P = given.A @ (P - K @ given.C @ P) @ given.A.T + given.Q
        P = (P + P.T) / 2
    return found


def equation_5(given: Given = EXAMPLE, starts: Sequence[float] = (0.0, 100.0)) -> Row:
    """The recursion from two P(0|-1) against the gain."""
    ends = [_gains(given, size * np.eye(len(given.A)), 60)[-1] for size in starts]
    worst = max(gap(end, given.K) for end in ends)
    return claim(
        "(5)", "P(k) and K(k) converge: distance of K(59) from K, from Sigma = 0 and 100 I", 0.0,
        worst, worst < ROUNDING,
        "Observability alone is not enough: an unexcited mode on or outside the unit circle "
        "would leave it undone. The example has Q = I.",
    )  # fmt: skip


def equation_7(corrected: bool = False, given: Given = EXAMPLE) -> Row:
    """K(0) with Sigma = P, or P_+, against K."""
    P = given.P
    start = given.A @ P @ given.A.T + given.Q if corrected else P
    off = gap(_gains(given, start, 1)[0], given.K)
    name, note = "P", "Sigma is the covariance of x(0) before any sample: it must be P_+ (next)."
    if corrected:
        name, note = "P_+", "P_+ = A P A' + Q is the fixed point."
    return claim(
        f"(7), Sigma = {name}", f"the filter starts at its steady state if Sigma = {name}: "
        "distance of K(0) from K", 0.0, off, off < ROUNDING, note,
    )  # fmt: skip


def observable_part(given: Given = EXAMPLE, blind: Given = EXAMPLE) -> Row:
    """Whether G_i sees just what sensor i observes; ``blind`` gives the observability."""
    ranks, same = [], True
    for G, row in zip(given.G, blind.C, strict=True):
        powers = [np.linalg.matrix_power(given.A, k) for k in range(len(given.A))]
        seen = np.stack([row @ power for power in powers])
        together = [np.linalg.matrix_rank(one) for one in (G, seen, np.vstack([G, seen]))]
        same &= len(set(together)) == 1
        ranks.append(int(together[0]))
    return claim(
        "Section III, 1)", "a local estimate lives on what its sensor observes: ranks of G_i, "
        "the row space being that of (A, C_i)", None, ranks, same,
    )  # fmt: skip


def remark_1(given: Given = REPEATED) -> Row:
    """How many ways of fusing leave the least-squares estimate as it is: kernel of [W~, G]."""
    return _uniqueness(
        "Remark 1", given,
        "Two Jordan blocks of one eigenvalue make two rows of every local estimate the same: any "
        "split of their weights gives the same estimate.",
    )  # fmt: skip


def remark_1_simple(given: Given = EXAMPLE) -> Row:
    """The same where every eigenvalue has one block."""
    return _uniqueness("Remark 1, one block per eigenvalue", given, "")


def _uniqueness(id: str, given: Given, note: str) -> Row:
    both = np.hstack([given.W, given.stacked()[0]])
    free = len(both) - int(np.linalg.matrix_rank(both, tol=ROUNDING * np.linalg.norm(both)))
    return claim(
        id, "the coefficients of the least-square fusion are unique: dimension of what can be "
        "added to each row of them", 0, free, free == 0, note,
    )  # fmt: skip


def _signal(m: int) -> np.ndarray:
    """Some samples of every sensor: nothing in the identity depends on what they are."""
    k = np.arange(1, STEPS + 1)[:, None]
    return np.sin(0.7 * k * (1.0 + np.arange(m))) + 0.3 * np.cos(2.1 * k)


def _kept_up(given: Given, before: np.ndarray, start: np.ndarray, F=None) -> float:
    """Largest difference of (7) from x^ ``before`` and (11) from zeta = ``start``, relative."""
    F = given.F if F is None else F
    x, zeta, off, size = before, start.astype(complex), 0.0, 1e-300
    for y in _signal(len(given.C)):
        x = given.M @ x + given.K @ y
        zeta = zeta @ given.J.T + y[:, None]
        off = max(off, float(np.max(np.abs(np.einsum("inj,ij->n", F, zeta) - x))))
        size = max(size, float(np.max(np.abs(x))))
    return off / size


def equation_12(before: np.ndarray = np.ones(3), given: Given = EXAMPLE) -> Row:  # noqa: B008
    """Zeta_i(0) = 0 although x^(0) is not."""
    off = _kept_up(given, np.asarray(before), np.zeros((len(given.C), len(given.A))))
    return claim(
        "(12), zeta_i(0) = 0", "with it (11) is the Kalman filter (7) from the start, x^(0) = "
        "(1, 1, 1): largest difference", 0.0, off, off < ROUNDING,
        "Only for x^(0) = 0, which the first sample makes K(0) y(0). It fades like (A - K C A)^k; "
        "zeta_i(0) = G_i x^(0) is right for every start.",
    )  # fmt: skip


def theorem_1(every: Sequence[Given] = EVERY, off: float = 0.0) -> Row:
    """(11) with (13), (14) against (7) over 30 samples; ``off`` is an error of F."""
    before = np.array([1.0, -2.0, 0.5])
    worst = max(
        _kept_up(g, start, np.einsum("inj,j->in", g.G, start), (1.0 + off) * g.F)
        for g in every
        for start in (np.zeros(3), before)
    )
    return claim(
        "Theorem 1", "sum F_i zeta_i with (13), (14) is the Kalman estimate (7): largest "
        "difference over 30 samples", 0.0, worst, worst < ROUNDING,
        "On the example and on plants with complex, defective and repeated eigenvalues of "
        "A - K C A, from zeta_i(0) = G_i x^(0).",
    )  # fmt: skip


def equation_15(every: Sequence[Given] = EVERY, off: float = 0.0) -> Row:
    """X_i 1 = V^-1 K_i."""
    worst = max(
        gap((1.0 + off) * given.X.sum(2).T, np.linalg.solve(given.V, given.K)) for given in every
    )
    return claim(
        "(15)", "X_i 1 = V^-1 K_i: largest difference", 0.0, worst, worst < ROUNDING,
    )  # fmt: skip


def equation_16(every: Sequence[Given] = EVERY, X: np.ndarray | None = None) -> Row:
    """X_i J = J X_i, or for another block diagonal X."""
    worst = max(
        gap((g.X if X is None else X) @ g.J, g.J @ (g.X if X is None else X)) for g in every
    )
    return claim(
        "(16)", "X_i J = J X_i: largest difference", 0.0, worst, worst < ROUNDING,
        "Because the blocks of X_i are Toeplitz; that both are block diagonal, which the paper "
        "gives as the reason, is not enough.",
    )  # fmt: skip


def corollary_1(every: Sequence[Given] = EVERY, moved: float = 0.0) -> Row:
    """(19) by running the plant; a relative error ``moved`` of G."""
    worst = 0.0
    for g in every:
        G, n = (1.0 + moved) * g.G, len(g.A)
        x, zeta = np.ones(n), np.zeros((len(g.C), n), complex)
        eps = G @ x - zeta
        for k, attack in enumerate(_signal(len(g.C))[:10]):
            w, v = np.cos(k + np.arange(n)), np.sin(3 * k + np.arange(len(g.C)))
            x = g.A @ x + w
            zeta = zeta @ g.J.T + (g.C @ x + v + attack)[:, None]
            eps = eps @ g.J.T + (G - g.C[:, None]) @ w - (v + attack)[:, None]
            worst = max(worst, gap(eps, G @ x - zeta))
    return claim(
        "Corollary 1", "(19), the recursion of eps_i = G_i x - zeta_i with noise and attack: "
        "largest difference over 10 steps", 0.0, worst, worst < ROUNDING,
        "Its factor J is stable, so eps_i stays bounded although x need not.",
    )  # fmt: skip


def equation_20(every: Sequence[Given] = EVERY, moved: float = 0.0) -> Row:
    """G_i A - 1 C_i A = J G_i."""
    worst = max(
        gap((1.0 + moved) * g.G @ g.A - (g.C @ g.A)[:, None], (1.0 + moved) * g.J @ g.G)
        for g in every
    )
    return claim(
        "(20)", "G_i A - 1 C_i A = J G_i: largest difference", 0.0, worst, worst < ROUNDING,
    )  # fmt: skip


def lemma_1(every: Sequence[Given] = EVERY, moved: float = 0.0) -> Row:
    """(21)."""
    worst = 0.0
    for given in every:
        G, F = given.stacked()
        worst = max(worst, gap((1.0 + moved) * F @ G, np.eye(len(given.A))))
    return claim(
        "Lemma 1", "(21), sum F_i G_i = I: largest difference", 0.0, worst, worst < ROUNDING,
        "The inverses in G_i need Assumption 2, not only Assumption 1.",
    )  # fmt: skip


def equation_22(given: Given = DEFECTIVE, shift: float = 0.0) -> Row:
    """The sum over sensors of X G, row by row as (22) prints it; ``shift`` moves A."""
    alpha, off = np.linalg.inv(given.V), 0.0
    KCA = given.K @ given.C @ given.A
    summed = np.einsum("iab,ibc->ac", given.X, given.G)
    for first, size in given.blocks:
        moved = given.A - (given.J[first, first] + shift) * np.eye(len(given.A))
        for row in range(size):
            printed = sum(
                alpha[first + h] @ KCA @ np.linalg.matrix_power(np.linalg.inv(moved), h - row + 1)
                for h in range(row, size)
            )
            off = max(off, gap(printed, summed[first + row]))
    return claim(
        "(22)", "sum over sensors of X_{l,i} G_{l,i}, row by row: largest difference", 0.0, off,
        off < ROUNDING, "A block of size two and one of size one.",
    )  # fmt: skip


def equation_23(given: Given = DEFECTIVE, shift: float = 0.0) -> Row:
    """Rows of V^-1 times K C A."""
    alpha = np.linalg.inv(given.V)
    KCA, worst = given.K @ given.C @ given.A, 0.0
    for first, size in given.blocks:
        moved = given.A - (given.J[first, first] + shift) * np.eye(len(given.A))
        for row in range(first, first + size):
            after = alpha[row + 1] if row + 1 < first + size else 0.0
            worst = max(worst, gap(alpha[row] @ KCA, alpha[row] @ moved - after))
    return claim(
        "(23)", "alpha_l' K C A of the rows alpha_l of V^-1: largest difference", 0.0, worst,
        worst < ROUNDING,
    )  # fmt: skip
