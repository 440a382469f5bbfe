"""CARE's Theorem 13 on one plant: its constants as printed, and those that hold.

The printed proof needs Qbar = (I - G M C) Q (I - G M C)' to be positive definite, but
(I - G M C) G = 0 wherever the attack estimate is unbiased, so Qbar is singular as soon as
there is an attack: the printed delta is 1 and no rate is left. It needs ||I - gamma B|| = 1
too, which oblique projections exceed. The statement itself survives for the filter that runs
on unprojected, in its steady state: the noise of the measurement fills the directions that Qbar
leaves out, and a projection with the weight P^-1 onto a set that holds the truth does not
lengthen the error in that norm. Where P of (27) is carried on it can fail: an unstable plant
can be held on a face for ever (`holdfast papers care`, Theorem 13).
"""

import itertools
from typing import NamedTuple

import numpy as np

from holdfast.analysis.constrained import blue_gain, projection_gain, rank_condition
from holdfast.analysis.model import Model

MOST = 10_000
"""Steps for which the Riccati recursion may move."""
OVERFLOW = 1e100
"""A variance at which the recursion need not go on."""
SETTLED = 1e-12
"""Relative change of P in a step that counts as none."""
MOST_SETS = 4096
"""Active sets that are tried for the largest norm of a projection."""


class Statement(NamedTuple):
    """Something the proof assumes or claims: whether it ``holds`` here, and the number."""

    name: str
    holds: bool
    value: float
    why: str


class Constants(NamedTuple):
    """E|x_k - x_hat_k|^2 <= a exp(-b k) E|x_0 - x_hat_0|^2 + c_x, by V_k <= delta V_{k-1} + c."""

    delta: float
    c: float
    a: float
    b: float
    c_x: float


class Stability(NamedTuple):
    """``printed``: the paper's formulas, q' read as q (their text gives it no value), c_2 as
    c_y and the stray h as 1. ``holding``: constants that hold for the steady-state filter
    without projection (None where there is none). ``P``: its covariance.
    """

    assumptions: tuple[Statement, ...]
    claims: tuple[Statement, ...]
    printed: Constants | None
    holding: Constants | None
    P: np.ndarray | None


class Step(NamedTuple):
    """One step of Algorithm 1, lines 2 to 13: gains, closed loop and covariance.

    The error obeys e_k = ``loop`` e_{k-1} + noise of covariance ``noise``.
    """

    M: np.ndarray
    L: np.ndarray
    loop: np.ndarray
    noise: np.ndarray
    P: np.ndarray


