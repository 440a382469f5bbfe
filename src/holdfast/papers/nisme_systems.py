"""NISME's Section 4 in plain NumPy: Algorithm 1 line by line, and batch least squares beside it.

The plant is (5) with f and h linear, sampled by Euler so that rho = 0: there the filter must equal
the least squares problem of all states and attacks. `nise` runs the lines as the errata have them,
each of them as it is printed where asked.
"""

from typing import NamedTuple

import numpy as np
from numpy.random import Generator, default_rng

EPSILON = 0.5
"""The sampling period: not 1, so that a factor epsilon left out shows."""
STEPS = 6


class System(NamedTuple):
    """x_{k+1} = x_k + eps (A x_k + B u_k + G d_k + w_k), y_k = C_k x_k + D u_k + H d_k + v_k.

    ``C`` (T + 1, p, n): of every sample. ``x0``, ``P0``: what is known of x_0.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    G: np.ndarray
    H: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    x0: np.ndarray
    P0: np.ndarray

    @property
    def F(self) -> np.ndarray:
        """I + eps A."""
        return np.eye(len(self.A)) + EPSILON * self.A


class Data(NamedTuple):
    """Inputs and outputs of samples 0 .. T; ``x``, ``d``, ``w``, ``v`` what they came from."""

    u: np.ndarray
    y: np.ndarray
    x: np.ndarray
    d: np.ndarray
    w: np.ndarray
    v: np.ndarray


class Split(NamedTuple):
    """(6) to (8) at one sample: z_i = T_i y, i = 1, 2, 3; ``Vbar``, ``Sbar`` of (7)."""

    T: tuple[np.ndarray, np.ndarray, np.ndarray]
    V1: np.ndarray
    V2: np.ndarray
    Vbar: np.ndarray
    H1: np.ndarray
    Sbar: np.ndarray


class Text(NamedTuple):
    """Which lines of Algorithm 1 are run as the errata have them; the others as printed."""

    line_2: bool = True
    line_3_size: bool = True
    line_3: bool = True
    line_4: bool = True
    line_11: bool = True
    eq_11: bool = True


class Found(NamedTuple):
    """Estimates with covariances at the last sample, gains and innovation.

    ``d2s``: d_2 corrected by nu_3; ``predicted``: of x before nu_3.
    """

    x: np.ndarray
    P: np.ndarray
    d1: np.ndarray
    P1: np.ndarray
    d2: np.ndarray
    P2: np.ndarray
    d2s: np.ndarray
    P2s: np.ndarray
    predicted: np.ndarray
    P_pred: np.ndarray
    L: np.ndarray
    Abar: np.ndarray
    Qbar: np.ndarray
    split: Split


def split(s: System, k: int) -> Split:
    """The transformations at sample k >= 1 (of sample 0: only T_1)."""
    U, sizes, Vt = np.linalg.svd(s.H)
    r = int(np.sum(sizes > 1e-9))
    U1, U2, V1, V2 = U[:, :r], U[:, r:], Vt[:r].T, Vt[r:].T
    T1, T2 = _uncorrelated(U1, U2, s.R), U2.T
    W, values, Wt = np.linalg.svd(T2 @ s.C[k] @ s.G @ V2)
    q = int(np.sum(values > 1e-9))
    Tbar1 = _uncorrelated(W[:, :q], W[:, q:], T2 @ s.R @ T2.T)
    parts = T1, Tbar1 @ T2, W[:, q:].T @ T2
    return Split(parts, V1, V2, Wt[:q].T, np.diag(sizes[:r]), np.diag(values[:q]))


def _uncorrelated(first: np.ndarray, rest: np.ndarray, R: np.ndarray) -> np.ndarray:
    return first.T - first.T @ R @ rest @ np.linalg.solve(rest.T @ R @ rest, rest.T)


def nise(s: System, data: Data, text: Text = Text()) -> Found:  # noqa: B008
    """Algorithm 1 from Algorithm 2's start to the last sample."""
    at = split(s, 0)
    M1, C1 = np.linalg.inv(at.H1), at.T[0] @ s.C[0]
    x, P = s.x0, s.P0
    d1 = M1 @ (at.T[0] @ (data.y[0] - s.D @ data.u[0]) - C1 @ x)
    P1 = M1 @ (C1 @ P @ C1.T + at.T[0] @ s.R @ at.T[0].T) @ M1.T
    carried, found = (x, P, d1, P1, -P @ (M1 @ C1).T), None
    for k in range(1, len(data.y)):
        found = _row(s, data, k, carried, text)
        now, C1 = found.split, found.split.T[0] @ s.C[k]
        M1 = np.linalg.inv(now.H1)
        carried = found.x, found.P, found.d1, found.P1, -found.P @ (M1 @ C1).T
    assert found is not None
    return found


