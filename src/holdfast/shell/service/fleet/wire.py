"""Messages of many plants as bytes: a batch of samples in, a batch of estimates out.

Little endian, array after array, so that a message is read without looking at any plant alone.

Samples: ``HFF1``; u16 columns; u16 0; u32 plants; u32 0; f64 time; then for the plants u64 id;
f64 values, plant by plant its columns (inputs, then outputs, in the plant's order); u8 marks,
the same: 0 did not arrive, 1 arrived, 3 arrived and authenticated (only the broker's word:
believed where the source says ``trust = true``).

Estimates: ``HFE1``; u16 states; u16 attack channels; u32 plants; u32 0; f64 0; then, each for all
plants, u64 id; u64 frame; f64 time; f64 states; f64 their standard deviations; f64 attack; f64 its
standard deviations; f64 statistic; f64 threshold; u32 status; u8 alarm; u8 reason. NaN is what is
not known.
"""

import math
import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from holdfast.shell.service.records import Labels

SAMPLES, ESTIMATES = b"HFF1", b"HFE1"
LIMIT = 16 * 2**20
"""Bytes of a message; longer ones are not read."""
_HEAD = struct.Struct("<4sHHIId")


class Batch(NamedTuple):
    """Samples of many plants at one time; ``values``, ``seen``, ``trusted``: plant by column."""

    time: float
    ids: np.ndarray
    values: np.ndarray
    seen: np.ndarray
    trusted: np.ndarray


class Told(NamedTuple):
    """What became of plants in a frame, each array plant by plant."""

    ids: np.ndarray
    frame: np.ndarray
    time: np.ndarray
    x: np.ndarray
    x_sd: np.ndarray
    d: np.ndarray
    d_sd: np.ndarray
    statistic: np.ndarray
    threshold: np.ndarray
    status: np.ndarray
    alarm: np.ndarray
    reason: np.ndarray


_TYPES = ("<u8", "<u8", "<f8", "<f8", "<f8", "<f8", "<f8", "<f8", "<f8", "<u4", "u1", "u1")


def batch_decoder(labels: Labels, trust: bool = False) -> Callable[[bytes], Batch | None]:
    """Of batches of samples; None for what is none."""
    columns = len(labels.columns)
    inputs = len(labels.inputs)

    def decode(message: bytes) -> Batch | None:
        if not _HEAD.size <= len(message) <= LIMIT:
            return None
        magic, found, _, plants, _, time = _HEAD.unpack_from(message)
        size = _HEAD.size + plants * (8 + 9 * columns)
        if magic != SAMPLES or found != columns or size != len(message) or not math.isfinite(time):
            return None
        ids, values, marks = _split(
            message, [("<u8", (plants,)), ("<f8", (plants, columns)), ("u1", (plants, columns))]
        )
        trusted = (marks[:, inputs:] & 3 == 3) & trust
        return Batch(time, ids, values, marks & 1 != 0, trusted)

    return decode


def batch_frame(batch: Batch) -> bytes:
    """The message of a batch: what a gateway writes."""
    plants, columns = batch.values.shape
    marks = batch.seen.astype("u1")
    outputs = batch.trusted.shape[1]
    believed = batch.trusted & batch.seen[:, columns - outputs :]
    marks[:, columns - outputs :] |= believed.astype("u1") << 1
    head = _HEAD.pack(SAMPLES, columns, 0, plants, 0, batch.time)
    parts = batch.ids.astype("<u8"), batch.values.astype("<f8"), marks
    return b"".join([head, *(np.ascontiguousarray(part).tobytes() for part in parts)])


def estimates_frame(told: Told) -> bytes:
    """The message of a frame's estimates."""
    head = _HEAD.pack(
        ESTIMATES, told.x.shape[1], told.d.shape[1], len(told.ids), 0, 0.0
    )  # fmt: skip
    parts = (a.astype(kind) for a, kind in zip(told, _TYPES, strict=True))
    return b"".join([head, *(np.ascontiguousarray(part).tobytes() for part in parts)])


def read_estimates(message: bytes) -> Told:
    """What `estimates_frame` wrote. Raises `ValueError` for anything else."""
    if len(message) < _HEAD.size:
        raise ValueError("no batch of estimates: too short")
    magic, n, nd, plants, _, _ = _HEAD.unpack_from(message)
    wide = {3: n, 4: n, 5: nd, 6: nd}
    shapes = [(plants, wide[i]) if i in wide else (plants,) for i in range(len(_TYPES))]
    layout = list(zip(_TYPES, shapes, strict=True))
    size = _HEAD.size + sum(np.dtype(kind).itemsize * math.prod(shape) for kind, shape in layout)
    if magic != ESTIMATES or size != len(message):
        raise ValueError("no batch of estimates: another beginning or length")
    return Told(*_split(message, layout))


def _split(message: bytes, layout: Sequence[tuple[str, tuple[int, ...]]]) -> list[np.ndarray]:
    found, at = [], _HEAD.size
    for kind, shape in layout:
        count = math.prod(shape)
        found.append(np.frombuffer(message, kind, count, at).reshape(shape))
        at += count * np.dtype(kind).itemsize
    return found
