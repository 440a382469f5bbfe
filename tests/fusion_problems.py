"""The LASSO fusion (31) of DECOMPOSE as test problems: streams of local estimates with attacks,
optimality in extended precision, and (31) itself by a conic solver.

Nothing here is shared with the solvers under test but the matrix Z.
"""

from typing import NamedTuple

import clarabel
import numpy as np
import scipy.sparse as sp

from decomposed import covariance, decomposable, forgotten, similar
from holdfast.numerics.jordan import Coordinates
from holdfast.numerics.local import Local, decompose, least_squares
from holdfast.numerics.steady_state import steady_state

PAPER = {
    "A": np.diag([1.0, 1.0, -2.0]),
    "C": np.array([[1, 0, 0], [1, 1, -1], [1, 2, 1], [1, -1, -0.5], [-0.5, 1, 1]]),
    "Q": np.eye(3),
    "R": np.eye(5),
}


class Fusion(NamedTuple):
    """(31), eliminated: 1/2 |c - Z' phi|^2 + sum of weight |phi_g|, c = -``to_c`` zeta.

    ``back`` (d x d): phi of one sensor in the coordinates of the bank from the phi penalised.
    """

    local: Local
    Z: np.ndarray
    group: np.ndarray
    weight: np.ndarray
    back: np.ndarray
    to_c: np.ndarray

    @property
    def scalar(self) -> bool:
        """Whether every coordinate is a group of its own."""
        return len(self.weight) == len(self.Z)


def papers_example() -> Local:
    return decompose(**PAPER, K=steady_state(**PAPER).K)


def drawn(seed: int) -> Local:
    """Of `decomposed.decomposable`."""
    s = decomposable(seed)
    return decompose(s.A, s.C, s.Q, s.R, s.K)


def nearly_repeated(apart: float) -> Local:
    """Three states, six sensors, two of the eigenvalues ``apart``."""
    rng = np.random.default_rng(1)
    while True:
        M = similar(rng, np.diag([0.3, 0.3 + apart, -0.4]))
        C, P, R = rng.normal(size=(6, 3)) / np.sqrt(6), covariance(rng, 3), covariance(rng, 6)
        K = np.linalg.solve(C @ P @ C.T + R, C @ P).T
        A = np.linalg.solve(np.eye(3) - K @ C, M)
        if forgotten(A, M) < 1e3:
            return decompose(A, C, covariance(rng, 3), R, K)


def fusion(local: Local, norm: str = "l1") -> Fusion:
    """With the paper's l1 norm, the l1 norm of the bank's own coordinates ("own"), or the
    2-norm of each sensor ("sensor")."""
    m, d = local.sensors, len(local.b)
    found: Coordinates = local.coordinates
    if norm == "sensor":
        back, groups, weight = np.eye(d), np.zeros(d, int), np.ones(1)
    elif norm == "own":
        back, groups, weight = np.eye(d), np.arange(d), np.ones(d)
    else:
        back, groups, weight = np.linalg.inv(found.rows), found.group, found.weight
    Z = least_squares(local.G, local.W).Z
    mapped = np.einsum("de,mdr->mer", back, Z.reshape(m, d, -1)).reshape(m * d, -1)
    group = (groups + len(weight) * np.arange(m)[:, None]).reshape(-1)
    return Fusion(local, mapped, group, np.tile(weight, m), back, Z.T)


def stream(
    local: Local, rng: np.random.Generator, steps: int, sizes: np.ndarray, most: int = 2
) -> np.ndarray:
    """Local estimates (steps x N) of x = 0, the errors drawn as they are correlated in time.

    From time to time ``most`` sensors at most are attacked, each by a constant out of
    ``sizes`` and noise of that size, then again none.
    """
    S, b, m = local.S, local.b, local.sensors
    whole = np.kron(np.eye(m), S)
    values, vectors = np.linalg.eigh(local.W - whole @ local.W @ whole.T)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    error = np.linalg.cholesky(local.W) @ rng.normal(size=len(whole))
    moved, bias, shake, found = np.zeros((m, len(b))), np.zeros(m), np.zeros(m), []
    for _ in range(steps):
        if rng.random() < 0.08:
            struck = rng.permutation(m)[: rng.integers(most + 1)]
            bias, shake = np.zeros(m), np.zeros(m)
            bias[struck] = rng.choice(sizes, len(struck)) * rng.choice([-1.0, 1.0], len(struck))
            shake[struck] = bias[struck] * rng.choice([0.0, 0.1], len(struck))
        error = whole @ error + root @ rng.normal(size=len(whole))
        moved = moved @ S.T + np.outer(bias + shake * rng.normal(size=m), b)
        found.append(moved.reshape(-1) - error)
    return np.array(found)


class Problems(NamedTuple):
    """Problems of one `Fusion`, one for each entry of the first axis."""

    of: Fusion
    zeta: np.ndarray
    w: np.ndarray
    c: np.ndarray