def _row(s: System, data: Data, k: int, carried: tuple, text: Text) -> Found:
    x, P, d1, P1, Pxd = carried
    now, eps = split(s, k), EPSILON
    z1, z2, z3 = (T @ data.y[k] for T in now.T)
    C1, C2, C3 = (T @ s.C[k] for T in now.T)
    D1, D2, D3 = (T @ s.D @ data.u[k] for T in now.T)
    R1, R2, R3 = (T @ s.R @ T.T for T in now.T)
    G1, G2 = s.G @ now.V1, s.G @ now.V2 @ now.Vbar
    M1, M2 = np.linalg.inv(now.H1), np.linalg.inv(eps * C2 @ G2)
    eye, f = np.eye(len(x)), s.A @ x + s.B @ data.u[k - 1] + G1 @ d1
    d2 = M2 @ (z2 - C2 @ (x + eps * f) - D2) if text.line_2 else \
        M2 @ (z2 - C2 @ (x + eps * f)) - D2  # fmt: skip
    P2 = _line_3(s, P, P1, Pxd, M2, C2, R2, C2 @ G1, text)
    rate = f + G2 @ d2
    predicted = x + eps * rate if text.line_4 else \
        np.linalg.solve(eye - s.A, rate - s.A @ x)  # fmt: skip
    seen_before = now.T[0] @ s.C[k - 1] if text.eq_11 else C1
    Pi = eye - eps * G2 @ M2 @ C2
    Abar = Pi @ (s.F - eps * G1 @ M1 @ seen_before)
    E = eps**2 * (s.Q + G1 @ M1 @ R1 @ M1.T @ G1.T)
    Qbar = Pi @ E @ Pi.T + eps**2 * G2 @ M2 @ R2 @ M2.T @ G2.T
    P_pred = Abar @ P @ Abar.T + Qbar
    S = C3 @ P_pred @ C3.T + R3
    L = np.linalg.solve(S, C3 @ P_pred).T
    nu = z3 - C3 @ predicted - D3
    after, left = predicted + L @ nu, eye - L @ C3
    P_after = left @ P_pred @ left.T + L @ R3 @ L.T
    before = s.F - eps * G1 @ M1 @ seen_before
    cross = -M2 @ C2 @ (before @ P @ before.T + E) @ Pi.T + eps * M2 @ R2 @ M2.T @ G2.T
    smooth = np.linalg.solve(S, C3 @ cross.T).T
    used = P_after if text.line_11 else P_pred
    return Found(
        after, P_after, M1 @ (z1 - C1 @ after - D1), M1 @ (C1 @ used @ C1.T + R1) @ M1.T,
        d2, P2, d2 + smooth @ nu, P2 - smooth @ S @ smooth.T, predicted, P_pred, L, Abar, Qbar, now,
    )  # fmt: skip


def _line_3(s: System, P, P1, Pxd, M2, C2, R2, C2G1, text: Text) -> np.ndarray:
    """P^d2.

    As printed, by ``line_3``, M_2 is missing on C_2 G_1; by ``line_3_size`` the last covariance
    is that of x.
    """
    by_x, by_d = M2 @ C2 @ s.F, (M2 if text.line_3 else np.eye(len(M2))) @ C2G1
    last = Pxd.T if text.line_3_size else P
    return (
        by_x @ P @ by_x.T
        + EPSILON**2 * M2 @ C2 @ s.Q @ (M2 @ C2).T
        + M2 @ R2 @ M2.T
        + EPSILON**2 * by_d @ P1 @ by_d.T
        + EPSILON * by_x @ Pxd @ by_d.T
        + EPSILON * by_d @ last @ by_x.T
    )


class Batch(NamedTuple):
    """Least squares of all states and attacks, to the last sample, and what is wanted of it."""

    x: np.ndarray
    P: np.ndarray
    d1: np.ndarray
    P1: np.ndarray
    d2: np.ndarray
    P2: np.ndarray


