"""Block structures that are known, and the paper's coordinates against the paper's own filter."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from decomposed import COUNT, decomposable, jordan, paper_form, similar, with_structure
from holdfast.numerics.jordan import blocks, coordinates
from holdfast.numerics.local import input_normal

# structure of one matrix: eigenvalues (of a complex pair the upper) with their block sizes
STRUCTURES = {
    "simple": [(0.5, (1,)), (-0.3, (1,)), (0.2 + 0.4j, (1,))],
    "mixed": [(0.5, (2, 1, 1)), (-0.3, (1,))],
    "three blocks": [(0.4, (3, 2, 1)), (0.8, (1,))],
    "equal blocks": [(-0.6, (2, 2)), (0.1, (1,))],
    "complex defective": [(0.4 + 0.3j, (2,)), (0.7, (1,))],
    "complex, three": [(0.4 + 0.3j, (3,)), (-0.7, (1,))],
    "complex derogatory": [(0.4 + 0.3j, (1, 1)), (0.2, (3,))],
    "complex mixed": [(-0.4 + 0.3j, (2, 1)), (-0.4, (1,)), (0.6 + 0.2j, (1,))],
    "two defective": [(0.9, (2,)), (0.89, (2,)), (0.1, (1,))],
    "imaginary": [(0.5j, (2, 1))],
    "small": [(1e-3, (3,)), (2e-3, (1, 1)), (0.9, (2,))],
    "zero": [(0.0, (2, 1)), (0.5, (1,))],
    "zero alone": [(0.0, (3,))],
    "multiple of I": [(0.5, (1, 1, 1))],
}
EASY = [name for name in STRUCTURES if "small" not in name and "zero" not in name]


def assert_structure(found, structure, tolerance):
    """The same eigenvalues with the same sizes."""
    assert len(found) == len(structure)
    left = list(found)
    for value, sizes in structure:
        match = min(left, key=lambda b: abs(b.value - value))
        left.remove(match)
        assert match.sizes == sizes
        assert abs(match.value - value) <= tolerance
        assert len(match.members) == sum(sizes)


@pytest.mark.parametrize("name", STRUCTURES)
def test_structure(name):
    """The mean of a k-fold eigenvalue is as exact as a simple one: rounding times the squared
    condition of the eigenvectors (16), times the departure from normality."""
    for seed in range(10):
        M = with_structure(np.random.default_rng(seed), STRUCTURES[name])
        assert_structure(blocks(M), STRUCTURES[name], 1e-12)


# all couplings of a multiple of I are rounding: nothing there tells the units
@pytest.mark.parametrize("name", [name for name in EASY if name != "multiple of I"])
def test_units_make_no_difference(name):
    for seed in range(10):
        rng = np.random.default_rng(seed)
        M = with_structure(rng, STRUCTURES[name])
        unit = 10.0 ** rng.integers(-4, 5, len(M))
        assert_structure(blocks(M * unit / unit[:, None]), STRUCTURES[name], 1e-12)


def test_the_structures_of_the_random_systems():
    """Here M = A - K C A with its rounding; near ones are apart, or together, by design."""
    for seed in range(COUNT):
        s = decomposable(seed)
        if s.structure is not None:
            assert_structure(blocks(s.A - s.K @ s.C @ s.A), s.structure, 1e-11)


@pytest.mark.parametrize("apart", [1e-12, 1e-9, 1e-8, 4e-7])
@pytest.mark.parametrize("value", [0.5, 0.3 + 0.4j])
@pytest.mark.parametrize("coupling", [1.0, 0.01])
def test_nearly_defective_is_merged(apart, value, coupling):
    """Apart by less than 1e-6 of their size, with one eigenvector for two: one block.

    Its members stay what they are, so that nothing is lost.
    """
    for seed in range(5):
        J = jordan(complex(value), (2,))
        half = len(J) // 2
        J[half:, half:] += apart * np.eye(half)
        J[:half, half:] *= coupling
        M = similar(np.random.default_rng(seed), block_diag(J, 0.9))
        assert_structure(blocks(M), [(value + apart / 2, (2,)), (0.9, (1,))], 1e-12)
        pair = next(b for b in blocks(M) if b.sizes == (2,))
        # rounding scatters by its square root
        assert abs(abs(pair.members[0] - pair.members[1]) - apart) < 1e-6


@pytest.mark.parametrize("apart", [1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4])
@pytest.mark.parametrize("value", [0.5, 0.3 + 0.4j])
def test_near_with_eigenvectors_is_not_merged(apart, value):
    """What is diagonalisable stays apart: one number for both would be wrong by their distance."""
    for seed in range(5):
        J = block_diag(jordan(complex(value), (1,)), jordan(value + complex(apart), (1,)), 0.9)
        M = similar(np.random.default_rng(seed), J)
        expected = [(value, (1,)), (value + apart, (1,)), (0.9, (1,))]
        assert_structure(blocks(M), expected, min(1e-12, apart / 4))


def test_a_coupling_between_far_eigenvalues_is_no_block():
    M = similar(np.random.default_rng(0), np.array([[0.5, 1.0], [0.0, 0.5001]]))
    assert_structure(blocks(M), [(0.5, (1,)), (0.5001, (1,))], 1e-11)


def test_blocks_exact_in_integers():
    """Every eigenvalue is in exactly one block, whatever the matrix; exact duplicates too."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        n = int(rng.integers(1, 7))
        M = rng.integers(-1, 2, (n, n)).astype(float)
        found = blocks(M)
        members = [z for b in found for z in b.members]
        members += [z.conjugate() for b in found if b.value.imag for z in b.members]
        expected = np.poly(M)
        # coefficients of the characteristic polynomial: integers up to about 50
        np.testing.assert_allclose(np.poly(members), expected, atol=1e-8)
        assert sum(sum(b.sizes) * (2 if b.value.imag else 1) for b in found) == n
        assert all(b.value.imag >= 0 and list(b.sizes) == sorted(b.sizes)[::-1] for b in found)
    assert [b.sizes for b in blocks(np.zeros((3, 3)))] == [(1, 1, 1)]
    assert [b.sizes for b in blocks(np.ones((3, 3)))] == [(1,), (1, 1)]


