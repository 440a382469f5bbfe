"""DECOMPOSE's least-squares interpretation (Section IV) and its proof (Appendix A), computed."""

from collections.abc import Sequence

import numpy as np

from holdfast.numerics.h_infinity import h_infinity_gain
from holdfast.papers.decompose_algebra import ROUNDING, theorem_1
from holdfast.papers.decompose_example import (
    COMPLEX,
    DEFECTIVE,
    EVERY,
    EXAMPLE,
    REPEATED,
    Given,
    diagonalised,
    gap,
)
from holdfast.papers.rows import Row, claim

SIMPLE = (EXAMPLE, DEFECTIVE, COMPLEX)
"""One Jordan block for each eigenvalue."""
INVERTIBLE = 1e-12
"""Smallest over largest eigenvalue from which a covariance has an inverse."""
BOUND = 1.0
"""Of the H-infinity filter; no filter of the example stays below 0.7."""


def equation_29(every: Sequence[Given] = EVERY, growth: float = 1.0) -> Row:
    """The fixed point exists and is the limit of (26); J times ``growth``."""
    off, least = 0.0, np.inf
    for given in every:
        J = np.kron(np.eye(len(given.C)), growth * given.J)
        limit = given.noise
        for _ in range(6):  # doubling the number of steps of (26)
            limit, J = limit + J @ limit @ J.conj().T, J @ J
        off, least = max(off, gap(limit, given.W)), min(least, _conditioning(given))
    return claim(
        "(29)", "W~ is well defined: distance of (26) after 64 steps from it, least relative "
        "eigenvalue of W~", [0.0, ">= 0"], [off, least], off < ROUNDING and least > -INVERTIBLE,
    )  # fmt: skip


def printed_weights(given: Given) -> np.ndarray:
    """(G^H W~^-1 G)^-1 G^H W~^-1 of Appendix A, W~ inverted as a machine does it."""
    G = given.stacked()[0]
    half = np.linalg.solve(given.W, G).conj().T
    return np.linalg.solve(half @ G, half)


def kkt_weights(given: Given) -> np.ndarray:
    """X of the system [[W~, G], [G^H, 0]], which needs no inverse of W~."""
    G = given.stacked()[0]
    N, n = G.shape
    system = np.block([[given.W, G], [G.conj().T, np.zeros((n, n))]])
    right = np.vstack([np.eye(N), np.zeros((n, N))])
    return np.linalg.lstsq(system, right, rcond=INVERTIBLE)[0][N:]


def _conditioning(given: Given) -> float:
    values = np.linalg.eigvalsh(given.W)
    return float(values[0] / values[-1])


def theorem_2(every: Sequence[Given] = SIMPLE) -> Row:
    """Both parts where W~ has an inverse."""
    off = 0.0
    for given in every:
        (G, F), found = given.stacked(), printed_weights(given)
        left = np.eye(len(G))
        off = max(off, gap(found, F), gap(left - G @ found, left - G @ F))
    return claim(
        "Theorem 2", "(30) is solved by x^ = sum F_i zeta_i and eps = (I - G F) eps~: largest "
        "difference of the coefficients", 0.0, off, off < 1e-7,
        "On the example and plants with complex and defective eigenvalues, one Jordan block for "
        "each eigenvalue. What is left of 16 digits after the inverse of W~.",
    )  # fmt: skip


def theorem_2_repeated(given: Given = REPEATED) -> Row:
    """The inverse of W~ that (30) and (31) need."""
    ratio = _conditioning(given)
    return claim(
        "Theorem 2, several Jordan blocks", "W~ has an inverse for every Jordan form: smallest "
        "over largest eigenvalue, two blocks of one eigenvalue", "> 0", ratio, ratio > INVERTIBLE,
        "W~ is singular exactly if an eigenvalue of A - K C A has several Jordan blocks: then two "
        "entries of every local estimate are the same, and (30), (31) do not exist as printed.",
    )  # fmt: skip


