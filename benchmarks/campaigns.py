"""A campaign beside the bare compiled scan, in one run: time, throughput and memory.

    python benchmarks/campaigns.py [--runs 10000] [--many 0]

Four states in closed loop, `unknown_input`, chi-square on the attack estimate, a bias on an
attack channel; 300 steps. "bare": `jax.vmap` of `simulate` in blocks of the same size, one mean
square error and one count of alarms kept of each run. "campaign": all scores. ``--many``: so
many runs in a process of their own, whose largest memory is printed.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import equinox as eqx
import jax
import jax.numpy as jnp

import holdfast
from holdfast.campaign.blocks import BLOCK
from holdfast.shell import runtime
from holdfast.shell.executors import Local, Task
from holdfast.shell.points import prepare
from holdfast.shell.study import read_study

STEPS = 300
SCENARIO = """
[plant]
kind = "linear"
dt = 0.1
A = [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]]
B = [[0.005, 0], [0.1, 0], [0, 0.005], [0, 0.1]]
C = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
G = [[0.005, 0], [0.1, 0], [0, 0.005], [0, 0.1]]
Q = [[1e-4, 0, 0, 0], [0, 1e-4, 0, 0], [0, 0, 1e-4, 0], [0, 0, 0, 1e-4]]
R = [[0.01, 0, 0, 0], [0, 0.01, 0, 0], [0, 0, 0.01, 0], [0, 0, 0, 0.01]]

[estimator]
kind = "unknown_input"
x0 = [0, 0, 0, 0]
P0 = [1, 1, 1, 1]

[detector]
kind = "chi_square"
level = 0.01

[controller]
kind = "lqr"
state_weight = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
input_weight = [[1, 0], [0, 1]]

[[attack]]
kind = "bias"
channel = "channel:d1"
start = 15
value = 1
"""


def written(folder: Path, runs: int) -> Path:
    (folder / "scenario.toml").write_text(SCENARIO)
    path = folder / "study.toml"
    path.write_text(
        f'[study]\nscenario = "scenario.toml"\nruns = {runs}\nsteps = {STEPS}\nstart = "fixed"\n'
    )
    return path


@eqx.filter_jit
def bare(scenario, keys):
    def one(key):
        trace = holdfast.simulate(scenario, key, STEPS)
        return jnp.mean((trace.estimate.x - trace.x) ** 2), jnp.sum(trace.verdict.alarm)

    return jax.vmap(one)(keys)


def timed(run, times: int = 5) -> float:
    run()
    found = []
    for _ in range(times):
        start = time.perf_counter()
        run()
        found.append(time.perf_counter() - start)
    return min(found)


def compare(runs: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = written(Path(folder), runs)
        prepared = prepare(read_study(path), False)
    blocks = -(-runs // BLOCK)
    keys = jax.random.split(jax.random.key(0), blocks * BLOCK).reshape(blocks, BLOCK)
    scenario = prepared.cases[0].scenario

    def scan():
        for some in keys:
            jax.block_until_ready(bare(scenario, some))

    def campaign(workers: int):
        tasks = [Task(0, i, 1) for i in range(blocks)]
        return lambda: list(Local(prepared, workers).run(tasks))

    reference, one = timed(scan), timed(campaign(1))
    print(f"{runs} runs of {STEPS} steps, {runtime.cores()} cores; the best of five")
    steps = runs * STEPS
    for name, seconds in (
        ("bare scan, one block at a time", reference),
        ("campaign, one thread", one),
        (f"campaign, {runtime.cores()} threads", timed(campaign(runtime.cores()))),
    ):
        rate = f"{1e6 * seconds / steps:.3f} us a step, {seconds / reference:.2f} of the bare scan"
        print(f"{name:32s} {seconds:6.2f} s, {rate}", flush=True)


def many(runs: int) -> None:
    """Run in a process of its own: with files, results and report."""
    with tempfile.TemporaryDirectory() as folder:
        path = written(Path(folder), runs)
        start = time.perf_counter()
        holdfast.run_study(path, Path(folder) / "out")
        seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{runs} runs, written and reported: {seconds:.0f} s, at most {peak:.2f} GiB")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--many", type=int, default=0, help="also so many runs, with their memory")
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    runtime.configure()
    if asked.alone:
        many(asked.many)
        return
    compare(asked.runs)
    if asked.many:
        line = [sys.executable, __file__, "--many", str(asked.many), "--alone"]
        subprocess.run(line, check=True)


if __name__ == "__main__":
    main()
