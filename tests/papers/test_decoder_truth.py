"""What the rows of DECODER are computed with, against independent computations."""

import itertools

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.optimize import linprog

from holdfast.papers import decoder_coding as coding
from holdfast.papers.decoder_algebra import fewest_units
from holdfast.papers.decoder_appendix import determinant
from holdfast.papers.decoder_design import isometry
from holdfast.papers.decoder_exact import bound, case, cases, relation, supports, window
from holdfast.papers.decoder_programs import parted, worst_ratio


def least_sum(Phi, y):
    """The x of (12) and its objective, by HiGHS on the primal."""
    m, n = Phi.shape
    cost = np.append(np.zeros(n), np.ones(m))
    A = np.block([[Phi, -np.eye(m)], [-Phi, -np.eye(m)]])
    found = linprog(cost, A, np.append(y, -y), bounds=[(None, None)] * n + [(0, None)] * m)
    return found.x[:n], found.fun


@pytest.mark.parametrize("seed", range(12))
def test_supports_are_those_of_all_sets_of_rows(seed):
    """The sets of zeros are the closed sets of rows of less than full rank, one by one."""
    rng = default_rng(seed)
    N, n = 7, 2 + seed % 2
    rows = rng.integers(-1, 2, (N, n))
    rows[3] = 2 * rows[1]  # parallel ones
    wanted = set()
    for size in range(N + 1):
        for few in itertools.combinations(range(N), size):
            kept = list(few)
            rank = np.linalg.matrix_rank(rows[kept]) if kept else 0
            if rank < n:
                wanted.add(
                    tuple(bool(np.linalg.matrix_rank(rows[[*kept, j]]) > rank) for j in range(N))
                )
    found = {tuple(map(bool, one)) for one in supports(rows.astype(object))}
    assert found == wanted


def test_a_relation_vanishes_at_its_steps_and_nowhere_else():
    w = relation([1, 2, 4], [0, 3])
    left = [sum(c * v**t for c, v in zip(w, (1, 2, 4), strict=True)) for t in range(8)]
    assert [t for t, x in enumerate(left) if x == 0] == [0, 3]
    assert all(w)


def test_the_bound_of_theorem_1_by_hand():
    # m = 2: 3 / (4 - 2) and 3 / (3 - 2); m = 3: (5 + 3) / (4 - 2)
    assert bound([3, 4, 3], 5, 1) == 4
    assert bound([10] * 8, 10, 4) == 35


def test_determinants():
    rng = default_rng(0)
    for n in range(1, 6):
        M = rng.integers(-4, 5, (n, n))
        assert float(determinant(M.tolist())) == pytest.approx(np.linalg.det(M), abs=1e-6)


def test_the_l1_ratio_decides_what_a_linear_program_returns():
    """The worst attack on q samples a step beats (12) iff the ratio is over 1."""
    over = under = 0
    for one in cases(40, seed=1):
        if not one.guaranteed:
            continue
        Phi, p, n = one.Phi, len(one.C), len(one.values)
        ratio = worst_ratio(one)
        if abs(ratio - 1.0) < 1e-3:
            continue
        size = np.abs(one.rays.astype(float) @ Phi.T).reshape(-1, one.T, p)
        top = np.argsort(np.argsort(-size, 2), 2) < one.q
        share = np.sum(np.where(top, size, 0.0), (1, 2)) / np.sum(size, (1, 2))
        at = int(np.argmax(share))
        z = one.rays[at].astype(float)
        e = np.where(top[at].ravel(), Phi @ (z / np.linalg.norm(z)), 0.0)
        x, objective = least_sum(Phi, e)
        exact = np.sum(np.abs(e - Phi @ np.zeros(n)))
        if ratio > 1.0:
            over += 1
            assert objective < exact - 1e-9
        else:
            under += 1
            np.testing.assert_allclose(x, 0.0, atol=1e-7)
    assert min(over, under) > 0


