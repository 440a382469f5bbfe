"""The secure fusion (31) of the paper's example in its own coordinates, over many draws.

The state itself has the eigenvalue -2 and keeps no digits for long, so that nothing here
simulates it. Without attack the local errors are N(0, W~), and c = Z' eps is standard normal and
independent of the Kalman error; an attack shifts them. That gives mean squared errors without a
simulation over time; `simulated` runs the errors over time all the same, by (19).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from holdfast.numerics.lasso import cold, lasso
from holdfast.numerics.local import least_squares
from holdfast.papers.decompose_example import EXAMPLE, Given

SEEDS = 16
DRAWS = 125
"""Draws for each seed: the spread of the benign mean is then some 1e-4 of it at gamma = 2."""
STEPS = 1000
FORGOTTEN = 50
"""Steps that are left out: 0.3^50 of the start is then left."""
CHUNK = 100
"""Problems that are solved in one call of the compiled solver."""
GAMMAS = (
    0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0,
    10.0, 15.0, 20.0, 30.0,
)  # fmt: skip
SIZE = 100.0
"""The paper's attack on sensor 1."""


class Fused(NamedTuple):
    """``F`` (n x N) of (11), ``Z`` (N x r) with Z Z' = W~^-1 (I - G F), ``rows`` = Z without those
    of sensors that are authenticated, ``settled`` (m x N) where an attack of 1 on each sensor
    takes the local errors, ``trace`` = tr P.
    """

    F: np.ndarray
    Z: np.ndarray
    rows: np.ndarray
    settled: np.ndarray
    trace: float


def fused(given: Given = EXAMPLE, authenticated: tuple[int, ...] = ()) -> Fused:
    """Of a plant with real simple eigenvalues of A - K C A."""
    m, n = given.C.shape
    found = least_squares(np.real(given.stacked()[0]), np.real(given.W))
    penalised = np.repeat([i not in authenticated for i in range(m)], n)
    settled = -np.linalg.solve(np.eye(n) - np.real(given.J), np.ones(n))
    return Fused(
        found.F,
        found.Z,
        np.where(penalised[:, None], found.Z, 0.0),
        np.kron(np.eye(m), settled),
        float(np.trace(given.P)),
    )


@eqx.filter_jit
def _minimisers(rows, w, c):
    return jax.lax.map(lambda one: lasso(rows, w, one, cold(rows))[0].f, c)


def minimisers(rows: np.ndarray, gamma: float, c: np.ndarray) -> np.ndarray:
    """The l1 part of (31) (k x N) for each c (k x r); k a multiple of `CHUNK`, or less."""
    w = jnp.full(len(rows), gamma)
    parts = [c[i : i + CHUNK] for i in range(0, len(c), CHUNK)]
    return np.concatenate([_minimisers(jnp.asarray(rows), w, jnp.asarray(part)) for part in parts])


def drawn(seeds: int, draws: int, size: int) -> np.ndarray:
    """Standard normal numbers (seeds x draws x size)."""
    keys = jax.random.split(jax.random.key(0), seeds)
    return np.asarray(jax.vmap(lambda key: jax.random.normal(key, (draws, size)))(keys))


def squares(found: Fused, gamma: float, shift: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """Mean squared error of each seed, local errors shifted by ``shift`` (N,) or (k x N)."""
    c = draws.reshape(-1, draws.shape[-1]) + shift @ found.Z
    left = (shift - minimisers(found.rows, gamma, c)) @ found.F.T
    return found.trace + np.mean(np.sum(left**2, 1).reshape(draws.shape[:2]), 1)


class Sweep(NamedTuple):
    """Normalised mean squared errors (6 x gamma x seed): without attack, each sensor attacked."""

    gammas: tuple[float, ...]
    errors: np.ndarray

    def at(self, gamma: float) -> np.ndarray:
        """The errors (6 x seed) at one of the gammas."""
        return self.errors[:, self.gammas.index(gamma)]

    def best(self, sensor: int) -> tuple[np.ndarray, np.ndarray]:
        """The gamma of the least error of each seed, and that error, with ``sensor`` attacked."""
        where = np.argmin(self.errors[sensor], 0)
        return np.array(self.gammas)[where], np.min(self.errors[sensor], 0)


def sweep(
    found: Fused,
    seeds: int = SEEDS,
    draws: int = DRAWS,
    gammas: tuple[float, ...] = GAMMAS,
    size: float = SIZE,
) -> Sweep:
    """Fig. 2, with every sensor attacked in turn; the same draws everywhere."""
    noise = drawn(seeds, draws, found.Z.shape[1])
    shifts = [np.zeros(len(found.Z)), *(size * found.settled)]
    errors = [[squares(found, gamma, shift, noise) for gamma in gammas] for shift in shifts]
    return Sweep(gammas, np.array(errors) / found.trace)


class Growth(NamedTuple):
    """Root mean squared errors (sensor x size), and the sensors that are authenticated."""

    sizes: np.ndarray
    errors: np.ndarray
    authenticated: tuple[int, ...] = ()


def growth(
    sizes: np.ndarray,
    draws: np.ndarray,
    given: Given = EXAMPLE,
    authenticated: tuple[int, ...] = (),
    gamma: float = 0.75,
) -> Growth:
    """Constant attacks of every size on each sensor; NaN for one that is authenticated."""
    found = fused(given, authenticated)
    errors = np.full((len(found.settled), len(sizes)), np.nan)
    for i in set(range(len(errors))) - set(authenticated):
        for j, size in enumerate(sizes):
            errors[i, j] = np.mean(squares(found, gamma, size * found.settled[i], draws))
    return Growth(sizes, np.sqrt(errors), authenticated)


@eqx.filter_jit
def _errors(J, enters, keys, steps: int, attack):
    """Local errors (seed x time x N) by (19), from 0."""
    m, n = len(attack), enters.shape[1]

    def one(key):
        def step(eps, key):
            noise = jax.random.normal(key, (n + m,))
            pushed = jnp.repeat(noise[n:] + attack, n)
            eps = jnp.tile(J, m) * eps + jnp.sum(enters * noise[:n], 1) - pushed
            return eps, eps

        return jax.lax.scan(step, jnp.zeros(m * n), jax.random.split(key, steps))[1]

    return jax.vmap(one)(keys)


def simulated(
    found: Fused, gamma: float, attack: np.ndarray, seeds: int, steps: int, given: Given = EXAMPLE
) -> np.ndarray:
    """The normalised empirical MSE of each seed over time; the example's Q = R = I.

    The state is 0 throughout and only the local errors move, which is the same: x_s - x is
    F (f - eps) whatever x does.
    """
    enters = np.real(given.G - given.C[:, None, :]).reshape(-1, len(given.A))
    keys = jax.random.split(jax.random.key(1), seeds)
    arrays = (jnp.asarray(np.real(np.diagonal(given.J))), jnp.asarray(enters), keys)
    eps = np.asarray(_errors(*arrays, steps + FORGOTTEN, jnp.asarray(attack)))[:, FORGOTTEN:]
    eps = eps.reshape(-1, eps.shape[-1])
    f = minimisers(found.rows, gamma, eps @ found.Z)
    error = np.sum(((f - eps) @ found.F.T) ** 2, 1).reshape(seeds, steps)
    return np.mean(error, 1) / found.trace
