"""Messages as bytes: JSON, CSV cells and a compact binary frame.

A JSON object is a row of a log by the names of its columns:

    {"time": 12.3, "u:accel": 0.1, "y:gps": 4.2, "trusted": ["gps"]}

A value of null, or one that is left out, did not arrive. Text, true, a list is a fault of that
sample (NaN). ``"secured": {"gps": "0a1b.."}`` holds messages of `holdfast.auth` in hex.
``"partial": true``: what is left out is still to come in another message.

The binary frame, little endian: the bytes ``HFB1``; u8 flags (1: partial); u8 0; u16 number of
columns; f64 time (NaN: none); then for every column (inputs, then outputs, in the plant's order)
a f64, and at last for every column a u8: 0 did not arrive, 1 arrived, 3 arrived and authenticated
(only the broker's word: believed where the source says ``trust = true``).
"""

import binascii
import json
import math
import struct
from collections.abc import Callable, Mapping
from typing import Any

from holdfast.shell.service.records import Labels, Samples

MAGIC = b"HFB1"
LIMIT = 64 * 1024
"""Bytes of a message; longer ones are not read."""
_HEAD = struct.Struct("<4sBBHd")

Decoder = Callable[[bytes], Samples | None]
"""Reads a message; None where it is none."""


def json_decoder(labels: Labels, trust: bool = False) -> Decoder:
    """Of JSON objects. ``trust``: whether the sender's word "trusted" counts."""
    columns = frozenset(labels.columns)
    outputs = frozenset(labels.outputs)

    def decode(message: bytes) -> Samples | None:
        if len(message) > LIMIT:
            return None
        try:
            found = json.loads(message)
        except (ValueError, RecursionError):
            return None
        return _from_object(found, columns, outputs, trust) if isinstance(found, dict) else None

    return decode


def _from_object(
    found: dict[str, Any], columns: frozenset[str], outputs: frozenset[str], trust: bool
) -> Samples | None:
    time = found.get("time")
    if time is None:
        time = math.nan
    elif not is_number(time) or not math.isfinite(time):
        return None
    values = {
        name: as_float(value)
        for name, value in found.items()
        if name in columns and value is not None
    }
    named = found.get("trusted", ()) if trust else ()
    named = named if isinstance(named, list) else ()
    trusted = frozenset(name for name in named if isinstance(name, str)) & outputs
    secured = _secured(found.get("secured"), outputs)
    if not values and not secured and not trusted:
        # an object of nobody's signals says no more than noise does
        return None
    return Samples(float(time), values, trusted, secured, found.get("partial") is not True)


def _secured(found: Any, outputs: frozenset[str]) -> Mapping[str, bytes]:
    messages = {}
    for name, text in found.items() if isinstance(found, dict) else ():
        if name in outputs and isinstance(text, str):
            try:
                messages[name] = binascii.unhexlify(text)
            except (ValueError, binascii.Error):
                messages[name] = b""  # not a message: the verifier says so
    return messages


def binary_decoder(labels: Labels, trust: bool = False) -> Decoder:
    """Of binary frames."""
    columns = labels.columns
    count = len(columns)
    body = struct.Struct(f"<{count}d{count}B")
    first_output = len(labels.inputs)

    def decode(message: bytes) -> Samples | None:
        if len(message) != _HEAD.size + body.size:
            return None
        magic, flags, _, found, time = _HEAD.unpack_from(message)
        if magic != MAGIC or found != count or math.isinf(time):
            return None
        cells = body.unpack_from(message, _HEAD.size)
        marks = cells[count:]
        values = {name: cells[i] for i, name in enumerate(columns) if marks[i] & 1}
        trusted = frozenset(
            labels.outputs[i - first_output]
            for i in range(first_output, count)
            if trust and marks[i] & 3 == 3
        )
        return Samples(time, values, trusted, {}, not flags & 1)

    return decode


def binary_frame(labels: Labels, samples: Samples) -> bytes:
    """The binary frame of these samples: what a sender writes."""
    columns = labels.columns
    count = len(columns)
    values = [samples.values.get(name, 0.0) for name in columns]
    marks = [
        (3 if name[2:] in samples.trusted and name[0] == "y" else 1)
        if name in samples.values else 0
        for name in columns
    ]  # fmt: skip
    head = _HEAD.pack(MAGIC, 0 if samples.whole else 1, 0, count, samples.time)
    return head + struct.pack(f"<{count}d{count}B", *values, *marks)


DECODERS: dict[str, Callable[[Labels, bool], Decoder]] = {
    "json": json_decoder,
    "binary": binary_decoder,
}


def single(column: str) -> Decoder:
    """Of messages that hold one column: a number as text, or {"time": .., "value": ..}."""

    def decode(message: bytes) -> Samples | None:
        if len(message) > LIMIT:
            return None
        try:
            found = json.loads(message)
        except (ValueError, RecursionError):
            return None
        time = math.nan
        if isinstance(found, dict):
            stamp = found.get("time")
            if stamp is not None:
                if not is_number(stamp) or not math.isfinite(stamp):
                    return None
                time = float(stamp)
            if "value" not in found:
                return None
            found = found["value"]
        return None if found is None else Samples(time, {column: as_float(found)})

    return decode


def is_number(value: Any) -> bool:
    """Whether JSON gave a number, and one that a float holds."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        float(value)
    except OverflowError:
        return False
    return True


def as_float(value: Any) -> float:
    """A sample's value; NaN, a fault, where it is no number."""
    return float(value) if is_number(value) else math.nan


def line_decoder(labels: Labels, trust: bool = False) -> Callable[[bytes], Samples | None]:
    """Of lines that are JSON objects, or CSV after a header of a log's columns."""
    from_json = json_decoder(labels, trust)
    known = frozenset(labels.columns)
    header: list[str] = []

    def decode(line: bytes) -> Samples | None:
        text = line.strip()
        if text.startswith(b"{"):
            return from_json(text)
        if not text or len(text) > LIMIT:
            return None
        cells = text.decode("utf-8", "replace").split(",")
        names = [cell.strip().strip('"') for cell in cells]
        if "time" in names:
            header[:] = names
            return None
        if len(cells) != len(header):
            return None
        return _from_cells(dict(zip(header, names, strict=True)), known, trust)

    return decode


def _from_cells(cells: dict[str, str], known: frozenset[str], trust: bool) -> Samples | None:
    time = _cell(cells["time"])
    if not math.isfinite(time):
        return None
    values = {name: _cell(cell) for name, cell in cells.items() if name in known and cell}
    trusted = frozenset(
        name[8:] for name, cell in cells.items()
        if trust and name.startswith("trusted:") and cell == "1"
    )  # fmt: skip
    return Samples(time, values, trusted, {}, True)


def _cell(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
