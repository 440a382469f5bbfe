"""The modes that a bank weighs: which channels are attacked, and where the switches stand."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from holdfast.estimators.nise import active_channels
from holdfast.parts import InvalidValue, Plant

KEYS = ("name", "attacks", "switch")
MOST = 1 << 16
"""Modes that "all" may stand for."""


class Mode(NamedTuple):
    """One hypothesis: a position of the switches, by number, and the channels attacked."""

    name: str
    position: int
    active: tuple[bool, ...]


def modes_of(plant: Plant, wanted: Sequence[Any] | str, key: str = "modes") -> tuple[Mode, ...]:
    """The modes that a scenario lists: lists of attack names, or tables with ``attacks``,
    ``switch`` and ``name``; "all" for every set of channels in every position, "single" for
    none, each channel alone, and each position without attack.

    Raises `InvalidValue` about ``key`` for an unknown name, a mode or name that comes twice.
    """
    if isinstance(wanted, str):
        if wanted not in ("all", "single"):
            words = '"single", "all", or a list of lists of attack names'
            raise InvalidValue(key, repr(wanted), words)
        return _all(plant) if wanted == "all" else _single(plant)
    if not wanted:
        raise InvalidValue(key, "an empty list", "at least one mode; [] is the one without")
    found = tuple(_mode(plant, entry, key) for entry in wanted)
    for what, values in (
        ("names", [m.name for m in found]),
        ("modes", [(m.position, m.active) for m in found]),
    ):
        for i, value in enumerate(values):
            if value in values[:i]:
                raise InvalidValue(key, repr(found[i].name), f"{what} that differ")
    return found


def _mode(plant: Plant, entry: Any, key: str) -> Mode:
    if isinstance(entry, dict):
        unknown = [name for name in entry if name not in KEYS]
        if unknown:
            raise InvalidValue(key, f"the key {unknown[0]!r}", f"one of {', '.join(KEYS)}")
        attacks, switch = entry.get("attacks", []), entry.get("switch", plant.positions[0])
        name = entry.get("name")
        if name is not None and not isinstance(name, str):
            raise InvalidValue(key, repr(name), "a name in quotes")
    else:
        attacks, switch, name = entry, plant.positions[0], None
    if not isinstance(attacks, list | tuple) or any(not isinstance(a, str) for a in attacks):
        raise InvalidValue(key, repr(attacks), "a list of attack names")
    if switch not in plant.positions:
        raise InvalidValue(key, repr(switch), f"one of {', '.join(plant.positions)}")
    active = tuple(bool(a) for a in active_channels(plant, attacks, key))
    position = plant.positions.index(switch)
    return Mode(_name(plant, attacks, position) if name is None else name, position, active)


def _name(plant: Plant, attacks: Sequence[str], position: int) -> str:
    parts = [*attacks, *([plant.positions[position]] if position else [])]
    return "+".join(parts) or "none"


def _single(plant: Plant) -> tuple[Mode, ...]:
    alone = [{"attacks": attacks} for attacks in [[], *([name] for name in plant.attacks)]]
    switched = [{"switch": name} for name in plant.positions[1:]]
    return tuple(_mode(plant, entry, "modes") for entry in [*alone, *switched])


def _all(plant: Plant) -> tuple[Mode, ...]:
    count = len(plant.positions) * 2 ** len(plant.attacks)
    if count > MOST:
        raise InvalidValue("modes", f'"all", which is {count} modes', f"a list of at most {MOST}")
    sets = [
        attacks
        for size in range(len(plant.attacks) + 1)
        for attacks in itertools.combinations(plant.attacks, size)
    ]
    return tuple(
        Mode(_name(plant, attacks, position), position, tuple(a in attacks for a in plant.attacks))
        for position in range(len(plant.positions))
        for attacks in sets
    )


class Slots(NamedTuple):
    """Modes arranged by group, and by the channels each of them uses; see `bank.Group`.

    ``modes`` (s, j): which mode stands there; the last of a group is repeated where it has
    fewer than others, and ``real`` is False there.
    """

    modes: np.ndarray
    real: np.ndarray
    position: np.ndarray
    before: np.ndarray
    before_on: np.ndarray
    now: np.ndarray
    now_on: np.ndarray


def arranged(
    modes: Sequence[Mode], moving: np.ndarray, sensed: np.ndarray, together: bool
) -> Slots:
    """The modes of one position ``together``, or each for itself.

    ``moving``, ``sensed``: which channels reach the dynamics, and which an output.
    """
    active = np.array([m.active for m in modes], bool).reshape(len(modes), -1)
    position = np.array([m.position for m in modes])
    groups = [np.array([i]) for i in range(len(modes))]
    if together:
        groups = [np.flatnonzero(position == p) for p in np.unique(position)]
    width = max(map(len, groups))
    number = np.stack([np.pad(g, (0, width - len(g)), mode="edge") for g in groups])
    real = np.stack([np.arange(width) < len(g) for g in groups])
    before, before_on = _listed(active & moving)
    now, now_on = _listed(active & sensed)
    return Slots(
        number, real, position[number[:, 0]],
        before[number], before_on[number], now[number], now_on[number],
    )  # fmt: skip


def _listed(used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The numbers of the channels used, one row per mode, and which entries of it count."""
    width = int(np.max(np.sum(used, 1), initial=0))
    # stable: the used ones first, in the plant's order
    order = np.argsort(~used, axis=1, kind="stable")[:, :width]
    return order, np.take_along_axis(used, order, 1)
