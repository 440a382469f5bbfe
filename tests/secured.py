"""For tests of the secure fusion: plants whose state stays small, and (31) in the paper's own
complex coordinates, from a Jordan form with distinct eigenvalues. Nothing here knows the bank.
"""

from typing import NamedTuple

import clarabel
import equinox as eqx
import jax
import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from fusion_problems import PAPER
from holdfast.plants.linear import LinearPlant
from holdfast.records import Observation
from systems import quiet_plant


def paper_plant() -> LinearPlant:
    """The paper's example, with an input for every state."""
    return quiet_plant(**PAPER, B=np.eye(3))


def complex_plant() -> LinearPlant:
    """A - K C A has a complex pair; R is correlated, D not zero."""
    rng = np.random.default_rng(5)
    A = np.array([[0.9, 0.5, 0.1], [-0.5, 0.9, 0.0], [0.0, 0.2, 0.8]])
    root = 0.4 * rng.normal(size=(4, 4))
    return quiet_plant(
        A=A, B=np.eye(3), C=rng.normal(size=(4, 3)), D=rng.normal(size=(4, 3)),
        Q=np.diag([1.0, 0.5, 0.3]), R=root @ root.T + np.eye(4),
    )  # fmt: skip


class Log(NamedTuple):
    """Inputs, samples and the true state of a run."""

    u: np.ndarray
    y: np.ndarray
    x: np.ndarray

    @property
    def all_seen(self):
        return self.u, self.y, np.ones(self.y.shape, bool)


def log(plant: LinearPlant, attack, steps: int, seed: int = 0) -> Log:
    """``attack``: (m,) or (steps x m). u = -A x cancels the state, which is then the noise alone
    (errata 8: an unstable one would lose all digits)."""
    rng = np.random.default_rng(seed)
    A, C, D, Q, R = (np.asarray(getattr(plant, name)) for name in "ACDQR")
    x = rng.normal(size=(steps, len(A))) @ np.linalg.cholesky(Q).T
    v = rng.normal(size=(steps, len(C))) @ np.linalg.cholesky(R).T
    u = -np.vstack([np.zeros(len(A)), x[:-1]]) @ A.T
    return Log(u, x @ C.T + u @ D.T + v + attack, x)


CHUNK = 100


@eqx.filter_jit
def _chunk(estimator, state, observations):
    def row(state, observation):
        state, estimate = estimator.step(state, observation)
        return state, (state, estimate)

    return jax.lax.scan(row, state, observations)


def followed(estimator, u, y, seen, trusted=None):
    """The states and the estimates of a log, in pieces: one compilation for any length."""
    log = Observation.of(u, np.where(seen, y, 0.0), seen, trusted)
    state, pieces = jax.tree.map(np.asarray, estimator.init()[0]), []
    steps = len(y)
    for k in range(0, steps, CHUNK):
        rows = np.minimum(np.arange(k, k + CHUNK), steps - 1)
        state, found = _chunk(estimator, state, jax.tree.map(lambda a, rows=rows: a[rows], log))
        pieces.append(jax.tree.map(np.asarray, found))
        state = jax.tree.map(np.asarray, state)
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:steps], *pieces)


def estimates(estimator, u, y, seen, trusted=None):
    """The estimates alone."""
    return followed(estimator, u, y, seen, trusted)[1]


