"""CARE in plain NumPy, written from the paper's Algorithm 1 and its errata alone.

Line 9 with + Q, line 11 with a pseudo-inverse, projections by trying every active set. None of
the package's algebra is used.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np


class Filtered(NamedTuple):
    """One run, time first: state and attack after and before projection."""

    x: np.ndarray
    x_cov: np.ndarray
    d: np.ndarray
    d_cov: np.ndarray
    d_free: np.ndarray
    d_free_cov: np.ndarray


def project(point, cov, rows, bound):
    """The nearest point of {rows z <= bound} in the metric cov^{-1}, and (27).

    Tries all sets of at most n linearly independent rows with a KKT check.
    """
    n = len(point)
    if np.all(rows @ point <= bound):
        return point, cov
    best = None
    for size in range(1, n + 1):
        for chosen in map(list, combinations(range(len(rows)), size)):
            active = rows[chosen]
            if np.linalg.matrix_rank(active) < size:
                continue
            gain = cov @ active.T @ np.linalg.inv(active @ cov @ active.T)
            z = point - gain @ (active @ point - bound[chosen])
            if np.any(rows @ z > bound + 1e-9):
                continue
            distance = (z - point) @ np.linalg.solve(cov, z - point)
            if best is None or distance < best[0] - 1e-12:
                shrink = np.eye(n) - gain @ active
                best = distance, z, shrink @ cov @ shrink.T
    assert best is not None, "an empty set"
    return best[1], best[2]


def care(A, G, C, Q, R, x0, P0, y, state, attack, project_it=True):
    """Algorithm 1 over a log without inputs: A, G per step; ``state``, ``attack`` (rows, bound)."""
    x, P, found = x0, P0, []
    n = len(x0)
    for A_k, G_k, y_k in zip(A, G, y, strict=True):
        prior = A_k @ x
        R_inv = np.linalg.inv(C @ (A_k @ P @ A_k.T + Q) @ C.T + R)
        d_cov = np.linalg.inv(G_k.T @ C.T @ R_inv @ C @ G_k)
        M = d_cov @ G_k.T @ C.T @ R_inv
        d = M @ (y_k - C @ prior)
        cross = -P @ A_k.T @ C.T @ M.T
        star = prior + G_k @ d
        coupled = A_k @ cross @ G_k.T - G_k @ M @ C @ Q
        P_star = A_k @ P @ A_k.T + coupled + coupled.T + G_k @ d_cov @ G_k.T + Q
        noisy = C @ G_k @ M @ R
        R_star = C @ P_star @ C.T - noisy - noisy.T + R
        L = (P_star @ C.T - G_k @ M @ R) @ np.linalg.pinv(R_star, rcond=1e-10, hermitian=True)
        x_free = star + L @ (y_k - C @ star)
        keep = np.eye(n) - L @ C
        mixed = keep @ G_k @ M @ R @ L.T
        P_free = mixed + mixed.T + keep @ P_star @ keep.T + L @ R @ L.T
        d_free, d_free_cov = d, d_cov
        x, P = x_free, P_free
        if project_it:
            x, P = project(x_free, P_free, *state)
            d, d_cov = project(d_free, d_free_cov, *attack)
        found.append((x, P, d, d_cov, d_free, d_free_cov))
    return Filtered(*(np.stack(part) for part in zip(*found, strict=True)))


def matrices(v, dt=0.01, rear=1.5):
    """The vehicle's A and G = B at the speed v, as printed in Section 5.1."""
    A, G = np.eye(4), np.zeros((4, 2))
    A[0, 3], A[1, 2] = dt, v * dt
    G[1, 0], G[2, 0], G[3, 1] = v * dt, v * dt / rear, dt
    return A, G


Q = np.diag([0.1, 0.1, 0.001, 0.0001])
R = np.diag([0.01, 0.01, 0.001, 0.00001])
X0 = np.array([0.0, 0.0, 0.0, 18.8])
STATE = (
    np.array([[s * (i == j) for j in range(4)] for i in (0, 1, 3) for s in (1.0, -1.0)]),
    np.array([20.0, 0, 5, 0, 22, 0]),
)
BETA = np.arctan(0.5 * np.tan(1.0472))
ATTACK = (np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]]), np.array([BETA, BETA, 3.5, 3.5]))


def attack(k):
    """(beta, a) injected at k, clipped at the steering limit."""
    if k < 100:
        return np.zeros(2)
    delta = np.clip(1.1 * np.sin(0.05 * k), -1.0472, 1.0472)
    return np.array([np.arctan(0.5 * np.tan(delta)), 3.5 if (k // 100) % 2 else -3.5])


def vehicle(rng, steps=1000):
    """A run: A, G, true x and d, y, time first."""
    x, rows = X0, []
    for k in range(steps):
        A, G = matrices(x[3])
        d = attack(k)
        x = A @ x + G @ d + np.sqrt(np.diag(Q)) * rng.standard_normal(4)
        x = np.array([np.clip(x[0], 0, 20), np.clip(x[1], 0, 5), x[2], np.clip(x[3], 0, 22)])
        y = x + np.sqrt(np.diag(R)) * rng.standard_normal(4)
        rows.append((A, G, x, d, y))
    return tuple(np.stack(part) for part in zip(*rows, strict=True))
