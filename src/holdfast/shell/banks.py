"""Banks of modes in a scenario: reduced before they are built; and what their modes are."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from holdfast.analysis.modes import Position, reduce
from holdfast.estimators.believed import Hypotheses, Sets
from holdfast.estimators.hypotheses import Mode, modes_of
from holdfast.estimators.nisme import Nisme
from holdfast.parts import Estimator, InvalidValue, Plant, no_attack
from holdfast.plants.linear import LinearPlant
from holdfast.shell.errors import shown
from holdfast.shell.schema import Table

REDUCED = "reduced"
"""The word for the modes that are enough, as a bank."""


def reduce_bank(table: Table, plant: Plant) -> None:
    """Put the modes that are enough where the table says ``bank = "reduced"``.

    These are the largest sets of the channels in ``modes`` that can be assumed together, at
    every position of the switches in ``modes`` (NISME, Algorithm 3), over ``window`` steps: of
    a plant with matrices per step those from the first on (all if not given), of a nonlinear
    one along its motion from x0 without input. Raises `InputError`.
    """
    values = table.values
    bank, window = values.get("bank"), values.pop("window", None)
    if bank != REDUCED:
        if window is not None:
            raise table.error("window", shown(window), f'none, or bank = "{REDUCED}" beside it')
        if isinstance(bank, str):
            raise table.error("bank", shown(bank), f'"{REDUCED}", or a list of modes')
        return
    if window is not None and (type(window) is not int or window < 3):
        raise table.error("window", shown(window), "a whole number from 3 up")
    modes = values.get("modes", "single")
    if "x0" not in values or not isinstance(modes, str | list):
        return  # what is wrong with those is said first
    try:
        listed = modes_of(plant, modes)
    except InvalidValue as error:
        raise table.error(error.key, str(error.found), error.expected) from None
    at = values["x0"]
    if window is not None and not isinstance(plant, LinearPlant):
        at = np.asarray(_motion(plant, jnp.asarray(at, float), window))
    found = reduce(plant, at, window)
    if found.reason is not None:
        raise table.error("bank", f'"{REDUCED}", but {found.reason}', "a list of modes")
    values["bank"] = [
        entry
        for number, position in enumerate(found.positions)
        for entry in _enough(table, position, [m for m in listed if m.position == number], plant)
    ]


def _enough(
    table: Table, position: Position, listed: Sequence[Mode], plant: Plant
) -> list[dict[str, Any]]:
    """The largest sets at a position of channels that are listed there."""
    if not listed:
        return []
    if not position.kept:
        found = f'"{REDUCED}", but not even without attack can the plant be tracked'
        raise table.error("bank", f"{found} at {position.name!r}", "modes without that position")
    used = {i for mode in listed for i, on in enumerate(mode.active) if on}
    sets = list(dict.fromkeys(frozenset(kept.channels) & used for kept in position.kept))
    largest = [chosen for chosen in sets if not any(chosen < other for other in sets)]
    names = [[plant.attacks[i] for i in sorted(chosen)] for chosen in largest]
    return [{"attacks": attacks, "switch": position.name} for attacks in names]


@eqx.filter_jit
def _motion(plant: Plant, x0: jax.Array, steps: int) -> jax.Array:
    """The states from x0 on, one a step, without input, noise or attack."""
    u, d = jnp.zeros(len(plant.inputs)), no_attack(plant)

    def step(x, k):
        return plant.transition(k, x, u, d), x

    return jax.lax.scan(step, x0, jnp.arange(1, steps + 1, dtype=jnp.int32))[1]


def hypotheses_of(estimator: Estimator) -> Sets | Hypotheses | None:
    """What the modes of ``Trace.named`` are; None for an estimator that weighs none."""
    if not isinstance(estimator, Nisme):
        return None
    return estimator.sets if estimator.hypotheses is None else estimator.hypotheses
