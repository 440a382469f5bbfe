"""The local decomposition: every equation of the paper, and the bank against the filter.

Tolerances: the 200 systems are drawn so that x is made of terms at most 1e3 times as large
(`decomposed.forgotten`), twice, in F and in G; with 2e-16 a step that is 2e-10 at the very
worst, and some 1e-12 as it comes.
"""

import mpmath as mp
import numpy as np
import pytest
from scipy.linalg import block_diag, solve_discrete_lyapunov

from decomposed import COUNT, KINDS, decomposable, kalman_with, order
from holdfast.numerics.local import (
    Unfit,
    bank_covariance,
    decompose,
    input_normal,
    least_squares,
    stein,
)
from holdfast.numerics.steady_state import steady_state


@pytest.fixture(scope="module")
def systems():
    drawn = [decomposable(seed) for seed in range(COUNT)]
    return [(s, decompose(s.A, s.C, s.Q, s.R, s.K)) for s in drawn]


def parts(s, local):
    """F (m x n x d) and G (m x d x n) by sensor, and M."""
    n, m = s.K.shape
    F = local.F.reshape(n, m, len(local.b)).transpose(1, 0, 2)
    return F, local.G.reshape(m, -1, n), s.A - s.K @ s.C @ s.A


def relative(found, truth):
    return np.max(np.abs(found - truth)) / np.max(np.abs(truth))


POLES = {
    "none": [],
    "zeros": [0, 0, 0],
    "reals": [0.3, -0.5, 0.3],
    "pairs": [0.4 + 0.3j, 0.4 + 0.3j, -0.2 + 0.1j],
    "near the circle": [1 - 1e-9, -1 + 1e-9, (1 - 1e-9) * np.exp(1j), 0.5],
    "many": list(np.linspace(-0.95, 0.95, 12)),
    "a pair that is nearly real": [0.5 + 1e-9j, -0.99 + 1e-12j],
}


@pytest.mark.parametrize("name", POLES)
def test_input_normal(name):
    """[S b] has orthonormal rows; the poles are those asked for: prod (S - p) = 0.

    Rounding of each of up to 12 sections. The diagonal of S is real by construction.
    """
    poles = [complex(p) for p in POLES[name]]
    S, b = input_normal(poles)
    whole = [*poles, *(p.conjugate() for p in poles if p.imag)]
    assert len(S) == len(b) == len(whole)
    np.testing.assert_allclose(S @ S.T + np.outer(b, b), np.eye(len(b)), atol=1e-14)
    product = np.eye(len(b), dtype=complex)
    for p in whole:
        product = product @ (S - p * np.eye(len(b)))
    np.testing.assert_allclose(product, 0.0, atol=1e-14)
    assert np.trace(S) == pytest.approx(sum(whole).real, abs=1e-14)


def test_bank_equals_the_filter(systems):
    """60 steps with inputs through B and D and x0 not zero: the issue's figure, 1e-10.

    Measured: at worst 2e-12 of the largest estimate.
    """
    worst = []
    for seed, (s, local) in enumerate(systems):
        F, G, _ = parts(s, local)
        rng = np.random.default_rng(seed)
        x, zeta = s.x0, G @ s.x0
        enters = (G - np.multiply.outer(s.C, local.b).transpose(0, 2, 1)) @ s.B
        error, size = np.max(np.abs(np.einsum("mid,md->i", F, zeta) - x)), np.max(np.abs(x))
        for _ in range(60):
            u, y = rng.normal(size=2), rng.normal(size=len(s.C))
            before = s.A @ x + s.B @ u
            x = before + s.K @ (y - s.D @ u - s.C @ before)
            zeta = zeta @ local.S.T + np.multiply.outer(y - s.D @ u, local.b) + enters @ u
            error = max(error, np.max(np.abs(np.einsum("mid,md->i", F, zeta) - x)))
            size = max(size, np.max(np.abs(x)))
        worst.append(error / size)
    print(f"bank and filter differ by at most {max(worst):.2g} (system {np.argmax(worst)})")
    assert max(worst) < 1e-10


