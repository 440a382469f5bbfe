"""Which shards of a fleet are ours, where several processes share one through a broker.

Every process says that it is there (retained, taken back by its last will), and whose a shard is
(retained). A shard whose owner is gone is offered by the first of those present, by name, on a
topic with a shared subscription: the broker gives each offer to one process alone. Who takes a
shard says so; of two who do, the one whose word the broker has last. All processes hear the
broker's messages in the same order, so that they agree.

No network here: words go in, actions come out.
"""

import math
from typing import Literal, NamedTuple

AGAIN = 1.0
"""Seconds until a shard that nobody took is offered again."""


class Action(NamedTuple):
    """What to do about a shard: offer it, say that it is ours, begin it, or drop it."""

    kind: Literal["offer", "claim", "begin", "drop"]
    shard: int


class Shares:
    """The words that one process has heard. ``name``: its own, never used before.

    ``now``: a clock that only goes forward, in seconds.
    """

    def __init__(self, name: str, shards: int):
        self.name, self.shards = name, shards
        self.present = {name}
        self.ours: set[int] = set()
        """Shards that we work on."""
        self._owners: dict[int, str] = {}
        self._claimed: set[int] = set()
        self._offered: dict[int, float] = {}
        self._leaving = False

    @property
    def fair(self) -> int:
        """How many shards a process has at most."""
        return math.ceil(self.shards / len(self.present))

    def hear_presence(self, name: str, here: bool) -> list[Action]:
        """A process is there, or is gone."""
        if name == self.name:
            return []
        if not here:
            self.present.discard(name)
            return []
        self.present.add(name)
        # what is more than our share goes to others
        surplus = sorted(self.ours)[self.fair :]
        return [Action("drop", shard) for shard in surplus]

    def hear_owner(self, shard: int, name: str) -> list[Action]:
        """Whose a shard is; "": nobody's."""
        self._owners[shard] = name
        if name == self.name:
            self._claimed.discard(shard)
            if shard in self.ours:
                return []
            if self._leaving or len(self.ours) >= self.fair:
                # others have come since
                return [Action("drop", shard)]
            self.ours.add(shard)
            return [Action("begin", shard)]
        if shard in self.ours:
            # somebody said so after us, or gave back what he did not know to be ours by then
            return [Action("drop" if name else "claim", shard)]
        return []

    def hear_offer(self, shard: int) -> list[Action]:
        """The broker gave us a shard that somebody offered. One that we leave alone is offered
        again, and comes to another.
        """
        known = shard in self.ours or shard in self._claimed or not self._free(shard)
        if known or self._leaving or len(self.ours) + len(self._claimed) >= self.fair:
            return []
        self._claimed.add(shard)
        return [Action("claim", shard)]

    def leave(self) -> list[Action]:
        """Take nothing any more, and give everything back."""
        self._leaving = True
        return [Action("drop", shard) for shard in sorted(self.ours)]

    @property
    def waiting(self) -> bool:
        """Whether we have claimed a shard and not heard our own word on it yet."""
        return bool(self._claimed)

    def owns(self, shard: int) -> bool:
        """Whether the last word on a shard is ours."""
        return self._owners.get(shard) == self.name

    def dropped(self, shard: int) -> None:
        """We no longer work on it."""
        self.ours.discard(shard)

    def tick(self, now: float) -> list[Action]:
        """What the first of those present offers."""
        if self._leaving or self.name != min(self.present):
            return []
        due = [
            shard for shard in range(self.shards)
            if self._free(shard) and now - self._offered.get(shard, -math.inf) >= AGAIN
        ]  # fmt: skip
        self._offered |= dict.fromkeys(due, now)
        return [Action("offer", shard) for shard in due]

    def _free(self, shard: int) -> bool:
        return self._owners.get(shard, "") not in self.present
