"""Random projections onto polytopes, and their solution by trying every set of active faces."""

from itertools import combinations
from typing import NamedTuple

import numpy as np


class Problems(NamedTuple):
    """Problems of one shape, one for each entry of the first axis."""

    point: np.ndarray
    cov: np.ndarray
    rows: np.ndarray
    bound: np.ndarray


def covariances(rng, count, n):
    root = rng.normal(size=(count, n, n))
    return root @ root.swapaxes(1, 2) + 0.1 * np.eye(n)


def times(matrices, vectors):
    return np.einsum("kij,kj->ki", matrices, vectors)


def generic(rng, count, n, m):
    """A point of its own inside, so that the set is not empty."""
    rows = rng.normal(size=(count, m, n))
    bound = times(rows, 0.5 * rng.normal(size=(count, n))) + rng.uniform(0, 1, (count, m))
    return Problems(rng.normal(size=(count, n)), covariances(rng, count, n), rows, bound)


def perhaps_empty(rng, count, n, m):
    found = generic(rng, count, n, m)
    return found._replace(bound=rng.normal(size=(count, m)))


def duplicates(rng, count, n, m):
    """The second half of the rows are the first, in other units."""
    found = generic(rng, count, n, m)
    half, units = m // 2, 10.0 ** rng.uniform(-6, 6, (count, m // 2))
    found.rows[:, -half:] = units[..., None] * found.rows[:, :half]
    found.bound[:, -half:] = units * found.bound[:, :half]
    return found


def equalities(rng, count, n, m):
    """Opposite rows that meet; every fourth pair leaves a gap of 0.1: empty."""
    found = generic(rng, count, n, m)
    apart = np.where(np.arange(count) % 4 == 0, 0.1, 0.0)
    found.rows[:, 1] = -found.rows[:, 0]
    found.bound[:, 1] = -found.bound[:, 0] - apart
    return found


def zero_rows(rng, count, n, m):
    """0 z <= b with b of either sign or 0, and rows without a bound."""
    found = generic(rng, count, n, m)
    found.rows[:, 0] = 0.0
    found.bound[:, 0] = rng.choice([-1.0, 0.0, 1.0], count)
    found.bound[:, 2] = np.inf
    return found


def one_vertex(rng, count, n, m):
    """Every face through one point: more of them than dimensions."""
    found = generic(rng, count, n, m)
    return found._replace(bound=times(found.rows, 0.5 * rng.normal(size=(count, n))))


def whole_numbers(rng, count, n, m):
    """Rows of -1, 0, 1 and small whole bounds: ties of every kind, exactly."""
    rows = rng.integers(-1, 2, (count, m, n)).astype(float)
    bound = rng.integers(-1, 3, (count, m)).astype(float)
    root = rng.integers(-1, 2, (count, n, n)).astype(float)
    cov = root @ root.swapaxes(1, 2) + np.eye(n)
    return Problems(rng.integers(-3, 4, (count, n)).astype(float), cov, rows, bound)


def singular(rng, count, n, m):
    """Whole covariances of half the rank; half of the problems with a point in reach."""
    found = whole_numbers(rng, count, n, m)
    root = rng.integers(-2, 3, (count, n, max(1, n // 2))).astype(float)
    reached = found.point + times(root, rng.normal(size=(count, root.shape[2])))
    inside = times(found.rows, reached) + rng.uniform(0, 1, (count, m))
    bound = np.where((np.arange(count) % 2 == 0)[:, None], inside, found.bound)
    return found._replace(cov=root @ root.swapaxes(1, 2), bound=bound)


def graded(rng, count, n, m):
    """Correlated, standard deviations from 3e-5 to 1: covariances of condition 1e10 and more."""
    found = generic(rng, count, n, m)
    spread = 10.0 ** -np.linspace(0, 4.5, n)
    return found._replace(cov=spread[:, None] * found.cov * spread)


FAMILIES = (
    generic, perhaps_empty, duplicates, equalities, zero_rows, one_vertex, whole_numbers,
    singular, graded,
)  # fmt: skip


def enumerated(problems: Problems):
    """The projections, which of them exist, and the squared distances.

    The nearest point of a polytope is the shortest vector onto the intersection of some of
    its faces; so it is the shortest of all those that lie in the polytope. Pseudo-inverses
    from singular values, in the eigenvectors of the correlation matrix.
    """
    point, cov, rows, bound = problems
    count, m, n = rows.shape
    sd = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    safe = np.where(sd > 0, sd, 1.0)
    values, vectors = np.linalg.eigh(cov / safe[:, :, None] / safe[:, None, :])
    values = np.where(values > 1e-12, values, 0.0)
    factor = sd[:, :, None] * vectors * np.sqrt(values)[:, None, :]
    normal = rows @ factor
    size = np.einsum("kij,kj->ki", np.abs(rows), sd)
    length = np.linalg.norm(normal, axis=2)
    seen = length > 1e-8 * size
    length = np.where(seen, length, np.where(size > 0, size, 1.0))
    normal = np.where(seen[..., None], normal / length[..., None], 0.0)
    distance = (bound - times(rows, point)) / length
    finite = np.where(np.isfinite(distance), distance, 0.0)
    scale = np.abs(finite) + np.abs(times(rows, point)) / length

    best, shortest = np.zeros((count, n)), np.full(count, np.inf)
    for size in range(min(m, n) + 1):
        for some in map(list, combinations(range(m), size)):
            x = times(np.linalg.pinv(normal[:, some], rcond=1e-9), finite[:, some])
            length_of = np.linalg.norm(x, axis=1)
            # 1e-11: the pseudo-inverse of nearly parallel faces loses four digits of 15
            excess = times(normal, x) - distance - 1e-11 * (scale + length_of[:, None] + 1e-9)
            better = np.all(excess <= 0, axis=1) & (length_of < shortest)
            shortest = np.where(better, length_of, shortest)
            best = np.where(better[:, None], x, best)
    feasible = np.isfinite(shortest)
    return point + times(factor, best), feasible, np.where(feasible, shortest**2, 0.0)
