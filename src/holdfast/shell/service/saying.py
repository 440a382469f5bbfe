"""Rows and events as JSON objects, with the columns of a result."""

import json
import math
from typing import Any

from holdfast.records import Reason, Status
from holdfast.shell.service.records import Event, Labels, Row

_NOT_READY = int(Status.NOT_READY)
_REASONS = {int(reason): reason.words for reason in Reason}


def row_object(row: Row, labels: Labels) -> dict[str, Any]:
    """A row: null where there is nothing to tell (not ready, undetermined, nothing to test)."""
    # looking up a record's attributes one by one is slow
    estimate, verdict = vars(row.estimate), vars(row.verdict)
    status = int(estimate["status"])
    found: dict[str, Any] = {"frame": row.frame, "time": row.time}
    _quantities(
        found, "x", labels.states, estimate["x"], estimate["x_cov"], bool(status & _NOT_READY)
    )
    _quantities(found, "d", labels.attacks, estimate["d"], estimate["d_cov"], False)
    statistic, threshold = float(verdict["statistic"]), float(verdict["threshold"])
    tested = math.isfinite(threshold) and math.isfinite(statistic)
    found["statistic"] = statistic if tested else None
    found["threshold"] = threshold if tested else None
    found["alarm"] = int(verdict["alarm"])
    found["reason"] = _REASONS[int(verdict["reason"])]
    found["status"] = Status(status).words
    found["mode"] = row.mode
    for name, state in zip(labels.outputs, row.sensors, strict=True):
        found[f"sensor:{name}"] = state
    return found


def _quantities(
    found: dict[str, Any], prefix: str, names: tuple[str, ...], values: Any, cov: Any, empty: bool
) -> None:
    spread = [math.sqrt(max(variance, 0.0)) for variance in cov.diagonal().tolist()]
    for name, value, sd in zip(names, values.tolist(), spread, strict=True):
        known = not empty and math.isfinite(sd)
        # a state that is not determined still has a value; an attack has not
        shown = known or (prefix == "x" and not empty)
        found[f"{prefix}:{name}"] = value if shown and math.isfinite(value) else None
        found[f"{prefix}_sd:{name}"] = sd if known else None


def event_object(event: Event) -> dict[str, Any]:
    """An event; null for numbers that there are none of."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in event._asdict().items()
    }


def dumps(value: dict[str, Any]) -> bytes:
    """Compact JSON. Raises `ValueError` for NaN or infinity, which JSON has no word for."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()