class Paper(NamedTuple):
    """(9) to (29) for distinct eigenvalues ``z`` of A - K C A: G (m x n x n) by (18), the
    covariance ``W`` of the local errors by (29), both complex."""

    plant: LinearPlant
    z: np.ndarray
    G: np.ndarray
    W: np.ndarray
    K: np.ndarray
    P: np.ndarray

    @classmethod
    def of(cls, plant: LinearPlant, K: np.ndarray | None = None) -> "Paper":
        A, C, Q, R = (np.asarray(getattr(plant, name)) for name in "ACQR")
        n, m = len(A), len(C)
        before = solve_discrete_are(A.T, C.T, Q, R)
        if K is None:
            K = np.linalg.solve(C @ before @ C.T + R, C @ before).T
        z = np.linalg.eigvals(A - K @ C @ A)
        assert np.min(np.abs(z[:, None] - z) + np.eye(n)) > 1e-2
        G = np.stack([[row @ A @ np.linalg.inv(A - e * np.eye(n)) for e in z] for row in C])
        enters = (G - C[:, None, :]).reshape(m * n, n)
        noise = enters @ Q @ enters.conj().T + np.kron(R, np.ones((n, n)))
        W = solve_discrete_lyapunov(np.kron(np.eye(m), np.diag(z)), noise)
        return cls(plant, z, G, W, K, (np.eye(n) - K @ C) @ before)

    @property
    def stacked(self) -> np.ndarray:
        """G as one matrix."""
        return self.G.reshape(-1, len(self.z))

    def local(self, of: Log) -> np.ndarray:
        """(12) with inputs: the local estimates of every row (steps x m x n)."""
        B, C, D = (np.asarray(getattr(self.plant, name)) for name in "BCD")
        zeta, rows = np.zeros(self.G.shape[:2], complex), []
        enters = (self.G - C[:, None, :]) @ B
        for u, y in zip(of.u, of.y, strict=True):
            zeta = zeta * self.z + (y - D @ u)[:, None] + enters @ u
            rows.append(zeta)
        return np.array(rows)

    def without(self, zeta: np.ndarray, suspects: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Weighted least squares on the other sensors: x and its covariance."""
        m, n = self.G.shape[:2]
        rest = np.isin(np.arange(m), suspects, invert=True)
        rows = np.repeat(rest, n)
        G, W = self.stacked[rows], self.W[np.ix_(rows, rows)]
        weighed = np.linalg.solve(W, G)
        P = np.linalg.inv((G.conj().T @ weighed).real)
        return P @ (weighed.conj().T @ zeta.reshape(-1)[rows]).real, P

    def minimiser(self, zeta: np.ndarray, gamma: float, norm: str) -> np.ndarray:
        """x of (31) as it stands, by an interior-point method; v is eliminated, phi is not.

            minimise 1/2 |L^-1 (G x - phi - zeta)|^2 + gamma sum t,   |phi_j| <= t_j

        with W = L L^H, real and imaginary parts as variables, in units in which zeta is of
        size 1. "group": |X^-1/2 phi_i| <= t_i with the reachability Gramian X of (J, 1), which
        is the 2-norm in any basis where that of the sensor's filter is I.
        """
        m, n = self.G.shape[:2]
        N, unit = m * n, max(1.0, float(np.max(np.abs(zeta))))
        inverse = np.linalg.inv(np.linalg.cholesky(self.W))

        def real(M):
            return np.block([[M.real, -M.imag], [M.imag, M.real]])

        # the state is real
        residual = np.hstack([real(inverse @ self.stacked)[:, :n], -real(inverse)])
        target = real(inverse)[:, :N] @ zeta.reshape(-1).real
        target = target + real(inverse)[:, N:] @ zeta.reshape(-1).imag
        X = 1.0 / (1.0 - np.outer(self.z, self.z.conj()))
        half = np.linalg.inv(np.linalg.cholesky(X)) if norm == "group" else np.eye(n)
        sizes = m if norm == "group" else N
        members = np.arange(N).reshape(sizes, -1)
        weights = real(np.kron(np.eye(m), half))
        rows, cones = [], []
        for k, of in enumerate(members):
            both = np.concatenate([of, N + of])
            cone = np.zeros((1 + len(both), n + 2 * N + sizes))
            cone[0, n + 2 * N + k] = -1.0
            cone[1:, n : n + 2 * N] = -weights[both]
            rows.append(cone)
            cones.append(clarabel.SecondOrderConeT(len(cone)))
        pad = np.zeros((2 * N, sizes))
        residual = np.hstack([residual, pad])
        q = -residual.T @ target / unit
        q[n + 2 * N :] = gamma / unit
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-13
        settings.tol_ktratio = 1e-10
        settings.max_iter = 500
        A, P = sp.csc_matrix(np.vstack(rows)), sp.csc_matrix(np.triu(residual.T @ residual))
        found = clarabel.DefaultSolver(P, q, A, np.zeros(A.shape[0]), cones, settings).solve()
        # at these tolerances the last step may bring nothing; what it is worth the comparison says
        assert str(found.status) in ("Solved", "AlmostSolved", "InsufficientProgress"), found.status
        return unit * np.array(found.x)[:n]

    def violation(self, zeta, x, f, S, b, gamma: float, norm: str) -> float:
        """How far x and f (m x d, in the coordinates of the bank with S and b) are from the
        conditions that make them optimal for (31), relative to gamma (and G' mu to |G|).

        With v = G x - phi - zeta and mu = W^-1 v:  Re G^H mu = 0, |mu_j| <= gamma and
        mu_j = gamma phi_j / |phi_j| where phi_j is not zero; per sensor in its norm and its dual.
        phi = T f with the left eigenvectors t of S, t b = 1.
        """
        z, T = np.linalg.eig(S.T)
        T = T.T / (T.T @ b)[:, None]
        T = T[[int(np.argmin(np.abs(z - e))) for e in self.z]]
        phi = f @ T.T
        mu = np.linalg.solve(self.W, self.stacked @ x - (phi + zeta).reshape(-1))
        balance = np.max(np.abs((self.stacked.conj().T @ mu).real)) / np.max(np.abs(self.G))
        mu = mu.reshape(phi.shape)
        if norm == "group":
            half = np.linalg.cholesky(1.0 / (1.0 - np.outer(self.z, self.z.conj())))
            phi, mu = phi @ np.linalg.inv(half).T, mu @ half.conj()
        else:
            phi, mu = phi.reshape(-1, 1), mu.reshape(-1, 1)
        size = np.linalg.norm(phi, axis=1, keepdims=True)
        there = size[:, 0] > 1e-9 * np.max(size)
        off = np.linalg.norm(mu - gamma * phi / np.where(size > 0, size, 1.0), axis=1)
        over = np.linalg.norm(mu, axis=1) - gamma
        return float(max(balance, np.max(np.where(there, off, over)))) / gamma