def care_step(model: Model, P: np.ndarray) -> Step:
    """The unprojected covariance from one row to the next, line 9 corrected by + Q.

    Source: CARE, Algorithm 1 (lines 2 to 4, 9 to 11, 13) and (47).
    """
    A, G, C, _, Q, R = model[:6]
    M = blue_gain(C, G, A @ P @ A.T + Q, R)
    through = np.eye(len(A)) - G @ M @ C
    given = G @ M
    star = through @ (A @ P @ A.T + Q) @ through.T + given @ R @ given.T
    cross = star @ C.T - given @ R
    left = np.eye(len(R)) - C @ given
    # of rank ny - nd by construction: the directions of C G are spent on the attack
    spread = C @ through @ (A @ P @ A.T + Q) @ through.T @ C.T + left @ R @ left.T
    values, vectors = np.linalg.eigh((spread + spread.T) / 2)
    kept = slice(G.shape[1], None)
    L = cross @ (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    rest = np.eye(len(A)) - L @ C
    bar = L @ C @ given - L - given
    noise = rest @ through @ Q @ through.T @ rest.T + bar @ R @ bar.T
    loop = rest @ through @ A
    return Step(M, L, loop, noise, loop @ P @ loop.T + noise)


def stability(model: Model, P0: np.ndarray, state_rows: np.ndarray) -> Stability:
    """Assumption 10, Claims 14 and 15 and the constants of Theorem 13 for a constant plant.

    ``P0`` (n x n) starts the Riccati recursion, whose extreme eigenvalues are the bounds p
    and p_bar; ``state_rows`` (m x n) is the paper's B, the rows that constrain the state.
    Attacks on the outputs (H) are outside the theorem.

    Source: CARE, Assumption 10, Theorem 13, Claims 14 and 15, with the errata.
    """
    assumptions = _assumptions(model, state_rows)
    if not all(s.holds for s in assumptions if s.name in ("H = 0", "rank(C G) = nd")):
        return Stability(assumptions, (), None, None, None)
    steps, settled = _recursion(model, P0)
    low = min(float(np.linalg.eigvalsh(step.P)[0]) for step in steps)
    high = max(float(np.linalg.eigvalsh(step.P)[-1]) for step in steps)
    moving = f"the Riccati recursion still moves after {len(steps)} steps"
    assumptions += (
        Statement("P >= p I", low > 0, low, "smallest eigenvalue over the Riccati recursion"),
        Statement(
            "P <= p_bar I",
            settled,
            high,
            "largest eigenvalue over the Riccati recursion" if settled else moving,
        ),
    )
    if not (settled and low > 0):
        return Stability(assumptions, (), None, None, None)
    last = steps[-1]
    printed, holding = _printed(model, steps, low, high), _holding(last)
    claims = _claims(model, last, state_rows, printed, holding)
    return Stability(assumptions, claims, printed, holding, last.P)


def _recursion(model: Model, P0: np.ndarray) -> tuple[list[Step], bool]:
    P, steps = P0, []
    for _ in range(MOST):
        steps.append(care_step(model, P))
        if np.max(np.abs(steps[-1].P - P)) <= SETTLED * np.max(np.abs(P)):
            return steps, True
        P = steps[-1].P
        if np.max(P) > OVERFLOW:
            break
    return steps, False


def _assumptions(model: Model, rows: np.ndarray) -> tuple[Statement, ...]:
    n, rank = len(model.states), int(np.linalg.matrix_rank(rows)) if rows.size else 0
    lowest = float(np.linalg.eigvalsh(model.Q)[0])
    felt = rank_condition(model.C, model.G)
    nd = len(model.attacks)
    return (
        Statement("H = 0", not np.any(model.H), _norm(model.H), "no attack on the outputs"),
        Statement("rank(C G) = nd", felt.holds, felt.rank, f"nd = {nd}: the gain M exists"),
        Statement("rank(B) < n", rank < n, rank, f"n = {n}: some state direction is not limited"),
        Statement("Q >= q I", lowest > 0, lowest, "smallest eigenvalue of Q"),
    )


def _printed(model: Model, steps: list[Step], low: float, high: float) -> Constants:
    a, c, g = _norm(model.A), _norm(model.C), _norm(model.G)
    m, gain = max(_norm(step.M) for step in steps), max(_norm(step.L) for step in steps)
    q = float(np.linalg.eigvalsh(model.Q)[0])
    share = q / ((a * (1 + g * m * c)) ** 2 * high)
    process = _norm(model.Q) * int(np.linalg.matrix_rank(model.Q))
    sensors = _norm(model.R) * len(model.R)
    first = (1 + gain * c) ** 2 * (1 + g * m * c) ** 2 * process
    constant = high * (first + (gain * c * g * m - gain - g * m) ** 2 * sensors)
    delta = 1.0 / (1.0 + share)
    return Constants(
        delta, constant, high / low, float(np.log1p(share)), constant * high / (1.0 - delta)
    )


def _holding(step: Step) -> Constants:
    """V_k = e' P^-1 e with P = loop P loop' + noise: delta is the largest eigenvalue of
    P^-1/2 loop P loop' P^-1/2, and what the noise adds is tr(P^-1 noise).
    """
    values, vectors = np.linalg.eigh(step.P)
    white = (vectors / np.sqrt(values)) @ vectors.T
    delta = 1.0 - float(np.linalg.eigvalsh(white @ step.noise @ white)[0])
    added = float(np.trace(np.linalg.solve(step.P, step.noise)))
    rate = -float(np.log(delta)) if delta > 0 else np.inf
    c_x = values[-1] * added / (1.0 - delta) if delta < 1.0 else np.inf
    return Constants(delta, added, float(values[-1] / values[0]), rate, float(c_x))


def _claims(
    model: Model, step: Step, rows: np.ndarray, printed: Constants, holding: Constants
) -> tuple[Statement, ...]:
    through = np.eye(len(model.A)) - model.G @ step.M @ model.C
    spread = through @ model.Q @ through.T
    lowest = float(np.linalg.eigvalsh(spread)[0])
    largest = _largest_projection(step.P, rows)
    return (
        Statement(
            "Claim 14: Qbar >= q' I with q' > 0",
            lowest > 1e-12 * _norm(spread),
            lowest,
            "(I - G M C) G = 0, so Qbar is singular wherever there is an attack",
        ),
        Statement(
            "Claim 14: ||I - gamma B|| = 1",
            largest <= 1.0 + 1e-9,
            largest,
            "largest norm over the active sets: the projection is oblique",
        ),
        Statement(
            "Claim 14: contraction by delta",
            holding.delta <= printed.delta,
            holding.delta,
            f"without projection, against the printed delta of {printed.delta:.9g}",
        ),
        Statement(
            "Claim 15: noise adds at most c",
            holding.c <= printed.c,
            holding.c,
            f"tr(P^-1 noise), against the printed c of {printed.c:.4g}",
        ),
    )


def _largest_projection(P: np.ndarray, rows: np.ndarray) -> float:
    """The largest ||I - gamma B|| over independent active sets of under n rows; 1 without any."""
    n = len(P)
    sizes = range(1, min(len(rows), n - 1) + 1)
    sets = itertools.chain.from_iterable(itertools.combinations(range(len(rows)), m) for m in sizes)
    largest = 1.0
    for active in itertools.islice(sets, MOST_SETS):
        chosen = rows[list(active)]
        if np.linalg.matrix_rank(chosen) == len(active):
            largest = max(largest, _norm(np.eye(n) - projection_gain(P, chosen) @ chosen))
    return largest


def _norm(m: np.ndarray) -> float:
    return float(np.linalg.norm(m, 2)) if m.size else 0.0
