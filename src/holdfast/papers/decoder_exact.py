"""Small systems in whole numbers, whose windows are looked at exactly.

In the basis of its eigenvectors A is diagonal, and a factor of A changes no support: whole numbers
stand for all rational eigenvalues. Row (t, i) of Phi is then C_ij l_j^t. What Phi z is zero on is
decided without rounding, for every z other than 0 (up to three states).
"""

import itertools
import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.random import Generator, default_rng

LONGEST = 12
"""Steps of the longest window that is drawn."""
SEEN = 0.85
"""Share of the eigenvectors that a sensor sees."""


class Case(NamedTuple):
    """A system, q and a window: T is what Theorem 1 asks for if |supp(C v_i)| > 2 q for all i.

    ``values`` (n,), ``C`` (p x n) whole numbers. ``seen`` (k x T x p): every support of Phi z
    that there is; ``rays`` (k x n): the z that are zero on n - 1 independent rows.
    """

    values: np.ndarray
    C: np.ndarray
    q: int
    T: int
    seen: np.ndarray
    rays: np.ndarray

    @property
    def s(self) -> np.ndarray:
        """|supp(C v_i)| of each eigenvector."""
        return np.sum(self.C != 0, 0)

    @property
    def guaranteed(self) -> bool:
        """(i) of Theorem 1."""
        return bool(np.min(self.s) > 2 * self.q)

    @property
    def fewest(self) -> int:
        """The least |supp(Phi z)|."""
        return int(np.min(np.sum(self.seen, (1, 2))))

    @property
    def together(self) -> int:
        """The least number of sensors that see z at some step."""
        return int(np.min(np.sum(np.any(self.seen, 1), 1)))

    @property
    def Phi(self) -> np.ndarray:
        """(T p x n) as floating-point numbers."""
        return window(self.values, self.C, self.T).astype(float)

    def over(self, T: int) -> "Case":
        """The same system with another window."""
        return case(self.values, self.C, self.q, T)


def case(values, C, q: int, T: int) -> Case:
    """With the supports of its window."""
    values, C = np.array(values, object), np.array(C, object)
    rows = window(values, C, T)
    return Case(values, C, q, T, supports(rows).reshape(-1, T, len(C)), rays(rows))


def window(values: np.ndarray, C: np.ndarray, T: int) -> np.ndarray:
    """Phi (T p x n)."""
    return np.concatenate([C * values**t for t in range(T)])


def rays(rows: np.ndarray) -> np.ndarray:
    """Every z (k x n) that is orthogonal to n - 1 independent rows, n = 1, 2 or 3."""
    n = rows.shape[1]
    if n == 1:
        return np.ones((1, 1), object)
    if n == 2:
        found = rows @ np.array([[0, 1], [-1, 0]], object)
    else:
        i, j = np.triu_indices(len(rows), 1)
        found = across(rows[i], rows[j])
    return found[np.any(found != 0, 1)]


def across(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of rows of three."""
    turned = [a[:, (k + 1) % 3] * b[:, (k + 2) % 3] for k in range(3)]
    back = [a[:, (k + 2) % 3] * b[:, (k + 1) % 3] for k in range(3)]
    return np.stack(turned, 1) - np.stack(back, 1)


def supports(rows: np.ndarray) -> np.ndarray:
    """Every support of rows z, z other than 0 (k x N): the rows that z is zero on are a flat."""
    N, n = rows.shape
    found = [np.any(rows != 0, 1)[None], rays(rows) @ rows.T != 0]
    if n == 3:
        i, j = np.divmod(np.arange(N * N), N)
        parallel = np.all(across(rows[i], rows[j]) == 0, 1).reshape(N, N)
        found.append(~parallel[found[0][0]])
    return np.unique(np.concatenate(found).astype(bool), axis=0)


def relation(values: list[int], steps: list[int]) -> list[int]:
    """The w with sum_j w_j values_j^t = 0 at each of the steps, one fewer than the values."""
    rows = [[Fraction(value) ** t for value in values] for t in steps]
    n = len(values)
    for k in range(n - 1):
        pivot = next(r for r in range(k, n - 1) if rows[r][k])
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [x / rows[k][k] for x in rows[k]]
        for r in set(range(n - 1)) - {k}:
            rows[r] = [x - rows[r][k] * y for x, y in zip(rows[r], rows[k], strict=True)]
    w = [-row[n - 1] for row in rows] + [Fraction(1)]
    scale = math.lcm(*(x.denominator for x in w))
    return [int(x * scale) for x in w]


def bound(s, p: int, q: int) -> Fraction:
    """The largest, over m and all sets of m of the s_i of ((m - 2) p + min) / (max - 2 q)."""
    sets = [few for m in range(2, len(s) + 1) for few in itertools.combinations(map(int, s), m)]
    each = [Fraction((len(few) - 2) * p + min(few), max(few) - 2 * q) for few in sets]
    return max(each, default=Fraction(0))


def cases(count: int, seed: int = 0) -> list[Case]:
    """Systems of two and three states, three to five sensors. Of every two, one has a state that
    each sensor misses at as many steps as it can.
    """
    rng, found = default_rng(seed), []
    while len(found) < count:
        n, p = int(rng.integers(2, 4)), int(rng.integers(3, 6))
        one = _drawn(rng, n, p, int(rng.integers(1, (p - 1) // 2 + 1)), len(found) % 2 == 0)
        found += [one] if one else []
    return found


def _drawn(rng: Generator, n: int, p: int, q: int, cancelled: bool) -> Case | None:
    values = np.sort(rng.choice(np.arange(1, 5), n, replace=False)).astype(int)
    there = rng.random((p, n)) < SEEN
    s = np.sum(there, 0)
    if not (np.all(np.any(there, 1)) and np.all(s)):
        return None
    T = math.floor(bound(s, p, q)) + 1 if min(s) > 2 * q else n + 1
    if T > LONGEST:
        return None
    C = np.zeros((p, n), object)
    for row, sees in zip(C, there, strict=True):
        own = values[sees].tolist()
        steps = rng.choice(T, len(own) - 1, replace=False).tolist()
        drawn = (rng.integers(1, 4, len(own)) * rng.choice([-1, 1], len(own))).tolist()
        row[sees] = relation(own, sorted(steps)) if cancelled else drawn
    length = np.linalg.norm(C.astype(float), axis=1, keepdims=True)
    if np.linalg.matrix_rank(C.astype(float) / length, tol=1e-9) < n:
        return None
    return case(values.astype(object), C, q, T)