def theorem_2_kkt(given: Given = REPEATED, off: float = 0.0) -> Row:
    """The same least-squares problem by its optimality conditions, where W~ is singular."""
    G, F = given.stacked()
    reached = np.hstack([given.W, G])
    left = gap(((1.0 + off) * kkt_weights(given) - F) @ reached, np.zeros((len(F), 1)))
    return claim(
        "Theorem 2, without the inverse", "[[W~, G], [G^H, 0]] gives sum F_i zeta_i also with two "
        "blocks of one eigenvalue: largest difference", 0.0, left, left < ROUNDING,
        "On every local estimate that occurs (range of [W~, G]). The factor form zeta = G x - L v "
        "with W~ = L L^H is another; the product uses a basis in which W is never singular.",
    )  # fmt: skip


def other_gains(given: Given = EXAMPLE) -> list[Given]:
    """The example with the gain of an H-infinity filter, and with 1.1 times the Kalman gain."""
    matrices = given[:4]
    robust = h_infinity_gain(*matrices, bound=BOUND)
    if robust is None:
        raise ValueError("no such H-infinity filter")
    return [diagonalised(*matrices, K) for K in (robust, 1.1 * given.K)]


def remark_2(off: float = 0.0) -> Row:
    """Theorem 1 and (21) with other gains."""
    every = other_gains()
    summed = max(gap(F @ G, np.eye(3)) for G, F in (given.stacked() for given in every))
    run = theorem_1(every, off).ours
    worst = max(summed, run)
    return claim(
        "Remark 2", "other fixed gains decompose as well (H-infinity, 1.1 K): largest difference "
        "from the filter, or in (21)", 0.0, worst, worst < ROUNDING,
        "The H-infinity filter that amplifies disturbances by less than 1.",
    )  # fmt: skip


def remark_2_squares(every: Sequence[Given] | None = None) -> Row:
    """Theorem 2 with other gains: F against the least-squares coefficients."""
    every = other_gains() if every is None else every
    off = [gap(printed_weights(given), given.stacked()[1]) for given in every]
    return claim(
        "Remark 2, least squares", "Theorem 2 carries over to these gains: distance of F from the "
        "coefficients of (30) (H-infinity, 1.1 K)", 0.0, off, max(off) < 1e-7,
        "Lemma 2 needs the Kalman gain. With another gain (30) is solved by the least-squares "
        "fusion of the local estimates, which has no larger variance than the filter that was "
        "decomposed; under (33), (31) gives that fusion and not this filter.",
    )  # fmt: skip


def lemma_2(every: Sequence[Given] = EVERY, spread: float = 1.0) -> Row:
    """(35) for several L, ``spread`` times 0, K, and two others."""
    worst = 0.0
    for g in every:
        n, m = g.K.shape
        others = np.cos(np.arange(2 * n * m)).reshape(2, n, m)
        for L in (0.0 * g.K, spread * g.K, *(spread * others)):
            left, right = np.eye(n) - g.K @ g.C, np.eye(n) - L @ g.C
            made = g.M @ g.P @ (right @ g.A).T + left @ g.Q @ right.T + g.K @ g.R @ L.T
            worst = max(worst, gap(made, g.P))
    return claim(
        "Lemma 2", "(35) for L = 0, K and two others: largest difference", 0.0, worst,
        worst < ROUNDING, "Whether A - L C A is stable plays no part: (35) is affine in L.",
    )  # fmt: skip


def lyapunov(id: str, given: Sequence[Given], conjugate: bool, what: str) -> Row:
    """(36), (39) or (40): the largest residual relative to the solution, with J or J^H."""
    equation = id.split(", ")[0]
    worst = max(
        _residual("(36)" if equation == "Lemma 3" else equation, g, conjugate) for g in given
    )
    kind = "J^H" if conjugate else "J as printed"
    return claim(
        id, f"{what}, with {kind}: largest residual, relative", 0.0, worst, worst < ROUNDING,
        "" if conjugate else "The last factor must be J^H, as in (29). As printed it holds where "
        "the eigenvalues are real and simple, as in the paper's example.",
    )  # fmt: skip


def _residual(equation: str, g: Given, conjugate: bool) -> float:
    n, m = g.K.shape
    last = g.J.conj().T if conjugate else g.J
    W, noise, G, F = g.W.reshape(m, n, m, n), g.noise.reshape(m, n, m, n), g.G, g.F
    ones, worst = np.ones(n), 0.0
    for j in range(m):
        enter = (np.eye(n) - g.K @ g.C) @ g.Q @ (G[j] - np.outer(ones, g.C[j])).conj().T
        rest = enter + np.outer(g.K @ g.R[:, j], ones)
        if equation == "(39)":
            pairs = [(W[i, :, j], g.J, noise[i, :, j]) for i in range(m)]
        elif equation == "(36)":
            pairs = [(g.P @ G[j].conj().T, g.M, rest)]
        else:
            pairs = [(np.einsum("iab,ibc->ac", F, W[:, :, j]), g.M, rest)]
        for solution, before, added in pairs:
            off = np.max(np.abs(solution - before @ solution @ last - added))
            worst = max(worst, float(off / np.max(np.abs(solution))))
    return worst


