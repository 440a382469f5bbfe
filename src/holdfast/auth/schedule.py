"""Which message must carry a tag: a policy as both ends of a link look it up, step by step."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holdfast.records import Enforcement


@dataclass(frozen=True)
class Schedule:
    """At which steps each sensor's message must carry a tag.

    Either ``rules`` (every, duration, first) of each sensor, as in `records.Enforcement`, or a
    ``table`` of steps x sensors from step 0 on. Beyond a table every message must carry one:
    a stream that outlives its plan is not to become an open one.
    """

    rules: tuple[tuple[int, int, int], ...] = ()
    table: tuple[tuple[bool, ...], ...] | None = None

    @classmethod
    def of(cls, policy: Any) -> "Schedule":
        """From a `records.Enforcement` or a bool array of steps x sensors.

        Raises `ValueError` for an array of another shape or kind.
        """
        if isinstance(policy, Enforcement):
            rules = (
                np.asarray(policy.every),
                np.asarray(policy.duration),
                np.asarray(policy.first),
            )
            every, duration, first = (rule.tolist() for rule in rules)
            return cls(tuple(zip(every, duration, first, strict=True)))
        table = np.asarray(policy)
        if table.ndim != 2 or table.dtype != bool or not table.size:
            raise ValueError(
                f"policy: found {table.dtype} of shape {table.shape}, expected an Enforcement "
                "or bools, steps x sensors"
            )
        return cls(table=tuple(tuple(row) for row in table.tolist()))

    @property
    def sensors(self) -> int:
        """How many sensors it speaks of."""
        return len(self.rules if self.table is None else self.table[0])

    def at(self, k: int) -> tuple[bool, ...]:
        """For each sensor, whether its message at step ``k`` must carry a tag.

        Plain numbers: for a handful of sensors they are faster than any array.
        """
        if self.table is not None:
            return self.table[k] if 0 <= k < len(self.table) else (True,) * self.sensors
        return tuple(
            k >= first and (k - first) % (every if every > 1 else 1) < duration
            for every, duration, first in self.rules
        )

    def mask(self, start: int, stop: int) -> NDArray[np.bool_]:
        """The steps start..stop-1 at once: (steps x sensors), as `Enforcement.at` says it."""
        steps = np.arange(start, stop)[:, None]
        if self.table is not None:
            table = np.asarray(self.table)
            inside = (steps[:, 0] >= 0) & (steps[:, 0] < len(table))
            found = np.ones((len(steps), self.sensors), bool)
            found[inside] = table[steps[inside, 0]]
            return found
        every, duration, first = np.asarray(self.rules).reshape(-1, 3).T
        since = steps - first
        return (since >= 0) & (since % np.maximum(every, 1) < duration)

    def tags(self, start: int, stop: int) -> NDArray[np.int_]:
        """How many messages of each sensor must carry a tag in the steps start..stop-1."""
        return self.mask(start, stop).sum(axis=0)
