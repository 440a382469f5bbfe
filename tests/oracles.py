"""Independent truths, written without any of the package's algebra.

Extended precision here is the 64-bit mantissa of `numpy.longdouble` on x86 (eps 1.1e-19).
"""

from typing import NamedTuple

import numpy as np

WIDE = np.longdouble


class Answer(NamedTuple):
    """Least-squares values of chosen functionals: value, covariance, which are determined."""

    value: np.ndarray
    cov: np.ndarray
    determined: np.ndarray
    condition: float


def cholesky(p: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor in the precision of ``p``."""
    n = len(p)
    lower = np.zeros_like(p)
    for j in range(n):
        lower[j, j] = np.sqrt(p[j, j] - lower[j, :j] @ lower[j, :j])
        for i in range(j + 1, n):
            lower[i, j] = (p[i, j] - lower[i, :j] @ lower[j, :j]) / lower[j, j]
    return lower


def forward(lower: np.ndarray, b: np.ndarray) -> np.ndarray:
    """X with L X = b."""
    x = np.zeros(b.shape, b.dtype)
    for i in range(len(lower)):
        x[i] = (b[i] - lower[i, :i] @ x[:i]) / lower[i, i]
    return x


def back(upper: np.ndarray, b: np.ndarray) -> np.ndarray:
    """X with U X = b."""
    x = np.zeros(b.shape, b.dtype)
    for i in range(len(upper) - 1, -1, -1):
        x[i] = (b[i] - upper[i, i + 1 :] @ x[i + 1 :]) / upper[i, i]
    return x


def pivoted_qr(matrix: np.ndarray, rhs: np.ndarray, tolerance: float):
    """Householder QR with column pivoting: R, Q'rhs, column order and rank."""
    work = np.column_stack([matrix, rhs]).astype(WIDE)
    columns = matrix.shape[1]
    if min(matrix.shape) == 0:
        return work, np.arange(columns), 0
    order = np.arange(columns)
    first = None
    for i in range(min(work.shape[0], columns)):
        norms = np.sum(work[i:, i:columns] ** 2, 0)
        j = i + int(np.argmax(norms))
        first = norms[j - i] if first is None else first
        if first == 0 or norms[j - i] <= (tolerance**2) * first:
            return work, order, i
        work[:, [i, j]] = work[:, [j, i]]
        order[[i, j]] = order[[j, i]]
        v = work[i:, i].copy()
        v[0] += np.copysign(np.sqrt(np.sum(v * v)), v[0])
        beta = 2 / np.sum(v * v)
        work[i:, i:] -= np.outer(beta * v, v @ work[i:, i:])
    return work, order, min(work.shape[0], columns)


def least_squares(matrix, rhs, tolerance=1e-11) -> Answer:
    """Minimise |matrix z - rhs|: values and covariances (M'M)^+ of z.

    An entry is determined if no z that ``matrix`` maps to zero moves it.
    """
    scale = column_norms(matrix)
    work, order, rank = pivoted_qr(matrix / scale, rhs, tolerance)
    upper, columns = work[:rank, :rank], matrix.shape[1]
    follow = back(upper, work[:rank, rank:columns])
    inverse = back(upper, np.eye(rank, dtype=WIDE))
    value = np.zeros(columns, WIDE)
    half = np.zeros((columns, rank), WIDE)
    determined = np.zeros(columns, bool)
    kept = order[:rank]
    value[kept] = back(upper, work[:rank, columns]) / scale[kept]
    half[kept] = inverse / scale[kept][:, None]
    determined[kept] = np.all(np.abs(follow) < 1e-9, 1)
    singular = np.linalg.svd(upper.astype(float), compute_uv=False)
    condition = float(singular[0] / singular[-1]) if rank else 1.0
    return Answer(value, half @ half.T, determined, condition)


def column_norms(matrix):
    norms = np.sqrt(np.sum(matrix.astype(WIDE) ** 2, 0))
    norms[norms == 0] = 1
    return norms


def eliminate(matrix, rhs, count, tolerance=1e-11):
    """The rows that are left of a least-squares problem when its first columns are solved for.

    Orthogonal elimination: minimising over z_1 leaves exactly these rows for z_2.
    """
    first = matrix[:, :count]
    work, _, rank = pivoted_qr(
        first / column_norms(first), np.column_stack([matrix[:, count:], rhs]), tolerance
    )
    rest, right = work[rank:, count:-1], work[rank:, -1]
    # what only rounding (1e-19) leaves of a column would look like information about it
    noise = np.abs(rest) < 1e-15 * column_norms(matrix[:, count:])
    return np.where(noise, 0, rest), right


def batch_estimate(m, x0, P0, u, y, seen, free_attack: bool = True, delay: int = 0) -> Answer:
    """Exact (x_k, d_{k-1-delay}, ..., d_k) from rows 1..k, every attack free (or none at all).

    One weighted least-squares problem in all of x_0..x_k and d_0..d_k (``m``: A, B, C, D, G,
    H, Q, R, constant), solved by orthogonal elimination in the order of time.
    """
    A, B, C, D, G, H, Q, R = (np.asarray(v, WIDE) for v in m)
    n, nd = A.shape[0], G.shape[1] if free_attack else 0
    G, H = G[:, :nd], H[:, :nd]
    eye, past = np.eye(n, dtype=WIDE), nd * (delay + 1)
    root_P, root_Q = cholesky(np.asarray(P0, WIDE)), cholesky(Q)
    # what is known of (x_k, d_{k-delay}, ..., d_k); of the attacks up to d_0 nothing is
    info = forward(root_P, np.hstack([eye, np.zeros((n, past), WIDE)]))
    rhs = forward(root_P, np.asarray(x0, WIDE))
    older = np.zeros((n, past - nd), WIDE)
    answer = None
    for inputs, sample, arrived in zip(u, y, np.asarray(seen, bool), strict=True):
        inputs = np.asarray(inputs, WIDE)
        # columns: x before | attacks before, x now, d now
        rows = [
            np.hstack([info, np.zeros((len(info), n + nd), WIDE)]),
            forward(root_Q, np.hstack([-A, older, -G, eye, np.zeros((n, nd), WIDE)])),
        ]
        right = [rhs, forward(root_Q, B @ inputs)]
        if arrived.any():
            root_R = cholesky(R[np.ix_(arrived, arrived)])
            still = np.zeros((arrived.sum(), n + past), WIDE)
            rows.append(forward(root_R, np.hstack([still, C[arrived], H[arrived]])))
            right.append(forward(root_R, (np.asarray(sample, WIDE) - D @ inputs)[arrived]))
        info, rhs = eliminate(np.vstack(rows), np.concatenate(right), n)
        answer = least_squares(info, rhs)
        info, rhs = eliminate(info, rhs, nd)
        state = np.r_[past - nd : past - nd + n]
        info = np.hstack([info[:, state], np.delete(info, state, 1)])
    order = np.r_[past : past + n, 0:past, past + n : past + n + nd]
    return Answer(
        answer.value[order],
        answer.cov[np.ix_(order, order)],
        answer.determined[order],
        answer.condition,
    )


class Nise(NamedTuple):
    """One row of `algorithm_1`; attacks as vectors over the plant's channels.

    ``told`` (d_{1,k}) and ``found`` (d_{2,k-1}); three log-likelihoods: of (15) with its
    normaliser, of the errata, and of a Kalman filter whose attacks have the prior.
    """

    x: np.ndarray
    P: np.ndarray
    told: np.ndarray
    told_cov: np.ndarray
    found: np.ndarray
    found_cov: np.ndarray
    paper: float
    errata: float
    kalman: float


def log_normal(v, cov) -> float:
    """The log-density of N(0, cov) at v."""
    whole = np.linalg.slogdet(cov)[1] + len(v) * np.log(2 * np.pi)
    return -0.5 * float(v @ np.linalg.solve(cov, v) + whole)


def output_split(F, R):
    """(6) or (7) for outputs that F d falsifies: T_1, T_2, singular values, V_1, V_2."""
    U, s, Vt = np.linalg.svd(F)
    r = int(np.sum(s > 1e-9 * max(1.0, np.max(s, initial=0.0))))
    U1, U2 = U[:, :r], U[:, r:]
    first = U1.T - U1.T @ R @ U2 @ np.linalg.solve(U2.T @ R @ U2, U2.T)
    return first, U2.T, s[:r], Vt[:r].T, Vt[r:].T


def algorithm_1(model, x, P, prior, u, y) -> list[Nise]:
    """NISE's Algorithm 1 after the errata, its SVDs as they stand, with eps in A, G and Q.

    ``model(k)``: the functions f(x, u, d), h(x, u), motion(x, u, d) = (A, G, Q) and sense(x, u) =
    (C, H, R) of row k; a channel that the mode does not use has zero columns. ``prior``: variances
    of the attacks. Every sample arrives, h is linear in what finds d_2, and what falsifies an
    output is found in its row or the next. d_0 is as free as any other.
    """
    x, P, nd = np.asarray(x, float), np.asarray(P, float), len(prior)
    joint, V1, V2, d1 = P, np.zeros((nd, 0)), np.eye(nd), np.zeros(0)
    D, rows = np.diag(prior), []
    for k, (inputs, sample) in enumerate(zip(u, y, strict=True), 1):
        f, h, motion, sense = model(k)
        A, G, Q = motion(x, inputs, V1 @ d1)
        blind = f(x, inputs, V1 @ d1)
        C, H, R = sense(blind, inputs)
        moves = np.hstack([A, G @ V1])
        before, nu = moves @ joint @ moves.T + Q, sample - h(blind, inputs)
        F, size = np.hstack([C @ G @ V2, H]), V2.shape[1]
        scale = np.block([[V2.T @ D @ V2, np.zeros((size, nd))], [np.zeros((nd, size)), D]])
        kalman = log_normal(nu, C @ before @ C.T + R + F @ scale @ F.T)
        # lines 1 to 5
        T1, T2, sigma, W1, W2 = output_split(H, R)
        S1, S2, bar, B1, _ = output_split(T2 @ C @ G @ V2, T2 @ R @ T2.T)
        to_2, to_3 = S1 @ T2, S2 @ T2
        G2, M2 = G @ V2 @ B1, np.diag(1 / bar)
        d2 = M2 @ to_2 @ nu
        C2, C3 = to_2 @ C, to_3 @ C
        keep = np.eye(len(x)) - G2 @ M2 @ C2
        noise_2 = M2 @ to_2 @ R @ to_2.T @ M2.T
        ahead = keep @ before @ keep.T + G2 @ noise_2 @ G2.T
        cross = -M2 @ C2 @ before @ keep.T + noise_2 @ G2.T
        cov_2 = M2 @ C2 @ before @ C2.T @ M2.T + noise_2
        predicted = blind + G2 @ d2
        # lines 6 to 8, and d2 smoothed
        nu_3, spread = to_3 @ nu - C3 @ G2 @ d2, C3 @ ahead @ C3.T + to_3 @ R @ to_3.T
        L = np.linalg.solve(spread, C3 @ ahead).T
        x = predicted + L @ nu_3
        left = np.eye(len(x)) - L @ C3
        P = left @ ahead @ left.T + L @ to_3 @ R @ to_3.T @ L.T
        smooth = np.linalg.solve(spread, C3 @ cross.T).T
        d2 = d2 + smooth @ nu_3
        cov_2 = cov_2 - smooth @ spread @ smooth.T
        # lines 9 to 12
        M1, C1 = np.diag(1 / sigma), T1 @ C
        d1 = M1 @ (T1 @ nu - C1 @ (x - blind))
        cov_1 = M1 @ (C1 @ P @ C1.T + T1 @ R @ T1.T) @ M1.T
        with_x = -P @ C1.T @ M1.T
        joint = np.block([[P, with_x], [with_x.T, cov_1]])
        # the evidence of the errata: d1 and d2 with their joint covariance
        both = (cross - smooth @ spread @ L.T) @ -(M1 @ C1).T
        attacks = np.concatenate([d2, d1])
        cov = np.block([[cov_2, both], [both.T, cov_1]])
        basis = V2 @ B1
        cov[: len(d2), : len(d2)] += basis.T @ D @ basis
        cov[len(d2) :, len(d2) :] += W1.T @ D @ W1
        paper = log_normal(nu_3, spread)
        errata = paper - np.sum(np.log(sigma)) - np.sum(np.log(bar)) + log_normal(attacks, cov)
        rows.append(
            Nise(x, P, W1 @ d1, W1 @ cov_1 @ W1.T, basis @ d2, basis @ cov_2 @ basis.T,
                 paper, float(errata), kalman)
        )  # fmt: skip
        V1, V2 = W1, W2
    return rows
