"""A vehicle that follows a trajectory, its position and its speed measured, per axis."""

from collections.abc import Sequence

import numpy as np

from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.linear import LinearPlant
from holdfast.plants.named import channels

DT = 0.01
A = ((1.0, DT), (0.0, 1.0))
B = ((0.0001,), (0.01,))
PROCESS, SENSORS = 0.26984, 10.144


def build(
    *,
    axes: int = 1,
    process_noise: float = PROCESS,
    sensor_noise: float = SENSORS,
    attacks: Sequence[str] = (),
) -> LinearPlant:
    """Per axis the discrete model of (62), dt = 0.01 s:

        A = [[1, 0.01], [0, 1]],   B = [[0.0001], [0.01]],   C = I

    as printed (0.00005 would be the exact effect of a held acceleration on the position).
    Q = ``process_noise`` I and R = ``sensor_noise`` I, variances per step and per sample in the
    units of the states. The paper states neither them nor the detector's h; with the defaults
    and h = 8.399 its claims hold together: without enforcement an attacker of all sensors moves
    the estimate by more than 0.7 in 4 steps, with one authenticated sample in 20 or 30 he
    cannot, in 35 he can (over the first three of them).

    ``axes`` 1: states "position" (m), "speed" (m/s), input "accel" (m/s^2), outputs
    "measured_position", "measured_speed". ``axes`` 2: states x, x_speed, y, y_speed, inputs
    x_accel, y_accel, outputs measured_x, ..; the axes do not act on each other.
    ``attacks``: the attack channels, "actuator:accel", "sensor:measured_speed", ..
    (`holdfast.plants.named`).

    Raises `InvalidValue` for another number of axes, variances that cannot be or attacks that
    have no such name.

    Source: INTEGRITY, Section VI-A, errata 11.
    """
    if axes not in (1, 2):
        raise InvalidValue("axes", axes, "1 or 2")
    if not (np.isfinite(process_noise) and process_noise >= 0):
        raise InvalidValue("process_noise", process_noise, "a variance, 0 or more")
    if not (np.isfinite(sensor_noise) and sensor_noise > 0):
        raise InvalidValue("sensor_noise", sensor_noise, "a variance above 0")
    each, n = np.eye(axes), 2 * axes
    states = ["position", "speed"] if axes == 1 else ["x", "x_speed", "y", "y_speed"]
    inputs = ["accel"] if axes == 1 else ["x_accel", "y_accel"]
    outputs = [f"measured_{name}" for name in states]
    act, sens = channels(attacks, inputs, outputs)
    push = np.kron(each, B)
    return linear_plant(
        A=np.kron(each, A),
        B=push,
        C=np.eye(n),
        G=push @ act,
        H=sens,
        Q=process_noise * np.eye(n),
        R=sensor_noise * np.eye(n),
        dt=DT,
        states=states,
        inputs=inputs,
        outputs=outputs,
        attacks=attacks,
    )
