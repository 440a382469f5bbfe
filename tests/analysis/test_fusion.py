"""What the LASSO fusion withstands: the paper's example, definitions, and big plants."""

import itertools

import numpy as np
import pytest
from numpy.linalg import matrix_rank

from analysis.models import model, plant
from holdfast.analysis.advice import advice
from holdfast.analysis.fusion import fusion
from holdfast.analysis.whole import analysis
from holdfast.numerics.steady_state import steady_state

PAPER_A = np.diag([1.0, 1.0, -2.0])
PAPER_C = np.array(
    [[1.0, 0.0, 0.0], [1.0, 1.0, -1.0], [1.0, 2.0, 1.0], [1.0, -1.0, -0.5], [-0.5, 1.0, 1.0]]
)


def found(A, C, Q=None, R=None):
    A = np.asarray(A, float)
    of = model(A, np.zeros((len(A), 0)), C, Q=Q, R=R)
    return fusion(of, steady_state(of.A, of.C, of.Q, of.R))


def random_plant(seed, n, m):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    return A * 0.98 / np.max(np.abs(np.linalg.eigvals(A))), rng.normal(size=(m, n))


def moduli(A, C, K):
    """|G_i u|_1 at the columns of a matrix: the rows of G_i are C_i A (A - z I)^-1, by (12)."""
    n = len(A)
    rows = [C @ A @ np.linalg.inv(A - z * np.eye(n)) for z in np.linalg.eigvals(A - K @ C @ A)]
    return lambda U: np.sum([np.abs(part @ U) for part in rows], 0)


def test_the_paper_s_example():
    """Errata: only sensors 1, 4 and 5 are withstood; Theorem 4 fails for p = 1."""
    f = found(PAPER_A, PAPER_C, Q=np.eye(3))
    np.testing.assert_array_equal(f.lower, f.upper)
    np.testing.assert_allclose(f.upper, [0.4305, 1.6873, 1.1460, 0.7579, 0.4379], atol=5e-5)
    assert f.bounded == (True, False, False, True, True)
    assert (f.withstood, f.sparse_observable, f.untried) == (0, 1, 0)
    np.testing.assert_allclose(f.upper_sets, [f.upper[1], 6.265], rtol=1e-4)
    assert f.lower_sets[1] == f.upper_sets[1]
    enough = {remedy.name: remedy.enough for remedy in f.authenticate}
    assert enough == {"y1": False, "y2": True, "y3": True, "y4": True, "y5": True}
    assert f.authenticate[-1].name == "y1"
    assert [remedy.enough for remedy in f.add] == [True, False, False]
    assert (f.derogatory, f.ill_conditioned, f.reason) == (False, False, None)


@pytest.mark.parametrize(("seed", "n", "m"), [(0, 2, 4), (1, 3, 5), (2, 4, 5), (3, 5, 6)])
def test_no_direction_is_worse(seed, n, m):
    A, C = random_plant(seed, n, m)
    f = found(A, C)
    K = steady_state(A, C, 1e-2 * np.eye(n), np.eye(m)).K
    g = moduli(A, C, K)(np.random.default_rng(seed).normal(size=(n, 100_000)))
    ratios = g / (g.sum(0) - g)
    assert np.all(ratios.max(1) <= f.upper * (1 + 1e-9))
    # random directions come near the worst only where there are few states
    assert np.all(ratios.max(1) >= f.lower * (1 - 10.0 ** (n - 5.0)))
    assert np.all(f.upper <= 1.03 * f.lower)


def test_an_added_sensor_is_a_plant_with_that_sensor():
    R = np.diag([1.0, 4.0, 9.0, 2.0, 1.0])
    f = found(PAPER_A, PAPER_C, Q=np.eye(3), R=R)
    for i, name in enumerate(("x1", "x2", "x3")):
        more = np.vstack([PAPER_C, np.eye(3)[i]])
        whole = found(PAPER_A, more, Q=np.eye(3), R=np.diag([1.0, 4.0, 9.0, 2.0, 1.0, 2.0]))
        (remedy,) = [r for r in f.add if r.name == name]
        assert remedy.upper == pytest.approx(whole.upper.max(), rel=1e-9)


def test_a_ratio_of_one_is_not_certain():
    """Two sensors alike: neither can be told from the other."""
    f = found([[0.9]], np.ones((2, 1)))
    np.testing.assert_allclose(f.upper, 1.0, rtol=1e-12)
    assert f.bounded == (False, False)
    assert f.withstood == 0
    f = found([[0.9]], np.ones((7, 1)))
    np.testing.assert_allclose(f.upper_sets, [1 / 6, 2 / 5, 3 / 4], rtol=1e-9)
    assert (f.withstood, f.sparse_observable) == (3, 3)


