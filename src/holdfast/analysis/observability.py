"""Whether the outputs determine the state when nobody attacks, and from how many samples."""

from typing import NamedTuple

import numpy as np

from holdfast.analysis.model import Model
from holdfast.numerics.steady_state import UNSTABLE
from holdfast.numerics.subspaces import (
    Scaled,
    complement,
    legible,
    modes,
    scaled,
    silent,
    span,
)


class Observability(NamedTuple):
    """``rows``: how many samples determine the state (the observability index); None: none do.

    ``hidden`` (n x r): the state directions that no output shows, in the plant's units: the
    identity on r states. ``sensors``: the states that would each, measured alone, make
    the plant observable.
    """

    observable: bool
    rows: int | None
    hidden: np.ndarray
    eigenvalues: np.ndarray
    unstable: int
    sensors: tuple[str, ...]


def observability(model: Model) -> Observability:
    """Rank of [C; C A; ...; C A^(v-1)], the smallest v for which it is n, and the modes of A.

    ``unstable`` counts |lambda| >= 1 - 1e-7. Ranks as in `holdfast.numerics.subspaces`.
    """
    told = silent(_unattacked(model))
    n = len(model.states)
    observable = told[-1].shape[1] == n
    found = modes(_unattacked(model).A)
    eigenvalues = np.array([z for z, count in found for _ in range(count)], complex)
    return Observability(
        observable,
        len(told) - 1 if observable else None,
        legible(complement(told[-1]) * _units(model)[:, None]),
        eigenvalues,
        int(np.sum(np.abs(eigenvalues) >= UNSTABLE)),
        () if observable else _that_show(model),
    )


def rows_until_observable(models: list[Model]) -> int | None:
    """How many rows, from the first, determine the state before them; None if all do not.

    For plants whose matrices change from step to step.
    """
    if not models:
        return None
    n = len(models[0].states)
    through, told = np.eye(n), np.zeros((n, 0))
    units = _units(models[0])
    for count, model in enumerate(models, 1):
        through = (model.A * units / units[:, None]) @ through
        rows = model.C * units @ through
        sizes = np.linalg.norm(rows, axis=1)
        rows = rows / np.where(sizes > 0, sizes, 1.0)[:, None]
        told = span(np.hstack([told, rows.T]))
        if told.shape[1] == n:
            return count
    return None


def _unattacked(model: Model) -> Scaled:
    n, ny = len(model.states), len(model.outputs)
    return scaled(model.A, np.zeros((n, 0)), model.C, np.zeros((ny, 0)))


def _units(model: Model) -> np.ndarray:
    return _unattacked(model).x


def _that_show(model: Model) -> tuple[str, ...]:
    found = []
    for i, name in enumerate(model.states):
        told = silent(_unattacked(model.measuring(i)))
        if told[-1].shape[1] == len(model.states):
            found.append(name)
    return tuple(found)
