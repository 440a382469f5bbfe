"""Keys and their succession."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise


@dataclass(frozen=True)
class Key:
    """A secret with a number, active from the freshness value ``first`` until the next key is.

    Raises `ValueError` for a negative ``first``.
    """

    id: int
    secret: bytes = field(repr=False)
    first: int = 0

    def __post_init__(self):
        if self.first < 0:
            raise ValueError(f"first: found {self.first}, expected 0 or more")


@dataclass(frozen=True)
class KeyRing:
    """The keys of a stream, oldest first. Exactly one is active at each freshness value.

    Both ends hold the next key before the value at which it becomes active, so they change
    over at the same message without a word on the wire, and there is nothing to overlap: the
    old key is right below that value and wrong from there on. A verifier that has not yet seen
    that value still accepts the old key; if that key has leaked, a synchronisation message
    with a value above closes it.

    Raises `ValueError` if two keys share an id or a first value, or are not in order.
    """

    keys: tuple[Key, ...]

    def __post_init__(self):
        firsts = [key.first for key in self.keys]
        if not firsts or any(b <= a for a, b in pairwise(firsts)):
            raise ValueError(f"keys: found first values {firsts}, expected one or more, rising")
        ids = [key.id for key in self.keys]
        if len(set(ids)) < len(ids):
            raise ValueError(f"keys: found ids {ids}, expected each once")

    @classmethod
    def of(cls, secret: bytes) -> "KeyRing":
        """One key, number 0, for all freshness values."""
        return cls((Key(0, secret),))

    def at(self, value: int) -> Key | None:
        """The key that is active at this freshness value; None before the first."""
        return next((key for key in reversed(self.keys) if key.first <= value), None)

    def rotated(self, key: Key) -> "KeyRing":
        """With a next key. Raises `ValueError` if it does not start after the newest."""
        return KeyRing((*self.keys, key))

    def without(self, ids: Sequence[int]) -> "KeyRing":
        """Without these keys; messages from their time are then UNKNOWN_KEY, not accepted.

        Only the oldest can go: what a later key took over would fall back to an earlier one.
        Raises `ValueError` otherwise.
        """
        kept = tuple(key for key in self.keys if key.id not in ids)
        if kept != self.keys[len(self.keys) - len(kept) :]:
            raise ValueError(f"ids: found {list(ids)}, expected the oldest keys")
        return KeyRing(kept)

    def sized(self, length: int) -> "KeyRing":
        """The ring itself. Raises `ValueError` if a secret has not ``length`` bytes."""
        for key in self.keys:
            if len(key.secret) != length:
                raise ValueError(f"key {key.id}: found {len(key.secret)} bytes, expected {length}")
        return self
