"""The keys of `holdfast.estimators.secure_fusion`: what cannot be is refused by name."""

from collections.abc import Sequence

import numpy as np

from holdfast.estimators.penalty import RULES
from holdfast.parts import InvalidValue
from holdfast.plants.linear import LinearPlant


def check(gamma, rule, share, attack_size, norm, suspect) -> None:
    """The first key that cannot be, as `InvalidValue`."""
    for key, value, allowed in (("rule", rule, RULES), ("norm", norm, ("modulus", "group"))):
        if value not in (None, *allowed):
            raise InvalidValue(key, repr(value), " or ".join(map(repr, allowed)))
    if gamma is not None and rule is not None:
        raise InvalidValue("rule", repr(rule), "no rule beside a gamma that is given")
    if gamma is not None and not (np.isfinite(gamma) and gamma > 0):
        raise InvalidValue("gamma", gamma, "a positive number")
    if share is not None and (gamma is not None or rule == "worst_case"):
        raise InvalidValue("share", share, 'no share without the rule "coincide" or "loss"')
    if share is not None and not 0 < share < 1:
        raise InvalidValue("share", share, "a number between 0 and 1")
    if not (np.isfinite(attack_size) and attack_size > 0):
        raise InvalidValue("attack_size", attack_size, "a positive number of standard deviations")
    if not suspect > 0:
        raise InvalidValue("suspect", suspect, "a positive number of standard deviations")


def numbers(plant: LinearPlant, key: str, names: Sequence[str]) -> list[int]:
    """Which outputs the names of a key are."""
    for name in names:
        if name not in plant.outputs:
            raise InvalidValue(key, repr(name), f"one of {', '.join(plant.outputs)}")
    return [plant.outputs.index(name) for name in names]