def batch(s: System, data: Data, start: bool = True) -> Batch:
    """Of x_0 ~ (x0, P0), z_1 of sample 0 where ``start``, and all of the samples 1 .. T."""
    T, n, nd = len(data.y) - 1, len(s.A), s.G.shape[1]
    width, rows, wanted = (n + nd) * (T + 1), [], []

    def add(cov, target, *blocks):
        line, W = np.zeros((len(target), width)), np.linalg.inv(np.linalg.cholesky(cov))
        for at, block in blocks:
            line[:, at : at + block.shape[1]] = block
        rows.append(W @ line)
        wanted.append(W @ target)

    def state(k):
        return (n + nd) * k

    def attack(k):
        return state(k) + n

    add(s.P0, s.x0, (0, np.eye(n)))
    if start:
        T1 = split(s, 0).T[0]
        add(T1 @ s.R @ T1.T, T1 @ (data.y[0] - s.D @ data.u[0]), (0, T1 @ s.C[0]),
            (n, T1 @ s.H))  # fmt: skip
    for k in range(1, T + 1):
        add(EPSILON**2 * s.Q, EPSILON * s.B @ data.u[k - 1], (state(k), np.eye(n)),
            (state(k - 1), -s.F), (attack(k - 1), -EPSILON * s.G))  # fmt: skip
        add(s.R, data.y[k] - s.D @ data.u[k], (state(k), s.C[k]), (attack(k), s.H))
    inverse = np.linalg.pinv(np.vstack(rows), rcond=1e-12)
    z, now = inverse @ np.concatenate(wanted), split(s, T)
    take = np.zeros((3, width, width))
    take[0, :n, state(T) : state(T) + n] = np.eye(n)
    take[1, : len(now.H1), attack(T) : attack(T) + nd] = now.V1.T
    take[2, : len(now.Sbar), attack(T - 1) : attack(T - 1) + nd] = (now.V2 @ now.Vbar).T
    found = []
    for one, size in zip(take, (n, len(now.H1), len(now.Sbar)), strict=True):
        root = (one @ inverse)[:size]
        found += [(one @ z)[:size], root @ root.T]
    return Batch(*found)


def simulated(
    s: System, rng: Generator, u: float = 1.0, scale: float = 1.0, attack: float = 3.0
) -> Data:
    """Samples 0 .. T with attacks of that size; all of it times ``scale``, inputs times ``u``."""
    T, (p, n), nd = STEPS, s.C[0].shape, s.G.shape[1]
    inputs = u * rng.normal(size=(T + 1, s.B.shape[1]))
    d = attack * rng.normal(size=(T + 1, nd))
    w = rng.normal(size=(T + 1, n)) @ np.linalg.cholesky(s.Q).T
    v = rng.normal(size=(T + 1, p)) @ np.linalg.cholesky(s.R).T
    x = [s.x0 + np.linalg.cholesky(s.P0) @ rng.normal(size=n)]
    for k in range(T):
        x.append(s.F @ x[-1] + EPSILON * (s.B @ inputs[k] + s.G @ d[k] + w[k]))
    x = np.array(x)
    y = (s.C @ x[..., None])[..., 0] + inputs @ s.D.T + d @ s.H.T + v
    return Data(*(scale * m for m in (inputs, y, x, d, w, v)))


def drawn(
    count: int, seed: int, size: tuple[int, int, int, int] | None = None, moving: bool = True
) -> list[System]:
    """Systems of ``size`` (n, p, nd, rank of H), or of any; C differs at every sample where
    ``moving``. Every attack is seen in its own or the next sample, by a value of 0.2 at least.
    """
    rng, found = default_rng(seed), []
    while len(found) < count:
        n, p, nd, r = size or _size(rng)
        one = _drawn(rng, n, p, nd, r, moving)
        C = one.C if moving else one.C[1:2]
        seen = [split(one._replace(C=C[None]), 0) for C in C]
        weakest = min(np.min(np.diag(m), initial=1.0) for a in seen for m in (a.H1, a.Sbar))
        if all(len(a.Sbar) == nd - r for a in seen) and weakest > 0.2:
            found.append(one)
    return found


def _size(rng: Generator) -> tuple[int, int, int, int]:
    nd = int(rng.integers(2, 4))
    return int(rng.integers(3, 6)), nd + int(rng.integers(1, 3)), nd, int(rng.integers(1, nd))


def _drawn(rng: Generator, n: int, p: int, nd: int, r: int, moving: bool) -> System:
    F = rng.normal(size=(n, n))
    F *= 0.9 / np.max(np.abs(np.linalg.eigvals(F)))
    C = rng.normal(size=(STEPS + 1 if moving else 1, p, n))
    H = rng.normal(size=(p, r)) @ rng.normal(size=(r, nd))
    return System(
        (F - np.eye(n)) / EPSILON, rng.normal(size=(n, 2)), np.broadcast_to(C, (STEPS + 1, p, n)),
        rng.normal(size=(p, 2)), rng.normal(size=(n, nd)), H, spread(rng, n), spread(rng, p),
        rng.normal(size=n), spread(rng, n),
    )  # fmt: skip


def spread(rng: Generator, n: int) -> np.ndarray:
    """A covariance of general orientation."""
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


def gap(a: np.ndarray, b: np.ndarray) -> float:
    """Largest distance, relative to the largest entry of b; 0 where both are empty or zero."""
    size = np.max(np.abs(b), initial=0.0)
    return float(np.max(np.abs(a - b), initial=0.0) / max(size, 1e-300))
