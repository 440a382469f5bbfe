import numpy as np
import pytest
import scipy.linalg

from holdfast.parts import InvalidValue
from holdfast.plants.library.quadrotor import build

POSITIONS = ("p_x", "p_y", "p_z")


def rates():
    """x' = A x + B u of DECODER, Section V-A, written down again row by row."""
    g, d0, d1, n0, kT = 9.81, 10.0, 8.0, 10.0, 0.91
    tilt = [[0, 1, 0, 0], [0, 0, g, 0], [0, 0, -d1, 1], [0, 0, -d0, 0]]
    A = scipy.linalg.block_diag(tilt, tilt, [[0, 1], [0, 0]])
    push = [[0], [0], [0], [n0]]
    return A, scipy.linalg.block_diag(push, push, [[0], [kT]])


@pytest.mark.parametrize("dt", [0.1, 0.02])
def test_dynamics_are_the_exponential(dt):
    A, B = rates()
    plant = build(dt=dt)
    whole = scipy.linalg.expm(dt * np.block([[A, B], [np.zeros((3, 13))]]))
    np.testing.assert_allclose(plant.A, whole[:10, :10], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(plant.B, whole[:10, 10:], rtol=1e-12, atol=1e-14)
    assert (plant.dt, plant.constant) == (dt, True)


def test_noise_is_the_integral_over_a_sample():
    A, _ = rates()
    plant = build(acceleration_noise=0.3, tilt_noise=0.7)
    density = np.diag([0, 0.3, 0, 0.7, 0, 0.3, 0, 0.7, 0, 0.3]) ** 2
    nodes, weights = np.polynomial.legendre.leggauss(12)
    moved = [scipy.linalg.expm(A * 0.05 * (node + 1)) for node in nodes]
    Q = sum(0.05 * w * m @ density @ m.T for w, m in zip(weights, moved, strict=True))
    np.testing.assert_allclose(plant.Q, Q, rtol=1e-10, atol=1e-16)
    # the vertical axis, by hand: 0.3^2 [[dt^3/3, dt^2/2], [dt^2/2, dt]]
    expected = 0.09 * np.array([[1e-3 / 3, 5e-3], [5e-3, 0.1]])
    np.testing.assert_allclose(plant.Q[8:, 8:], expected, rtol=1e-12)


def test_eigenvalues():
    slow, fast = np.exp(0.1 * np.roots([1, 8, 10]).real[::-1])
    found = np.sort(np.linalg.eigvals(np.asarray(build().A)).real)
    np.testing.assert_allclose(found[:4], [fast, fast, slow, slow], rtol=1e-10)
    # three double integrators: rounding moves a double eigenvalue by about its square root
    np.testing.assert_allclose(found[4:], 1.0, atol=1e-6)


def test_a_held_reference_angle_is_reached_and_accelerates():
    plant = build()
    A, B = np.asarray(plant.A), np.asarray(plant.B)
    x = np.zeros(10)
    for _ in range(100):
        before, x = x, A @ x + B @ [0.02, 0.0, 2.0]
    np.testing.assert_allclose(x[2], 0.02, rtol=1e-5)  # n0 = d0: the angle that was asked for
    np.testing.assert_allclose((x - before)[1] / 0.1, 9.81 * 0.02, rtol=1e-5)
    np.testing.assert_allclose(x[9], 0.91 * 2.0 * 10.0, rtol=1e-12)
    np.testing.assert_array_equal(x[4:8], 0.0)
    # the angle stands still, but what the paper calls its velocity does not vanish
    np.testing.assert_allclose(x[3], 8.0 * 0.02, rtol=1e-5)


@pytest.mark.parametrize(
    ("sensors", "outputs"),
    [
        (3, POSITIONS),
        (5, (*POSITIONS, "v_x", "v_y")),
        (8, (*POSITIONS, "v_x", "v_y", "v_z", "theta_x", "theta_y")),
        (["p_z", "theta_y_rate"], ("p_z", "theta_y_rate")),
        (["p_x", "v_z", "p_x", "p_x"], ("p_x", "v_z", "p_x_2", "p_x_3")),
    ],
)
def test_sensors(sensors, outputs):
    plant = build(sensors=sensors, position_sd=2.0, speed_sd=3.0, angle_sd=5.0, rate_sd=7.0)
    assert plant.outputs == outputs
    assert plant.inputs == ("pitch_ref", "roll_ref", "thrust")
    assert plant.attacks == ()
    measured = [name.removesuffix("_2").removesuffix("_3") for name in outputs]
    picked = [[float(state == name) for state in plant.states] for name in measured]
    np.testing.assert_array_equal(plant.C, picked)
    assert plant.states[3] == "theta_x_rate"
    kinds = {"p": 4.0, "v": 9.0, "theta": 25.0, "theta_x": 49.0, "theta_y": 49.0}
    variances = [kinds[name.rpartition("_")[0]] for name in measured]
    np.testing.assert_allclose(plant.R, np.diag(variances), rtol=1e-14)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"sensors": 4}, "sensors: found 4, expected 3, 5 or 8"),
        ({"sensors": []}, "sensors: found an empty list"),
        ({"sensors": ["p_x", "p_w"]}, r"sensors\[2\]: found 'p_w', expected one of p_x, v_x"),
        ({"position_sd": 0.0}, "position_sd: found 0.0, expected a standard deviation over 0"),
        ({"tilt_noise": -1.0}, "tilt_noise: found -1.0, expected a noise density"),
        ({"rate_sd": float("nan")}, "rate_sd: found nan"),
        ({"dt": 0.0}, "dt: found 0.0"),
    ],
)
def test_wrong_settings_are_named(keys, message):
    with pytest.raises(InvalidValue, match=message):
        build(**keys)
