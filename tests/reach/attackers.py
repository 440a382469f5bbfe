"""Stealthy attacks straight from the definition, and the best of them by cone programs.

The unknowns are the values a_k that the attacker adds to what he can alter; the error and the
residuals follow e_k = (A - K C A) e_{k-1} - K a_k and z_k = C A e_{k-1} + a_k. The bounds of the
residuals come from scipy, the policy from counting steps. Nothing here is the product's, but for
the records in which a question is asked.
"""

from typing import NamedTuple

import clarabel
import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve_discrete_are, solve_triangular
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from holdfast.numerics.stealth import Stealth
from holdfast.plants.watched import Watched
from holdfast.reach.setting import Setting
from holdfast.records import Enforcement


def filtered(A, C, Q, R) -> Watched:
    """A plant and its filter."""
    A, C, Q, R = (np.asarray(m, float) for m in (A, C, Q, R))
    ahead = solve_discrete_are(A.T, C.T, Q, R)
    spread = C @ ahead @ C.T + R
    K = np.linalg.solve(spread, C @ ahead).T
    states = tuple(f"x{i}" for i in range(len(A)))
    outputs = tuple(f"y{i}" for i in range(len(C)))
    return Watched(A, C, K, spread, ahead - K @ C @ ahead, states, outputs)


def vehicle() -> Watched:
    """Position and speed, both measured; the noise that the project's notes found to fit."""
    eye = np.eye(2)
    return filtered([[1.0, 0.01], [0.0, 1.0]], eye, 0.26984 * eye, 10.144 * eye)


