"""CARE's statements about the projection (Lemma 5 to Theorem 9), each on its counterexample.

The product's `project` gives the projected point and the active rows; the paper's gain and
covariance follow from those.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import chdtri, chndtr

from holdfast.numerics.projection import project
from holdfast.papers.care_vehicle import LEVEL
from holdfast.papers.rows import Row, claim

ROUNDING = 1e-9
_project = jax.jit(project)


class Case(NamedTuple):
    """An estimate with its covariance, the limits rows z <= bound, and the truth."""

    cov: np.ndarray
    rows: np.ndarray
    bound: np.ndarray
    truth: np.ndarray
    estimate: np.ndarray


OBLIQUE = Case(
    cov=np.array([[1.0, 10.0], [10.0, 101.0]]),
    rows=np.array([[1.0, 0.0]]),
    bound=np.zeros(1),
    truth=np.zeros(2),
    estimate=np.array([1.0, 0.0]),
)
"""The truth lies on the face x1 <= 0; the projection moves along (1, 10)."""
INSIDE = OBLIQUE._replace(truth=np.array([-1.0, 0.0]))
WEDGE = Case(
    cov=np.eye(2),
    rows=np.array([[1.0, 0.0], [1.0, 1.0]]),
    bound=np.zeros(2),
    truth=np.array([-3.0, 2.0]),
    estimate=np.array([2.0, 1.0]),
)
"""Both rows are active, and not orthogonal."""
CLIPPED = Case(
    cov=np.eye(2),
    rows=np.array([[1.0, 0.0]]),
    bound=np.array([3.0]),
    truth=np.array([3.0, 0.8]),
    estimate=np.array([3.3, 0.1]),
)
"""An attack that satisfies Assumption 7, found before projection and lost by it."""


class Projected(NamedTuple):
    """A projected estimate, the active rows, the paper's gain gamma times them, and (27)."""

    point: np.ndarray
    active: np.ndarray
    moved_along: np.ndarray
    cov: np.ndarray


def projected(case: Case) -> Projected:
    """The estimate on its limits, with gamma and the covariance of (26), (27)."""
    cov = case.cov
    found = _project(*map(jnp.asarray, (case.estimate, cov, case.rows, case.bound)))
    active = case.rows[np.asarray(found.active)]
    gain = cov @ active.T @ np.linalg.inv(active @ cov @ active.T)
    keep = np.eye(len(cov)) - gain @ active
    return Projected(np.asarray(found.point), active, gain @ active, keep @ cov @ keep.T)