def test_equations_of_the_decomposition(systems):
    """F_i S = M F_i, F_i b = K_i; (20) G_i A - S G_i = b C_i A; (21) sum F_i G_i = I.

    The equations to rounding: 1e-14, 4e-14. Their solution, (21), has its condition: 3e-11.
    """
    for s, local in systems:
        F, G, M = parts(s, local)
        d = len(local.b)
        np.testing.assert_allclose(
            local.S @ local.S.T + np.outer(local.b, local.b), np.eye(d), atol=1e-14
        )
        assert np.max(np.abs(F @ local.S - M @ F)) < 1e-12 * np.max(np.abs(F))
        assert np.max(np.abs(F @ local.b - s.K.T)) < 1e-12 * np.max(np.abs(F))
        drive = local.b[:, None] * (s.C @ s.A)[:, None, :]
        assert np.max(np.abs(G @ s.A - local.S @ G - drive)) < 1e-12 * np.max(np.abs(G))
        np.testing.assert_allclose(local.F @ local.G, np.eye(len(s.A)), atol=1e-10)
        assert local.sensors == len(s.C)
        if s.structure is not None:  # the order is that of the minimal polynomial
            assert d == sum(sizes[0] * order(value) for value, sizes in s.structure)


def test_covariances(systems):
    """W by SciPy's Lyapunov solver; W >= R x I; F W F' = P, the filter's own; P likewise.

    Measured: W 7e-15 of its largest entry, P 3e-13, F W F' 1e-12.
    """
    for s, local in systems:
        n, m = s.K.shape
        d = len(local.b)
        enters = local.G - np.kron(s.C, local.b[:, None])
        noise = enters @ s.Q @ enters.T + np.kron(s.R, np.outer(local.b, local.b))
        whole = np.kron(np.eye(m), local.S)
        if m * d <= 60:
            assert relative(local.W, solve_discrete_lyapunov(whole, noise)) < 1e-11
        assert relative(local.W - whole @ local.W @ whole.T, noise) < 1e-12 * max(
            1.0, np.max(np.abs(local.W)) / np.max(np.abs(noise))
        )
        assert np.array_equal(local.W, local.W.T)
        least = np.linalg.eigvalsh(local.W - np.kron(s.R, np.eye(d)))[0]
        assert least > -1e-14 * np.linalg.norm(local.W, 2)
        left = np.eye(n) - s.K @ s.C
        P = solve_discrete_lyapunov(left @ s.A, left @ s.Q @ left.T + s.K @ s.R @ s.K.T)
        assert relative(local.P, P) < 1e-11
        assert relative(local.F @ local.W @ local.F.T, P) < 1e-10


def kalman_checks(local, P):
    """(41) F W = P G', least squares is F, and what it leaves over, as relative errors."""
    cross = P @ local.G.T
    fused = least_squares(local.G, local.W)
    precision = np.linalg.inv(local.W)
    left = precision @ (np.eye(len(local.W)) - local.G @ local.F)
    normal = fused.Z.T @ local.W @ fused.Z
    return {
        "(41)": relative(local.F @ local.W, cross),
        "fusion": relative(fused.F, local.F),
        "left over": np.linalg.norm(fused.Z @ fused.Z.T - left) / np.linalg.norm(precision),
        "normal": np.max(np.abs(normal - np.eye(len(normal))), initial=0),
    }


def test_kalman_gain_is_the_least_squares_fusion(systems):
    """Theorem 2, with P from the Riccati equation. Measured: (41) 3e-14, fusion 1e-14,
    what is left over 4e-13; the condition of W is up to 1e5."""
    for s, local in systems:
        if s.kind != "kalman":
            continue
        P = steady_state(s.A, s.C, s.Q, s.R).P
        assert relative(local.P, P) < 1e-12
        for name, error in kalman_checks(local, P).items():
            assert error < 1e-11, (name, error)