def test_windows_are_solved_as_highs_solves_them():
    rng = default_rng(2)
    for p, S in ((8, 28), (10, 36), (12, 44)):
        given = coding.drawn(rng, "designed", 5, p, S)
        x, E = coding.decoded(given.Phi, given.Y)
        for k in range(5):
            wanted, objective = least_sum(given.Phi[k], given.Y[k])
            assert np.sum(np.abs(E[k])) == pytest.approx(objective, rel=1e-7)
            np.testing.assert_allclose(given.Phi[k] @ (x[k] - wanted), 0.0, atol=1e-6)


def test_attacks_are_placed_as_the_paper_says():
    """S = 20 of eight steps: two at each step at least, four more anywhere."""
    on = coding.placed(default_rng(3), 400, 10, 20).reshape(400, 8, 10)
    assert np.all(np.sum(on, (1, 2)) == 20)
    assert np.min(np.sum(on, 2)) == 2
    # every sample equally often: .25 with a deviation of .022
    np.testing.assert_allclose(np.mean(on, 0), 0.25, atol=0.1)


def test_isometry_constants_bound_what_they_say():
    """Of random sparse vectors, and reached by single columns."""
    found = isometry("ideal", 1)
    Q2 = parted(found.Phi[0])[1]
    rng = default_rng(4)
    ratios = []
    for _ in range(2000):
        e = np.zeros(len(Q2))
        e[rng.choice(len(Q2), 3, replace=False)] = rng.standard_normal(3)
        ratios.append(np.sum((Q2.T @ e) ** 2) / np.sum(e**2))
    # the scale is not said: the quotient of both ends does not need it
    d = found.delta[0, 2]
    assert max(ratios) / min(ratios) <= (1 + d) / (1 - d) + 1e-12
    assert found.delta[0, 0] <= found.delta[0, 1] <= d < 1.0


# what the paper gets wrong, each by a computation of its own


def test_l1_is_not_certain_where_l0_is():
    """Erratum 1, without whole numbers and without the product's solver."""
    Phi = np.tile([[100.0], [1.0], [1.0]], (3, 1))
    y = np.tile([0.0, 1.0, 1.0], 3)
    x, objective = least_sum(Phi, y)
    assert abs(x[0]) < 1e-9
    assert objective == pytest.approx(6.0)
    by_l0 = fewest_units(Phi[:, None], y[:, None], 4)
    assert len(by_l0) == 1
    assert by_l0[0][0] == pytest.approx(1.0)


@pytest.mark.parametrize("A", [[[0, -1], [1, 0]], [[1, 0], [0, -1]]])
def test_no_window_helps_against_complex_or_negative_eigenvalues(A):
    """Erratum 2: one lie a step makes (1, 1) look like 0, however long the window."""
    A, C = np.array(A), np.array([[1, 1], [1, -1], [1, 1], [1, -1]])
    z = np.array([1, 1])
    for _ in range(50):
        # two sensors see z: whichever of them lies, the other two cannot tell
        assert np.sum(C @ z != 0) == 2
        z = A @ z


def test_a_window_of_35_is_beaten():
    """Erratum 3: four sensors a step lie, and two states explain the samples equally well."""
    values, rows = list(range(1, 9)), []
    for layer in range(2):
        for k in range(5):
            rows.append(
                relation(values, list(range(7 * k, 7 * k + 7) if layer else range(k, 35, 5)))
            )
    C = np.array(rows, object)
    y = window(np.array(values, object), C, 35) @ np.ones(8, object)
    seen = (y != 0).reshape(35, 10)
    assert np.all(np.sum(seen, 1) == 8)
    # half of what sees z lies: 140 samples contradict z, 140 contradict 0
    lying = np.cumsum(seen, 1) * seen <= 4
    assert np.sum(seen & lying) == np.sum(seen & ~lying) == 140
    assert np.max(np.sum(seen & lying, 1)) == 4


def test_more_than_q_is_not_enough():
    """Erratum 3, Sections IV-A and V-B: |supp(C v)| = 2 > 1, and two states tie."""
    one = case([1, 2], [[1, 0], [1, 0], [0, 1], [0, 1]], 1, 10)
    y = np.where(np.arange(40) % 4 == 0, 0.0, one.Phi @ [1.0, 0.0])
    assert [int(np.sum(y != one.Phi @ x)) for x in ([1.0, 0.0], [0.0, 0.0])] == [10, 10]
