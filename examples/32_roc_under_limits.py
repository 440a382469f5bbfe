"""Likelihood ratio under limits against chi-square: the table of docs/detection_under_limits.md."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from holdfast.campaign.roc import Signal, compare
from holdfast.detectors import chi_square, likelihood_ratio
from holdfast.estimators import unknown_input
from holdfast.papers.care_vehicle import START, Setting, attack_signal
from holdfast.plants.build import linear_plant
from holdfast.plants.library import bicycle
from holdfast.records import Observation
from holdfast.report.roc_figure import roc_png, roc_table

LIMITS = {  # lower, upper, attack: in standard deviations of the attack's estimate
    "one-sided, inside": ([0, 0], [np.inf, np.inf], [1.5, 1.0]),
    "0 on a face, inside": ([0, -1], [2, 1], [1.0, 0.5]),
    "0 on a face, at the limits": ([0, -1], [2, 1], [2.0, -1.0]),
    "±6 sd, inside": ([-6, -6], [6, 6], [1.5, 1.0]),
    "±1 sd, inside": ([-1, -1], [1, 1], [0.7, -0.3]),
    "±1 sd, at the limits": ([-1, -1], [1, 1], [1.0, 1.0]),
}
ROWS = jax.tree.map(jnp.asarray, Observation.of(np.zeros((60, 0)), np.zeros((60, 4))))
settled = jax.jit(lambda e: jax.lax.scan(lambda *s: e.step(*s), e.init()[0], ROWS)[1].d_free_cov)


def random_plant(seed, low, high):
    rng = np.random.default_rng(seed)  # the attacks' estimates get a standard deviation of 1
    A, G, C, q, r = (rng.normal(size=s) for s in ((3, 3), (3, 2), (4, 3), (3, 3), (4, 4)))
    A, Q, R = 0.9 * A / max(abs(np.linalg.eigvals(A))), q @ q.T + np.eye(3), r @ r.T + np.eye(4)
    limits = {"matrix": np.vstack([np.eye(2), -np.eye(2)]), "bound": [*high, *-np.array(low)]}
    free = linear_plant(A=A, C=C, G=G, Q=Q, R=R)
    G = G * np.sqrt(np.diagonal(settled(unknown_input.build(free, np.zeros(3), np.eye(3)))[-1]))
    return linear_plant(A=A, C=C, G=G, Q=Q, R=R, constraints={"attack": limits})


def compared(plant, x0, P0, attack, rows):
    tests = {"chi-square": chi_square, "likelihood ratio": likelihood_ratio}
    tests = {name: module.build(plant, on="attack") for name, module in tests.items()}
    watched, attacks = unknown_input.build(plant, x0, P0), (Signal(jnp.asarray(attack)),)
    return compare(watched, tests, attacks, first=rows[0], steps=rows[1], seed=0)


if __name__ == "__main__":
    car, signal = bicycle.build(model="linear"), attack_signal(Setting())
    slower, found = np.where(np.any(signal != 0, 1, keepdims=True), [0.0, -1.0], 0.0), {}
    for name, d in (("car, the paper's attack", signal), ("car, acceleration -1", slower)):
        found[name] = compared(car, START, 1e-4 * np.eye(4), d, (101, 300))
    for name, (low, high, d) in LIMITS.items():
        for seed in (1, 2, 3):
            case = random_plant(seed, low, high), np.zeros(3), np.eye(3), np.array([d]), (61, 260)
            found[f"{name}, plant {seed}"] = compared(*case)
    print(roc_table(found, (0.01, 0.05)))
    for path in sys.argv[1:]:
        Path(path).write_bytes(roc_png({n: one for n, one in found.items() if n[-1] not in "23"}))
