"""DECOMPOSE's own algebra, from a known Jordan form: (9) to (29) as printed.

The paper's example, and small plants with complex, defective and repeated eigenvalues. Nothing
here uses the product's decomposition, so that it is not judged by itself.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, solve_discrete_lyapunov

from holdfast.numerics.steady_state import steady_state
from holdfast.plants.library.five_sensors import MODES, SENSORS


class Given(NamedTuple):
    """A plant with B = I, a gain, and the Jordan form A - K C A = V J V^-1."""

    A: np.ndarray
    C: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    K: np.ndarray
    V: np.ndarray
    J: np.ndarray

    @property
    def M(self) -> np.ndarray:
        """A - K C A."""
        return self.A - self.K @ self.C @ self.A

    @property
    def P(self) -> np.ndarray:
        """The covariance of the fixed-gain filter after a sample; for a Kalman gain that of (5)."""
        left = np.eye(len(self.A)) - self.K @ self.C
        return solve_discrete_lyapunov(self.M, left @ self.Q @ left.T + self.K @ self.R @ self.K.T)

    @property
    def blocks(self) -> list[tuple[int, int]]:
        """First row and size of every Jordan block."""
        n = len(self.J)
        first = [i for i in range(n) if i == 0 or self.J[i - 1, i] == 0]
        return [(a, b - a) for a, b in zip(first, [*first[1:], n], strict=True)]

    @property
    def X(self) -> np.ndarray:
        """(13b), (14): upper triangular Toeplitz blocks, for each sensor (m x n x n)."""
        right = np.linalg.solve(self.V, self.K.astype(complex))
        X = np.zeros((len(self.C), *self.J.shape), complex)
        for first, size in self.blocks:
            end = first + size
            below = np.concatenate([right[first + 1 : end], np.zeros((1, len(self.C)))])
            x = right[first:end] - below
            for up in range(size):
                for row in range(size - up):
                    X[:, first + row, first + row + up] = x[size - 1 - up]
        return X

    @property
    def F(self) -> np.ndarray:
        """(13a), m x n x n."""
        return self.V @ self.X

    @property
    def G(self) -> np.ndarray:
        """(18), m x n x n."""
        n = len(self.A)
        G = np.zeros((len(self.C), n, n), complex)
        for first, size in self.blocks:
            inverse = np.linalg.inv(self.A - self.J[first, first] * np.eye(n))
            total, power = np.zeros((n, n)), np.eye(n)
            for row in reversed(range(first, first + size)):
                power = power @ inverse
                total = total + power
                G[:, row] = self.C @ self.A @ total
        return G

    @property
    def noise(self) -> np.ndarray:
        """Xi of (27) and (28), m n x m n."""
        enters = (self.G - self.C[:, None, :]).reshape(-1, len(self.A))
        return enters @ self.Q @ enters.conj().T + np.kron(self.R, np.ones(self.J.shape))

    @property
    def W(self) -> np.ndarray:
        """The fixed point of (29)."""
        return solve_discrete_lyapunov(np.kron(np.eye(len(self.C)), self.J), self.noise)

    def stacked(self) -> tuple[np.ndarray, np.ndarray]:
        """[G_1; ..; G_m] and [F_1 .. F_m]."""
        return self.G.reshape(-1, len(self.A)), np.concatenate(list(self.F), 1)


def diagonalised(A, C, Q, R, K) -> Given:
    """With distinct eigenvalues of A - K C A, the smallest first, as in the paper's G_i."""
    values, V = np.linalg.eig(A - K @ C @ A)
    order = np.lexsort((np.imag(values), np.real(values)))
    J = np.diag(values[order])
    return Given(A, C, Q, R, K, V[:, order], J)


def example(
    *, R: float = 1.0, modes=MODES, gain: float = 1.0, measured: int | None = None
) -> Given:
    """Section VI, with R times the unit matrix, other modes, or a Kalman gain times ``gain``.

    ``measured``: the number of a state that a sixth sensor measures.
    """
    A, C = np.diag(modes), np.array(SENSORS)
    C = C if measured is None else np.vstack([C, np.eye(len(A))[measured]])
    Q, noise = np.eye(len(A)), R * np.eye(len(C))
    K = steady_state(A, C, Q, noise).K
    if K is None:
        raise ValueError("no steady-state filter")
    return diagonalised(A, C, Q, noise, gain * K)


def with_form(J: np.ndarray, V: np.ndarray, gain: float = 1.0) -> Given:
    """Three sensors and three states with P_+ = I and a Kalman gain, times ``gain``, of this form.

    A = P^-1 V J V^-1 with P = I - K C; Q is what keeps P_+ at I.
    """
    C = np.array([[0.6, 0.2, 0.1], [-0.3, 0.5, 0.2], [0.1, -0.2, 0.7]])
    R = np.array([[3.0, 0.4, 0.1], [0.4, 2.5, -0.3], [0.1, -0.3, 2.0]])
    K = np.linalg.solve(C @ C.T + R, C).T
    P = np.eye(3) - K @ C
    A = np.linalg.inv(P) @ np.real(V @ J @ np.linalg.inv(V))
    Q = np.eye(3) - A @ P @ A.T
    np.linalg.cholesky(Q)
    given = Given(A, C, (Q + Q.T) / 2, R, K, V, J)
    return given if gain == 1.0 else diagonalised(*given[:4], gain * K)


MIRROR = np.eye(3) - np.outer([1.0, 2.0, 3.0], [1.0, 2.0, 3.0]) / 7.0
"""An orthogonal matrix, so that the forms are in no one's own basis."""
PAIR = np.asarray(block_diag(np.array([[1.0, 1.0], [1.0j, -1.0j]]) / np.sqrt(2), 1.0))
DEFECTIVE = with_form(
    np.array([[0.3, 1.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, -0.2]]), MIRROR * [1.0, 5.0, 1.0]
)
"""One block of size two."""
COMPLEX = with_form(np.diag([0.2 + 0.3j, 0.2 - 0.3j, 0.1]), MIRROR @ PAIR)
REPEATED = with_form(np.diag([0.3, 0.3, 0.1]), MIRROR)
"""Two blocks of one eigenvalue."""
EXAMPLE = example()
EVERY = (EXAMPLE, DEFECTIVE, COMPLEX, REPEATED)
"""What an identity is tried on."""


def gap(found, wanted) -> float:
    """Largest difference, relative to the largest entry of what is wanted (or to 1)."""
    size = max(1.0, float(np.max(np.abs(wanted))))
    return float(np.max(np.abs(np.asarray(found) - wanted))) / size
