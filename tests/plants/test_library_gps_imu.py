import numpy as np
import pytest

from holdfast.parts import InvalidValue
from holdfast.plants.library.gps_imu import build


def test_the_closed_form():
    dt, q = 0.5, 0.3
    plant = build(dt=dt, position_sd=2.0, speed_sd=0.25, acceleration_noise=q)
    one, zero = np.eye(3), np.zeros((3, 3))
    np.testing.assert_allclose(plant.A, np.block([[one, dt * one], [zero, one]]), atol=1e-14)
    np.testing.assert_allclose(plant.B, np.vstack([dt**2 / 2 * one, dt * one]), atol=1e-14)
    per_axis = q**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    np.testing.assert_allclose(plant.Q, np.kron(per_axis, one), rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(plant.C, np.block([[zero, one], [one, zero]]))
    np.testing.assert_allclose(plant.R, np.diag([0.0625] * 3 + [4.0] * 3), rtol=1e-14)


def test_names():
    plant = build()
    assert plant.states == ("p_x", "p_y", "p_z", "v_x", "v_y", "v_z")
    assert plant.inputs == ("accel_x", "accel_y", "accel_z")
    assert plant.outputs == (
        "imu_v_x", "imu_v_y", "imu_v_z", "gps_p_x", "gps_p_y", "gps_p_z",
    )  # fmt: skip
    assert (plant.attacks, plant.dt) == ((), 0.1)


def test_a_shift_of_a_position_is_seen_by_one_sensor_at_every_time():
    """Errata 7: no decoder can tell it from an attack on that sensor."""
    plant = build()
    A, C = np.asarray(plant.A), np.asarray(plant.C)
    for axis in range(3):
        x = np.eye(6)[axis]
        for k in range(12):
            assert np.flatnonzero(C @ np.linalg.matrix_power(A, k) @ x).tolist() == [3 + axis]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"position_sd": 0.0}, "position_sd: found 0.0"),
        ({"speed_sd": float("inf")}, "speed_sd: found inf"),
        ({"acceleration_noise": -1.0}, "acceleration_noise: found -1.0"),
    ],
)
def test_wrong_settings_are_named(keys, message):
    with pytest.raises(InvalidValue, match=message):
        build(**keys)
