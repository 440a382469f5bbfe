"""INTEGRITY, Section V-A: the sum that stands for the SPRT, and what it stands for."""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import toeplitz
from scipy.optimize import root_scalar
from scipy.special import chdtrc, chndtr

from holdfast.papers.integrity_detection import risen
from holdfast.papers.integrity_systems import (
    EPSILON,
    VEHICLE,
    Policy,
    System,
    alpha,
    norms,
    under,
)
from holdfast.papers.rows import Row, claim

H = 8.399
"""Erratum 11's threshold; with p = 2, as on the vehicle."""
CELLS = 400
"""Of the test's statistic between its two thresholds."""


def equation_46(
    corrected: bool = False, p: int = 2, h: float = H, mean: float | None = None
) -> Row:
    """The mean of a step's log likelihood ratio without attack: E z'Q^-1 z = p."""
    drift = 0.5 * (p if mean is None else mean) + (-0.5 * p if corrected else -0.5 * h)
    id, power = ("(46), c with e^(-p/2)", "-p/2") if corrected else ("(46)", "-h/2")
    return claim(
        id, f"c = e^({power}) / sqrt((2 pi)^p det Q) makes the ratio Lambda_k zero without "
        "attack: its mean, p = 2, h = 8.399", 0.0, drift, abs(drift) < 1e-12,
        f"Zero in the mean alone: its deviation is sqrt(p/2) = {np.sqrt(p / 2):.3g} a step."
        if corrected else "The sum then falls by 3.2 a step and (47) does not follow.",
    )  # fmt: skip


def equation_47(
    corrected: bool = False,
    p: int = 2,
    h: float = H,
    off: float = 1.0,
    steps: Sequence[int] = (1, 10, 100),
) -> Row:
    """By how much alarms rise where (47) has equality, with the threshold that c makes."""
    rises = []
    for k in steps:
        threshold = 2.0 * h + k * (p if corrected else h)
        bound = off * float(alpha(np.array([k]), p, h)[0])
        rises.append(risen(bound**2, k * p, threshold) / EPSILON)
    id = "(47), c with e^(-p/2)" if corrected else "(47)"
    return claim(
        id, f"(16) for (46) with its e^({'-p/2' if corrected else '-h/2'}) is (47): rise of the "
        "alarms over epsilon where (47) has equality, k = 1, 10, 100", 1.0, rises,
        bool(np.max(np.abs(np.array(rises) - 1.0)) < 1e-6),
        "" if corrected else "As printed the threshold is 2h + kh.",
    )  # fmt: skip


def alarms(steps: Sequence[int] = (1, 10, 100, 10**4), h: float = 4.2, p: int = 2) -> Row:
    """The alarm rate of the sum without attack."""
    k = np.asarray(steps, float)
    rates = chdtrc(k * p, 2.0 * h + k * p)
    return claim(
        "Section V-A, alarms without attack", "the sum does not go above h without attack: "
        "P(chi2_kp > kp + 2h) at k = 1, 10, 100, 10^4, h = 4.2, p = 2", "small", rates,
        bool(np.all(rates < 0.05)),
        "It drifts to 1/2: the sum has no false-alarm level. The `sprt` detector is Wald's test "
        "with reset.",
    )  # fmt: skip


def alpha_grows(t: Sequence[int] = (10, 1000, 10**6), h: float = 4.2, p: int = 2) -> Row:
    """The bound of (47)."""
    found = alpha(np.asarray(t), p, h)
    return claim(
        "Section V-A, alpha(t)", "the bound alpha(epsilon, tp, 2h + tp) of a stealthy attack stays "
        "bounded in t: at t = 10, 10^3, 10^6, h = 4.2, p = 2", "bounded", found,
        found[-1] < 1.05 * found[-2],
        "It grows like t^(1/4): of all alarms without attack ever more can be had for epsilon.",
    )  # fmt: skip


def theorem_4(blocks: Sequence[int] = (3, 60, 300), of: System = VEHICLE, h: float = H) -> Row:
    """The largest error up to a block, on a plant that Theorem 4's policy protects."""
    policy = Policy(1, 20)
    sizes = norms(under(of, policy, max(blocks), h))
    found = [float(np.max(sizes[: policy.ends(b)[-1]])) for b in blocks]
    return claim(
        "Theorem 4, with the sum of (46)", "the error is bounded with f of (31): vehicle, f = 1, "
        "L = 20, largest error up to block 3, 60, 300", "bounded", found,
        found[-1] < 1.05 * found[-2],
        "Theorem 4 is about tests with a bounded alpha; alpha(t) grows like t^(1/4), and the "
        "errors with it.",
    )  # fmt: skip


def _rate(shift2: float, p: int, h: float, low: float) -> float:
    """Alarms per step of g <- g + z'Q^-1 z / 2 - p / 2, back to 0 above h and below -low."""
    edges = np.linspace(-low, h, CELLS + 1)
    width, middle = edges[1] - edges[0], 0.5 * (edges[1:] + edges[:-1])

    def below(rise: np.ndarray) -> np.ndarray:
        return chndtr(np.maximum(2.0 * rise + p, 0.0), p, shift2)

    steps = width * np.arange(-CELLS, CELLS + 1)
    mass = below(steps + 0.5 * width) - below(steps - 0.5 * width)
    move = toeplitz(mass[CELLS::-1], mass[CELLS:])[:CELLS, :CELLS]
    alarm = 1.0 - below(h - middle)
    zero = int(np.argmin(np.abs(middle)))
    move[:, zero] += 1.0 - np.sum(move, 1)
    balance = np.vstack([(move.T - np.eye(CELLS))[1:], np.ones(CELLS)])
    share = np.linalg.solve(balance, np.append(np.zeros(CELLS - 1), 1.0))
    return float(share @ alarm)


def lower_threshold(t: int = 10**4, p: int = 2, h: float = 4.2, low: float = 4.2) -> Row:
    """A constant shift that Wald's test with both thresholds lets pass at every step."""
    calm = _rate(0.0, p, h, low)

    def gap(shift2: float) -> float:
        return _rate(shift2, p, h, low) - calm - EPSILON

    most = float(root_scalar(gap, bracket=(1e-6, 10.0), xtol=1e-9).root)
    allowed = float(alpha(np.array([t]), p, h)[0]) ** 2
    return claim(
        "Section V-A, the lower threshold", "decisions for H0 only constrain the attacker: sum of "
        "|dz|^2 over 10^4 steps that Wald's test lets pass, and alpha(t)^2", "<= alpha(t)^2",
        [most * t, allowed], most * t <= allowed,
        "Each decision for H0 starts the sum anew: a constant shift raises the alarms by epsilon "
        "at every step, for ever. Thresholds 4.2 and -4.2, p = 2.",
    )  # fmt: skip