def test_decoupled_plants_are_judged_apart():
    A = np.diag([0.9, 0.8])
    C = np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 2.0], [0.0, 1.0]])
    f = found(A, C)
    np.testing.assert_allclose(f.upper, [0.5, 0.5, 0.5, 1 / 3, 1.0, 1 / 3], rtol=1e-9)
    assert (f.withstood, f.sparse_observable) == (0, 1)
    # one of three left
    assert np.all(f.lower_sets[1:] >= 2.0)


@pytest.mark.parametrize("seed", range(9))
def test_sparse_observability_is_what_it_says(seed):
    """Against the rank of what is left, for every set; with repeated eigenvalues in A."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(2, 5)), int(rng.integers(3, 7))
    A = np.diag(rng.choice([0.9, 0.5, -0.8], n)) + np.diag(rng.integers(0, 2, n - 1), 1) * 0.5
    C = rng.integers(-1, 2, (m, n)).astype(float)
    powers = [np.linalg.matrix_power(A, k) for k in range(n)]

    def observable(kept):
        return matrix_rank(np.vstack([C[list(kept)] @ power for power in powers])) == n

    if not observable(range(m)):
        pytest.skip("not observable at all")
    f = found(A, C)
    truth = max(
        p for p in range((m - 1) // 2 + 1)
        if all(observable(kept) for kept in itertools.combinations(range(m), m - 2 * p))
    )  # fmt: skip
    assert f.reason is None
    assert f.sparse_observable == truth
    # where it fails, so does the condition of Theorem 4
    assert np.all(f.lower_sets[truth:] >= 1.0 - 1e-9)


def test_where_there_is_nothing_to_say():
    one = found(0.5 * np.eye(2), [[1.0, 1.0]])
    assert "one sensor" in one.reason
    unseen = found(np.diag([2.0, 0.5]), [[0.0, 1.0], [0.0, 2.0]])
    assert "do not see the unstable mode 2" in unseen.reason
    shared = found(np.diag([0.5, 0.9]), [[0.0, 1.0], [0.0, 2.0]])
    assert "share the eigenvalue 0.5" in shared.reason
    large = found(0.5 * np.eye(40), np.ones((26, 40)))
    assert "too many" in large.reason
    for nothing in (one, unseen, shared, large):
        assert nothing.withstood is None
        assert nothing.bounded == nothing.authenticate == nothing.add == ()


def test_a_big_plant_gets_an_interval():
    """12 states, 20 sensors: 1e18 rays. What is too dear to try is said to be so."""
    f = found(*random_plant(12, 12, 20))
    assert np.all(f.lower < f.upper)
    assert np.all(f.upper < 1.3 * f.lower)
    assert f.withstood >= 1
    assert f.untried >= 12
    assert f.add == ()


def said(A, C, **kw):
    n = len(A)
    made = plant(A, np.zeros((n, 0)), C, **kw)
    return advice(analysis(made, np.zeros(n), np.eye(n)), None, fusion=True)


def test_advice():
    liars, authenticate, add = said(PAPER_A, PAPER_C, Q=np.eye(3))
    assert 'cannot afford a lie of "y2" (ratio 1.69) or "y3" (ratio 1.15)' in liars
    assert authenticate == (
        'Authenticate "y2" (ratio 0.571), "y3" (ratio 0.6), "y5" (ratio 0.667) or 1 more and the '
        "LASSO fusion withstands any other sensor."
    )
    assert add.startswith('Measure "x3" (ratio 0.876) as well and the LASSO fusion withstands')
    assert said(np.array([[0.9]]), np.ones((5, 1))) == [
        "The LASSO fusion withstands any 2 sensors at once of the 5: the worst ratio is 0.667, "
        "under 1."
    ]
    (why,) = said(np.array([[0.9]]), np.ones((1, 1)))
    assert why.startswith("What the LASSO fusion withstands cannot be said: there is one sensor")
    # two eigenvalues nearly equal
    withstands, ill = said(np.diag([0.9, 0.9 + 1e-8]), np.vstack([np.eye(2)] * 3))
    assert withstands.startswith("The LASSO fusion withstands any one sensor of the 6")
    assert "ill-conditioned here" in ill
    liars, nothing = said(np.eye(2) * 0.9, np.eye(2))
    assert '"y1" (ratio infinite) or "y2" (ratio infinite)' in liars
    assert nothing == "No single sensor, authenticated or added, mends that."
