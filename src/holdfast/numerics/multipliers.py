"""Multipliers of many limits at once, by the recursion: for stretches too long to be written out.

Any weights of the steps that keep sum_j share_j = 1 with multipliers share_j / b_j give an outer
ellipsoid; the smallest one along a direction is an optimal design, and its multiplicative
algorithm needs no more than what the cheapest attack spends on each limit.
"""

from typing import NamedTuple

import numpy as np
from numpy.linalg import norm
from scipy.sparse import csr_array

from holdfast.numerics.reachability import Moves, Path, backward, forward, joined, longest

ROUNDS = 60
"""Times that the multipliers are improved; the bounds close in like one over it."""
CLOSE = 1e-7
LEAST = 1e-12
TURNED, OLDEST = 0.9, 10
"""Cosine of two longest axes that are not the same; attacks that the multipliers go by at most."""


class Long(NamedTuple):
    """Steps in a row: their moves, the set of each, sum_i w_ji cost_i <= b_j (w m x t (1 + f), the
    costs of the residuals first), and a factor of the ellipsoid of e_0, None where it is 0.
    """

    m: Moves
    sets: np.ndarray
    w: csr_array
    b: np.ndarray
    start: np.ndarray | None


class Certificate(NamedTuple):
    """``share`` (m + 1,): of each limit and of the first ellipsoid, summing to 1."""

    share: np.ndarray
    weights: np.ndarray
    start: np.ndarray


def evenly(of: Long) -> np.ndarray:
    """Shares to begin with: alike for all limits, as much again for what came before them."""
    return np.append(np.ones(len(of.b)), float(len(of.b)))


def certificate(of: Long, share: np.ndarray) -> Certificate:
    """Any shares (m + 1,), made to sum to 1 and to leave out none."""
    share = np.maximum(np.asarray(share, float), LEAST)
    if of.start is None:
        share[-1] = 0.0
    share = share / np.sum(share)
    each = of.w.T @ (share[:-1] / of.b)
    steps, n = len(of.sets), of.m.F.shape[1]
    weights = np.column_stack([each[:steps], each[steps:].reshape(steps, -1)])
    start = np.zeros((n, n)) if of.start is None else of.start / np.sqrt(share[-1])
    return Certificate(share, weights, start)


def factors(of: Long, held: Certificate) -> np.ndarray:
    """Factors (t x n x n) of the ellipsoids of every e_k that a certificate gives."""
    L = forward(of.m, of.sets, held.weights, held.start)
    T = backward(of.m, of.sets, held.weights, np.zeros(len(of.sets), np.int32))
    return joined(L, T)


class Descended(NamedTuple):
    """``upper`` >= max |functional e_k| >= ``lower``, which the attack ``path`` reaches."""

    upper: float
    lower: float
    held: Certificate
    path: Path


def descended(
    of: Long,
    functional: np.ndarray,
    k: int,
    share: np.ndarray | None = None,
    enough: float = 0.0,
    over: float = np.inf,
    rounds: int = ROUNDS,
) -> Descended:
    """The multipliers that make the ellipsoid of e_k small, functional e_k being what counts.

    share_j <- share_j sqrt(spent_j / b_j), spent_j what the cheapest attack along the longest axis
    uses of limit j: it never makes that axis longer. Another may become the longest: the best
    ellipsoid often has several of one length, and going by one at a time would go to and fro
    between them for ever. So where the axis changes spent_j is a mean over the last attacks. Every
    turn gives an attack, once it has been scaled to use no limit more than whole. From ``share``
    on, until the upper bound is ``enough``, the lower one ``over`` what matters, or the two meet.

    Source: Silvey, Titterington and Torsney (1978); monotone along one axis by Yu (2010).
    """
    found = _turn(of, functional, k, evenly(of) if share is None else share)
    last, mean, changes = found, _relative(of, found), 0
    for _ in range(rounds - 1):
        if found.upper <= max(enough, found.lower * (1.0 + CLOSE)) or found.lower > over:
            break
        axis = functional @ last.path.e[k - 1]
        last = _turn(of, functional, k, last.held.share * np.sqrt(mean))
        same = abs(axis @ functional @ last.path.e[k - 1])
        changes += same < TURNED * norm(axis) * last.lower
        new = max(1.0 / OLDEST, 1.0 / (1.0 + 0.5 * changes))
        mean = (1.0 - new) * mean + new * _relative(of, last)
        high, low = min(found, last, key=_upper), max(found, last, key=_lower)
        found = Descended(high.upper, low.lower, high.held, low.path)
    return found


def _upper(one: Descended) -> float:
    return one.upper


def _lower(one: Descended) -> float:
    return one.lower


def _turn(of: Long, functional: np.ndarray, k: int, share: np.ndarray) -> Descended:
    """Both bounds by one set of multipliers."""
    held = certificate(of, share)
    size, path = longest(of.m, of.sets, held.weights, k, functional, held.start)
    if of.start is not None:
        path = path._replace(first=path.first / np.sqrt(held.share[-1]))
    most = float(np.max(_spent(of, path)))
    scale = 1.0 / np.sqrt(most) if most > 0 else 0.0
    path = Path(path.e * scale, path.a * scale, path.cost * scale**2, path.first * scale)
    reached = float(norm(functional @ path.e[k - 1]))
    return Descended(size, reached, held, path)


def _spent(of: Long, path: Path) -> np.ndarray:
    """What an attack uses of every limit, and of the first ellipsoid: 1 is all of it."""
    costs = np.concatenate([path.cost[:, 0], path.cost[:, 1:].reshape(-1)])
    return np.append((of.w @ costs) / of.b, np.sum(path.first**2))


def _relative(of: Long, found: Descended) -> np.ndarray:
    """What its attack uses of every limit, 1 on average over the shares."""
    spent = _spent(of, found.path)
    whole = float(found.held.share @ spent)
    return spent / whole if whole > 0 else np.ones(len(spent))
