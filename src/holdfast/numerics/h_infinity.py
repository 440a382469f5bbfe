"""The steady gain of the H-infinity filter: the worst disturbance grows by less than a bound."""

import numpy as np

STEPS = 100_000
SETTLED = 1e-13
FLOOR = 1e-12
"""What is added to a singular Q, relative to its largest entry, so that P can be inverted."""


def h_infinity_gain(
    A: np.ndarray, C: np.ndarray, Q: np.ndarray, R: np.ndarray, bound: float
) -> np.ndarray | None:
    """K (n x m) with sup |x - x^|^2 / (|w|^2_{Q^-1} + |v|^2_{R^-1}) < bound^2; None if none is.

    P <- A (P^-1 + C' R^-1 C - bound^-2 I)^-1 A' + Q, run until it settles, and the gain of an
    estimate of x_k that knows y_k, K = P C' (C P C' + R)^-1. Large bounds give the Kalman gain.
    (The gain with the inverse above in place of P is that of the one-step predictor: here it
    exceeds the bound, and may be unstable.)

    Source: Hassibi, Sayed and Kailath (1996), Linear estimation in Krein spaces, Part II, the
    a-posteriori filter.
    """
    n = len(A)
    information = C.T @ np.linalg.solve(R, C) - np.eye(n) / bound**2
    Q = Q + FLOOR * np.max(Q) * np.eye(n)
    P = Q
    for _ in range(STEPS):
        # P^-1 + information > 0, without inverting P
        try:
            root = np.linalg.cholesky((P + P.T) / 2)
        except np.linalg.LinAlgError:
            return None
        inner = np.eye(n) + root.T @ information @ root
        values, vectors = np.linalg.eigh((inner + inner.T) / 2)
        if values[0] <= 0:
            return None
        half = root @ vectors / np.sqrt(values)
        new = A @ (half @ half.T) @ A.T + Q
        if np.max(np.abs(new - P)) <= SETTLED * np.max(np.abs(new)):
            return np.linalg.solve(C @ new @ C.T + R, C @ new).T
        P = new
    return None
