"""A feedback that lets a decoder correct attacks, and what it costs in control.

An observer who does not know u sees x_k = (A - B K) x_{k-1}, y_k = C x_k + e_k (`closed_loop`
says what, where D is not zero). A decoder that looks for the fewest attacked samples over a
window corrects any q sensors attacked at every step, which may be others at each, exactly if
(window long enough, poles positive)

    |supp(C v)| > 2 q   for every eigenvector v of A - B K.

The paper prints "> q" in two places; that is false. Nor does the criterion speak of the decoder
that minimises an l1 norm, which may fail where it holds, or of an observer who knows u: that one
decodes with A, whatever K is.
"""

import math
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.random import Generator, default_rng
from scipy.linalg import null_space, solve_discrete_lyapunov

from holdfast.controllers import feedback
from holdfast.controllers.pole_placement import distance, placed, unreached
from holdfast.numerics.subspaces import kernel, scaled
from holdfast.parts import InvalidValue, Plant

LEAST = 1e-6
"""An entry of C v this much smaller than its largest is zero: placing poles leaves errors of
up to 1e-8. Sensors are compared in units of their noise's deviation."""
SAME = 1e-6
"""Poles nearer than this (relative to those above 1) are one pole with several eigenvectors."""
REAL = 1e-9
"""Imaginary part of a pole that is rounding."""
SMALLEST = 0.02
"""Poles of the first controller nearer to the origin than this start from here."""
SIZES = (0.01, 0.03, 0.1, 0.2, 0.3)


class Candidate(NamedTuple):
    """One feedback: how far from the best control, what it costs, what it lets be corrected.

    ``size`` of the perturbation, ``poles`` (n,) from the largest modulus down, ``gain`` K
    (nu x n), ``moved``: the largest distance of a pole from the one it had; ``cost``: expected
    control cost over the least possible. ``supports``: |supp(C v)| for each pole, ``weakest``:
    the smallest entry that counts in any C v, relative to that vector's largest (a sensor that
    hardly sees a mode counts in full, and helps little). ``corrected``: q, no more than which
    can be corrected; -1 where the state is not observable even without attack. ``attained``:
    whether every pole is real and positive, so that a long enough window does correct q.
    """

    size: float
    poles: np.ndarray
    gain: np.ndarray
    moved: float
    cost: float
    supports: tuple[int, ...]
    weakest: float
    corrected: int
    attained: bool


def candidates(
    plant: Plant,
    *,
    state_weight: list[list[float]],
    input_weight: list[list[float]],
    sizes: Sequence[float] = SIZES,
    noise: np.ndarray | None = None,
    draws: int = 20,
    seed: int = 0,
    least: float = LEAST,
) -> tuple[Candidate, ...]:
    """The optimal feedback (size 0), and for each of ``sizes`` the best found that far from it.

    Size s in (0, 1) makes the poles real, positive and distinct, nearer to the origin and
    further apart: with m_1 >= .. >= m_n the moduli under optimal control, pole i is
    m_i (1 - s i / n). The poles alone do not decide what C v is where there are several inputs:
    the eigenvectors are first those of `scipy.signal.place_poles`, then, ``draws`` times, those
    turned at random by about s within what the poles allow. Of these gains the one is kept
    with the largest smallest support, and of equals the one with the least cost.

    ``least`` is what counts as an entry that is not zero (see `LEAST`); a larger one, such as
    1e-2, asks that every sensor sees every mode well enough to be of use.

    The cost is the mean over time of x'Xx + u'Uu under process noise of covariance ``noise``
    W (n x n; default the plant's Q; `numpy.eye(n)` for unit noise), exactly:
    trace(S W) with S = (A - BK)' S (A - BK) + X + K'UK.

    Raises `InvalidValue` for weights that `feedback.build` refuses, a pair (A, B) that is not
    controllable, sizes not in (0, 1), ``noise`` of wrong shape or zero, and poles that
    `placed` cannot place.

    Source: DECODER, Sections IV-A and V-B; errata 1, 3, 7.
    """
    plant, A, B = feedback.steered(plant)
    stuck = unreached(A, B)
    if stuck:
        found = f"no input that reaches the mode {stuck[0]:.4g}"
        raise InvalidValue("plant.B", found, "a controllable pair")
    if not all(0.0 < size < 1.0 for size in sizes):
        raise InvalidValue("sizes", list(sizes), "numbers between 0 and 1")
    W = np.asarray(plant.Q if noise is None else noise, float)
    if W.shape != A.shape or not np.trace(W) > 0:
        raise InvalidValue("noise", f"shape {W.shape}", "a covariance of the state, not zero")
    best = feedback.build(plant, state_weight=state_weight, input_weight=input_weight)
    units = np.sqrt(np.diag(np.asarray(plant.R)))[:, None]
    C, D = np.asarray(plant.C) / units, np.asarray(plant.D) / units
    weights = np.asarray(state_weight, float), np.asarray(input_weight, float)
    loop = _Loop(A, B, C, D, *weights, W, np.asarray(best.gain), least)
    first = loop.judged(0.0, loop.gain)
    rng, found = default_rng(seed), [first]
    for size in sizes:
        gains = _gains(loop, first.poles, size, draws, rng)
        tried = [loop.judged(size, K) for K in gains]
        found.append(max(tried, key=lambda one: (min(one.supports), -one.cost)))
    return tuple(found)


