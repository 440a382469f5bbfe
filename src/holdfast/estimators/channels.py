"""Where the attack channels of a plant enter, whatever the numbers: found once, on the host."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from holdfast.numerics.linalg import RANK_TOLERANCE
from holdfast.parts import Plant
from holdfast.plants.linear import LinearPlant, Table
from holdfast.plants.local import motion, sensing


def direct_channels(plant: Plant, x0: np.ndarray, active: np.ndarray | None = None) -> np.ndarray:
    """Which channels' axes lie in the row space of H; per step where the plant is.

    ``x0``: the state near which a nonlinear plant is looked at. ``active``: the channels that
    can be attacked, all if not given; the columns of the others count as 0.
    """
    return _over_time(plant, x0, active, _direct)


def hidden_input(plant: Plant, x0: np.ndarray, active: np.ndarray | None = None) -> np.ndarray:
    """Whether an attack moves the state and reaches no output of its own row or the next."""
    return _over_time(plant, x0, active, _hidden)


Find = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
Entries = list[tuple[np.ndarray, np.ndarray, np.ndarray]]


def _over_time(plant: Plant, x0: np.ndarray, active: np.ndarray | None, find: Find) -> np.ndarray:
    """A structural property of (C, G, H): per step where they are, on every grid point and so
    between them where they are scheduled, near ``x0`` where the plant is not linear, else once.
    """
    entries, per_step = _entries(plant, x0)
    found = _each(entries, active, find)
    return found if per_step else np.asarray(np.all(found, 0))


def _each(entries: Entries, active: np.ndarray | None, find: Find) -> np.ndarray:
    mask = 1.0 if active is None else np.asarray(active, float)
    return np.stack([find(C, G * mask, H * mask) for C, G, H in entries])


def _entries(plant: Plant, x0: np.ndarray) -> tuple[Entries, bool]:
    """Every (C, G, H) that the plant can have, and whether they are those of the steps."""
    if not isinstance(plant, LinearPlant):
        return [_generic(plant, x0)], False
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

    entries = [
        (entry(sources[0], i), entry(sources[1], i), entry(sources[2], i)) for i in range(count)
    ]
    return entries, bool(lengths)


class Reach(NamedTuple):
    """Where attacks enter, for several sets of active channels in several switch positions.

    ``moving``, ``sensed`` (nd,): channels that reach the dynamics, and an output, in any of
    them; ``direct`` (sets, nd) and ``hidden`` (sets,): as `direct_channels` (at every step) and
    `hidden_input` (at any).
    """

    moving: np.ndarray
    sensed: np.ndarray
    direct: np.ndarray
    hidden: np.ndarray


def reach(
    plant: Plant, x0: np.ndarray, positions: Sequence[int], active: Sequence[Sequence[bool]]
) -> Reach:
    """The above, one set of active channels per entry of ``positions``."""
    entries = {
        p: _entries(plant.at_position(jnp.asarray(p, jnp.int32)), x0)[0] for p in {*positions}
    }
    every = [entry for found in entries.values() for entry in found]
    sets = list(zip(positions, map(np.asarray, active), strict=True))
    return Reach(
        np.any([np.any(G != 0, 0) for _, G, _ in every], 0),
        np.any([np.any(H != 0, 0) for _, _, H in every], 0),
        np.stack([np.all(_each(entries[p], used, _direct), 0) for p, used in sets]),
        np.array([np.any(_each(entries[p], used, _hidden)) for p, used in sets]),
    )


def _generic(plant: Plant, x0: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """C, G, H off the special points (standstill, straight ahead) where a rank may drop."""
    irrational = np.sqrt(np.arange(2, 2 + max(len(x0), len(plant.attacks))))
    x = jnp.asarray(x0 + 0.1 * irrational[: len(x0)])
    d = jnp.asarray(0.1 * irrational[: len(plant.attacks)])
    u = jnp.zeros(len(plant.inputs))
    k = jnp.asarray(1, jnp.int32)
    C, G, H = _tangent(plant, k, x, u, d)
    return np.asarray(C), np.asarray(G), np.asarray(H)


@eqx.filter_jit
def _tangent(plant: Plant, k, x, u, d):
    """Compiled once for all switch positions of a plant."""
    moved, sensed = motion(plant, k, x, u, d), sensing(plant, k, x, u, d)
    return sensed.C, moved.G, sensed.H


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
