"""One of six sensors lies at each step, another at the next: what that does to each estimate.

Run: python examples/50_hopping_attack.py
"""

from pathlib import Path

import equinox as eqx
import jax
import numpy as np

import holdfast
from holdfast.estimators import kalman, l1_kalman

SCENARIO = Path(__file__).parent / "scenarios" / "hopping.toml"
RUNS, STEPS, WARM = 20, 300, 50


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
        "l1_kalman, raw": l1_kalman.build(plant, *start, window=8),
        "l1_kalman, threshold 5": scenario.monitor.estimator,
        "kalman, nobody lies": kalman.build(plant, *start),
    }
    print(f"{'':24}place (m)  speed (m/s)   root mean square over {RUNS} runs")
    for name, estimator in contest.items():
        honest = eqx.tree_at(lambda s: s.attacks, scenario, ())
        trace = traces(estimator, honest if "nobody" in name else scenario)
        error = (np.asarray(trace.estimate.x) - np.asarray(trace.x))[:, WARM:]
        print(f"{name:24}{np.sqrt(np.mean(error**2, (0, 1))).round(4)}")
        if "threshold" in name:
            said, lied = np.asarray(trace.estimate.a) != 0, np.asarray(trace.injection.y) != 0
            print(f"{'':24}{np.mean(said[lied]):.1%} of the lies named, ", end="")
            print(f"{np.mean(said[~lied]):.2%} of the honest samples")


if __name__ == "__main__":
    main()
