"""The vehicle of Section 5: the true run, and what ISE and CARE make of it.

What the paper leaves open or misprints is set as the errata found it to reproduce Table 1: the
linear time-varying model is the truth, v_k the true speed, R and Q variances, the state
clipped into its limits, the steering angle at 1.0472 rad, a^d = +3.5 in odd blocks of 100
steps and -3.5 in even ones.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from holdfast.detectors import cusum
from holdfast.estimators import care, unknown_input
from holdfast.loop import Monitor, replay
from holdfast.plants.library import bicycle
from holdfast.plants.linear import LinearPlant
from holdfast.records import Observation, Trace

DT = 0.01
FRONT = REAR = 1.5
START = np.array([0.0, 0.0, 0.0, 18.8])
PROCESS, MEASUREMENT = np.array(bicycle.PROCESS), np.array(bicycle.SENSORS)
LOW = np.array([0.0, 0.0, -np.inf, 0.0])
HIGH = np.array([bicycle.LENGTH, bicycle.WIDTH, np.inf, bicycle.TOP_SPEED])
STATE_ROWS = np.vstack([np.eye(4)[[0, 1, 3]], -np.eye(4)[[0, 1, 3]]])
ATTACK_ROWS = np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
FIRST = 100
"""The attack begins with d_100, which row 101 of the log is the first to feel."""
STEPS = 1000
PHI, LEVEL = 0.15, 0.01
"""The forgetting rate and the significance level of Section 5.2."""
SEEDS = 16


class Setting(NamedTuple):
    """What of the example can be changed: variances, the attack's size in rad, its presence."""

    process: np.ndarray = PROCESS
    measurement: np.ndarray = MEASUREMENT
    steering: float = 1.1
    attacked: bool = True
    seeds: int = SEEDS


class Run(NamedTuple):
    """One setting over all seeds: truth and estimates, seed first, then time.

    Row k - 1 of ``x`` is x_k and of ``d`` d_{k-1}, as in the estimates. ``outside`` says where
    the state had to be clipped. ``speed`` is v_{k-1}, in the matrices of row k.
    """

    speed: np.ndarray
    x: np.ndarray
    d: np.ndarray
    y: np.ndarray
    outside: np.ndarray
    ise: Trace
    care: Trace


def slip(delta):
    """The steering angle as the slip angle beta, the paper's first input."""
    return np.arctan(REAR / (FRONT + REAR) * np.tan(delta))


ATTACK_BOUND = np.array([slip(bicycle.STEERING)] * 2 + [bicycle.ACCELERATION] * 2)
"""The limits on (beta, a); the paper writes them in delta."""


def matrices(speed) -> tuple[np.ndarray, np.ndarray]:
    """A and G = B as Section 5.1 prints them, at one speed or an array of them."""
    v = np.asarray(speed, float)
    A, G = np.zeros((*v.shape, 4, 4)), np.zeros((*v.shape, 4, 2))
    A[...] = np.eye(4)
    A[..., 0, 3], A[..., 1, 2] = DT, v * DT
    G[..., 1, 0], G[..., 2, 0], G[..., 3, 1] = v * DT, v * DT / REAR, DT
    return A, G


def attack_signal(setting: Setting) -> np.ndarray:
    """D_0 to d_{STEPS-1} as (beta, a), the angle clipped at its limit."""
    k = np.arange(STEPS)
    delta = np.clip(setting.steering * np.sin(0.05 * k), -bicycle.STEERING, bicycle.STEERING)
    push = np.where((k // 100) % 2 == 1, bicycle.ACCELERATION, -bicycle.ACCELERATION)
    on = (k >= FIRST) & setting.attacked
    return np.where(on[:, None], np.stack([slip(delta), push], 1), 0.0)


@eqx.filter_jit
def _truth(key, d, process, measurement):
    """x_k, y_k and whether x_k was clipped, over the attack d."""

    def row(x, inputs):
        key, d = inputs
        w, v = jax.random.normal(key, (2, 4))
        move = DT * jnp.stack([x[3], x[3] * (x[2] + d[0]), x[3] * d[0] / REAR, d[1]])
        free = x + move + jnp.sqrt(process) * w
        x_next = jnp.clip(free, jnp.asarray(LOW), jnp.asarray(HIGH))
        y = x_next + jnp.sqrt(measurement) * v
        return x_next, (x[3], x_next, y, jnp.any(x_next != free))

    return jax.lax.scan(row, jnp.asarray(START), (jax.random.split(key, STEPS), d))[1]


def plant_along(speed: np.ndarray, setting: Setting) -> LinearPlant:
    """The product's linear vehicle along given speeds, one per step, with the paper's limits."""
    return bicycle.along(
        speed, dt=DT, front=FRONT, rear=REAR,
        process_variance=setting.process.tolist(), sensor_variance=setting.measurement.tolist(),
    )  # fmt: skip


@eqx.filter_jit
def _replayed(monitor: Monitor, A, G, logs: Observation) -> Trace:
    """Every seed's log (first axis) through the monitor with that seed's matrices."""

    def one(A, G, log):
        def changing(m):
            return m.estimator.plant.A, m.estimator.plant.B, m.estimator.plant.G

        return replay(eqx.tree_at(changing, monitor, (A, G, G)), log)

    return jax.vmap(one)(A, G, logs)


def watched(
    build: Callable, speed: np.ndarray, y: np.ndarray, setting: Setting, start: np.ndarray = START
) -> Trace:
    """The logs of all seeds replayed through an estimator and the test (55)-(56) on d before
    projection, as NumPy arrays.
    """
    # what the estimator finds out about the matrices' structure is the same at every speed > 0
    plant = plant_along(speed[0], setting)
    test = cusum.build(plant, level=LEVEL, on="attack", threshold="paper", forgetting=PHI)
    monitor = Monitor(build(plant, start, np.eye(4)), test)
    logs = Observation.of(np.zeros((*y.shape[:-1], 2)), y)
    arrays = jax.tree.map(jnp.asarray, (*matrices(speed), logs))
    return jax.tree.map(np.asarray, _replayed(monitor, *arrays))


def drive(setting: Setting) -> Run:
    """Every seed of a setting, driven and estimated."""
    d = attack_signal(setting)
    keys = jax.random.split(jax.random.key(0), setting.seeds)
    noise = jnp.asarray(setting.process), jnp.asarray(setting.measurement)
    truth = jax.vmap(lambda key: _truth(key, jnp.asarray(d), *noise))(keys)
    speed, x, y, outside = (np.asarray(part) for part in truth)
    found = [watched(part.build, speed, y, setting) for part in (unknown_input, care)]
    return Run(speed, x, np.broadcast_to(d, (setting.seeds, *d.shape)), y, outside, *found)
