"""A fixed-gain filter as a sum of one local filter per sensor.

The filter  x = M x_before + (I - K C) B u + K (y - D u),  M = A - K C A,  is the sum of
F_i zeta_i, where the bank

    zeta_i = S zeta_i,before + b (y_i - D_i u) + (G_i - b C_i) B u

needs only that (S, b) is controllable and has the poles of M. The paper takes (J, 1) with the
Jordan form J, which is fragile. Here S S' + b b' = I: a cascade of all-pass sections, built from
the eigenvalues alone, whatever their multiplicity. Then

    F_i = M F_i S' + K_i b'              (both stable: always well posed)
    G_i A - S G_i = b C_i A              (well posed where A and M share no eigenvalue)
    W = (I x S) W (I x S)' + cov of what enters    >= R x I

so that W, the covariance of all local errors G_i x - zeta_i, can be inverted whatever the
eigenvalues: it is singular in the paper's coordinates only where those repeat themselves.

Source: DECOMPOSE (9) to (29), with J^H for J in (36), (39), (40).
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_sylvester

from holdfast.numerics.jordan import Block, Coordinates, blocks, coordinates

SHARED = 1e-7
"""Distance of an eigenvalue of A from one of A - K C A, relative to the larger of its size and
1e-3 of the largest, under which they are taken as shared: G then has lost half its digits."""


class Unfit(ValueError):
    """Why a plant has no such decomposition."""


class Local(NamedTuple):
    """The bank of m sensors, each of order d, and how its errors go together.

    ``S`` (d x d), ``b`` (d,); ``F`` (n x m d) and ``G`` (m d x n) stacked by sensor;
    ``W`` (m d x m d); ``P`` (n x n), the covariance of the filter itself; ``coordinates``
    the paper's.
    """

    S: np.ndarray
    b: np.ndarray
    F: np.ndarray
    G: np.ndarray
    W: np.ndarray
    P: np.ndarray
    coordinates: Coordinates
    structure: tuple[Block, ...]

    @property
    def sensors(self) -> int:
        """How many sensors."""
        return len(self.G) // len(self.b)

    @property
    def derogatory(self) -> bool:
        """Whether some eigenvalue of A - K C A has several Jordan blocks."""
        return any(len(block.sizes) > 1 for block in self.structure)

    def paper_G(self) -> np.ndarray:
        """G in the paper's coordinates, real and imaginary parts (m x d x n)."""
        return self.coordinates.rows @ self.G.reshape(self.sensors, len(self.b), -1)


def decompose(A: np.ndarray, C: np.ndarray, Q: np.ndarray, R: np.ndarray, K: np.ndarray) -> Local:
    """The decomposition of the filter with the gain ``K`` (n x m).

    A (n x n), C (m x n), Q (n x n), R (m x m) full. Raises `Unfit` where A - K C A is not
    stable or shares an eigenvalue with A, to the digits that sum F_i G_i = I shows (a repeated
    eigenvalue is shared without any two computed ones being close).
    """
    n, m = K.shape
    M = A - K @ C @ A
    found = blocks(M)
    _check(A, M)
    S, b = input_normal(_poles(found))
    d = len(b)
    F = stein(M, S, np.einsum("ni,d->ind", K, b))
    G = np.stack([solve_sylvester(-S, A, np.outer(b, row)) for row in C @ A])
    enters = (G - np.einsum("d,in->idn", b, C)).reshape(m * d, n)
    noise = enters @ Q @ enters.T + np.kron(R, np.outer(b, b))
    W = bank_covariance(S, noise)
    F, G = np.concatenate(F, 1), G.reshape(m * d, n)
    _check_sum(F, G)
    left = np.eye(n) - K @ C
    P = stein(M, M, (left @ Q @ left.T + K @ R @ K.T)[None])[0]
    return Local(S, b, F, G, W, (P + P.T) / 2, coordinates(S, b, found), tuple(found))


def _check(A: np.ndarray, M: np.ndarray) -> None:
    of_M, of_A = np.linalg.eigvals(M), np.linalg.eigvals(A)
    if np.max(np.abs(of_M)) >= 1.0:
        raise Unfit(f"A - K C A has an eigenvalue of modulus {np.max(np.abs(of_M)):.4g}, not < 1")
    size = np.maximum(np.abs(of_A), 1e-3 * np.max(np.abs(of_A)))
    apart = np.abs(of_A[:, None] - of_M[None]) / np.where(size > 0, size, 1.0)[:, None]
    i = int(np.argmin(apart.min(1)))
    if apart[i].min() < SHARED:
        z = of_A[i]
        text = f"{z.real:.4g}" if abs(z.imag) <= 1e-12 * abs(z) else f"{z:.4g}"
        raise Unfit(
            f"A and A - K C A share the eigenvalue {text}: no measurement corrects that mode "
            "(it is not seen, not excited by noise, or forgotten in one step)"
        )