@pytest.mark.parametrize("structure", [
    [(0.3, (2,)), (-0.2, (1,))], [(0.25, (3,))], [(0.2 + 0.15j, (2,))],
    [(0.3, (1, 1)), (0.1, (2,))],
])  # fmt: skip
def test_theorem_2_with_repeated_eigenvalues(structure):
    """A of these comes closer to M: solving with W costs its condition, up to 4e8."""
    k = kalman_with(np.random.default_rng(3), structure, 4)
    assert relative(steady_state(k.A, k.C, k.Q, k.R).K, k.K) < 1e-12
    local = decompose(k.A, k.C, k.Q, k.R, k.K)
    tolerance = 1e-12 + np.finfo(float).eps * np.linalg.cond(local.W)
    for name, error in kalman_checks(local, k.P).items():
        assert error < (1e-11 if name == "(41)" else tolerance), (name, error)
    assert local.derogatory == any(len(sizes) > 1 for _, sizes in structure)


def test_a_gain_that_is_3_percent_off_is_seen(systems):
    """(20) and (21) hold for every gain; these know the gain. With one state or one sensor the
    fusion is decided by (21) and by the ratios of the gains alone."""
    off = 0
    for s, _ in systems:
        if s.kind != "kalman":
            continue
        P = steady_state(s.A, s.C, s.Q, s.R).P
        other = decompose(s.A, s.C, s.Q, s.R, 1.03 * s.K)
        errors = kalman_checks(other, P)
        assert errors["(41)"] > 1e-4
        assert min(s.K.shape) == 1 or errors["fusion"] > 1e-4
        assert relative(other.P, P) > 1e-5
        assert np.trace(other.P) > np.trace(P)
        F, _, _ = parts(s, other)
        assert relative(F @ other.b, s.K.T) == pytest.approx(0.03, rel=1e-6)
        off += 1
    assert off == COUNT // len(KINDS)


# ---- the paper's own coordinates, from a Jordan form that is known


def chains(J):
    """First and last row of each block of J."""
    ends = [i for i in range(len(J)) if i + 1 == len(J) or J[i, i + 1] == 0]
    return zip([0, *(e + 1 for e in ends[:-1])], ends, strict=True)


def paper_G(C, A, J):
    """(18) for each sensor: C_i A ((A - z)^-h + ... + (A - z)^-1) at height h of a block."""
    n = len(A)
    G = np.zeros((len(C), len(J), n), complex)
    for first, last in chains(J):
        inverse = np.linalg.inv(A - J[first, first] * np.eye(n))
        total, power = np.zeros((n, n)), np.eye(n)
        for row in range(last, first - 1, -1):
            power = power @ inverse
            total = total + power
            G[:, row] = C @ A @ total
    return G


def paper_F(V, J, K):
    """(13) and (14): x_h on the h-th diagonal from the corner, the differences of V^-1 K."""
    right = np.linalg.solve(V, K.astype(complex))
    X = np.zeros((K.shape[1], len(J), len(J)), complex)
    for first, last in chains(J):
        size = last - first + 1
        for up in range(size):
            below = right[last - up + 1] if up else 0.0
            x = right[last - up] - below
            for row in range(size - up):
                X[:, first + row, first + row + up] = x
    return V @ X


DEFECTIVE = {
    "real": [(0.3, (2,)), (-0.2, (1,))],
    "real, three": [(0.25, (3,))],
    "complex": [(0.2 + 0.15j, (2,))],
    "complex, simple": [(0.2 + 0.3j, (1,)), (0.1, (1,))],
}


