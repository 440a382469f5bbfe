"""NISME's Section 5 and its proofs judged: what is stable, and which constants bound it."""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from holdfast.papers.nisme_filter import COUNT, EXACT, some
from holdfast.papers.nisme_systems import STEPS, Data, System, batch, gap, nise
from holdfast.papers.rows import Row, claim, unstated

LONG = 200


def definition_1_1(walking: bool = False, c: float = 1.1) -> Row:
    """x(t) = x(0), |x(0)| <= 1, or a random walk, with alpha = b = 1 and ``c``."""
    t = np.arange(0.0, 1001.0)
    allowed = np.exp(-t) + c
    spread = np.sqrt(t) if walking else 0.0 * t
    with np.errstate(divide="ignore"):
        inside = ndtr((allowed - 1.0) / spread) - ndtr((-allowed - 1.0) / spread)
    least = float(np.min(inside))
    return claim(
        "Definition 1.1", "what does not decay is not PESp: x(t) = x(0) = 1, alpha = b = 1, "
        "c = 1.1: least P(|x(t)| < alpha e^-bt |x(0)| + c)", "< 1", least, least < 0.5,
        "c may be any size: PESp says that x is bounded in probability, not that it decays. "
        "Nor is it a special case of [24], which has no c where there is no input.",
    )  # fmt: skip


def _recursion(s: System, data: Data, P: np.ndarray, noise: float = 1.0):
    """Covariances of a constant system, Qbar times ``noise``, and the error's matrix at the end."""
    a = nise(s, data)
    C3, R3 = a.split.T[2] @ s.C[-1], a.split.T[2] @ s.R @ a.split.T[2].T
    left, found = np.eye(len(P)), []
    for _ in range(LONG):
        P = a.Abar @ P @ a.Abar.T + noise * a.Qbar
        L = np.linalg.solve(C3 @ P @ C3.T + R3, C3 @ P).T
        left = np.eye(len(P)) - L @ C3
        P = left @ P @ left.T + L @ R3 @ L.T
        found.append(P)
    return found, left @ a.Abar


def _observable(count: int):
    """Constant systems with as many rows of C_3 as states."""
    return some(count, size=(3, 6, 3, 1), moving=False)


def lemma_5_1(
    later: bool = False, count: int = COUNT, start: float = 0.0, noise: float = 1.0
) -> Row:
    """Least eigenvalue of P_k^x from P_0 = ``start`` I, of all k or of k >= 1; largest too."""
    low, high = np.inf, 0.0
    for s, data in _observable(count):
        P0 = start * np.eye(len(s.A))
        found, _ = _recursion(s, data, P0, noise)
        values = np.array([np.linalg.eigvalsh(P) for P in (found if later else [P0, *found])])
        low, high = min(low, float(np.min(values))), max(high, float(np.max(values)))
    which = "k >= 1" if later else "k >= 0"
    return claim(
        f"Lemma 5.1{', k >= 1' if later else ''}", f"p I <= P_k <= pbar I, {which}, from P_0 = "
        f"{start:g} I, (C_3, Abar) observable: least and largest eigenvalue",
        "> 0, bounded", [low, high], low > 0 and np.isfinite(high),
        "" if later else "P_0 >= 0 may be singular: the bound begins at k = 1.",
    )  # fmt: skip


def theorem_5_1(count: int = COUNT, gain: bool = True, faster: float = 1.0) -> Row:
    """Spectral radii of (I - L C_3) Abar on linear systems; without ``gain`` of Abar."""
    largest = 0.0
    for s, data in _observable(count):
        found, closed = _recursion(s, data, s.P0)
        moved = closed if gain else nise(s, data).Abar
        assert np.all(np.isfinite(found[-1]))
        largest = max(largest, faster * float(np.max(np.abs(np.linalg.eigvals(moved)))))
    return claim(
        "Theorem 5.1", "on linear plants, all that Assumption 5.3 as printed allows, the error "
        "forgets x~_0: largest spectral radius of (I - L C_3) Abar", "< 1", largest, largest < 1,
        "Its covariance is P_k <= pbar I (Lemma 5.1), so the three properties hold at each k.",
    )  # fmt: skip


