"""Logs that are stored as arrays: .npz and .nc (layouts: `holdfast.shell.logs`)."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from holdfast.parts import Plant
from holdfast.shell.columns import Column, Columns, assembled, columns_of, flags
from holdfast.shell.errors import InputError, one_of
from holdfast.shell.reading import DATA_LIMIT, check_file, read_bytes

WHAT = "a log as arrays of numbers"


def from_npz(path: str | Path, plant: Plant) -> Columns:
    """One array per column, all of one length. Nothing is unpickled."""
    content = io.BytesIO(read_bytes(path, DATA_LIMIT, WHAT))
    # a damaged archive fails in ways that no list covers
    try:
        with np.load(content, allow_pickle=False) as archive:
            arrays = {name: np.asarray(archive[name]) for name in archive.files}
    except Exception as error:
        raise InputError(path, "", f"no readable .npz ({error})", "arrays of numbers") from None
    marks = [f"seen:{n}" for n in plant.outputs] + [f"sent:{n}" for n in plant.inputs]
    where = columns_of(path, list(arrays), plant, marks)
    rows = arrays["time"].shape
    for name in where:
        array = arrays[name]
        if (
            array.shape != rows
            or array.ndim != 1
            or not len(array)
            or array.dtype.kind not in "fiub"
        ):
            raise InputError(
                path,
                f"array {name!r}",
                f"{array.dtype} of shape {array.shape}",
                f"numbers in one dimension, as many as 'time' ({rows})",
            )

    def numbers(name: str) -> Column:
        values = arrays[name].astype(float)
        flag = name.replace("y:", "seen:", 1) if name[0] == "y" else name.replace("u:", "sent:", 1)
        given = np.ones(len(values), bool)
        if name[:2] in ("y:", "u:") and flag in where:
            given = flags(path, flag, arrays[flag].astype(float), given)
        return values, given

    return assembled(path, plant, where, numbers)


def from_netcdf(path: str | Path, plant: Plant) -> Columns:
    """Variables with the dimension ``time``, as a result has them."""
    check_file(path, DATA_LIMIT, WHAT)
    # a damaged file fails in ways that no list covers
    try:
        import xarray as xr

        with xr.open_dataset(path, engine="h5netcdf") as dataset:
            data = dataset.load()
    except Exception as error:
        raise InputError(path, "", f"no readable NetCDF ({error})", "a NetCDF-4 file") from None
    if data.sizes.get("run", 1) != 1:
        raise InputError(path, "run", f"{data.sizes['run']} runs", "one: a log is a single run")
    data = data.squeeze("run") if "run" in data.dims else data
    if "time" not in data.variables or data["time"].dims != ("time",) or not data.sizes["time"]:
        raise InputError(path, "time", "no times", "a variable 'time' (time) in seconds")
    sides = {"u": ("input", plant.inputs), "y": ("output", plant.outputs)}
    for name, (axis, wanted) in sides.items():
        if wanted:
            _check_variable(path, data, name, axis, wanted)
    marks = [name for name in ("sample", "trusted") if name in data]
    for name in marks:
        _check_variable(path, data, name, "output", plant.outputs)

    def numbers(column: str) -> Column:
        values, _, name = column.partition(":")
        given = np.ones(data.sizes["time"], bool)
        if not name:
            return np.asarray(data["time"].values, float), given
        if values == "y" and "sample" in marks:
            given = data["sample"].sel(output=name).values != 1
        return np.asarray(data[values].sel({_AXES[values]: name}).values, float), given

    names = [f"trusted:{name}" for name in plant.outputs] if "trusted" in marks else []
    return assembled(path, plant, names, numbers)


_AXES = {"u": "input", "y": "output", "trusted": "output"}


def _check_variable(
    path: str | Path, data: Any, name: str, axis: str, wanted: tuple[str, ...]
) -> None:
    if name not in data:
        raise InputError(path, name, "no such variable", f"{name} (time, {axis})")
    array = data[name]
    if array.dims != ("time", axis) or array.dtype.kind not in "fiub":
        found = f"{array.dtype} ({', '.join(map(str, array.dims))})"
        raise InputError(path, name, found, f"numbers ({', '.join(('time', axis))})")
    names = [str(label) for label in array[axis].values]
    for label in wanted:
        if names.count(label) != 1:
            found = f"{label!r} {names.count(label)} times" if label in names else f"no {label!r}"
            raise InputError(
                path, f"{name}, {axis}", found, f"it once among {one_of(names, label)}"
            )
