"""The kinematic bicycle: a car whose steering and acceleration may be falsified.

    x' = v cos(psi + beta),  y' = v sin(psi + beta),  psi' = v / l_r sin(beta),  v' = a,
    beta = arctan(l_r / (l_f + l_r) tan(delta))

x, y (m) of the centre of mass, heading psi (rad), speed v (m/s); steering delta (rad),
acceleration a (m/s^2); beta is the angle of the velocity to the car's axis. At v = 0 steering
moves nothing: that channel is then undetermined, which the estimators report.

Source: CARE Section 5.1, errata 10.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.linear import LinearPlant, Table
from holdfast.plants.nonlinear import NonlinearPlant, nonlinear_plant, sampled

STATES = ("x", "y", "heading", "speed")
PROCESS = (0.1, 0.1, 0.001, 0.0001)
SENSORS = (0.01, 0.01, 0.001, 0.00001)
"""The paper's variances: m^2, m^2, rad^2, (m/s)^2, per step and per sample."""
LENGTH, WIDTH, TOP_SPEED = 20.0, 5.0, 22.0
STEERING, ACCELERATION = 1.0472, 3.5
"""The paper's limits: m, m, m/s; rad, m/s^2."""
FASTEST = 100.0
"""The linear model is scheduled on speeds from -100 to 100 m/s; it is linear in between."""


def build(
    *,
    model: Literal["nonlinear", "linear"] = "nonlinear",
    dt: float = 0.01,
    front: float = 1.5,
    rear: float = 1.5,
    process_variance: Sequence[float] = PROCESS,
    sensor_variance: Sequence[float] = SENSORS,
    length: float = LENGTH,
    width: float = WIDTH,
    top_speed: float = TOP_SPEED,
    steering: float = STEERING,
    acceleration: float = ACCELERATION,
) -> LinearPlant | NonlinearPlant:
    """A car on a ground of ``length`` x ``width`` metres, all four states measured.

    "nonlinear": sampled by Runge-Kutta over ``dt`` seconds; inputs "steering" (rad) and
    "accel" (m/s^2), and an attack that adds to each. "linear": the paper's model about a
    small heading, scheduled on the speed, with inputs and attacks "slip" (beta, rad) and
    "accel". Limits: 0 <= x <= length, 0 <= y <= width, 0 <= v <= top_speed, and on command
    plus attack |steering|, |acceleration|; inf for none. ``front``, ``rear``: l_f, l_r (m).

    Raises `InvalidValue` for a length or variance that cannot be.
    """
    _check(dt=dt, front=front, rear=rear)
    limits = _limits(length, width, top_speed, steering, acceleration)
    if model == "linear":
        grid = jnp.array([-FASTEST, FASTEST])
        A, B = (Table(grid, jnp.asarray(m)) for m in _matrices(np.asarray(grid), dt, rear))
        return _linear(
            A, B, dt, _in_slip(limits, front, rear), process_variance, sensor_variance, "speed"
        )

    def rate(x, u, d):
        beta = jnp.arctan(rear / (front + rear) * jnp.tan(u[0] + d[0]))
        heading, speed = x[2], x[3]
        return jnp.stack(
            [
                speed * jnp.cos(heading + beta),
                speed * jnp.sin(heading + beta),
                speed / rear * jnp.sin(beta),
                u[1] + d[1],
            ]
        )

    return nonlinear_plant(
        sampled(rate, dt),
        lambda x, u, d: x,
        Q=np.diag(process_variance),
        R=np.diag(sensor_variance),
        dt=dt,
        states=STATES,
        inputs=["steering", "accel"],
        outputs=[f"measured_{name}" for name in STATES],
        attacks=["steering_attack", "accel_attack"],
        constraints=limits,
    )


def along(
    speeds: Sequence[float] | np.ndarray,
    *,
    dt: float = 0.01,
    front: float = 1.5,
    rear: float = 1.5,
    process_variance: Sequence[float] = PROCESS,
    sensor_variance: Sequence[float] = SENSORS,
    length: float = LENGTH,
    width: float = WIDTH,
    top_speed: float = TOP_SPEED,
    steering: float = STEERING,
    acceleration: float = ACCELERATION,
) -> LinearPlant:
    """The linear model of `build` with the speed given for every step, as the paper has it.

    ``speeds[k-1]`` (m/s) is the speed at k-1, from which the car moves to row k.
    """
    _check(dt=dt, front=front, rear=rear)
    limits = _limits(length, width, top_speed, steering, acceleration)
    A, B = _matrices(np.asarray(speeds, float), dt, rear)
    return _linear(A, B, dt, _in_slip(limits, front, rear), process_variance, sensor_variance)


def _matrices(speeds: np.ndarray, dt: float, rear: float) -> tuple[np.ndarray, np.ndarray]:
    """A_k and B_k = G_k of the paper for each speed."""
    A = np.tile(np.eye(4), (len(speeds), 1, 1))
    A[:, 0, 3] = dt
    A[:, 1, 2] = speeds * dt
    B = np.zeros((len(speeds), 4, 2))
    B[:, 1, 0] = speeds * dt
    B[:, 2, 0] = speeds * dt / rear
    B[:, 3, 1] = dt
    return A, B


def _linear(A: Any, B: Any, dt, limits, process, sensors, scheduling=None) -> LinearPlant:
    return linear_plant(
        A=A,
        B=B,
        G=B,
        C=np.eye(4),
        Q=np.diag(process),
        R=np.diag(sensors),
        dt=dt,
        states=STATES,
        inputs=["slip", "accel"],
        outputs=[f"measured_{name}" for name in STATES],
        attacks=["slip_attack", "accel_attack"],
        scheduling=scheduling,
        constraints=limits,
    )


def _limits(length, width, top_speed, steering, acceleration) -> dict[str, dict[str, Any]]:
    for key, value in (
        ("length", length),
        ("width", width),
        ("top_speed", top_speed),
        ("steering", steering),
        ("acceleration", acceleration),
    ):
        if not value > 0:
            raise InvalidValue(key, value, "a number above 0, or inf for no limit")
    seen = np.eye(4)[[0, 1, 3]]
    both = np.kron(np.eye(2), [[1.0], [-1.0]])
    return {
        "state": {
            "matrix": np.vstack([seen, -seen]),
            "bound": [length, width, top_speed, 0.0, 0.0, 0.0],
        },
        "attack": {
            "matrix": both,
            "bound": [steering, steering, acceleration, acceleration],
            "bound_u": -both,
        },
    }


def _in_slip(limits: dict[str, dict[str, Any]], front: float, rear: float):
    """The limit on delta as the one on beta that it means."""
    steering, _, acceleration, _ = limits["attack"]["bound"]
    slip = math.atan(rear / (front + rear) * math.tan(min(steering, math.pi / 2)))
    attack = {**limits["attack"], "bound": [slip, slip, acceleration, acceleration]}
    return {**limits, "attack": attack}


def _check(**lengths: float) -> None:
    for key, value in lengths.items():
        if not (np.isfinite(value) and value > 0):
            raise InvalidValue(key, value, "a number above 0")
