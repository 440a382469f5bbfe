import numpy as np
import pytest

from holdfast.numerics.steady_state import UNSTABLE
from holdfast.parts import InvalidValue
from holdfast.plants.library.dcacc import build


def by_hand(tau, dt):
    """(63) integrated: a fades as e^(-t/tau), v is its integral, d falls by that of v."""
    fade = np.exp(-dt / tau)
    once = tau * (1 - fade)
    twice = tau * (dt - once)
    A = np.array([[1.0, -dt, -twice], [0.0, 1.0, once], [0.0, 0.0, fade]])
    # an input held over the sample: the integrals of the last column
    B = np.array([[-tau * (dt**2 / 2 - twice)], [twice], [once]])
    return A, B


@pytest.mark.parametrize(("tau", "dt"), [(0.8, 0.01), (0.8, 0.1), (2.0, 0.5)])
def test_matrices(tau, dt):
    plant = build(tau=tau, dt=dt)
    A, B = by_hand(tau, dt)
    # differences of numbers of size dt that cancel to dt^3
    np.testing.assert_allclose(plant.A, A, rtol=0, atol=1e-14)
    np.testing.assert_allclose(plant.B, B, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(plant.C, [[1, 0, 0], [0, 1, 0]])
    assert (plant.dt, plant.constant) == (dt, True)


def test_names_and_defaults():
    plant = build()
    assert plant.states == ("distance", "speed", "acceleration")
    assert plant.inputs == ("command",)
    assert plant.outputs == ("measured_distance", "measured_speed")
    assert (plant.attacks, plant.dt) == ((), 0.01)
    np.testing.assert_allclose(plant.A, by_hand(0.8, 0.01)[0], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(plant.R, np.diag([0.01, 0.01]))


def test_what_the_paper_says_of_it():
    """Observability index 2, two unstable modes, both at 1."""
    plant = build()
    A, C = np.asarray(plant.A), np.asarray(plant.C)
    assert np.linalg.matrix_rank(C) == 2
    assert np.linalg.matrix_rank(np.vstack([C, C @ A])) == 3
    modes = np.sort(np.abs(np.linalg.eigvals(A)))
    assert np.sum(modes >= UNSTABLE) == 2
    # a double eigenvalue in one Jordan block: rounding moves it by its square root
    np.testing.assert_allclose(modes[1:], 1.0, atol=1e-7)
    np.testing.assert_allclose(modes[0], np.exp(-0.01 / 0.8), rtol=1e-12)


def test_process_noise():
    """Singer's: the variance of the acceleration, and the integral of its spread over a sample."""
    plant = build(process_noise=2.5, dt=0.2)
    A, Q = np.asarray(plant.A), np.asarray(plant.Q)
    fade = A[2, 2]
    np.testing.assert_allclose(Q[2, 2] / (1 - fade**2), 2.5, rtol=1e-12)
    t = (np.arange(20_000) + 0.5) / 20_000 * 0.2
    columns = np.stack([by_hand(0.8, s)[0][:, 2] for s in t])
    spread = 2 * 2.5 / 0.8 * columns.T @ columns * (t[1] - t[0])
    # the midpoint rule: relative error (dt / 20 000)^2
    np.testing.assert_allclose(Q, spread, rtol=1e-7)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"tau": 0.0}, "tau: found 0.0, expected a positive number of seconds"),
        ({"dt": -1.0}, "dt: found -1.0, expected a positive number of seconds"),
        ({"process_noise": -1.0}, "process_noise: found -1.0, expected a variance, 0 or more"),
        ({"sensor_noise": [1.0]}, "sensor_noise: found [1.0], expected two variances above 0"),
        ({"sensor_noise": [1.0, 0.0]}, "found [1.0, 0.0], expected two variances above 0"),
    ],
)
def test_wrong_settings_are_named(keys, message):
    with pytest.raises(InvalidValue) as caught:
        build(**keys)
    assert message in str(caught.value)
