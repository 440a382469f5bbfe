"""Which errors a stealthy attacker can move without limit, some sensors authenticated in turn.

The error follows e_k = A e_{k-1} - K z_k with z_k = C A e_{k-1} + a_k, every z_k bounded and a_k
zero at the sensors that cannot be attacked at step k. What these show of the error is bounded;
what they do not show, U, moves by A alone, driven by what the attacker chooses.

Source: INTEGRITY, (10), (11), Theorems 3, 4 and 6.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import schur

from holdfast.numerics.steady_state import UNSTABLE
from holdfast.numerics.subspaces import complement, kernel, legible, modes, scaled, span

WIDTH = 1e-4
"""Relative distance of two moduli that are treated as one."""


class Band(NamedTuple):
    """Modes of one modulus: M ``basis`` = ``modulus`` ``basis`` ``move``, M (n x n).

    ``basis`` (n x q) is orthonormal, the eigenvalues of ``move`` (q x q) have moduli about 1:
    however often it is applied, it neither hides nor inflates a direction.
    """

    modulus: float
    basis: np.ndarray
    move: np.ndarray


class Movable(NamedTuple):
    """What every question on one plant and gain needs, in units of size one.

    ``bands``: the unstable modes of A; ``loose``: of (A - K C A)', none for a gain that
    stabilises. ``C`` (ny x n); ``K`` (n x ny), each column of length one; ``x``: the units of
    the states.
    """

    bands: tuple[Band, ...]
    loose: tuple[Band, ...]
    C: np.ndarray
    K: np.ndarray
    x: np.ndarray

    @property
    def unstable(self) -> int:
        """How many modes of A have modulus 1 - 1e-7 or more."""
        return sum(len(band.move) for band in self.bands)


class Mode(NamedTuple):
    """An unstable eigenvalue of A that can be moved, and how often; of a pair the one above
    the real axis. ``directions`` (n x r) in the plant's units: its generalised eigenvectors, the
    identity on r states.
    """

    z: complex
    multiplicity: int
    directions: np.ndarray


class Growth(NamedTuple):
    """What can be moved without limit.

    ``radius``: the largest modulus of these modes, per step; 0 if there are none (what fades is
    not looked at). ``subspace`` (n x r): the errors before the first step of a period that can
    be made as large as one likes, in the plant's units, the identity on r states. ``modes``:
    the same by modes of A; only where the sensors do not change from step to step.
    """

    radius: float
    unbounded: bool
    subspace: np.ndarray
    modes: tuple[Mode, ...]


def movable(A: np.ndarray, C: np.ndarray, K: np.ndarray) -> Movable:
    """The unstable modes of A (n x n), for the outputs C (ny x n) and the gain K (n x ny).

    Units as in `holdfast.numerics.subspaces`, so that no answer depends on the caller's.
    """
    s = scaled(A, np.zeros((len(A), 0)), C, np.zeros((len(C), 0)))
    gain = K * s.y / s.x[:, None]
    sizes = np.linalg.norm(gain, axis=0)
    whole = s.A - gain @ s.C @ s.A
    gain = gain / np.where(sizes > 0, sizes, 1.0)
    return Movable(_bands(s.A), _bands(whole.T), s.C, gain, s.x)


def growth(
    A: np.ndarray, C: np.ndarray, K: np.ndarray, attackable: np.ndarray, *, aware: bool = True
) -> Growth:
    """Whether e_k = A e_{k-1} - K z_k can grow without limit while every z_k stays bounded.

    ``attackable`` (L x ny, bool): which sensors can be attacked at step i of a period of L;
    one row where that never changes. ``aware``: the attacker knows the period; if not, he must
    stay stealthy whichever step is authenticated, and keeps C A e bounded as well (Theorem 6).
    """
    return growth_of(movable(A, C, K), attackable, aware=aware)


def growth_of(found: Movable, attackable: np.ndarray, *, aware: bool = True) -> Growth:
    """The same for a plant that has been looked at before.

    U_i = {e : C_j A e = 0 for j not attackable at step i, and A e in U_{i+1}}, R the states
    reached by K a: A maps U_i and R_i into U_{i+1} and R_{i+1}, and the error can grow
    if and only if A^L has an unstable eigenvalue on U_0 and R_0. Modulo U the error is a
    function of bounded quantities; on U and R any sequence of bounded pushes is possible.

    A mode in U that cannot be reached is a mode of A - K C A: for a gain that stabilises, R does
    not matter, nor does K. An invariant subspace of A^L is a sum over moduli, so each band is
    looked at alone, step by step: A^L decides no rank.

    Source: INTEGRITY, Theorem 3, with whole eigenspaces and generalised eigenvectors.
    """
    period, n = len(attackable), len(found.x)
    told = ~attackable[::-1] if aware else np.ones((1, len(found.C)), bool)
    never = _unreached(found, attackable)
    radius, bases, of = 0.0, [np.zeros((n, 0))], []
    for band in found.bands:
        outputs = found.C @ band.basis
        hidden = _hidden(band.move, [outputs[rows] for rows in told])
        hidden = hidden @ kernel(never.T @ band.basis @ hidden)
        if not hidden.shape[1]:
            continue
        move = hidden.T @ np.linalg.matrix_power(band.move, period) @ hidden
        size, kept = _unstable(move, band.modulus, period)
        if kept.shape[1]:
            radius = max(radius, size)
            bases.append(band.basis @ hidden @ kept)
            if period == 1:
                within = band.modulus * kept.T @ move @ kept
                of += [(z, m, bases[-1] @ own) for z, m, own in _by_mode(within)]
    units = found.x[:, None]
    return Growth(
        radius,
        len(bases) > 1,
        legible(units * np.hstack(bases)),
        tuple(Mode(z, count, legible(units * own)) for z, count, own in of),
    )


def _bands(m: np.ndarray) -> tuple[Band, ...]:
    """The modes of ``m`` by modulus, largest first, as far as some are unstable."""
    raw = np.sort(np.abs(np.linalg.eigvals(m)))[::-1]
    # rounding scatters a repeated eigenvalue in ``raw``, and not in ``sizes``
    sizes = np.array([abs(z) for z, count in modes(m) for _ in range(count)])
    gaps = np.minimum(sizes[:-1] - sizes[1:], 10 * (raw[:-1] - raw[1:]))
    cuts = np.flatnonzero(gaps > WIDTH * sizes[:-1]) + 1
    bands = []
    for start, end in pairwise([0, *cuts.tolist(), len(m)]):
        if sizes[start] < UNSTABLE:
            break
        basis = _invariant(m, raw, start, end)
        modulus = float(np.exp(np.mean(np.log(sizes[start:end]))))
        bands.append(Band(modulus, basis, basis.T @ m @ basis / modulus))
    return tuple(bands)


def _invariant(m: np.ndarray, raw: np.ndarray, start: int, end: int) -> np.ndarray:
    """An orthonormal basis of the modes whose modulus is of rank ``start`` to ``end`` - 1."""
    above = np.sqrt(raw[start - 1] * raw[start]) if start else np.inf
    below = np.sqrt(raw[end - 1] * raw[end]) if end < len(raw) else -1.0
    if above == np.inf and below < 0:
        return np.eye(len(m))
    _, basis, *count = schur(m, output="real", sort=lambda re, im: below < np.hypot(re, im) < above)
    return basis[:, : int(count[0])]


def _hidden(move: np.ndarray, rows: list[np.ndarray]) -> np.ndarray:
    """What no row of a period ever shows (q x r), ``rows`` from its last step to its first.

    What is shown before a step is what is shown after it and by its own rows, one step earlier.
    """
    q = len(move)
    told = np.zeros((q, 0))
    while True:
        before = told.shape[1]
        for new in rows:
            if len(new):
                told = np.hstack([told, span(new.T - told @ (told.T @ new.T))])
            if told.shape[1] == q:
                return np.zeros((q, 0))
            if told.shape[1]:
                told = np.linalg.qr(move.T @ told)[0]
        if told.shape[1] == before:
            return complement(told)


def _unreached(found: Movable, attackable: np.ndarray) -> np.ndarray:
    """The unstable part of what is orthogonal to R (n x r): R_{i+1} = K E_i and F R_i."""
    bases = [np.zeros((len(found.x), 0))]
    for band in found.loose:
        inputs = found.K.T @ band.basis
        hidden = _hidden(band.move, [inputs[rows] for rows in attackable])
        bases.append(band.basis @ band.move @ hidden)
    return span(np.hstack(bases))


def _unstable(move: np.ndarray, modulus: float, period: int) -> tuple[float, np.ndarray]:
    """The largest modulus per step of (modulus^L move), and its unstable part (r x s)."""
    found = modes(move)
    sizes = [modulus * abs(z) ** (1 / period) for z, count in found for _ in range(count)]
    count = sum(size >= UNSTABLE for size in sizes)
    if count in (0, len(sizes)):
        return sizes[0], np.eye(len(move))[:, :count]
    raw = np.sort(np.abs(np.linalg.eigvals(move)))[::-1]
    return sizes[0], _invariant(move, raw, 0, count)


def _by_mode(m: np.ndarray) -> list[tuple[complex, int, np.ndarray]]:
    """Every mode of ``m``, of a pair one, how often, and its generalised eigenvectors, real."""
    found, eye = [], np.eye(len(m))
    for z, count in modes(m):
        if z.imag < 0:
            continue
        if z.imag == 0:
            zero, r = m - z.real * eye, count
        else:
            zero, r = m @ m - 2 * z.real * m + abs(z) ** 2 * eye, 2 * count
        right = np.linalg.svd(np.linalg.matrix_power(zero, count))[2]
        found.append((z, count, right[len(m) - r :].T))
    return found
