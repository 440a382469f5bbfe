"""Where the attack channels of a plant enter, whatever the numbers: found once, on the host."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from holdfast.numerics.linalg import RANK_TOLERANCE
from holdfast.parts import Plant
from holdfast.plants.linear import LinearPlant, Table
from holdfast.plants.local import motion, sensing


def direct_channels(plant: Plant, x0: np.ndarray) -> np.ndarray:
    """Which channels' axes lie in the row space of H; per step where the plant is.

    ``x0``: the state near which a nonlinear plant is looked at.
    """
    return _over_time(plant, x0, _direct)


def hidden_input(plant: Plant, x0: np.ndarray) -> np.ndarray:
    """Whether an attack moves the state and reaches no output of its own row or the next."""
    return _over_time(plant, x0, _hidden)


Find = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def _over_time(plant: Plant, x0: np.ndarray, of: Find) -> np.ndarray:
    """A structural property of (C, G, H): per step where they are, on every grid point and so
    between them where they are scheduled, near ``x0`` where the plant is not linear, else once.
    """
    if not isinstance(plant, LinearPlant):
        return of(*_generic(plant, x0))
    given = [getattr(plant, name) for name in "CGH"]
    # copied once: an entry of a JAX array takes a millisecond's worth of dispatch
    sources = [np.asarray(v.values if isinstance(v, Table) else v) for v in given]
    per_step = [
        v.ndim == 3 and not isinstance(g, Table) for v, g in zip(sources, given, strict=True)
    ]
    lengths = [len(v) for v, moves in zip(sources, per_step, strict=True) if moves]
    grids = [len(v) for v in sources if v.ndim == 3]
    count = min(lengths) if lengths else max(grids, default=1)

    def entry(source: np.ndarray, i: int) -> np.ndarray:
        return source if source.ndim == 2 else source[i % len(source)]

    found = np.stack([of(*(entry(source, i) for source in sources)) for i in range(count)])
    return found if lengths else np.asarray(np.all(found, 0))


def _generic(plant: Plant, x0: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """C, G, H off the special points (standstill, straight ahead) where a rank may drop."""
    irrational = np.sqrt(np.arange(2, 2 + max(len(x0), len(plant.attacks))))
    x = jnp.asarray(x0 + 0.1 * irrational[: len(x0)])
    d = jnp.asarray(0.1 * irrational[: len(plant.attacks)])
    u = jnp.zeros(len(plant.inputs))
    k = jnp.asarray(1, jnp.int32)
    moved, sensed = motion(plant, k, x, u, d), sensing(plant, k, x, u, d)
    return np.asarray(sensed.C), np.asarray(moved.G), np.asarray(sensed.H)


def _rank(rows: np.ndarray) -> int:
    """Rank after scaling rows and columns to unit size: units of a channel do not matter."""
    for axis in (1, 0):
        norms = np.linalg.norm(rows, axis=axis, keepdims=True)
        rows = np.divide(rows, norms, out=np.zeros_like(rows), where=norms > 0)
    return int(np.linalg.matrix_rank(rows, tol=RANK_TOLERANCE)) if rows.size else 0


def _direct(C: np.ndarray, G: np.ndarray, H: np.ndarray) -> np.ndarray:
    axes = np.eye(H.shape[1])
    return np.array([_rank(np.vstack([H, axis])) == _rank(H) for axis in axes], bool)


def _hidden(C: np.ndarray, G: np.ndarray, H: np.ndarray) -> np.ndarray:
    felt = np.vstack([H, C @ G])
    return np.array(_rank(np.vstack([felt, G])) > _rank(felt))