class Loop(NamedTuple):
    """x+ = x + w, y = (sin x, cos x) + v, both of variance s^2: an angle, its rate unknown.

    C_3'C_3 = 1 wherever it is linearised, so P is the same for all x; the error moves by
    e + w - L (sin(e + w) + v), |x~| modulo turns.
    """

    s: float

    @property
    def gain(self) -> float:
        """The steady L."""
        P = 0.5 * (1.0 + np.sqrt(5.0))
        return float(P / (P + 1.0))

    def chain(self, turns: int, points: int, linear: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Cells of (-turns pi, turns pi), and the probabilities of moving between them."""
        edges = np.linspace(-turns * np.pi, turns * np.pi, points + 1)
        x = 0.5 * (edges[1:] + edges[:-1])

        def between(mean, sd):
            return np.diff(ndtr((edges[None, :] - mean[:, None]) / sd), axis=1)

        seen = x if linear else np.sin(x)
        return x, between(x, self.s) @ between(x - self.gain * seen, self.gain * self.s)


def theorem_5_1_nonlinear(s: float = 0.7, linear: bool = False, doublings: int = 13) -> Row:
    """P(|x~_k| < pi) of the loop after 2^4, .. steps, and slips a step with less noise."""
    x, K = Loop(s).chain(19, 1000, linear)
    at = np.zeros(len(x))
    at[len(x) // 2] = 1.0
    inside, k = [], np.abs(x) < np.pi
    for doubling in range(doublings):
        if doubling % 4 == 0 and doubling:
            inside.append(float(np.sum((at @ K)[k])))
        K = K @ K
    slips = [_slips(Loop(of), linear) for of in (0.7, 0.5, 0.4)]
    return claim(
        "Theorem 5.1, nonlinear", "5.3 with some constant: |x~_k| < c with 1 - gamma for all k, y "
        "= (sin x, cos x), w, v of sd .7: P(|x~| < pi) at k = 2^4, 2^8, ..", "> 1 - gamma", inside,
        inside[-1] > 0.5,
        "All its assumptions hold. Gaussian noise turns the estimate by 2 pi sooner or later and "
        f"it stays there: {', '.join(f'{p:.1e}' for p in slips)} a step at sd .7, .5, .4, never 0.",
    )  # fmt: skip


def _slips(loop: Loop, linear: bool) -> float:
    """Probability a step of leaving (-pi, pi), once there for long."""
    _, K = loop.chain(1, 400, linear)
    at = np.full(len(K), 1.0 / len(K))
    left = 0.0
    for _ in range(200):
        moved = at @ K
        left = 1.0 - float(np.sum(moved))
        at = moved / np.sum(moved)
    return left


def claim_c_1(off: float = 0.0) -> Row:
    """The Kalman filter of (32), with Abar, Qbar, C_3 and R_3, against least squares."""
    worst = 0.0
    for s, data in some():
        P = (1.0 + off) * s.P0
        for k in range(1, STEPS + 1):
            a = nise(s, data._replace(u=data.u[: k + 1], y=data.y[: k + 1]))
            C3, R3 = a.split.T[2] @ s.C[k], a.split.T[2] @ s.R @ a.split.T[2].T
            P = a.Abar @ P @ a.Abar.T + a.Qbar
            P = P - P @ C3.T @ np.linalg.solve(C3 @ P @ C3.T + R3, C3 @ P)
        worst = max(worst, gap(P, batch(s, data).P))
    return claim(
        "Claim C.1", "NISE is the Kalman filter of (32): its covariance against that of least "
        "squares with free attacks, largest relative distance", 0.0, worst, worst < EXACT,
    )  # fmt: skip


def lemma_8_2(k: int = 2000, L: float = 0.01) -> Row:
    """Of x' = d_1, x measured with gain ``L``, d_1 = t measured: the error after ``k`` samples."""
    eps, error = 0.01, 0.0
    chi = 0.5 * eps**2
    for _ in range(k):
        error = (1.0 - L) * (error + chi)
    bound = (1.0 + L) * chi
    return claim(
        "Lemma 8.2", "|x_(k|k,e)| <= (1 + l c_3) chi: x' = d_1 = t, x and d_1 measured, L = 0.01, "
        f"after {k} samples, in units of the bound", "<= 1", error / bound, error <= bound,
        "(24) starts from x_e = 0 at every sample, but the error of the last one is carried on. Of "
        "what one sample adds, which is all that (25) uses, the next row holds.",
    )  # fmt: skip


def lemma_8_2_one(phi: float | None = None, rate: float = 50.0) -> Row:
    """x_e after one sample from 0, for attacks of slope 1, against chi."""
    eps, g1, g2 = 0.01, 1.0, 1.0
    tau = (np.arange(2000) + 0.5) * eps / 2000
    found = float(np.sum(np.exp(rate * (eps - tau)) * (g1 * tau + g2 * (eps - tau))) * eps / 2000)
    chi = (np.exp(rate * eps) if phi is None else phi) * (0.5 * g1 + g2) * eps**2
    return claim(
        "Lemma 8.2, one sample", "|x_e| <= chi where the sample began without error: x' = 50 x + "
        "d_1 + d_2, slopes 1, in units of chi", "<= 1", found / chi, found <= chi,
    )  # fmt: skip


def lemma_8_2_attack(g1: float = 10.0) -> Row:
    """Of x' = g1 d_1 + d_2, d_1 = t, d_2 = 0; x and d_1 measured without noise."""
    eps, k = 0.01, 7
    x = 0.5 * g1 * (eps * np.arange(k + 1)) ** 2
    found = float(abs((x[k] - x[k - 1]) / eps - g1 * eps * (k - 1)))
    return claim(
        "Lemma 8.2, d_2", "|d_(2,e)| <= eps dbar: x' = 10 d_1 + d_2, d_1 = t, d_2 = 0, x and d_1 "
        "measured without noise: |d^_2| in units of eps dbar", "<= 1", found / eps,
        found <= eps * (1 + 1e-9), "d^_2 takes what d_1 changes by within the sample.",
    )  # fmt: skip


def remark_5_1() -> Row:
    """What the proof's constants would have to be."""
    return unstated(
        "Remark 5.1", "the parameters can be obtained in the proof, the procedure is omitted", None,
        "With the constants of Claims B.1 to B.4 mended (their rows) alpha, b and c of a linear "
        "plant follow from p, pbar and Abar; for a nonlinear one there are none (Theorem 5.1).",
    )  # fmt: skip
