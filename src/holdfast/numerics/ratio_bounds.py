"""Bounds of the worst ratio of sums of norms where not all rays can be tried.

The problem is that of `holdfast.numerics.rays`. From below: a u found by ascent. From above: a
certificate. With the parts R of the blocks in question, T of the others and any positive weights
W, the matrix X = R (T' W T)^-1 T' W gives R = X T, so that

    sum_j |R_j u| <= sum_k (sum_j |X_jk|) |T_k u| <= max_k (sum_j |X_jk|) sum_k |T_k u|

whatever u is. The weights are changed until the largest column is small.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

ROUNDS = 200
"""Changes of the weights of a certificate, at most."""
FEW = 60
"""The same, where a certificate is no longer good."""
NORM = 30.0
"""Multiplications that take as long as the norm of a 2 x 2 matrix."""
OVERHEAD = 1e5
"""Multiplications that take as long as what comes with every round."""
STEPS = 40
"""Steps of an ascent."""
TRIED = 24
"""Ascents for one number of blocks, at most."""
KINK = 1e-10
"""Norm of a part, relative to the largest, that the ascent takes for zero."""
INFINITE = 1e10
"""A ratio from which the denominator counts as zero."""
SLACK = 1e-9
"""Relative rounding that a certificate is enlarged by."""


class Component(NamedTuple):
    """``parts`` (N x 2 x r): a norm each, a row being a pair with a zero row; ``block`` (N,).

    ``blocks``: how many there are, whether or not they have parts here. In coordinates of u
    in which the columns of all rows together are orthonormal.
    """

    parts: np.ndarray
    block: np.ndarray
    blocks: int

    @property
    def rows(self) -> np.ndarray:
        """All rows (2 N x r)."""
        return self.parts.reshape(-1, self.parts.shape[2])

    @property
    def member(self) -> np.ndarray:
        """Which part belongs to which block (N x blocks)."""
        return np.arange(self.blocks) == self.block[:, None]

    def sums(self, U: np.ndarray) -> np.ndarray:
        """The g_i at each row of U (k x r): (k x blocks)."""
        z = U @ self.rows.T
        return np.hypot(z[:, 0::2], z[:, 1::2]) @ self.member


class Ratios(NamedTuple):
    """Bounds of the ratio of each block alone (m,), and of the worst set of 1, 2, .. blocks.

    Infinite where nothing is left of the others; equal bounds are exact. Where the blocks are
    counted by steps, the sets have 1, 2, .. blocks of each.
    """

    lower: np.ndarray
    upper: np.ndarray
    lower_sets: np.ndarray
    upper_sets: np.ndarray

    @property
    def narrow(self) -> bool:
        """Whether all bounds agree to 1e-3."""
        upper = np.append(self.upper, self.upper_sets)
        return bool(np.all(np.append(self.lower, self.lower_sets) >= (1.0 - 1e-3) * upper))

    def tightened(self, other: "Ratios") -> "Ratios":
        """What both say."""
        return Ratios(
            np.maximum(self.lower, other.lower),
            np.minimum(self.upper, other.upper),
            np.maximum(self.lower_sets, other.lower_sets),
            np.minimum(self.upper_sets, other.upper_sets),
        )

    def worse(self, other: "Ratios") -> "Ratios":
        """The larger of two, one by one."""
        return Ratios(*(np.maximum(a, b) for a, b in zip(self, other, strict=True)))


def single(g: np.ndarray) -> np.ndarray:
    """g_i over the sum of the others, for g (k x m)."""
    return _over_rest(g, np.sum(g, 1, keepdims=True))


def largest(g: np.ndarray, most: int, steps: int = 1) -> np.ndarray:
    """The sum of the 1, 2, .. ``most`` largest of each step over that of the others: (k x most).

    The blocks of g (k x m) are ``steps`` runs of equal length.
    """
    ordered = gathered(g, steps)
    return _over_rest(ordered[:, :most], ordered[:, -1:])


def gathered(g: np.ndarray, steps: int = 1) -> np.ndarray:
    """The sum of the 1, 2, .. largest of each step, for g (k x m): (k x m / steps)."""
    return np.sum(np.cumsum(-np.sort(-g.reshape(len(g), steps, -1), 2), 2), 1)


def _over_rest(of: np.ndarray, total: np.ndarray) -> np.ndarray:
    rest = total - of
    ratio = of / np.where(rest > 0, rest, 1.0)
    return np.where((of > 0) & (of >= INFINITE * rest), np.inf, ratio)


def climb(part: Component, U: np.ndarray, choose: Callable, rounds: int) -> np.ndarray:
    """Better rows of U (k x r) for the ratio of the blocks that ``choose`` takes.

    ``choose`` gives, for the sums g (k x m), who is in the numerator (k x m, bool). The
    numerator is replaced by its tangent at u, each |T_k u| of the denominator by the quadratic
    form that touches it from above: at the maximum of that the ratio is no lower.
    """
    rows = part.rows
    for _ in range(rounds):
        z = U @ rows.T
        size = np.hypot(z[:, 0::2], z[:, 1::2])
        inside = choose(size @ part.member)[:, part.block]
        size = np.maximum(size, KINK * size.max(1, keepdims=True))
        slope = (z * np.repeat(inside / size, 2, 1)) @ rows
        form = (rows.T * np.repeat(~inside / size, 2, 1)[:, None]) @ rows
        # a direction that only the numerator sees gets a finite step
        ridge = 1e-14 * np.trace(form, axis1=1, axis2=2) + 1e-100
        form += ridge[:, None, None] * np.eye(rows.shape[1])
        step = np.linalg.solve(form, slope[..., None])[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        U = np.where(length > 0.0, step / np.where(length > 0.0, length, 1.0), U)
    return U


def fixed(sets: np.ndarray) -> Callable:
    """For `climb`: these blocks, a row of ``sets`` (k x m, bool) for each row of U."""
    return lambda g: sets


def top(count: np.ndarray, steps: int = 1) -> Callable:
    """For `climb`: the ``count`` (k,) largest blocks of each step."""

    def choose(g: np.ndarray) -> np.ndarray:
        order = np.argsort(np.argsort(-g.reshape(len(g), steps, -1), 2), 2)
        return (order < count[:, None, None]).reshape(g.shape)

    return choose


def effort(part: Component) -> float:
    """Multiplications of one round of certificates, one for each block, about."""
    N, _, r = part.parts.shape
    blocks = len(np.unique(part.block))
    return N * (4.0 * r * r * blocks + (4.0 * r + NORM) * N) + OVERHEAD * blocks


def bounded(part: Component, most: int, work: float, steps: int = 1) -> Ratios:
    """An interval for each block alone and for the worst sets of up to ``most`` blocks.

    ``work``: multiplications that the certificates of the blocks may take, about, those of
    the sets, and the ascents. With several ``steps`` nothing is said of a block alone.
    """
    if steps > 1:
        return _bounded_by_steps(part, most, work, steps)
    m, (N, _, r) = part.blocks, part.parts.shape
    step = STEPS * 2.0 * N * r * (r + NORM / 2)
    best = _climbed(part, int(np.clip(work / (step * m), 1, 3 * r)))
    g = part.sums(best)
    lower = np.diagonal(single(g))
    rounds = int(np.clip(work / effort(part), 5, ROUNDS))
    upper = np.maximum([_certified_alone(part, part.block == i, rounds) for i in range(m)], lower)
    if most > 1:
        starts = int(np.clip(work / (step * most), 1, m))
        order = np.argsort(-largest(g, most)[:, 1:], 0)[:starts]
        count = np.repeat(np.arange(2, most + 1), starts)
        ends = climb(part, best[order.T.ravel()], top(count), STEPS)
        g = np.concatenate([g, part.sums(ends)])
    lower_sets = np.max(largest(g, most), 0)
    upper_sets = np.maximum(_certified_sets(part, upper, most, work), lower_sets)
    return Ratios(lower, upper, lower_sets, upper_sets)


def _bounded_by_steps(part: Component, most: int, work: float, steps: int) -> Ratios:
    """The sets of up to ``most`` blocks of each step; the ascents start at the best of many u."""
    m, (N, _, r) = part.blocks, part.parts.shape
    # no randomness is needed: the cosines of squares are spread well enough
    mixed = np.cos(np.arange(TRIED * r * r) ** 2.0).reshape(-1, r)
    tried = np.concatenate([np.eye(r), part.parts[:, 0], mixed])
    g = part.sums(tried)
    starts = int(np.clip(work / (STEPS * 2.0 * N * r * (r + NORM / 2) * most), 1, TRIED))
    order = np.argsort(-largest(g, most, steps), 0)[:starts]
    count = np.repeat(np.arange(1, most + 1), len(order))
    ends = climb(part, tried[order.T.ravel()], top(count, steps), STEPS)
    lower_sets = np.max(largest(np.concatenate([g, part.sums(ends)]), most, steps), 0)
    unknown = np.full(m, np.inf)
    upper_sets = np.maximum(_certified_sets(part, unknown, most, work, steps), lower_sets)
    return Ratios(np.zeros(m), unknown, lower_sets, upper_sets)


def _climbed(part: Component, starts: int) -> np.ndarray:
    """The best u found for each block, from what it sees best and from sums of its rows."""
    m, r = part.blocks, part.parts.shape[2]
    first, whose = [np.zeros((0, r))], []
    for i in np.unique(part.block):
        rows = part.parts[part.block == i].reshape(-1, r)
        seen = np.linalg.svd(rows)[2]
        # no randomness is needed: the cosines of squares are spread well enough
        mixed = np.cos(np.arange(2 * r * len(rows)) ** 2.0).reshape(2 * r, -1) @ rows
        first.append(np.concatenate([seen[:1], mixed[:r], seen[1:], mixed[r:]])[:starts])
        whose += [i] * len(first[-1])
    U, own = np.concatenate(first), np.array(whose, int)
    U = np.concatenate([U, climb(part, U, fixed(np.arange(m) == own[:, None]), STEPS)])
    ratio = np.where(np.arange(m) == np.tile(own, 2)[:, None], single(part.sums(U)), -1.0)
    return U[np.argmax(ratio, 0)]


def _certified_alone(part: Component, own: np.ndarray, rounds: int) -> float:
    one = np.ones((own.sum(), 1))
    return _certified(part.parts[own], part.parts[~own], one, 1, rounds) if own.any() else 0.0


def _certified_sets(
    part: Component, upper: np.ndarray, most: int, work: float, steps: int = 1
) -> np.ndarray:
    """For the worst sets: from the bounds of the blocks alone, and from all rows at once."""
    finite = np.where(np.isinf(upper), 0.0, upper)
    shares = np.where(np.isinf(upper), 1.0, finite / (1.0 + finite))
    share = gathered(shares[None], steps)[0, :most]
    member, (N, _, r) = part.member.astype(float), part.parts.shape
    cost = N * (4.0 * r * r + (4.0 * r + NORM) * N) + OVERHEAD
    rounds = int(np.clip(work / (cost * most), FEW, ROUNDS))
    # of one block alone more is known
    first = 2 if steps == 1 else 1
    for p in range(first, min(most, 1 + int(work / (cost * rounds))) + 1):
        at_once = _certified(part.parts, part.parts, member, p, rounds, steps)
        share[p - 1] = min(share[p - 1], at_once)
        if share[p - 1] >= 1.0:
            break
    below = np.where(share < 1.0, share, 0.0)
    ratio = np.where(share < 1.0, below / (1.0 - below), np.inf)
    if steps == 1:
        ratio[0] = np.max(upper)
    return np.minimum.accumulate(ratio[::-1])[::-1]


def _certified(
    R: np.ndarray, T: np.ndarray, member: np.ndarray, p: int, rounds: int, steps: int = 1
) -> float:
    """A bound of (the p largest of each step of: sum of |R_j u| over a block) / sum of |T_k u|.

    R (J x 2 x r), T (N x 2 x r), ``member`` (J x blocks).
    """
    (J, _, r), N = R.shape, len(T)
    flat, rest = R.reshape(2 * J, r), T.reshape(2 * N, r)
    lengths = np.linalg.svd(rest, compute_uv=False) if N else np.zeros(1)
    if len(lengths) < r or lengths[-1] * INFINITE <= 1.0:
        return np.inf
    weight, best = np.ones(N), (np.inf, np.zeros((2 * J, 2 * N)))
    for _ in range(rounds):
        root = np.repeat(np.sqrt(weight), 2)
        q, triangle = np.linalg.qr(rest * root[:, None])
        X = np.linalg.solve(triangle.T, flat.T).T @ q.T * root
        columns = _columns(X, member, p, steps)
        if columns.max() < best[0]:
            best = columns.max(), X
        weight = weight / np.maximum(columns / columns.max(), 1e-3) ** 0.7
        weight = np.maximum(weight / weight.max(), 1e-10)
    # what rounding has left of R - X T is put right, and what is left then is added
    back, X = np.linalg.pinv(rest), best[1]
    X = X + (flat - X @ rest) @ back
    over = _columns((flat - X @ rest) @ back, member, p, steps).max()
    return float((_columns(X, member, p, steps).max() + over) * (1.0 + SLACK))


def _columns(X: np.ndarray, member: np.ndarray, p: int, steps: int) -> np.ndarray:
    """For each part on the right, the p largest sums over blocks of the norms of X's 2 x 2s."""
    a, b, c, d = X[0::2, 0::2], X[0::2, 1::2], X[1::2, 0::2], X[1::2, 1::2]
    half = np.hypot(a + d, b - c) + np.hypot(a - d, b + c)
    sums = (member.T @ (half / 2.0)).reshape(steps, -1, half.shape[1])
    return np.sum(np.sum(-np.sort(-sums, 1)[:, :p], 1), 0)
