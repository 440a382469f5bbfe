"""How many sensors see each mode, and the windows that follow from those numbers alone."""

import itertools
import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from holdfast.analysis.model import Model
from holdfast.numerics.subspaces import TOLERANCE, complement, kernel, modes, scaled, silent

SUBSETS = 20_000
"""Sets of sensors tried for a repeated eigenvalue, and sets of modes that are told apart."""

SETS = 500
"""Sets of sensors that are taken away from a short window."""


class Seen(NamedTuple):
    """An eigenvalue, how often it occurs, and the sensors (p,) that see its eigenvector.

    Of several eigenvectors, the one that the fewest sensors see.
    """

    eigenvalue: complex
    multiplicity: int
    sensors: np.ndarray

    @property
    def number(self) -> int:
        """|supp(C v)|."""
        return int(np.sum(self.sensors))


def supports(model: Model, trusted: tuple[int, ...] = ()) -> tuple[Seen, ...] | None:
    """supp(C v) for an eigenvector v of each eigenvalue, in the order of `modes`.

    A complex pair has one entry for each of the two; its entries of C v count by modulus. With
    ``trusted`` sensors, only eigenvectors that they do not see. None if too dear.

    Source: DECODER, Lemma 3 and Theorem 1 (whose s_i these are).
    """
    n, m = len(model.A), len(model.C)
    s = scaled(model.A, np.zeros((n, 0)), model.C, np.zeros((m, 0)))
    found = []
    for z, multiplicity in modes(s.A):
        off = s.A - z * np.eye(n)
        space = kernel(off, s.size)
        # an eigenvalue as computed has an eigenvector, whatever rounding says
        space = space if space.shape[1] else np.linalg.svd(off)[2][-1:].conj().T
        space = space @ kernel(s.C[list(trusted)] @ space)
        if not space.shape[1]:
            continue
        sensors = _fewest(s.C @ space)
        if sensors is None:
            return None
        found.append(Seen(z, multiplicity, sensors))
    return tuple(found)


def _fewest(seen: np.ndarray) -> np.ndarray | None:
    """The rows of ``seen`` (m x r) that see the direction which the fewest see."""
    m, r = seen.shape
    if kernel(seen).shape[1]:
        return np.zeros(m, bool)
    count = math.comb(m, r - 1)
    if count > SUBSETS:
        return None
    sets = np.reshape(list(itertools.combinations(range(m), r - 1)), (count, r - 1))
    hidden = np.linalg.svd(seen[sets.astype(int)], full_matrices=True)[2][:, -1].conj()
    found = np.abs(seen @ hidden.T) > TOLERANCE
    return found[:, np.argmin(np.sum(found, 0))]


