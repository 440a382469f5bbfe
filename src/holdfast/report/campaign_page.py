"""The page of a campaign: what was run, the figures, and every point with its scores."""

import itertools
from typing import Any

import numpy as np
import xarray as xr

from holdfast.report import campaign_figures, sections
from holdfast.report.campaign_grid import labels, means, score_label, study_axes
from holdfast.report.figures import NARROW, WIDE, svg
from holdfast.report.markup import Column, Markup, document, element, items, join, section, table
from holdfast.report.pictures import Picture
from holdfast.report.words import DASH, NBSP, count, number

ROWS = 500
"""Points that the page lists at most."""
LOWER = ("state_rmse", "attack_rmse", "detection_delay", "missed_share", "false_alarm_rate",
         "control_cost")  # fmt: skip
HIGHER = ("detected_share", "mode_accuracy", "localisation_precision", "localisation_recall", "auc")
"""Scores of which less, or more, is better; of all others neither."""
ATTRIBUTES = {
    "scenario": "Scenario", "points": "Points", "runs": "Runs of each point",
    "steps": "Steps of each run", "seed": "Seed", "holdfast": "Version of holdfast",
    "microseconds_per_step": "Microseconds a step of a run took, compiling included",
    "bytes_per_step": "Bytes that the record of a step takes while it is worked on",
}  # fmt: skip
LISTED = 12
"""Values of an axis that are listed."""

_INTERVAL = "the 95 % confidence interval of the mean over the runs"
_READINGS = {
    "curve": f"The mean over the runs, with {_INTERVAL}.",
    "map": "The mean over the runs; cells are of equal size, whatever the steps of the setting.",
    "roc": "The share of rows with alarm under attack against that without, as the threshold "
    "falls. The further a line keeps above the diagonal, the better the detector.",
}
_SHOWS = {
    "detection": "Detection",
    "state_rmse": "Error of the state estimate",
    "attack_rmse": "Error of the attack estimate",
    "control_cost": "Cost of the control",
}
_DELAY = " The delay is that of the runs with an alarm."


def page(found: xr.Dataset) -> str:
    """The page as text, complete in itself, from the dataset of a campaign."""
    title = str(found.attrs.get("study") or "Campaign")
    notes = [line for line in str(found.attrs.get("notes", "")).splitlines() if line.strip()]
    pictures = _pictures(found)
    parts = [
        section("run", "What was run", _attributes(found), _axes(found)),
        section("notes", "Notes", items(notes)) if notes else None,
        section("figures", "Figures", *(picture.markup() for picture in pictures))
        if pictures else None,
        section("points", "All points", _points(found)),
    ]  # fmt: skip
    kept = [part for part in parts if part]
    top = element(
        "header", element("h1", title), element("p", _subtitle(found), class_="under"),
        sections.contents(kept),
    )  # fmt: skip
    return document(title, top, kept)


def _subtitle(found: xr.Dataset) -> str:
    points = int(found.attrs.get("points", _size(found)))
    text = f"Campaign of {count(points, 'point')}"
    if "runs" in found.attrs:
        text += f", {count(int(found.attrs['runs']), 'simulated run')} each"
    return text + "."


def _size(found: xr.Dataset) -> int:
    return int(np.prod([found.sizes[name] for name in _names(found)], dtype=int))


def _names(found: xr.Dataset) -> list[str]:
    return [str(d) for d in found["summary"].dims if d not in ("score", "statistic")]


def _attributes(found: xr.Dataset) -> Markup:
    """What the campaign was run with, and the command that runs it again."""
    given = {k: found.attrs[k] for k in ATTRIBUTES if k in found.attrs}
    # no time where nothing was run: NaN
    rows = [[ATTRIBUTES[k], _setting(value)] for k, value in given.items() if value == value]
    parts = [table([Column("Setting"), Column("Value")], rows)] if rows else []
    if found.attrs.get("command"):
        above = element("p", "The command that runs it again:", class_="caption")
        parts += [above, element("pre", str(found.attrs["command"]), tabindex="0")]
    return join(parts)


