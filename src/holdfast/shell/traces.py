"""The full records of the first runs of every point of a study, as a Zarr store."""

import hashlib
import importlib
import json
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import xarray as xr
from jaxtyping import PRNGKeyArray

from holdfast import __version__
from holdfast.campaign.blocks import Case, single
from holdfast.campaign.choice import structure_of
from holdfast.parts import Plant
from holdfast.records import Trace
from holdfast.shell.block_files import BlockFiles
from holdfast.shell.errors import InputError
from holdfast.shell.points import Prepared
from holdfast.shell.reading import size_in_words
from holdfast.shell.study import Study
from holdfast.shell.writing import replacing_folder

STORE = "traces.zarr"
KEY = "study.traces"
MOST = 4 * 2**30
"""Bytes that the records of a study may take before they are compressed; those of a point are
held in memory together."""
CHUNK = 4 * 2**20
"""Bytes that are compressed together: whole runs of a variable where they fit, else rows."""
SMALL = 3 * 4096
"""Bytes that the files of the smallest variable take on a disk."""
FORMAT = 2
"""Of Zarr: format 3 specifies neither consolidated metadata nor text of fixed width."""
TIME = {"long_name": "time in s"}
SD = ("x_sd", "d_sd")
"""Variables that are the root of the diagonal of a covariance."""
TEXTS = {
    "true_x": "true state",
    "u": "commanded input over the interval that ends at the row",
    "y": "measurement",
    "seen": "sample arrived",
    "trusted": "sample was authenticated",
    "x": "state estimate",
    "x_sd": "standard deviation of x; inf = not determined",
    "d": "attack estimate",
    "d_sd": "standard deviation of d; inf = not determined",
    "p": "probability of each mode of the bank",
    "mode": "the mode believed in: a number of named",
    "statistic": "detector's statistic",
    "threshold": "alarm above it; inf = nothing to test",
    "alarm": "alarm",
    "status": "what happened at the row; 0 = OK",
    "injected_u": "injected into the actuators at the row",
    "injected_y": "injected into the sensors at the row",
    "injected_d": "injected into the channels at the row",
    "injected_switch": "where the switches stand after the row: a number of position",
}

Fields = dict[str, tuple[tuple[str, ...], Any]]
"""Dimensions and values (or their shapes) of every variable of a run by its name."""


def check_wanted(study: Study, output: str | Path | None) -> None:
    """Whether the records that a study asks for could be written, before anything is run.

    Raises `InputError` without a folder and without the package zarr.
    """
    if not study.settings.traces:
        return
    if output is None:
        raise InputError(
            study.path, KEY, f"{study.settings.traces} and no folder",
            "a folder to write them to (-o FOLDER), or 0",
        )  # fmt: skip
    try:
        importlib.import_module("zarr")
    except ImportError:
        raise InputError(study.path, KEY, "no zarr", 'pip install "holdfast[zarr]"') from None


def store_bytes(prepared: Prepared) -> int:
    """Bytes of all records that the study asks for, not compressed. `InputError` over `MOST`."""
    study = prepared.study
    runs, known, total = study.settings.traces, {}, 0
    if not runs:
        return 0
    for case in prepared.cases:
        kind = structure_of(case)
        if kind not in known:
            record: Any = eqx.filter_eval_shape(single, case, jax.random.key(0), 0)
            fields = _fields(record, case.scenario.plant)
            known[kind] = sum(max(runs * _bytes(n, v), SMALL) for n, (_, v) in fields.items())
        total += known[kind]
    if total > MOST:
        raise InputError(
            study.path, KEY, f"records of {size_in_words(total)}",
            f"fewer traces, points or steps: {size_in_words(MOST)} at most",
        )  # fmt: skip
    return total


def write_traces(
    files: BlockFiles, prepared: Prepared, advance: Callable[[], None] = lambda: None
) -> None:
    """The records that the study asks for, whole or not at all; what is there is kept.

    A group for every point, called by its number from 0, with the labels of the point as
    attributes; the manifest has the checksum of the store. Run i of a point is `single` of i.
    A store that is damaged, or of other points or another number of runs, is made again.

    Raises `InputError` where it cannot be written.
    """
    wanted, path = _wanted(prepared), files.folder / STORE
    if not wanted["runs"] or _kept(files, wanted):
        return
    points = list(zip(prepared.study.points, prepared.cases, prepared.keys, strict=True))
    with replacing_folder(path) as temporary:
        for number, (point, case, key) in enumerate(points):
            found = _records(case, key, wanted["runs"], advance)
            found.attrs = {k: _plain(v) for k, v in prepared.study.labels_of(point).items()}
            _put(found, temporary, str(number))
        # once for all groups: who opens one then reads a single file first
        whole = xr.Dataset(attrs={"holdfast": __version__, "points": len(points)})
        whole.to_zarr(temporary, mode="a", zarr_format=FORMAT, consolidated=True)
        checksum = _checksum(temporary)
    files.traces = wanted | {"checksum": checksum}
    files.write_manifest()


