"""Recorded logs: CSV, .npz and .nc, checked and put on the plant's time grid.

CSV: a header, then one row per sample. `time` (s), `u:NAME`, `y:NAME`, optional
`trusted:NAME` (0/1). Columns without a colon, and those of a result (`x:NAME`, ...), are
ignored; any other prefix or name is an error, because it is most likely misspelt.

.npz: one-dimensional arrays of equal length under the same names. An array has no empty
cells, so `seen:NAME` and `sent:NAME` (0/1) mark the samples of `y:NAME` and `u:NAME` that
arrived; without them all did, and a NaN is a fault.

.nc: variables `u` (time, input), `y` (time, output), optional `sample` (time, output; 0
used, 1 did not arrive, 2 and 3 were faulty) and `trusted` (time, output), the names in
the coordinates. That is what `-o OUT.nc` writes, so a result is again a log.
"""

import csv
import io
import math
from pathlib import Path

import numpy as np

from holdfast.parts import Plant
from holdfast.shell.columns import Column, Columns, assembled, columns_of
from holdfast.shell.errors import InputError, shown
from holdfast.shell.grid import Log, on_grid
from holdfast.shell.log_arrays import from_netcdf, from_npz
from holdfast.shell.reading import DATA_LIMIT, decode, read_bytes

__all__ = ["Log", "read_log"]

WHAT = "a log: a header, then rows of numbers"


def read_log(path: str | Path, plant: Plant) -> Log:
    """The log of this plant in a file, by its ending (CSV for any other; ``-`` for stdin).

    A `.ulg` or a folder is a PX4 flight. Raises `InputError` naming the file, the row and the
    column.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".ulg" or (suffix != ".nc" and Path(path).is_dir()):
        from holdfast.shell.uav import read_flight

        return read_flight(path, plant).log
    readers = {".npz": from_npz, ".nc": from_netcdf}
    columns = readers.get(suffix, _from_csv)(path, plant)
    return on_grid(path, columns, plant.dt)


def _from_csv(path: str | Path, plant: Plant) -> Columns:
    text = decode(read_bytes(path, DATA_LIMIT, WHAT), path, WHAT)
    try:
        header, *rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    except ValueError:
        raise InputError(path, "", "no header", WHAT) from None
    except csv.Error as error:
        raise InputError(path, "", f"no CSV ({error})", WHAT) from None
    while rows and not rows[-1]:
        rows.pop()
    if not rows:
        raise InputError(path, "", "no rows after the header", WHAT)
    header = [name.strip() for name in header]
    where = columns_of(path, header, plant)
    for i, row in enumerate(rows, 1):
        if len(row) != len(header):
            raise InputError(
                path, f"row {i}", f"{len(row)} cells", f"{len(header)} as in the header"
            )
    cells = list(zip(*rows, strict=True))
    underscored = "_" in text[text.index("\n") :]

    def numbers(name: str) -> Column:
        return _numbers(path, name, cells[where[name]], underscored)

    return assembled(path, plant, where, numbers)


def _numbers(path: str | Path, name: str, cells: tuple[str, ...], careful: bool) -> Column:
    """One column of text as numbers, and which cells were not empty."""
    nan = math.nan
    try:
        values = np.array([float(cell) if cell else nan for cell in cells])
        given = np.array([cell != "" for cell in cells])
        # Python reads 1_000 as a number, and nobody writes that into a log
        if not (careful and any("_" in cell for cell in cells)):
            return values, given
    except ValueError:
        pass
    stripped = [cell.strip() for cell in cells]
    for i, cell in enumerate(stripped, 1):
        if cell and not _is_number(cell):
            raise InputError(
                path, f"row {i}, column {name!r}", shown(cell), "a number, or nothing for a gap"
            )
    values = np.array([float(cell) if cell else nan for cell in stripped])
    return values, np.array([cell != "" for cell in stripped])


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell
