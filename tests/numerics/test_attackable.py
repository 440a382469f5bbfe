"""What can be moved without limit, against what can be reached in T steps."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from holdfast.numerics.attackable import growth
from holdfast.numerics.steady_state import steady_state


def jordan(z, size):
    return z * np.eye(size) + np.eye(size, k=1)


def rotation(modulus, angle):
    c, s = np.cos(angle), np.sin(angle)
    return modulus * np.array([[c, -s], [s, c]])


BLOCKS = [
    np.eye(1), -np.eye(1), 1.1 * np.eye(1), 0.5 * np.eye(1), np.zeros((1, 1)),
    np.eye(2), 1.1 * np.eye(2), jordan(1.0, 2), jordan(1.1, 2), jordan(0.0, 2),
    rotation(1.0, np.pi / 2), rotation(1.0, np.pi / 3), rotation(1.1, 1.0), rotation(0.6, 0.4),
]  # fmt: skip


def blocks(*of):
    n = sum(len(one) for one in of)
    whole, at = np.zeros((n, n)), 0
    for one in of:
        whole[at : at + len(one), at : at + len(one)] = one
        at += len(one)
    return whole


def gain(A, C):
    return steady_state(A, C, np.eye(len(A)), np.eye(len(C))).K


def dense(A, C, K, attackable, steps):
    """Y with e Y^-1 e <= 1 the errors reached with sum |z_k|^2 <= 1: all attacks at once."""
    n, ny = len(A), len(C)
    error, rows = np.zeros((n, 0)), []
    for k in range(steps):
        free = np.eye(ny)[:, attackable[k % len(attackable)]]
        rows.append(np.hstack([C @ A @ error, free]))
        error = np.hstack([(A - K @ C @ A) @ error, -K @ free])
    theta = np.zeros((steps * ny, error.shape[1]))
    for k, row in enumerate(rows):
        theta[k * ny : (k + 1) * ny, : row.shape[1]] = row
    root = error @ np.linalg.pinv(theta, rcond=1e-14)
    return root @ root.T


def reached(A, C, K, attackable, steps):
    """The same by the recursion of the project's notes on INTEGRITY (item 10), for Q = I."""
    n = len(A)
    W = np.zeros((n, n))
    for k in range(steps):
        can = attackable[k % len(attackable)]
        H = (C @ A)[~can]
        F = A - K[:, ~can] @ H
        G = np.linalg.solve(H @ W @ H.T + np.eye(len(H)), H @ W).T
        left = np.eye(n) - G @ H
        W = F @ (left @ W @ left.T + G @ G.T) @ F.T + K[:, can] @ K[:, can].T
        W = (W + W.T) / 2
    return W


def test_both_oracles_agree():
    rng = np.random.default_rng(0)
    for _ in range(5):
        A, C = 0.6 * rng.normal(size=(3, 3)), rng.normal(size=(2, 3))
        can = rng.random((2, 2)) < 0.7
        K = gain(A, C)
        slow, fast = (f(A, C, K, can, 10) for f in (dense, reached))
        # two routes to the same ellipsoid, of entries of size 1
        np.testing.assert_allclose(fast, slow, rtol=1e-8, atol=1e-10)


def random_case(rng):
    """One or two of `BLOCKS` in general coordinates, sensors that see some of it, a policy."""
    J = blocks(*(BLOCKS[i] for i in rng.integers(len(BLOCKS), size=rng.integers(1, 3))))
    n, ny = len(J), int(rng.integers(1, 4))
    T = np.linalg.qr(rng.normal(size=(n, n)))[0] @ (np.eye(n) + 0.3 * rng.normal(size=(n, n)))
    back = np.linalg.inv(T)
    A, C = T @ J @ back, rng.integers(-1, 2, (ny, n)) @ back
    can = rng.random((rng.integers(1, 5), ny)) < rng.choice([0.4, 0.7, 0.9])
    return A, C, gain(A, C), can


def check(A, C, K, can):
    """Along ``subspace`` every direction grows without limit, across it all settles."""
    found = growth(A, C, K, can)
    S, _ = np.linalg.qr(found.subspace)
    if found.unbounded:
        low, high = (np.linalg.eigvalsh(S.T @ reached(A, C, K, can, T) @ S)[0] for T in (48, 96))
        # the square of what a mode on the circle reaches grows like T, once the rest has settled
        assert high > 1.2 * low > 0, found
    if found.radius < 1.01:
        # otherwise the rounding of what grows is soon larger than what does not
        rest = np.eye(len(A)) - S @ S.T

        def settled(steps):
            sizes = (reached(A, C, K, can, T) for T in (steps, 2 * steps))
            before, after = (np.linalg.norm(rest @ W @ rest, 2) for W in sizes)
            return after <= 1.01 * before + 1e-9

        # what is hardly seen settles late
        assert settled(384) or settled(4096), found
    return found


