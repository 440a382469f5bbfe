"""What compiling costs, and what it buys: XLA's ways to write kernels for a CPU, in turn.

    cd benchmarks && PYTHONPATH=../src python compiling.py

A block of the arena's vehicle (256 runs of 200 rows, all attacks) is compiled and run in a process
of its own for each way. "compile": seconds of processor time, on all cores together. "run": the
best of five. "worst score": the largest relative difference of a score from the first way's.
"""

import os
import subprocess
import sys
import tempfile
import time
from importlib import resources
from pathlib import Path

import numpy as np

WAYS = {
    "as holdfast sets it": "",
    "with XLA's own choice": "--xla_cpu_use_fusion_emitters=true",
    "less optimisation": "--xla_backend_optimization_level=1",
    "no optimisation": "--xla_backend_optimization_level=0",
}
ESTIMATORS = ("Kalman", "NISME")


def child(path):
    """Compile and run the blocks here; print times, write scores."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from holdfast.campaign.blocks import BLOCK, _block
    from holdfast.shell.points import prepare
    from holdfast.shell.study import read_study

    ground = resources.files("holdfast.shell.grounds").joinpath("vehicle")
    with resources.as_file(ground) as folder:
        study = read_study(folder / "estimators.toml")
        prepared = prepare(study, False, [None] * len(study.points))
    numbers = jnp.arange(BLOCK)
    found = {}
    for name in ESTIMATORS:
        case = next(
            case
            for point, case in zip(study.points, prepared.cases, strict=True)
            if study.labels_of(point) == {"attack": "bias", "estimator": name}
        )
        given = (case, jax.random.key(0), numbers, numbers < BLOCK)
        lowered = eqx.filter_jit(lambda *some: _block.__wrapped__(*some)).lower(*given)
        start = time.process_time()
        compiled = lowered.compile()
        spent = time.process_time() - start
        runs = []
        for _ in range(5):
            start = time.perf_counter()
            scores = jax.block_until_ready(compiled(*given))[0]
            runs.append(time.perf_counter() - start)
        print(name, spent, min(runs))
        found |= {f"{name} {score}": np.asarray(values) for score, values in scores.items()}
    np.savez(path, **found)


def main():
    """Each way in a process of its own."""
    first = None
    print(f"{'':24} {'estimator':10} {'compile, s':>11} {'run, ms':>9} {'worst score':>12}")
    with tempfile.TemporaryDirectory() as folder:
        for number, (way, flags) in enumerate(WAYS.items()):
            path = Path(folder) / f"{number}.npz"
            environment = os.environ | {"XLA_FLAGS": flags, "HOLDFAST_CACHE": "off"}
            done = subprocess.run(
                [sys.executable, __file__, str(path)], env=environment, check=True,
                capture_output=True, text=True,
            )  # fmt: skip
            scores = dict(np.load(path))
            first = scores if first is None else first
            for line in done.stdout.splitlines():
                name, spent, run = line.split()
                worst = max(
                    np.nanmax(np.abs(values - first[key]) / np.maximum(np.abs(first[key]), 1e-9))
                    for key, values in scores.items()
                    if key.startswith(name) and np.isfinite(values).any()
                )
                print(f"{way:24} {name:10} {float(spent):11.1f} {1e3 * float(run):9.0f} "
                      f"{worst:12.1e}", flush=True)  # fmt: skip


if __name__ == "__main__":
    child(sys.argv[1]) if len(sys.argv) > 1 else main()
