"""The worst ratio of sums of norms: how far a few blocks can outweigh all the others.

With g_i(u) the sum over the parts of block i of |part u| (a row), or of the 2-norm of part u (a
pair of rows: the modulus of a complex one), the ratio of a set I of blocks is

    max over u of  sum over I of g_i(u) / sum over the others of g_i(u).

Where all parts are rows, both sums are linear on every cell of the hyperplanes row u = 0, so
that the maximum lies on a ray orthogonal to n - 1 independent rows: finitely many, all of which
are tried. A pair is replaced by its components along K directions; with c = sin(pi / 2K),

    cos(pi / 2K) |z|  <=  c sum_k |component k of z|  <=  |z|

which bounds the ratio from both sides. Where there are too many rays,
`holdfast.numerics.ratio_bounds` bounds it.

Source: DECOMPOSE, Theorem 4, whose condition is that every ratio is below 1.
"""

import itertools
import math
from collections.abc import Iterator

import numpy as np
from scipy.sparse.csgraph import connected_components

from holdfast.numerics.ratio_bounds import (
    FEW,
    STEPS,
    Component,
    Ratios,
    bounded,
    climb,
    effort,
    fixed,
    gathered,
    largest,
    single,
    top,
)
from holdfast.numerics.subspaces import kernel

MOST = 1e8
"""Rays times rows up to which all rays are tried: a second or two."""
DIRECTIONS = (1024, 256, 64, 32, 16, 12, 8, 6, 4)
"""Numbers of directions of a pair; the ratio is then known to a factor 1 / cos(pi / 2K)."""
WORK = 10.0
"""Multiplications of a certificate that take as long as a row of a ray."""
NEAR = 1.0 - 1e-4
"""Factor from which the best ray is not improved upon."""
NOTHING = 1e-12
"""Relative size that counts as zero."""
PARALLEL = 1e-9
"""Distance of unit rows that are taken as one."""
LINES = 10_000
"""Rows of pairs that are looked at; more are too dear in any case."""
CHUNK = 1_000_000
"""Numbers that are held at a time."""


def components(
    G: np.ndarray, group: np.ndarray, trusted: tuple[int, ...] = (), seen: np.ndarray | None = None
) -> list[Component]:
    """The blocks of G (m x d x n), rows with the same ``group`` (d,) a pair, taken apart.

    Directions u that a ``trusted`` block sees are left out, and so is what no block sees;
    ``seen`` (k x n) has the rows of the trusted blocks, if there are better ones than G's.
    Components share no state. The worst ratio of the whole is that of one of them, since
    (a + c) / (b + d) is at most the larger of a / b and c / d.
    """
    m, _, n = G.shape
    names, which = np.unique(group, return_inverse=True)
    parts = np.zeros((m, len(names), 2, n))
    for j, part in enumerate(which):
        parts[:, part, int(np.any(which[:j] == part))] = G[:, j]
    parts = parts.reshape(-1, 2, n)
    block = np.repeat(np.arange(m), len(names))
    sizes = np.hypot(parts[:, 0], parts[:, 1])
    limit = np.minimum.outer(sizes.max(1, initial=0.0), sizes.max(0, initial=0.0))
    there = (sizes > NOTHING * limit).astype(int)
    count, label = connected_components(there.T @ there, directed=False)
    fixed = G[list(trusted)].reshape(-1, n) if seen is None else seen
    left = ~np.isin(block, trusted)
    found = []
    for k in range(count):
        columns = label == k
        own = left & there[:, columns].any(1)
        if own.any():
            found.append(_component(parts[own][:, :, columns], block[own], m, fixed[:, columns]))
    return [part for part in found if part.parts.size]


