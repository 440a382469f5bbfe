"""Random systems whose fixed-gain filter has a prescribed Jordan structure.

A matrix M with the structure and a gain K are drawn, and A = (I - K C)^-1 M, so that
A - K C A = M whatever the number of sensors. K is the Kalman gain of one update from a drawn
covariance: I - K C has eigenvalues in (0, 1).
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from holdfast.numerics.steady_state import steady_state

COUNT = 200
WELL_POSED = 1e3
"""Largest `forgotten` of a system; the others are drawn again."""
NEARLY = 1e-6
"""Distance of the eigenvalues of the nearly defective kinds."""


class Decomposable(NamedTuple):
    """A system with a gain; ``structure``: [(eigenvalue, block sizes)], None for a Kalman gain.

    B and D (two inputs) and x0 are for runs of the filter.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    K: np.ndarray
    x0: np.ndarray
    kind: str
    structure: list[tuple[complex, tuple[int, ...]]] | None


# how large each block of each repeated eigenvalue is, and whether that eigenvalue is complex
REPEATED = {
    "kalman": [],
    "distinct": [],
    "derogatory": [((1, 1), False)],
    "derogatory complex": [((1, 1), True)],
    "defective": [((2,), False)],
    "defective, three": [((3,), False)],
    "defective complex": [((2,), True)],
    "mixed": [((2, 1, 1), False)],
    "nearly defective": [],
    "nearly repeated": [],
}
KINDS = list(REPEATED)


def jordan(value: complex, sizes: tuple[int, ...]) -> np.ndarray:
    """Real Jordan blocks of a real eigenvalue or of a complex pair."""
    cell = np.array([[value.real]])
    if value.imag:
        cell = np.array([[value.real, value.imag], [-value.imag, value.real]])
    unit = np.eye(len(cell))
    return block_diag(*(np.kron(np.eye(s), cell) + np.kron(np.eye(s, k=1), unit) for s in sizes))


def order(value: complex) -> int:
    """1 for a real eigenvalue, 2 for a pair."""
    return 2 if complex(value).imag else 1


def basis(rng: np.random.Generator, n: int) -> np.ndarray:
    """Well conditioned: orthogonal, with columns of length 0.5 to 2."""
    return np.linalg.qr(rng.normal(size=(n, n)))[0] * rng.uniform(0.5, 2.0, n)


def covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.normal(size=(n, n)) / np.sqrt(n)
    return root @ root.T + 0.1 * np.eye(n)


def similar(rng: np.random.Generator, J: np.ndarray) -> np.ndarray:
    """U J U^-1."""
    U = basis(rng, len(J))
    return np.linalg.solve(U.T, (U @ J).T).T


def with_structure(
    rng: np.random.Generator, structure: list[tuple[complex, tuple[int, ...]]]
) -> np.ndarray:
    """A real matrix of the structure; of a complex pair one value is given."""
    return similar(rng, block_diag(*(jordan(complex(z), sizes) for z, sizes in structure)))


def _value(rng, taken: list[complex], real: bool) -> complex:
    """An eigenvalue of modulus 0.1 to 0.9, at least 0.05 from others and from the real axis."""
    while True:
        size = rng.uniform(0.1, 0.9)
        z = (
            complex(size * rng.choice([-1, 1]))
            if real
            else size * np.exp(1j * rng.uniform(0, np.pi))
        )
        if (real or z.imag > 0.05) and all(
            min(abs(z - t), abs(z - t.conjugate())) > 0.05 for t in taken
        ):
            taken.append(z)
            return z


def paper_form(structure: list[tuple[complex, tuple[int, ...]]]) -> tuple[np.ndarray, np.ndarray]:
    """The paper's J (9), conjugates and copies written out, and T with T J T^-1 = the real form."""
    J, T = [], []
    for value, sizes in structure:
        for s in sizes:
            block = value * np.eye(s) + np.eye(s, k=1)
            if complex(value).imag:
                column = np.kron(np.eye(s), [[1.0], [1.0j]]) / np.sqrt(2)
                J += [block, block.conj()]
                T.append(np.hstack([column, column.conj()]))
            else:
                J.append(block)
                T.append(np.eye(s))
    return block_diag(*J), block_diag(*T)


class KalmanWith(NamedTuple):
    """A - K C A = V J V^-1, K the steady-state Kalman gain, P its covariance after a sample."""

    A: np.ndarray
    C: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    K: np.ndarray
    P: np.ndarray
    V: np.ndarray
    J: np.ndarray