@pytest.mark.parametrize("name", DEFECTIVE)
def test_papers_proof_needs_the_conjugate_transpose(name):
    """(36), (39) and (40) hold with J^H and fail with the printed J, where J is not real diagonal.

    Everything in the paper's own coordinates; W by SciPy's Lyapunov solver.
    """
    for seed in range(5):
        k = kalman_with(np.random.default_rng(seed), DEFECTIVE[name], 3)
        n, m = k.K.shape
        M, J, one = k.A - k.K @ k.C @ k.A, k.J, np.ones(len(k.J))
        G, F = paper_G(k.C, k.A, J), paper_F(k.V, J, k.K)
        for i in range(m):  # (20) and Theorem 1
            np.testing.assert_allclose(
                G[i] @ k.A - np.outer(one, k.C[i] @ k.A), J @ G[i], atol=1e-11
            )
            np.testing.assert_allclose(F[i] @ J, M @ F[i], atol=1e-12)
            np.testing.assert_allclose(F[i] @ one, k.K[:, i], atol=1e-12)
        np.testing.assert_allclose(np.sum(F @ G, 0), np.eye(n), atol=1e-11)
        enters = (G - k.C[:, None, :]).reshape(m * n, n)
        noise = enters @ k.Q @ enters.conj().T + np.kron(k.R, np.ones((n, n)))
        W = solve_discrete_lyapunov(np.kron(np.eye(m), J), noise).reshape(m, n, m, n)
        for j in range(m):
            enter = (np.eye(n) - k.K @ k.C) @ k.Q @ (G[j] - np.outer(one, k.C[j])).conj().T
            rest = enter + np.outer(k.K @ k.R[:, j], one)
            PG = k.P @ G[j].conj().T
            summed = np.einsum("iab,ibc->ac", F, W[:, :, j])
            size = np.max(np.abs(PG))
            for both in (PG, summed):  # (36), (40)
                assert np.max(np.abs(both - M @ both @ J.conj().T - rest)) < 1e-12 * size
                assert np.max(np.abs(both - M @ both @ J - rest)) > 1e-4 * size
            assert np.max(np.abs(PG - summed)) < 1e-11 * size  # (41)
            for i in range(m):  # (39)
                Wij = W[i, :, j]
                entered = noise.reshape(m, n, m, n)[i, :, j]
                size_W = np.max(np.abs(Wij))
                assert np.max(np.abs(Wij - J @ Wij @ J.conj().T - entered)) < 1e-12 * size_W
                assert np.max(np.abs(Wij - J @ Wij @ J - entered)) > 1e-4 * size_W


@pytest.mark.parametrize("structure", [
    *DEFECTIVE.values(), [(0.3, (2, 1)), (0.1, (1,))], [(0.2 + 0.3j, (1, 1))],
])  # fmt: skip
def test_papers_coordinates(structure):
    """G and W of the paper (18), (29) are those of the bank, mapped; W~ is singular exactly if
    an eigenvalue has two blocks, and the bank's own W never is (errata 3)."""
    k = kalman_with(np.random.default_rng(1), structure, 3)
    local = decompose(k.A, k.C, k.Q, k.R, k.K)
    n, m = k.K.shape
    full = paper_G(k.C, k.A, k.J)
    papers = np.concatenate([full.real, full.imag], 1)
    for mine in local.paper_G().transpose(1, 0, 2):  # one row of all sensors
        errors = np.max(np.abs(papers.transpose(1, 0, 2) - mine), (1, 2))
        assert np.min(errors) < 1e-11 * np.max(np.abs(full))
    enters = (full - k.C[:, None, :]).reshape(m * n, n)
    noise = enters @ k.Q @ enters.conj().T + np.kron(k.R, np.ones((n, n)))
    W = solve_discrete_lyapunov(np.kron(np.eye(m), k.J), noise)
    least = np.linalg.eigvalsh(W)[0] / np.linalg.norm(W, 2)
    assert (least < 1e-13) == local.derogatory
    assert np.linalg.eigvalsh(local.W)[0] >= np.linalg.eigvalsh(k.R)[0] - 1e-12


# ---- the paper's example


PAPER = {
    "A": np.diag([1.0, 1.0, -2.0]),
    "C": np.array([[1, 0, 0], [1, 1, -1], [1, 2, 1], [1, -1, -0.5], [-0.5, 1, 1]]),
    "Q": np.eye(3),
    "R": np.eye(5),
}
PRINTED_K = [
    [0.2443, 0.0431, 0.1942, 0.2693, -0.0885],
    [-0.0838, 0.2494, 0.1469, -0.1991, 0.0846],
    [0.1175, -0.4272, 0.2265, 0.0629, 0.1955],
]
PRINTED_P = [[0.2443, -0.0838, 0.1175], [-0.0838, 0.1879, -0.1452], [0.1175, -0.1452, 0.3995]]
PRINTED_G = [
    [[0.7783, 0, 0], [1.1187, 0, 0], [1.2384, 0, 0]],
    [[0.7783, 0.7783, -1.1660], [1.1187, 1.1187, -0.9496], [1.2384, 1.2384, -0.9122]],
    [[0.7783, 1.5567, 1.1660], [1.1187, 2.2373, 0.9496], [1.2384, 2.4768, 0.9122]],
    [[0.7783, -0.7783, -0.5830], [1.1187, -1.1187, -0.4748], [1.2384, -1.2384, -0.4561]],
    [[-0.3892, 0.7783, 1.1660], [-0.5593, 1.1187, 0.9496], [-0.6192, 1.2384, 0.9122]],
]


