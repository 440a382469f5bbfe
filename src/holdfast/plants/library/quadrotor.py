"""A quadrotor near hover: two tilting axes and a vertical one, whichever states are measured."""

from collections.abc import Sequence

import numpy as np

from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.linear import LinearPlant
from holdfast.plants.named import channels

STATES = (
    "p_x", "v_x", "theta_x", "theta_x_rate",
    "p_y", "v_y", "theta_y", "theta_y_rate",
    "p_z", "v_z",
)  # fmt: skip
INPUTS = ("pitch_ref", "roll_ref", "thrust")
GRAVITY = 9.81
D0, D1, N0 = 10.0, 8.0, 10.0
"""Attitude loop from a reference angle to the angle: N0 / (s^2 + D1 s + D0)."""
THRUST_GAIN = 0.91

GPS = ("p_x", "p_y", "p_z")
SENSORS = {
    3: GPS,
    5: (*GPS, "v_x", "v_y"),
    8: (*GPS, "v_x", "v_y", "v_z", "theta_x", "theta_y"),
}
"""What a count of sensors stands for."""


def build(
    *,
    dt: float = 0.1,
    sensors: int | list[str] = 5,
    position_sd: float = 0.1,
    speed_sd: float = 0.1,
    angle_sd: float = 0.01,
    rate_sd: float = 0.05,
    acceleration_noise: float = 0.1,
    tilt_noise: float = 0.1,
    attacks: Sequence[str] = (),
) -> LinearPlant:
    """The ten-state model of the DECODER paper. For both horizontal axes, and the vertical one,

        p' = v,   v' = g theta + a,   theta' = -d1 theta + rate,
        rate' = -d0 theta + n0 theta_ref + b;          p_z' = v_z,   v_z' = k_T F + a_z

    with g = 9.81, d0 = 10, d1 = 8, n0 = 10, k_T = 0.91, sampled exactly over ``dt`` seconds,
    the inputs held: the reference angles (rad) and the thrust F less what carries the weight.
    a and b are white: ``acceleration_noise`` (m/s^1.5) and ``tilt_noise`` (rad/s^1.5). "rate"
    is the second state of the attitude loop, theta' + d1 theta: not the angular velocity that
    the paper calls it.

    ``sensors``: 3 (GPS positions), 5 (and the horizontal speeds), 8 (positions, speeds and
    both angles: GPS and an inertial unit), or a list of states; a state named again is a second
    sensor of it, called "p_x_2". Deviations of a sample: ``position_sd`` (m), ``speed_sd``
    (m/s), ``angle_sd`` (rad), ``rate_sd`` (rad/s). The paper states no noise: the defaults are
    those of a good receiver and a small inertial unit in light wind.

    states (10), inputs (3), outputs named like the states. A position is seen by position
    sensors alone, however many others there are. ``attacks``: the attack channels,
    "actuator:thrust", "sensor:p_x", "sensor:p_x_2", .. (`holdfast.plants.named`), held over a
    sample like the inputs.

    Raises `InvalidValue` for a count of sensors other than 3, 5, 8, an unknown state or attack,
    a deviation that is not positive or a density that is negative.

    Source: DECODER, Section V-A; the model and its numbers: P. Bouffard, On-board Model
    Predictive Control of a Quadrotor Helicopter, UCB/EECS-2012-241.
    """
    deviations = {
        "position_sd": position_sd, "speed_sd": speed_sd, "angle_sd": angle_sd, "rate_sd": rate_sd,
    }  # fmt: skip
    densities = {"acceleration_noise": acceleration_noise, "tilt_noise": tilt_noise}
    _check(deviations, densities)
    measured = _measured(sensors)
    outputs = _numbered(measured)
    act, sens = channels(attacks, INPUTS, outputs)
    A, B, Q = np.zeros((10, 10)), np.zeros((10, 3)), np.zeros(10)
    for axis, first in enumerate((0, 4)):
        p, v, theta, rate = range(first, first + 4)
        A[p, v], A[v, theta] = 1.0, GRAVITY
        A[theta, [theta, rate]] = -D1, 1.0
        A[rate, theta], B[rate, axis] = -D0, N0
        Q[[v, rate]] = acceleration_noise**2, tilt_noise**2
    A[8, 9], B[9, 2], Q[9] = 1.0, THRUST_GAIN, acceleration_noise**2
    return linear_plant(
        time="continuous",
        noise="white",
        dt=dt,
        A=A,
        B=B,
        C=np.eye(10)[[STATES.index(name) for name in measured]],
        G=B @ act,
        H=sens,
        Q=np.diag(Q),
        R=np.diag([deviations[_kind(name)] ** 2 for name in measured]),
        states=STATES,
        inputs=INPUTS,
        outputs=outputs,
        attacks=attacks,
    )


def _measured(sensors: int | list[str]) -> tuple[str, ...]:
    """The state that each sensor measures."""
    if isinstance(sensors, int):
        if sensors not in SENSORS:
            raise InvalidValue("sensors", sensors, "3, 5 or 8, or a list of states")
        return SENSORS[sensors]
    if not sensors:
        raise InvalidValue("sensors", "an empty list", "at least one sensor")
    for i, name in enumerate(sensors, 1):
        if name not in STATES:
            raise InvalidValue(f"sensors[{i}]", repr(name), f"one of {', '.join(STATES)}")
    return tuple(sensors)


def _numbered(measured: tuple[str, ...]) -> list[str]:
    """Each name, from its second use on with the number of the use."""
    uses = [measured[: i + 1].count(name) for i, name in enumerate(measured)]
    return [name if k == 1 else f"{name}_{k}" for name, k in zip(measured, uses, strict=True)]


def _kind(state: str) -> str:
    """The key of the deviation of a sensor of this state."""
    if state.endswith("_rate"):
        return "rate_sd"
    return {"p": "position_sd", "v": "speed_sd", "theta": "angle_sd"}[state.rpartition("_")[0]]


def _check(deviations: dict[str, float], densities: dict[str, float]) -> None:
    for key, value in deviations.items():
        if not (np.isfinite(value) and value > 0):
            raise InvalidValue(key, value, "a standard deviation over 0")
    for key, value in densities.items():
        if not (np.isfinite(value) and value >= 0):
            raise InvalidValue(key, value, "a noise density, 0 or more")
