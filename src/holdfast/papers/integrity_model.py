"""INTEGRITY's model of the attacked filter: covariances, the shifts (10) and (11), Theorem 2."""

from collections.abc import Sequence

import numpy as np
from numpy.random import default_rng
from scipy.linalg import solve_discrete_lyapunov
from scipy.special import chdtrc, ndtr

from holdfast.numerics.noncentral import alphas
from holdfast.numerics.quadratic_reach import largest
from holdfast.papers.integrity_detection import risen
from holdfast.papers.integrity_systems import (
    EPSILON,
    ROUNDING,
    VEHICLE,
    System,
    drawn,
    maps,
    moved,
)
from holdfast.papers.rows import Row, claim


def spread(of: System) -> np.ndarray:
    """Cov(e_k) of (5), from what drives it: e = (A - KCA) e + (I - KC) w - K v."""
    left = np.eye(len(of.A)) - of.K @ of.C
    return solve_discrete_lyapunov(left @ of.A, left @ of.W @ left.T + of.K @ of.R @ of.K.T)


def _gap(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.max(np.abs(a - b)) / max(np.max(np.abs(b)), 1e-300))


def _gain(of: System, sigma: np.ndarray) -> np.ndarray:
    return np.linalg.solve(of.C @ sigma @ of.C.T + of.R, of.C @ sigma).T


def equation_3(predicted: bool = False, plants: Sequence[System] | None = None) -> Row:
    """K and Q of (3) and (4) from Cov(e_k), or from the covariance before the sample."""
    off = 0.0
    for of in [VEHICLE, *drawn(30, 3)] if plants is None else plants:
        sigma = of.P_pred if predicted else spread(of)
        off = max(off, _gap(_gain(of, sigma), of.K), _gap(of.C @ sigma @ of.C.T + of.R, of.S))
    if predicted:
        id, what, note = "(3), (4), a priori", "with the covariance of x_k before sample k", ""
    else:
        id, what = "(3), (4)", "with Sigma the covariance of the estimation error e_k of (5)"
        note = "Of x - x^ after the sample; (3) and (4) need the one before it (next row)."
    return claim(
        id, f"K and Q = C Sigma C' + R {what}: largest relative distance from the filter's K and "
        "E zz'", 0.0, off, off < 1e-7, note,
    )  # fmt: skip


def equation_10(count: int = 20, steps: int = 30, off: float = 0.0) -> Row:
    """The plant and its filter run twice with one noise, in closed loop, without and with a_k."""
    rng, worst = default_rng(4), 0.0
    for of in drawn(count, 4):
        n, p = len(of.A), len(of.C)
        B, G = rng.normal(size=(n, 1)), 0.1 * rng.normal(size=(1, n))
        w, v, a = (rng.normal(size=(steps, k)) for k in (n, p, p))
        calm, hit = (_run(of, B, G, w, v, attack) for attack in (0.0 * a, a))
        e, z = moved(of, (1.0 + off) * a)
        worst = max(worst, _gap(hit[0] - calm[0], e), _gap(hit[1] - calm[1], z))
    return claim(
        "(10), (11)", "the shifts of error and residue follow them: largest relative distance "
        "from two runs of plant, filter and feedback with one noise", 0.0, worst, worst < 1e-7,
        "So that (12) holds too: the shift is the same in every run.",
    )  # fmt: skip


def _run(of: System, B, G, w, v, a) -> tuple[np.ndarray, np.ndarray]:
    x = known = np.zeros(len(of.A))
    errors, residues = [], []
    for noise, sensor, attack in zip(w, v, a, strict=True):
        u = -G @ known
        x = of.A @ x + B @ u + noise
        known = of.A @ known + B @ u
        residues.append(of.C @ x + sensor + attack - of.C @ known)
        known = known + of.K @ residues[-1]
        errors.append(x - known)
    return np.array(errors), np.array(residues)


def remark_1(late: int = 5, before: float = 0.0) -> Row:
    """An attack that starts later, over what happens before it."""
    rng, worst = default_rng(5), 0.0
    for of in drawn(20, 5):
        a = rng.normal(size=(10, len(of.C)))
        early, delayed = np.full((late, len(of.C)), before), moved(of, a)[0]
        worst = max(worst, _gap(moved(of, np.vstack([early, a]))[0][late:], delayed))
    return claim(
        "Remark 1", "without loss of generality the attack starts at k = 1: distance of one that "
        "starts at 6 from the same one, moved", 0.0, worst, worst < ROUNDING,
    )  # fmt: skip


