"""CARE's statements about stability (Assumption 10 to Theorem 13), computed."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from holdfast.detectors import chi_square
from holdfast.estimators import care
from holdfast.loop import Monitor, replay
from holdfast.papers.care_estimation import C, G, Step, printed_step
from holdfast.papers.care_projection import INSIDE, Case, errors, projected
from holdfast.papers.care_vehicle import PROCESS, STATE_ROWS, matrices
from holdfast.papers.rows import Row, claim, claim_over_seeds
from holdfast.plants.build import linear_plant
from holdfast.records import Observation

STUCK_STEPS = 200


def steps_along(speed: np.ndarray, x_cov: np.ndarray) -> list[Step]:
    """Lines 3 to 13 at every row of one run of CARE, from its projected covariances."""
    before = np.concatenate([np.eye(4)[None], x_cov[:-1]])
    A, G = matrices(speed)
    return [printed_step(A=a, G=g, P=p, add_q=True) for a, g, p in zip(A, G, before, strict=True)]


def assumption_10(speed, M, process=PROCESS, state_rows=STATE_ROWS) -> Row:
    """The bounds along a run, and the rank of the state's rows."""
    A, G = matrices(speed)
    norms = [float(np.max(np.linalg.norm(one, 2, axis=(1, 2)))) for one in (A, G, M)]
    rank, low = int(np.linalg.matrix_rank(state_rows)), float(np.min(process))
    return claim(
        "Assumption 10", "rank of the state's rows, bounds on |A|, |G|, |M|, lower bound on Q, "
        "along one run of the vehicle", "rank < 4, bounded, Q > 0", [rank, *norms, low],
        rank < 4 and bool(np.all(np.isfinite(norms))) and low > 0,
        "|M| grows like 1 / v: the limits 0 <= v admit no bound, the run's speeds do.",
    )  # fmt: skip


def remark_11(state_rows=STATE_ROWS) -> Row:
    """Rank against number of rows."""
    rank, count, n = int(np.linalg.matrix_rank(state_rows)), *state_rows.shape
    return claim(
        "Remark 11", "rank < n means fewer constraints than state variables: rank, constraints, n",
        "constraints < n", [rank, count, n], (rank < n) == (count < n),
        "The paper's own example has six constraints, of rank three, on four variables.",
    )  # fmt: skip


def theorem_12(G: np.ndarray = G) -> Row:
    """Whether the pair exists, C = I: C G M must have an inverse."""
    step = printed_step(G=G, add_q=True)
    felt = C @ G @ step.M
    rank, ny = int(np.linalg.matrix_rank(felt, tol=1e-9)), len(C)
    # a Z without correlation must solve Z (I - C G M) = -G M
    wanted, system = -G @ step.M, np.eye(ny) - felt
    solved = np.linalg.lstsq(system.T, wanted.T, rcond=1e-9)[0].T
    left = float(np.max(np.abs(solved @ system - wanted)))
    return claim(
        "Theorem 12", "its pair needs the inverse of C G M: rank, n_y; and a Z that decorrelates "
        "the noises: least residual", "rank n_y; 0", [rank, ny, left], rank == ny,
        "C G M has rank n_d < n_y. No Z decorrelates: Z (I - C G M) = -G M times C G reads "
        "0 = -G. Boundedness is for the Riccati recursion itself to show (next row).",
    )  # fmt: skip


def theorem_12_bounds(x_cov: np.ndarray) -> Row:
    """Bounds on P^{x,u} along a run, and no growth from its first half to its second."""
    values = np.linalg.eigvalsh(x_cov)
    low, high = float(values.min()), float(values.max())
    half = len(values) // 2
    grows = values[half:].max() > 1.01 * values[:half].max()
    return claim(
        "Theorem 12, bounds", "p I <= P^{x,u} <= p' I along one run of the vehicle, by the "
        "recursion: p, p'", None, [low, high], bool(low > 0 and not grows),
    )  # fmt: skip


