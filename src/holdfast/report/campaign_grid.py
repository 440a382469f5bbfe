"""What the figures of a campaign show: which axis goes where, and what has no room."""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from holdfast.report.words import NBSP

FAMILIES = {
    "detection": ("detection_delay", "detected_share", "missed_share", "false_alarm_rate"),
    "state_rmse": ("state_rmse",),
    "attack_rmse": ("attack_rmse",),
    "control_cost": ("control_cost",),
}
"""The scores that are drawn; those of one family stand in one figure."""
SHARES = ("share", "rate", "accuracy", "precision", "recall")
"""What the name of a score ends in that lies between 0 and 1."""
WORDS = {"state_rmse": "state RMSE", "attack_rmse": "attack RMSE", "nees": "NEES", "nis": "NIS",
         "auc": "AUC"}  # fmt: skip
LINES, CHANNELS, COMBINATIONS, ROWS, PANELS = 8, 6, 6, 12, 12
"""Lines, channels, combinations, names beside bars and panels that are drawn at most."""
LONG = 34
"""Letters of a name shown in full."""


class Axis(NamedTuple):
    """An axis of the study with at least two values."""

    name: str
    values: np.ndarray
    numeric: bool

    def text(self, i: int) -> str:
        """The i-th value in words."""
        return plain(f"{self.values[i]:.4g}" if self.numeric else str(self.values[i]))

    def setting(self, i: int, room: int) -> str:
        """The name with the i-th value, in about so many letters, to stand on one line."""
        value = short(self.text(i), max(12, room // 2))
        name = short(plain(self.name), max(12, room - len(value) - 4))
        return f"{name} = {value}".replace(" ", NBSP)


class Plan(NamedTuple):
    """What goes where: along x, the coloured lines (the rows of a map), and the panels.

    ``columns`` and ``lines``: which values of ``across`` and of ``second`` are drawn; ``panels``:
    the combinations of the values of ``others``, by their places; ``left_out``: what is not.
    """

    across: Axis
    columns: list[int]
    second: Axis | None
    lines: list[int]
    others: list[Axis]
    panels: list[dict[str, int]]
    left_out: list[str]


def study_axes(found: xr.Dataset) -> list[Axis]:
    """The axes of the study along which anything changes."""
    names = [str(d) for d in found["summary"].dims if d not in ("score", "statistic")]
    axes = []
    for name in names:
        values = found[name].values
        # a setting that can be infinite has no place on an axis of numbers
        numeric = values.dtype.kind in "iuf" and bool(np.all(np.isfinite(values)))
        axes.append(Axis(name, values, numeric))
    return [axis for axis in axes if len(axis.values) > 1]


def means(found: xr.Dataset) -> xr.DataArray:
    """Mean, low and high of every score; infinite where at least half of the runs are and there
    is no mean, as of the delay where no run has an alarm.
    """
    data = found["summary"]
    kept = data.sel(statistic=["mean", "low", "high"])
    kept = kept.where(kept != -np.inf)
    if "q50" not in data["statistic"].values:
        return kept
    mean, median = (data.sel(statistic=name, drop=True) for name in ("mean", "q50"))
    endless = mean.isnull() & (median == np.inf)
    return kept.where(~endless | (kept["statistic"] != "mean"), np.inf)


def score_label(name: str, unit: str = "") -> str:
    """A score as a heading: its words, its channel, its unit."""
    family, _, channel = name.partition(":")
    words = WORDS.get(family, family.replace("_", " "))
    return words + (f", {channel}" if channel else "") + (f" ({unit})" if unit else "")


def labels(found: xr.Dataset) -> list[str]:
    """Every score of the dataset as a heading."""
    names = [str(name) for name in found["score"].values]
    units = [str(u) for u in found["unit"].values] if "unit" in found.coords else [""] * len(names)
    return [score_label(name, unit) for name, unit in zip(names, units, strict=True)]


def plain(text: str) -> str:
    """The text on one line, without what matplotlib would take for mathematics."""
    text = " ".join(text.split()).replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text  # else a legend drops it


def short(text: str, most: int = LONG) -> str:
    """The text without its middle where it is too long."""
    return text if len(text) <= most else f"{text[: most // 2]}…{text[-(most - most // 2 - 1) :]}"


def even(count: int, most: int) -> list[int]:
    """At most so many of 0 ... count-1, evenly spread, both ends among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def line_axis(axes: Sequence[Axis], across: Axis) -> Axis | None:
    """The axis drawn as colours: a categorical one first, then one whose values all fit."""
    others = [axis for axis in axes if axis is not across]
    return min(others, default=None, key=lambda a: (a.numeric, len(a.values) > LINES,
                                                    -len(a.values)))  # fmt: skip


def plan_of(axes: Sequence[Axis], across: Axis, second: Axis | None, most: int | None) -> Plan:
    """What goes where; ``most``: lines at most, None for all of them."""
    columns = even(len(across.values), len(across.values) if across.numeric else ROWS)
    length = 1 if second is None else len(second.values)
    lines = even(length, most or length)
    others = [axis for axis in axes if axis is not across and axis is not second]
    whole = list(itertools.product(*(range(len(axis.values)) for axis in others)))
    kept = [whole[i] for i in even(len(whole), COMBINATIONS)]
    panels = [dict(zip((a.name for a in others), point, strict=True)) for point in kept]
    left_out = [
        f"{len(shown)} of {len(axis.values)} values of {short(plain(axis.name))}"
        for axis, shown in ((across, columns), (second, lines))
        if axis is not None and len(shown) < len(axis.values)
    ]
    if len(kept) < len(whole):
        names = " and ".join(short(plain(axis.name)) for axis in others)
        kind = "values" if len(others) == 1 else "combinations"
        left_out.append(f"{len(kept)} of {len(whole)} {kind} of {names}")
    return Plan(across, columns, second, lines, others, panels, left_out)


def families(found: xr.Dataset, plan: Plan) -> Iterator[tuple[str, list[int], list[str]]]:
    """Of each figure its name, its scores, and what it leaves out.

    Detection fills as many figures as it takes; of many channels those that change most.
    """
    mean = means(found).sel(statistic="mean").transpose("score", ...).values
    mean = mean.reshape(len(mean), -1)
    names = [str(name) for name in found["score"].values]
    room = PANELS // len(plan.panels)
    for family, members in FAMILIES.items():
        known = [i for i, name in enumerate(names) if name.partition(":")[0] in members
                 and not np.all(np.isnan(mean[i]))]  # fmt: skip
        if len(members) > 1:
            for start in range(0, len(known), room):
                name = family if not start else f"{family}_{start // room + 1}"
                yield name, known[start : start + room], plan.left_out
        elif known:
            most = min(CHANNELS, room)
            kept = sorted(sorted(known, key=lambda i: -_relative_spread(mean[i]))[:most])
            less = [f"{most} of {len(known)} channels, those that change most"]
            yield family, kept, plan.left_out + (less if len(kept) < len(known) else [])


def _relative_spread(values: np.ndarray) -> float:
    """How much a score changes over the grid, for the size it has."""
    if np.any(np.isinf(values)):
        return np.inf
    size = np.nanmax(np.abs(values))
    return float((np.nanmax(values) - np.nanmin(values)) / size) if size > 0 else 0.0


def panel_values(found: xr.Dataset, plan: Plan, score: int, panel: dict[str, int]) -> np.ndarray:
    """Of one panel mean, low and high, (line, along x, 3)."""
    order = [plan.across.name, *([] if plan.second is None else [plan.second.name])]
    data = means(found).isel(score=score)
    data = data.isel({d: panel.get(str(d), 0) for d in data.dims if d not in (*order, "statistic")})
    values = data.transpose(*order[1:], order[0], "statistic").values
    return values.reshape(-1, len(plan.across.values), 3)[plan.lines][:, plan.columns]


def decades(values: np.ndarray) -> bool:
    """Positive throughout, over more than two decades: a logarithmic scale."""
    known = values[np.isfinite(values)]
    return bool(known.size and np.all(known > 0) and known.max() > 100 * known.min())


def limits_of(values: np.ndarray, log: bool, *, zero: bool) -> tuple[float, float]:
    """Limits for mean, low and high, the same for all panels of a score; room for the infinite."""
    known = values[np.isfinite(values) & ((values > 0) | (not log))]
    if not known.size:
        return 0.0, 1.0
    low, high = float(known.min()), float(known.max())
    room = 0.16 if np.any(np.isinf(values)) else 0.05
    if log:
        # an interval that comes close to 0 must not flatten the means
        mean = values[..., 0][np.isfinite(values[..., 0])]
        low = max(low, float(mean.min()) / 10)
        reach = max(1.15, (high / low) ** room)
        return low / reach, high * reach
    lowest = min(low, 0.0) if zero or low < high / 2 else low
    reach = high - lowest or abs(high) or 1.0
    return lowest - (0.05 * reach if lowest else 0.0), high + room * reach
