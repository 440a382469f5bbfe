"""Matrices of a scenario: inline, ``{ file, name }`` or ``{ grid, values }``."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from holdfast.shell.errors import InputError, one_of, shown
from holdfast.shell.reading import DATA_LIMIT, decode, read_bytes

WHAT = "a .mat, .npz or .csv file of numbers"


def matrix(value: Any, file: str, key: str, folder: Path) -> Any:
    """An array of floats, or a `Table` for ``{ grid, values }``.

    A number, a list, a list of lists and so on, or a reference relative to ``folder``.
    Raises `InputError` naming ``file`` and ``key``.
    """
    if isinstance(value, dict):
        if "grid" in value or "values" in value:
            return _table(value, file, key, folder)
        return _from_file(value, file, key, folder)
    return _inline(value, file, key)


def _table(value: dict[str, Any], file: str, key: str, folder: Path) -> Any:
    from holdfast.plants.linear import Table

    _check_keys(value, {"grid", "values"}, {"grid", "values"}, file, key)
    import jax.numpy as jnp

    grid, values = (matrix(value[k], file, f"{key}.{k}", folder) for k in ("grid", "values"))
    for part, array in (("grid", grid), ("values", values)):
        if not isinstance(array, np.ndarray):
            raise InputError(file, f"{key}.{part}", "a table in a table", "numbers")
    return Table(jnp.asarray(grid), jnp.asarray(values))


def _from_file(value: dict[str, Any], file: str, key: str, folder: Path) -> np.ndarray:
    _check_keys(value, {"file"}, {"file", "name"}, file, key)
    for part, text in value.items():
        if not isinstance(text, str):
            raise InputError(file, f"{key}.{part}", shown(text), "text in quotes")
    path = folder / value["file"]
    name, suffix = value.get("name"), path.suffix.lower()
    if suffix == ".csv":
        if name is not None:
            raise InputError(file, f"{key}.name", shown(name), "none: a CSV holds one matrix")
        return _csv(path)
    if suffix not in (".mat", ".npz"):
        raise InputError(file, f"{key}.file", shown(value["file"]), WHAT)
    if name is None:
        raise InputError(file, f"{key}.name", "nothing", f"which matrix of {path.name} to take")
    return _array(_stored(path, suffix, name), path, name)


def _check_keys(value: dict, needed: set, allowed: set, file: str, key: str) -> None:
    for name in value:
        if name not in allowed:
            raise InputError(file, f"{key}.{name}", "an unknown key", one_of(sorted(allowed), name))
    for name in sorted(needed - value.keys()):
        raise InputError(file, f"{key}.{name}", "nothing", f"the key {name!r}")


def _inline(value: Any, file: str, key: str) -> np.ndarray:
    if not isinstance(value, list):
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(
                file, key, shown(value), "a matrix: rows of numbers, or { file = .., name = .. }"
            )
        return np.asarray(float(value))
    rows = [_inline(row, file, f"{key}[{i}]") for i, row in enumerate(value, 1)]
    shapes = [row.shape for row in rows]
    for i, shape in enumerate(shapes, 1):
        if shape != shapes[0]:
            raise InputError(
                file,
                f"{key}[{i}]",
                f"{shape[0] if shape else 'no'} numbers",
                f"{shapes[0][0] if shapes[0] else 'no'} as in row 1",
            )
    return np.asarray(rows, float) if rows else np.zeros(0)


def _csv(path: Path) -> np.ndarray:
    text = decode(read_bytes(path, DATA_LIMIT, WHAT), path, WHAT)
    rows = [line.split(",") for line in text.splitlines() if line.strip()]
    found = []
    for i, row in enumerate(rows, 1):
        if len(row) != len(rows[0]):
            raise InputError(path, f"row {i}", f"{len(row)} numbers", f"{len(rows[0])} as in row 1")
        try:
            found.append([float(cell) for cell in row])
        except ValueError:
            bad = next(j for j, cell in enumerate(row, 1) if not _is_number(cell))
            raise InputError(
                path, f"row {i}, column {bad}", shown(row[bad - 1]), "a number (and no header)"
            ) from None
    if not found:
        raise InputError(path, "", "no numbers", WHAT)
    return np.asarray(found)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _stored(path: Path, suffix: str, name: str) -> Any:
    content = io.BytesIO(read_bytes(path, DATA_LIMIT, WHAT))
    # the parsers of binary formats fail on damaged files in ways that no list covers
    try:
        if suffix == ".npz":
            if not zipfile.is_zipfile(content):
                raise ValueError("not an .npz archive")
            with np.load(content, allow_pickle=False) as archive:
                names = list(archive.files)
                found = archive[name] if name in names else None
        else:
            import scipy.io

            names = [entry[0] for entry in scipy.io.whosmat(content)]
            content.seek(0)
            found = scipy.io.loadmat(content, variable_names=[name]).get(name)
    except NotImplementedError:
        raise InputError(path, "", "MATLAB's version 7.3 format", "save(.., '-v7')") from None
    except Exception as error:
        raise InputError(path, "", f"damaged content ({error})", WHAT) from None
    if found is None:
        raise InputError(path, "", f"no matrix {name!r}", one_of(names, name))
    return found


def _array(found: Any, path: Path, name: str) -> np.ndarray:
    if hasattr(found, "toarray"):
        found = found.toarray()
    found = np.asarray(found)
    if found.dtype.kind not in "fiub":
        raise InputError(path, name, f"values of type {found.dtype}", "real numbers")
    return found.astype(float)
