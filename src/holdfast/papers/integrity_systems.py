"""Plants, attacks and policies on which INTEGRITY's statements are judged, in plain NumPy.

Nothing here calls the product's own reachability: (10), (11), (44) and (49) are written out, and
the recursion that equals (59) is in its covariance form.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator, default_rng

from holdfast.numerics.noncentral import alphas
from holdfast.numerics.steady_state import steady_state

EPSILON = 1e-3
"""The paper's epsilon, in both case studies."""
ROUNDING = 1e-9
"""Relative size under which a difference is rounding."""


class System(NamedTuple):
    """A plant and its filter: S is the paper's Q, P_pred its Sigma of (3), P = Cov(e).

    ``values``: the eigenvalues of A where they are known exactly.
    """

    A: np.ndarray
    C: np.ndarray
    K: np.ndarray
    S: np.ndarray
    P: np.ndarray
    P_pred: np.ndarray
    W: np.ndarray
    R: np.ndarray
    values: tuple[complex, ...] = ()

    @property
    def unstable(self) -> int:
        """q_un, counted with multiplicity."""
        return sum(bool(abs(z) >= 1.0 - 1e-9) for z in self.values)

    @property
    def observability_index(self) -> int:
        """psi, the observability index."""
        n, powers = len(self.A), [self.C]
        while rank(np.vstack(powers)) < n:
            powers.append(powers[-1] @ self.A)
        return len(powers)

    @property
    def f(self) -> int:
        """(31)."""
        return min(self.observability_index, self.unstable)


def system(A, C, W=1.0, R=1.0, values: Sequence[complex] = ()) -> System | None:
    """With noise of variances ``W`` and ``R``, numbers or matrices; None without a filter."""
    A, C = np.atleast_2d(np.asarray(A, float)), np.atleast_2d(np.asarray(C, float))
    process, sensors = (
        np.eye(k) * x if np.ndim(x) == 0 else np.asarray(x) for k, x in ((len(A), W), (len(C), R))
    )
    found = steady_state(A, C, process, sensors)
    if found.K is None or found.P is None or found.P_pred is None:
        return None
    S = C @ found.P_pred @ C.T + sensors
    known = tuple(values) or tuple(np.linalg.eigvals(A))
    return System(A, C, found.K, S, found.P, found.P_pred, process, sensors, known)


def sure(A, C, W=1.0, R=1.0, values: Sequence[complex] = ()) -> System:
    """The same for a plant that has a filter."""
    found = system(A, C, W, R, values)
    assert found is not None
    return found


def rank(m: np.ndarray) -> int:
    """To 1e-8 of the largest singular value."""
    sizes = np.linalg.svd(m, compute_uv=False)
    return int(np.sum(sizes > 1e-8 * max(sizes[0], 1e-300))) if sizes.size else 0


def null(m: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the kernel, to 1e-8 in entries of order one."""
    _, sizes, right = np.linalg.svd(m)
    count = int(np.sum(sizes > 1e-8 * max(float(np.max(sizes, initial=0.0)), 1.0)))
    return right[count:].conj().T


def rotation(modulus: float, angle: float) -> np.ndarray:
    """Two modes of one modulus."""
    c, s = np.cos(angle), np.sin(angle)
    return modulus * np.array([[c, -s], [s, c]])


QUARTER = sure(np.array([[0.0, -1.0], [1.0, 0.0]]), [[1.0, 0.0]], values=(1j, -1j))
"""A rotation by 90 degrees of which one coordinate is measured."""
TWICE = sure(np.diag([1.1, 1.1]), [[1.0, 1.0], [1.0, 0.0]], values=(1.1, 1.1))
"""One eigenvalue, every vector its eigenvector."""
VEHICLE = sure([[1.0, 0.01], [0.0, 1.0]], np.eye(2), 0.26984, 10.144, (1.0, 1.0))
"""Section VI-A with the noise of erratum 11."""

_BLOCKS = (
    (np.eye(1), (1.0,)),
    (-np.eye(1), (-1.0,)),
    (1.1 * np.eye(1), (1.1,)),
    (0.5 * np.eye(1), (0.5,)),
    (np.eye(2), (1.0, 1.0)),
    (1.1 * np.eye(2), (1.1, 1.1)),
    (np.array([[1.0, 1.0], [0.0, 1.0]]), (1.0, 1.0)),
    (np.array([[1.1, 1.0], [0.0, 1.1]]), (1.1, 1.1)),
    (np.array([[0.0, -1.0], [1.0, 0.0]]), (1j, -1j)),
    (rotation(1.0, np.pi / 3), (np.exp(1j * np.pi / 3), np.exp(-1j * np.pi / 3))),
    (rotation(0.6, 0.4), (0.6 * np.exp(0.4j), 0.6 * np.exp(-0.4j))),
)
"""Simple, repeated and defective eigenvalues in, on and outside the unit circle."""
REAL = tuple(i for i, (_, of) in enumerate(_BLOCKS) if len(of) == 1 and abs(of[0]) >= 1)
STABLE = tuple(i for i, (_, of) in enumerate(_BLOCKS) if abs(of[0]) < 1)


def drawn(count: int, seed: int, kinds: Sequence[Sequence[int]] | None = None) -> list[System]:
    """Observable plants with one or two of the blocks (or one of each of ``kinds``) in general
    coordinates, seen by one to three sensors whose rows are -1, 0 and 1 in the block's own.
    """
    rng, found = default_rng(seed), []
    while len(found) < count:
        which = (
            [int(rng.choice(list(kind))) for kind in kinds]
            if kinds
            else rng.integers(len(_BLOCKS), size=int(rng.integers(1, 3))).tolist()
        )
        one = _drawn(rng, [_BLOCKS[i] for i in which])
        found += [one] if one is not None else []
    return found


def _drawn(rng: Generator, blocks) -> System | None:
    values = tuple(complex(z) for _, of in blocks for z in of)
    n, at = len(values), 0
    J = np.zeros((n, n))
    for block, of in blocks:
        J[at : at + len(of), at : at + len(of)] = block
        at += len(of)
    C = rng.integers(-1, 2, (int(rng.integers(1, 4)), n)).astype(float)
    turned = np.linalg.qr(rng.normal(size=(n, n)))[0] @ (np.eye(n) + 0.3 * rng.normal(size=(n, n)))
    seen = np.vstack([C @ np.linalg.matrix_power(J, k) for k in range(n)])
    if np.linalg.matrix_rank(seen) < n or not np.all(np.any(C != 0, 1)):
        return None
    if np.linalg.cond(turned) > 20.0:
        return None
    back = np.linalg.inv(turned)
    return system(turned @ J @ back, C @ back, values=values)


def moved(of: System, a: np.ndarray, start: np.ndarray | None = None) -> tuple:
    """(10) and (11): the shifts of error and residue (T x n, T x p) by attacks a (T x p)."""
    e = np.zeros(len(of.A)) if start is None else start
    errors, residues = [], []
    for attack in a:
        residues.append(of.C @ of.A @ e + attack)
        e = of.A @ e - of.K @ residues[-1]
        errors.append(e)
    return np.array(errors), np.array(residues)


def maps(of: System, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """M_k P' and N_k P' of (45), k = 1 .. T, filled up with zero columns: T x n x d, T x p x d.

    ``free`` (T x p): what can be altered at each step.
    """
    T, p = free.shape
    n, F = len(of.A), of.A - of.K @ of.C @ of.A
    M, N = np.zeros((T, n, T * p)), np.zeros((T, p, T * p))
    powers = [of.K]
    for _ in range(T - 1):
        powers.append(F @ powers[-1])
    for k in range(T):
        for j in range(k + 1):
            M[k, :, j * p : (j + 1) * p] = powers[k - j]
        N[k, :, k * p : (k + 1) * p] = np.eye(p)
        if k:
            N[k] -= of.C @ of.A @ M[k - 1]
    kept = free.ravel()
    return M[..., kept], N[..., kept]


def theta(of: System, N: np.ndarray) -> np.ndarray:
    """(49)."""
    return np.sum(np.swapaxes(N, 1, 2) @ np.linalg.solve(of.S, N), 0)


class Step(NamedTuple):
    """A step of the recursion: F, a factor B of N, and the whitened rows G that nobody alters."""

    F: np.ndarray
    B: np.ndarray
    G: np.ndarray


def step(of: System, free: np.ndarray) -> Step:
    """For the outputs ``free`` (p,) that can be altered (erratum 10)."""
    E, told, p = np.eye(len(free))[:, free], of.C @ of.A, len(free)
    weight = np.linalg.solve(of.S, E)
    inner = np.linalg.cholesky(E.T @ weight)
    spread = E @ np.linalg.inv(inner).T
    F = of.A - of.K @ (np.eye(p) - spread @ spread.T @ np.linalg.inv(of.S)) @ told
    lower = np.linalg.cholesky(of.S[np.ix_(~free, ~free)])
    return Step(F, of.K @ spread, np.linalg.solve(lower, told[~free]))


def forwards(steps: Sequence[Step]) -> np.ndarray:
    """W_1 .. W_T of unit cost, each residue counted once; by factors, as W spans many orders."""
    n = len(steps[0].F)
    L = none = np.zeros((n, n))
    eye, found = np.eye(n), []
    for F, B, G in steps:
        if len(G):
            R = np.asarray(np.linalg.qr(np.vstack([G @ L, eye]), mode="r"))
            L = np.linalg.solve(R.T, L.T).T
        L = np.asarray(np.linalg.qr(np.vstack([(F @ L).T, B.T, none]), mode="r")).T
        found.append(L @ L.T)
    return np.array(found)


def ellipsoids(of: System, free: np.ndarray, horizon: np.ndarray, h: float) -> np.ndarray:
    """Y_1 .. Y_T of (59), gamma = 0; ``free`` (T' x p), ``horizon`` (T,) the t of each k."""
    kinds, index = np.unique(free, axis=0, return_inverse=True)
    of_kind = [step(of, kind) for kind in kinds]
    steps = [of_kind[i] for i in index.reshape(-1)[: int(horizon[-1])]]
    n, p = len(of.A), free.shape[1]
    W, S, t = forwards(steps), np.zeros((n, n)), 0
    found = np.zeros((len(horizon), n, n))
    bound = {t: a * a for t, a in zip(np.unique(horizon), alpha(np.unique(horizon), p, h),
                                      strict=True)}  # fmt: skip
    for k in range(len(steps), 0, -1):
        if k in bound and (k > len(horizon) or horizon[k - 1] == k):
            S, t = np.zeros((n, n)), k
        if k <= len(horizon):
            Y = bound[t] * np.linalg.solve(np.eye(n) + W[k - 1] @ S, W[k - 1])
            found[k - 1] = (Y + Y.T) / 2
        F, B, G = steps[k - 1]
        S = F.T @ S @ np.linalg.solve(np.eye(n) + B @ B.T @ S, F) + G.T @ G
        S = (S + S.T) / 2
    return found


def alpha(t: np.ndarray, p: int, h: float, epsilon: float = EPSILON) -> np.ndarray:
    """The bound of (47) at every t, the square root of what the sum up to t may come to."""
    t = np.asarray(t, float)
    return alphas(epsilon, t * p, 2.0 * h + t * p)


def norms(Y: np.ndarray) -> np.ndarray:
    """Square roots of the largest eigenvalues: the corrected (61)."""
    return np.sqrt(np.linalg.norm(Y, 2, axis=(1, 2)))


class Policy(NamedTuple):
    """Blocks of f steps, every L steps, the first at t_0 = L (Algorithm 1, line 4)."""

    f: int
    L: int

    def free(self, T: int, p: int) -> np.ndarray:
        """What can be altered at the steps 1 .. T (T x p), all sensors alike."""
        since = np.arange(1, T + 1) - self.L
        held = (since >= 0) & (since % self.L < self.f)
        return np.repeat(~held[:, None], p, 1)

    def ends(self, blocks: int) -> np.ndarray:
        """The last steps of the blocks."""
        return np.arange(1, blocks + 1) * self.L + self.f - 1


def under(of: System, policy: Policy, blocks: int, h: float) -> np.ndarray:
    """The ellipsoids up to the end of so many blocks."""
    ends, p = policy.ends(blocks), len(of.C)
    horizon = ends[np.searchsorted(ends, np.arange(1, ends[-1] + 1))]
    return ellipsoids(of, policy.free(int(ends[-1]), p), horizon, h)
