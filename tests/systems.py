"""Random systems for tests: plants whose attacks can be estimated, and how well posed they are."""

import warnings
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from scipy.linalg import eigvals

from holdfast.plants.build import linear_plant
from holdfast.plants.linear import LinearPlant
from holdfast.records import Observation


class System(NamedTuple):
    plant: LinearPlant
    x0: np.ndarray
    P0: np.ndarray


def quiet_plant(**matrices) -> LinearPlant:
    """A plant whose A may well have all its eigenvalues in the left half plane."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return linear_plant(**matrices)


def covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


def attack_strength(C, G, H) -> float:
    """Smallest singular value of the map from attacks to outputs: H, then C G unseen by H."""
    U, s, Vt = np.linalg.svd(H)
    rank = int(np.sum(s > 1e-10))
    smallest = [s[rank - 1]] if rank else []
    rest = H.shape[1] - rank
    if rest:
        second = U[:, rank:].T @ C @ G @ Vt[rank:].T
        values = np.linalg.svd(second, compute_uv=False)
        smallest.append(values[rest - 1] if len(values) >= rest else 0.0)
    return float(min(smallest, default=1.0))


def largest_zero(A, G, C, H, rng) -> float:
    """Largest modulus of an invariant zero: where the system pencil loses column rank.

    Non-square pencils are squared by random output combinations; a zero is one that survives.
    """
    n, nd = G.shape
    mix = rng.normal(size=(nd, C.shape[0])) if C.shape[0] > nd else np.eye(nd)
    left = np.block([[A, G], [mix @ C, mix @ H]])
    right = np.zeros((n + nd, n + nd))
    right[:n, :n] = np.eye(n)
    found = eigvals(left, right)
    largest = 0.0
    for z in found[np.isfinite(found)]:
        pencil = np.block([[A - z * np.eye(n), G], [C, H]])
        if abs(z) < 1e6 and np.linalg.svd(pencil, compute_uv=False)[-1] < 1e-8 * (1 + abs(z)):
            largest = max(largest, abs(z))
    return largest


def random_system(seed: int, n: int, ny: int, nd: int, rank: int) -> System:
    """Full Q and R, spectral radius 0.9; H of the rank given; well posed by rejection.

    Well posed: `attack_strength` at least 0.05, invariant zeros inside 0.95.
    """
    rng = np.random.default_rng(seed)
    while True:
        A = rng.normal(size=(n, n))
        A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
        C, G = rng.normal(size=(ny, n)), rng.normal(size=(n, nd))
        H = rng.normal(size=(ny, rank)) @ rng.normal(size=(rank, nd))
        if attack_strength(C, G, H) < 0.05:
            continue
        if nd == 0 or largest_zero(A, G, C, H, rng) < 0.95:
            break
    plant = quiet_plant(
        A=A,
        B=rng.normal(size=(n, 1)),
        C=C,
        D=rng.normal(size=(ny, 1)),
        G=G,
        H=H,
        Q=covariance(rng, n),
        R=covariance(rng, ny),
    )
    return System(plant, rng.normal(size=n), covariance(rng, n))


def random_log(seed: int, plant: LinearPlant, steps: int, missing: float = 0.0):
    """Inputs, measurements and which arrived. Any numbers do: estimators are linear."""
    rng = np.random.default_rng(seed + 10_000)
    u = rng.normal(size=(steps, len(plant.inputs)))
    y = rng.normal(size=(steps, len(plant.outputs)))
    return u, y, rng.random(y.shape) >= missing


def matrices(plant: LinearPlant) -> list[np.ndarray]:
    """A, B, C, D, G, H, Q, R of a constant plant."""
    found = plant.at(1, np.zeros(len(plant.states)), np.zeros(len(plant.inputs)))
    return [np.asarray(m) for m in found]


@eqx.filter_jit
def run(estimator, observations):
    """Every estimate of a log; plant arrays are arguments, so one compilation a shape."""
    start = estimator.init()[0]
    return jax.lax.scan(lambda s, o: estimator.step(s, o), start, observations)[1]


def estimates(estimator, u, y, seen, trusted=None):
    observation = Observation.of(u, np.where(seen, y, 0.0), seen, trusted)
    return jax.tree.map(np.asarray, run(estimator, observation))
