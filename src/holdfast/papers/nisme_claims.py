"""The proof of NISME's Theorem 5.1 judged: Claims B.1 to B.5 and the constants in them.

Bars under and over p cannot be told apart in the text at hand: where a bound has p, it is taken as
the larger of the two, which is the more generous reading here.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from holdfast.papers.rows import Row, claim


class Plane(NamedTuple):
    """x_1 moved by an attack and x_2 not, both measured, eps = 1, A = 0: a case of all constants.

    ``q``: of w; ``r2``, ``r3``: of the sensors of x_1 and x_2. Abar = diag(0, 1),
    Qbar = diag(r2, q), C_3 = (0, 1), P = diag(r2, p).
    """

    q: float
    r2: float
    r3: float

    @property
    def p(self) -> float:
        """The steady variance of x_2."""
        before = 0.5 * (self.q + np.sqrt(self.q**2 + 4.0 * self.q * self.r3))
        return float(before * self.r3 / (before + self.r3))

    @property
    def L(self) -> float:
        """The steady gain for x_2."""
        return self.p / self.r3

    @property
    def ends(self) -> tuple[float, float]:
        """The least and the largest eigenvalue of P."""
        return min(self.p, self.r2), max(self.p, self.r2)


NOISY = Plane(1e-4, 100.0, 1.0)
SMALL = Plane(1e-2, 1e-3, 1e-2)


def lower_q(of: Plane = NOISY) -> Row:
    """Q of Section 8.3.2, max of its two terms, against the least eigenvalue of Qbar."""
    q, least = max(of.r2, of.q), min(of.r2, of.q)
    return claim(
        "Section 8.3.2, q", "q I <= Qbar with q the larger of eps^2 g2^2 m2^2 r2 and eps^2 q': "
        "least eigenvalue of Qbar, q' = 1e-4, r2 = 100", f">= {q:g}", least, least >= q,
        "One term bounds Qbar on the range of G_2, the other beside it: the smaller is meant.",
    )  # fmt: skip


def upper_q(of: Plane = SMALL) -> Row:
    """Qbar's bound, with (qbar' + g1 m1 r1)^2 squared as printed."""
    bound, largest = 4.0 * of.q**2 + of.r2, max(of.r2, of.q)
    return claim(
        "Section 8.3.2, qbar", "Qbar <= qbar I with (qbar' + g1 m1 r1)^2 in qbar: largest "
        "eigenvalue, q' = 0.01, r2 = 0.001", f"<= {bound:.4g}", largest, largest <= bound,
        "A variance squared: qbar' + g1^2 m1^2 r1 is meant.",
    )  # fmt: skip


def equation_27(of: Plane = SMALL) -> Row:
    """V = x~' P^-1 x~ against pbar |x~|^2."""
    V = 1.0 / of.ends[0]
    return claim(
        "Section 8.3.2, V", "V = x~' P^-1 x~ <= pbar |x~|^2, used in (27): largest V, |x~| = 1",
        f"<= {of.ends[1]:.3g}", V, of.ends[1] >= V, "1/p is meant, p I <= P.",
    )  # fmt: skip


def claim_b_1(corrected: bool = False, of: Plane = NOISY, factor: float = 1.0) -> Row:
    """Decay of Abar'(I-LC)'P^-1(I-LC)Abar against P^-1, along x_2 where it is largest."""
    decay = (1.0 - of.L) ** 2
    q = of.q if corrected else max(of.r2, of.q)
    alpha = factor / (1.0 + q / (2.0 * 2.0**2 * of.ends[1]))
    says = ", q = eps^2 q'" if corrected else ""
    return claim(
        f"Claim B.1{says}", "V shrinks by alpha' = 1/(1 + q/(2 abar^2 pbar)) in a step without "
        f"noise, q {'that of Q' if corrected else 'of Section 8.3.2'}: what it shrinks by",
        f"< {alpha:.7g}", decay, decay < alpha,
    )  # fmt: skip


def claim_b_2(corrected: bool = False, of: Plane = SMALL, factor: float = 1.0) -> Row:
    """E vbar' P^-1 vbar against epsilon_0; l = pbar c_3 r_3 as printed, or pbar c_3 / r_3."""
    found = 1.0 + ((1.0 - of.L) ** 2 * of.q + of.L**2 * of.r3) / of.p
    low, high = of.ends
    weight = 1.0 / low if corrected else high
    gain = high / of.r3 if corrected else high * of.r3
    inner = (1.0 + 1.0) ** 2 * of.q * 2.0 + of.r2
    bound = factor * weight * ((1.0 + gain) ** 2 * inner + gain**2 * of.r3)
    return claim(
        f"Claim B.2{', 1/p' if corrected else ''}", "E vbar' P^-1 vbar <= epsilon_0 of its proof"
        f"{', P^-1 <= I/p and |L| <= pbar c_3 / r_3 in it' if corrected else ', p taken as pbar'}",
        f"<= {bound:.3g}", found, found <= bound,
        "" if corrected else "P^-1 is bounded by 1/p, not by p.",
    )  # fmt: skip