def _setting(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _axes(found: xr.Dataset) -> Markup:
    """The settings that were varied, and those that have one value."""
    if not _names(found):
        return element("p", "No setting was varied.")
    rows = []
    for name in _names(found):
        values = [_value(value) for value in found[name].values]
        shown = ", ".join(values[:LISTED])
        if len(values) > LISTED:
            shown += f", ... to {values[-1]}"
        rows.append([name, str(len(values)), shown])
    columns = [Column("Axis of the study"), Column("Values", True), Column("Which")]
    return table(columns, rows, "The grid: every combination of these values is a point.")


def _value(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)


def _pictures(found: xr.Dataset) -> list[Picture]:
    wide = campaign_figures.figures(found, WIDE)
    narrow = campaign_figures.figures(found, NARROW)
    over = " and ".join(axis.name for axis in study_axes(found)) or "the threshold"
    made = []
    for name, figure in wide.items():
        kind = name if name == "roc" else "map" if name.startswith("map_") else "curve"
        family = name.removeprefix("map_")
        what = next((said for key, said in _SHOWS.items() if family.startswith(key)), "ROC curves")
        reading = _READINGS[kind] if name == "roc" else f"{what}. {_READINGS[kind]}"
        if family.startswith("detection") and "detection_delay" in found["score"].values:
            reading += _DELAY
        made.append(Picture(name, f"{what} over {over}", reading, svg(figure), svg(narrow[name])))
    return made


def _points(found: xr.Dataset) -> Markup:
    """Every point of the grid with the mean of each score and its interval."""
    names, total = _names(found), _size(found)
    heads, values, better = _scores(found)
    shown = min(total, ROWS)
    best = [_best(values[:, i, 0], way) for i, way in enumerate(better)]
    kinds = [found[name].values.dtype.kind in "iuf" for name in names]
    columns = [Column("Point")]
    columns += [Column(name, kind) for name, kind in zip(names, kinds, strict=True)]
    columns += [Column(head, True) for head in heads]
    grid = itertools.product(*(found[name].values for name in names))
    rows = [
        [str(i + 1), *(_value(value) for value in point),
         *(_cell(cell, bool(best[k][i]), heads[k]) for k, cell in enumerate(values[i]))]
        for i, point in enumerate(itertools.islice(grid, shown))
    ]  # fmt: skip
    caption = f"The mean of each score, in brackets {_INTERVAL}."
    if any(np.any(mask) for mask in best):
        caption += " Bold: the best mean of all points, whether or not the intervals overlap."
    if total > shown:
        caption += f" {total - shown} of {total} points are left out; result.nc has them."
    return table(columns, rows, caption)


def _scores(found: xr.Dataset) -> tuple[list[str], np.ndarray, list[int]]:
    """Headings, mean, low and high (points x scores x 3), and which way is better (-1, 0, 1).

    Scores that exist at no point are left out.
    """
    values = means(found).transpose(*_names(found), "score", "statistic").values
    values = values.reshape(_size(found), -1, 3)
    heads = labels(found)
    families = [str(name).partition(":")[0] for name in found["score"].values]
    if "auc" in found:
        auc = [found.get(name, found["auc"] * np.nan).transpose(*_names(found)).values.ravel()
               for name in ("auc", "auc_low", "auc_high")]  # fmt: skip
        values = np.concatenate([values, np.stack(auc, 1)[:, None]], 1)
        heads, families = [*heads, score_label("auc")], [*families, "auc"]
    known = np.flatnonzero(~np.all(np.isnan(values[..., 0]), 0))
    better = [(families[i] in HIGHER) - (families[i] in LOWER) for i in known]
    return [heads[i] for i in known], values[:, known], better


def _best(mean: np.ndarray, way: int) -> np.ndarray:
    """Which points have the best mean; none where all are the same."""
    known = mean[~np.isnan(mean)]
    if not way or not known.size or known.min() == known.max():
        return np.zeros(len(mean), bool)
    return mean == (known.max() if way > 0 else known.min())


def _cell(cell: np.ndarray, best: bool, head: str) -> Any:
    mean, low, high = (float(v) for v in cell)
    if np.isnan(mean):
        return DASH
    if np.isinf(mean) and head.startswith(score_label("detection_delay")):
        return "no alarm"
    said = element("strong", _number(mean)) if best else Markup(_number(mean))
    if np.isnan(low) or np.isnan(high):
        return said
    interval = f"[{_number(low)},{NBSP}{_number(high)}]"
    return Markup(f"{said}{NBSP}{element('small', interval)}")


def _number(value: float) -> str:
    if np.isinf(value):
        return "∞" if value > 0 else f"{DASH}∞"
    return number(value)
