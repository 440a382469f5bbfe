"""Recorded topics of PX4: columns by name, from a `.ulg` or from a folder of CSV files."""

import contextlib
import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from holdfast.shell.errors import InputError, shown
from holdfast.shell.reading import DATA_LIMIT, decode, read_bytes

WHAT = "a PX4 flight: a .ulg file or a folder of CSV topics"

Topic = dict[str, np.ndarray]
"""The columns of one topic, by name."""


def read_topics(
    path: str | Path, names: Sequence[str], allow_cut: bool = False
) -> dict[str, Topic]:
    """The columns of these topics: from a `.ulg`, or from CSV files named after the topics.

    In a folder, `vehicle_air_data.csv`, `benign_vehicle_air_data.csv` and
    `log_vehicle_air_data_0.csv` all hold `vehicle_air_data`. ``allow_cut``: take what a
    `.ulg` holds that stops inside a message, as after a crash.

    Raises `InputError` naming the file and the topic.
    """
    if Path(path).is_dir():
        return {name: _csv_topic(Path(path), name) for name in names}
    return _ulog_topics(Path(path), names, allow_cut)


def _csv_topic(folder: Path, name: str) -> Topic:
    pattern = re.compile(rf"(.*_)?{re.escape(name)}(_0)?\.csv")
    found = sorted(file for file in folder.iterdir() if pattern.fullmatch(file.name))
    if len(found) != 1:
        listed = ", ".join(file.name for file in found) or "no such file"
        raise InputError(folder, name, listed, f"one file named *{name}.csv")
    what = f"a CSV file of the topic {name}"
    text = decode(read_bytes(found[0], DATA_LIMIT, what), found[0], what)
    header, *lines = list(csv.reader(io.StringIO(text, newline="")))
    values = np.empty((len(lines), len(header)))
    for i, line in enumerate(lines):
        if len(line) != len(header):
            raise InputError(
                found[0], f"row {i + 2}", f"{len(line)} cells", f"{len(header)} as in the header"
            )
        for j, cell in enumerate(line):
            try:
                values[i, j] = float(cell)
            except ValueError:
                key = f"row {i + 2}, column {header[j]}"
                raise InputError(found[0], key, shown(cell), "a number") from None
    return {column.strip(): values[:, j] for j, column in enumerate(header)}


def _ulog_topics(path: Path, names: Sequence[str], allow_cut: bool) -> dict[str, Topic]:
    try:
        from pyulog import ULog
    except ImportError:
        raise InputError(
            path, "", "no reader for .ulg files", 'pip install "holdfast[ulog]"'
        ) from None
    content = read_bytes(path, DATA_LIMIT, WHAT)
    # pyulog prints what it stumbles over, and fails on damaged files in ways no list covers
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            log = ULog(io.BytesIO(content), list(names))
    except Exception as error:
        raise InputError(path, "", f"no readable ulog ({error})", WHAT) from None
    if log.file_corruption:
        raise InputError(
            path, "", "damaged messages", "a whole ulog: copy it from the vehicle again"
        )
    if not allow_cut and not _ends_with_a_message(content):
        raise InputError(
            path,
            "",
            "a file that stops inside a message",
            "a whole ulog: copy it again, or take what there is by read_flight(.., allow_cut=True)",
        )
    found = {}
    for topic in sorted(log.data_list, key=lambda topic: topic.multi_id):
        found.setdefault(topic.name, topic.data)
    for name in names:
        if name not in found:
            raise InputError(path, name, "no such topic in the log", f"samples of {name}")
    return {name: found[name] for name in names}


def _ends_with_a_message(content: bytes) -> bool:
    """Whether the chain of message sizes (ulog: 16 bytes of header first) ends at the end."""
    at = 16
    while at + 3 <= len(content):
        at += 3 + int.from_bytes(content[at : at + 2], "little")
    return at == len(content)
