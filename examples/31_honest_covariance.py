"""How far to trust an error bar under limits: the paper's covariance against honest moments.

A position in [0, 20] and a push in [-1, 1], estimated from one row. The truth is drawn as the
model says, inside the limits; then the position is held on a face, or far from all of them.
"""

import jax
import numpy as np

from holdfast.estimators import care
from holdfast.plants.build import linear_plant
from holdfast.records import Observation

DRAWS = 2000
MEAN, P0, Q, R = np.array([0.3, 1.0]), np.diag([1.0, 0.25]), 0.05 * np.eye(2), 0.5 * np.eye(2)
PLANT = linear_plant(
    A=[[1, 0.5], [0, 1]], C=np.eye(2), G=[[0], [0.7]], Q=Q, R=R,
    constraints={
        "state": {"matrix": [[1, 0], [-1, 0]], "bound": [20, 0]},
        "attack": {"matrix": [[1], [-1]], "bound": [1, 1]},
    },
)  # fmt: skip


def drawn(rng, position=None):
    """True x_1 and d_0, x_0 from its prior and d_0 from anywhere inside the limits; and y_1."""
    push = rng.uniform(-1, 1, 10 * DRAWS)
    x = rng.multivariate_normal(MEAN, P0, len(push)) @ np.asarray(PLANT.A).T
    x += push[:, None] * np.asarray(PLANT.G)[:, 0] + rng.multivariate_normal([0, 0], Q, len(push))
    if position is not None:
        x[:, 0] = position
    inside = np.flatnonzero((x[:, 0] >= 0) & (x[:, 0] <= 20))[:DRAWS]
    x, push = x[inside], push[inside, None]
    return x, push, x + rng.multivariate_normal([0, 0], R, DRAWS)


def errors(project, y):
    """What the estimator says of one row, for every draw."""
    estimator = care.build(PLANT, MEAN, P0, project=project)
    state = estimator.init()[0]
    rows = Observation.of(np.zeros((DRAWS, 0)), y)
    return jax.jit(jax.vmap(lambda row: estimator.step(state, row)[1]))(rows)


def nees(error, cov):
    """e' P^{-1} e of every draw; infinite where P leaves no room for an error that is there."""
    regular = np.linalg.det(cov) > 1e-12
    safe = np.where(regular[:, None, None], cov, np.eye(cov.shape[-1]))
    value = np.einsum("ri,rij,rj->r", error, np.linalg.inv(safe), error)
    return np.where(regular, value, np.where(np.any(error != 0, 1), np.inf, 0.0))


if __name__ == "__main__":
    print(f"{'truth':13}{'project':10}{'sd of 0':8}{'beyond 3 sd: position, push':>29}", end="")
    print(f"{'NEES / n: state, push':>24}")
    for name, position in (("drawn", None), ("on the face", 0.0), ("1 inside", 1.0)):
        x, d, y = drawn(np.random.default_rng(0), position)
        for project in ("feedback", "moments"):
            got = jax.tree.map(np.asarray, errors(project, y))
            pairs = ((got.x - x, got.x_cov), (got.d - d, got.d_cov))
            held = np.mean((got.x_cov[:, 0, 0] == 0) | (got.d_cov[:, 0, 0] == 0))
            far = [np.mean(e[:, 0] ** 2 > 9 * P[:, 0, 0]) for e, P in pairs]
            size = [np.mean(nees(e, P)) / e.shape[1] for e, P in pairs]
            print(f"{name:13}{project:10}{held:7.0%}{far[0]:18.1%}{far[1]:12.1%}", end="")
            print(f"{size[0]:16.2f}{size[1]:8.2f}")