def equation_38(every: Sequence[Given] = EVERY) -> Row:
    """(38), row by row of every G_j."""
    worst = 0.0
    for g in every:
        n, m = g.K.shape
        left = np.eye(n) - g.K @ g.C
        for j in range(m):
            for row in g.G[j].conj():
                made = g.M @ g.P @ g.A.T @ (row - g.C[j]) + left @ g.Q @ (row - g.C[j])
                made = made + g.K @ g.R[:, j]
                worst = max(worst, gap(made, g.P @ row))
    return claim(
        "(38)", "for every row of every G_j: largest difference", 0.0, worst, worst < ROUNDING,
        "It holds for any other row as well: G enters only in (36), by (20).",
    )  # fmt: skip


def rows_not_zero(eigenvalue: float = -0.7, of_M: float = 0.3) -> Row:
    """A row of (18), in a block of size two, for a sensor that sees one mode of A."""
    row = eigenvalue * ((eigenvalue - of_M) ** -2 + (eigenvalue - of_M) ** -1)
    return claim(
        "Appendix A, G_{o,l,j}", "no row of (18) is zero, since C_j and A - lambda I are not: its "
        "size, A v = -0.7 v, lambda = 0.3 in a block of 2", "> 0", abs(row), abs(row) > ROUNDING,
        "The sum of inverse powers is singular where A has the eigenvalue lambda - 1. Nothing "
        "depends on it: (38) is affine in L_j and holds for every L_j.",
    )  # fmt: skip


def misprinted_product(corrected: bool = False, given: Given = DEFECTIVE) -> Row:
    """F_i J against V J V^-1 K_i, which has one column, or V J V^-1 F_i."""
    made = given.M @ (given.F if corrected else given.K.T[:, :, None])
    off, columns = gap(given.F @ given.J, made), made.shape[-1]
    last = "F_i" if corrected else "K_i"
    return claim(
        f"Appendix A, V J V^-1 {last}", f"F_i J = V J V^-1 {last}: columns of the right-hand side, "
        "largest difference", [len(given.A), 0.0], [columns, off],
        columns == len(given.A) and off < ROUNDING,
        "" if corrected else "A misprint for F_i.",
    )  # fmt: skip


def equation_41(every: Sequence[Given] = EVERY, off: float = 0.0) -> Row:
    """[F_1 .. F_m] W~ = P [G_1^H .. G_m^H]."""
    worst = 0.0
    for given in every:
        G, F = given.stacked()
        wanted = given.P @ G.conj().T
        worst = max(worst, gap((1.0 + off) * F @ given.W, wanted))
    return claim(
        "(41)", "[F_1 .. F_m] W~ = P [G_1^H .. G_m^H]: largest difference", 0.0, worst,
        worst < ROUNDING, "Also where W~ is singular; Theorem 2 without the inverse follows.",
    )  # fmt: skip


def appendix() -> list[Row]:
    """The rows of Appendix A."""
    hard = (DEFECTIVE, COMPLEX)
    return [
        lemma_2(),
        lyapunov("Lemma 3", [DEFECTIVE], False, "(36) on a defective A - K C A"),
        lyapunov("(36)", hard, False, "Lemma 3's equation for P G_j^H"),
        lyapunov("(36), with J^H", EVERY, True, "Lemma 3's equation for P G_j^H"),
        equation_38(),
        rows_not_zero(),
        lyapunov("(39)", hard, False, "the equation of a block of W~"),
        lyapunov("(39), with J^H", EVERY, True, "the equation of a block of W~"),
        misprinted_product(),
        misprinted_product(corrected=True),
        lyapunov("(40)", hard, False, "the equation of S~_j"),
        lyapunov("(40), with J^H", EVERY, True, "the equation of S~_j"),
        equation_41(),
    ]
