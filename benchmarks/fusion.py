"""The secure fusion of a row beside CVXPY with Clarabel, in one run, as ratios.

    pip install ".[bench]"
    python benchmarks/fusion.py [--repeat 5]

DECOMPOSE's example, 3 states and 5 sensors, gamma = 2, sensor 1 off by 100: a stream of local
estimates drawn from their exact distribution, each row close to the one before as the bank makes
it. Every contestant solves (31) for the same rows and the estimates are compared first. CVXPY has
the problem as a parametrised (DPP) one that is solved again for every row. holdfast: one row from
Python, from where the row before ended and from nothing; 1000 streams at once, the same two ways.
Rounds alternate between contestants; figures are medians over rounds, ratios those of medians.
"""

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np
from peers import available, show, timed

from holdfast.estimators import secure_fusion
from holdfast.numerics.lasso import cold, lasso
from holdfast.plants.library import five_sensors

jax.config.update("jax_cpu_enable_async_dispatch", False)

GAMMA, ATTACK = 2.0, 100.0
ROWS, STREAMS = 20, 1000
ESTIMATOR = secure_fusion.build(five_sensors.build(), gamma=GAMMA)
LOCAL = secure_fusion.local_bank(ESTIMATOR.plant, None, None)[1]
BACK = np.asarray(ESTIMATOR.back)
FORWARD = np.linalg.inv(BACK)
Z = BACK.T @ np.asarray(ESTIMATOR.fusion.Z)
F, G = np.asarray(ESTIMATOR.fusion.F), LOCAL.G
W = np.asarray(ESTIMATOR.weight)


def streams(count: int) -> np.ndarray:
    """Local estimates (row, stream, N) of a state at zero, sensor 1 lying from the first row."""
    rng = np.random.default_rng(0)
    d, m = len(LOCAL.b), LOCAL.sensors
    enter = (G - np.kron(np.asarray(ESTIMATOR.plant.C), LOCAL.b[:, None])) @ np.eye(3)
    step = np.kron(np.eye(m), LOCAL.S)
    error = rng.normal(size=(count, len(G))) @ np.linalg.cholesky(LOCAL.W).T
    offset = np.kron(np.eye(m)[0] * ATTACK, np.linalg.solve(np.eye(d) - LOCAL.S, LOCAL.b))
    rows = []
    for _ in range(ROWS):
        noise = rng.normal(size=(count, 3)) @ enter.T
        noise -= np.kron(rng.normal(size=(count, m)), LOCAL.b)
        error = error @ step.T + noise
        rows.append(offset - error)
    return np.stack(rows)


ZETA = streams(STREAMS)
CENTRE = -ZETA @ np.asarray(ESTIMATOR.fusion.Z)
KALMAN = ZETA @ F.T


def state(f: np.ndarray, kalman: np.ndarray) -> np.ndarray:
    return kalman + f @ (F @ BACK).T


def row_by_row(warm_start: bool):
    run = jax.jit(lambda c, warm: lasso(Z, W, c, warm))
    none = cold(jnp.asarray(Z))

    def rows():
        warm, found = none, []
        for c in CENTRE[:, 0]:
            solution, after = run(c, warm)
            warm = after if warm_start else none
            found.append(np.asarray(solution.f))
        return state(np.stack(found), KALMAN[:, 0])

    return rows


def together(warm_start: bool):
    none = cold(jnp.asarray(Z))

    @jax.jit
    def run(centre, warm):
        def row(warm, c):
            solution, after = jax.vmap(lambda c, w: lasso(Z, W, c, w))(c, warm)
            return (after if warm_start else warm), solution.f

        return jax.lax.scan(row, warm, centre)[1]

    start = jax.tree.map(lambda a: jnp.broadcast_to(a, (STREAMS, *a.shape)), none)
    return lambda: state(np.asarray(run(CENTRE, start)), KALMAN)


def cvxpy():
    import cvxpy as cp

    size = len(G)
    zeta, x = cp.Parameter(size), cp.Variable(3)
    v, f = cp.Variable(size), cp.Variable(size)
    lower = FORWARD @ np.linalg.cholesky(LOCAL.W)
    problem = cp.Problem(
        cp.Minimize(0.5 * cp.sum_squares(v) + GAMMA * cp.norm1(f)),
        [zeta == FORWARD @ G @ x - lower @ v - f],
    )

    def rows():
        found = []
        for one in ZETA[:, 0]:
            zeta.value = FORWARD @ one
            problem.solve(solver=cp.CLARABEL)
            found.append(x.value)
        return np.stack(found)

    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=5, help="rounds")
    repeat = parser.parse_args().repeat
    alone = available(
        {
            "holdfast": lambda: row_by_row(True),
            "holdfast, from nothing": lambda: row_by_row(False),
            "CVXPY with Clarabel": cvxpy,
        }
    )
    truth = np.asarray(alone["holdfast"]())
    for name, run in alone.items():
        print(f"{name}: largest difference {np.max(np.abs(np.asarray(run()) - truth)):.1e}")
    show("fusion of one row, from Python", "us / row", 1e6, timed(alone, repeat, ROWS))
    batch = {"holdfast": together(True), "holdfast, from nothing": together(False)}
    for name, run in batch.items():
        difference = np.max(np.abs(run()[:, 0] - truth))
        print(f"{name}: largest difference {difference:.1e}")
    found = timed(batch, repeat, ROWS * STREAMS)
    if "CVXPY with Clarabel" in alone:
        alone = {"CVXPY with Clarabel": alone["CVXPY with Clarabel"]}
        found |= timed(alone, repeat, ROWS)
    show(f"the same, {STREAMS} streams at once", "us / row", 1e6, found)
