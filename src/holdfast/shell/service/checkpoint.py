"""Where the service was: state, counters and the positions of its sources, in one file.

    holdfast checkpoint 1 SHA256-OF-THE-REST
    {"scenario": SHA256 of what the state belongs to, ...}      one line of JSON
    an .npz archive of plain arrays

Nothing in it is unpickled. It is written under a temporary name, synced and renamed, so that a
power cut leaves the one before.
"""

import hashlib
import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from holdfast.shell.errors import InputError
from holdfast.shell.reading import read_bytes
from holdfast.shell.writing import replacing

MAGIC = b"holdfast checkpoint 1 "
LIMIT = 2**30
WHAT = "a checkpoint of the live service"


def digest(*parts: str) -> str:
    """What a state belongs to, as one number."""
    found = hashlib.sha256()
    for part in parts:
        found.update(len(part).to_bytes(8, "big") + part.encode())
    return found.hexdigest()


def write_checkpoint(
    path: Path, owner: str, words: dict[str, Any], arrays: dict[str, np.ndarray]
) -> None:
    """Replace the checkpoint by this state of ``owner``. Raises `InputError`."""
    archive = io.BytesIO()
    np.savez(archive, allow_pickle=False, **arrays)  # pyright: ignore[reportArgumentType]
    head = json.dumps({"scenario": owner, **words}).encode()
    rest = head + b"\n" + archive.getvalue()
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(MAGIC + hashlib.sha256(rest).hexdigest().encode() + b"\n" + rest)
        file.flush()
        os.fsync(file.fileno())
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def checkpoint_words(path: Path) -> dict[str, Any] | None:
    """The words of a checkpoint without its arrays, unchecked; None if there is none."""
    try:
        with path.open("rb") as file:
            file.readline()
            found = json.loads(file.readline(LIMIT))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def read_checkpoint(path: Path, owner: str) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
    """The state that was written last, None if there is none yet.

    Raises `InputError` for a file that is damaged or not a checkpoint, and for the state of
    another scenario.
    """
    if not path.exists():
        return None
    content = read_bytes(path, LIMIT, WHAT)
    first, _, rest = content.partition(b"\n")
    if not first.startswith(MAGIC):
        raise InputError(path, "", "something else", f"{WHAT} (remove the file to start anew)")
    if hashlib.sha256(rest).hexdigest().encode() != first[len(MAGIC) :]:
        raise InputError(path, "", "a damaged file", f"{WHAT} (remove the file to start anew)")
    head, _, archive = rest.partition(b"\n")
    words = json.loads(head)
    if words["scenario"] != owner:
        raise InputError(
            path, "scenario", "the state of another scenario or of other settings",
            "that of this one: remove the file to start anew, or name another",
        )  # fmt: skip
    with np.load(io.BytesIO(archive), allow_pickle=False) as loaded:
        arrays = {name: loaded[name] for name in loaded.files}
    return words, arrays