def test_the_papers_numbers():
    """Half a unit of the last printed digit; the rows of G are those of -0.2848, 0.1061, 0.1925."""
    found = steady_state(**PAPER)
    local = decompose(**PAPER, K=found.K)
    printed = {"rtol": 0, "atol": 0.5e-4}
    np.testing.assert_allclose(found.K, PRINTED_K, **printed)
    np.testing.assert_allclose(local.P, PRINTED_P, **printed)
    np.testing.assert_allclose(np.trace(local.P), 0.8317, **printed)
    values = [block.value.real for block in local.structure]
    np.testing.assert_allclose(values, [-0.2848, 0.1925, 0.1061], **printed)
    np.testing.assert_allclose(local.paper_G()[:, [0, 2, 1]], PRINTED_G, **printed)
    assert local.coordinates.weight.tolist() == [1.0, 1.0, 1.0]
    assert not local.derogatory
    assert local.sensors == 5


# ---- extended precision


def wide(matrix):
    return mp.matrix(np.asarray(matrix).tolist())


def kron(a, b):
    out = mp.zeros(a.rows * b.rows, a.cols * b.cols)
    for i in range(a.rows):
        for j in range(a.cols):
            for p in range(b.rows):
                for q in range(b.cols):
                    out[i * b.rows + p, j * b.cols + q] = a[i, j] * b[p, q]
    return out


def column(matrix):
    """Rows one after the other, so that vec(X Y Z) = (X kron Z') vec(Y)."""
    return mp.matrix([matrix[i, j] for i in range(matrix.rows) for j in range(matrix.cols)])


def narrow(vector, rows):
    return np.array([float(v) for v in vector]).reshape(rows, -1)


def test_extended_precision(systems):
    """F, G, W of the smaller systems from 40 digits, of the same (S, b).

    G is exact to rounding times the 1e3 of `forgotten`, with those of the norms of A.
    """
    small = [(s, local) for s, local in systems if len(s.A) <= 4][::4]
    assert len({s.kind for s, _ in small}) >= 5
    for s, local in small:
        n, m, d = len(s.A), len(s.C), len(local.b)
        with mp.workdps(40):
            A, C, K, S, b = (wide(x) for x in (s.A, s.C, s.K, local.S, local.b[:, None]))
            M = A - K * C * A
            of_F, of_G = mp.eye(n * d) - kron(M, S), kron(mp.eye(d), A.T) - kron(S, mp.eye(n))
            F, G = [], []
            for i in range(min(m, 3)):
                F.append(narrow(mp.lu_solve(of_F, column(K[:, i] * b.T)), n))
                G.append(narrow(mp.lu_solve(of_G, column(b * (C[i, :] * A))), d))
        mine_F, mine_G, _ = parts(s, local)
        assert relative(mine_F[:3], np.array(F)) < 1e-12
        assert relative(mine_G[:3], np.array(G)) < 1e-11


# ---- what has no decomposition


def unfit(A, C, Q, K=None):
    A, C = np.asarray(A, float), np.atleast_2d(np.asarray(C, float))
    R = np.eye(len(C))
    if K is None:
        K = steady_state(A, C, Q, R).K
    with pytest.raises(Unfit) as caught:
        decompose(A, C, Q, R, K)
    return str(caught.value)


