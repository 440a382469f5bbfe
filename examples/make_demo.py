"""Fly the demo: a drone under a slow GPS spoof, written as a log.

python examples/make_demo.py [LOG]    (default: examples/data/drone_spoof.csv)

The autopilot steers by an ordinary Kalman filter that believes its GPS, so the spoof drags
the drone away from where it should hover. Plant, attack, controller and seed are those of
examples/scenarios/drone_spoof.toml; the log holds what the autopilot recorded, the true
flight is not in it.
"""

import csv
import sys
from pathlib import Path

import equinox as eqx
import jax
import numpy as np

from holdfast import Kalman, simulate
from holdfast.shell.files import read_scenario

HERE = Path(__file__).parent


def flight():
    """Scenario and trace of the flight that the autopilot flew."""
    found = read_scenario(HERE / "scenarios" / "drone_spoof.toml")
    watching = found.scenario.monitor.estimator
    autopilot = Kalman(watching.plant, watching.x0, watching.P0)
    flown = eqx.tree_at(lambda s: s.monitor.estimator, found.scenario, autopilot)
    return flown, simulate(flown, jax.random.key(found.run.seed), found.run.steps)


def write(path, plant, observation):
    """The log: time, inputs, outputs, to a millimetre."""
    rows = len(observation.y)
    values = np.hstack([observation.u, observation.y])
    with open(path, "w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        names = [f"u:{name}" for name in plant.inputs] + [f"y:{name}" for name in plant.outputs]
        out.writerow(["time", *names])
        for k in range(rows):
            out.writerow([f"{(k + 1) * plant.dt:.1f}", *(f"{v:.3f}" for v in values[k])])


if __name__ == "__main__":
    scenario, trace = flight()
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "data" / "drone_spoof.csv"
    write(path, scenario.plant, trace.observation)
    north, east = np.asarray(trace.x)[-1, :2]
    print(f"{path}: {len(trace.x)} rows; the drone ends {north:.1f} m north, {east:.1f} m east")