def equation_13(corrected: bool = False, of: System = VEHICLE) -> Row:
    """Cov(e_k) of the vehicle against the Sigma of (3)."""
    said = (np.eye(len(of.A)) - of.K @ of.C) @ of.P_pred if corrected else of.P_pred
    ours = spread(of)
    gap = _gap(ours, said)
    id, name = ("(13), (I - KC) Sigma", "(I - KC) Sigma") if corrected else ("(13)", "Sigma")
    return claim(
        id, f"Cov(e^a_k) = Cov(e_k) = {name} of (3): trace of {name}, and of Cov(e_k) by its own "
        "recursion, on the vehicle", float(np.trace(said)), float(np.trace(ours)), gap < 1e-8,
        "" if corrected else "The Sigma that makes (3) and (4) right is the a-priori one.",
    )  # fmt: skip


def definition_2(sizes: Sequence[float] = (0.0, 3.0, 10.0, 100.0), gamma: float = 9.0) -> Row:
    """One state of variance 1: where the error of the largest attack lies."""
    m = np.asarray(sizes)
    edge = np.sqrt(m**2 + gamma)
    inside = ndtr(edge - m) - ndtr(-edge - m)
    wanted = float(ndtr(np.sqrt(gamma)) - ndtr(-np.sqrt(gamma)))
    return claim(
        "Definition 2", "gamma sets the confidence with which e^a_k is in R_k: probability at "
        "gamma = 9, one state, largest shift 0, 3, 10, 100 deviations", wanted, inside,
        bool(np.all(inside >= wanted - 1e-6)),
        "e e' <= m m' + gamma Cov leaves ever less room beyond m: to 1/2 for any gamma. The sum of "
        "the set of m and of e' Cov^-1 e <= gamma keeps the confidence.",
    )  # fmt: skip


def theorem_2(count: int = 12, steps: int = 5, scale: float = 1.0) -> Row:
    """The largest first error under both norms, exactly: one quantity, a limit on every step."""
    low, high = np.inf, 0.0
    for of in drawn(count, 6):
        _, N = maps(of, np.ones((steps, len(of.C)), bool))
        B = maps(of, np.ones((steps, len(of.C)), bool))[0][-1][:1]
        half = np.linalg.cholesky(of.S)
        w, b = np.eye(steps), np.ones(steps)
        plain = largest(N, w, b, B).upper
        white = largest(np.linalg.solve(half, N), w, b, B).upper
        values = np.linalg.eigvalsh(of.S)
        low = min(low, scale * white / plain / np.sqrt(values[0]))
        high = max(high, scale * white / plain / np.sqrt(values[-1]))
    return claim(
        "Theorem 2", "R_k is bounded iff R^_k is: ratio of their sizes over sqrt(lambda_min), "
        "least, and over sqrt(lambda_max), largest, random plants", [">= 1", "<= 1"],
        [low, high], low >= 1.0 - 1e-6 and high <= 1.0 + 1e-6,
        "For one k both are always bounded; the factors do not depend on k, so that it holds of "
        "the unions too. Lemmas 1 and 2 are needed in their corrected form.",
    )  # fmt: skip


def theorem_2_norms(
    root: bool = False, plants: Sequence[System] | None = None, off: float = 1.0
) -> Row:
    """The two norms of random shifts."""
    rng, most = default_rng(7), 0.0
    for of in [VEHICLE, *drawn(30, 7)] if plants is None else plants:
        values = np.linalg.eigvalsh(of.S)
        z = rng.normal(size=(200, len(of.C)))
        white = np.sqrt(np.sum(z * np.linalg.solve(of.S, z.T).T, 1)) / np.linalg.norm(z, axis=1)
        power = 0.5 if root else 1.0
        most = max(most, off * float(np.max(white) * values[0] ** power))
        most = max(most, float(1.0 / np.min(white) / values[-1] ** power))
    name = "1/sqrt(lambda)" if root else "1/lambda"
    return claim(
        f"Theorem 2, {name}", f"|z|_2 / l_max <= |z|_Q^-1 <= |z|_2 / l_min, l the "
        f"{'roots of ' if root else ''}eigenvalues of Q: largest factor by which one fails",
        "<= 1", most, most <= 1.0 + 1e-9,
        "" if root else "The square roots are missing; bounded is bounded all the same.",
    )  # fmt: skip