def sweep(seed, count):
    rng, kinds = np.random.default_rng(seed), []
    for _ in range(count):
        A, C, K, can = random_case(rng)
        if K is not None:
            kinds.append(check(A, C, K, can).unbounded)
    assert 0.1 < np.mean(kinds) < 0.9


def test_against_what_is_reached():
    sweep(1, 40)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 4))
def test_against_what_is_reached_on_many(seed):
    sweep(seed, 250)


def lti(A, C, can):
    A, C = np.asarray(A, float), np.asarray(C, float)
    return growth(A, C, gain(A, C), np.atleast_2d(np.asarray(can, bool)))


def single_eigenvectors(A, C, can):
    """Theorem 3 as printed, with the eigenvectors that a numerical routine happens to give."""
    values, vectors = np.linalg.eig(A)
    unstable = vectors[:, np.abs(values) >= 1]
    return bool(np.any(np.all(np.abs((C @ unstable)[~np.asarray(can, bool)]) < 1e-9, axis=0)))


def test_a_repeated_eigenvalue_needs_its_whole_eigenspace():
    """The project's notes on INTEGRITY, item 9: there with the sensors counted the other way."""
    A, C = 1.1 * np.eye(2), np.array([[1.0, 1.0], [1.0, 0.0]])
    found = lti(A, C, [False, True])
    assert (found.unbounded, found.radius) == (True, pytest.approx(1.1, rel=1e-12))
    # what sensor 0 does not see is x1 = -x2, which is no axis
    np.testing.assert_allclose(found.subspace, [[-1.0], [1.0]], rtol=1e-12)
    assert not single_eigenvectors(A, C, [False, True])
    # sensor 1 does not see x2, an axis: here the printed test finds it as well
    assert lti(A, C, [True, False]).unbounded
    assert single_eigenvectors(A, C, [True, False])
    W = [reached(A, C, gain(A, C), np.array([[False, True]]), steps)[0, 0] for steps in (50, 100)]
    assert W[1] > 1e3 * W[0]


def test_a_rotation_needs_both_steps_when_the_period_repeats_it():
    """Item 8: A^L is a multiple of I for even L, and one step then shows one direction."""
    A, C = rotation(1.0, np.pi / 2), np.array([[1.0, 0.0]])
    for period in range(1, 13):
        enough = [
            not lti(A, C, np.arange(period)[:, None] >= f).unbounded for f in range(period + 1)
        ]
        assert enough.index(True) == (1 if period % 2 else 2)
        assert enough == sorted(enough)


def test_generalised_eigenvectors():
    """The eigenvector of a Jordan block can be hidden and the rest of its chain not."""
    A = jordan(1.2, 2)
    found = lti(A, np.eye(2), [True, False])
    np.testing.assert_array_equal(found.subspace, [[1.0], [0.0]])
    both = lti(A, np.eye(2), [True, True])
    assert both.subspace.shape == (2, 2)
    ((z, count, directions),) = both.modes
    assert (z, count) == (pytest.approx(1.2), 2)
    np.testing.assert_array_equal(directions, np.eye(2))
    # the last of a chain moves the first: seeing the first alone is enough
    assert not lti(A, np.eye(2), [False, True]).unbounded


def test_stable_plants_and_singular_ones():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(4, 4))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    assert lti(A, np.eye(4), np.ones(4)) == (0.0, False, pytest.approx(np.zeros((4, 0))), ())
    # x1 becomes x2 becomes nothing, beside an integrator that sensor 2 alone sees
    A = blocks(jordan(0.0, 2), np.eye(1))
    C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert [lti(A, C, row).unbounded for row in np.eye(3)] == [False, False, True]


def test_a_pair_is_one_mode_of_two_directions():
    ((z, count, directions),) = lti(blocks(rotation(1.1, 0.3), np.eye(1)), np.eye(3), [1, 1, 0])[3]
    assert (z, count) == (pytest.approx(1.1 * np.exp(0.3j)), 1)
    np.testing.assert_allclose(directions, [[1, 0], [0, 1], [0, 0]], atol=1e-12)


