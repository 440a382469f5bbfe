"""Scores of many runs of a point as means with their confidence intervals, and quantiles.

| score | what | mean of |
| --- | --- | --- |
| state_rmse, attack_rmse:NAME | root mean square error of a run, where determined | runs |
| state_worst, attack_worst:NAME | largest error of a run | runs |
| detection_delay | seconds to the first alarm under attack | attacked runs with an alarm |
| detected_share | attacked runs with an alarm | attacked runs |
| false_alarm_rate | alarms | tested rows before the attack |
| missed_share | rows without alarm | attacked rows |
| localisation_precision | channels hit | channels named in attacked rows |
| localisation_recall | channels named | channels hit in attacked rows |
| mode_accuracy | rows in which the true mode was believed | rows with a true mode |
| control_cost | x' Qx x + u' Ru u off what is to be held, mean over a run's rows (LQR) | runs |
| nees, nis | normalised squares before the attack, 1 where covariances are honest | degrees |
| unobservable_share, not_converged_share, diverged_share | rows with that status | rows |

Runs are independent and rows of a run are not: intervals (95 %) come from the spread over runs,
of a ratio by its linearisation. Where there is no spread, as with no event at all, Wilson's
interval takes the rows as independent. Quantiles of the delay count a run without alarm as
infinite.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from holdfast.campaign.run_scores import COUNTED
from holdfast.evaluate.scores import share

STATISTICS = ("mean", "low", "high", "q05", "q50", "q95")
QUANTILES = (0.05, 0.5, 0.95)
RATIOS = {
    "false_alarm_rate": ("false_alarms", "benign_rows"),
    "missed_share": ("missed", "attacked_rows"),
    "localisation_precision": ("named_hit", "named"),
    "localisation_recall": ("named_hit", "hit"),
    "mode_accuracy": ("mode_right", "mode_rows"),
    "nees": ("nees", "nees_degrees"),
    "nis": ("nis", "nis_degrees"),
} | {f"{name.lower()}_share": (name.lower(), "rows") for name in COUNTED}
"""Scores that are a sum over a sum."""
SHARES = tuple(name for name in RATIOS if name not in ("nees", "nis"))
PER_CHANNEL = {"state_rmse": "state", "state_worst": "state",
               "attack_rmse": "attack", "attack_worst": "attack"}  # fmt: skip
"""Scores that every channel has, and of what the channel is one."""
Z = float(ndtri(0.975))

Scores = Mapping[str, np.ndarray]
"""Every score of every run of a point, runs first."""


class Curve(NamedTuple):
    """Shares of benign and of attacked rows over each multiple of the threshold; the area
    below the one against the other with its interval.
    """

    false: np.ndarray
    true: np.ndarray
    auc: tuple[float, float, float]


def aggregated(
    scores: Scores, names: Mapping[str, tuple[str, ...]]
) -> dict[str, Float[np.ndarray, " statistics"]]:
    """`STATISTICS` of every score by its label; ``names``: of states and of attacks."""
    found = {}
    for score, kind in PER_CHANNEL.items():
        if score in scores:
            columns = zip(names[kind], scores[score].T, strict=True)
            found |= {f"{score}:{name}": mean(values) for name, values in columns}
    if "control_cost" in scores:
        found["control_cost"] = mean(np.asarray(scores["control_cost"]))
    delay = np.asarray(scores["detection_delay"])
    attacked = delay[~np.isnan(delay)]
    caught = np.isfinite(attacked)
    found["detection_delay"] = np.concatenate([mean(attacked[caught])[:3], _quantiles(attacked)])
    found["detected_share"] = _share(int(caught.sum()), len(attacked))
    for name, (above, below) in RATIOS.items():
        if above in scores:
            found[name] = ratio(scores[above], scores[below], bounded=name in SHARES)
    return found


def mean(values: np.ndarray) -> Float[np.ndarray, " statistics"]:
    """Of one number per run; NaN are left out. An infinite mean has no interval."""
    values = values[~np.isnan(values)]
    if not len(values):
        return np.full(len(STATISTICS), np.nan)
    with np.errstate(over="ignore"):  # costs of runs that diverge may be too large to add
        middle = float(np.mean(values))
        known = len(values) > 1 and np.isfinite(middle)
        half = Z * np.std(values, ddof=1) / np.sqrt(len(values)) if known else np.nan
    return np.concatenate([[middle, middle - half, middle + half], _quantiles(values)])


def ratio(
    above: np.ndarray, below: np.ndarray, *, bounded: bool
) -> Float[np.ndarray, " statistics"]:
    """Of sum(above) / sum(below), one pair per run; quantiles are those of the runs' own ratios.

    ``bounded``: the ratio is a share of things counted.
    """
    total = float(np.sum(below))
    if total == 0:
        return np.full(len(STATISTICS), np.nan)
    value, runs = float(np.sum(above)) / total, len(above)
    spread = np.sum((above - value * below) ** 2)
    half = Z * np.sqrt(spread * runs / max(runs - 1, 1)) / total if runs > 1 else np.nan
    low, high = value - half, value + half
    if bounded:
        low, high = max(low, 0.0), min(high, 1.0)
    if bounded and (spread == 0 or runs == 1):
        _, low, high, *_ = share(int(np.sum(above)), int(total))
    own = above[below > 0] / below[below > 0]
    return np.concatenate([[value, low, high], _quantiles(own)])


def _share(hits: int, of: int) -> Float[np.ndarray, " statistics"]:
    found = share(hits, of)
    return np.array([found.value, found.low, found.high, np.nan, np.nan, np.nan])


def _quantiles(values: np.ndarray) -> Float[np.ndarray, " quantiles"]:
    if not len(values):
        return np.full(len(QUANTILES), np.nan)
    return np.quantile(values, QUANTILES, method="inverted_cdf")


def curve(benign: np.ndarray, attacked: np.ndarray) -> Curve:
    """The trade-off from counts per bin, one row per block of runs.

    Rows in the same bin count as ties. The interval of the area is the jackknife's over blocks,
    NaN with a single one.
    """
    total = benign.sum(0), attacked.sum(0)
    false, true = (_over(counts) for counts in total)
    area = _area(*total)
    blocks = len(benign)
    if blocks < 2:
        return Curve(false, true, (area, np.nan, np.nan))
    left_out = np.array([
        _area(total[0] - b, total[1] - a) for b, a in zip(benign, attacked, strict=True)
    ])  # fmt: skip
    half = Z * np.sqrt((blocks - 1) / blocks * np.sum((left_out - left_out.mean()) ** 2))
    return Curve(false, true, (area, max(area - half, 0.0), min(area + half, 1.0)))


def _over(counts: np.ndarray) -> np.ndarray:
    """The share at or above the lower edge of each bin."""
    total = counts.sum()
    if total == 0:
        return np.full(len(counts), np.nan)
    return np.cumsum(counts[::-1])[::-1] / total


def _area(benign: np.ndarray, attacked: np.ndarray) -> float:
    """The chance that an attacked row lies in a higher bin than a benign one, ties half."""
    pairs = float(benign.sum()) * float(attacked.sum())
    if pairs == 0:
        return np.nan
    below = np.concatenate([[0], np.cumsum(benign)[:-1]])
    return float(np.sum(attacked * (below + 0.5 * benign)) / pairs)