def test_shared_eigenvalues_are_refused():
    eye = np.eye(2)
    assert "share the eigenvalue 0.5" in unfit(np.diag([0.9, 0.5]), [1, 0], eye)
    assert "share the eigenvalue 0.5" in unfit(np.diag([0.9, 0.5]), [1, 1], np.diag([1.0, 0]))
    assert "share the eigenvalue 0:" in unfit(np.diag([0.9, 0.0]), [1, 1], eye)
    assert "share the eigenvalue 0:" in unfit(np.zeros((2, 2)), [1, 1], eye)
    pair = block_diag(0.9, [[0.3, 0.4], [-0.4, 0.3]])
    assert "share the eigenvalue 0.3+0.4j" in unfit(pair, [1, 0, 0], np.eye(3))
    # one sensor and two modes of the same eigenvalue: one combination is never seen
    assert "share the eigenvalue 0.5" in unfit(0.5 * eye, [1, 1], eye)
    # a gain of zero corrects nothing
    assert "share the eigenvalue" in unfit(0.5 * eye, eye, eye, np.zeros((2, 2)))


@pytest.mark.parametrize("value", [0.0, 0.5])
@pytest.mark.parametrize("size", [2, 3, 4])
def test_a_shared_block_is_refused(value, size):
    """Rounding scatters a repeated eigenvalue of A and of M differently: no two come close,
    and only sum F_i G_i, which is not I, tells. At 0 it is a chain of delays."""
    A = block_diag(0.9, value * np.eye(size) + np.eye(size, k=1))
    n = size + 1
    C = np.eye(1, n) if value else np.ones((1, n))
    for seed in range(5):
        U = np.linalg.qr(np.random.default_rng(seed).normal(size=(n, n)))[0]
        unit = 10.0 ** np.random.default_rng(seed).integers(-3, 4, n)
        assert "shar" in unfit(U @ A @ U.T * unit / unit[:, None], C @ U.T * unit,
                               U @ U.T / np.outer(unit, unit))  # fmt: skip


def test_an_unstable_filter_is_refused():
    text = unfit([[1.2]], [[1.0]], np.eye(1), np.array([[-0.1]]))
    assert "modulus 1.32, not < 1" in text


def test_close_but_not_shared_is_decomposed():
    """A mode of A corrected by 1e-5 of itself: the sum still is I to 1e-7."""
    A, K = np.diag([0.9, 0.5]), np.diag([0.4, 1e-5])
    local = decompose(A, np.eye(2), np.eye(2), np.eye(2), K)
    np.testing.assert_allclose(local.F @ local.G, np.eye(2), atol=1e-7)


# ---- the solvers


def test_stein_close_to_the_circle():
    """X = sum M^k added S'^k where both have modulus 1 - 1e-7: X is 1e7 times what is added."""
    M = np.array([[1 - 1e-7]])
    X = stein(M, M, np.ones((1, 1, 1)))
    np.testing.assert_allclose(X, 1 / (1 - M[None] ** 2), rtol=1e-8)
    assert np.array_equal(
        stein(np.eye(2) * 0, np.eye(2) * 0, np.ones((1, 2, 2)))[0], np.ones((2, 2))
    )


def test_bank_covariance_is_a_sum():
    rng = np.random.default_rng(0)
    S, _ = input_normal([0.3 + 0.4j, -0.5])
    root = rng.normal(size=(6, 6))
    noise, whole, total = root @ root.T, np.kron(np.eye(2), S), np.zeros((6, 6))
    for k in range(200):
        power = np.linalg.matrix_power(whole, k)
        total += power @ noise @ power.T
    np.testing.assert_allclose(bank_covariance(S, noise), total, rtol=0, atol=1e-12 * total.max())


def test_least_squares_is_weighted_regression():
    rng = np.random.default_rng(0)
    G, root = rng.normal(size=(7, 3)), rng.normal(size=(7, 7))
    W = root @ root.T + np.eye(7)
    F, Z = least_squares(G, W)
    precision = np.linalg.inv(W)
    np.testing.assert_allclose(F, np.linalg.solve(G.T @ precision @ G, G.T @ precision), atol=1e-12)
    np.testing.assert_allclose(Z @ Z.T, precision @ (np.eye(7) - G @ F), atol=1e-12)
    np.testing.assert_allclose(Z.T @ G, 0.0, atol=1e-12)
