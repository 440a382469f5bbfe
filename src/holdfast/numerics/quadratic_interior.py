"""Multipliers of quadratic limits by a primal-dual interior-point method, in whitened coordinates.

    minimise sum_j mu_j   subject to   sum_j mu_j M_j >= B'B, mu >= 0

M_j = sum_k share_jk unit_k unit_k', sum_j M_j = I and B of size one: what
`holdfast.numerics.quadratic_reach` makes of its problem.

Source: Helmberg, Rendl, Vanderbei and Wolkowicz, An interior-point method for semidefinite
programming, SIAM Journal on Optimization 6 (1996).
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import get_lapack_funcs

ROUNDS, START = 60, 1.5
"""Interior-point steps at most (8 to 20 are usual); all multipliers at first, 1 being safe."""
STEP, HALVINGS, SHORT = 0.95, 4, 1e-6
"""Share of the way to the boundary that a step goes; least number of halvings of one that leaves
the cone; a step under which rounding has the upper hand."""
_cholesky, _inverse, _solved = get_lapack_funcs(("potrf", "trtri", "potrs"), (np.zeros((1, 1)),))


class _Point(NamedTuple):
    """Inside both cones: mu, z > 0 and S = sum_j mu_j M_j - B'B, X > 0; or a change of it."""

    mu: np.ndarray
    z: np.ndarray
    S: np.ndarray
    X: np.ndarray

    def gap(self) -> float:
        """Sum mu - tr(B X B')."""
        return float(np.sum(self.S * self.X) + self.mu @ self.z)

    def moved(self, by: "_Point") -> "tuple[float, _Point]":
        """As far as both cones, and a whole step, allow; and the longer of the two ways."""
        p, d = _reach(self.z, by.z, self.X, by.X), _reach(self.mu, by.mu, self.S, by.S)
        new = (self.mu + d * by.mu, self.z + p * by.z, self.S + d * by.S, self.X + p * by.X)
        return max(p, d), _Point(*new)


def interior(unit, share, goal, tolerance) -> tuple[np.ndarray, np.ndarray, int]:
    """mu, X and the number of steps: min sum mu, sum_j mu_j M_j >= B'B, where sum_j M_j = I."""
    m, d = len(share), unit.shape[1]
    trace = share @ np.sum(unit * unit, 1)
    x = min(m / (m + d), 0.5 / np.max(trace))
    S = START * np.eye(d) - goal.T @ goal
    at = _Point(np.full(m, START), 1.0 - x * trace, S, x * np.eye(d))
    steps = 0
    while steps < ROUNDS and at.gap() > 0.5 * tolerance * np.sum(at.mu):
        new = _stepped(unit, share, at)
        if new is None:
            break
        at, steps = new, steps + 1
    return at.mu, at.X, steps


class _Newton(NamedTuple):
    """On X S = nu I, made symmetric as in the source: dX = nu S^-1 - X - X dS S^-1."""

    unit: np.ndarray
    share: np.ndarray
    at: _Point
    inverse: np.ndarray
    pull: np.ndarray
    factor: np.ndarray

    def change(self, nu, second, second_z) -> _Point:
        """Toward the centre at nu, less terms of second order of X and z."""
        at = self.at
        right = nu * (self.pull + 1.0 / at.mu) - 1.0 - second_z
        right -= self.share @ np.sum((self.unit @ second) * self.unit, 1)
        mu = _solved(self.factor, right, lower=1)[0]
        S = (self.unit * (mu @ self.share)[:, None]).T @ self.unit
        X = at.X @ S @ self.inverse + second
        z = nu / at.mu - at.z - at.z / at.mu * mu - second_z
        return _Point(mu, z, S, nu * self.inverse - at.X - 0.5 * (X + X.T))


def _stepped(unit, share, at: _Point) -> _Point | None:
    """One predictor-corrector step, or None where rounding allows no more."""
    lower, failed = _cholesky(at.S, lower=1)
    if failed:
        return None
    half = _inverse(lower, lower=1)[0]
    inverse, seen = half.T @ half, unit @ half.T
    # tr(M_j X M_l S^-1), and tr(M_j S^-1)
    hessian = share @ ((unit @ at.X @ unit.T) * (seen @ seen.T)) @ share.T + np.diag(at.z / at.mu)
    pull = share @ np.sum(seen * seen, 1)
    factor, failed = _cholesky(hessian, lower=1)
    if failed:
        return None
    newton = _Newton(unit, share, at, inverse, pull, factor)
    # the predictor aims at nu = 0; how far it gets tells what the corrector should aim at
    far = newton.change(0.0, np.zeros_like(at.X), np.zeros_like(at.z))
    left = min(max(at.moved(far)[1].gap() / at.gap(), 0.0), 1.0)
    nu = left**2 * at.gap() / (len(at.mu) + len(at.S))
    length, new = at.moved(newton.change(nu, far.X @ far.S @ inverse, far.z * far.mu / at.mu))
    return new if length >= SHORT else None


def _reach(x: np.ndarray, dx: np.ndarray, A: np.ndarray, dA: np.ndarray) -> float:
    """A step at most 1 that leaves x > 0 and A > 0, up to the boundary but for a share."""
    falling = dx < 0
    far = min(1.0, STEP * np.min(-x[falling] / dx[falling], initial=np.inf))
    if not _cholesky(A + far * dA, lower=1)[1]:
        return far
    good, bad, halved = 0.0, far, 0
    while halved < HALVINGS or (good == 0.0 and bad > SHORT):
        middle, halved = 0.5 * (good + bad), halved + 1
        out = _cholesky(A + middle * dA, lower=1)[1]
        good, bad = (good, middle) if out else (middle, bad)
    return STEP * good