def drawn(seed, n, p, size=1.05) -> Watched:
    """A random plant with the spectral radius ``size`` and correlated noise."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A *= size / np.max(np.abs(np.linalg.eigvals(A)))
    roots = [0.3 * rng.normal(size=(m, m)) + 0.5 * np.eye(m) for m in (n, p)]
    return filtered(A, rng.normal(size=(p, n)), *(root @ root.T for root in roots))


def asked(
    system,
    detector,
    enforcement=None,
    compromised=None,
    aware=True,
    functional=None,
    enforced=None,
    weights=(1.0, 1.0, 1.0),
    level=0.015,
    epsilon=1e-3,
) -> Setting:
    n, p = len(system.A), len(system.C)
    hit = np.ones(p, bool) if compromised is None else np.asarray(compromised, bool)
    stealth = Stealth(detector, epsilon, level, p, weights)
    on = np.eye(n) if functional is None else np.asarray(functional, float)
    return Setting(system, stealth, hit, enforcement, on, aware, enforced)


def together(p, every, duration=1, first=None) -> Enforcement:
    return Enforcement.of(np.full(p, every), duration, every if first is None else first)


def alpha(epsilon, dof, threshold, tail=None) -> float:
    """The shift that makes the tail of a chi-square what it is without one, and epsilon more."""
    top = (chi2.sf(threshold, dof) if tail is None else tail) + epsilon
    return brentq(lambda a: ncx2.sf(threshold, dof, a * a) - top, 1e-9, 1e3, xtol=1e-13)


def authenticated(setting, k) -> np.ndarray:
    """Which outputs are at step k, one after the other."""
    if setting.enforced is not None:
        none = np.zeros(len(setting.compromised), bool)
        return setting.enforced[k - 1] if k <= len(setting.enforced) else none
    if setting.enforcement is None:
        return np.zeros(len(setting.compromised), bool)
    held = setting.enforcement
    rows = zip(*(np.asarray(v) for v in (held.every, held.duration, held.first)), strict=True)
    return np.array([any((k - f - i) % e == 0 for i in range(d)) and k >= f for e, d, f in rows])


def block_end(setting, k, most=300) -> int:
    """Where every altered output that is authenticated now and then has ended a block, from k."""
    ends = [k]
    for j in np.flatnonzero(setting.compromised):
        on = np.array([authenticated(setting, i)[j] for i in range(1, most + 2)])
        found = [t for t in range(k, most + 1) if on[t - 1] and not on[t]]
        ends += found[:1]
    return max(ends)


def horizon(setting, k) -> int:
    """The t whose constraint is used, round after round."""
    t = 0
    while t < k:
        t = block_end(setting, t + 1)
    return t


class Attacks(NamedTuple):
    """All of them over t steps: e_k = errors[k] theta, and |rows theta| <= bound."""

    errors: np.ndarray
    limits: list[tuple[np.ndarray, float]]


def written(setting, t, k, tight=False) -> Attacks:
    """The stealthy attacks over t steps; one who does not know the policy has to be ready for
    an authenticated block in place of each of them; if only a sum is bounded, behind k.
    """
    s, block = setting.system, 0 if setting.aware else setting.blocks
    root = np.linalg.cholesky(s.Q)
    free = [np.flatnonzero(setting.compromised & ~authenticated(setting, i + 1)) for i in range(t)]
    d = sum(len(one) for one in free)
    e, at = np.zeros((len(s.A), d)), 0
    errors, shown, ready = [e], [], []
    for one in free:
        move, told = e, []
        for _ in range(block):
            told.append(solve_triangular(root, s.C @ s.A @ move, lower=True))
            move = (s.A - s.K @ s.C @ s.A) @ move
        ready.append(told)
        a = np.zeros((len(s.C), d))
        a[one, np.arange(at, at + len(one))] = 1.0
        shown.append(solve_triangular(root, s.C @ s.A @ e + a, lower=True))
        e, at = (s.A - s.K @ s.C @ s.A) @ e - s.K @ a, at + len(one)
        errors.append(e)
    limits = []
    whole = setting.stealth.detector == "sprt" and not tight
    ends = [t] * setting.aware if whole else range(1, t + 1)
    for end in ends:
        limits += _tested(setting, shown[:end], end)
    if block and whole:
        limits += _tested(setting, shown[:k] + ready[k], k + block)
    elif block:
        for i in range(t):
            for j in range(block):
                limits += _tested(setting, shown[:i] + ready[i][: j + 1], i + j + 1)
    return Attacks(np.array(errors), limits)


def _tested(setting, shown, end) -> list[tuple[np.ndarray, float]]:
    """The test at step ``end`` of the residuals of the steps before it."""
    of = setting.stealth
    p, h = len(setting.compromised), chi2.isf(of.level, len(setting.compromised))
    if of.detector == "sprt":
        return [(np.vstack(shown), alpha(of.epsilon, end * p, 2 * h + end * p))]
    if of.detector == "chi_square":
        return [(shown[-1], alpha(of.epsilon, p, h))]
    c = of.weights
    inside = [z for z, weight in zip(shown[::-1], c[::-1], strict=False) if weight > 0]
    dof = p * sum(weight > 0 for weight in c)
    return [(np.vstack(inside), alpha(of.epsilon, dof, chi2.isf(of.level, dof)))] if inside else []


def furthest(found: Attacks, c) -> np.ndarray:
    """The theta of the largest c'theta."""
    A, right, cones = [], [], []
    for rows, bound in found.limits:
        A += [np.zeros((1, len(c))), -rows / bound]
        right += [[1.0], np.zeros(len(rows))]
        cones.append(clarabel.SecondOrderConeT(1 + len(rows)))
    options = clarabel.DefaultSettings()
    options.verbose = False
    options.tol_gap_abs = options.tol_gap_rel = options.tol_feas = 1e-9
    nothing = sp.csc_matrix((len(c), len(c)))
    size = np.linalg.norm(c)
    A = sp.csc_matrix(np.vstack(A))
    found = clarabel.DefaultSolver(nothing, -c / size, A, np.concatenate(right), cones, options)
    solution = found.solve()
    assert "Solved" in str(solution.status)
    return np.array(solution.x)


def largest(setting, k, tight=False, starts=6, seed=0) -> float:
    """The largest |functional e_k| that ascents from several directions find."""
    t = horizon(setting, k) + (not setting.aware)
    if setting.stealth.detector == "sprt" and not tight and not setting.aware:
        # one sum is bounded: behind k or where the policy's block ends
        known = largest(setting._replace(aware=True), k, tight, starts, seed)
        return min(known, _climbed(written(setting, t, k), setting, k, starts, seed))
    return _climbed(written(setting, t, k, tight), setting, k, starts, seed)


def _climbed(found: Attacks, setting, k, starts, seed) -> float:
    B = setting.functional @ found.errors[k]
    if not np.any(B):
        return 0.0
    rng, best = np.random.default_rng(seed), 0.0
    starts = 1 if len(B) == 1 else starts
    for c in [*np.eye(len(B))[: starts - 1], *rng.normal(size=(starts, len(B)))][:starts]:
        value = 0.0
        for _ in range(30):
            reached = B @ furthest(found, c @ B) if np.any(c @ B) else np.zeros(len(B))
            size = float(np.linalg.norm(reached))
            if size <= value * (1 + 1e-9):
                break
            value, c = size, reached / size
        best = max(best, value)
    return best
