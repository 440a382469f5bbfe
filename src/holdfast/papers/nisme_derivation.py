"""NISME's Section 8.1 judged: the derivation of the filter, Lemma 8.1 and Theorem 8.1."""

import numpy as np
from numpy.random import default_rng

from holdfast.papers.nisme_filter import COUNT, EXACT, some
from holdfast.papers.nisme_systems import (
    EPSILON,
    STEPS,
    Data,
    Found,
    System,
    batch,
    gap,
    nise,
    split,
    spread,
)
from holdfast.papers.rows import Row, claim


def equation_20(scale: float = 1.0) -> Row:
    """x~ on the left of (20), for x^."""
    s, data = some(1, scale=scale)[0]
    a = nise(s, data)
    off = float(np.max(np.abs((data.x[-1] - a.x) - a.x)))
    return claim(
        "(20)", "the corrected prediction is the estimation error x~: distance", 0.0, off,
        off < EXACT, "x^ is meant.",
    )  # fmt: skip


def equation_22(off: float = 0.0) -> Row:
    """The error of the filter, step by step, by (22) with (11) corrected."""
    worst = 0.0
    for s, data in some():
        errors = [data.x[0] - s.x0]
        for k in range(1, STEPS + 1):
            a, before = _upto(s, data, k), split(s, k - 1)
            errors.append((1.0 + off) * _error(s, data, k, errors[-1], a, before.T[0]))
        worst = max(worst, gap(errors[-1], data.x[-1] - nise(s, data).x))
    return claim(
        "(22)", "the estimation error follows it: largest relative distance after "
        f"{STEPS} steps, C_(1,k-1) in (11)", 0.0, worst, worst < EXACT,
    )  # fmt: skip


def _upto(s: System, data: Data, k: int) -> Found:
    return nise(s, data._replace(u=data.u[: k + 1], y=data.y[: k + 1]))


def _error(s: System, data: Data, k: int, e: np.ndarray, a: Found, T1: np.ndarray) -> np.ndarray:
    eps, now = EPSILON, a.split
    C2, C3 = (T @ s.C[k] for T in now.T[1:])
    v1, v2, v3 = T1 @ data.v[k - 1], now.T[1] @ data.v[k], now.T[2] @ data.v[k]
    G1, G2 = s.G @ now.V1, s.G @ now.V2 @ now.Vbar
    M1, M2 = np.linalg.inv(now.H1), np.linalg.inv(eps * C2 @ G2)
    Pi = np.eye(len(e)) - eps * G2 @ M2 @ C2
    w = eps * Pi @ (data.w[k - 1] - G1 @ M1 @ v1) - eps * G2 @ M2 @ v2
    moved = a.Abar @ e + w
    return moved - a.L @ (C3 @ moved + v3)


def gain_equation(corrected: bool = False, off: float = 0.0, identity: bool = False) -> Row:
    """The slope d tr(P) / dL at L of line 6; p_3 = n, else the printed sum cannot be formed."""
    rng, worst = default_rng(8), 0.0
    for _ in range(10):
        P, R = spread(rng, 3), spread(rng, 3)
        C = np.eye(3) if identity else rng.normal(size=(3, 3))
        L = np.linalg.solve(C @ P @ C.T + R, C @ P).T * (1.0 + off)
        slope = (C @ P @ C.T + R) @ L.T - C @ P if corrected else ((C @ P).T + R) @ L.T - C @ P
        worst = max(worst, float(np.max(np.abs(slope)) / np.max(np.abs(C @ P))))
    says = "C_3 P C_3'" if corrected else "(C_3 P)'"
    return claim(
        f"Section 8.1.4, {says}", f"d tr P / dL = 2(({says} + R_3) L' - C_3 P) is 0 at L of "
        "line 6: largest relative entry", 0.0, worst, worst < EXACT,
    )  # fmt: skip


def lemma_8_1(count: int = COUNT, noise: float = 1.0) -> Row:
    """Smallest eigenvalues of the three matrices, P_0 = 0 among the starts."""
    smallest = np.inf
    for s, data in some(count):
        for P0 in (s.P0, np.zeros_like(s.P0)):
            a = nise(s._replace(P0=P0), data)
            C1, C2, C3 = (T @ s.C[-1] for T in a.split.T)
            R1, _, R3 = (noise * T @ s.R @ T.T for T in a.split.T)
            M2 = np.linalg.inv(EPSILON * C2 @ s.G @ a.split.V2 @ a.split.Vbar)
            of = [C3 @ a.P_pred @ C3.T + R3, C1 @ a.P_pred @ C1.T + R1]
            of += [np.linalg.solve(M2, np.linalg.solve(M2, a.P2).T), a.P_pred]
            values = [np.linalg.eigvalsh((m + m.T) / 2) for m in of]
            smallest = min(smallest, *(float(np.min(v, initial=np.inf)) for v in values))
    return claim(
        "Lemma 8.1", "P_(k|k-1) >= 0, and Pbar, R~_1, R~_2 > 0: smallest eigenvalue of all, half "
        "of the starts with P_0 = 0", "> 0", smallest, smallest > 0,
    )  # fmt: skip


def lemma_8_1_covariance(corrected: bool = False, off: float = 0.0, **how) -> Row:
    """Cov(z_1 - h_1(x^_k)) of (14), from least squares, against R~_1 of the lemma."""
    worst = 0.0
    for s, data in some(**how):
        a, b = nise(s, data), batch(s, data)
        C1, R1 = a.split.T[0] @ s.C[-1], a.split.T[0] @ s.R @ a.split.T[0].T
        P = (1 + off) * (a.P if corrected else a.P_pred)
        worst = max(worst, gap(C1 @ P @ C1.T + R1, a.split.H1 @ b.P1 @ a.split.H1.T))
    says = "P_k" if corrected else "P_(k|k-1)"
    return claim(
        f"Lemma 8.1, {says}", f"R~_1 with {says} is the covariance of z_1 - h_1(x^_k) of (14): "
        "largest relative distance", 0.0, worst, worst < EXACT,
    )  # fmt: skip


def theorem_8_1(tilt: float = 1.0, longer: float = 1.0) -> Row:
    """(H'H)^-1 H' against other unbiased linear estimates: how much larger their covariance is."""
    rng, least = default_rng(9), np.inf
    for _ in range(100):
        H = rng.normal(size=(5, 2))
        best = longer * np.linalg.pinv(H)
        other = np.linalg.pinv(H) + tilt * rng.normal(size=(2, 5)) @ (
            np.eye(5) - H @ np.linalg.pinv(H)
        )
        more = other @ other.T - best @ best.T
        least = min(least, float(np.linalg.eigvalsh(more)[0] / np.trace(best @ best.T)))
    return claim(
        "Theorem 8.1", "(H*H)^-1 H* is best: least eigenvalue of what 100 other unbiased ones add "
        "to its covariance, relative", ">= 0", least, least >= -1e-12,
    )  # fmt: skip