def errors(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """The estimation error before and after projection."""
    return case.truth - case.estimate, case.truth - projected(case).point


def size(error, weight) -> float:
    """The norm of an error with a weight."""
    return float(np.sqrt(error @ weight @ error))


def covariance_of_projected(id: str, case: Case = INSIDE) -> Row:
    """(22) or (27) across an active face against the square of the error there."""
    after = projected(case)
    printed = float((after.active @ after.cov @ after.active.T)[0, 0])
    actual = float((after.active @ (case.truth - after.point))[0] ** 2)
    return claim(
        id, "error variance across an active face, as Algorithm 1 uses it for every truth: as "
        "printed, and the error squared", printed, actual, abs(actual - printed) < ROUNDING,
        "Right if the truth lies on the face, as the text says; lines 16 and 19 cannot know that "
        "and use it always. Here the truth is one standard deviation inside.",
    )  # fmt: skip


def lemma_5(case: Case = WEDGE) -> Row:
    """The factors alpha of (32), which must lie in [0, 1), and the identity (31)."""
    after = projected(case)
    before, left = errors(case)
    across, was = after.moved_along @ left, after.moved_along @ before
    unchanged = (left - across) - (before - was)
    alpha = np.divide(across, was, out=np.zeros_like(was), where=np.abs(was) > ROUNDING)
    holds = (
        np.max(np.abs(unchanged)) < ROUNDING
        and np.allclose(across, alpha * was, rtol=0, atol=ROUNDING)
        and bool(np.all((alpha >= 0) & (alpha < 1)))
    )
    return claim(
        "Lemma 5", "(31) holds and every alpha of (32) lies in [0, 1): alpha with two active rows",
        "in [0, 1)", alpha, holds,
        "(31) holds, (32) fails: P = I, x1 <= 0, x1 + x2 <= 0, truth (-3, 2), estimate (2, 1). "
        "With one active row, or orthogonal ones in the metric, both hold.",
    )  # fmt: skip


def equation_33(case: Case = OBLIQUE) -> Row:
    """(I - gamma B)' gamma B, and the same with the weight P^{-1} between."""
    moved = projected(case).moved_along
    kept = np.eye(len(case.cov)) - moved
    plain = float(np.max(np.abs(kept.T @ moved)))
    weighted = float(np.max(np.abs(kept.T @ np.linalg.solve(case.cov, moved))))
    return claim(
        "(33)", "(I - gamma B)' gamma B = 0: largest entry", 0.0, plain, plain < ROUNDING,
        f"With the weight P^-1 between them it is {weighted:.1g}: the projection is oblique.",
    )  # fmt: skip


def theorem_6(case: Case = OBLIQUE) -> Row:
    """Euclidean errors before and after projection, and the order of the covariances."""
    before, after = errors(case)
    shrinks = np.linalg.norm(after) <= np.linalg.norm(before) + ROUNDING
    drop = np.linalg.eigvalsh(case.cov - projected(case).cov)[0]
    return claim(
        "Theorem 6", "projection never enlarges the Euclidean error: error before, after",
        "|x~| <= |x~u|", [np.linalg.norm(before), np.linalg.norm(after)],
        bool(shrinks and drop > -ROUNDING * np.trace(case.cov)),
        "P = [[1, 10], [10, 101]], x1 <= 0, truth 0: the estimate (1, 0) moves to (0, -10).",
    )  # fmt: skip


def theorem_6_weighted(case: Case = OBLIQUE) -> Row:
    """The same errors in the norm in which the projection is the shortest."""
    weight = np.linalg.inv(case.cov)
    before, after = (size(e, weight) for e in errors(case))
    return claim(
        "Theorem 6, weight P^-1", "the same in the norm weighted with P^-1: error before, after",
        None, [before, after], after <= before + ROUNDING,
        "What does hold, for every truth in the set: the projection is the nearest point there.",
    )  # fmt: skip


def theorem_6_strict(case: Case = OBLIQUE) -> Row:
    """The rank of P^u - P: strict order needs all of n."""
    gone = case.cov - projected(case).cov
    rank = int(np.linalg.matrix_rank(gone, tol=ROUNDING * np.trace(case.cov)))
    return claim(
        "Theorem 6, strict order", "P^x < P^{x,u} strictly once a row is active: rank of the "
        "difference, n", "rank n", [rank, len(gone)], rank == len(gone),
        "The difference has the rank of the active rows, here 1: the order holds, not strictly.",
    )  # fmt: skip


def remark_8(noncentrality: float | None = None, level: float = LEVEL) -> Row:
    """Power of the chi-square test against an attack just too small for Assumption 7 (ii)."""
    threshold = chdtri(2, level)
    shift = 0.999 * threshold if noncentrality is None else noncentrality
    power = 1.0 - chndtr(threshold, 2, shift)
    return claim(
        "Remark 8", "an attack with d' P^-1 d at most the threshold cannot be told from noise: "
        "probability of its alarm", level, power, power <= level + ROUNDING,
        "Right below the threshold (two degrees of freedom) more than every second row alarms.",
    )  # fmt: skip


def theorem_9(case: Case = CLIPPED) -> Row:
    """One row that satisfies Assumption 7: the test before and after projection.

    The statistics: before, after with the weight (P^{d,u})^{-1}, after with the pseudo-inverse
    of P^d (its null space is that of the active rows).
    """
    threshold = chdtri(2, LEVEL)
    weight = np.linalg.inv(case.cov)
    small = np.linalg.norm(case.truth - case.estimate) < 0.5 * np.linalg.norm(case.truth)
    large = size(case.truth, weight) ** 2 > threshold
    after = projected(case)
    free = np.linalg.svd(after.active)[2][len(after.active) :].T
    inside = free.T @ after.point
    pseudo = (
        float(inside @ np.linalg.solve(free.T @ after.cov @ free, inside)) if free.size else 0.0
    )
    before, weighted = size(case.estimate, weight) ** 2, size(after.point, weight) ** 2
    lost = before > threshold and min(weighted, pseudo) <= threshold
    return claim(
        "Theorem 9", "projection finds whatever the free estimate finds: statistic before, after "
        "(weight P^u^-1), after (pseudo-inverse)", f"> {threshold:.3f} throughout",
        [before, weighted, pseudo], bool(small and large and not lost),
        "P^d is singular, so (P^d)^-1 of (37) does not exist. P^u = I, d1 <= 3, d = (3, 0.8), "
        "d^u = (3.3, 0.1): Assumption 7 holds. With 0 in the set |d^|_W <= |d^u|_W always.",
    )  # fmt: skip