def test_the_gain_does_not_matter_if_it_stabilises():
    """Theorem 3's "v is reachable" is always true of a Kalman filter."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        A, C, K, can = random_case(rng)
        if K is None:
            continue
        other = steady_state(A, C, 1e-4 * np.eye(len(A)), 9.0 * np.eye(len(C))).K
        ours, theirs = (growth(A, C, k, can) for k in (K, other))
        assert ours.radius == theirs.radius
        np.testing.assert_array_equal(ours.subspace, theirs.subspace)


def test_a_gain_that_does_not_stabilise_leaves_modes_alone():
    """What the filter does not correct, an attack on its residuals cannot move."""
    can = np.ones((1, 2), bool)
    A = np.diag([1.1, 1.2])
    found = growth(A, np.eye(2), np.diag([0.5, 0.0]), can)
    assert found.radius == pytest.approx(1.1)
    np.testing.assert_array_equal(found.subspace, [[1.0], [0.0]])
    assert not growth(A, np.eye(2), np.zeros((2, 2)), can).unbounded
    turns = np.array([[True, False], [False, True]])
    assert growth(A, np.eye(2), np.diag([0.5, 0.0]), turns).unbounded is False
    # a gain that couples them, in general coordinates: mode 1.2 cannot be reached
    T = np.array([[2.0, 1.0], [1.0, 1.0]])
    back = np.linalg.inv(T)
    K = T @ np.array([[0.5, 0.3], [0.0, 0.0]])
    assert growth(T @ A @ back, back, K, can).radius == pytest.approx(1.1)


def test_who_does_not_know_the_steps_is_always_bounded():
    """Theorem 6: he must keep C A e small at every step."""
    A, C = np.array([[1.0, 0.1], [0.0, 1.0]]), np.eye(2)
    can = np.ones((5, 2), bool)
    assert growth(A, C, gain(A, C), can).unbounded
    assert not growth(A, C, gain(A, C), can, aware=False).unbounded


@pytest.mark.parametrize("period", [100, 4000])
def test_long_periods_lose_no_direction(period):
    """A mode of modulus 1 that no authenticated step shows, beside one of modulus 3 that one does.

    Propagated over a period, what is shown of the latter is 3^100 times what rounding adds to
    the former.
    """
    T = np.random.default_rng(5).normal(size=(3, 3))
    back = np.linalg.inv(T)
    A, C = T @ np.diag([3.0, 1.0, 1.5]) @ back, np.array([[1.0, 0, 0], [0, 1, 0], [1, 0, 1]]) @ back
    can = np.ones((period, 3), bool)
    can[0, 0] = can[period // 3, 2] = False
    found = lti(A, C, can)
    assert found.radius == pytest.approx(1.0, rel=1e-12)
    hidden = T[:, 1] / T[np.flatnonzero(found.subspace[:, 0] == 1.0)[0], 1]
    # rounding times the condition number of the coordinates
    np.testing.assert_allclose(found.subspace[:, 0], hidden, rtol=1e-10)
    can[1, 1] = False
    assert not lti(A, C, can).unbounded


def test_a_late_step_of_the_period_counts_like_the_first():
    A, C = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    for step in range(7):
        can = np.arange(7)[:, None] != step
        # one position per period shows the speed as well, by the next one
        assert not lti(A, C, can).unbounded


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.lists(st.floats(-6, 6), min_size=8, max_size=8))
def test_units_do_not_matter(seed, powers):
    A, C, K, can = random_case(np.random.default_rng(seed))
    if K is None:
        return
    n, ny = len(A), len(C)
    x, y = 10.0 ** np.array(powers[:n]), 10.0 ** np.array(powers[8 - ny :])
    found = growth(A, C, K, can)
    other = growth(A * x[:, None] / x, C * y[:, None] / x, K * x[:, None] / y, can)
    assert found.unbounded == other.unbounded
    # in the scaled units both are the same plant to rounding
    assert other.radius == pytest.approx(found.radius, rel=1e-6)
    assert found.subspace.shape == other.subspace.shape


@settings(max_examples=40)
@given(st.integers(0, 10**6))
def test_more_sensors_are_never_less(seed):
    rng = np.random.default_rng(seed)
    A, C, K, can = random_case(rng)
    if K is None:
        return
    more = can | (rng.random(can.shape) < 0.3)
    few, many = (growth(A, C, K, which) for which in (can, more))
    assert few.unbounded <= many.unbounded
    assert few.radius <= many.radius + 1e-9
    # and what could be moved still can be
    joint = np.hstack([few.subspace, many.subspace])
    assert np.linalg.matrix_rank(joint, tol=1e-6) == many.subspace.shape[1]
