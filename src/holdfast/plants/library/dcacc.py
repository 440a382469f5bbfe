"""Adaptive cruise control that has lost the radio: a lidar alone sees the vehicle in front."""

from collections.abc import Sequence

import numpy as np

from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.linear import LinearPlant
from holdfast.plants.named import channels

TAU = 0.8
"""The paper's maneuver time constant, s."""
MANEUVER = 1.0
LIDAR = (0.01, 0.01)
"""Variances chosen here: (m/s^2)^2; m^2, (m/s)^2."""
INPUTS, OUTPUTS = ("command",), ("measured_distance", "measured_speed")


def build(
    *,
    dt: float = 0.01,
    tau: float = TAU,
    process_noise: float = MANEUVER,
    sensor_noise: Sequence[float] = LIDAR,
    attacks: Sequence[str] = (),
) -> LinearPlant:
    """Degraded cooperative adaptive cruise control, with the Singer model of (63), (64):

        d' = -v,   v' = a,   a' = -a / tau + u + w,   y = (d, v)

    d (m) the distance to the vehicle in front, v (m/s) its speed, a (m/s^2) its acceleration
    with the time constant ``tau`` (s); sampled exactly over ``dt`` seconds, u (m/s^3) held.
    Two modes at z = 1, observability index 2.

    The paper states no noise; this one is chosen here. w is Singer's: white, of intensity
    2 ``process_noise`` / tau, so that ``process_noise`` (default 1 (m/s^2)^2) is the variance that
    the acceleration has in the long run without u. ``sensor_noise``: the variances of a sample
    of distance and speed (0.01 m^2 and 0.01 (m/s)^2: 10 cm and 10 cm/s).

    states "distance", "speed", "acceleration", input "command", outputs "measured_distance",
    "measured_speed". ``attacks``: the attack channels, of "actuator:command",
    "sensor:measured_distance", "sensor:measured_speed" (`holdfast.plants.named`), held over a
    sample like u.

    Raises `InvalidValue` for a time, a variance or an attack that cannot be.

    Source: INTEGRITY, Section VI-B, errata 11; Singer, Estimating optimal tracking filter
    performance for manned maneuvering targets (1970).
    """
    if not (np.isfinite(tau) and tau > 0):
        raise InvalidValue("tau", tau, "a positive number of seconds")
    if not (np.isfinite(process_noise) and process_noise >= 0):
        raise InvalidValue("process_noise", process_noise, "a variance, 0 or more")
    if len(sensor_noise) != 2 or not all(np.isfinite(r) and r > 0 for r in sensor_noise):
        raise InvalidValue("sensor_noise", list(sensor_noise), "two variances above 0")
    act, sens = channels(attacks, INPUTS, OUTPUTS)
    push = np.array([[0.0], [0.0], [1.0]])
    return linear_plant(
        time="continuous",
        noise="white",
        dt=dt,
        A=[[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / tau]],
        B=push,
        C=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        G=push @ act,
        H=sens,
        Q=np.diag([0.0, 0.0, 2.0 * process_noise / tau]),
        R=np.diag(sensor_noise),
        states=["distance", "speed", "acceleration"],
        inputs=INPUTS,
        outputs=OUTPUTS,
        attacks=attacks,
    )
