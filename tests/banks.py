"""Filters of one mode each, in tests: their states over a log, and their plants for the oracle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import systems
from holdfast.plants.local import motion, sensing
from holdfast.records import Observation

NAMES = ("push", "spoof", "both")
MODES = [[], ["push"], ["spoof", "both"], ["push", "spoof", "both"]]


def log(u, y, seen=None, trusted=None) -> Observation:
    """Rows as an estimator gets them: what did not arrive is 0."""
    return Observation.of(u, y if seen is None else np.where(seen, y, 0.0), seen, trusted)


@eqx.filter_jit
def ran(estimator, observations):
    """The states and the estimates of all rows; plant arrays are arguments."""

    def row(state, observation):
        state, estimate = estimator.step(state, observation)
        return state, (state, estimate)

    return jax.lax.scan(row, estimator.init()[0], observations)[1]


def active(plant, mode) -> np.ndarray:
    """1 where the mode has the channel, 0 elsewhere."""
    return np.array([float(name in mode) for name in plant.attacks])


def linear(plant, mode):
    """A constant linear plant under a mode, as `oracles.algorithm_1` takes it."""
    A, B, C, D, G, H, Q, R = systems.matrices(plant)
    G, H = G * active(plant, mode), H * active(plant, mode)
    return lambda k: (
        lambda x, u, d: A @ x + B @ u + G @ d,
        lambda x, u: C @ x + D @ u,
        lambda x, u, d: (A, G, Q),
        lambda x, u: (C, H, R),
    )


def nonlinear(plant, mode):
    """A plant of functions under a mode, linearised where the oracle asks for it."""
    used, none, k = active(plant, mode), jnp.zeros(len(plant.attacks)), jnp.asarray(1, jnp.int32)

    @jax.jit
    def moved(x, u, d):
        m = motion(plant, k, x, u, d)
        return plant.transition(k, x, u, d), m.A, m.G * used, m.Q

    @jax.jit
    def seen(x, u):
        s = sensing(plant, k, x, u, none)
        return plant.output(k, x, u, none), s.C, s.H * used, s.R

    def values(function, *arguments):
        return [np.asarray(v) for v in function(*map(jnp.asarray, arguments))]

    return lambda k: (
        lambda x, u, d: values(moved, x, u, d)[0],
        lambda x, u: values(seen, x, u)[0],
        lambda x, u, d: values(moved, x, u, d)[1:],
        lambda x, u: values(seen, x, u)[1:],
    )


def plant_of(seed: int, n: int, ny: int, **changes):
    """push moves the state, spoof falsifies an output, both two others and the state; well posed
    as in `systems.random_system`.
    """
    rng = np.random.default_rng(seed)
    while True:
        A, C = rng.normal(size=(n, n)), rng.normal(size=(ny, n))
        G, H = rng.normal(size=(n, 3)), rng.normal(size=(ny, 3))
        A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
        G[:, 1], H[:, 0], H[1:, 1], H[[0, *range(3, ny)], 2] = 0, 0, 0, 0
        strong = systems.attack_strength(C, G, H) > 0.3
        if strong and systems.largest_zero(A, G, C, H, rng) < 0.95:
            break
    given = dict(
        A=A, B=rng.normal(size=(n, 1)), C=C, D=rng.normal(size=(ny, 1)), G=G, H=H,
        Q=systems.covariance(rng, n), R=systems.covariance(rng, ny), attacks=NAMES,
    )  # fmt: skip
    return systems.quiet_plant(**(given | changes))


def observed(seed: int, plant, steps: int):
    """Rows of which some lack a sample and some have one that is trusted; an attack now and then
    of each kind, so that every mode is believed at times. The first row, where the attacks
    before it are free too, is whole: every row tells what there is to tell.
    """
    rng = np.random.default_rng(seed)
    u, y, _ = systems.random_log(seed, plant, steps)
    y[steps // 4 : steps // 2] += 20 * rng.normal(size=y.shape[1])
    seen, trusted = np.ones(y.shape, bool), np.zeros(y.shape, bool)
    for row in range(2, steps, 3):
        seen[row, rng.integers(y.shape[1])] = False
    for row in range(1, steps, 5):
        trusted[row, rng.integers(y.shape[1])] = True
    return log(u, y, seen, trusted)