def claim_14(case: Case = INSIDE, q: float = 0.01, r: float = 1.0) -> Row:
    """The contraction with A = C = I, Q = q I, R = r I, no attack, one active row x1 <= 0.

    With I in place of A the paper's bounds are a' = 1, q' = q. The ratio is the largest
    eigenvalue of the left-hand side relative to (P_{k-1})^{-1}.
    """
    eye = np.eye(2)
    after = projected(case)
    kept = eye - after.moved_along
    before, left = errors(case)
    shrink = float(left[0] / before[0])
    prior = after.cov + q * eye
    gain = prior @ np.linalg.inv(prior + r * eye)
    now = (eye - gain) @ prior
    through = (eye - gain) @ (kept + shrink * after.moved_along)
    root = np.linalg.cholesky(case.cov)
    ratio = np.linalg.eigvalsh(root.T @ through.T @ np.linalg.solve(now, through @ root))[-1]
    highest = max(np.linalg.eigvalsh(case.cov)[-1], np.linalg.eigvalsh(now)[-1])
    delta = 1.0 / (q / highest + 1.0)
    norm = float(np.linalg.norm(kept, 2))
    return claim(
        "Claim 14", "|I - gamma B| = 1 and contraction by delta < 1: the norm, the factor, delta",
        [1.0, "< delta", "in (0, 1)"], [norm, float(ratio), float(delta)],
        bool(abs(norm - 1.0) < 1e-9 and ratio < delta),
        "The projection is oblique; and the recursion (48) holds Gamma-bar, the error Gamma: what "
        "alpha > 0 lets through meets a covariance that projection made small. Also Q-bar >= q' I "
        "is false: (I - G M C) G = 0 for every attack.",
    )  # fmt: skip


def claim_15(scale: float = 0.1) -> Row:
    """The constant c as printed, with A = C = I, no attack, Q = R = scale^2 I, n = 2."""
    noise, P = scale**2, scale**2
    for _ in range(100):
        P = 1.0 / (1.0 / (P + noise) + 1.0 / noise)
    gain = P / noise
    left = (1.0 - gain) ** 2 / P * 2 * noise + gain**2 / P * 2 * noise
    printed = P * (1.0 + gain) ** 2 * noise * 2 + P * gain**2 * noise * 2
    return claim(
        "Claim 15", "the constant c bounds the noise terms: c as printed, the terms", printed,
        left, left <= printed,
        "The norm of P^-1 is bounded by 1/p, not by p' as printed; so c changes with the units. "
        "Here Q = R = 0.01 I. In c the sign of l c g m - l - g m must be + throughout.",
    )  # fmt: skip


def theorem_13(growth: float = 1.5, project: Literal["feedback", "output"] = "feedback") -> Row:
    """A projected state that never lets go of its face: errors that do not decay.

    x1 <= 0, x1_k = growth x1_{k-1} + u with the known u that holds x1 = -M, C = I; the attack
    enters x2 alone. The estimate starts at 0 with P_0 = 0.01 I. No noise is drawn: only one of
    hundreds of standard deviations would free the estimate.
    """
    plant = linear_plant(
        A=np.diag([growth, 0.5]), B=[[1.0], [0.0]], G=[[0.0], [1.0]], C=np.eye(2),
        Q=0.01 * np.eye(2), R=np.eye(2),
        constraints={"state": {"matrix": [[1.0, 0.0]], "bound": [0.0]}},
    )  # fmt: skip
    estimator = care.build(plant, np.zeros(2), 0.01 * np.eye(2), project=project)
    monitor = Monitor(estimator, chi_square.build(plant))
    depth = np.array([10.0, 1000.0])
    u = np.broadcast_to((growth - 1.0) * depth[:, None, None], (2, STUCK_STEPS, 1))
    y = np.zeros((2, STUCK_STEPS, 2))
    y[..., 0] = -depth[:, None]
    logs = jax.tree.map(jnp.asarray, Observation.of(u, y))
    x = np.asarray(eqx.filter_vmap(replay, in_axes=(None, 0))(monitor, logs).estimate.x)
    left = np.linalg.norm(x[:, -1] - y[:, -1], axis=1)
    return claim(
        "Theorem 13", "initial errors of 10 and 1000 decay to a level that the bounds alone give: "
        "mean error after 200 steps", "decays", left, bool(np.all(left < 0.05 * depth)),
        "Known bounds on A, C, G, M, Q and P^{x,u} (C = I: P^{x,u} <= R) leave the error as large "
        "as it began: projection on x1 <= 0 with P of (27) fed back locks an unstable state onto "
        "the face, here with P_0 = 0.01 I. A stable plant forgets, and so does a filter that runs "
        "without the projection (project = 'output').",
    )  # fmt: skip


def theorem_13_vehicle(right: np.ndarray, wrong: np.ndarray) -> Row:
    """Mean square state errors (seed, time) from the right and from a wrong start."""
    half = right.shape[1] // 2
    ratio = np.mean(wrong[:, half:], 1) / np.mean(right[:, half:], 1)
    settled = np.mean(right[:, half:]) < 2.0 * np.mean(right[:, :half])
    return claim_over_seeds(
        "Theorem 13, vehicle", "mean square state error over the second half, from a start 3 m "
        "off over that from the true one", 1.0, ratio, bool(np.all(ratio < 1.05) and settled),
        "On the vehicle a wrong start is forgotten and the error does not grow.",
    )  # fmt: skip
