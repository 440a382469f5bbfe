"""One of six sensors lies by 20 m for 20 s: what it does to each estimate, and who is named.

Run: python examples/40_lying_sensor.py
"""

from pathlib import Path

import equinox as eqx
import jax
import numpy as np

import holdfast
from holdfast.estimators import kalman, secure_fusion

SCENARIO = Path(__file__).parent / "scenarios" / "lying_sensor.toml"
RUNS, STEPS = 20, 400


def traces(estimator, scenario):
    """Twenty simulated runs watched by this estimator."""
    monitor = holdfast.Monitor(estimator, scenario.monitor.detector)
    scenario = eqx.tree_at(lambda s: s.monitor, scenario, monitor)
    keys = jax.random.split(jax.random.key(0), RUNS)
    run = eqx.filter_jit(jax.vmap(lambda key: holdfast.simulate(scenario, key, STEPS)))
    return run(keys)


def main():
    scenario = holdfast.load_scenario(SCENARIO)
    plant, start = scenario.plant, ([0.0, 0.0], 0.01 * np.eye(2))
    contest = {
        "kalman": kalman.build(plant, *start),
        "secure_fusion": secure_fusion.build(plant, *start, rule="loss", share=0.01),
        "secure_fusion, refit": secure_fusion.build(plant, *start, refit=True),
        "kalman, nobody lies": kalman.build(plant, *start),
    }
    print(f"{'':24}place (m)  speed (m/s)   root mean square over {RUNS} runs")
    for name, estimator in contest.items():
        honest = eqx.tree_at(lambda s: s.attacks, scenario, ())
        trace = traces(estimator, honest if "nobody" in name else scenario)
        error = np.asarray(trace.estimate.x) - np.asarray(trace.x)
        print(f"{name:24}{np.sqrt(np.mean(error**2, (0, 1))).round(3)}")
        if name == "secure_fusion, refit":
            said, lied = np.asarray(trace.estimate.a), np.asarray(trace.injection.y) != 0
            named = np.mean(said[..., 0][lied[..., 0]] != 0)
            others = np.mean(said[..., 1:] != 0)
            print(f"{'':24}{plant.outputs[0]} named in {named:.1%} of the rows in which it lies, ")
            print(f"{'':24}an honest sensor in {others:.2%} of all rows")


if __name__ == "__main__":
    main()
