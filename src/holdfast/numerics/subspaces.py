"""Subspaces of a plant that an attack can use, in coordinates that do not depend on units.

Every rank is decided by singular values after `scaled` has chosen units of the states, the
outputs and the attacks in which the couplings that are there have size about 1. What is below
`TOLERANCE` there counts as no coupling.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import qr

TOLERANCE = 1e-8
"""Singular value that counts as zero: about the square root of the rounding, so that what a
decision leaves behind (rounding over the smallest kept value) stays under the next decision."""
NOISE = 1e-12
"""Entries this much smaller than both their row's and their column's largest are rounding."""

NEAR = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 0.0)
"""Distances within which computed eigenvalues may be one repeated eigenvalue, widest first:
rounding moves a k-fold one by about eps^(1/k)."""


class Scaled(NamedTuple):
    """A, G, C, H in units of size one: x = ``x`` times the scaled state, d and y likewise."""

    A: np.ndarray
    G: np.ndarray
    C: np.ndarray
    H: np.ndarray
    x: np.ndarray
    d: np.ndarray
    y: np.ndarray

    @property
    def size(self) -> float:
        """What singular values are compared with."""
        return max(1.0, float(np.linalg.norm(np.hstack([self.A, self.G]))))


def scaled(A: np.ndarray, G: np.ndarray, C: np.ndarray, H: np.ndarray) -> Scaled:
    """The units in which the logarithms of the non-zero entries are smallest in mean square.

    With z the logarithms of the units, sum over entries (log|m_rc| + z_c - z_r)^2 is
    minimised: another choice of units for the same plant gives the same scaled matrices.

    Source: Curtis and Reid (1972), with one unit for the row and the column of a state.
    """
    (n, nd), ny = G.shape, len(C)
    whole = np.abs(np.block([[A, G], [C, H]]))
    largest = np.minimum.outer(whole.max(1, initial=0.0), whole.max(0, initial=0.0))
    there = whole > NOISE * largest
    logs = np.log(np.where(there, whole, 1.0))
    nodes = n + nd + ny
    rows = np.r_[0:n, n + nd : nodes]
    coupled, sizes = np.zeros((nodes, nodes)), np.zeros((nodes, nodes))
    coupled[np.ix_(rows, np.arange(n + nd))] = there
    sizes[np.ix_(rows, np.arange(n + nd))] = logs
    laplacian = np.diag(coupled.sum(0) + coupled.sum(1)) - coupled - coupled.T
    unit = np.exp(np.linalg.lstsq(laplacian, sizes.sum(1) - sizes.sum(0), rcond=None)[0])
    x, d, y = unit[:n], unit[n : n + nd], unit[n + nd :]
    y = y * _one_for_zero(np.linalg.norm(np.hstack([C * x, H * d]) / y[:, None], axis=1))
    d = d / _one_for_zero(np.linalg.norm(np.vstack([G / x[:, None], H / y[:, None]]) * d, axis=0))
    return Scaled(
        A * x / x[:, None], G * d / x[:, None], C * x / y[:, None], H * d / y[:, None], x, d, y
    )


def _one_for_zero(norms: np.ndarray) -> np.ndarray:
    return np.where(norms > 0, norms, 1.0)


def span(m: np.ndarray, size: float = 1.0) -> np.ndarray:
    """An orthonormal basis (columns) of the range of ``m``."""
    left, values, _ = np.linalg.svd(m, full_matrices=False)
    return left[:, values > TOLERANCE * size]


def complement(m: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what is orthogonal to the columns of ``m``."""
    left, values, _ = np.linalg.svd(m, full_matrices=True)
    return left[:, int(np.sum(values > TOLERANCE)) :]


def kernel(m: np.ndarray, size: float = 1.0) -> np.ndarray:
    """An orthonormal basis of the z with m z = 0."""
    _, values, right = np.linalg.svd(m, full_matrices=True)
    return right[int(np.sum(values > TOLERANCE * size)) :].conj().T