def _component(parts: np.ndarray, block: np.ndarray, blocks: int, fixed: np.ndarray) -> Component:
    """In orthonormal coordinates of the u with fixed u = 0 that some block sees."""
    size = np.linalg.norm(np.concatenate([fixed, parts.reshape(-1, parts.shape[2])]), axis=0)
    size = np.where(size > 0, size, 1.0)
    parts, fixed = parts / size, fixed / size
    length = np.linalg.norm(fixed, axis=1, keepdims=True)
    parts = parts @ kernel(fixed / np.where(length > 0, length, 1.0))
    flat = parts.reshape(2 * len(parts), parts.shape[2])
    left, values, _ = np.linalg.svd(flat, full_matrices=False)
    left = left[:, values > NOTHING]
    parts = left.reshape(len(parts), 2, left.shape[1])
    if not parts.size:
        return Component(parts, block, blocks)
    _, lengths, right = np.linalg.svd(parts, full_matrices=False)
    # a pair whose rows are parallel is a row
    thin = lengths[:, -1] <= NOTHING * lengths[:, 0] if lengths.shape[1] > 1 else True
    alone = lengths[:, 0, None] * right[:, 0]
    parts = np.where(np.reshape(thin, (-1, 1, 1)), np.stack([alone, 0.0 * alone], 1), parts)
    there = lengths[:, 0] > NOTHING
    return Component(parts[there], block[there], blocks)


def affordable(found: list[Component], limit: float) -> bool:
    """Whether `worst` is exact, or gives a narrow interval, within ``limit``."""
    each = limit / max(1, len(found))
    return all(
        cost(lines(part, DIRECTIONS[-1])[0]) <= each or FEW * effort(part) <= WORK * each
        for part in found
    )


def worst(
    found: list[Component], blocks: int, most: int, limit: float = MOST, steps: int = 1
) -> Ratios:
    """The ratio of each block alone, and of the worst sets of 1 .. ``most`` of the ``blocks``.

    With ``steps``, the blocks are so many runs of equal length, and the sets have 1 .. ``most``
    blocks of each: (a + c) / (b + d) is still the worst of one component, since the largest of
    two lists together are no more than the largest of each. Exact where all parts are rows and
    ``limit``, shared by the components, allows all rays to be tried; elsewhere an interval that
    contains it.
    """
    ratios = Ratios(*(np.zeros(count) for count in (blocks, blocks, most, most)))
    for part in found:
        each = limit / len(found)
        own = _tried(part, most, each, steps)
        if own is None:
            own = bounded(part, most, WORK * each, steps)
        elif not own.narrow:
            own = own.tightened(bounded(part, most, WORK * each, steps))
        ratios = ratios.worse(own)
    return ratios


def _tried(part: Component, most: int, limit: float, steps: int) -> Ratios | None:
    """All rays, with as many directions of a pair as can be afforded; None if too dear."""
    pairs = int(np.sum(np.any(part.parts[:, 1] != 0.0, axis=1)))
    for K in DIRECTIONS if pairs else (1,):
        if pairs * K > LINES:
            continue
        rows, weights = lines(part, K)
        if cost(rows) <= limit:
            factor = math.cos(math.pi / (2 * K)) if pairs else 1.0
            return _best(part, rows, weights, most, factor, steps)
    return None


