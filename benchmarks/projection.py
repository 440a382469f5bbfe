"""Projection onto a polytope beside daqp, in one run, as ratios.

    pip install ".[bench]"
    python benchmarks/projection.py [--repeat 7]

1000 random problems with 4 dimensions and 8 faces, each with a covariance of its own; the
answers are compared before anything is timed. holdfast starts from the covariance, as NumPy
arrays. daqp is given the inverse covariance and the linear term, computed beforehand; timed
are `daqp.solve`, and a kept `Model` whose matrices are all replaced. Rounds alternate between
contestants; the figure is the median over rounds, the ratio is that of medians.
"""

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import jax
import numpy as np
from peers import available, show, timed

from holdfast.numerics.projection import project

jax.config.update("jax_cpu_enable_async_dispatch", False)

COUNT, N, M = 1000, 4, 8
RNG = np.random.default_rng(0)
ROOT = RNG.normal(size=(COUNT, N, N))
COV = ROOT @ ROOT.swapaxes(1, 2) + 0.1 * np.eye(N)
ROWS = RNG.normal(size=(COUNT, M, N))
INSIDE = 0.5 * RNG.normal(size=(COUNT, N))
BOUND = np.einsum("kij,kj->ki", ROWS, INSIDE) + RNG.uniform(0, 1, (COUNT, M))
POINT = 2.0 * RNG.normal(size=(COUNT, N))
WEIGHT = np.linalg.inv(COV)
LINEAR = -np.einsum("kij,kj->ki", WEIGHT, POINT)
PROBLEMS = list(zip(POINT, COV, ROWS, BOUND, strict=True))
QUADRATIC = list(zip(WEIGHT, LINEAR, ROWS, BOUND, strict=True))


def together():
    run = jax.jit(jax.vmap(project))
    return lambda: jax.block_until_ready(run(POINT, COV, ROWS, BOUND)).point


def alone():
    run = jax.jit(project)
    return lambda: [jax.block_until_ready(run(*one)).point for one in PROBLEMS]


def daqp_solve():
    import daqp

    return lambda: [daqp.solve(*one)[0] for one in QUADRATIC]


def daqp_kept():
    import daqp

    model = daqp.Model()
    model.setup(*QUADRATIC[0])

    def one(H, f, A, bupper):
        model.update(H=H, f=f, A=A, bupper=bupper)
        return model.solve()[0]

    return lambda: [one(*problem) for problem in QUADRATIC]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=7, help="rounds")
    contest = available(
        {
            "holdfast": together,
            "holdfast, one by one": alone,
            "daqp.solve": daqp_solve,
            "daqp.Model": daqp_kept,
        }
    )
    truth = np.asarray(contest["holdfast"]())
    for name, run in contest.items():
        print(f"{name}: largest difference {np.max(np.abs(np.asarray(run()) - truth)):.1e}")
    found = timed(contest, parser.parse_args().repeat, COUNT)
    show(f"projection, n = {N}, m = {M}, {COUNT} problems", "us / problem", 1e6, found)
