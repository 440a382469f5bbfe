"""How far an attacker's moves can carry a quantity while every bounded energy stays bounded.

    maximise |B theta|   subject to   theta' M_j theta <= b_j,   M_j = sum_i w_ji Z_i' Z_i

theta (d,) are the moves, Z_i (r x d) their shift of the whitened residual at step i; a constraint
is a step, a window or a sum up to a time. From above, the S-procedure: mu >= 0 with
sum_j mu_j M_j >= B'B proves |B theta|^2 <= b'mu. The least b'mu is the largest tr(B X B') over
X >= 0, tr(M_j X) <= b_j, and exact where B has one row. From below: a theta, by ascent.

Source: Boyd and Vandenberghe, Convex Optimization (2004), appendix B; Nesterov, Semidefinite
relaxation and nonconvex quadratic optimization, Optimization Methods and Software 9 (1998).
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import qr, solve_triangular

from holdfast.numerics.quadratic_interior import interior

EPS, DEPENDENT, FLOOR = float(np.finfo(float).eps), 1e-14, 1e-14
"""Of rounding; of the diagonal of a triangular factor, per column, that counts as none; least
share of a multiplier in their sum, so that a certificate can be checked."""
ASCENTS, STARTS, TILT = 50, 3, 0.03
"""Steps of an ascent at most; starts of each kind; change of a first direction."""
ROUGH, GROWN, MET, CLOSED = 1e-3, 1e-10, 1e-7, 1e-7
"""Relative: growth in a step that counts as none, at first and at last; 1 - cosine of directions
that lead to the same end; distance of bounds that are equal."""


class Outer(NamedTuple):
    """A certified bound: |B theta|^2 <= ``value`` = b'mu wherever theta' M_j theta <= b_j.

    ``mu`` (m,): multipliers, sum_j mu_j M_j >= B'B. ``theta`` (d x q): the relaxation's X rounded
    to attacks, each feasible and at a bound, B times the longest first; one attains ``value``
    where X has rank one. ``gap``: (value - the relaxation's value from below) / value;
    ``converged`` where it is within the tolerance.
    """

    mu: np.ndarray
    value: float
    theta: np.ndarray
    iterations: int
    gap: float
    converged: bool


class Inner(NamedTuple):
    """A feasible ``theta`` (d,) and its ``value`` |B theta|, in the unit of B theta."""

    theta: np.ndarray
    value: float


class Largest(NamedTuple):
    """``lower`` = |B theta| <= max |B theta| <= ``upper`` = sqrt(b'mu), in the unit of B theta.

    ``exact`` where upper - lower <= 1e-7 upper; ``mu`` (m,) and ``theta`` (d,) prove the bounds.
    """

    upper: float
    lower: float
    mu: np.ndarray
    theta: np.ndarray
    exact: bool


def largest(Z: np.ndarray, w: np.ndarray, b: np.ndarray, B: np.ndarray) -> Largest:
    """Both bounds of max |B theta| over theta' M_j theta <= b_j, M_j = sum_i w_ji Z_i' Z_i.

    Arguments and errors as of `outer`.
    """
    ready, B = _whitened(Z, w, b, B)
    above = _outer(ready, B, 1e-9)
    upper = float(np.sqrt(above.value))
    found = np.hstack([above.theta, _signed(ready, above.theta)])
    theta, lower = _longest(B, found)
    if upper - lower > CLOSED * upper:
        found = np.column_stack([theta, _inner(ready, B, above.theta).theta])
        theta, lower = _longest(B, found)
    return Largest(upper, lower, above.mu, theta, bool(upper - lower <= CLOSED * upper))


def outer(
    Z: np.ndarray, w: np.ndarray, b: np.ndarray, B: np.ndarray, tolerance: float = 1e-9
) -> Outer:
    """The least b'mu over mu >= 0, sum_j mu_j M_j >= B'B with M_j = sum_i w_ji Z_i' Z_i.

    Z (T x r x d), w (m x T) nonnegative, b (m,) positive in the unit of |Z theta|^2, B (q x d).
    It bounds |B theta|^2 whether or not the iteration converged; an estimate of what rounding
    can hide is added. The maximum itself where q = 1 or the relaxation's X has rank one.
    Raises ValueError where an argument is none of these, or some direction of theta has no bound.
    """
    ready, B = _whitened(Z, w, b, B)
    return _outer(ready, B, tolerance)


def inner(
    Z: np.ndarray, w: np.ndarray, b: np.ndarray, B: np.ndarray, start: np.ndarray | None = None
) -> Inner:
    """The best theta found by ascent: theta maximises c'B theta, then c = B theta / |B theta|.

    Arguments and errors as of `outer`; ``start`` (d x k): attacks to begin at, as `Outer.theta`.
    The first directions are those of B ``start``, of its best sums with signs, and the longest
    axes of the image under B of the ellipsoid theta' (sum_j M_j / b_j) theta <= 1.
    """
    ready, B = _whitened(Z, w, b, B)
    start = np.zeros((B.shape[1], 0)) if start is None else np.asarray(start, float)
    return _inner(ready, B, start)


class _Factor(NamedTuple):
    """R = ``upper`` with R'R = A'A for rows A (n x d), columns ``order``ed and over ``unit``."""

    upper: np.ndarray
    order: np.ndarray
    unit: np.ndarray

    def left(self, B: np.ndarray) -> np.ndarray:
        """B R^-1 (q x d): its squared singular values are the eigenvalues of B (A'A)^-1 B'."""
        return solve_triangular(self.upper, (B / self.unit)[:, self.order].T, trans=1).T

    def back(self, y: np.ndarray) -> np.ndarray:
        """The theta (d x k) of coordinates y."""
        theta = np.empty_like(y)
        theta[self.order] = solve_triangular(self.upper, y)
        return theta / self.unit[:, None]


def _factored(rows: np.ndarray) -> tuple[_Factor, np.ndarray]:
    """Of rows (n x d), n >= d, and the orthonormal columns of rows R^-1."""
    unit = np.sqrt(np.sum(rows * rows, 0))
    unit[unit == 0] = 1.0
    # long rows first, and pivoted: Householder's errors are then relative to each row
    sort = np.argsort(-np.max(np.abs(rows), 1), kind="stable")
    found: Any = qr((rows / unit)[sort], mode="economic", pivoting=True)
    Q, R, order = found
    back = np.empty_like(Q)
    back[sort] = Q
    return _Factor(R, order, unit), back


class _Whitened(NamedTuple):
    """Coordinates y in which sum_j M_j / b_j = I: M_j / b_j = sum_k share_jk unit_k unit_k'.

    ``rows`` (n x d) are those of Z that are bounded, ``weights`` (m x n) theirs; ``unit`` (n x d)
    and ``share`` (m x n), whose columns sum to one, the same in y.
    """

    rows: np.ndarray
    weights: np.ndarray
    b: np.ndarray
    factor: _Factor
    unit: np.ndarray
    share: np.ndarray


def _whitened(Z, w, b, B) -> tuple[_Whitened, np.ndarray]:
    Z, w, b, B = (np.asarray(a, float) for a in (Z, w, b, B))
    T, r, d = Z.shape if Z.ndim == 3 else (0, 0, 0)
    if not d or b.ndim != 1 or w.shape != (len(b), T) or B.ndim != 2 or B.shape[1] != d:
        shapes = [a.shape for a in (Z, w, b, B)]
        raise ValueError(f"Z, w, b, B are {shapes}: not T x r x d, m x T, m, q x d")
    if not all(np.all(np.isfinite(a)) for a in (Z, w, b, B)) or np.any(w < 0) or np.any(b <= 0):
        raise ValueError("all must be finite, w not negative and b positive")
    rows, weights = Z.reshape(-1, d), np.repeat(w, r, 1)
    total = np.sum(weights / b[:, None], 0)
    kept = (total > 0) & np.any(rows != 0, 1)
    rows, weights, total = rows[kept], weights[:, kept], total[kept]
    if len(rows) >= d:
        factor, unit = _factored(np.sqrt(total)[:, None] * rows)
        size = np.abs(np.diagonal(factor.upper))
        if np.min(size) > DEPENDENT * d * size[0]:
            share = weights / b[:, None] / total
            return _Whitened(rows, weights, b, factor, unit, share), B
    raise ValueError("some direction of theta has no bound, or none beyond rounding")


def _outer(ready: _Whitened, B: np.ndarray, tolerance: float) -> Outer:
    d, m = ready.rows.shape[1], len(ready.b)
    goal = ready.factor.left(B)
    size = np.linalg.norm(goal, 2) if len(B) else 0.0
    if size == 0.0:
        return Outer(np.zeros(m), 0.0, np.zeros((d, max(len(B), 1))), 0, 0.0, True)
    goal = goal / size
    # the value is now between 1 and m: every |y| <= 1 is feasible, and so is mu = 1
    mu, X, steps = interior(ready.unit, ready.share, goal, tolerance)
    mu, value = _certified(ready, B, size * size * mu / ready.b)
    # X B'c / sqrt(c'B X B'c) is feasible for every c, as its square is at most X
    image = X @ goal.T
    lengths, turn = np.linalg.eigh(goal @ image)
    scale = np.where(lengths > 0, 1.0 / np.sqrt(np.where(lengths > 0, lengths, 1.0)), 0.0)
    theta = _bounded(ready, ready.factor.back(image @ turn * scale))
    most = np.max(ready.share @ np.sum((ready.unit @ X) * ready.unit, 1))
    gap = abs(1.0 - size * size * float(np.sum(lengths)) / most / value)
    return Outer(mu, value, _sorted(B, theta), steps, gap, bool(gap <= tolerance))


def _certified(ready: _Whitened, B, mu) -> tuple[np.ndarray, float]:
    """The least multiple of mu that is a certificate, and its b'mu; from the given Z alone."""
    mu = np.maximum(mu, FLOOR * (mu @ ready.b) / ready.b)
    factor, _ = _factored(np.sqrt(mu @ ready.weights)[:, None] * ready.rows)
    goal, d = factor.left(B), len(factor.unit)
    length = np.linalg.norm(goal, 2)
    # a factor of rows A + E has y'(A'E + E'A) y too much at y = M(mu)^-1 B'
    missed = 4.0 * np.sqrt(d) * np.linalg.norm(factor.unit[:, None] * factor.back(goal.T)) / length
    mu = mu * length**2 * (1.0 + EPS * (d + missed))
    return mu, float(mu @ ready.b)


def _bounded(ready: _Whitened, theta: np.ndarray) -> np.ndarray:
    """Attacks (d x k) scaled to their first bound, less what rounding may hide; zeros stay."""
    shift = np.abs(ready.rows @ theta)
    shift += 0.5 * EPS * len(theta) * (np.abs(ready.rows) @ np.abs(theta))
    used = np.sqrt(np.max(ready.weights @ shift**2 / ready.b[:, None], 0))
    return theta / np.where(used > 0, used * (1.0 + 2.0 * EPS), 1.0)


def _sorted(B, theta: np.ndarray) -> np.ndarray:
    """Attacks (d x k), those with the longest B theta first."""
    return theta[:, np.argsort(-np.linalg.norm(B @ theta, axis=0), kind="stable")]


def _longest(B, theta: np.ndarray) -> Inner:
    best = _sorted(B, theta)[:, 0]
    return Inner(best, float(np.linalg.norm(B @ best)))


def _signed(ready: _Whitened, theta: np.ndarray) -> np.ndarray:
    """All sums with signs of the first attacks, 8 at most, scaled to a bound."""
    k = min(theta.shape[1], 8)
    signs = 1.0 - 2.0 * (np.arange(2 ** max(k - 1, 0)) >> np.arange(k)[:, None] & 1)
    return _bounded(ready, theta[:, :k] @ signs)


def _inner(ready: _Whitened, B: np.ndarray, start: np.ndarray) -> Inner:
    axes = np.linalg.svd(ready.factor.left(B), full_matrices=False)[0][:, :STARTS]
    sums = _sorted(B, _signed(ready, start))[:, :STARTS]
    c = np.hstack([B @ start, B @ sums, axes])
    c = c[:, np.any(c, 0)] / np.linalg.norm(c[:, np.any(c, 0)], axis=0)
    # from a start on an axis of symmetry an ascent can stay at a saddle
    tilt = TILT * (-1.0) ** np.arange(len(B)) / np.arange(1, len(B) + 1)
    ends = _climbed(ready, B, c + tilt[:, None], ROUGH)
    c = B @ _sorted(B, ends)
    size = np.linalg.norm(c, axis=0)
    best = _climbed(ready, B, c[:, size >= (1.0 - ROUGH) * size[0]], GROWN)
    return _longest(B, np.hstack([ends, best]))


def _climbed(ready: _Whitened, B, directions: np.ndarray, tolerance: float) -> np.ndarray:
    """The attacks (d x k) at the ends of ascents that did not meet an earlier one; or zero."""
    ends, met = [np.zeros(B.shape[1])], np.zeros((0, len(B)))
    for c in directions.T[np.any(directions, 0)]:
        at, c = Inner(ends[0], 0.0), c / np.linalg.norm(c)
        for _ in range(ASCENTS):
            if np.any(np.abs(met @ c) > 1.0 - max(tolerance, MET)):
                break
            new = _longest(B, _outer(ready, c[None] @ B, tolerance).theta)
            if new.value <= at.value * (1.0 + tolerance):
                break
            at, c = new, B @ new.theta / new.value
        ends, met = [*ends, at.theta], np.vstack([met, c])
    return np.stack(ends, 1)
