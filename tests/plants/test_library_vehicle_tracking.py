import numpy as np
import pytest

from holdfast.parts import InvalidValue
from holdfast.plants.library.vehicle_tracking import build

# INTEGRITY (62) and errata 11, written down again
A, B = np.array([[1, 0.01], [0, 1]]), np.array([[0.0001], [0.01]])


def test_one_axis():
    plant = build()
    np.testing.assert_array_equal(plant.A, A)
    np.testing.assert_array_equal(plant.B, B)
    np.testing.assert_array_equal(plant.C, np.eye(2))
    np.testing.assert_array_equal(plant.Q, 0.26984 * np.eye(2))
    np.testing.assert_array_equal(plant.R, 10.144 * np.eye(2))
    assert (plant.dt, plant.constant) == (0.01, True)
    assert plant.states == ("position", "speed")
    assert plant.inputs == ("accel",)
    assert plant.outputs == ("measured_position", "measured_speed")
    assert plant.attacks == ()


def test_two_axes_that_do_not_act_on_each_other():
    plant = build(axes=2, process_noise=0.5, sensor_noise=2.0)
    none = np.zeros((2, 2))
    np.testing.assert_array_equal(plant.A, np.block([[A, none], [none, A]]))
    np.testing.assert_array_equal(plant.B, np.block([[B, 0 * B], [0 * B, B]]))
    np.testing.assert_array_equal(plant.C, np.eye(4))
    np.testing.assert_array_equal(plant.Q, 0.5 * np.eye(4))
    np.testing.assert_array_equal(plant.R, 2.0 * np.eye(4))
    assert plant.states == ("x", "x_speed", "y", "y_speed")
    assert plant.inputs == ("x_accel", "y_accel")
    assert plant.outputs == ("measured_x", "measured_x_speed", "measured_y", "measured_y_speed")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"axes": 3}, "axes: found 3, expected 1 or 2"),
        ({"process_noise": -1.0}, "process_noise: found -1.0, expected a variance, 0 or more"),
        ({"sensor_noise": 0.0}, "sensor_noise: found 0.0, expected a variance above 0"),
    ],
)
def test_wrong_settings_are_named(keys, message):
    with pytest.raises(InvalidValue) as caught:
        build(**keys)
    assert str(caught.value) == message
