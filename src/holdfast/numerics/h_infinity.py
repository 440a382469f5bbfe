"""The steady gain of the H-infinity filter: the worst disturbance grows by less than a bound."""

import numpy as np

STEPS = 100_000
SETTLED = 1e-13


def h_infinity_gain(
    A: np.ndarray, C: np.ndarray, Q: np.ndarray, R: np.ndarray, bound: float
) -> np.ndarray | None:
    """K (n x m) with sup |x - x^|^2 / (|w|^2_{Q^-1} + |v|^2_{R^-1}) < bound^2; None if none is.

    K = S C' R^-1 with S = (P^-1 - bound^-2 I + C' R^-1 C)^-1, P <- A S A' + Q, run until it
    settles. Large bounds give the Kalman gain.

    Source: Simon (2006), Optimal State Estimation, (11.89).
    """
    n = len(A)
    information = C.T @ np.linalg.solve(R, C) - np.eye(n) / bound**2
    P = Q + 1e-12 * np.max(Q) * np.eye(n)
    for _ in range(STEPS):
        # P^-1 + information > 0, without inverting P
        root = np.linalg.cholesky((P + P.T) / 2)
        inner = np.eye(n) + root.T @ information @ root
        values, vectors = np.linalg.eigh((inner + inner.T) / 2)
        if values[0] <= 0:
            return None
        half = root @ vectors / np.sqrt(values)
        S = half @ half.T
        new = A @ S @ A.T + Q + 1e-12 * np.max(Q) * np.eye(n)
        if np.max(np.abs(new - P)) <= SETTLED * np.max(np.abs(new)):
            return np.linalg.solve(R, C @ S).T
        P = new
    return None