def _check_sum(F: np.ndarray, G: np.ndarray) -> None:
    """Sum F_i G_i = I, with each state in the unit in which the local estimates see it."""
    size = np.linalg.norm(G, axis=0)
    unit = 1.0 / np.where(size > 0, size, 1.0)
    lost = np.max(np.abs(F @ G - np.eye(len(unit))) * unit / unit[:, None])
    if not lost <= SHARED:
        raise Unfit(
            "A and A - K C A come too close to sharing an eigenvalue: the local estimates give "
            f"the state back with a relative error of {lost:.1g}"
        )


def _poles(found: list[Block]) -> list[complex]:
    """The zeros of the minimal polynomial: one of a real eigenvalue, one of a complex pair."""
    poles: list[complex] = []
    for block in found:
        if len(block.sizes) == 1:
            # as computed: together they are exact, their mean is not
            poles += [z for z in block.members if block.value.imag or z.imag >= 0]
        else:
            poles += [block.value] * block.sizes[0]
    return poles


def input_normal(poles: list[complex]) -> tuple[np.ndarray, np.ndarray]:
    """A real pair (S, b) with S S' + b b' = I; of each complex pair one pole is given.

    Orthogonal all-pass sections of one real pole or one pair, each fed by the one before
    (Takenaka, Malmquist). A pair, z^2 + a1 z + a2, is the section
    [[a2 t, -a2 r], [r, t]] with t = -a1 / (1 + a2), r = sqrt(1 - t^2), also where it is a
    double real pole.
    """
    d = sum(1 if z.imag == 0 else 2 for z in poles)
    S, b = np.zeros((d, d)), np.zeros(d)
    feed, through, at = np.zeros(d), 1.0, 0
    for z in poles:
        if z.imag == 0:
            gain = np.sqrt((1.0 - z.real) * (1.0 + z.real))
            section, enter = np.array([[z.real]]), np.array([gain])
            leave, past = np.array([gain]), -z.real
        else:
            a2 = abs(z) ** 2
            t = 2.0 * z.real / (1.0 + a2)
            r = abs(1.0 - z) * abs(1.0 + z) / (1.0 + a2)
            gain = np.sqrt((1.0 - abs(z)) * (1.0 + abs(z)) * (1.0 + a2))
            section, enter = np.array([[a2 * t, -a2 * r], [r, t]]), np.array([gain, 0.0])
            leave, past = np.array([-gain * t, gain * r]), a2
        here = slice(at, at + len(enter))
        S[here] = np.outer(enter, feed)
        S[here, here] = section
        b[here] = through * enter
        feed, through = past * feed, past * through
        feed[here] = leave
        at = here.stop
    return S, b


def stein(M: np.ndarray, S: np.ndarray, added: np.ndarray) -> np.ndarray:
    """X = M X S' + added, for each of a stack, both matrices stable: by doubling."""
    X = added
    for _ in range(64):
        step = M @ X @ S.T
        if np.max(np.abs(step), initial=0.0) <= 1e-18 * np.max(np.abs(X), initial=0.0):
            break
        X, M, S = X + step, M @ M, S @ S
    return X


def bank_covariance(S: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """W = (I x S) W (I x S)' + noise, exactly symmetric."""
    d, m = len(S), len(noise) // len(S)
    parts = noise.reshape(m, d, m, d).transpose(0, 2, 1, 3)
    W = stein(S, S, parts).transpose(0, 2, 1, 3).reshape(m * d, m * d)
    return (W + W.T) / 2


class Residuals(NamedTuple):
    """The least-squares fusion of local estimates, and the coordinates of what it leaves over.

    ``F`` (n x N) = (G' W^-1 G)^-1 G' W^-1; ``Z`` (N x (N - n)) with
    Z Z' = W^-1 (I - G F): a benign Z' zeta is standard normal.
    """

    F: np.ndarray
    Z: np.ndarray


def least_squares(G: np.ndarray, W: np.ndarray) -> Residuals:
    """Fusion of zeta = G x - e, e ~ (0, W), by an orthogonal factorisation.

    Source: DECOMPOSE (30) and Theorem 2.
    """
    lower = np.linalg.cholesky(W)
    white = np.linalg.solve(lower, G)
    q, r = np.linalg.qr(white, mode="complete")
    n = G.shape[1]
    F = np.linalg.solve(r[:n], np.linalg.solve(lower.T, q[:, :n]).T)
    return Residuals(F, np.linalg.solve(lower.T, q[:, n:]))
