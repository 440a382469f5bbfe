"""All attacks over a stretch of steps, as rows of one vector, and what a detector allows of them.

What `holdfast.numerics.reachability` says by recursion for one weighted sum of residuals is written
out here, so that every residual can have a bound of its own.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from holdfast.numerics.multipliers import Long, descended
from holdfast.numerics.quadratic_reach import largest
from holdfast.numerics.reachability import Path, travelled

MOST = 160
"""Unknowns up to which attacks are written out: beyond it the cone programs take over a second."""


class Attacks(NamedTuple):
    """Residual i is ``Z[i]`` theta, whitened; e_k is ``errors[k - 1]`` theta.

    Z (t (1 + f) + 1, r, d): the residuals of t steps, those ahead of each, and the first error,
    where it is free; w, b: the limits on their squares. errors (t, n, d). ``start``: how many
    entries of theta are of the first error.
    """

    Z: np.ndarray
    w: np.ndarray
    b: np.ndarray
    errors: np.ndarray
    start: int


def attacks(of: Long) -> Attacks:
    """All attacks over a stretch, from e_0 = 0 or from e_0 = start xi with |xi| <= 1."""
    m, index, first = of.m, of.sets, of.start
    F, B, G = (np.asarray(x) for x in (m.F, m.B, m.G))
    n, p = F.shape[1], B.shape[2]
    free = [np.flatnonzero(np.any(push, axis=0)) for push in np.asarray(m.push)]
    counts = [len(free[i]) for i in index]
    start = 0 if first is None else n
    d = start + sum(counts)
    e = np.zeros((n, d))
    if first is not None:
        e[:, :n] = first
    ahead = np.asarray(m.ahead)
    steps, f = len(index), len(ahead)
    blocks = steps * (1 + f) + (first is not None)
    Z = np.zeros((blocks, max(p, n if start else 0), d))
    errors = np.zeros((steps, n, d))
    at = start
    for i, (which, count) in enumerate(zip(index, counts, strict=True)):
        Z[i, :p] = G[which] @ e
        v = np.zeros((p, d))
        v[free[which], np.arange(at, at + count)] = 1.0
        # the honest rows come first in G, so that those of the moves find room behind them
        Z[i, p - count : p, at : at + count] = np.eye(count)
        for j in range(f):
            Z[steps + i * f + j, :p] = ahead[j] @ e
        e = F[which] @ e + B[which] @ v
        errors[i], at = e, at + count
    if start:
        Z[-1, :n, :n] = np.eye(n)
    w, b = np.asarray(of.w.toarray()), of.b
    if start:
        w, b = np.asarray(block_diag(w, np.eye(1))), np.append(b, 1.0)
    return Attacks(Z, w, b, errors, start)


def unknowns(of: Long) -> int:
    """How many numbers the attacker chooses."""
    free = np.sum(np.any(np.asarray(of.m.push) != 0, axis=1), axis=1)
    return int(np.sum(free[of.sets]))


def path(of: Long, found: Attacks, theta: np.ndarray) -> Path:
    """The attack theta (from e_0 = 0), step by step."""
    push = np.asarray(of.m.push)
    v, at = np.zeros((len(of.sets), push.shape[1])), 0
    for i, which in enumerate(of.sets):
        free = np.flatnonzero(np.any(push[which], axis=0))
        v[i, free] = theta[at : at + len(free)]
        at += len(free)
    n = found.errors.shape[1]
    before = np.concatenate([np.zeros((1, n)), found.errors[:-1] @ theta])
    return travelled(of.m, of.sets, before, v, np.zeros(n))


def strongest(of: Long, functional: np.ndarray, k: int) -> Path:
    """The attack from e_0 = 0 that makes |functional e_k| as large as was found, within limits."""
    if unknowns(of) > MOST:
        return descended(of, functional, k).path
    found = attacks(of)
    return path(
        of, found, largest(found.Z, found.w, found.b, functional @ found.errors[k - 1]).theta
    )
