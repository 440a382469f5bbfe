"""Random systems in large numbers, as observability matrices for a decoder: Figs. 1 and 2.

Over T = n samples Y = Phi x_0 + E with Phi = [C; C A; ...; C A^(T-1)]. Three sorts: a Gaussian
Phi that belongs to no plant, a plant whose feedback places its poles, and a plant whose feedback
is optimal for control alone. All trials are drawn and solved at once.

Source: DECODER, Section IV-B.
"""

from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from holdfast.parts import InvalidValue

INPUTS = 4
"""Columns of B in the paper's example of 8 states (errata 6)."""
GAINS = (0.5, 1.5)
"""Range of |C_ij|: sensors of about one scale. With normal entries some sensor hardly reads
its state, and every rate of success is some .15 lower."""
SETTLED, MOST = 1e-12, 60
"""Relative change that ends the doubling, and the most doublings."""


class Systems(NamedTuple):
    """One plant a trial, in closed loop: ``A`` = ``A0`` + ``B`` ``G``.

    ``Phi`` (trials x p n x n), ``A`` and ``A0`` (trials x n x n), ``C`` (trials x p x n),
    ``B`` (trials x n x nu), ``G`` (trials x nu x n).
    """

    Phi: np.ndarray
    A: np.ndarray
    C: np.ndarray
    A0: np.ndarray
    B: np.ndarray
    G: np.ndarray


def ideal(rng: Generator, trials: int, rows: int, n: int) -> np.ndarray:
    """Coding matrices (trials x rows x n) of independent standard normal entries."""
    _check(trials, rows, n)
    return rng.standard_normal((trials, rows, n))


def designed(
    rng: Generator,
    trials: int,
    n: int,
    p: int,
    poles: tuple[float, float] = (0.5, 0.95),
    inputs: int = INPUTS,
) -> Systems:
    """Random plants whose feedback places n poles, evenly spread over ``poles``.

    A0 and B have standard normal entries, C is that of `sensors`. The eigenvectors

        v_i = (l_i I - A0)^-1 B g_i,   G = [g_1 .. g_n] [v_1 .. v_n]^-1,

    start from standard normal g_i; each is then once turned, within what its pole l_i allows,
    as far from the span of the others as it can be. Such plants decode like those of
    `scipy.signal.place_poles` (n = 8, p = 10, 32 attacked samples, poles .5 to .95: .87 of the
    trials, both); the g_i as drawn do a little better (.89) with gains 300 times as large.

    Raises `InvalidValue` where the poles are not 0 < first < last < 1, or a count is below 1.
    """
    first, last = poles
    if not 0 < first < last < 1:
        raise InvalidValue("poles", poles, "0 < first < last < 1")
    A0, B, C = _open_loop(rng, trials, n, p, inputs)
    values = np.linspace(first, last, n)
    V = _eigenvectors(rng, A0, B, values)
    basis, triangle = np.linalg.qr(B)
    moved = V * values - A0 @ V
    g = np.linalg.solve(triangle, np.swapaxes(basis, 1, 2) @ moved)
    G = np.swapaxes(np.linalg.solve(np.swapaxes(V, 1, 2), np.swapaxes(g, 1, 2)), 1, 2)
    A = A0 + B @ G
    return Systems(stacked(A, C, n), A, C, A0, B, G)


def poor(rng: Generator, trials: int, n: int, p: int, inputs: int = INPUTS) -> Systems:
    """The same random plants under the feedback that minimises sum |x|^2 + |u|^2, and no more.

    G = -(I + B' S B)^-1 B' S A0, S the stabilising solution of the discrete Riccati equation.
    Raises `InvalidValue` where a count is below 1.
    """
    A0, B, C = _open_loop(rng, trials, n, p, inputs)
    S = _riccati(A0, B)
    right = np.swapaxes(B, 1, 2) @ S
    G = -np.linalg.solve(np.eye(inputs) + right @ B, right @ A0)
    A = A0 + B @ G
    return Systems(stacked(A, C, n), A, C, A0, B, G)


