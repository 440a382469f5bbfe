"""Attack channels by name: a falsified sensor, or a falsified actuator."""

from collections.abc import Sequence

import numpy as np

from holdfast.parts import InvalidValue

SHOWN = 12
"""How many names a message lists."""


def channels(
    attacks: Sequence[str],
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    expected: str = "",
) -> tuple[np.ndarray, np.ndarray]:
    """Which input (nu x nd) and which output (ny x nd) each attack channel adds to, as 0 and 1.

    "actuator:INPUT" adds to that input, "sensor:OUTPUT" to that output. Of a linear plant

        G = B act,   H = D act + sens

    make channel j do to the plant what the same number added to the input or the output does.
    ``expected`` stands in messages for the list of the names, where that would be long.

    Raises `InvalidValue` for ``attacks[i]`` (counted from 1) that is no such name, and for
    ``attacks`` in which a name comes twice.
    """
    if len(set(attacks)) != len(attacks):
        raise InvalidValue("attacks", list(attacks), "names that differ")
    names = [*(f"actuator:{name}" for name in inputs), *(f"sensor:{name}" for name in outputs)]
    for i, attack in enumerate(attacks, 1):
        if attack not in names:
            listed = ", ".join(names[:SHOWN]) + (", .." if len(names) > SHOWN else "")
            raise InvalidValue(f"attacks[{i}]", repr(attack), expected or f"one of {listed}")
    chosen = np.eye(len(names))[:, [names.index(attack) for attack in attacks]]
    return chosen[: len(inputs)], chosen[len(inputs) :]
