"""Everything a run gave, as one dataset with named dimensions."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from holdfast import __version__
from holdfast.records import Reason, Status, Trace
from holdfast.report.truth import Modes, Named, true_attack, true_mode

GONE, MISSING, FAULTY = 3, 1, 2
"""What became of a sample: it did not arrive, it was NaN or infinite, or one of the two."""

_ATTACK_REASONS = tuple(r for r in Reason if r.name.startswith("ATTACK"))


def channel_names(trace: Trace, plant: Named) -> tuple[str, ...]:
    """What the entries of ``verdict.channel_alarms`` stand for: attack channels or outputs."""
    count = trace.verdict.channel_alarms.shape[-1]
    attacks = plant.attacks if trace.estimate.d.shape[-1] else ()
    reasons = np.unique(np.asarray(trace.verdict.reason))
    on_attack = not np.any(reasons) or np.any(np.isin(reasons, _ATTACK_REASONS))
    fits = [names for names in (attacks, plant.outputs) if len(names) == count]
    if len(fits) == 2:
        return fits[0] if on_attack else fits[1]
    return fits[0] if fits else tuple(str(i + 1) for i in range(count))


def dataset(
    trace: Trace,
    plant: Named,
    time: ArrayLike,
    *,
    units: Mapping[str, str] | None = None,
    modes: Modes | None = None,
) -> xr.Dataset:
    """Everything a run gave, with named dimensions; a leading axis of the trace is ``run``.

    Dimensions: (run,) time, state, input, output, attack, channel; a covariance's second
    axis is the name with ``_``. What the data do not determine is NaN with an infinite
    covariance; what was not tested has a NaN ``statistic``. ``units``: name of a state,
    input, output or attack -> unit. ``true_*`` and ``injected_*`` only if simulated.

    Of an estimator that weighs modes: ``p`` over ``bank``, the modes that have a filter;
    ``mode`` and ``true_mode``, numbers of entries of ``named``, the modes told apart, the true
    one -1 where it is none of them and only if ``modes`` says what they are.
    ``injected_switch`` is a number of an entry of ``position``.

    It goes to NetCDF with ``to_netcdf(path, engine="h5netcdf")`` and comes back the same.
    """
    estimate, verdict, seen_by = trace.estimate, trace.verdict, trace.observation
    lead = ("run", "time") if np.ndim(verdict.alarm) == 2 else ("time",)
    seen = np.asarray(seen_by.seen, bool) & np.isfinite(np.asarray(seen_by.y))
    status = np.asarray(estimate.status, np.int32)
    not_ready = (status & int(Status.NOT_READY)) != 0
    tested = np.isfinite(np.asarray(verdict.threshold))
    variables: dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, Any]]] = {}

    def put(name, dims, values, text, **more):
        values = np.asarray(values)
        variables[name] = ((*lead, *dims), values, {"long_name": text, **more})

    put("x", ("state",), np.where(not_ready[..., None], np.nan, estimate.x), "state estimate")
    put("x_cov", ("state", "state_"), estimate.x_cov, "error covariance of x")
    if estimate.d.shape[-1]:
        axes = ("attack", "attack_")
        for name, text in (("d", "attack estimate"), ("d_free", "attack estimate, unprojected")):
            value, cov = getattr(estimate, name), np.asarray(getattr(estimate, f"{name}_cov"))
            put(name, axes[:1], _where_finite(value, cov), text)
            put(f"{name}_cov", axes, cov, f"error covariance of {name}; inf = not determined")
    if estimate.a is not None:
        put("sensor_attack", ("output",), estimate.a, "what a suspected sensor's sample is off by")
    residual_cov = np.asarray(estimate.residual_cov)
    put("residual", ("output",), _where_information(estimate.residual, residual_cov),
        "innovation; NaN where the output carried no information")  # fmt: skip
    put("residual_cov", ("output", "output_"), residual_cov, "covariance of the innovation")
    put("statistic", (), np.where(tested, verdict.statistic, np.nan),
        "detector's statistic; NaN where there was nothing to test")  # fmt: skip
    put("threshold", (), verdict.threshold, "alarm above it; inf = nothing to test")
    put("alarm", (), np.asarray(verdict.alarm, bool), "alarm")
    if verdict.channel_alarms.shape[-1]:
        put("alarm_channel", ("channel",), np.asarray(verdict.channel_alarms, bool),
            "alarm of one channel")  # fmt: skip
    put("reason", (), np.asarray(verdict.reason, np.int32), "reason of the alarm",
        flag_values=np.array([int(r) for r in Reason], np.int32),
        flag_meanings=" ".join(r.name for r in Reason),
        words="; ".join(f"{r.name}: {r.words}" for r in Reason if r.words))  # fmt: skip
    put("status", (), status, "what happened at the row; 0 = OK",
        flag_masks=np.array([int(s) for s in Status if s], np.int32),
        flag_meanings=" ".join(str(s.name) for s in Status if s))  # fmt: skip
    put("u", ("input",), seen_by.u, "commanded input over the interval that ends at the row")
    put("y", ("output",), np.where(seen, seen_by.y, np.nan), "measurement; NaN where unusable")
    put("seen", ("output",), seen, "sample arrived and was a finite number")
    put("sample", ("output",), sample_quality(trace), "what became of the sample",
        flag_values=np.array([0, MISSING, FAULTY, GONE], np.int8),
        flag_meanings="used missing faulty missing_or_faulty")  # fmt: skip
    put("trusted", ("output",), np.asarray(seen_by.trusted, bool), "sample was authenticated")
    if trace.x is not None:
        put("true_x", ("state",), trace.x, "true state")
    if trace.injection is not None:
        put("injected_u", ("input",), trace.injection.u, "injected into the actuators at the row")
        put("injected_y", ("output",), trace.injection.y, "injected into the sensors at the row")
        put("injected_d", ("attack",), trace.injection.d, "injected into the channels at the row")
        if trace.injection.switch is not None:
            put("injected_switch", (), trace.injection.switch,
                "where the switches stand after the row: a number of position")  # fmt: skip
    truth = true_attack(trace, plant)
    if truth is not None:
        put("true_d", ("attack",), truth,
            "whole injection in terms of the attack channels, at the time that d of the row "
            "refers to; NaN where no combination of channels equals it")  # fmt: skip
    if estimate.p is not None:
        put("p", ("bank",), estimate.p, "probability of each mode of the bank")
    if estimate.mode is not None:
        put("mode", (), estimate.mode, "the mode believed in: a number of named")
        real = None if modes is None else true_mode(trace, truth, modes)
        if real is not None:
            put("true_mode", (), real, "the true mode: a number of named, -1 for none of them")
    return xr.Dataset(
        variables, _coordinates(trace, plant, time, lead, units or {}), _attributes(plant)
    )


def _where_finite(value: ArrayLike, cov: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(np.diagonal(cov, axis1=-2, axis2=-1)), value, np.nan)


def _where_information(value: ArrayLike, cov: np.ndarray) -> np.ndarray:
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    return np.where((variance > 0) & np.isfinite(variance), value, np.nan)


def _coordinates(
    trace: Trace, plant: Named, time: ArrayLike, lead: tuple[str, ...], units: Mapping[str, str]
) -> dict[str, Any]:
    found: dict[str, Any] = {"time": ("time", np.asarray(time, float), {"long_name": "time in s"})}
    if "run" in lead:
        found["run"] = ("run", np.arange(trace.verdict.alarm.shape[0]), {"long_name": "run"})
    kinds = {"state": plant.states, "input": plant.inputs, "output": plant.outputs}
    if trace.estimate.d.shape[-1] or trace.injection is not None:
        kinds["attack"] = plant.attacks
    if trace.verdict.channel_alarms.shape[-1]:
        kinds["channel"] = channel_names(trace, plant)
    if trace.injection is not None and trace.injection.switch is not None:
        kinds["position"] = plant.positions
    kinds |= {"bank": trace.modes} if trace.estimate.p is not None else {}
    kinds |= {"named": trace.named} if trace.estimate.mode is not None else {}
    for kind, names in kinds.items():
        # a fixed-width array of no names cannot be written
        labels = np.array(names, dtype=object if not names else None)
        given = {name: units[name] for name in names if name in units}
        attributes = {"units_of": "; ".join(f"{k}: {v}" for k, v in given.items())}
        found[kind] = (kind, labels, attributes if given else {})
        if kind in ("state", "output", "attack"):
            found[f"{kind}_"] = (f"{kind}_", labels)
    return found


def _attributes(plant: Named) -> dict[str, Any]:
    return {
        "Conventions": "CF-1.11",
        "source": f"holdfast {__version__}",
        "holdfast_version": __version__,
        "dt": float(plant.dt),
    }


def sample_quality(trace: Trace) -> np.ndarray:
    """Per sample: 0 used, `MISSING`, `FAULTY`, or `GONE` where the row has both kinds.

    A screened log keeps only the row's status, so which of two lost samples was the faulty
    one is not known there.
    """
    y, seen = np.asarray(trace.observation.y), np.asarray(trace.observation.seen, bool)
    status = np.asarray(trace.estimate.status)
    missing = (status & int(Status.MISSING)) != 0
    faulty = (status & int(Status.BAD_INPUT)) != 0
    kind = np.where(faulty, np.where(missing, GONE, FAULTY), MISSING)[..., None]
    found = np.where(seen, 0, kind)
    return np.where(seen & ~np.isfinite(y), FAULTY, found).astype(np.int8)
