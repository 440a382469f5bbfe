"""A small monitored plant for the tests of campaigns."""

import jax
import jax.numpy as jnp
import numpy as np

from holdfast.campaign.attack_free import attack_free
from holdfast.detectors import chi_square, cusum, per_channel, sprt, windowed
from holdfast.estimators import kalman, nisme, unknown_input
from holdfast.loop import Monitor
from holdfast.plants.build import linear_plant

ESTIMATORS = {"kalman": kalman, "unknown_input": unknown_input, "nisme": nisme}
DETECTORS = {
    "chi_square": (chi_square, {}),
    "windowed": (windowed, {}),
    "weighted": (windowed, {"length": 4, "weights": [0.2, 0.5, 1.0, 2.0]}),
    "cusum": (cusum, {"forgetting": 0.8}),
    "sprt": (sprt, {}),
    "per_channel": (per_channel, {}),
}


def plant(growth=1.0):
    """Position and speed, three correlated sensors, an attack on the speed and one on a sensor."""
    return linear_plant(
        A=[[growth, 0.1], [0.0, 0.95]],
        B=[[0.0], [0.1]],
        C=[[1.0, 0.0], [0.0, 1.0], [1.0, 0.3], [0.2, 1.0]],
        G=[[0.005, 0.0], [0.1, 0.0]],
        H=[[0.0, 0.0], [0.0, 0.0], [0.0, 1.0], [0.0, 0.0]],
        Q=np.diag([1e-4, 1e-3]),
        R=0.02 * np.eye(4) + 0.02,
        dt=0.1,
        outputs=["gps", "wheel", "baro", "radar"],
        attacks=["accel", "spoof"],
    )


def monitor(name, on, estimator, growth=1.0, **settings):
    module, own = DETECTORS[name]
    p = plant(growth)
    build = ESTIMATORS[estimator].build
    return Monitor(build(p, jnp.zeros(2), jnp.eye(2)), module.build(p, on=on, **own, **settings))


def rate(watched, runs, steps, seed=12345):
    """Alarms per row of attack-free runs with noise of their own, and the error between runs."""
    judged = attack_free(watched, None, jax.random.split(jax.random.key(seed), runs), steps)
    tested = np.isfinite(judged.threshold).sum(1)
    each = np.asarray(judged.alarm).sum(1) / tested
    return each.mean(), each.std(ddof=1) / np.sqrt(runs)
