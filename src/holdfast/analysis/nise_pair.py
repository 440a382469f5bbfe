"""NISE's pair (C_3, Abar): what is left of a plant once its attacks have been estimated."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from holdfast.analysis.model import Model
from holdfast.numerics.gramian import uniformly_observable
from holdfast.numerics.subspaces import NOISE, TOLERANCE


class Pair(NamedTuple):
    """x~_{k+1} = A_k x~_k, seen as C_k x~_k: arrays of a constant plant, else a list of each.

    The rows of C have unit noise, the states the plant's units. ``hidden``: some input reaches
    no output within a step, and the filter is biased by it.
    """

    A: np.ndarray | list[np.ndarray]
    C: np.ndarray | list[np.ndarray]
    hidden: bool


class _Sample(NamedTuple):
    """The whitened y_k split by H: z_1 = M_1^-1 d_1 + C_1 x, and the rest; G of (8) by V."""

    C1: np.ndarray
    M1: np.ndarray
    V1: np.ndarray
    V2: np.ndarray
    rest: np.ndarray


def nise_pair(models: list[Model], channels: tuple[int, ...]) -> Pair:
    """(C_3k, Abar_k) with only these channels attacked, of one model or of one a step.

    Abar_{k-1} = (I - G_2 M_2k C_2k) (A_{k-1} - G_1 M_1 C_{1,k-1}), where A, G are of
    discrete time (the paper's I + eps A and eps G), G_1 = G V_1, G_2 = G V_2 Vbar_1 and
    M_2 C_2 G_2 = I. Of a window of T steps, C_3 of the last T - 1 samples and the T - 2 steps
    between: the first C_3 needs the sample before.

    Outputs are whitened first. That makes the transformations (6) and (7) orthogonal, and
    moves neither the rows of C_3 nor Abar but by what the rows z_2 and z_3 annul.

    Source: NISME (6) to (8) and (11), with M_1, C_{1,k-1} at k - 1, and
    C_2 G V_2 = Sigmabar Vbar_1'.
    """
    kept = list(channels)
    constant = len(models) == 1
    white = []
    for m in models:
        L = cholesky(m.R, lower=True)
        C, H = (solve_triangular(L, x, lower=True) for x in (m.C, m.H[:, kept]))
        white.append(m._replace(G=m.G[:, kept], C=C, H=H))
    # one unit for a channel at all steps
    size = np.sqrt(np.mean([np.sum(m.H**2, 0) + np.sum((m.C @ m.G) ** 2, 0) for m in white], 0))
    size = np.where(size > 0, size, 1.0)
    white = [m._replace(G=m.G / size, H=m.H / size) for m in white]
    samples = [_split(m) for m in white]
    steps = [(0, 0)] if constant else [(k - 1, k) for k in range(1, len(models))]
    found = [_stepped(white[k], samples[i], samples[k]) for i, k in steps]
    hidden = any(unseen for _, _, unseen in found)
    if constant:
        return Pair(found[0][0], found[0][1], hidden)
    return Pair([A for A, _, _ in found[1:]], [C for _, C, _ in found], hidden)


def _split(m: Model) -> _Sample:
    U, values, Vt = np.linalg.svd(m.H, full_matrices=True)
    r = int(np.sum(values > TOLERANCE))
    return _Sample(U[:, :r].T @ m.C, np.diag(1.0 / values[:r]), Vt[:r].T, Vt[r:].T, U[:, r:].T)


def _stepped(m: Model, before: _Sample, now: _Sample) -> tuple[np.ndarray, np.ndarray, bool]:
    """Abar of the step to this sample, C_3 of it, and whether an input is hidden."""
    G = m.G @ before.V2
    rest = now.rest @ m.C
    U, values, Vt = np.linalg.svd(rest @ G, full_matrices=True)
    r = int(np.sum(values > TOLERANCE))
    # an entry of C_2 or C_3 is a unit row times a column of C: its length is what rounding is of
    length = np.linalg.norm(m.C, axis=0)
    G2, C2, C3 = G @ Vt[:r].T, _exact(U[:, :r].T @ rest, length), _exact(U[:, r:].T @ rest, length)
    unseen = G @ Vt[r:].T
    G1 = m.G @ before.V1 @ before.M1
    moved = m.A - G1 @ before.C1
    size = np.abs(m.A) + np.abs(G1) @ np.abs(before.C1)
    left = moved - G2 @ (C2 @ moved / values[:r, None])
    size = size + np.abs(G2) @ (length @ size / values[:r, None])
    return _exact(left, size), C3, bool(np.linalg.norm(unseen) > TOLERANCE * np.linalg.norm(m.G))


def _exact(values: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Zeros in place of what is rounding, next to the size that it would have had uncancelled."""
    return np.where(np.abs(values) > NOISE * size, values, 0.0)


def paper_admissible(models: list[Model], channels: tuple[int, ...]) -> bool:
    """Whether the paper keeps a mode: no hidden input, and (C_3, Abar) uniformly observable.

    Source: NISME, Section 6.1, the set M^ob.
    """
    pair = nise_pair(models, channels)
    return not pair.hidden and uniformly_observable(pair.A, pair.C).observable
