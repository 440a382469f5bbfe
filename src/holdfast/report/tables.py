"""Results as a dataset with named dimensions, and as a summary fit for JSON."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from holdfast import __version__
from holdfast.evaluate import scores
from holdfast.records import Reason, Status, Trace
from holdfast.report.mode_scores import mode_scores, mode_spells
from holdfast.report.results import FAULTY, GONE, MISSING, channel_names, dataset
from holdfast.report.truth import Modes, Named

__all__ = ["Named", "channel_names", "dataset", "json_safe", "summary"]

EPISODE_GAP = 10
"""Alarms at most this many rows apart are one episode, unless a gap is given."""


def summary(
    trace: Trace,
    plant: Named,
    time: ArrayLike,
    attack_window: tuple[float, float] | None = None,
    *,
    gap: float | None = None,
    modes: Modes | None = None,
) -> dict[str, Any]:
    """The scores of a run, or of a batch of runs pooled, fit for JSON (null for NaN and inf).

    ``attack_window`` (start, stop) in seconds, start <= t < stop; without it that of the
    injection, if simulated. False alarms are judged where it is known that nobody attacks:
    before the attack, or everywhere in a simulation without one. Alarms at most ``gap``
    seconds apart (default ten rows) are one episode. Intervals have 95 % confidence.
    ``modes``: what those are that the estimator weighs, so that the true one is known.
    """
    data = dataset(trace, plant, time, modes=modes)
    if "run" not in data.dims:
        data = data.expand_dims("run")
    gap = EPISODE_GAP * float(plant.dt) if gap is None else gap
    simulated = "true_x" in data
    t = data.time.values
    window = _on_rows(t, attack_window) if attack_window else _injected_window(data)
    benign = t < window[0] if window else np.full(t.shape, True)
    runs = [_one_run(data.isel(run=i), window, gap) for i in range(data.sizes["run"])]
    found = {
        "holdfast": __version__,
        "runs": len(runs),
        "rows": len(t),
        "dt_s": float(plant.dt),
        "begin_s": float(t[0]),
        "end_s": float(t[-1]),
        "simulated": simulated,
        "attack": {"start_s": window[0], "stop_s": window[1]} if window else None,
        "episode_gap_s": gap,
        "tested": _share(np.isfinite(data.threshold.values)),
        "alarm_rows": _share(data.alarm.values),
        "detection": _detection(data, runs, window) if window else None,
        "false_alarms": (
            _false_alarms(data, runs, benign, float(plant.dt)) if window or simulated else None
        ),
        "state": _errors(data, "x", "true_x") if simulated else None,
        "attack_estimate": _errors(data, "d", "true_d") if "true_d" in data else None,
        "consistency": _consistency(data, benign, known=bool(window) or simulated),
        "data": _quality(data),
        "status": _status(data),
        "modes": mode_scores(data),
        "per_run": runs,
    }
    return json_safe(found)


def json_safe(value: Any) -> Any:
    """The same with plain types only: null for NaN and infinity, named tuples as objects."""
    if isinstance(value, Mapping):
        return {str(k): json_safe(v) for k, v in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return json_safe(value._asdict())  # type: ignore[attr-defined]
    if isinstance(value, list | tuple):
        return [json_safe(v) for v in value]
    if isinstance(value, np.ndarray):
        return json_safe(value.tolist())
    if isinstance(value, np.generic):
        return json_safe(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _on_rows(t: np.ndarray, window: tuple[float, float]) -> tuple[float, float]:
    """The window, with an edge that misses a row by rounding only put onto it."""
    slack = 1e-9 * max(1.0, float(np.abs(t).max()))
    start, stop = (
        next((float(row) for row in t[np.abs(t - edge) <= slack]), float(edge)) for edge in window
    )
    return start, stop


def _injected_window(data: xr.Dataset) -> tuple[float, float] | None:
    """From the first row with an injection to the row after the last, over all runs."""
    names = [name for name in ("injected_u", "injected_y", "injected_d") if name in data]
    touched = np.zeros(data.sizes["time"], bool)
    for name in names:
        touched |= np.any(data[name].values != 0, axis=(0, 2))
    if "injected_switch" in data:
        touched |= np.any(data["injected_switch"].values != 0, axis=0)
    rows = np.flatnonzero(touched)
    if rows.size == 0:
        return None
    t = data.time.values
    after = t[rows[-1] + 1] if rows[-1] + 1 < len(t) else np.inf
    return float(t[rows[0]]), float(after)


def _share(mask: np.ndarray) -> scores.Share:
    return scores.share(int(mask.sum()), int(mask.size))


def _one_run(data: xr.Dataset, window: tuple[float, float] | None, gap: float) -> dict[str, Any]:
    t, alarm = data.time.values, data.alarm.values
    spans = scores.episodes(t, alarm, gap)
    found: dict[str, Any] = {"episodes": [_episode(data, *span) for span in spans]}
    if "mode" in data:
        found["modes"] = mode_spells(data)
    if window is None:
        return found
    delay = scores.detection_delay(t, alarm, *window)
    found["delay_s"] = delay
    found["detection"] = None
    if np.isfinite(delay):
        row = int(np.flatnonzero(alarm & (t >= window[0]))[0])
        found["detection"] = _episode(data, row, row)
    found["episodes_before"] = len(scores.episodes(t, alarm & (t < window[0]), gap))
    return found


def _episode(data: xr.Dataset, first: int, last: int) -> dict[str, Any]:
    rows = data.isel(time=slice(first, last + 1))
    ratio = scores.margin(rows.statistic.values, rows.threshold.values)
    peak = first + (int(np.nanargmax(ratio)) if np.any(np.isfinite(ratio)) else 0)
    row = data.isel(time=first)
    channel, kind = suspect(row)
    found = {
        "begin_s": float(data.time.values[first]),
        "end_s": float(data.time.values[last]),
        "alarm_rows": int(rows.alarm.values.sum()),
        "reason": Reason(int(row.reason)).name,
        "words": Reason(int(row.reason)).words,
        "largest_statistic": float(data.statistic.values[peak]),
        "threshold": float(data.threshold.values[peak]),
        "channel": channel,
        "channel_kind": kind,
    }
    if kind == "attack":
        i = list(row.attack.values).index(channel)
        found["estimate"] = float(row.d.values[i])
        found["estimate_sd"] = float(np.sqrt(row.d_cov.values[i, i]))
    return found


def suspect(row: xr.Dataset) -> tuple[str | None, str | None]:
    """The channel an alarm points at, and its kind: "attack" or "output".

    The channels that the detector names, else, where the detector tests the attack estimate,
    the attack furthest from zero in its standard deviations; else the output whose residual
    is. Among several named channels again the furthest.
    """
    far: dict[str, tuple[np.ndarray, list[str]]] = {}
    if "d" in row:
        far["attack"] = _in_sds(row.d.values, row.d_cov.values), list(row.attack.values)
    far["output"] = _in_sds(row.residual.values, row.residual_cov.values), list(row.output.values)
    kind = "attack" if "d" in row and not _on_residual(int(row.reason)) else "output"
    sizes, names = far[kind]
    if "alarm_channel" in row and np.any(row.alarm_channel.values):
        flagged = [str(n) for n in row.channel.values[row.alarm_channel.values]]
        if set(flagged) <= set(names):
            sizes = np.where(np.isin(names, flagged), sizes, np.nan)
            if not np.any(np.isfinite(sizes)):
                return flagged[0], kind
        else:
            return flagged[0], "output" if flagged[0] in far["output"][1] else None
    if not np.any(np.isfinite(sizes)):
        return None, None
    return str(names[int(np.nanargmax(sizes))]), kind


def _on_residual(reason: int) -> bool:
    return Reason(reason).name.startswith("RESIDUAL")


def _in_sds(value: np.ndarray, cov: np.ndarray) -> np.ndarray:
    variance = np.diagonal(cov)
    known = np.isfinite(variance) & (variance > 0) & np.isfinite(value)
    scale = np.sqrt(np.where(known, variance, 1.0))
    return np.where(known, np.abs(np.where(known, value, 0.0)) / scale, np.nan)


def _detection(
    data: xr.Dataset, runs: list[dict[str, Any]], window: tuple[float, float]
) -> dict[str, Any]:
    t = data.time.values
    attacked = np.broadcast_to((t >= window[0]) & (t < window[1]), data.alarm.shape)
    delays = np.array([run["delay_s"] for run in runs])
    ratio = scores.margin(data.statistic.values, data.threshold.values)
    benign = np.broadcast_to(t < window[0], attacked.shape)
    judged = attacked | benign
    tested = np.isfinite(data.threshold.values)
    curve = scores.roc(ratio[judged], attacked[judged])
    return {
        "runs": scores.share(int(np.isfinite(delays).sum()), len(delays)),
        # over all runs, a run without alarm being a delay without end
        "median_delay_s": float(np.quantile(delays, 0.5, method="higher")),
        "largest_delay_s": float(delays.max()),
        "missed_rows": scores.missed_share(data.alarm.values, attacked, tested),
        "missed_tested_rows": scores.missed_share(data.alarm.values, attacked & tested),
        "auc": {"value": curve.auc, "low": curve.low, "high": curve.high},
    }


def _false_alarms(
    data: xr.Dataset, runs: list[dict[str, Any]], benign: np.ndarray, dt: float
) -> dict[str, Any]:
    # a row in which a bank believes in no attack has passed its test, as calibration counts it
    tested = np.isfinite(data.threshold.values) | ("mode" in data)
    rows = np.broadcast_to(benign, tested.shape)
    count = sum(run.get("episodes_before", len(run["episodes"])) for run in runs)
    return {
        "rows": scores.false_alarm_rate(data.alarm.values, rows, tested),
        "episodes": scores.event_rate(count, float(rows.sum()) * dt),
    }


def _errors(data: xr.Dataset, name: str, truth: str) -> dict[str, Any]:
    kind = data[name].dims[-1]
    error = (data[name] - data[truth]).values
    variance = np.diagonal(data[f"{name}_cov"].values, axis1=-2, axis2=-1)
    root, worst = scores.rmse(error, variance), scores.worst_error(error, variance)
    known = np.isfinite(variance)
    sds = np.sqrt(np.where(known, variance, np.nan))
    return {
        str(label): {
            "rmse": root[i],
            "worst": worst[i],
            "median_sd": np.nanmedian(sds[..., i]) if known[..., i].any() else np.nan,
            "determined": _share(known[..., i]),
        }
        for i, label in enumerate(data[kind].values)
    }


def _consistency(data: xr.Dataset, benign: np.ndarray, *, known: bool) -> dict[str, Any]:
    before = data.isel(time=np.flatnonzero(benign))
    over = "rows without attack" if known else "all rows"
    squares, degrees = scores.normalised_squares(
        np.nan_to_num(before.residual.values), before.residual_cov.values
    )
    nis = scores.consistency(squares, degrees)
    found = {"nis": {**nis._asdict(), "consistent": nis.consistent, "over": over}}
    if "true_x" in data:
        error = np.nan_to_num((before.x - before.true_x).values)
        squares, degrees = scores.normalised_squares(error, before.x_cov.values)
        nees = scores.consistency(squares, degrees, white=False)
        found["nees"] = {**nees._asdict(), "consistent": nees.consistent, "over": over}
    return found


def _quality(data: xr.Dataset) -> dict[str, Any]:
    kinds = {"missing": MISSING, "faulty": FAULTY, "missing_or_faulty": GONE}
    return {
        str(label): {
            word: int((data["sample"].sel(output=label).values == code).sum())
            for word, code in kinds.items()
        }
        for label in data.output.values
    }


def _status(data: xr.Dataset) -> dict[str, int]:
    bits = data.status.values
    counts = {str(s.name): int(((bits & int(s)) != 0).sum()) for s in Status if s}
    return {"OK": int((bits == 0).sum())} | {name: n for name, n in counts.items() if n}
