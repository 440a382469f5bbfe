"""Bytes from files and from standard input, within limits."""

import io
import os
import stat
import sys
from pathlib import Path
from typing import BinaryIO

from holdfast.shell.errors import InputError

STANDARD_INPUT = "-"
SCENARIO_LIMIT = 16 * 2**20
"""Bytes of a scenario. Matrices that do not fit belong in files of their own."""
DATA_LIMIT = 4 * 2**30
"""Bytes of a log or a matrix file."""


def read_bytes(path: str | Path, limit: int, what: str) -> bytes:
    """The whole file, its size checked before it is read (``-`` is standard input)."""
    if str(path) == STANDARD_INPUT:
        return _read_at_most(sys.stdin.buffer, "standard input", limit, what)
    try:
        size = check_file(path, limit, what)
        with open(path, "rb") as file:
            return file.read() if size is not None else _read_at_most(file, path, limit, what)
    except OSError as error:
        raise InputError(
            path, "", error.strerror or str(error), f"{what} that can be read"
        ) from None


def check_file(path: str | Path, limit: int, what: str) -> int | None:
    """The size of a regular file within the limit; None for a pipe, whose size is unknown."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        raise InputError(path, "", "no such file", what) from None
    except (OSError, ValueError) as error:
        raise InputError(path, "", str(error), f"{what} that can be read") from None
    if stat.S_ISDIR(status.st_mode):
        raise InputError(path, "", "a folder", f"a file: {what}")
    if not stat.S_ISREG(status.st_mode):
        return None
    if status.st_size == 0:
        raise InputError(path, "", "an empty file", what)
    if status.st_size > limit:
        raise InputError(path, "", size_in_words(status.st_size), _at_most(limit, what))
    return status.st_size


def _read_at_most(
    file: io.BufferedIOBase | BinaryIO, name: str | Path, limit: int, what: str
) -> bytes:
    content = file.read(limit + 1)
    if len(content) > limit:
        raise InputError(name, "", f"more than {size_in_words(limit)}", _at_most(limit, what))
    if not content:
        raise InputError(name, "", "nothing in it", what)
    return content


def _at_most(limit: int, what: str) -> str:
    return f"{what} of at most {size_in_words(limit)}"


def size_in_words(size: float) -> str:
    """Bytes as a person reads them."""
    for unit in ("bytes", "KiB", "MiB"):
        if size < 1024:
            return f"{size:.3g} {unit}"
        size = size / 1024
    return f"{size:.3g} GiB"


def decode(content: bytes, path: str | Path, what: str) -> str:
    """The text of a UTF-8 file, with or without a byte order mark."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, "", f"bytes that are not text (at {error.start})", what) from None
    if "\0" in text:
        raise InputError(path, "", f"binary data (at {text.index(chr(0))})", what)
    return text
