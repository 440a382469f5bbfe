"""CARE on the vehicle beside its own unconstrained filter and a Python loop with daqp.

    pip install ".[bench]"
    python benchmarks/care.py [--repeat 7]

Live: one sample in, one estimate out, both projections included, on the same log; the ratio
is CARE over `unknown_input`. Batch: 1024 runs of 100 rows, compiled, against Algorithm 1 in
NumPy with daqp for the two projections, run after run; the loop is timed on two runs and given
per run and row. Once as the estimator alone with every sample there, once as `replay`, which
looks for gaps in each run and judges every row. The answers are compared first.
"""

import argparse
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import equinox as eqx
import jax
import numpy as np

from holdfast import Live, Monitor, Observation
from holdfast.detectors import chi_square
from holdfast.estimators import care, unknown_input
from holdfast.loop import replay
from holdfast.plants.library.bicycle import along

jax.config.update("jax_cpu_enable_async_dispatch", False)

STEPS, RUNS = 100, 1024
BLOCK = 64
"""Runs side by side: more no longer fit the cache."""
PLANT = along(np.full(STEPS, 18.8))
START, P0 = np.array([0.0, 0.0, 0.0, 18.8]), np.eye(4)


def samples(runs: int) -> np.ndarray:
    """Noisy positions of a car that is attacked, which keep several limits active."""
    rng = np.random.default_rng(0)
    time_ = 0.01 * np.arange(1, STEPS + 1)
    truth = np.stack([18.8 * time_, 0.3 * np.sin(3 * time_), 0.2 * np.sin(5 * time_)], 1)
    truth = np.concatenate([truth, 22.0 - np.exp(-time_)[:, None]], 1)
    sd = np.sqrt(np.diagonal(np.asarray(PLANT.R)))
    return truth + sd * rng.normal(size=(runs, STEPS, 4))


def projected(point, cov, rows, bound):
    """The projection and (27), by daqp."""
    import daqp

    weight = np.linalg.inv(cov)
    lower, sense = np.full(len(bound), -1e30), np.zeros(len(bound), np.int32)
    z, _, _, info = daqp.solve(weight, -weight @ point, rows, bound, lower, sense)
    active = rows[np.asarray(info["lam"]) > 0]
    if not len(active):
        return point, cov
    gain = np.linalg.solve(active @ cov @ active.T, active @ cov).T
    return z, cov - gain @ active @ cov


def python_loop(y):
    """Algorithm 1, corrected, one run."""
    limits = PLANT.constraints
    of_x = np.array(limits.state.matrix), np.array(limits.state.bound)
    of_d = np.array(limits.attack.matrix), np.array(limits.attack.bound)
    A_all, G_all = np.asarray(PLANT.A), np.asarray(PLANT.G)
    Q, R, C = (np.asarray(m) for m in (PLANT.Q, PLANT.R, PLANT.C))
    x, P, eye, found = START, P0, np.eye(4), []
    for A, G, sample in zip(A_all, G_all, y, strict=True):
        prior, spread = A @ x, A @ P @ A.T + Q
        weight = np.linalg.inv(C @ spread @ C.T + R)
        d_cov = np.linalg.inv(G.T @ C.T @ weight @ C @ G)
        M = d_cov @ G.T @ C.T @ weight
        d = M @ (sample - C @ prior)
        keep = eye - G @ M @ C
        star = prior + G @ d
        P_star = keep @ spread @ keep.T + G @ M @ R @ M.T @ G.T
        cross = P_star @ C.T - G @ M @ R
        noisy = C @ G @ M @ R
        R_star = C @ P_star @ C.T - noisy - noisy.T + R
        L = cross @ np.linalg.pinv(R_star, rcond=1e-10, hermitian=True)
        x, P = projected(star + L @ (sample - C @ star), P_star - L @ cross.T, *of_x)
        projected(d, d_cov, *of_d)
        found.append(x)
    return np.array(found)


def medians(first, second, repeat: int) -> tuple[float, float]:
    """Median seconds of both, rounds alternating."""
    taken: tuple[list[float], list[float]] = ([], [])
    for run in (first, second):
        run()
    for _ in range(repeat):
        for run, seconds in zip((first, second), taken, strict=True):
            start = time.perf_counter()
            run()
            seconds.append(time.perf_counter() - start)
    return float(np.median(taken[0])), float(np.median(taken[1]))


def live(repeat: int) -> None:
    y = samples(1)[0]
    nothing = np.zeros(len(PLANT.inputs))

    def stream(estimator):
        given = Live(Monitor(estimator, chi_square.build(PLANT, on="attack")))

        def run():
            for _ in range(10):
                given.reset()
                for sample in y:
                    given.push(Observation.of(nothing, sample))

        return run

    free = stream(unknown_input.build(PLANT, START, P0))
    for project in ("feedback", "output", "moments"):
        ours = stream(care.build(PLANT, START, P0, project=project))
        held, plain = medians(ours, free, repeat)
        scale = 1e6 / (10 * STEPS)
        print(
            f"live {project}: {held * scale:.1f} us a step, unknown_input {plain * scale:.1f}: "
            f"{held / plain:.2f} times"
        )


def batch(repeat: int) -> None:
    y = samples(RUNS)
    estimator = care.build(PLANT, START, P0)
    monitor = Monitor(estimator, chi_square.build(PLANT, on="attack"))
    log = Observation.of(np.zeros((STEPS, len(PLANT.inputs))), y[0])

    def filtered(y):
        rows = eqx.tree_at(lambda o: o.y, log, y)
        steps = lambda s, o: (lambda s, e: (s, e.x))(*estimator.step(s, o))  # noqa: E731
        return jax.lax.scan(steps, estimator.init()[0], rows)[1]

    def replayed(y):
        return replay(monitor, eqx.tree_at(lambda o: o.y, log, y)).estimate.x

    for name, one in (("estimator, all arrives", filtered), ("replay, own gaps", replayed)):
        run = jax.jit(lambda y, one=one: jax.lax.map(one, y, batch_size=BLOCK))
        apart = np.abs(np.asarray(run(y))[:2] - [python_loop(each) for each in y[:2]]).max()
        ours, loop = medians(
            lambda run=run: run(y).block_until_ready(),
            lambda: [python_loop(each) for each in y[:2]],
            repeat,
        )
        ours, loop = ours / (RUNS * STEPS) * 1e6, loop / (2 * STEPS) * 1e6
        print(
            f"batch of {RUNS}, {name}: {ours:.2f} us a run and row, NumPy with daqp {loop:.0f}: "
            f"{loop / ours:.0f} times as long; answers {apart:.1g} apart"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=7)
    arguments = parser.parse_args()
    live(arguments.repeat)
    batch(arguments.repeat)
