"""How few samples of a window see some direction u: counts over all rays.

With s_t(u) the number of samples of step t that see u (row u other than zero), what is counted here
depends on the set of zeros of u alone. The rays, orthogonal to r - 1 independent rows, are enough:
more zeros never make the sum of the s_t or the largest of them larger, and the share that some
samples I have in all that see u is on some ray no smaller than at u. To see this, give each sample
in I the value c - 1 and each other one c, where c is the share, so that those which see u add up to
0 and, wherever they add up to 0 or less, the share is c or more. Of the classes of parallel rows
one has a sum that is no smaller than that of all: let it vanish, and what remains, with a dimension
less, adds up to 0 or less; and so on down to a ray.

Parts of the plant that share no state are counted one by one: of u = (u_1, u_2) the counts are
s_t(u_1) + s_t(u_2). As min(q, a + b) <= min(q, a) + min(q, b), and (a + b) / (c + d) is at most the
larger of a / c and b / d, the largest share of the whole is that of one part, where it is met.
"""

import math
from typing import NamedTuple

import numpy as np

from holdfast.numerics.ratio_bounds import Component
from holdfast.numerics.rays import CHUNK, cost, lines, normals

ZERO = 1e-9
"""A unit row times a unit u that counts as zero. Every pattern is also met at its best-conditioned
rows, of which the others are combinations with coefficients up to 1: rounding stays below."""
SAMPLED = 2_000
"""Rays that are looked at where there are too many."""


class Counts(NamedTuple):
    """The worst, over all u other than 0, of what is counted.

    ``share`` (most,): the largest sum of the min(q, s_t) over the sum of the s_t, for q = 1,
    2, ..: the part of the samples of u that q attacks per step can take. ``fewest``: the least
    sum of the s_t; ``tallest``: the least of the largest s_t; both infinite where there is no
    u. ``exact``: whether all u were looked at; where not, some u may be worse.
    """

    share: np.ndarray
    fewest: float
    tallest: float
    exact: bool = True

    def worse(self, other: "Counts") -> "Counts":
        """Of two parts that share no state, the whole."""
        return Counts(
            np.maximum(self.share, other.share),
            min(self.fewest, other.fewest),
            min(self.tallest, other.tallest),
            self.exact and other.exact,
        )


def nothing(most: int) -> Counts:
    """The counts where there is no u at all."""
    return Counts(np.zeros(most), np.inf, np.inf)


def effort(part: Component) -> float:
    """Rays times rows that `counted` looks at to be exact."""
    return cost(lines(part, 1)[0])


def counted(part: Component, steps: int, most: int, limit: float) -> Counts:
    """The counts of the samples of ``part``, whose blocks are ``steps`` runs of equal length.

    Exact where ``limit`` allows as many rays times rows as `effort` says; elsewhere of a sample
    of the rays.
    """
    rows, weights = lines(part, 1)
    N = len(rows)
    per_step = np.sum((weights > 0.0).reshape(N, steps, -1), 2).astype(float)
    found, exact = nothing(most), cost(rows) <= limit
    for U in normals(rows) if exact else [_sample(rows)]:
        for few in np.array_split(U, math.ceil(len(U) * N / CHUNK)):
            found = found.worse(_least(np.abs(few @ rows.T) > ZERO, per_step, most))
    return found._replace(exact=exact)


def _least(seen: np.ndarray, per_step: np.ndarray, most: int) -> Counts:
    """Of u of which ``seen`` (k x N) says which rows see them."""
    if not len(seen):
        return nothing(most)
    s = seen.astype(float) @ per_step
    # a u that rounding hides from all samples is lost to any attack
    s[~np.any(s > 0.0, axis=1), 0] = 1.0
    total = np.sum(s, 1)
    taken = [np.max(np.sum(np.minimum(q, s), 1) / total) for q in range(1, most + 1)]
    return Counts(np.array(taken), float(np.min(total)), float(np.min(np.max(s, 1))))


def _sample(rows: np.ndarray) -> np.ndarray:
    """Unit vectors (k x r), each orthogonal to r - 1 rows."""
    N, r = rows.shape
    # no randomness is needed: the cosines of squares are spread well enough
    mixed = np.cos(np.arange(1, SAMPLED * N + 1) ** 2.0).reshape(SAMPLED, N)
    sets = np.argsort(mixed, 1)[:, : r - 1]
    return np.linalg.qr(np.swapaxes(rows[sets], 1, 2), mode="complete")[0][:, :, -1]
