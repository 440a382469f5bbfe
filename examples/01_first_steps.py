"""A cart whose GPS starts to lie: estimate, attack and alarm, sample by sample."""

import jax
import numpy as np

import holdfast
from holdfast.attacks import bias
from holdfast.detectors import chi_square
from holdfast.estimators import unknown_input
from holdfast.plants.build import linear_plant

plant = linear_plant(
    A=[[1, 0.1], [0, 1]],
    C=np.eye(2),
    H=[[1], [0]],
    Q=1e-4 * np.eye(2),
    R=np.diag([1.0, 0.01]),
    dt=0.1,
    states=["place", "speed"],
    outputs=["gps", "wheel"],
    attacks=["gps_spoof"],
)
estimator = unknown_input.build(plant, [0, 0], 0.01 * np.eye(2))
monitor = holdfast.Monitor(estimator, chi_square.build(plant, level=1e-3, on="attack"))

# a simulated run: the spoof shifts the GPS by 8 m from 5 s on
spoof = bias.build(plant, channel="channel:gps_spoof", start=5.0, value=8.0)
scenario = holdfast.Scenario(plant, np.zeros(2), monitor, attacks=(spoof,))
trace = holdfast.simulate(scenario, jax.random.key(0), 100)

# the same samples once more, as they would come from a stream
live = holdfast.Live(monitor)
for k in range(100):
    sample = jax.tree.map(lambda a, k=k: np.asarray(a[k]), trace.observation)
    estimate, verdict = live.push(sample)
    if verdict.alarm:
        sd = float(np.sqrt(estimate.d_cov[0, 0]))
        print(f"{0.1 * (k + 1):.1f} s: alarm, spoof {estimate.d[0]:.1f} m, sd {sd:.1f} m")
        break
