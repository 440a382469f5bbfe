"""The Jordan structure of a real matrix, and the coordinates in which the DECOMPOSE paper counts.

A Jordan form is not computed: it is fragile, and nothing needs its eigenvectors. What is needed
are the eigenvalues with the sizes of their blocks, and the map from any controllable pair with
the same poles to the pair (J, 1) of the paper.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import matrix_balance, schur

from holdfast.numerics.subspaces import NEAR

TOGETHER = 1e-6
"""Relative distance within which eigenvalues with a deficient eigenspace are one block."""
DEFICIENT = 1e-8
"""Singular value of a nilpotent part, relative to its size, that counts as zero for these."""
ROUNDING = 1e-12
"""The same for eigenvalues further apart, and for several blocks of one eigenvalue: there only
rounding may have scattered them, since their mean stands for all."""


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
    eigenvalue, their mean; others are taken as they are, however close. The units of the
    state make no difference (up to powers of 2, which balancing takes).
    """
    M = matrix_balance(M, permute=False)[0]
    computed = np.diag(schur(M, output="complex")[0])
    left = [complex(z) for z in np.linalg.eigvals(M)]
    found = []
    while left:
        group, value, sizes = _group(M, computed, left)
        for z in group:
            left.remove(z)
        # a real eigenvalue's scatter may have imaginary parts, a complex one's conjugates are
        # another group
        if value.imag >= 0:
            found.append(Block(value, sizes, tuple(group)))
    return sorted(found, key=lambda b: (-abs(b.value), -b.value.real, b.value.imag))


def _group(M, computed, left: list[complex]) -> tuple[list[complex], complex, tuple[int, ...]]:
    first = left[0]
    scale = max(float(np.linalg.norm(M, 2)), np.finfo(float).tiny)
    for distance in NEAR:
        group = [z for z in left if abs(z - first) <= distance * scale]
        if len(group) == 1:
            break
        value = complex(np.mean(group))
        spread = max(abs(z - value) for z in group)
        if abs(value.imag) <= spread:
            if any(z.conjugate() not in group for z in group):
                continue
            value = complex(value.real)
        nilpotent = _nilpotent(M, computed, value, len(group))
        sizes = _sizes(nilpotent, ROUNDING * scale)
        if sizes is None and spread <= TOGETHER * abs(value):
            sizes = _sizes(nilpotent, DEFICIENT * scale)
            if sizes is not None and len(sizes) > 1:
                continue
        if sizes is not None:
            return group, value, sizes
    return [first], first, (1,)


def _nilpotent(M, computed, value: complex, k: int) -> np.ndarray:
    """M - value I on the invariant subspace of the k eigenvalues nearest to ``value``.

    ``computed``: the eigenvalues as the factorisation finds them, which scatters them
    differently from one that balances or keeps conjugates exact.
    """
    away = np.append(np.sort(np.abs(computed - value)), np.inf)
    reach = (away[k - 1] + away[k]) / 2
    triangle = schur(M, output="complex", sort=lambda z: bool(abs(z - value) < reach))[0]
    return triangle[:k, :k] - value * np.eye(k)


def _sizes(nilpotent: np.ndarray, limit: float) -> tuple[int, ...] | None:
    """The block sizes of a nilpotent matrix; None if it is not nilpotent.

    From the ranks of its powers (the Weyr characteristic).
    """
    k = len(nilpotent)
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