def _wanted(prepared: Prepared) -> dict[str, Any]:
    """What decides the content of a store beside what the manifest has to agree on anyway."""
    study = prepared.study
    named = [[study.name_of(point), study.labels_of(point)] for point in study.points]
    digest = hashlib.sha256(json.dumps(named, sort_keys=True).encode()).hexdigest()[:16]
    return {"store": STORE, "runs": study.settings.traces, "points": digest}


def _kept(files: BlockFiles, wanted: dict[str, Any]) -> bool:
    """Whether the store is there, finished, undamaged, and of these points and runs."""
    path, made = files.folder / STORE, files.traces
    if made is None or not path.is_dir() or {k: made.get(k) for k in wanted} != wanted:
        return False
    if made.get("checksum") == _checksum(path):
        return True
    warnings.warn(f"{path}: damaged; it is made again", stacklevel=2)
    return False


def _checksum(folder: Path) -> str:
    """Of the names and contents of all files of a folder."""
    found = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        found.update(f"{path.relative_to(folder).as_posix()} {content}\n".encode())
    return found.hexdigest()[:16]


def _records(case: Case, key: PRNGKeyArray, runs: int, advance: Callable[[], None]) -> xr.Dataset:
    """The first runs of a point with dimensions (run, time) and, of vectors, what is named.

    Values are those of the record, as they are: `holdfast.records` says what infinite standard
    deviations and thresholds mean.
    """
    plant, data, trace = case.scenario.plant, {}, None
    for run in range(runs):
        # one by one: in a batch some estimators call LAPACK side by side, which can wait for
        # itself on a CPU
        trace = single(case, key, run)
        for name, (dims, value) in _fields(trace, plant).items():
            row = _values(name, value)
            if name not in data:
                data[name] = dims, np.empty((runs, *row.shape), row.dtype)
            data[name][1][run] = row
        advance()
    assert trace is not None
    time = plant.dt * np.arange(1, case.steps + 1)
    coords: dict[str, Any] = {"run": np.arange(runs), "time": ("time", time, TIME)}
    coords |= {kind: np.array(names) for kind, names in _names(trace, plant).items() if names}
    variables = {
        name: (("run", *dims), values, {"long_name": TEXTS[name]})
        for name, (dims, values) in data.items()
    }
    return xr.Dataset(variables, coords)


def _fields(trace: Trace, plant: Plant) -> Fields:
    """The variables of a run; those of vectors without entries are left out."""
    seen_by, estimate, verdict, injection = (
        trace.observation, trace.estimate, trace.verdict, trace.injection,
    )  # fmt: skip
    assert injection is not None
    found = {
        "true_x": ("state", trace.x),
        "u": ("input", seen_by.u),
        "y": ("output", seen_by.y),
        "seen": ("output", seen_by.seen),
        "trusted": ("output", seen_by.trusted),
        "x": ("state", estimate.x),
        "x_sd": ("state", estimate.x_cov),
        "d": ("attack", estimate.d),
        "d_sd": ("attack", estimate.d_cov),
        "p": ("bank", estimate.p),
        "mode": ("", estimate.mode),
        "statistic": ("", verdict.statistic),
        "threshold": ("", verdict.threshold),
        "alarm": ("", verdict.alarm),
        "status": ("", estimate.status),
        "injected_u": ("input", injection.u),
        "injected_y": ("output", injection.y),
        "injected_d": ("attack", injection.d),
        "injected_switch": ("", injection.switch),
    }
    return {
        name: (("time", kind) if kind else ("time",), value)
        for name, (kind, value) in found.items()
        if value is not None and value.shape[-1]
    }


def _names(trace: Trace, plant: Plant) -> dict[str, tuple[str, ...]]:
    """The names along every dimension, and those that numbers in variables stand for."""
    found = {"state": plant.states, "input": plant.inputs, "output": plant.outputs}
    found |= {"attack": plant.attacks, "bank": trace.modes, "named": trace.named}
    switched = trace.injection is not None and trace.injection.switch is not None
    return found | ({"position": plant.positions} if switched else {})


def _bytes(name: str, value: Any) -> int:
    shape = value.shape[:-1] if name in SD else value.shape
    return math.prod(shape) * np.dtype(value.dtype).itemsize


def _values(name: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if name in SD:
        return np.sqrt(np.maximum(np.diagonal(array, axis1=-2, axis2=-1), 0.0))
    return array


def _plain(label: str | float) -> str | float:
    """A label that JSON can hold."""
    return label if isinstance(label, str) or math.isfinite(label) else str(label)


def _put(found: xr.Dataset, store: Path, group: str) -> None:
    encoding = {}
    for name, variable in found.data_vars.items():
        rest, size = variable.shape[2:], variable.dtype.itemsize
        row = size * math.prod(rest)
        rows = min(variable.shape[1], max(1, CHUNK // row))
        runs = min(variable.shape[0], max(1, CHUNK // (row * rows)))
        encoding[name] = {"chunks": (runs, rows, *rest)}
    found.to_zarr(
        store, group=group, mode="w", zarr_format=FORMAT, consolidated=False, encoding=encoding
    )
