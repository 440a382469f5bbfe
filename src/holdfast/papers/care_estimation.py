"""CARE's statements about the estimate before projection, and its misprints, each computed.

Every check is a function of its inputs; the defaults are the vehicle at its first speed, or
the counterexample. The algebra is the paper's, line by line, so that the product's own
estimator is not judged by itself.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from holdfast.papers.care_vehicle import MEASUREMENT, PROCESS, START, matrices
from holdfast.papers.rows import Row, claim

ROUNDING = 1e-9
"""Relative size under which a difference of matrices of order 1 is rounding."""
A, G = matrices(START[3])
C, Q, R, P = np.eye(4), np.diag(PROCESS), np.diag(MEASUREMENT), np.eye(4)
NO_ERROR, EVERY_ATTACK = np.zeros(4), np.eye(2)
ATTACK, ESTIMATE = np.array([1.0, 0.0]), np.array([0.8, 0.1])


class Step(NamedTuple):
    """Lines 3 to 13 of Algorithm 1: gains and covariances."""

    M: np.ndarray
    d_cov: np.ndarray
    spread: np.ndarray
    L: np.ndarray
    x_cov: np.ndarray


def printed_step(A=A, G=G, C=C, Q=Q, R=R, P=P, *, add_q: bool) -> Step:
    """Algorithm 1 as printed, with or without the + Q_{k-1} that line 9 lacks."""
    weight = np.linalg.inv(C @ (A @ P @ A.T + Q) @ C.T + R)
    d_cov = np.linalg.inv(G.T @ C.T @ weight @ C @ G)
    M = d_cov @ G.T @ C.T @ weight
    coupled = -A @ P @ A.T @ C.T @ M.T @ G.T - G @ M @ C @ Q
    star = A @ P @ A.T + coupled + coupled.T + G @ d_cov @ G.T
    if add_q:
        star = star + Q
    noisy = C @ G @ M @ R
    spread = C @ star @ C.T - noisy - noisy.T + R
    L = (star @ C.T - G @ M @ R) @ np.linalg.pinv(spread, rcond=1e-10, hermitian=True)
    keep = np.eye(len(A)) - L @ C
    mixed = keep @ G @ M @ R @ L.T
    return Step(M, d_cov, spread, L, mixed + mixed.T + keep @ star @ keep.T + L @ R @ L.T)


def algorithm_1(*, add_q: bool = False) -> Row:
    """Line 10 must give a covariance: no eigenvalue below zero."""
    values = np.linalg.eigvalsh(printed_step(add_q=add_q).spread)
    return claim(
        "Algorithm 1", "lines 9 and 10 as printed give a covariance: smallest over largest "
        "eigenvalue of R~*", ">= 0", values[0] / values[-1], values[0] >= -ROUNDING * values[-1],
        "Line 9 lacks + Q_{k-1}, which the text of Section 3.2 has; vehicle at 18.8 m/s, P = I.",
    )  # fmt: skip


def algorithm_1_corrected(*, add_q: bool = True) -> Row:
    """Lines 3 to 13 against joint weighted least squares in (x_k, d_{k-1}) given the prior."""
    step = printed_step(add_q=add_q)
    prior = np.hstack([np.eye(4), -G])
    seen = np.hstack([C, np.zeros((4, 2))])
    information = prior.T @ np.linalg.solve(A @ P @ A.T + Q, prior)
    joint = np.linalg.inv(information + seen.T @ np.linalg.solve(R, seen))
    gap = max(
        np.max(np.abs(step.x_cov - joint[:4, :4])) / np.max(np.abs(joint[:4, :4])),
        np.max(np.abs(step.d_cov - joint[4:, 4:])) / np.max(np.abs(joint[4:, 4:])),
    )
    return claim(
        "Algorithm 1, line 9 with + Q", "lines 3 to 13 give the covariances of joint weighted "
        "least squares in (x_k, d_{k-1})", 0.0, gap, gap < ROUNDING,
        "R~* has rank n_y - n_d: the inverse of line 11 is a pseudo-inverse with a cut-off.",
    )  # fmt: skip


def proposition_2(start_error=NO_ERROR, attacks=EVERY_ATTACK) -> Row:
    """Means through (12)-(14) for gains with and without M C G = I."""
    step = printed_step(add_q=True)
    gains = [step.M, np.linalg.pinv(C @ G), 0.9 * step.M, step.M + 0.1 * np.abs(step.M)]
    agree, largest = True, 0.0
    for M in gains:
        bias = 0.0
        for d in attacks:
            error = np.asarray(start_error, float)
            for _ in range(3):
                d_error = d - M @ C @ (A @ error + G @ d)
                error = (np.eye(4) - step.L @ C) @ (A @ error + G @ d_error)
                bias = max(bias, np.max(np.abs(d_error)), np.max(np.abs(error)))
        left_inverse = np.max(np.abs(M @ C @ G - np.eye(2))) < ROUNDING
        agree &= left_inverse == (bias < ROUNDING)
        largest = max(largest, bias) if left_inverse else largest
    return claim(
        "Proposition 2", "estimates are unbiased if and only if M C G = I (no projection): "
        "largest bias with M C G = I", 0.0, largest, agree,
        "'Only if' needs every attack: with d = 0 at all times any gain is unbiased. Four gains, "
        "two of them no left inverses.",
    )  # fmt: skip


def excess_variance(gain: np.ndarray, design: np.ndarray, cov: np.ndarray) -> float:
    """Total variance of a linear estimator over the least that an unbiased one can have.

    The least comes from the optimality conditions [cov design; design' 0] of min tr N cov N'
    subject to N design = I. Infinite where the gain is biased.
    """
    m, q = design.shape
    if np.max(np.abs(gain @ design - np.eye(q))) > ROUNDING:
        return np.inf
    system = np.block([[cov, design], [design.T, np.zeros((q, q))]])
    best = np.linalg.solve(system, np.vstack([np.zeros((m, q)), np.eye(q)]))[:m].T
    return float(np.trace(gain @ cov @ gain.T) / np.trace(best @ cov @ best.T) - 1.0)


def proposition_3(gain=None) -> Row:
    """(15) against the best of all left inverses."""
    found = printed_step(add_q=True).M if gain is None else gain
    excess = excess_variance(found, C @ G, C @ (A @ P @ A.T + Q) @ C.T + R)
    return claim(
        "Proposition 3", "the gain (15) is best linear unbiased: its variance over the least "
        "possible, minus 1", 0.0, excess, excess < ROUNDING,
        "Least variance from the optimality conditions over all gains with M C G = I.",
    )  # fmt: skip


def theorem_16(weight=None) -> Row:
    """Gauss-Markov with the paper's H, n <= m, full rank; ``weight`` stands for R_v^{-1}."""
    H = np.array([[1.0, 0], [1, 1], [0, 2], [3, 1]])
    cov = np.diag([1.0, 4.0, 0.25, 9.0]) + 0.2
    W = np.linalg.inv(cov) if weight is None else weight
    excess = excess_variance(np.linalg.solve(H.T @ W @ H, H.T @ W), H, cov)
    return claim(
        "Theorem 16", "Gauss-Markov: (H' R^-1 H)^-1 H' R^-1 y has the least variance of unbiased "
        "linear estimators", 0.0, excess, excess < ROUNDING,
        "Excess over the least variance, on a 4 x 2 example with correlated noise.",
    )  # fmt: skip


def remark_4(speed: float = 18.8) -> Row:
    """Rank(C G) = n_d and M C G = I at a speed."""
    G = matrices(speed)[1]
    rank = int(np.linalg.matrix_rank(C @ G))
    gap = np.inf
    if rank == 2:
        gap = float(np.max(np.abs(printed_step(G=G, add_q=True).M @ C @ G - np.eye(2))))
    return claim(
        "Remark 4", "rank(C G) = n_d suffices for M C G = I with M of (15): rank, |M C G - I|",
        [2, 0.0], [rank, gap], gap < ROUNDING,
        "The vehicle's limits 0 <= v admit v = 0, where the rank is 1 and (15) does not exist.",
    )  # fmt: skip


def equation_17(A=A, x=START) -> Row:
    """What (17) leaves on its right-hand side if C x^_{k-1} is subtracted, without errors."""
    left = float(np.linalg.norm(C @ (A @ x - x)))
    return claim(
        "(17)", "y - C x^_{k-1} leaves only the attack and errors: what is left over without "
        "either", 0.0, left, left < ROUNDING, "C x^-_k must be subtracted.",
    )  # fmt: skip


def equation_21(truth=ATTACK, estimate=ESTIMATE) -> Row:
    """The two lines of (21): the error, and what is printed as equal to it."""
    gap = float(np.linalg.norm((truth - estimate) - estimate))
    return claim(
        "(21)", "its second line equals the attack estimation error: difference of the two lines",
        0.0, gap, gap < ROUNDING, "The second line is the estimate d^, not the error d~.",
    )  # fmt: skip


def mean_excess(slack: float, deviation: float) -> float:
    """E max(s, 0) for s ~ N(slack, deviation^2): what projection takes off on average."""
    z = slack / deviation
    return float(slack * ndtr(z) + deviation * np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi))


def equation_28(id: str, slack: float = -1.0, deviation: float = 1.0) -> Row:
    """(28) or (29) along one row: the printed mean of the error against the exact one."""
    exact = mean_excess(slack, deviation)
    return claim(
        id, "mean error of the projected estimate along one constraint", slack, exact,
        abs(exact - slack) < 1e-3 * deviation,
        "Right given that the row is active; the mean over all outcomes has the other sign, and "
        "does not vanish for a truth on the face.",
    )  # fmt: skip


def contribution_i(slack: float = -1.0, deviation: float = 1.0) -> Row:
    """Bias that a projected state hands to the next attack estimate: -M C A E[x~]."""
    lateral = np.array([0.0, mean_excess(slack, deviation), 0.0, 0.0])
    bias = -printed_step(add_q=True).M @ C @ A @ lateral
    return claim(
        "Section 1, contribution i", "CARE first gives minimum-variance unbiased estimates: bias "
        "of the next d^u after one projection", 0.0, np.max(np.abs(bias)),
        np.max(np.abs(bias)) < ROUNDING,
        "True until the first projection; fed back, a projected state is biased (28)-(29), and so "
        "is the next 'unconstrained' estimate. Row y <= 5, truth one standard deviation inside.",
    )  # fmt: skip
