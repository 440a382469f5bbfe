"""What `unknown_input` says of attacks it cannot see, of authenticated samples, of units."""

import numpy as np
import pytest

import oracles
import systems
from holdfast.estimators import kalman, unknown_input
from holdfast.plants.build import linear_plant
from holdfast.records import Status
from systems import estimates

DT = 0.1


def words(got) -> set[str]:
    return {Status(int(s)).words for s in got.status}


def test_a_push_on_a_cart_with_a_position_sensor_is_hidden_in_its_own_row():
    """C G = 0: speed and push of row k are undetermined at k, the position is not."""
    plant = linear_plant(
        A=[[1, DT], [0, 1]], C=[[1, 0]], G=[[0], [DT]], Q=1e-3 * np.eye(2), R=[[0.01]], dt=DT
    )
    rng = np.random.default_rng(0)
    y = rng.normal(size=(8, 1))
    u, seen = np.zeros((8, 0)), np.ones((8, 1), bool)
    got = estimates(unknown_input.build(plant, [0, 0], np.eye(2)), u, y, seen)
    assert words(got) == {"UNOBSERVABLE+HIDDEN_INPUT"}
    assert np.all(np.isinf(got.x_cov[:, 1, 1]))
    assert np.all(np.isinf(got.d_cov[:, 0, 0]))
    assert np.all(got.d == 0)
    answer = oracles.batch_estimate(systems.matrices(plant), np.zeros(2), np.eye(2), u, y, seen)
    np.testing.assert_allclose(got.x[-1, 0], float(answer.value[0]), rtol=1e-12)
    np.testing.assert_allclose(got.x_cov[-1, 0, 0], float(answer.cov[0, 0]), rtol=1e-12)


def spoofable(factor: float = 1.0):
    """Two states, three sensors, the first spoofable; its channel in units of 1/factor."""
    return linear_plant(
        A=[[1, DT], [0, 0.9]],
        C=[[1, 0], [0, 1], [1, 1]],
        H=[[factor], [0], [0]],
        Q=[[0.1, 0.02], [0.02, 0.2]],
        R=[[1, 0.3, 0], [0.3, 0.5, 0.1], [0, 0.1, 0.4]],
    )


def test_samples_that_are_all_trusted_give_the_kalman_filter():
    """An authenticated sample cannot be attacked: d = 0 with sd 0, and full use of it."""
    plant = spoofable()
    u, y, seen = systems.random_log(0, plant, 25, 0.3)
    trusted = seen.copy()
    ours = estimates(unknown_input.build(plant, [0, 0], np.eye(2)), u, y, seen, trusted)
    truth = estimates(kalman.build(plant, [0, 0], np.eye(2)), u, y, seen)
    np.testing.assert_allclose(ours.x, truth.x, atol=1e-12)
    np.testing.assert_allclose(ours.x_cov, truth.x_cov, atol=1e-12)
    arrived = seen[:, 0]
    assert np.all(ours.d[arrived] == 0)
    assert np.all(ours.d_cov[arrived] == 0)
    assert np.all(np.isinf(ours.d_cov[~arrived]))


def test_an_attacked_sensor_that_is_not_trusted_is_as_good_as_absent():
    plant = spoofable()
    u, y, seen = systems.random_log(1, plant, 25)
    ours = estimates(unknown_input.build(plant, [0, 0], np.eye(2)), u, y, seen)
    without = seen.copy()
    without[:, 0] = False
    truth = estimates(kalman.build(plant, [0, 0], np.eye(2)), u, y, without)
    np.testing.assert_allclose(ours.x, truth.x, atol=1e-12)
    np.testing.assert_allclose(ours.x_cov, truth.x_cov, atol=1e-12)
    # attack = sample - what the others say of it, its noise correlated with theirs
    assert words(ours) == {"OK"}


@pytest.mark.parametrize("factor", [1e-9, 1e9])
def test_units_of_an_attack_do_not_matter(factor):
    u, y, seen = systems.random_log(2, spoofable(), 25, 0.2)
    ours = estimates(unknown_input.build(spoofable(factor), [0, 0], np.eye(2)), u, y, seen)
    truth = estimates(unknown_input.build(spoofable(), [0, 0], np.eye(2)), u, y, seen)
    np.testing.assert_array_equal(ours.status, truth.status)
    np.testing.assert_allclose(ours.x, truth.x, rtol=1e-10)
    np.testing.assert_allclose(ours.d * factor, truth.d, rtol=1e-10)


def test_the_residual_is_blind_to_the_attack_and_counts_what_is_left():
    """Any attack on the free channel leaves the residual as it was; rank p - 1."""
    plant = spoofable()
    u, y, seen = systems.random_log(3, plant, 25)
    lies = y.copy()
    lies[:, 0] += 1e3
    estimator = unknown_input.build(plant, [0, 0], np.eye(2))
    honest, attacked = estimates(estimator, u, y, seen), estimates(estimator, u, lies, seen)
    np.testing.assert_allclose(attacked.residual, honest.residual, atol=1e-9)
    np.testing.assert_allclose(attacked.d - honest.d, 1e3, rtol=1e-12)
    assert np.linalg.matrix_rank(honest.residual_cov[-1], tol=1e-9) == 2


def test_the_attacks_limits_follow_the_input():
    """A limit on d + u: the bound of d at a row is the limit less that row's input."""
    plant = linear_plant(
        A=[[0.9]], B=[[1]], C=[[1]], G=[[1]], Q=[[0.1]], R=[[0.1]],
        constraints={"attack": {"matrix": [[1], [-1]], "bound": [3, 3], "bound_u": [[-1], [1]]}},
    )  # fmt: skip
    u = np.array([[0.5], [-2.0]])
    got = estimates(
        unknown_input.build(plant, [0], [[1]]), u, np.zeros((2, 1)), np.ones((2, 1), bool)
    )
    np.testing.assert_allclose(got.d_bound, [[2.5, 3.5], [5.0, 1.0]])
