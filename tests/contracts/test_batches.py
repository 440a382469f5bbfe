"""No batch of runs makes batched calls of LAPACK: two of them at a time can wait for each other for
ever (jaxlib 0.10 on the CPU), and campaigns run two blocks at a time.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.catalog import ESTIMATORS
from holdfast.plants.build import linear_plant
from holdfast.records import Observation

SETTINGS = {
    "secure_fusion": {"gamma": 2.0},
    "l1_decoder": {"window": 3},
    "l1_kalman": {"window": 3, "threshold": 5.0},
}
BATCHED = re.compile(r"@lapack_\w+\([^\n]*-> *\(?tensor<\d+x\d+x\d+x")


def plant_of(n):
    rng = np.random.default_rng(n)
    A = np.diag(np.linspace(-0.9, 0.95, n)) + 0.02 * rng.normal(size=(n, n))
    return linear_plant(
        A=A, B=np.ones((n, 1)), C=np.vstack([np.eye(n), np.ones((1, n))]),
        Q=np.diag(np.linspace(0.05, 1.0, n)),
        G=np.eye(n)[:, :1], H=np.eye(n + 1)[:, :1] * 0, R=np.eye(n + 1),
    )  # fmt: skip


def called(function, *arguments):
    """The batched calls of LAPACK in a program."""
    return set(re.findall(r"lapack_\w+", "\n".join(
        m.group() for m in BATCHED.finditer(jax.jit(function).lower(*arguments).as_text())
    )))  # fmt: skip


def test_a_batched_call_is_found():
    assert called(jax.vmap(jnp.linalg.cholesky), jnp.zeros((4, 3, 3))) == {"lapack_dpotrf_ffi"}
    assert called(jnp.linalg.cholesky, jnp.zeros((3, 3))) == set()


@pytest.mark.filterwarnings("ignore:the paper's coordinates")
@pytest.mark.parametrize(
    ("kind", "n"),
    # a bank of local filters is as large with six states as others are with twelve
    [(kind, 3) for kind in ESTIMATORS]
    + [
        pytest.param(kind, 6 if kind == "secure_fusion" else 12, marks=pytest.mark.slow)
        for kind in ESTIMATORS
    ],
)
def test_a_step_of_many_runs_has_none(kind, n):
    plant = plant_of(n)
    estimator = ESTIMATORS[kind](plant, np.zeros(n), np.eye(n), **SETTINGS.get(kind, {}))
    rows = 7
    states = jax.tree.map(lambda v: jnp.stack([v] * rows), estimator.init()[0])
    seen = jnp.ones((rows, n + 1), bool)
    observations = Observation(
        jnp.zeros((rows, 1)), jnp.zeros((rows, n + 1)), seen, ~seen, jnp.zeros(rows, jnp.int32)
    )
    assert called(jax.vmap(estimator.step), states, observations) == set()