def kalman_with(
    rng: np.random.Generator, structure: list[tuple[complex, tuple[int, ...]]], m: int
) -> KalmanWith:
    """The covariance of the prediction is I; Q is what keeps it there.

    The eigenvalues have to be small for Q to be a covariance: an error otherwise.
    """
    J, T = paper_form(structure)
    n = len(J)
    # couplings of 0.2 in real blocks
    length = [
        5.0**i for z, sizes in structure for s in sizes for i in np.repeat(range(s), order(z))
    ]
    V = np.linalg.qr(rng.normal(size=(n, n)))[0] * np.array(length) @ T
    M = np.linalg.solve(V.T, (V @ J).T).T.real
    C, R = rng.normal(size=(m, n)) / np.sqrt(m), 2 * np.eye(m) + covariance(rng, m)
    K = np.linalg.solve(C @ C.T + R, C).T
    P = np.eye(n) - K @ C
    A = np.linalg.solve(P, M)
    Q = np.eye(n) - A @ P @ A.T
    np.linalg.cholesky(Q)
    return KalmanWith(A, C, (Q + Q.T) / 2, R, K, P, V, J)


def forgotten(A: np.ndarray, M: np.ndarray) -> float:
    """How large the local estimates have to be for x = sum F_i zeta_i, from eigenvalues alone.

    With G v = (a - S)^-1 b C a v for an eigenvector v of A and S S' + b b' = I,
    ||(a - S)^-1 b||^2 = (B^2 - 1) / (1 - |a|^2),  B = prod |1 - p' a| / |a - p|,
    over the poles p. B is infinite where A and M share an eigenvalue, and large where an
    eigenvalue of A is near many of M: then x is the small difference of large terms, whatever
    the basis, and loses the digits of B.
    """
    a, p = np.linalg.eigvals(A)[:, None], np.linalg.eigvals(M)
    B = np.prod(np.abs(1 - p.conj() * a) / np.abs(a - p), axis=1)
    return float(np.max(B))


def _structure(rng, kind: str, n: int) -> tuple[list, list]:
    """What is to be found, and what the matrix is built from: they differ in the near kinds."""
    taken: list[complex] = []
    found = [(_value(rng, taken, not pair), sizes) for sizes, pair in REPEATED[kind]]
    built = list(found)
    blocks = []
    if kind.startswith("nearly"):
        z = _value(rng, taken, True).real
        near = z + NEARLY * z
        if kind == "nearly defective":
            blocks = [np.array([[z, 1.0], [0.0, near]])]
            found.append((complex((z + near) / 2), (2,)))
        else:
            blocks = [np.diag([z, near])]
            found += [(complex(z), (1,)), (complex(near), (1,))]
    blocks += [jordan(z, sizes) for z, sizes in built]
    left = n - sum(len(b) for b in blocks)
    while left > 0:
        z = _value(rng, taken, left < 2 or rng.random() < 0.5)
        found.append((z, (1,)))
        blocks.append(jordan(z, (1,)))
        left -= len(blocks[-1])
    return found, blocks


def _prescribed(rng, kind: str, n: int, m: int):
    found, blocks = _structure(rng, kind, n)
    M = similar(rng, block_diag(*blocks))
    C, P, R = rng.normal(size=(m, n)) / np.sqrt(m), covariance(rng, n), covariance(rng, m)
    K = np.linalg.solve(C @ P @ C.T + R, C @ P).T
    return np.linalg.solve(np.eye(n) - K @ C, M), C, covariance(rng, n), R, K, found


@cache
def decomposable(seed: int) -> Decomposable:
    """The seed-th system: n from 1 to 12, m from 1 to 20, the kinds in turn."""
    rng = np.random.default_rng([1, seed])
    kind = KINDS[seed % len(KINDS)]
    least = sum(len(block) for block in _structure(rng, kind, 0)[1])
    # one sensor cannot move two blocks of an eigenvalue away from it
    copies = max((len(sizes) for sizes, _ in REPEATED[kind]), default=1)
    n, m = int(rng.integers(max(least, 1), 13)), int(rng.integers(copies, 21))
    while True:
        found: list | None = None
        if kind == "kalman":
            A, C, Q, R, K = _kalman(rng, n, m)
        else:
            A, C, Q, R, K, found = _prescribed(rng, kind, n, m)
        if forgotten(A, A - K @ C @ A) <= WELL_POSED:
            break
    return Decomposable(
        A, rng.normal(size=(n, 2)), C, rng.normal(size=(m, 2)), Q, R, K, rng.normal(size=n),
        kind, found,
    )  # fmt: skip


def _kalman(rng, n: int, m: int):
    # no modes that die out at once: each costs the local estimates digits, see `forgotten`
    A = np.linalg.qr(rng.normal(size=(n, n)))[0] @ np.diag(rng.uniform(0.7, 1.3, n))
    C, Q, R = rng.normal(size=(m, n)), covariance(rng, n), covariance(rng, m)
    K = steady_state(A, C, Q, R).K
    assert K is not None
    return A, C, Q, R, K