def sparse_observable(model: Model, trusted: tuple[int, ...] = ()) -> int | None:
    """The largest q such that the state stays observable without any 2 q sensors.

    A sensor is of no use for a mode if it does not see its eigenvector; of a repeated
    eigenvalue, the eigenvector that the fewest sensors see. With ``trusted`` sensors, which
    stay. None if too dear.

    Source: DECODER, Proposition 1 for T >= n: |union over t of supp(C A^t z)| > 2 q.
    """
    found = supports(model, trusted)
    if found is None:
        return None
    # a mode that no sensor but trusted ones could see is not in danger
    fewest = min((mode.number for mode in found), default=2 * len(model.C) + 1)
    return max(0, (fewest - 1) // 2)


def observable_without(model: Model, window: int, trusted: tuple[int, ...] = ()) -> int | None:
    """`sparse_observable` of a window of any length; None if too dear.

    Source: DECODER, Proposition 1.
    """
    p, n = model.C.shape
    if window >= n:
        return sparse_observable(model, trusted)
    others = [i for i in range(p) if i not in trusted]
    for q in range(1, len(others) // 2 + 1):
        if math.comb(len(others), 2 * q) > SETS:
            return None
        for lost in itertools.combinations(others, 2 * q):
            kept = tuple(i for i in range(p) if i not in lost)
            if hidden(model, kept, window).shape[1]:
                return q - 1
    return len(others) // 2


def hidden(model: Model, sensors: tuple[int, ...], window: int) -> np.ndarray:
    """What ``window`` samples of these ``sensors`` do not show: orthonormal states (n x r).

    In the units that `scaled` has for all sensors.
    """
    n, m = len(model.A), len(model.C)
    s = scaled(model.A, np.zeros((n, 0)), model.C, np.zeros((m, 0)))
    kept = list(sensors)
    told = silent(s._replace(C=s.C[kept], H=s.H[kept], y=s.y[kept]))
    return complement(told[min(window, len(told) - 1)])


def theorem_1(model: Model, q: int) -> int | None:
    """The smallest window that Theorem 1 allows for q attacked samples per step.

    For all m = 2 .. n and all m of the s_i = |supp(C v_i)|,

        T > ((m - 2) p + min s) / (max s - 2 q),

    where A has distinct eigenvalues over 0, C full rank, (A, C) is observable, and all s_i
    are over 2 q; None where that is not so.

    Source: DECODER, Theorem 1.
    """
    p, n = model.C.shape
    found = _positive(model)
    if found is None or kernel(_one_each(model.C if p >= n else model.C.T)).shape[1]:
        return None
    s = sorted(mode.number for mode in found)
    if s[0] <= 2 * q:
        return None
    # of m of them with the same largest, those next to it have the largest min
    bounds = [
        Fraction((m - 2) * p + s[k - m + 1], s[k] - 2 * q)
        for m in range(2, n + 1)
        for k in range(m - 1, n)
    ]
    return 1 + math.floor(max(bounds, default=Fraction(0)))


def sharper(model: Model, q: int) -> int | None:
    """The smallest window for which cancellations alone cannot outweigh q samples per step.

    Of z with parts along the eigenvectors I, a sensor that sees m_i >= 1 of them has an
    exponential sum of m_i terms, zero at no more than m_i - 1 steps. So T is enough if for
    all I

        sum over i with m_i >= 1 of max(0, T - m_i + 1)  >  2 q T.

    Assumes distinct eigenvalues over 0 and observability; None where that is not so, where
    some eigenvector is seen by 2 q sensors or fewer, or where it is too dear.

    Source: Descartes' rule of signs, as in DECODER, Proposition 5, each sensor on its own.
    """
    cancelled = cancellations(model)
    if cancelled is None:
        return None
    seen = np.sum(cancelled >= 0, 1)
    if np.min(seen) <= 2 * q:
        return None
    enough = np.max(np.sum(np.maximum(cancelled, 0), 1) / (seen - 2 * q))
    for T in range(1, math.floor(enough) + 2):
        if fewest_samples(cancelled, T) > 2 * q * T:
            return T
    return None


def cancellations(model: Model) -> np.ndarray | None:
    """For each set I of eigenvectors, of each sensor: m_i - 1 (sets x p), -1 where m_i = 0.

    Sets with equal numbers of eigenvectors of each kind (seen by the same sensors) are one.
    """
    found = _positive(model)
    if found is None:
        return None
    kinds, count = np.unique([mode.sensors for mode in found], axis=0, return_counts=True)
    if math.prod(int(c) + 1 for c in count) > SUBSETS:
        return None
    chosen = np.array(list(itertools.product(*(range(c + 1) for c in count))))[1:]
    return chosen @ kinds.astype(int) - 1


def fewest_samples(cancelled: np.ndarray, T: int) -> int:
    """The least number of samples of T steps that see a z, as `cancellations` allow."""
    left = np.where(cancelled >= 0, np.maximum(T - cancelled, 0), 0)
    return int(np.min(np.sum(left, 1)))


def _positive(model: Model) -> tuple[Seen, ...] | None:
    """The modes, if all are distinct, over 0 and seen."""
    found = supports(model)
    if found is None:
        return None
    fits = all(
        mode.multiplicity == 1
        and mode.number
        and mode.eigenvalue.imag == 0.0
        and mode.eigenvalue.real > TOLERANCE
        for mode in found
    )
    return found if fits else None


def _one_each(C: np.ndarray) -> np.ndarray:
    """C (p x n) with columns of length 1."""
    length = np.linalg.norm(C, axis=0)
    return C / np.where(length > 0.0, length, 1.0)
