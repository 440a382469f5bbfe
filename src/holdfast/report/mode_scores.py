"""What a summary says of the modes that an estimator weighs."""

from typing import Any

import numpy as np
import xarray as xr

from holdfast.evaluate import modes, scores


def mode_scores(data: xr.Dataset) -> dict[str, Any] | None:
    """Of all runs (leading axis): how often each mode was believed in, and how rightly.

    ``accuracy`` over the rows whose true mode is one of those told apart, ``unlisted`` the
    share of the other rows, ``true`` the same for each true mode, with the delays until it was
    believed in, over all spells in which it was true (null: never). The last three are null
    where the truth is not known. None for an estimator that weighs no modes.
    """
    if "mode" not in data:
        return None
    names, believed = [str(name) for name in data.named.values], data["mode"].values
    found: dict[str, Any] = {
        "accuracy": None,
        "unlisted": None,
        "believed": {
            names[i]: scores.share(int(np.sum(believed == i)), believed.size)
            for i in np.unique(believed)
        },
        "true": None,
    }
    if "true_mode" not in data:
        return found
    truth, dt = data["true_mode"].values, float(data.attrs["dt"])
    every = [spell for run in range(len(truth)) for spell in _spells(believed[run], truth[run])]
    found["accuracy"] = modes.accuracy(believed, truth)
    found["unlisted"] = scores.share(int(np.sum(truth < 0)), truth.size)
    found["true"] = {}
    for i in np.unique([spell.mode for spell in every]):
        delays = np.array([dt * spell.delay for spell in every if spell.mode == i])
        found["true"][names[i]] = {
            "accuracy": modes.accuracy(believed, np.where(truth == i, truth, -1)),
            "spells": len(delays),
            # a spell in which it was never believed in being a delay without end
            "median_delay_s": float(np.quantile(delays, 0.5, method="higher")),
            "largest_delay_s": float(delays.max()),
        }
    return found
    return found


def mode_spells(data: xr.Dataset) -> list[dict[str, Any]]:
    """Of one run: every spell in which a mode was true, and how soon it was believed in."""
    if "true_mode" not in data:
        return []
    t, dt = data.time.values, float(data.attrs["dt"])
    return [
        {
            "mode": str(data.named.values[spell.mode]),
            "begin_s": float(t[spell.first]),
            "end_s": float(t[spell.last]),
            "accuracy": spell.right.value,
            "delay_s": dt * spell.delay,
        }
        for spell in _spells(data["mode"].values, data["true_mode"].values)
    ]


def _spells(believed: np.ndarray, truth: np.ndarray) -> list[modes.Spell]:
    """Those of two rows or more: what starts in the dynamics and in an output at one sample is
    felt one row apart.
    """
    return [spell for spell in modes.spells(believed, truth) if spell.last > spell.first]
