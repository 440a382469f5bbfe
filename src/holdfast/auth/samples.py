"""Samples as payloads: one float64 of one sensor, big endian; and which sensor has which id."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

PAYLOAD_BYTES = 8

_double = struct.Struct(">d")


def encode(value: float) -> bytes:
    """The 8 bytes of a sample; every bit of it, NaN included."""
    return _double.pack(value)


def decode(payload: bytes) -> float | None:
    """The sample; None unless there are 8 bytes."""
    return _double.unpack(payload)[0] if len(payload) == PAYLOAD_BYTES else None


@dataclass(frozen=True)
class Sensors:
    """The sensors in the order of ``y``, and the data id of each (16 bits).

    Raises `ValueError` unless every sensor has an id of its own: a tag binds a sample to its
    sensor by the id alone.
    """

    names: tuple[str, ...]
    data_ids: tuple[int, ...]

    def __post_init__(self):
        if len(self.names) != len(self.data_ids):
            raise ValueError(
                f"data_ids: found {len(self.data_ids)}, expected one for each of "
                f"{len(self.names)} sensors"
            )
        for what, found in (("names", self.names), ("data_ids", self.data_ids)):
            if len(set(found)) < len(found):
                raise ValueError(f"{what}: found {list(found)}, expected each once")
        if not all(0 <= found <= 0xFFFF for found in self.data_ids):
            raise ValueError(f"data_ids: found {list(self.data_ids)}, expected 0 to 65535")

    @classmethod
    def of(cls, names: Sequence[str], first: int = 1) -> "Sensors":
        """Data ids first, first + 1, ... in the order of ``y``."""
        return cls(tuple(names), tuple(range(first, first + len(names))))

    def index(self, data_id: int) -> int | None:
        """Where in ``y`` the sensor with this data id stands; None if there is none."""
        return self.data_ids.index(data_id) if data_id in self.data_ids else None
