import itertools

import numpy as np
import pytest
import scipy.linalg

from holdfast.analysis.poles import candidates, support
from holdfast.controllers.feedback import closed_loop
from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.library import quadrotor

WEIGHTS = {"state_weight": np.eye(10).tolist(), "input_weight": np.eye(3).tolist()}


@pytest.fixture(scope="module")
def plant():
    return quadrotor.build(sensors=5)


@pytest.fixture(scope="module")
def table(plant):
    return candidates(plant, **WEIGHTS, sizes=(0.03, 0.1, 0.3))


def loop(plant, candidate):
    return np.asarray(plant.A) - np.asarray(plant.B) @ candidate.gain


def seen_as(pattern, poles, seed=0):
    """A (n x n) with these poles and C with C V = ``pattern`` for its eigenvectors V."""
    V = np.random.default_rng(seed).normal(size=(len(poles), len(poles)))
    inverse = np.linalg.inv(V)
    return V @ np.diag(poles) @ inverse, np.asarray(pattern, float) @ inverse


def test_supports_of_chosen_eigenvectors():
    pattern = [[1, 0, 2], [1, 0, 1], [0, 1e-3, 1], [1, 0, -1]]
    A, C = seen_as(pattern, [0.4, 0.9, 0.6])
    counts, weakest = support(A, C)
    assert counts == (1, 4, 3)  # from the largest pole down: .9, .6, .4
    assert weakest == pytest.approx(0.5, rel=1e-6)
    # an entry of 1e-3 of the largest counts, unless it is asked not to
    A, C = seen_as([[1, 2], [1e-3, 1]], [0.9, 0.5])
    assert support(A, C)[0] == (2, 2)
    assert support(A, C)[1] == pytest.approx(1e-3, rel=1e-6)
    assert support(A, C, 1e-2)[0] == (1, 2)


def test_a_repeated_pole_counts_by_its_worst_combination():
    # c (1, -1) leaves two of five; each vector alone is seen by three or four
    pair = np.array([[1, 1], [2, 2], [1, -1], [0, 0], [1, 0]])
    A, C = seen_as(np.hstack([pair, np.ones((5, 1))]), [0.7, 0.7, 0.2])
    assert support(A, C)[0] == (2, 2, 5)
    # and two vectors seen alike are not seen at all where they cancel
    A, C = seen_as([[1, 2, 1], [2, 4, 1]], [0.7, 0.7, 0.2])
    assert support(A, C)[0] == (0, 0, 2)


def test_a_turn_and_a_chain():
    turn = 0.9 * np.array([[0.0, -1.0], [1.0, 0.0]])
    assert support(turn, np.array([[1.0, 1.0], [1.0, -1.0], [0.0, 0.0]]))[0] == (2, 2)
    # a Jordan block has one eigenvector, e1
    chain = np.array([[0.5, 1.0], [0.0, 0.5]])
    assert support(chain, np.array([[0.0, 1.0], [1.0, 3.0]]))[0] == (1, 1)


def test_optimal_control_leaves_the_axes_apart_and_corrects_nothing(table):
    """Fig. 5: p_z is seen by one sensor, each other axis by position and speed."""
    first = table[0]
    assert (first.size, first.moved, first.cost) == (0.0, 0.0, 1.0)
    assert sorted(first.supports) == [1, 1] + [2] * 8
    assert (first.corrected, first.attained) == (0, False)
    X = scipy.linalg.solve_discrete_are  # each axis by itself is the same problem
    for states, column in ((slice(0, 4), 0), (slice(4, 8), 1), (slice(8, 10), 2)):
        found = quadrotor.build()
        A = np.asarray(found.A)[states, states]
        B = np.asarray(found.B)[states, column : column + 1]
        S = X(A, B, np.eye(len(A)), np.eye(1))
        expected = np.linalg.solve(1 + B.T @ S @ B, B.T @ S @ A)
        np.testing.assert_allclose(first.gain[column : column + 1, states], expected, rtol=1e-7)