def problems(of: Fusion, seed: int, steps: int, largest: float = 1e8) -> Problems:
    """A stream with attacks of 1 to ``largest``; gamma from 0.03 to 30, new every ten steps."""
    rng = np.random.default_rng(seed)
    zeta = stream(of.local, rng, steps, 10.0 ** np.arange(0, np.log10(largest) + 0.5))
    gamma = np.exp(np.repeat(rng.uniform(np.log(0.03), np.log(30), -(-steps // 10)), 10)[:steps])
    return Problems(of, zeta, gamma[:, None] * of.weight, -zeta @ of.to_c.T)


def violations(given: Problems, f: np.ndarray) -> np.ndarray:
    """`missed` of each, relative."""
    pairs = [
        missed(given.of.Z, given.of.group, w, c, phi)
        for w, c, phi in zip(given.w, given.c, f, strict=True)
    ]
    return np.array([worst / scale for worst, scale in pairs])


def rounded(given: Problems, f: np.ndarray) -> np.ndarray:
    """What rounding f alone may make of `violations`: eps |Z| |Z'| |f|."""
    Z, group = np.abs(given.of.Z), given.of.group
    eps = np.finfo(float).eps
    found = [
        eps * np.max(norms(Z @ (Z.T @ np.abs(phi)), group))
        / (np.max(w) + np.max(norms(given.of.Z @ c, group)))
        for w, c, phi in zip(given.w, given.c, f, strict=True)
    ]  # fmt: skip
    return np.array(found)


def norms(v: np.ndarray, group: np.ndarray) -> np.ndarray:
    """2-norms of the groups."""
    squares = np.zeros(group.max() + 1, v.dtype)
    np.add.at(squares, group, v * v)
    return np.sqrt(squares)


def missed(Z, group, w, c, f) -> tuple[float, float]:
    """Violation of the conditions of optimality, and what it is compared with: the largest
    w + the largest |Z_g c|; in extended precision (64 bits of mantissa).

    With g = Z (Z' f - c) = M (zeta + phi): |g_k| <= w_k, and g_k = -w_k f_k / |f_k| where f_k
    is not zero.
    """
    Z, w, c, f = (np.asarray(a, np.longdouble) for a in (Z, w, c, f))
    gradient = Z @ (Z.T @ f - c)
    size = norms(f, group)
    there = size > 0
    unit = f / np.where(there, size, 1)[group]
    off = norms(gradient + w[group] * unit, group)
    over = norms(gradient, group) - w
    worst = np.max(np.where(there, off, np.maximum(over, 0)))
    return float(worst), float(np.max(w) + np.max(norms(Z @ c, group)))


def objective(Z, group, w, c, f) -> float:
    Z, w, c, f = (np.asarray(a, np.longdouble) for a in (Z, w, c, f))
    p = c - Z.T @ f
    return float(p @ p / 2 + w @ norms(f, group))


class Conic(NamedTuple):
    """The value of (31) and its minimiser; ``gap`` to the dual value, relative."""

    objective: float
    gap: float
    x: np.ndarray
    phi: np.ndarray


def conic(of: Fusion, w: np.ndarray, zeta: np.ndarray) -> Conic:
    """(31) as it stands, x and phi its variables, by an interior-point method.

        minimise  1/2 v' W^-1 v + w' t    zeta = G x - v - phi,  |phi_g| <= t_g

    in units in which zeta is of size 1, and the second time the value as well: else the
    tolerances mean little. Variables: u with v = L u, W = L L'; x; phi as penalised; t.
    """
    G, L = of.local.G, np.linalg.cholesky(of.local.W)
    N, n, g = len(zeta), G.shape[1], len(w)
    unit = max(1.0, float(np.max(np.abs(zeta))))
    back = np.kron(np.eye(of.local.sensors), of.back)
    equal = np.hstack([-L, G, -back, np.zeros((N, g))])
    rows, cones = [equal], [clarabel.ZeroConeT(N)]
    for k in range(g):
        members = np.flatnonzero(of.group == k)
        cone = np.zeros((1 + len(members), N + n + N + g))
        cone[0, N + n + N + k] = -1.0
        cone[1 + np.arange(len(members)), N + n + members] = -1.0
        rows.append(cone)
        cones.append(clarabel.SecondOrderConeT(len(cone)))
    A = sp.csc_matrix(np.vstack(rows))
    right = np.concatenate([zeta / unit, np.zeros(A.shape[0] - N)])
    value = 1.0
    for _ in range(2):
        P = sp.block_diag([sp.eye(N) / value, sp.csc_matrix((n + N + g,) * 2)], format="csc")
        found = _solved(P, np.append(np.zeros(N + n + N), w / unit / value), A, right, cones)
        value *= found.obj_val
    gap = abs(found.obj_val - found.obj_val_dual) / abs(found.obj_val)
    z = unit * np.array(found.x)
    return Conic(value * unit**2, gap, z[N : N + n], z[N + n : 2 * N + n])


def _solved(P, q, A, right, cones):
    """To the tightest tolerance that the solver reaches by its own account; cones are hard."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    for tolerance in (1e-11, 1e-10):
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
        found = clarabel.DefaultSolver(P, q, A, right, cones, settings).solve()
        if str(found.status) == "Solved":
            return found
    raise AssertionError(found.status)
