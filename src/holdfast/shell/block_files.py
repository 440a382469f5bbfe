"""Finished blocks of a campaign on disk: written whole, checked by their checksum when read."""

import hashlib
import io
import json
import platform
import re
import warnings
import zipfile
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from holdfast import __version__
from holdfast.campaign.blocks import BLOCK, Block
from holdfast.shell.errors import InputError
from holdfast.shell.study import Study
from holdfast.shell.writing import replacing, unwritable, write_text

MANIFEST, FOLDER = "manifest.json", "blocks"
_NAME = re.compile(r"([0-9a-f]{16})-(\d+)-(\d+)-([0-9a-f]{16})\.npz")
POOLED = ("benign", "attacked")


def versions() -> dict[str, str]:
    """Of what the numbers of a run depend on."""
    packages = ("jax", "jaxlib", "numpy", "equinox")
    return {"holdfast": __version__, "python": platform.python_version()} | {
        name: version(name) for name in packages
    }


class BlockFiles:
    """The folder of a campaign: its manifest, and files with the blocks that are finished.

    A file is named by its point, its first run, the number of runs and a checksum of its
    content, so that a damaged or half-copied one is found out and its runs made again.
    ``traces``: what the manifest says of a store of records, None where there is none.
    """

    def __init__(self, folder: str | Path, study: Study):
        self.folder, self.study = Path(folder), study
        self.names = {study.name_of(point): self.named(point) for point in study.points}
        self.traces: dict[str, Any] | None = None
        self._check_begun()

    def named(self, point: tuple[int, ...]) -> str:
        """The beginning of the names of a point's files."""
        return hashlib.sha256(self.study.name_of(point).encode()).hexdigest()[:16]

    def _check_begun(self) -> None:
        path = self.folder / MANIFEST
        if not path.exists():
            if self.folder.is_dir() and any(self.folder.iterdir()):
                raise InputError(
                    self.folder, "", "a folder that holds something else",
                    "a new or empty folder, or that of the same campaign",
                )  # fmt: skip
            return
        try:
            begun = json.loads(path.read_text(encoding="utf-8"))
            digest, made, traces = begun["digest"], begun["versions"], begun.get("traces")
        except (OSError, ValueError, KeyError, TypeError):
            raise InputError(path, "", "no manifest of a campaign", "another folder") from None
        if digest != self.study.digest:
            raise InputError(
                self.folder, "", "a campaign with another scenario or other settings",
                "another folder, or the study that it was begun with (runs and axes may change)",
            )  # fmt: skip
        if made != versions():
            now = versions()
            other = ", ".join(f"{k} {made.get(k)}" for k in now if made.get(k) != now[k])
            raise InputError(
                self.folder, "", f"blocks made with {other}",
                "the same versions, or another folder: last digits may differ",
            )  # fmt: skip
        self.traces = traces if isinstance(traces, dict) else None

    def begin(self) -> None:
        """Make the folder and write the manifest, before the first block."""
        try:
            (self.folder / FOLDER).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise unwritable(self.folder, error) from None
        write_text(self.folder / "study.toml", self.study.source)
        write_text(self.folder / "scenario.toml", self.study.scenario_source)
        self.write_manifest()

    def write_manifest(self) -> None:
        """What was run, with what, and every file with its checksum."""
        study = self.study
        files = sorted(p.name for p in self._files())
        found = {
            "digest": study.digest,
            "versions": versions(),
            "study": Path(study.path).name,
            "scenario": Path(study.scenario_path).name,
            "settings": study.settings.model_dump(),
            "block": BLOCK,
            "points": [
                {"point": study.labels_of(point), "files": self.named(point)}
                for point in study.points
            ],
            "blocks": {name: _NAME.fullmatch(name)[4] for name in files},  # type: ignore[index]
            "traces": self.traces,
        }
        write_text(self.folder / MANIFEST, json.dumps(found, indent=1) + "\n")

    def _files(self) -> list[Path]:
        folder = self.folder / FOLDER
        return [p for p in folder.iterdir() if _NAME.fullmatch(p.name)] if folder.is_dir() else []

    def write(self, point: tuple[int, ...], first: int, blocks: Sequence[Block]) -> None:
        """The blocks from number ``first`` on, in one file."""
        arrays: dict[str, Any] = {
            f"score:{name}": np.concatenate([b.scores[name] for b in blocks])
            for name in blocks[0].scores
        }
        arrays |= {name: np.stack([getattr(b, name) for b in blocks]) for name in POOLED}
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)
        content = buffer.getvalue()
        runs = sum(len(b.scores["rows"]) for b in blocks)
        name = f"{self.named(point)}-{first * BLOCK}-{runs}-{_checksum(content)}.npz"
        with replacing(self.folder / FOLDER / name) as temporary:
            temporary.write_bytes(content)

    def read(self) -> dict[tuple[tuple[int, ...], int], Block]:
        """Every finished block of this study by point and number; damaged files are removed."""
        points = {self.named(point): point for point in self.study.points}
        runs, found = self.study.settings.runs, {}
        for path in sorted(self._files()):
            matched = _NAME.fullmatch(path.name)
            assert matched is not None
            point = points.get(matched[1])
            if point is None:
                continue  # of a value that is no longer on its axis
            blocks = _blocks(path, matched[4])
            if blocks is None:
                warnings.warn(f"{path}: damaged; its runs are made again", stacklevel=2)
                path.unlink(missing_ok=True)
                continue
            first = int(matched[2]) // BLOCK
            for number, block in enumerate(blocks, first):
                # the last block of fewer runs, asked for before, is not whole
                if len(block.scores["rows"]) == min(BLOCK, runs - number * BLOCK):
                    found[point, number] = block
        return found


def _checksum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _blocks(path: Path, checksum: str) -> list[Block] | None:
    """The blocks of a file; None if it is damaged."""
    try:
        content = path.read_bytes()
        if _checksum(content) != checksum:
            return None
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            scores = {n[6:]: arrays[n] for n in arrays.files if n.startswith("score:")}
            pooled = [arrays[name] for name in POOLED]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return None
    count = len(pooled[0])
    rows = [slice(i * BLOCK, (i + 1) * BLOCK) for i in range(count)]
    return [
        Block({name: values[r] for name, values in scores.items()}, pooled[0][i], pooled[1][i])
        for i, r in enumerate(rows)
    ]
