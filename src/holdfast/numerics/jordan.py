"""The Jordan structure of a real matrix, and the coordinates in which the DECOMPOSE paper counts.

A Jordan form is not computed: it is fragile, and nothing needs its eigenvectors. What is needed
are the eigenvalues with the sizes of their blocks, and the map from any controllable pair with
the same poles to the pair (J, 1) of the paper.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import schur

from holdfast.numerics.subspaces import NEAR

TOGETHER = 1e-6
"""Relative distance within which eigenvalues with a deficient eigenspace are one block."""
DEFICIENT = 1e-8
"""Singular value of a nilpotent part, relative to its size, that counts as zero."""
ROUNDING = 1e-13
"""The same where only rounding can have scattered eigenvalues further than `TOGETHER`."""


class Block(NamedTuple):
    """One eigenvalue (imaginary part >= 0; its conjugate goes with it) and its Jordan blocks.

    ``sizes``: largest first. ``members``: the eigenvalues as computed, which rounding may have
    scattered about ``value``.
    """

    value: complex
    sizes: tuple[int, ...]
    members: tuple[complex, ...]


def blocks(M: np.ndarray) -> list[Block]:
    """The Jordan structure of a real M (n x n), largest eigenvalue first.

    Eigenvalues within `TOGETHER` of each other whose eigenspace is deficient are one
    eigenvalue, their mean; others are taken as they are, however close.
    """
    left = [complex(z) for z in np.linalg.eigvals(M)]
    found = []
    while left:
        group, value, sizes = _group(M, left)
        # a real eigenvalue's scatter may have imaginary parts, a complex one's conjugates are
        # another group
        left = [z for z in left if z not in group]
        if value.imag >= 0:
            found.append(Block(value, sizes, tuple(group)))
    return sorted(found, key=lambda b: (-abs(b.value), -b.value.real, b.value.imag))


def _group(M, left: list[complex]) -> tuple[list[complex], complex, tuple[int, ...]]:
    first = left[0]
    scale = max(float(np.linalg.norm(M, 2)), np.finfo(float).tiny)
    for distance in NEAR:
        group = [z for z in left if abs(z - first) <= distance * max(abs(z), abs(first))]
        if len(group) == 1:
            break
        value = complex(np.mean(group))
        spread = max(abs(z - value) for z in group)
        if abs(value.imag) <= spread:
            value = complex(value.real)
        limit = DEFICIENT if spread <= TOGETHER * abs(value) else ROUNDING
        sizes = _sizes(M, group, value, limit * scale)
        if sizes is not None:
            return group, value, sizes
    return [first], first, (1,)


def _sizes(M, group: list[complex], value: complex, limit: float) -> tuple[int, ...] | None:
    """The block sizes of M - value I on the invariant subspace of a group; None if it is regular.

    From the ranks of its powers (the Weyr characteristic).
    """
    reach = 2.0 * max(abs(z - value) for z in group) + 1e-14 * abs(value)
    triangle, _, count = schur(M, output="complex", sort=lambda z: bool(abs(z - value) <= reach))
    k = len(group)
    if count != k:
        return None
    nilpotent = triangle[:k, :k] - value * np.eye(k)
    size = max(1.0, float(np.linalg.norm(nilpotent, 2)))
    power, nullities = np.eye(k), [0]
    for j in range(1, k + 1):
        power = power @ nilpotent
        values = np.linalg.svd(power, compute_uv=False)
        nullities.append(int(np.sum(values <= limit * size ** (j - 1))))
        if nullities[-1] == k:
            break
    if nullities[1] == 0 or nullities[-1] < k:
        return None
    # as many blocks of size >= j as the j-th step of the nullities
    steps = np.diff(nullities)
    return tuple(int(np.sum(steps > i)) for i in range(int(steps[0])))


class Coordinates(NamedTuple):
    """The paper's coordinates of a local estimate, as real numbers: ``rows`` (d x d) times it.

    The l1 norm there is the sum over groups of weight times 2-norm: a real entry is a group of
    one, real and imaginary part of a complex entry are a group of two, of weight 2 because the
    conjugate entry counts as well. An entry that the paper has several times (repeated
    eigenvalues with several blocks) has its number as a factor. ``group`` (d,) names the group
    of each row; ``weight`` has an entry for each group.
    """

    rows: np.ndarray
    group: np.ndarray
    weight: np.ndarray

    @property
    def condition(self) -> float:
        """How much a relative rounding of the local estimate grows in these coordinates."""
        return float(np.linalg.cond(self.rows)) if self.rows.size else 1.0


def coordinates(S: np.ndarray, b: np.ndarray, found: list[Block]) -> Coordinates:
    """The rows t with t S = J t and t b = 1 for every block J, for a controllable pair (S, b).

    S (d x d) has the minimal polynomial of ``found`` as its characteristic one. Within a
    block t_s (S - z) = 0 and t_j (S - z) = t_{j+1}, each with t b = 1.

    Source: DECOMPOSE (9), (12); the l1 norm of (31).
    """
    rows, group, weight = [], [], []
    for block in found:
        after = np.zeros(len(b), complex)
        for height in range(1, block.sizes[0] + 1):
            system = np.vstack([(S - block.value * np.eye(len(b))).T, b[None]])
            after = np.linalg.lstsq(system, np.append(after, 1.0), rcond=None)[0]
            copies = sum(size >= height for size in block.sizes)
            parts = [after.real] if block.value.imag == 0 else [after.real, after.imag]
            group += [len(weight)] * len(parts)
            weight.append(float(copies * len(parts)))
            rows += parts
    return Coordinates(np.array(rows), np.array(group), np.array(weight))