def sensors(rng: Generator, trials: int, n: int, p: int) -> np.ndarray:
    """C (trials x p x n): one nonzero entry in each row, and of full rank.

    The rows, in random order, measure each state once and then states at random (p >= n), or
    p different states (p < n). The entries have random signs and sizes uniform in `GAINS`.
    """
    _check(trials, n, p)
    order = rng.permuted(np.tile(np.arange(n), (trials, 1)), axis=1)[:, :p]
    more = rng.integers(0, n, (trials, max(0, p - n)))
    measured = rng.permuted(np.concatenate([order, more], axis=1), axis=1)
    values = rng.uniform(*GAINS, (trials, p)) * rng.choice([-1.0, 1.0], (trials, p))
    C = np.zeros((trials, p, n))
    np.put_along_axis(C, measured[..., None], values[..., None], axis=2)
    return C


def stacked(A: np.ndarray, C: np.ndarray, steps: int) -> np.ndarray:
    """[C; C A; ...; C A^(steps-1)]: (trials x p steps x n)."""
    rows = [C]
    for _ in range(steps - 1):
        rows.append(rows[-1] @ A)
    return np.concatenate(rows, axis=1)


def _open_loop(
    rng: Generator, trials: int, n: int, p: int, inputs: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    _check(trials, n, p, inputs)
    A0 = rng.standard_normal((trials, n, n))
    B = rng.standard_normal((trials, n, inputs))
    return A0, B, sensors(rng, trials, n, p)


def _eigenvectors(rng: Generator, A: np.ndarray, B: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Eigenvectors (trials x n x n, columns of length 1) that a feedback can give ``values``.

    Source: Kautsky, Nichols and Van Dooren (1985), Int. J. Control 41: one sweep of method 0.
    """
    trials, n, inputs = B.shape
    # v_i lies in the span of (l_i I - A)^-1 B
    allowed = values[:, None, None] * np.eye(n) - A[:, None]
    bases, _ = np.linalg.qr(np.linalg.solve(allowed, B[:, None]))
    columns = bases @ rng.standard_normal((trials, n, inputs, 1))
    V = np.swapaxes(columns[..., 0], 1, 2)
    V /= np.linalg.norm(V, axis=1, keepdims=True)
    for i in range(n):
        unit = np.broadcast_to(np.eye(n)[:, i : i + 1], (trials, n, 1))
        across = np.linalg.solve(np.swapaxes(V, 1, 2), unit)
        turned = bases[:, i] @ (np.swapaxes(bases[:, i], 1, 2) @ across)
        V[:, :, i] = (turned / np.linalg.norm(turned, axis=1, keepdims=True))[..., 0]
    return V


def _riccati(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """S = I + A' S (I + B B' S)^-1 A, every trial at once, by structure-preserving doubling.

    Doubling number k is 2^k steps of the Riccati recursion.
    Source: Chu, Fan and Lin (2005), Linear Algebra and its Applications 396.
    """
    one = np.eye(A.shape[1])
    G, H = B @ np.swapaxes(B, 1, 2), np.broadcast_to(one, A.shape)
    for _ in range(MOST):
        solved = np.linalg.solve(one + G @ H, np.concatenate([A, G], axis=2))
        by_A, by_G = np.split(solved, 2, axis=2)
        across = np.swapaxes(A, 1, 2)
        added = across @ H @ by_A
        G, H, A = G + A @ by_G @ across, H + added, A @ by_A
        G, H = (G + np.swapaxes(G, 1, 2)) / 2, (H + np.swapaxes(H, 1, 2)) / 2
        if np.all(np.linalg.norm(added, axis=(1, 2)) <= SETTLED * np.linalg.norm(H, axis=(1, 2))):
            break
    return H


def _check(*counts: int) -> None:
    if min(counts) < 1:
        raise InvalidValue("counts", counts, "whole numbers from 1 up")