def test_feedback_across_the_axes_lets_every_sensor_see_every_mode(plant, table):
    moduli = np.abs(table[0].poles)
    for found in table[1:]:
        assert found.supports == (5,) * 10
        assert (found.corrected, found.attained) == (2, True)
        expected = moduli * (1 - found.size * np.arange(1, 11) / 10)
        np.testing.assert_allclose(found.poles, expected, atol=1e-6)
        assert np.all(np.diff(found.poles.real) < 0)
        values, V = np.linalg.eig(loop(plant, found))
        assert np.max(np.abs(values.imag)) < 1e-9
        seen = np.abs(np.asarray(plant.C) @ V)
        weakest = np.min(seen / np.max(seen, axis=0))
        # both sensors' deviations are equal here, so that units do not matter
        assert found.weakest == pytest.approx(weakest, rel=1e-4)
        assert found.weakest > 1e-5
        # it is to stay a controller: the poles moved by .2 at most, the cost by a small factor
        assert 1 < found.cost < 3
        assert found.moved < 0.2


def test_more_sensors_are_more_to_be_corrected():
    six = ["p_x", "p_x", "p_y", "p_y", "p_z", "p_z"]
    first, found = candidates(quadrotor.build(sensors=six), **WEIGHTS, sizes=(0.1,))
    assert (first.supports, first.corrected) == ((2,) * 10, 0)
    assert (found.supports, found.corrected) == ((6,) * 10, 2)


def test_cost_is_the_mean_over_time(plant, table):
    for W in (np.asarray(plant.Q), np.eye(10)):
        tried = candidates(plant, **WEIGHTS, sizes=(0.1,), noise=W)
        means = []
        for found in tried:
            A, K = loop(plant, found), found.gain
            # the covariance of the state, by squaring: sum of A^k W A'^k
            covariance, power = W, A
            for _ in range(14):
                covariance, power = covariance + power @ covariance @ power.T, power @ power
            means.append(np.trace(covariance @ (np.eye(10) + K.T @ K)))
        assert tried[1].cost == pytest.approx(means[1] / means[0], rel=1e-8)


def test_twice_as_many_sensors_as_attacks_are_not_enough(plant, table):
    """The paper prints |supp| > q, which 2 > 1 fulfils: one attack has two explanations."""
    closed = closed_loop(plant, table[0].gain)
    A, C = np.asarray(closed.A), np.asarray(closed.C)
    # optimal control: what starts along the x axis stays there, seen by p_x and v_x alone
    x = np.array([1.0, -0.3, 0.1, 0.2, 0, 0, 0, 0, 0, 0])
    Y = np.stack([C @ np.linalg.matrix_power(A, k) @ x for k in range(40)])
    Y = np.where(np.abs(Y) > 1e-12, Y, 0.0)  # what rounding of the gain couples
    watching = [plant.outputs.index("p_x"), plant.outputs.index("v_x")]
    assert np.flatnonzero(np.any(Y != 0, axis=0)).tolist() == watching
    one, other = (np.where(np.arange(5) == sensor, Y, 0.0) for sensor in watching)
    # at rest with p_x attacked, or at x with v_x attacked: the same samples, one attack each
    np.testing.assert_array_equal(0 * Y + one, Y - other)


def least_seen(A, C, steps):
    """The fewest nonzero samples of C A^k z over z other than 0 (n = 2): z across each row."""
    Phi = np.vstack([C @ np.linalg.matrix_power(A, k) for k in range(steps)])
    counts = [len(Phi)]
    for row in Phi:
        z = np.array([-row[1], row[0]])
        if np.any(z):
            seen = np.abs(Phi @ z)
            counts.append(int(np.sum(seen > 1e-9 * np.max(seen))))
    return min(counts)


