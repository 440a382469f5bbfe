"""Results: one row per step, as CSV (exact floats) or NetCDF (with full covariances)."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from holdfast.parts import Plant
from holdfast.records import Reason, Status, Trace
from holdfast.shell.writing import replacing, write_text

BLOCK = 20_000
"""Rows that are turned into text at a time."""


def write_result(path: str | Path, trace: Trace, plant: Plant, time: np.ndarray) -> None:
    """The result in a file: NetCDF for `.nc`, else CSV; written whole or not at all."""
    if Path(path).suffix.lower() != ".nc":
        write_text(path, "".join(csv_blocks(trace, plant, time)))
        return
    from holdfast.report.tables import dataset

    with replacing(path) as temporary:
        dataset(trace, plant, time).to_netcdf(temporary, engine="h5netcdf")


def csv_blocks(trace: Trace, plant: Plant, time: np.ndarray) -> Iterator[str]:
    """The lines of the CSV result, header first, some thousand at a time.

    Floats are written so that reading them gives the same number. Empty: the state while
    NOT_READY, an attack channel that cannot be identified, statistic and threshold where
    there was nothing to test.
    """
    columns = _columns(trace, plant, np.asarray(time, float))
    yield ",".join(_quoted(name) for name in columns) + "\n"
    for start in range(0, len(time), BLOCK):
        rows = slice(start, start + BLOCK)
        texts = (_texts(values[rows], empty[rows]) for values, empty in columns.values())
        yield "\n".join(map(",".join, zip(*texts, strict=True))) + "\n"


Column = tuple[np.ndarray, np.ndarray]
"""The values of a column, and where its cells are empty."""


def _columns(trace: Trace, plant: Plant, time: np.ndarray) -> dict[str, Column]:
    estimate: Any = jax.tree.map(np.asarray, trace.estimate)
    verdict: Any = jax.tree.map(np.asarray, trace.verdict)
    never = np.zeros(len(time), bool)
    not_ready = (estimate.status & int(Status.NOT_READY)) != 0
    untested = ~np.isfinite(verdict.threshold)
    columns: dict[str, Column] = {"time": (time, never)}
    x_sd = _sd(estimate.x_cov)
    _add(columns, "x", plant.states, estimate.x, np.broadcast_to(not_ready[:, None], x_sd.shape))
    _add(columns, "x_sd", plant.states, x_sd, np.broadcast_to(not_ready[:, None], x_sd.shape))
    d_sd = _sd(estimate.d_cov)
    # without columns where the estimator estimates no attack
    channels = plant.attacks[: d_sd.shape[1]]
    _add(columns, "d", channels, estimate.d, np.isinf(d_sd))
    _add(columns, "d_sd", channels, d_sd, np.isinf(d_sd))
    if estimate.a is not None:
        _add(columns, "a", plant.outputs, estimate.a, np.zeros(estimate.a.shape, bool))
    columns["statistic"] = (verdict.statistic, untested)
    columns["threshold"] = (verdict.threshold, untested)
    columns["alarm"] = (verdict.alarm.astype(int), never)
    flags = verdict.channel_alarms
    names: Sequence[str] = ()
    if flags.shape[1]:
        from holdfast.report.tables import channel_names

        names = channel_names(trace, plant)
        _add(columns, "alarm", names, flags.astype(int), np.zeros(flags.shape, bool))
    columns["reason"] = (_reasons(verdict.reason, flags, names), never)
    if estimate.mode is not None:
        columns["mode"] = (_words(estimate.mode, lambda i: _quoted(trace.named[i])), never)
    if estimate.p is not None:
        _add(columns, "p", trace.modes, estimate.p, np.zeros(estimate.p.shape, bool))
    columns["status"] = (_words(estimate.status, lambda code: Status(code).words), never)
    return columns


def _add(columns: dict[str, Column], prefix: str, names, values, empty) -> None:
    for j, name in enumerate(names):
        columns[f"{prefix}:{name}"] = (values[:, j], empty[:, j])


def _sd(cov: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0))


def _reasons(codes: np.ndarray, flags: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """The reasons in words, with the channels that a localising detector points at."""
    words = _words(codes, lambda code: Reason(code).words).astype(object)
    on_channel = np.isin(codes, (Reason.ATTACK_CHANNEL, Reason.RESIDUAL_CHANNEL))
    for row in np.flatnonzero(on_channel):
        pointed = "+".join(name for name, flag in zip(names, flags[row], strict=True) if flag)
        words[row] = _quoted(f"{words[row]} {pointed}")
    return words


def _words(codes: np.ndarray, of: Callable[[int], str]) -> np.ndarray:
    kinds, which = np.unique(codes, return_inverse=True)
    return np.array([of(int(kind)) for kind in kinds], object)[which]


def _texts(values: np.ndarray, empty: np.ndarray) -> list[str]:
    # words come quoted; repr of a float is the shortest text that reads back as the same
    cells = values.tolist() if values.dtype == object else list(map(repr, values.tolist()))
    for row in np.flatnonzero(empty):
        cells[row] = ""
    return cells


def _quoted(text: str) -> str:
    if not any(c in text for c in ',"\r\n'):
        return text
    return '"' + text.replace('"', '""') + '"'
