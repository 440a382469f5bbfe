"""Uniform observability over a window, from square roots of observability Gramians.

M_{k+l,k} = sum_{i=k}^{k+l} Phi_{i,k}' C_i' C_i Phi_{i,k} is never formed: a factor F with M = F'F
comes from a QR decomposition of the stacked rows, carried back one sample at a time,

    M_{k+l,k} = C_k' C_k + A_k' M_{k+l,k+1} A_k,    F_k = R of qr([C_k; F_{k+1} A_k]),

so a singular value of F counts down to its own rounding, where an eigenvalue of M, its square, is
lost at the square root of that.

Source: NISME, Definitions 1.2 and 6.1, with C'C in place of the printed CC' and the transition
matrices the other way round.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import qr

from holdfast.numerics.subspaces import TOLERANCE


class Uniform(NamedTuple):
    """a I <= M_{k+l,k} <= b I over all windows, for the smallest l for which a > 0.

    ``steps`` is l, None where no allowed l does; ``lowest`` a and ``highest`` b are then NaN.
    Their unit is one over that of the state, squared, where the rows of C are in units of
    their noise.
    """

    steps: int | None
    lowest: float
    highest: float

    @property
    def observable(self) -> bool:
        """Whether there is such an l."""
        return self.steps is not None


def uniformly_observable(
    A: np.ndarray | Sequence[np.ndarray], C: np.ndarray | Sequence[np.ndarray]
) -> Uniform:
    """Whether (C_k, A_k) is uniformly observable over the window, and how well.

    x_{k+1} = A_k x_k, seen as C_k x_k; the rows of C in units of their noise (W C with
    W R W' = I). Constant: A (n, n), C (p, n), an endless window. Else one A (n, n) and one
    C (p_k, n) for each of the samples c1, .., c2, or one A less: the last is not used; every
    window of l + 1 samples must determine the state at its first, l < c2 - c1.

    The rank is decided relatively: the columns of F, one a state, are divided by the lengths
    that they would have if nothing cancelled; then the smallest singular value must be over
    1e-8 of the largest. Units of the states do not matter, nor that of the noise.
    """
    constant = isinstance(A, np.ndarray) and A.ndim == 2
    moves = [np.asarray(move, float) for move in ([A] if constant else A)]
    seen = [np.asarray(rows, float) for rows in ([C] if constant else C)]
    last = len(moves[0]) - 1 if constant else len(seen) - 2
    factors = seen
    sizes = [np.linalg.norm(rows, axis=0) for rows in seen]
    for steps in range(last + 1):
        if steps:
            later = slice(None) if constant else slice(1, None)
            found = [
                _earlier(*window)
                for window in zip(seen, factors[later], sizes[later], moves, strict=False)
            ]
            factors, sizes = [F for F, _ in found], [size for _, size in found]
        if all(_full(F, size) for F, size in zip(factors, sizes, strict=True)):
            spectra = [np.linalg.svd(F, compute_uv=False) ** 2 for F in factors]
            lowest, highest = (f(s[i] for s in spectra) for f, i in ((min, -1), (max, 0)))
            return Uniform(steps, float(lowest), float(highest))
    return Uniform(None, np.nan, np.nan)


def _earlier(
    C: np.ndarray, F: np.ndarray, size: np.ndarray, A: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The factor of a window that starts one sample earlier, and the sizes of its columns."""
    grown = np.hypot(np.linalg.norm(C, axis=0), size @ np.abs(A))
    R: np.ndarray = qr(np.vstack([C, F @ A]), mode="r")[-1]
    return R[: A.shape[1]], grown


def _full(F: np.ndarray, size: np.ndarray) -> bool:
    """Whether F has full column rank, relative to the ``size`` of its columns."""
    if len(F) < F.shape[1] or not np.all(size > 0):
        return False
    values = np.linalg.svd(F / size, compute_uv=False)
    return bool(values[-1] > TOLERANCE * values[0])