def lines(part: Component, K: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit rows (N x r), no two parallel, and their weights (N x blocks): g = |rows u| weights."""
    paired = np.any(part.parts[:, 1] != 0.0, axis=1)
    angle = np.arange(K) * math.pi / K
    turned = math.sin(math.pi / (2 * K)) * np.stack([np.cos(angle), np.sin(angle)], 1)
    split = (turned @ part.parts[paired]).reshape(-1, part.parts.shape[2])
    rows = np.concatenate([part.parts[~paired, 0], split])
    block = np.concatenate([part.block[~paired], np.repeat(part.block[paired], K)])
    size = np.linalg.norm(rows, axis=1)
    rows = rows / size[:, None]
    rows = rows * np.where(rows @ np.cos(np.arange(rows.shape[1])) < 0, -1.0, 1.0)[:, None]
    # parallel rows that rounding keeps apart cost time, not truth
    _, first, which = np.unique(
        np.round(rows / PARALLEL), axis=0, return_index=True, return_inverse=True
    )
    weights = np.zeros((len(first), part.blocks))
    np.add.at(weights, (which.ravel(), block), size)
    return rows[first], weights


def cost(rows: np.ndarray) -> float:
    """N times N choose r - 1."""
    N, r = rows.shape
    rays = math.lgamma(N + 1) - math.lgamma(r) - math.lgamma(N - r + 2)
    return N * math.exp(min(rays, 600.0))


def _best(
    part: Component, rows: np.ndarray, weights: np.ndarray, most: int, factor: float, steps: int
) -> Ratios:
    """The best of all rays, where |rows u| weights is from ``factor`` to once the sums."""
    m, r = part.blocks, rows.shape[1]
    share, where = np.full(m + most, -1.0), np.zeros((m + most, r))
    for U in normals(rows):
        for few in np.array_split(U, math.ceil(len(U) * len(rows) / CHUNK)):
            g = np.abs(few @ rows.T) @ weights
            g = g / np.sum(g, 1, keepdims=True)
            shares = np.concatenate([g, gathered(g, steps)[:, :most]], 1)
            at = np.argmax(shares, 0)
            new = shares[at, np.arange(m + most)]
            better = new > share
            share[better], where[better] = new[better], few[at[better]]
    if factor == 1.0:
        lower = _values(part, where, most, steps)
        return Ratios(lower[:m], lower[:m], lower[m:], lower[m:])
    g = np.abs(where @ rows.T) @ weights
    upper = np.append(np.diagonal(single(g)[:m]), np.diagonal(largest(g, most, steps)[m:])) / factor
    lower = _values(part, where, most, steps)
    if factor < NEAR:
        own = climb(part, where[:m], fixed(np.eye(m, dtype=bool)), STEPS)
        sets = climb(part, where[m:], top(np.arange(1, most + 1), steps), STEPS)
        lower = np.maximum(lower, _values(part, np.concatenate([own, sets]), most, steps))
    upper = np.maximum(upper, lower)
    return Ratios(lower[:m], upper[:m], lower[m:], upper[m:])


def _values(part: Component, U: np.ndarray, most: int, steps: int) -> np.ndarray:
    """The ratio of each block at its row of U, then of the sets at theirs."""
    g, m = part.sums(U), part.blocks
    return np.append(np.diagonal(single(g[:m])), np.diagonal(largest(g[m:], most, steps)))


def normals(rows: np.ndarray) -> Iterator[np.ndarray]:
    """Unit vectors (k x r) among which is every ray orthogonal to r - 1 independent rows.

    The orthogonal plane of r - 2 rows at a time, and in it the normal of each row that comes
    before them all.
    """
    N, r = rows.shape
    if r == 1:
        yield np.ones((1, 1))
        return
    if r == 2:
        yield rows @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        return
    for first in range(1, N - r + 3):
        others = itertools.combinations(range(first + 1, N), r - 3)
        size = max(1, CHUNK // (first * N))
        while chosen := list(itertools.islice(others, size)):
            sets = np.array(chosen, int).reshape(len(chosen), r - 3)
            sets = np.concatenate([np.full((len(sets), 1), first), sets], 1)
            planes = np.linalg.qr(np.swapaxes(rows[sets], 1, 2), mode="complete")[0][:, :, r - 2 :]
            across = rows[:first] @ planes
            size_of = np.linalg.norm(across, axis=2, keepdims=True)
            normal = across @ np.array([[0.0, 1.0], [-1.0, 0.0]])
            normal = normal / np.where(size_of > NOTHING, size_of, 1.0)
            U = (normal @ np.swapaxes(planes, 1, 2)).reshape(-1, r)
            # a row that depends on the others has no normal of its own
            yield U[size_of.ravel() > NOTHING]