def epsilon_0(smallest: float = 1e-6, apart: bool = False) -> Row:
    """E vbar' P^-1 vbar for smaller and smaller noise; ``apart``: with P kept."""
    found = []
    for scale in np.geomspace(1.0, smallest, 3):
        of = Plane(SMALL.q * scale, SMALL.r2 * scale, SMALL.r3 * scale)
        one = 1.0 + ((1.0 - of.L) ** 2 * of.q + of.L**2 * of.r3) / of.p
        found.append(float(one * (scale if apart else 1.0)))
    return claim(
        "Section 8.3.2, epsilon_0", "tends to 0 with the noise: E vbar' P^-1 vbar for noise of "
        "variances times 1, 1e-3, 1e-6", 0.0, found, found[-1] < 0.01,
        "P becomes smaller with the noise. So does pbar, which is what (27) needs.",
    )  # fmt: skip


def claim_b_3(w: float = 0.1, bend: float = 0.1, of: Plane = SMALL) -> Row:
    """Its left side where x~_(k-1) = 0 and w moves x_2, seen as x_2 + ``bend`` x_2^2."""
    psi = of.L * bend * w**2
    found = psi**2 / of.p
    return claim(
        "Claim B.3", "at x~_(k-1) = 0 it is epsilon_1 at most, which is 0 here: left side with "
        "h_3 = x + 0.1 x^2, after w = 0.1", 0.0, found, found <= 0.0,
        "psi_3 is a function of x~_(k|k-1), which has w in it: no multiple of |x~_(k-1)|^2 bounds "
        "it, nor does any constant, for Gaussian w.",
    )  # fmt: skip


def claim_b_4(corrected: bool = False, chi: float = 0.1, of: Plane = SMALL, factor: float = 1.0):
    """Its left side at x~ = 0 and x_e = ``chi`` along x_2, without linearisation error."""
    low, high = of.ends
    found = (1.0 - of.L) ** 2 * chi**2 / of.p
    p, gain = (1.0 / low, high / of.r3) if corrected else (high, high * of.r3)
    bound = factor * p * (1.0 + gain) * (1.0 + gain) * (2.0 * 2.0 + chi) * chi
    return claim(
        f"Claim B.4{', 1/p' if corrected else ''}", "the terms with x_e are epsilon_2 at most at "
        f"x~ = 0, {'1/p for p and |L| <= pbar c_3 / r_3 in it' if corrected else 'p as pbar'}: "
        "left side, x_e = 0.1", f"<= {bound:.3g}", found, found <= bound,
    )  # fmt: skip


def claim_b_5(k: int = 10_000, memory: float = 0.5, size: float = 3.0) -> Row:
    """P(mu <= k), (29): the error of a scalar filter leaves +-3 standard deviations by then."""
    edges = np.linspace(-size, size, 401)
    x = 0.5 * (edges[1:] + edges[:-1])
    K = np.diff(
        ndtr((edges[None, :] - memory * x[:, None]) / np.sqrt(1.0 - memory**2)), axis=1
    )  # fmt: skip
    start = np.zeros(len(x))
    start[len(x) // 2] = 1.0
    left = 1.0 - float(np.sum(start @ np.linalg.matrix_power(K, k)))
    bound = 1.0 / size**2
    return claim(
        "Claim B.5", f"(29): P(the error ever leaves delta = {size:g} sd) <= (V_0 + c/(1-alpha)) P "
        f"/ delta^2, scalar linear filter from 0: by step {k}", f"<= {bound:.3g}", left,
        left <= bound,
        "(28) applies E V_k <= alpha E V_(k-1) + c at a stopped time: V stays above delta^2/P once "
        "stopped, and every step adds to that. P(|x~_k| > delta) at one k is another matter.",
    )  # fmt: skip


def lemma_8_2_gain(corrected: bool = False, of: Plane = SMALL, factor: float = 1.0) -> Row:
    """|L| against pbar c_3 r_3, or pbar c_3 / r_3."""
    bound = factor * (of.ends[1] / of.r3 if corrected else of.ends[1] * of.r3)
    says = "pbar c_3 / r_3" if corrected else "pbar c_3 r_3"
    return claim(
        f"Lemma 8.2, l = {says}", f"|L_k| <= {says}: |L|, r_3 = 0.01", f"<= {bound:.3g}", of.L,
        bound * (1 + 1e-12) >= of.L,
        "" if corrected else "As the text at hand has it; L = P_k C_3' R_3^-1 is what is bounded.",
    )  # fmt: skip