def remark_3(h: float = 9.0, p: int = 1, grows: bool = False, last: int = 200) -> Row:
    """Lemma 1 with T = k: shifts within the alpha of k at an earlier step k'."""
    steps = np.arange(1, last + 1)
    if grows:
        thresholds = 2.0 * h + steps * p
    else:
        thresholds = np.full(len(steps), h)
        steps = steps[chdtrc(steps * p, h) < 1.0 - 1.1 * EPSILON]
    thresholds = thresholds[: len(steps)]
    alpha = alphas(EPSILON, steps * p * 1.0, thresholds)
    each = alpha[-1] / np.sqrt(steps[-1])
    rises = [
        risen(k * each**2, k * p, x) / EPSILON
        for k, x in zip(steps.tolist(), thresholds.tolist(), strict=True)
    ]
    single = alphas(EPSILON, np.full(len(steps), p), thresholds)
    beyond = float(np.max(alpha / single))
    most = float(np.max(rises))
    id = "Remark 3, threshold 2h + kp" if grows else "Remark 3"
    said = "2h + kp" if grows else "h"
    return claim(
        id, f"Lemmas 1, 2 hold of a sum over all steps, threshold {said}: last k, rise over "
        "epsilon before it within alpha_k, stealthy over upper alpha",
        [None, "<= 1", "<= 1"], [int(steps[-1]), most, beyond],
        most <= 1.0 + 1e-6 and beyond <= 1.0 + 1e-6,
        f"h = {h:g}, p = {p}, c = 1."
        + ("" if grows else " With a fixed h the alarms tend to 1 and alpha_k to infinity: "
           "what is within it at k is not stealthy before."),
    )  # fmt: skip


def equation_53(corrected: bool = False, of: System = VEHICLE) -> Row:
    """The Sigma of gamma Sigma in (53) against Cov(e)."""
    said = (np.eye(len(of.A)) - of.K @ of.C) @ of.P_pred if corrected else of.P_pred
    ours = spread(of)
    off = float(np.max(np.abs(said - ours)) / np.max(np.abs(ours)))
    id, name = ("(53), (I - KC) Sigma", "(I - KC) Sigma") if corrected else ("(53)", "Sigma")
    return claim(
        id, f"gamma Cov(e^a_k) is gamma {name} of (3): relative difference of {name} from Cov(e_k) "
        "on the vehicle", 0.0, off, off < 1e-8,
        "" if corrected else "As in (13): the region is then larger than meant.",
    )  # fmt: skip


def gamma(count: int = 40, seed: int = 36, scale: float = 1.0) -> Row:
    """Union over m m' <= Y~ of {e e' <= m m' + gamma Sigma}: the least e'(m m' + ..)^-1 e of an
    e on the edge of (53), its m from (Y~^-1 + (gamma Sigma)^-1)^-1 (gamma Sigma)^-1 e.
    """
    rng, low, high = default_rng(seed), np.inf, 0.0
    for n in (2, 3):
        for _ in range(count):
            Y, spread_ = (m @ m.T for m in rng.normal(size=(2, n, n)))
            e = np.linalg.cholesky(Y + spread_) @ rng.normal(size=n)
            e *= scale / np.sqrt(e @ np.linalg.solve(Y + spread_, e))
            m = np.linalg.solve(
                np.linalg.inv(Y) + np.linalg.inv(spread_), np.linalg.solve(spread_, e)
            )
            m /= np.sqrt(m @ np.linalg.solve(Y, m))
            value = float(e @ np.linalg.solve(np.outer(m, m) + spread_, e))
            low, high = min(low, value), max(high, value)
    return claim(
        "(53), gamma", "{ee' <= Y~ + gamma Sigma} is the union of (41) over mm' <= Y~: least and "
        "largest e'(mm' + gamma Sigma)^-1 e, e on its edge, best m", [1.0, 1.0], [low, high],
        abs(low - 1.0) < 1e-6 and abs(high - 1.0) < 1e-6,
        "What the set has to do with a confidence is Definition 2's row.",
    )  # fmt: skip
