"""The cases of the arena: what each estimator made of each attack, and what was promised of it."""

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from holdfast.shell.arena_promises import Promise, Promises
from holdfast.shell.points import Prepared

FAILED = 3.0
"""Times the error of the first estimator without attack from which an estimator has failed."""
SURE = 4.5
"""Standard errors from which a promise counts as broken: one in 100,000 by chance."""
BESIDE = ("attack", "estimator", "detector")


def cases_of(ground: str, study: str, prepared: Prepared, result: xr.Dataset) -> pd.DataFrame:
    """A row per point of a study.

    ``error``: root mean square over rows and runs, of the state with the largest, in units of
    what the first estimator has without attack (under the same truth), and its 95 % interval
    ``error_low``, ``error_high``; ``failed``: whether it is `FAILED` or more; ``bound``: what was
    promised of that state, in the same units, ``tightness``: the largest part of a promise that
    was used up, ``promise``: "exact", "kept", "broken" or nothing, ``why``. ``alarms``: share of
    attacked rows with an alarm, with its interval; ``delay``: median seconds to the first one;
    ``false_alarms``: of the same without attack. ``cost_lost``: of control, as a part of what it
    is without attack, the noise being the same. ``attackable``: whether undetected lies of the
    sensors hit can grow without bound, None where there are none or it is not known.
    """
    kept = ["state_rmse", "summary", *({"control_cost"} & set(result.data_vars))]
    result = result[kept].load()
    points = prepared.study.points
    names = [axis.name for axis in prepared.study.axes]
    truths = [i for i, name in enumerate(names) if name not in BESIDE]
    promises = Promises(prepared)
    rows = []
    for number, point in enumerate(points):
        labels = prepared.study.labels_of(point)
        without = _moved(point, names, attack=0)
        first = _moved(without, names, estimator=0, detector=0)
        case, quiet = prepared.cases[number], points.index(without)
        error, low, high, state = _errors(result, names, point, first)
        promised = promises.of(number, quiet)
        row = {
            "ground": ground, "study": study, "attack": str(labels.get("attack", "")),
            "estimator": str(labels.get("estimator", "")),
            "detector": str(labels.get("detector", "")),
            "truth": ", ".join(f"{names[i]} = {labels[names[i]]:g}" for i in truths),
            "state": case.scenario.plant.states[state] if state >= 0 else "",
            "error": error, "error_low": low, "error_high": high, "failed": not error < FAILED,
        }  # fmt: skip
        row |= _kept(result, names, point, first, promised, state)
        row |= _detection(result, names, point, without)
        row["cost_lost"] = _cost_lost(result, names, point, without)
        row["attackable"] = promises.attackable(number)
        rows.append(row)
    return pd.DataFrame(rows)


def _moved(point: tuple[int, ...], names: list[str], **places: int) -> tuple[int, ...]:
    return tuple(places.get(name, i) for i, name in zip(point, names, strict=True))


def _at(result: xr.Dataset, names: list[str], point: tuple[int, ...]) -> xr.Dataset:
    return result.isel(dict(zip(names, point, strict=True)))


def _squares(result: xr.Dataset, names, point) -> np.ndarray:
    """The mean square error of every run and state."""
    return _at(result, names, point)["state_rmse"].values ** 2


def _errors(result: xr.Dataset, names, point, first) -> tuple[float, float, float, int]:
    """The relative error of the worst state with its interval, and which state that is."""
    squares = _squares(result, names, point)
    unit = np.mean(_squares(result, names, first), 0)
    ratio = squares / unit
    mean = np.mean(ratio, 0)
    if not np.any(np.isfinite(mean)):
        # nothing determined, or grown beyond all numbers
        return (np.nan if np.all(np.isnan(squares)) else np.inf), np.nan, np.nan, -1
    state = int(np.nanargmax(np.where(np.isnan(mean), -np.inf, mean)))
    half = 1.96 * np.std(ratio[:, state], ddof=1) / np.sqrt(len(ratio))
    low, high = max(mean[state] - half, 0.0), mean[state] + half
    value, low, high = (float(np.sqrt(v)) for v in (mean[state], low, high))
    return value, low, high, state


def _kept(result, names, point, first, promised: Promise | None, state: int) -> dict[str, Any]:
    """What became of a promise."""
    nothing = {"bound": np.nan, "tightness": np.nan, "promise": "", "why": ""}
    if promised is None or not np.all(np.isfinite(promised.bound)) or state < 0:
        return nothing
    squares = _squares(result, names, point)
    mean, error = np.mean(squares, 0), np.std(squares, axis=0, ddof=1) / np.sqrt(len(squares))
    most = promised.bound**2
    over = mean - SURE * error > most * (1 + 1e-9)
    under = promised.exact & (mean + SURE * error < most * (1 - 1e-9))
    verdict = "broken" if np.any(over | under) else "exact" if promised.exact else "kept"
    unit = np.sqrt(np.mean(_squares(result, names, first)[:, state]))
    return {
        "bound": float(promised.bound[state] / unit),
        "tightness": float(np.max(np.sqrt(mean) / promised.bound)),
        "promise": verdict, "why": promised.why,
    }  # fmt: skip


def _detection(result: xr.Dataset, names, point, without) -> dict[str, float]:
    summary = _at(result, names, point)["summary"]

    def of(score: str, statistic: str, at=summary) -> float:
        return float(at.sel(score=score, statistic=statistic))

    missed = [of("missed_share", s) for s in ("mean", "high", "low")]
    alarms = dict(
        zip(("alarms", "alarms_low", "alarms_high"), (1 - m for m in missed), strict=True)
    )
    quiet = _at(result, names, without)["summary"]
    return alarms | {
        "delay": of("detection_delay", "q50"),
        "false_alarms": of("false_alarm_rate", "mean", quiet),
        "not_converged": of("not_converged_share", "mean"),
    }


def _cost_lost(result: xr.Dataset, names, point, without) -> float:
    if "control_cost" not in result:
        return np.nan
    cost, quiet = (_at(result, names, p)["control_cost"].values for p in (point, without))
    return float(np.mean(cost - quiet) / np.mean(quiet))
