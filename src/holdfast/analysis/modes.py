"""Which attacked channels a bank of modes can assume together, and what it then cannot tell apart.

Of all sets of channels those stay in the bank that are admissible
(`holdfast.analysis.admissible`) and not a part of a larger one that is.

Source: NISME, Section 6, Algorithm 3, with the attack-free set in it.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from holdfast.analysis.admissible import only, reason, samples, silent_for_ever, units
from holdfast.analysis.model import Model, model_at, models_over
from holdfast.analysis.nise_pair import nise_pair
from holdfast.numerics.gramian import Uniform, uniformly_observable
from holdfast.numerics.subspaces import Scaled
from holdfast.parts import Plant, no_attack
from holdfast.plants.linear import LinearPlant
from holdfast.plants.local import motion, sensing

CHANNELS = 16
"""Attack channels up to which all sets are listed."""
CHECKS = 1_000
"""Sets that are examined at most."""
PAIRS = 2_000
"""Pairs of kept sets that are examined at most."""

TOO_MANY = "the sets of channels that can be attacked together are too many"
LINEARISED = "the plant linearised there, without input and attack"


class Kept(NamedTuple):
    """A maximal admissible set of channels, by number.

    ``samples``: how many determine the state at the last of them. ``uniform``: of the paper's
    pair (C_3, Abar), which need not be observable.
    """

    channels: tuple[int, ...]
    samples: int
    uniform: Uniform


class Refused(NamedTuple):
    """A minimal set that no mode can assume, and why: each set that contains it is refused."""

    channels: tuple[int, ...]
    reason: str


class Position(NamedTuple):
    """Of one position of the switches; ``confusable``: pairs of ``kept``, by number.

    Each of the two has an attack that the other explains as well, for ever.
    """

    name: str
    kept: tuple[Kept, ...]
    refused: tuple[Refused, ...]
    confusable: tuple[tuple[int, int], ...]


class Reduction(NamedTuple):
    """``all``: modes of the full bank, all sets at all positions. ``steps``: that were looked at,
    None for a constant plant; ``note``: of which point or steps this is, empty if of all.
    ``positions`` is empty where ``reason`` says why nothing is known.
    """

    attacks: tuple[str, ...]
    all: int
    positions: tuple[Position, ...]
    steps: int | None
    note: str
    reason: str | None = None

    @property
    def kept(self) -> int:
        """Modes of the reduced bank."""
        return sum(len(position.kept) for position in self.positions)


class _Unknown(Exception):
    """Why nothing is said."""


def reduce(
    plant: Plant, at: np.ndarray, window: int | None = None, first: int = 1, most: int = CHANNELS
) -> Reduction:
    """The maximal admissible sets of attacked channels at every position of the switches.

    A linear plant as it is, any other as it is linearised at ``at``, a state (n,), or along
    states (T, n), one a step from ``first``. Of matrices per step, the ``window`` from
    ``first`` on is looked at (all that there are, if None); a constant plant has no window.
    More than ``most`` channels are too many, and a window takes three steps or more.

    Source: NISME, Algorithms 3 and 5 (line 4), for every position. Where the plant is not
    linear the answer is local: the points to come are not known beforehand (Remark 6.1).
    """
    names, count = plant.attacks, len(plant.attacks)
    every = 2**count * len(plant.positions)
    if count > most:
        return Reduction(names, every, (), None, "", f"{count} attack channels, over {most}")
    found, models = [], []
    try:
        for number, position in enumerate(plant.positions):
            models = _models(plant, number, np.asarray(at, float), window, first)
            found.append(_reduced(position, models))
    except _Unknown as why:
        return Reduction(names, every, (), None, "", str(why))
    steps = len(models) if len(models) > 1 else None
    note = models[0].note
    if steps is not None:
        note = f"steps {first} to {first + steps - 1}"
        note += "" if isinstance(plant, LinearPlant) else ", linearised at the given states"
    return Reduction(names, every, tuple(found), steps, note)


def _models(
    plant: Plant, number: int, at: np.ndarray, window: int | None, first: int
) -> list[Model]:
    """At one position of the switches: one model, or one for each step of the window."""
    position = jnp.asarray(number, jnp.int32)
    switched = plant.at_position(position)
    if isinstance(switched, LinearPlant) and at.ndim == 1:
        if switched.steps is None:
            return [model_at(switched, at, first)]
        until = None if window is None else first - 1 + window
        models = models_over(switched, at)[first - 1 : until]
    else:
        points = np.atleast_2d(at)[:window]
        models = [_near(plant, position, x, first + i) for i, x in enumerate(points)]
        if at.ndim == 1:
            return models
        # the step to k is linearised at k - 1, where it starts
        models = [
            m._replace(A=b.A, G=b.G) for m, b in zip(models, models[:1] + models, strict=False)
        ]
    if len(models) < 3:
        raise _Unknown(f"a window of {len(models)} steps, under three")
    return models


def _near(plant: Plant, position: jax.Array, x: np.ndarray, k: int) -> Model:
    """`model_at` at one position; compiled once for all positions, states and steps."""
    arrays = _tangent(plant, position, jnp.asarray(x), jnp.asarray(k, jnp.int32))
    A, G, C, H, Q, R = (np.asarray(array) for array in arrays)
    return Model(A, G, C, H, Q, R, plant.states, plant.outputs, plant.attacks, LINEARISED)


@eqx.filter_jit
def _tangent(plant: Plant, position: jax.Array, x: jax.Array, k: jax.Array):
    plant = plant.at_position(position)
    u, d = jnp.zeros(len(plant.inputs)), no_attack(plant)
    moved, sensed = motion(plant, k, x, u, d), sensing(plant, k, x, u, d)
    return moved.A, moved.G, sensed.C, sensed.H, moved.Q, sensed.R


def _reduced(name: str, models: list[Model]) -> Position:
    steps = units(models)
    count = steps[0].G.shape[1]
    later: dict[int, int | None] = {}

    def admissible(chosen: int) -> bool:
        if chosen not in later:
            if len(later) >= CHECKS:
                raise _Unknown(TOO_MANY)
            later[chosen] = samples(only(steps, _channels(chosen)))
        return later[chosen] is not None

    maximal, minimal = borders(count, admissible)
    kept = []
    for chosen in maximal:
        pair = nise_pair(models, _channels(chosen))
        uniform = uniformly_observable(pair.A, pair.C)
        kept.append(Kept(_channels(chosen), later[chosen] or 0, uniform))
    refused = []
    for chosen in minimal:
        refused.append(Refused(_channels(chosen), reason(only(steps, _channels(chosen)))))
    return Position(name, tuple(kept), tuple(refused), _confusable(steps, maximal))


def borders(count: int, admissible: Callable[[int], bool]) -> tuple[list[int], list[int]]:
    """The maximal admissible and the minimal refused sets of ``count`` channels, as bit masks.

    ``admissible`` must hold for every subset of a set for which it holds. The largest set about
    which nothing is known is looked at next, from all down to none: what is refused is made
    smaller until it is minimal, and settles every set that contains it.
    """
    masks = np.arange(2**count)
    size = np.sum(masks[:, None] >> np.arange(count) & 1, axis=1)
    unknown = np.ones(len(masks), bool)
    maximal, minimal = [], []
    while np.any(unknown):
        chosen = int(np.argmax(np.where(unknown, size, -1)))
        if admissible(chosen):
            # whatever is larger is known by now, and not admissible: this would be a part of it
            maximal.append(chosen)
            unknown &= (masks & ~chosen) != 0
            continue
        for bit in range(count):
            fewer = chosen & ~(1 << bit)
            if fewer != chosen and not admissible(fewer):
                chosen = fewer
        minimal.append(chosen)
        unknown &= (masks & chosen) != chosen
    return maximal, minimal


def _channels(mask: int) -> tuple[int, ...]:
    return tuple(i for i in range(mask.bit_length()) if mask >> i & 1)


def _confusable(steps: list[Scaled], maximal: list[int]) -> tuple[tuple[int, int], ...]:
    """Pairs of sets whose union has an attack that no sample ever shows.

    Neither set alone has one, so it takes channels of both: as d_1 - d_2 it is an attack on
    one that the other explains. A union that is refused for more than a delay always has.
    """
    pairs = [(i, j) for j in range(len(maximal)) for i in range(j)]
    if len(pairs) > PAIRS:
        raise _Unknown(TOO_MANY)
    known: dict[int, bool] = {}
    for i, j in pairs:
        union = maximal[i] | maximal[j]
        if union not in known:
            known[union] = silent_for_ever(only(steps, _channels(union)))
    return tuple((i, j) for i, j in pairs if known[maximal[i] | maximal[j]])
