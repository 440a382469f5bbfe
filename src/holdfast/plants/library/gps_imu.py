"""A flying vehicle in three axes, its positions seen by GPS and its speeds by an inertial unit."""

import numpy as np

from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.linear import LinearPlant

AXES = ("x", "y", "z")


def build(
    *,
    dt: float = 0.1,
    position_sd: float = 0.1,
    speed_sd: float = 0.1,
    acceleration_noise: float = 0.1,
) -> LinearPlant:
    """Double integrators: per axis p' = v, v' = u + a, sampled over ``dt`` seconds, u held.

        x = (p_x, p_y, p_z, v_x, v_y, v_z),   C = [C_IMU; C_GPS] = [[0, I], [I, 0]]

    with a white acceleration of density ``acceleration_noise`` q (m/s^1.5), so that per axis
    Q = q^2 [[dt^3/3, dt^2/2], [dt^2/2, dt]], and the deviations ``speed_sd`` (m/s) and
    ``position_sd`` (m) of a sample. The paper states the sensors alone; inputs and noise are
    chosen here.

    states (6), inputs (3: accelerations, m/s^2), outputs (6), no attack channel besides those
    of the sensors. More kinds of sensor are not more redundancy: a position is seen by its GPS
    output alone, so that no attack on it can be corrected whatever decodes.

    Raises `InvalidValue` for a deviation that is not positive or a negative density.

    Source: DECODER, Section IV-B.
    """
    for key, value in (("position_sd", position_sd), ("speed_sd", speed_sd)):
        if not (np.isfinite(value) and value > 0):
            raise InvalidValue(key, value, "a standard deviation over 0")
    if not (np.isfinite(acceleration_noise) and acceleration_noise >= 0):
        raise InvalidValue("acceleration_noise", acceleration_noise, "a noise density, 0 or more")
    zero, one = np.zeros((3, 3)), np.eye(3)
    return linear_plant(
        time="continuous",
        noise="white",
        dt=dt,
        A=np.block([[zero, one], [zero, zero]]),
        B=np.vstack([zero, one]),
        C=np.block([[zero, one], [one, zero]]),
        Q=np.diag([0.0] * 3 + [acceleration_noise**2] * 3),
        R=np.diag([speed_sd**2] * 3 + [position_sd**2] * 3),
        states=[*(f"p_{axis}" for axis in AXES), *(f"v_{axis}" for axis in AXES)],
        inputs=[f"accel_{axis}" for axis in AXES],
        outputs=[*(f"imu_v_{axis}" for axis in AXES), *(f"gps_p_{axis}" for axis in AXES)],
    )