def test_q_attacks_a_step_have_one_explanation():
    """Two explanations differ by C A^k z, which then has at most 2 q T nonzero samples."""
    C = [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
    small = linear_plant(
        A=[[1.0, 0.1], [0.0, 1.0]], B=[[0.005], [0.1]], C=C, Q=np.eye(2), R=np.eye(3)
    )
    table = candidates(small, state_weight=np.eye(2).tolist(), input_weight=[[1.0]])
    for found in table[1:]:
        assert (found.corrected, found.attained) == (1, True)
        A = loop(small, found)
        # Theorem 1: T > 3 / (3 - 2 q) for q = 1
        for steps in (4, 8, 12):
            assert least_seen(A, np.array(C), steps) > 2 * steps


def test_with_one_input_the_poles_alone_decide():
    rng = np.random.default_rng(3)
    single = linear_plant(
        A=rng.normal(size=(4, 4)), B=rng.normal(size=(4, 1)), C=np.eye(4), Q=np.eye(4), R=np.eye(4)
    )
    weights = {"state_weight": np.eye(4).tolist(), "input_weight": [[1.0]]}
    for one, other in itertools.pairwise(
        candidates(single, **weights, sizes=(0.2,), draws=draws)[1] for draws in (0, 3)
    ):
        np.testing.assert_allclose(one.gain, other.gain, rtol=1e-6)


def test_a_sensor_of_the_input_sees_what_moves_it():
    plant = linear_plant(
        A=[[1.1, 1.0], [0.0, 0.5]], B=[[0.0], [1.0]], C=[[1.0, 0.0], [0.0, 0.0]],
        D=[[0.0], [1.0]], Q=np.eye(2), R=np.eye(2),
    )  # fmt: skip
    found = candidates(plant, state_weight=np.eye(2).tolist(), input_weight=[[1.0]])[1]
    assert found.supports == (2, 2)
    closed = closed_loop(plant, found.gain)  # the input is its third state
    values, V = np.linalg.eig(np.asarray(closed.A))
    seen = np.abs(np.asarray(closed.C) @ V)[:, np.abs(values) > 1e-9]
    assert found.weakest == pytest.approx(np.min(seen / np.max(seen, axis=0)), rel=1e-6)


def test_sensors_are_compared_in_units_of_their_noise(plant, table):
    loud = linear_plant(
        A=plant.A, B=plant.B, C=1e3 * plant.C, Q=plant.Q, R=1e6 * plant.R, dt=plant.dt
    )
    found = candidates(loud, **WEIGHTS, sizes=(0.03,))[1]
    assert found.weakest == pytest.approx(table[1].weakest, rel=1e-9)
    sd = np.array([1.0, 0.1, 30.0, 2.0, 1.0])
    uneven = linear_plant(A=plant.A, B=plant.B, C=plant.C, Q=plant.Q, R=np.diag(sd**2))
    found = candidates(uneven, **WEIGHTS, sizes=(0.03,))[1]
    _, V = np.linalg.eig(loop(uneven, found))
    seen = np.abs(np.asarray(plant.C) @ V) / sd[:, None]
    expected = np.min(seen / np.max(seen, axis=0))
    assert found.weakest == pytest.approx(expected, rel=1e-4)


def test_what_is_small_can_be_held_for_nothing(plant, table):
    coarse = candidates(plant, **WEIGHTS, sizes=(0.03,), least=0.3)[1]
    assert min(coarse.supports) < 5
    assert coarse.weakest >= 0.3
    again = candidates(plant, **WEIGHTS, sizes=(0.03, 0.1, 0.3))
    np.testing.assert_array_equal(again[2].gain, table[2].gain)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sizes": (0.1, 1.0)}, "sizes: found"),
        ({"sizes": (0.0,)}, "sizes: found"),
        ({"noise": np.zeros((2, 2))}, "noise: found shape"),
        ({"noise": np.eye(3)}, "noise: found shape"),
        ({"state_weight": [[1.0]]}, "state_weight: found shape"),
    ],
)
def test_wrong_settings_are_named(changes, message):
    keys = {"state_weight": [[1, 0], [0, 1]], "input_weight": [[1]], **changes}
    plant = linear_plant(
        A=[[1.1, 1], [0, 0.5]], B=[[0], [1]], C=np.eye(2), Q=np.eye(2), R=np.eye(2)
    )
    with pytest.raises(InvalidValue, match=message):
        candidates(plant, **keys)


def test_a_mode_out_of_reach_is_named():
    plant = linear_plant(
        A=[[1.1, 0], [0, 0.5]], B=[[1], [0]], C=np.eye(2), Q=np.eye(2), R=np.eye(2)
    )
    with pytest.raises(InvalidValue, match=r"plant.B: found no input that reaches the mode 0.5"):
        candidates(plant, state_weight=[[1, 0], [0, 1]], input_weight=[[1]])
