"""Files that are either written whole or not at all."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from holdfast.shell.errors import InputError

FILES = (".csv", ".nc")
"""Endings of a result in one file; any other name is a folder for a report."""


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path in the same folder; it takes the name of ``path`` if all goes well.

    On any failure it is removed and ``path`` is left as it was.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        raise InputError(path, "", _kind_of(path), "the name of a file to write")
    try:
        handle, name = tempfile.mkstemp(
            prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent
        )
    except OSError as error:
        raise unwritable(path, error) from None
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        raise unwritable(path, error) from None
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing_folder(path: str | Path) -> Iterator[Path]:
    """A temporary folder beside ``path``; it takes that name, as a whole, if all goes well.

    On any failure it is removed and ``path`` is left as it was. What an earlier one that was
    killed has left is removed first.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_dir():
        raise InputError(path, "", _kind_of(path), "the name of a folder to write")
    beginning = f".{path.name}."
    try:
        for left in path.parent.iterdir():
            if left.name.startswith(beginning) and left.is_dir():
                shutil.rmtree(left)
        place = Path(tempfile.mkdtemp(prefix=beginning, dir=path.parent))
        temporary, old = place / "new", place / "old"
        temporary.mkdir()
    except OSError as error:
        raise unwritable(path, error) from None
    try:
        yield temporary
        if path.exists():  # a folder can take the place of an empty one only
            os.replace(path, old)
        os.replace(temporary, path)
    except OSError as error:
        raise unwritable(path, error) from None
    finally:
        if old.exists() and not path.exists():
            os.replace(old, path)
        shutil.rmtree(place, ignore_errors=True)


def write_text(path: str | Path, text: str) -> None:
    """The text, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


def write_figures(folder: str | Path, figures: dict[str, Any]) -> None:
    """Figures by name as PNG files in a folder, which is made where there is none."""
    from holdfast.report.paper_figures import png

    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(folder, error) from None
    for name, figure in figures.items():
        with replacing(Path(folder) / f"{name}.png") as temporary:
            temporary.write_bytes(png(figure))


def check_place(path: str | Path) -> None:
    """Whether something can be written there, asked before the work that leads to it."""
    path = Path(os.path.realpath(path))
    names_file = path.suffix.lower() in FILES
    if path.exists():
        if names_file and not path.is_file():
            raise InputError(path, "", _kind_of(path), "the name of a file to write")
        if not names_file and not path.is_dir():
            expected = "a folder for the report, or a name ending in .csv or .nc"
            raise InputError(path, "", _kind_of(path), expected)
    elif names_file and not path.parent.is_dir():
        raise InputError(path, "", f"no folder {path.parent}", "a place that can be written")
    place = path if path.is_dir() else path.parent
    while not place.exists():
        place = place.parent
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        raise InputError(path, "", f"no permission to write in {place}", "another place")


def _kind_of(path: Path) -> str:
    if path.is_dir():
        return "a folder"
    return "a file" if path.is_file() else "a device or a pipe"


def unwritable(path: str | Path, error: OSError) -> InputError:
    """The system's refusal to write as our error."""
    return InputError(path, "", error.strerror or str(error), "a place that can be written")


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
