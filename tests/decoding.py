"""For tests of the decoders: plants whose sensors are redundant, logs with hopping attacks, and a
window of rows written out as one regression. Nothing here knows the package's window.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from holdfast.plants.linear import LinearPlant
from holdfast.records import Observation, screen
from systems import quiet_plant

A = np.array([[1.0, 0.1], [-0.05, 0.95]])
B = np.array([[0.005], [0.1]])
C = np.vstack([np.eye(2)] * 3)
D = np.array([[0.0], [0.1], [0.0], [0.0], [-0.3], [0.0]])
SIZES = {"Q": np.diag([1e-4, 1e-3]), "R": 0.01 * np.diag([1.0, 2.0, 1.0, 0.5, 1.0, 1.0])}
ROWS, T = 24, 4


def plant(**changes) -> LinearPlant:
    """Two states, three sensors each: one attacked sample a row is always outvoted."""
    return quiet_plant(**({"A": A, "B": B, "C": C, "D": D} | SIZES | changes))


class Log(NamedTuple):
    """Row k at index k-1. ``a``: what was added to the samples."""

    u: np.ndarray
    y: np.ndarray
    x: np.ndarray
    a: np.ndarray


def matrices(of: LinearPlant, k, x, u) -> list[np.ndarray]:
    """A, B, C, D, G, H, Q, R of row k."""
    return [np.asarray(m) for m in of.at(k, jnp.asarray(x), jnp.asarray(u))]


def hopping(rng, rows=ROWS, p=6, size=5.0, count=1):
    """``count`` other samples in every row."""
    a = np.zeros((rows, p))
    for row in a:
        row[rng.choice(p, count, replace=False)] = size * rng.normal(size=count)
    return a


def log(of: LinearPlant, a=None, rows=ROWS, seed=0, noise=0.0, u=None, x0=(1.0, -2.0)) -> Log:
    """``noise``: 1 that of the plant. ``u``: given, or random; a function: of the state before."""
    rng = np.random.default_rng(seed)
    p, n, nu = len(of.outputs), len(of.states), len(of.inputs)
    a = np.zeros((rows, p)) if a is None else a
    found, inputs, x = [], [], np.asarray(x0, float)
    for k in range(rows):
        uk = u(x) if callable(u) else rng.normal(size=nu) if u is None else u[k]
        m = matrices(of, k + 1, x, uk)
        x = m[0] @ x + m[1] @ uk
        if noise:
            x = x + noise * rng.multivariate_normal(np.zeros(n), m[6])
        m = matrices(of, k + 1, x, uk)
        v = noise * rng.multivariate_normal(np.zeros(p), m[7]) if noise else 0.0
        found.append((x, m[2] @ x + m[3] @ uk + v + a[k]))
        inputs.append(uk)
    x, y = (np.array(of) for of in zip(*found, strict=True))
    return Log(np.array(inputs).reshape(rows, nu), y, x, a)


@eqx.filter_jit
def _followed(estimator, observations):
    def row(carry, observation):
        state, u = carry
        observation = screen(observation, u)
        state, estimate = estimator.step(state, observation)
        return (state, observation.u), (state, estimate)

    u = jnp.zeros(len(estimator.plant.inputs))
    return jax.lax.scan(row, (estimator.init()[0], u), observations)[1]


def followed(estimator, of: Log, seen=None, trusted=None):
    """The states and the estimates of every row, samples screened as the loop does it."""
    return jax.tree.map(np.asarray, _followed(estimator, Observation.of(of.u, of.y, seen, trusted)))


class Window(NamedTuple):
    """y = Phi x_first (known inputs removed); x_last = last x_first + moved."""

    Phi: np.ndarray
    y: np.ndarray
    last: np.ndarray
    moved: np.ndarray


def window(of: LinearPlant, given: Log, k: int, length=T) -> Window:
    """The rows k-length+1 .. k, written out."""
    n = len(of.states)
    through, moved, rows, y = np.eye(n), np.zeros(n), [], []
    for i in range(k - length + 1, k + 1):
        m = matrices(of, i, np.zeros(n), given.u[i - 1])
        if rows:
            through, moved = m[0] @ through, m[0] @ moved + m[1] @ given.u[i - 1]
        rows.append(m[2] @ through)
        y.append(given.y[i - 1] - m[2] @ moved - m[3] @ given.u[i - 1])
    return Window(np.concatenate(rows), np.concatenate(y), through, moved)