def silent(s: Scaled) -> list[np.ndarray]:
    """What l samples reveal of a state whatever the attack: T_0, T_1, ... until it settles.

    The columns of T_l (n x r) are orthogonal to the states from which some attack keeps the
    next l samples (the state's own first) at zero:
    W_{l+1} = {x: C x + H d = 0 and A x + G d in W_l for some d},  W_0 = all, W_n = V*.

    Source: Basile and Marro (1992), the largest output-nulling controlled invariant.
    """
    n = len(s.A)
    found = [np.zeros((n, 0))]
    move, sense = np.hstack([s.A, s.G]), np.hstack([s.C, s.H])
    while True:
        pairs = kernel(np.vstack([sense, found[-1].T @ move]), s.size)
        told = complement(pairs[:n])
        if told.shape[1] <= found[-1].shape[1]:
            return found
        found.append(told)


def next_free(s: Scaled, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """After the sample at k: what is free of (x_k, d_k), and then of x_{k+1}.

    ``X`` (n x r): what was free of x_k before it. d_k had no prior at all.
    """
    n = len(s.A)
    pairs = kernel(np.hstack([s.C @ X, s.H]), s.size)
    split = X.shape[1]
    free = np.vstack([X @ pairs[:split], pairs[split:]])
    return free, span(s.A @ free[:n] + s.G @ free[n:], s.size)


def left_free(s: Scaled, first: np.ndarray) -> list[np.ndarray]:
    """What stays free of (x_k, d_k) given the samples up to k, for late k.

    ``first`` (n x r): what is free of the first state. The recursion is run until it repeats
    or, since it may move for ever, for 2 n steps, the last n of which are given: what is zero
    over n steps of a linear recursion of order n is zero always.
    """
    n = len(s.A)
    X, found = first, []
    for _ in range(2 * n + 1):
        free, new = next_free(s, X)
        found.append(free)
        if new.shape == X.shape and np.linalg.norm(new - X @ (X.T @ new)) <= TOLERANCE:
            return found[-1:]
        X = new
    return found[-n:]


def reached(s: Scaled) -> np.ndarray:
    """The states that an attack can reach from zero with no output before: S* (n x r)."""
    X = np.zeros((len(s.A), 0))
    while True:
        _, new = next_free(s, X)
        if new.shape[1] <= X.shape[1]:
            return X
        X = new


def modes(m: np.ndarray) -> list[tuple[complex, int]]:
    """The eigenvalues of ``m`` and how often each occurs, largest modulus first.

    Those that rounding has scattered are put together where m - z I is singular at their
    mean, which is as exact as a simple eigenvalue is.
    """
    left = [complex(z) for z in np.linalg.eigvals(m)]
    found = []
    while left:
        group, mean = next(filter(None, (_together(m, left, distance) for distance in NEAR)))
        found.append((mean, len(group)))
        left = [z for z in left if z not in group]
    return sorted(found, key=lambda mode: (-abs(mode[0]), -mode[0].real, -mode[0].imag))


def _together(
    m: np.ndarray, values: list[complex], distance: float
) -> tuple[list[complex], complex] | None:
    """The eigenvalues about the first, and their mean; None if they are not one repeated."""
    group = [z for z in values if abs(z - values[0]) <= distance * max(1.0, abs(z))]
    mean = complex(np.mean(group))
    if abs(mean.imag) <= TOLERANCE * abs(mean):
        mean = complex(mean.real)
    single = all(z == values[0] for z in group)
    return (group, mean) if single or kernel(m - mean * np.eye(len(m))).shape[1] else None


def legible(basis: np.ndarray) -> np.ndarray:
    """Another basis of the same span, the identity on as many rows as it has columns."""
    r = basis.shape[1]
    if r == 0:
        return basis
    order: np.ndarray = qr(basis.conj().T, mode="r", pivoting=True)[-1]
    pivots = np.sort(order[:r])
    found = np.linalg.solve(basis[pivots].T, basis.T).T
    found[pivots] = np.eye(r)
    return np.where(np.abs(found) > TOLERANCE, found, 0.0)
