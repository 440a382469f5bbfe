"""What `holdfast analyse` shows of the decoders of a window: JSON and a table."""

from typing import Any

import numpy as np
import rich.table

from holdfast.analysis.correctable import Correctable
from holdfast.analysis.remedies import Decoding, Remedy
from holdfast.analysis.windows import Bound
from holdfast.analysis.wording import between

KNOWN = 1e-5
"""Relative distance of two bounds that are given as one number."""


def decoding_content(found: Decoding, states: tuple[str, ...]) -> dict[str, Any]:
    """The field ``correctable`` of the JSON."""
    which = found.correctable
    plans: dict[str, dict[str, Any]] = {"l0": {}, "l1": {}}
    for plan in found.plans:
        plans[plan.decoder][plan.way] = {"names": list(plan.names), "enough": plan.enough}
    return {
        **_corrected(which),
        "exposed": [
            {"sensors": list(one.sensors), "state": named(one.direction, states)}
            for one in found.exposed
        ],
        "trusted": _mended(found.trusted),
        "measured": _mended(found.measured),
        "remedies": plans,
        "reason": which.reason,
    }


def _corrected(found: Correctable) -> dict[str, Any]:
    said = found.reason is None
    each = {"l0": found.l0, "l1": found.l1, "any": found.any}
    whole = {"cospark": found.cospark, "relaxed": found.relaxed}
    by_window = {f"{name}_window": i for i, name in enumerate(("theorem_1", "sharper", "exact"))}
    fixed = None
    if found.fixed is not None:
        l0, l1 = found.fixed_l0, found.fixed_l1
        bounds = {"l1_lower": l1.lower, "l1_upper": l1.upper}
        fixed = {"l0": l0, "l1": l1.exact, **bounds, **_ratios(*found.fixed[2:])}
    return {
        "window": found.window,
        **{name: bound.exact if said else None for name, bound in each.items()},
        "lower": _ends(each, 0) if said else None,
        "upper": _ends(each, 1) if said else None,
        "most": found.most,
        "observed": found.observed,
        **_ratios(found.lower, found.upper),
        "fixed": fixed,
        **{name: bound.exact if said else None for name, bound in whole.items()},
        "window_bounds": {"lower": _ends(whole, 0), "upper": _ends(whole, 1)} if said else None,
        "supports": None if found.supports is None else list(found.supports),
        **{
            name: {str(q): small[i] for q, small in enumerate(found.smallest, 1)}
            for name, i in by_window.items()
        },
    }


def _ends(bounds: dict[str, Bound], end: int) -> dict[str, int]:
    return {name: bound[end] for name, bound in bounds.items()}


def _ratios(lower: np.ndarray, upper: np.ndarray) -> dict[str, Any]:
    low, high = ({str(q): x for q, x in enumerate(v.tolist(), 1)} for v in (lower, upper))
    return {
        "l1_ratio": {q: ratio(low[q], high[q]) for q in low},
        "l1_ratio_bounds": {"lower": finite(low), "upper": finite(high)},
    }


def _mended(found: tuple[Remedy, ...]) -> dict[str, dict[str, int | None]]:
    return {one.name: {"l0": one.l0, "l1": one.l1} for one in found}


def named(vector: np.ndarray, names: tuple[str, ...]) -> dict[str, float]:
    """A direction by the names of its entries."""
    return {name: float(value) for name, value in zip(names, vector, strict=True)}


def ratio(lower: float, upper: float) -> float | None:
    """The number between two bounds, None where they are apart or infinite."""
    return lower if upper < np.inf and upper - lower <= KNOWN * upper else None


def finite(values: dict[str, float]) -> dict[str, float | None]:
    """Without infinities: None instead."""
    return {name: value if np.isfinite(value) else None for name, value in values.items()}


def decoders_table(found: Correctable) -> rich.table.Table:
    """What each decoder corrects."""
    table = rich.table.Table(box=None, pad_edge=False)
    headings = ("decoder", "corrects, hopping", "at the same sensors", "worst ratio for 1, 2, ..")
    for heading in headings:
        table.add_column(heading)
    fixed = "-" if found.fixed_l0 is None else str(found.fixed_l0)
    ends = zip(found.lower.tolist(), found.upper.tolist(), strict=True)
    ratios = ", ".join(between(lower, upper) for lower, upper in ends)
    table.add_row("any", _range(found.any), fixed, "")
    table.add_row("l0", _range(found.l0), fixed, "")
    table.add_row("l1", _range(found.l1), _range(found.fixed_l1), ratios)
    return table


def _range(bound: Bound) -> str:
    return str(bound.lower) if bound.exact is not None else f"{bound.lower} to {bound.upper}"
