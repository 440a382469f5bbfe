"""State estimation that holds when sensors and actuators lie.

float64 throughout: importing holdfast switches JAX to 64-bit numbers, because a noise
variance of 1e-8 next to an initial variance of 1e4 is normal here. The public names are
loaded on first use, so that ``holdfast --help`` need not wait for JAX.
"""

import importlib
import os
import sys

__version__ = "0.1.0"

if "jax" in sys.modules:
    sys.modules["jax"].config.update("jax_enable_x64", True)
else:
    os.environ["JAX_ENABLE_X64"] = "1"
# How XLA compiles for a CPU; without effect once JAX has computed something, and where XLA_FLAGS
# says otherwise.
_FLAGS = {
    # It runs a program operation by operation, but compiles a loop whole where the arrays it
    # touches are small: by default up to 1 KiB, which no filter meets. Up to 16 MiB a trajectory
    # of a small plant is one kernel, and 4 times faster.
    "xla_backend_extra_options": "xla_cpu_small_while_loop_byte_threshold=16777216",
    # The older way of writing kernels compiles in 0.65 to 0.75 of the time, and what it compiles
    # is as fast (docs/benchmarks.md).
    "xla_cpu_use_fusion_emitters": "false",
}
_given = os.environ.get("XLA_FLAGS", "")
os.environ["XLA_FLAGS"] = " ".join(
    ([_given] if _given else [])
    + [f"--{name}={value}" for name, value in _FLAGS.items() if name not in _given]
)

_PUBLIC = {
    "Observation": "records",
    "Estimate": "records",
    "Verdict": "records",
    "Trace": "records",
    "Status": "records",
    "LinearPlant": "plants.linear",
    "NonlinearPlant": "plants.nonlinear",
    "SwitchedPlant": "plants.switched",
    "Kalman": "estimators.kalman",
    "UnknownInput": "estimators.unknown_input",
    "Extended": "estimators.extended",
    "Unscented": "estimators.unscented",
    "Decomposition": "estimators.decomposition",
    "SecureFusion": "estimators.secure_fusion",
    "L1Decoder": "estimators.l1_decoder",
    "L1Kalman": "estimators.l1_kalman",
    "Nisme": "estimators.nisme",
    "Monitor": "loop",
    "Scenario": "loop",
    "monitor_step": "loop",
    "replay": "loop",
    "simulate": "loop",
    "Live": "shell.live",
    "load_scenario": "shell.files",
    "run_study": "shell.campaigning",
}

__all__ = [*_PUBLIC, "__version__"]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    if name not in _PUBLIC:
        raise AttributeError(f"module 'holdfast' has no attribute {name!r}")
    return getattr(importlib.import_module(f"holdfast.{_PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
