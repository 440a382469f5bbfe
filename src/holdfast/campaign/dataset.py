"""What a campaign found as a dataset: scores of every run, and their summary."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from holdfast.campaign.aggregate import (
    PER_CHANNEL,
    STATISTICS,
    Curve,
    aggregated,
    curve,
)
from holdfast.campaign.blocks import Block
from holdfast.campaign.run_scores import bin_edges

UNITS = {"detection_delay": "s"}
ALONG = {"state": "state", "attack": "channel"}
"""Dimension of what every state or every attack channel has; an axis may be called "attack"."""

Point = tuple[int, ...]


def campaign_dataset(
    axes: Mapping[str, Sequence[str | float]],
    blocks: Mapping[Point, Sequence[Block]],
    names: Mapping[Point, Mapping[str, tuple[str, ...]]],
    attrs: Mapping[str, Any],
) -> xr.Dataset:
    """Every score of every run (axes, run, and state or channel), the ``summary`` (axes, score,
    statistic), and the ROC curves (axes, margin).

    ``axes``: the labels on each. ``blocks``: those of each point, in order. ``names``: of the
    states and attacks of each point. A score that a point lacks is NaN there.
    """
    shape = tuple(map(len, axes.values()))
    runs = {point: _joined(found) for point, found in blocks.items()}
    channels = {
        kind: list(dict.fromkeys(n for by_kind in names.values() for n in by_kind[kind]))
        for kind in ("state", "attack")
    }
    count = max((len(found["rows"]) for found in runs.values()), default=0)
    data: dict[str, Any] = {}
    for score in dict.fromkeys(name for found in runs.values() for name in found):
        kind = PER_CHANNEL.get(score)
        extra = () if kind is None else (len(channels[kind]),)
        values = np.full((*shape, count, *extra), np.nan)
        for point, found in runs.items():
            if score not in found:
                continue
            if kind is None:
                values[point] = found[score]
            else:
                places = [channels[kind].index(n) for n in names[point][kind]]
                values[point][:, places] = found[score]
        data[score] = ((*axes, "run", *(() if kind is None else (ALONG[kind],))), values)
    summaries = {point: aggregated(found, names[point]) for point, found in runs.items()}
    labels = list(dict.fromkeys(label for found in summaries.values() for label in found))
    table = np.full((*shape, len(labels), len(STATISTICS)), np.nan)
    for point, found in summaries.items():
        for label, values in found.items():
            table[point][labels.index(label)] = values
    data["summary"] = ((*axes, "score", "statistic"), table)
    data |= _curves(tuple(axes), shape, blocks)
    coords = {name: list(values) for name, values in axes.items()}
    coords |= {"run": np.arange(count), "score": labels, "statistic": list(STATISTICS)}
    coords |= {ALONG[kind]: found for kind, found in channels.items()}
    coords["margin"] = bin_edges()
    unit = [UNITS.get(label, "") for label in labels]
    return xr.Dataset(data, coords, dict(attrs)).assign_coords(unit=("score", unit))


def _joined(blocks: Sequence[Block]) -> dict[str, np.ndarray]:
    return {
        name: np.concatenate([block.scores[name] for block in blocks]) for name in blocks[0].scores
    }


def _curves(axes: tuple[str, ...], shape: Point, blocks) -> dict[str, Any]:
    bins = len(bin_edges())
    false, true = np.full((*shape, bins), np.nan), np.full((*shape, bins), np.nan)
    area = np.full((*shape, 3), np.nan)
    for point, found in blocks.items():
        one: Curve = curve(*(np.stack([getattr(b, n) for b in found]) for n in Block._fields[1:]))
        false[point], true[point], area[point] = one
    return {
        "false_share": ((*axes, "margin"), false),
        "true_share": ((*axes, "margin"), true),
        **{name: (axes, area[..., i]) for i, name in enumerate(("auc", "auc_low", "auc_high"))},
    }
