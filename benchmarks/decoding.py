"""The l1 decoder of a window beside scipy's linprog and highspy, in one run, as ratios.

    pip install ".[bench]"
    python benchmarks/decoding.py [--repeat 5]

Windows of a stable random plant under attacks that hop between sensors, sliding by one row. All
contestants minimise |Y - Phi x|_1 on the same windows and the objectives are compared first
(1e-9 relative: HiGHS stops at tolerances). linprog gets the dual, which is faster for it than the
primal; "kept" is one HiGHS model of the dual whose costs alone change from window to window, so
that it starts from the last basis: sliding windows are its best case. holdfast starts every window
from nothing. Rounds alternate between contestants; figures are medians over rounds.
"""

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import jax
import numpy as np
from peers import available, show, timed
from scipy.optimize import linprog

from holdfast.numerics.l1_regression import l1_regression

jax.config.update("jax_cpu_enable_async_dispatch", False)

SHAPES = ((50, 10), (80, 8), (200, 20), (1000, 50))
"""Samples in a window, and states."""
WINDOWS, MANY = 20, 200
AGREE = 1e-9


def sliding(samples: int, states: int, count: int):
    """Phi of a window, and the samples of ``count`` windows, each one row after the other."""
    rng = np.random.default_rng(samples)
    sensors = samples // states if samples < 1000 else 20
    T = samples // sensors
    A, _ = np.linalg.qr(rng.normal(size=(states, states)))
    C = rng.normal(size=(sensors, states))
    x, rows = rng.normal(size=states), []
    for _ in range(T + count):
        x = 0.98 * A @ x + 0.01 * rng.normal(size=states)
        y = C @ x + 0.05 * rng.normal(size=sensors)
        y[rng.integers(sensors)] += 3.0 * rng.normal()
        rows.append(y)
    through, Phi = np.eye(states), []
    for _ in range(T):
        Phi.append(C @ through)
        through = 0.98 * A @ through
    return np.concatenate(Phi), np.array([np.concatenate(rows[k : k + T]) for k in range(count)])


def objective(Phi, y, x) -> np.ndarray:
    return np.sum(np.abs(y - x @ Phi.T), 1)


def ours(Phi, Y):
    run = jax.jit(lambda y: l1_regression(Phi, y).x)
    return lambda: np.stack([np.asarray(run(y)) for y in Y])


def ours_together(Phi, Y):
    run = jax.jit(jax.vmap(lambda y: l1_regression(Phi, y).x))
    return lambda: np.asarray(run(Y))


def ours_each_its_own(Phi, Y):
    run = jax.jit(jax.vmap(lambda P, y: l1_regression(P, y).x))
    stacked = np.broadcast_to(Phi, (len(Y), *Phi.shape))
    return lambda: np.asarray(run(stacked, Y))


def scipy_linprog(Phi, Y):
    m, n = Phi.shape

    def one(y):
        found = linprog(-y, A_eq=Phi.T, b_eq=np.zeros(n), bounds=[(-1, 1)] * m, method="highs")
        return -found.eqlin.marginals

    return lambda: np.stack([one(y) for y in Y])


def highspy_loop(Phi, Y, kept: bool):
    import highspy

    m, n = Phi.shape

    def model():
        solver = highspy.Highs()
        solver.setOptionValue("output_flag", False)
        lp = highspy.HighsLp()
        lp.num_col_, lp.num_row_ = m, n
        lp.col_lower_, lp.col_upper_ = np.full(m, -1.0), np.full(m, 1.0)
        lp.row_lower_ = lp.row_upper_ = np.zeros(n)
        lp.col_cost_ = np.zeros(m)
        lp.a_matrix_.start_ = np.arange(0, m * n + 1, n)
        lp.a_matrix_.index_ = np.tile(np.arange(n), m)
        lp.a_matrix_.value_ = Phi.ravel()
        solver.passModel(lp)
        return solver

    columns = np.arange(m, dtype=np.int32)
    held = model()

    def one(y):
        solver = held if kept else model()
        solver.changeColsCost(m, columns, -y)
        solver.run()
        return -np.array(solver.getSolution().row_dual)

    return lambda: np.stack([one(y) for y in Y])


def compared(contest, Phi, Y) -> None:
    names = list(contest)
    truth = objective(Phi, Y, contest[names[0]]())
    for name in names[1:]:
        off = np.max(np.abs(objective(Phi, Y, contest[name]()) / truth - 1.0))
        assert off < AGREE, f"{name} is off by {off:.1e}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=5, help="rounds")
    repeat = parser.parse_args().repeat
    for m, n in SHAPES:
        Phi, Y = sliding(m, n, WINDOWS)
        alone = available(
            {
                "holdfast": lambda Phi=Phi, Y=Y: ours(Phi, Y),
                "scipy linprog": lambda Phi=Phi, Y=Y: scipy_linprog(Phi, Y),
                "highspy, kept": lambda Phi=Phi, Y=Y: highspy_loop(Phi, Y, True),
                "highspy, anew": lambda Phi=Phi, Y=Y: highspy_loop(Phi, Y, False),
            }
        )
        compared(alone, Phi, Y)
        show(f"{m} x {n}, one window", "us", 1e6, timed(alone, repeat, WINDOWS))
    for m, n in SHAPES[:3]:
        Phi, Y = sliding(m, n, MANY)
        batch = available(
            {
                "holdfast": lambda Phi=Phi, Y=Y: ours_together(Phi, Y),
                "holdfast, a Phi each": lambda Phi=Phi, Y=Y: ours_each_its_own(Phi, Y),
                "highspy, kept": lambda Phi=Phi, Y=Y: highspy_loop(Phi, Y, True),
                "highspy, anew": lambda Phi=Phi, Y=Y: highspy_loop(Phi, Y, False),
            }
        )
        compared(batch, Phi, Y)
        show(f"{m} x {n}, {MANY} windows", "us / window", 1e6, timed(batch, repeat, MANY))
