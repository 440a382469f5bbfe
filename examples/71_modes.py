"""A GPS lies, then an accelerator, then both: how often a bank of modes says which of them.

Run: python examples/71_modes.py
"""

from pathlib import Path

import equinox as eqx
import jax
import numpy as np

import holdfast
from holdfast.estimators import nisme
from holdfast.evaluate.modes import accuracy
from holdfast.report.truth import true_attack, true_mode

SCENARIO = Path(__file__).parent / "scenarios" / "modes.toml"
RUNS, STEPS = 20, 700
PRIOR = np.array([20.0, 10.0])
BOTH = [["gps_spoof", "accel_attack"]]
CONTEST = {
    "evidence": {},
    "prior ten times smaller": {"attack_prior_sd": PRIOR / 10},
    "prior ten times larger": {"attack_prior_sd": PRIOR * 10},
    "the paper's likelihood": {"likelihood": "paper"},
    "without its normaliser": {"likelihood": "quadratic"},
    "floor 1e-8": {"floor": 1e-8},
    "chain, 1 % a row": {"transition": 0.01},
    "bank of one mode": {"bank": BOTH},
}


@eqx.filter_jit
def traces(scenario, keys):
    return jax.vmap(lambda key: holdfast.simulate(scenario, key, STEPS))(keys)


def main():
    scenario = holdfast.load_scenario(SCENARIO)
    plant, start = scenario.plant, ([0.0, 0.0], 0.01 * np.eye(2))
    keys = jax.random.split(jax.random.key(0), RUNS)
    print(f"{'share of rows with the right mode':34}{'all':>6}{'none':>7}{'gps':>6}{'accel':>7}"
          f"{'both':>6}")  # fmt: skip
    for name, settings in CONTEST.items():
        estimator = nisme.build(
            plant, *start, modes="all", **{"attack_prior_sd": list(PRIOR), **settings}
        )
        monitor = holdfast.Monitor(estimator, scenario.monitor.detector)
        trace = traces(eqx.tree_at(lambda s: s.monitor, scenario, monitor), keys)
        weighed = estimator.hypotheses or estimator.sets
        truth = true_mode(trace, true_attack(trace, plant), weighed)
        believed = np.asarray(trace.estimate.mode)
        each = [accuracy(believed, np.where(truth == i, truth, -1)).value for i in range(4)]
        print(
            f"{name:33}", *(f"{value:6.2f}" for value in [accuracy(believed, truth).value, *each])
        )


if __name__ == "__main__":
    main()
