"""CARE's statements on unbiasedness, the rank of C G and the bias of a projection.

Statements about one step: no recursion is run here (`holdfast.analysis.stability` does).
"""

from typing import NamedTuple

import numpy as np

from holdfast.numerics.subspaces import kernel, legible, scaled

ROUNDING = 1e-9
"""Part of its size without cancellation that an entry may be off and still count as exact."""


class Unbiased(NamedTuple):
    """``error``: the largest entry of M C G - I."""

    holds: bool
    error: float


class RankCondition(NamedTuple):
    """``hidden`` (nd x r): attacks with C G d = 0, the identity on r channels."""

    holds: bool
    rank: int
    hidden: np.ndarray


def unbiased(M: np.ndarray, C: np.ndarray, G: np.ndarray) -> Unbiased:
    """Whether d_hat = M (y - C x_pred) is unbiased whatever d is: M C G = I.

    M (nd x ny), C (ny x n), G (n x nd). Equal up to `ROUNDING` of |M| |C| |G|.

    Source: CARE, Proposition 2.
    """
    off = np.abs(M @ C @ G - np.eye(G.shape[1]))
    size = np.abs(M) @ np.abs(C) @ np.abs(G) + np.eye(G.shape[1])
    return Unbiased(bool(np.all(off <= ROUNDING * size)), float(np.max(off, initial=0.0)))


def rank_condition(C: np.ndarray, G: np.ndarray) -> RankCondition:
    """Whether rank(C G) = nd, without which no M with M C G = I exists; else what is hidden.

    C (ny x n), G (n x nd). Entries of C G that are under `ROUNDING` of |C| |G| are zero; rank
    as in `holdfast.numerics.subspaces`, so units do not matter.

    Source: CARE, Remark 4 (there called sufficient; it is also necessary).
    """
    felt = C @ G
    felt = np.where(np.abs(felt) > ROUNDING * (np.abs(C) @ np.abs(G)), felt, 0.0)
    ny, nd = felt.shape
    s = scaled(np.zeros((0, 0)), np.zeros((0, nd)), np.zeros((ny, 0)), felt)
    hidden = kernel(s.H)
    return RankCondition(hidden.shape[1] == 0, nd - hidden.shape[1], legible(s.d[:, None] * hidden))


def blue_gain(C: np.ndarray, G: np.ndarray, P_pred: np.ndarray, R: np.ndarray) -> np.ndarray:
    """M = (G' C' S^-1 C G)^-1 G' C' S^-1, S = C P_pred C' + R: (nd x ny).

    The best linear unbiased estimate of the attack from the innovation. ``rank_condition``
    must hold; `numpy.linalg.LinAlgError` where it fails outright.

    Source: CARE (15), Proposition 3.
    """
    felt = C @ G
    weighted = np.linalg.solve(C @ P_pred @ C.T + R, felt)
    return np.linalg.solve(felt.T @ weighted, weighted.T)


def projection_gain(cov: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Gamma = P Abar' (Abar P Abar')^-1, (n x m), for independent active rows Abar (m x n).

    Source: CARE (20), (26).
    """
    return np.linalg.solve(rows @ cov @ rows.T, rows @ cov).T


def bias(cov: np.ndarray, rows: np.ndarray, bound: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """E[truth - estimate] = gamma (Abar truth - bbar), (n,): what projecting onto the active
    rows Abar z = bbar costs a truth that does not lie on them.

    ``cov`` (n x n) of the estimate before, ``rows`` (m x n) and ``bound`` (m,) of the active
    set alone, taken as given: an active set that depends on the estimate makes the bias of
    the whole projection an average of this one.

    Source: CARE (28), (29).
    """
    return projection_gain(cov, rows) @ (rows @ truth - bound)