def bank(structure):
    """The bank's pair and the blocks found, of a matrix known only by its structure."""
    found = blocks(with_structure(np.random.default_rng(1), structure))
    poles = [b.value for b in found for _ in range(b.sizes[0])]
    S, b = input_normal([complex(z) for z in poles])
    return S, b, found


def complex_rows(found, rows):
    """The rows as the paper has them, one a height, and its J in this order; from the top."""
    out, J, at = [], [], 0
    for block in found:
        heights = []
        for _ in range(block.sizes[0]):
            wide = 2 if block.value.imag else 1
            heights.append(rows[at] + (1j * rows[at + 1] if wide == 2 else 0))
            at += wide
        out += heights[::-1]
        size = block.sizes[0]
        J.append(block.value * np.eye(size) + np.eye(size, k=1))
    assert at == len(rows)
    return np.array(out), block_diag(*J)


@pytest.mark.parametrize("name", STRUCTURES)
def test_coordinates(name):
    """T S = J T and T b = 1, to rounding relative to T.

    "small" has eigenvalues 1e-3 apart in blocks of up to three, and T of 1e9.
    """
    S, b, found = bank(STRUCTURES[name])
    c = coordinates(S, b, found)
    T, J = complex_rows(found, c.rows)
    size = np.max(np.abs(T))
    np.testing.assert_allclose(T @ S, J @ T, atol=1e-13 * size)
    np.testing.assert_allclose(T @ b, 1.0, atol=1e-13 * size)
    assert np.isfinite(c.condition)
    assert np.linalg.matrix_rank(c.rows) == len(b) or c.condition > 1e12


@pytest.mark.parametrize("name", EASY)
def test_norm_is_the_papers(name):
    """The sum of moduli of the paper's local estimate (12), simulated with its own J.

    Both are sums of up to 60 terms of size 1; the coordinates amplify rounding by their
    condition.
    """
    S, b, found = bank(STRUCTURES[name])
    c = coordinates(S, b, found)
    J, _ = paper_form(STRUCTURES[name])
    rng = np.random.default_rng(2)
    zeta, paper, plain = np.zeros(len(b)), np.zeros(len(J), complex), []
    for _ in range(60):
        y = rng.normal()
        zeta, paper = S @ zeta + b * y, J @ paper + y
        entries = c.rows @ zeta
        moduli = np.sqrt(np.bincount(c.group, entries**2))
        expected = np.sum(np.abs(paper))
        assert abs(c.weight @ moduli - expected) <= 1e-14 * (1 + c.condition) * expected
        plain.append(np.sum(np.abs(entries)) / expected)
    if any(complex(z).imag for z, _ in STRUCTURES[name]):
        assert max(plain) < 0.99  # the norm of real and imaginary parts is another one


@pytest.mark.parametrize("name", EASY)
def test_coordinates_belong_to_no_basis(name):
    """Another state of the same bank has the same coordinates."""
    S, b, found = bank(STRUCTURES[name])
    T = np.linalg.qr(np.random.default_rng(3).normal(size=S.shape))[0] * np.linspace(1, 2, len(b))
    first = coordinates(S, b, found)
    other = coordinates(T @ np.linalg.solve(T.T, S.T).T, T @ b, found)
    tolerance = 1e-13 * first.condition * np.max(np.abs(first.rows))
    np.testing.assert_allclose(other.rows @ T, first.rows, atol=tolerance)
    np.testing.assert_array_equal(other.group, first.group)
    np.testing.assert_array_equal(other.weight, first.weight)


def test_weights_count_conjugates_and_copies():
    """(2, 1) at a complex value: the entry at the bottom of a block is there four times, the
    one above twice; at a real value with (1, 1, 1) three times."""
    S, b, found = bank([(0.4 + 0.3j, (2, 1)), (0.9, (1, 1, 1))])
    c = coordinates(S, b, found)
    assert c.weight.tolist() == [3.0, 4.0, 2.0]
    assert c.group.tolist() == [0, 1, 1, 2, 2]
