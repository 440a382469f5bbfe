"""The report: one self-contained page, with the numbers and figures beside it."""

import contextlib
import json
import os
import platform
import secrets
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import xarray as xr
from numpy.typing import ArrayLike

from holdfast import __version__
from holdfast.records import Trace
from holdfast.report import sections
from holdfast.report.markup import Markup, document, element, items, section, settings
from holdfast.report.pictures import Picture, draw
from holdfast.report.tables import dataset, json_safe
from holdfast.report.truth import Modes, Named
from holdfast.report.words import count, seconds

FILES = ("report.html", "result.nc", "scores.json", "scenario.toml")


def write_report(
    directory: Path | str,
    *,
    trace: Trace,
    plant: Named,
    time: ArrayLike,
    title: str,
    scenario_text: str,
    summary: Mapping[str, Any],
    calibration: Mapping[str, Any] | None = None,
    blindness: Sequence[str | Mapping[str, Any]] = (),
    attack_window: tuple[float, float] | None = None,
    units: Mapping[str, str] | None = None,
    notes: Sequence[str] = (),
    modes: Modes | None = None,
) -> Path:
    """Write report.html, result.nc, scores.json, scenario.toml and figures/*.svg.

    ``trace`` of one run, or of several with a leading axis, of which the figures show the
    first. ``summary``: what `holdfast.report.tables.summary` gave. ``calibration``: how the
    threshold was found, name to value. ``blindness``: what the detector cannot see, as
    sentences or as rows (name to value) of a table. ``attack_window`` in seconds is shaded;
    without it that of the summary. ``units``: name of a state, output, ... -> unit. ``modes``:
    what those are that the estimator weighs.

    Each file appears whole or not at all. Returns the path of the page. OSError where the
    directory cannot be written.
    """
    directory = Path(directory)
    units = units or {}
    whole = dataset(trace, plant, time, units=units, modes=modes)
    data = whole.isel(run=0) if "run" in whole.dims else whole
    summary = json_safe(summary)
    window = attack_window or _window(summary)
    pictures = draw(data, summary, window)
    page = render(
        data, summary, pictures, title=title, scenario_text=scenario_text,
        calibration=calibration, blindness=blindness, units=units, notes=notes,
    )  # fmt: skip
    (directory / "figures").mkdir(parents=True, exist_ok=True)
    for picture in pictures.values():
        _write(directory / "figures" / f"{picture.name}.svg", picture.wide)
    with _replacing(directory / "result.nc") as temporary:
        # covariances hardly change: a tenth of the bytes, and every number the same
        packed = {str(name): {"compression": "gzip", "compression_opts": 1, "shuffle": True}
                  for name in whole.data_vars}  # fmt: skip
        whole.to_netcdf(temporary, engine="h5netcdf", encoding=packed)
    _write(directory / "scores.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
    _write(directory / "scenario.toml", scenario_text)
    # last, so that a page is never beside numbers that are not its own
    _write(directory / "report.html", page)
    return directory / "report.html"


def render(
    data: xr.Dataset,
    summary: Mapping[str, Any],
    pictures: Mapping[str, Picture],
    *,
    title: str,
    scenario_text: str,
    calibration: Mapping[str, Any] | None,
    blindness: Sequence[str | Mapping[str, Any]],
    units: Mapping[str, str],
    notes: Sequence[str],
) -> str:
    """The page as text."""

    def shown(*names: str) -> list[Markup]:
        return [pictures[name].markup() for name in names if name in pictures]

    parts = [
        section("alarms", "Alarms", *shown("statistic"), sections.episodes(summary, units)),
        section("modes", "Modes", *shown("modes"), sections.mode_scores(summary))
        if "modes" in pictures else None,
        section("attack", "Attack estimate", *shown("attacks"), sections.attack_scores(summary))
        if "attacks" in pictures else None,
        section("state", "State", *shown("path", "states"), sections.state_scores(summary)),
        section("residuals", "Residuals", *shown("residuals"), sections.consistency(summary))
        if "residuals" in pictures else None,
        section("detector", "What the detector can and cannot see", *shown("trade_off"),
                sections.detector(summary, calibration, blindness)),
        section("data", "Data quality", *shown("samples"), sections.quality(summary)),
        section("notes", "Notes", items(notes)) if notes else None,
        section("scenario", "Scenario", element("pre", scenario_text, tabindex="0")),
        section("versions", "Versions and files", settings(versions()), sections.files(FILES)),
    ]  # fmt: skip
    top = element(
        "header", element("h1", title), element("p", _subtitle(summary), class_="under"),
        sections.verdict_card(summary, units), sections.key_numbers(summary),
        sections.contents([part for part in parts if part]),
    )  # fmt: skip
    return document(title, top, [part for part in parts if part])


def versions() -> dict[str, str]:
    """What the numbers were computed with, and when."""
    found = {"holdfast": __version__, "Python": platform.python_version()}
    found |= {name: metadata.version(name) for name in ("jax", "equinox", "numpy", "scipy")}
    return found | {"written": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")}


def _subtitle(summary: Mapping[str, Any]) -> str:
    dt = summary["dt_s"]
    kind = "Simulation" if summary["simulated"] else "Recorded log"
    span = f"{seconds(summary['begin_s'], dt)} to {seconds(summary['end_s'], dt)}"
    text = f"{kind}, {count(summary['rows'], 'row')} of {dt:g} s, {span}"
    if summary["runs"] > 1:
        text += f"; {summary['runs']} runs, of which the figures show the first"
    return text + "."


def _window(summary: Mapping[str, Any]) -> tuple[float, float] | None:
    found = summary["attack"]
    if found is None:
        return None
    return found["start_s"], float("inf") if found["stop_s"] is None else found["stop_s"]


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _write(path: Path, content: str) -> None:
    with _replacing(path) as temporary:
        temporary.write_text(content, encoding="utf-8", newline="\n")