def support(A: np.ndarray, C: np.ndarray, least: float = LEAST) -> tuple[tuple[int, ...], float]:
    """|supp(C v)| for the eigenvectors v of A (n x n), from the pole of largest modulus down.

    A pole with several eigenvectors counts by the worst of their combinations, as often as it
    occurs. An entry below ``least`` times the largest of its C v is zero; also returned is the
    smallest that is not, relative to it (1 where no sensor sees anything).
    """
    n = len(A)
    s = scaled(A, np.zeros((n, 0)), C, np.zeros((len(C), 0)))
    seen: list[tuple[int, float]] = []
    for count, basis in _eigenspaces(s.A):
        seen += [_least_seen((C * s.x) @ basis, least)] * count
    return tuple(count for count, _ in seen), min(weakest for _, weakest in seen)


class _Loop(NamedTuple):
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    X: np.ndarray
    U: np.ndarray
    W: np.ndarray
    gain: np.ndarray
    """What costs least."""
    least: float

    def judged(self, size: float, K: np.ndarray) -> Candidate:
        closed = self.A - self.B @ K
        poles = _ordered(np.linalg.eigvals(closed))
        # where an output has the input in it, y_k = (C (A - B K) - D K) x_{k-1}
        C = self.C @ closed - self.D @ K if np.any(self.D) else self.C
        supports, weakest = support(closed, C, self.least)
        before = np.linalg.eigvals(self.A - self.B @ self.gain)
        return Candidate(
            size=size,
            poles=poles,
            gain=K,
            moved=distance(poles, before),
            cost=self.expense(K) / self.expense(self.gain),
            supports=supports,
            weakest=weakest,
            corrected=math.ceil(min(supports) / 2) - 1,
            attained=bool(np.all(np.abs(np.imag(poles)) <= REAL) and np.all(np.real(poles) > 0)),
        )

    def expense(self, K: np.ndarray) -> float:
        """trace(S W), infinite where K does not stabilise."""
        closed = self.A - self.B @ K
        if np.max(np.abs(np.linalg.eigvals(closed))) >= 1.0:
            return math.inf
        S = solve_discrete_lyapunov(closed.T, self.X + K.T @ self.U @ K)
        return float(np.trace(S @ self.W))


def _gains(
    loop: _Loop, poles: np.ndarray, size: float, draws: int, rng: Generator
) -> list[np.ndarray]:
    """Gains with the poles of this size: the solver's, and others with turned eigenvectors."""
    n = len(poles)
    moduli = np.maximum(np.abs(poles), SMALLEST)
    wanted = moduli * (1.0 - size * np.arange(1, n + 1) / n)
    K = placed(loop.A, loop.B, wanted)
    values, vectors = np.linalg.eig(loop.A - loop.B @ K)
    V = np.real(vectors[:, np.argsort(-np.real(values))])
    # (v, -K v) of a pole spans, over all gains, the kernel of [A - pole I, B]
    pairs = [null_space(np.hstack([loop.A - pole * np.eye(n), loop.B])) for pole in wanted]
    start = [basis.T @ np.concatenate([v, -K @ v]) for basis, v in zip(pairs, V.T, strict=True)]
    found = [K]
    for _ in range(draws):
        columns = []
        for basis, at in zip(pairs, start, strict=True):
            turn = rng.standard_normal(len(at)) * np.linalg.norm(at) / math.sqrt(len(at))
            column = basis @ (at + size * turn)
            columns.append(column / np.linalg.norm(column[:n]))
        both = np.stack(columns, axis=1)
        K = -np.linalg.solve(both[:n].T, both[n:].T).T
        if distance(np.linalg.eigvals(loop.A - loop.B @ K), wanted) <= SAME:
            found.append(K)
    return found


def _ordered(values: np.ndarray) -> np.ndarray:
    """From the largest modulus down; of equals, the one with the larger real part first."""
    keys = -np.round([np.abs(values), np.real(values), np.imag(values)], 9)
    return values[np.lexsort(keys[::-1])].astype(complex)


def _eigenspaces(A: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """How often each pole occurs, and its eigenvectors (columns, n x r), in `_ordered` order."""
    values, vectors = np.linalg.eig(A)
    size = max(1.0, float(np.linalg.norm(A)))
    left, found = list(_ordered(values)), []
    while left:
        group = [z for z in left if abs(z - left[0]) <= SAME * max(1.0, abs(z))]
        left = [z for z in left if z not in group]
        mean = np.mean(group)
        basis = kernel(A - mean * np.eye(len(A)), size) if len(group) > 1 else np.zeros((0, 0))
        if not basis.size:
            basis = vectors[:, [int(np.argmin(np.abs(values - mean)))]]
        found.append((len(group), basis))
    return found


def _least_seen(M: np.ndarray, least: float) -> tuple[int, float]:
    """The fewest nonzero entries of M c over c other than 0, and the smallest of those entries.

    The fewest are where M c is orthogonal to as many independent rows as it can be.
    """
    rank = int(np.sum(np.linalg.svd(M, compute_uv=False) > least * np.linalg.norm(M)))
    if rank < M.shape[1] or not np.any(M):
        return 0, 1.0
    tried = [np.ones((1, 1))] if M.shape[1] == 1 else []
    for rows in combinations(range(len(M)), M.shape[1] - 1):
        if M.shape[1] > 1:
            free = null_space(M[list(rows)], rcond=least)
            tried += [free] if free.shape[1] == 1 else []
    sizes = [np.abs(M @ c)[:, 0] for c in tried]
    each = [size[size > least * np.max(size)] / np.max(size) for size in sizes]
    fewest = min(len(entries) for entries in each)
    return fewest, min(float(np.min(e)) for e in each if len(e) == fewest)
