"""The Kalman filter of a plant in the long run, where it has one."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are

from holdfast.numerics.subspaces import complement, modes, scaled, silent

UNSTABLE = 1.0 - 1e-7
"""Modulus from which an eigenvalue or a zero counts as unstable."""
AGREED = 1e-8
"""Relative change of P_pred over one step of the recursion that counts as none."""


class SteadyState(NamedTuple):
    """``K`` (n x ny): x = x_pred + K residual; ``P`` after the measurement, ``P_pred`` before.

    All None where there is no stabilising solution; ``reason`` then says why.
    """

    K: np.ndarray | None
    P: np.ndarray | None
    P_pred: np.ndarray | None
    reason: str | None


def steady_state(A: np.ndarray, C: np.ndarray, Q: np.ndarray, R: np.ndarray) -> SteadyState:
    """P_pred = A P A' + Q with K = P_pred C' (C P_pred C' + R)^-1, P = (I - K C) P_pred.

    A (n x n), C (ny x n), Q (n x n), R (ny x ny) positive definite.

    From the Riccati equation, then polished and checked by the recursion itself. It exists
    where the outputs see every mode on or outside the unit circle and noise excites every
    mode on it.
    """
    unseen = [z for z in _unseen(A, C) if abs(z) >= UNSTABLE]
    if unseen:
        return _none(f"the outputs do not see the unstable mode {_text(unseen[0])}")
    still = [z for z in _unseen(A.T, Q) if abs(abs(z) - 1.0) <= 1.0 - UNSTABLE]
    if still:
        return _none(
            f"no noise excites the mode {_text(still[0])} on the unit circle: its gain "
            "tends to zero and never settles"
        )
    try:
        P_pred = solve_discrete_are(A.T, C.T, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        return _none(f"the Riccati equation was not solved ({error})")
    for _ in range(50):
        K, P, new = _recursion(A, C, Q, R, P_pred)
        change = np.max(np.abs(new - P_pred), initial=0.0)
        settled = change <= AGREED * np.max(np.abs(new), initial=0.0)
        P_pred = new
        if settled:
            return SteadyState(K, P, P_pred, None)
    return _none("the Riccati recursion does not stay at the solution of its equation")


def _recursion(A, C, Q, R, P_pred) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gain, P in Joseph's form, and the next P_pred."""
    K = np.linalg.solve(C @ P_pred @ C.T + R, C @ P_pred).T
    left = np.eye(len(A)) - K @ C
    P = left @ P_pred @ left.T + K @ R @ K.T
    return K, (P + P.T) / 2, A @ P @ A.T + Q


def _unseen(A: np.ndarray, C: np.ndarray) -> list[complex]:
    """The modes of A on its largest invariant subspace that C does not see."""
    s = scaled(A, np.zeros((len(A), 0)), C, np.zeros((len(C), 0)))
    basis = complement(silent(s)[-1])
    return [z for z, _ in modes(basis.T @ s.A @ basis)]


def _text(mode: complex) -> str:
    return f"{mode.real:.4g}" if mode.imag == 0 else f"{mode:.4g}"


def _none(reason: str) -> SteadyState:
    return SteadyState(None, None, None, reason)
