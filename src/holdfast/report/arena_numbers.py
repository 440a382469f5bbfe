"""What came of the arena in numbers: promises, failures, and who is best.

The cases have the columns of `holdfast.shell.arena_cases.cases_of`, also as read from a CSV file.
"""

import math
from collections import Counter
from collections.abc import Iterable
from statistics import median
from typing import Any, NamedTuple

import pandas as pd

ESTIMATORS, DETECTORS = "estimators", "detectors"
"""The studies whose cases compete with each other: for the error, and for the alarms."""
BASELINES = "Kalman", "extended Kalman", "gated Kalman", "Huber", "IMM", "unscented"
"""Estimators that are not our own."""

_TEXT = ["ground", "study", "attack", "estimator", "detector", "truth", "promise"]
_NUMBERS = ["error", "error_low", "error_high", "tightness", "alarms", "alarms_low",
            "alarms_high", "false_alarms"]  # fmt: skip


class Win(NamedTuple):
    """Who is best against an attack: first the one with the best value, then all that overlap it.

    ``lost_to``: the baseline that beats all of our own beyond the intervals, "" where none does;
    ``own``: the best of our own.
    """

    ground: str
    study: str
    attack: str
    best: tuple[str, ...]
    value: float
    failed: tuple[str, ...]
    lost_to: str
    lost_value: float
    own: str
    own_value: float


def records(cases: pd.DataFrame) -> list[dict[str, Any]]:
    """The cases one by one, with "" for text that a file gave back as missing."""
    found: Any = cases.copy()
    for name in _TEXT:
        found[name] = found[name].astype(object).where(found[name].notna(), "").astype(str)
    for name in _NUMBERS:
        found[name] = pd.to_numeric(found[name], errors="coerce")
    return found.to_dict("records")


def grouped(
    cases: Iterable[dict[str, Any]], *names: str
) -> dict[tuple[str, ...], list[dict[str, Any]]]:
    """The cases that agree in these columns, in the order of their first coming."""
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for case in cases:
        groups.setdefault(tuple(case[name] for name in names), []).append(case)
    return groups


def name_of(case: dict[str, Any]) -> str:
    """The estimator of a case, with its detector where that was varied."""
    return " / ".join(name for name in (case["estimator"], case["detector"]) if name)


def summary(cases: pd.DataFrame) -> dict[str, Any]:
    """How many cases, promises and failures; how tight bounds are; the range of false alarms.

    ``tightness_*`` are of promises that are bounds, ``false_alarms_*`` without attack and
    mismatch; NaN (``false_alarms_worst``: "") where there are none.
    """
    found = records(cases)
    # nobody attacks at the first value of the axis
    quiet = {
        study: group[0]["attack"] for study, group in grouped(found, "ground", "study").items()
    }
    attacked = [case for case in found if case["attack"] != quiet[case["ground"], case["study"]]]
    promised = [case for case in attacked if case["promise"]]
    others = [case for case in attacked if not case["promise"]]
    promises = Counter(case["promise"] for case in found if case["promise"])
    tight = [case["tightness"] for case in found if case["promise"] == "kept"]
    return {
        "cases": len(found), "promised": promises.total(),
        **{kind: promises[kind] for kind in ("exact", "kept", "broken")},
        "attacked": len(attacked), "attacked_promised": len(promised),
        "failed_promised": sum(bool(case["failed"]) for case in promised),
        "failed_unpromised": sum(bool(case["failed"]) for case in others),
        "sound_unpromised": sum(not case["failed"] for case in others),
        "tightness_median": median(tight) if tight else math.nan,
        "tightness_least": min(tight, default=math.nan),
        "tightness_most": max(tight, default=math.nan),
    } | _false_alarms(found)  # fmt: skip


def _false_alarms(found: list[dict[str, Any]]) -> dict[str, Any]:
    """The range of what is the same for all attacks on an estimator and detector."""
    known = [c for c in found if not c["truth"] and math.isfinite(c["false_alarms"])]
    rates = [case["false_alarms"] for case in known]
    worst = max(known, key=lambda case: case["false_alarms"], default=None)
    return {
        "false_alarms_least": min(rates, default=math.nan),
        "false_alarms_most": max(rates, default=math.nan),
        "false_alarms_worst": "" if worst is None else f"{name_of(worst)} on {worst['ground']}",
    }


def winners(cases: pd.DataFrame) -> list[Win]:
    """Who is best against each attack, and where our own lose to a baseline.

    Of `ESTIMATORS` the least error counts, of `DETECTORS` the largest share of alarms; the pairs
    with a baseline estimator are the baselines there. Attacks without any value are left out.
    """
    found = records(cases)
    competing = [case for case in found if case["study"] in (ESTIMATORS, DETECTORS)]
    wins = []
    for (ground, study, attack), rows in grouped(competing, "ground", "study", "attack").items():
        best = leaders(rows, study)
        if best:
            wins.append(_win(ground, study, attack, rows, best))
    return wins


def _win(ground: str, study: str, attack: str, rows: list[dict[str, Any]], best) -> Win:
    column = "alarms" if study == DETECTORS else "error"
    own = [row for row in rows if row["estimator"] not in BASELINES]
    known = [row for row in own if math.isfinite(row[column])]
    leader = min(known, key=lambda row: _span(row, study)[0], default=None)
    rivals = leaders([row for row in rows if row["estimator"] in BASELINES], study)
    lost = ""
    if own and rivals:
        reach = _span(rivals[0], study)[2]
        lost = name_of(rivals[0]) if all(_span(row, study)[1] > reach for row in own) else ""
    failed = () if study == DETECTORS else tuple(name_of(row) for row in rows if row["failed"])
    return Win(
        ground, study, attack, tuple(map(name_of, best)), best[0][column], failed,
        lost, rivals[0][column] if lost else math.nan,
        "" if leader is None else name_of(leader), math.nan if leader is None else leader[column],
    )  # fmt: skip


def _span(case: dict[str, Any], study: str) -> tuple[float, float, float]:
    """The value with its interval, so that less is better; infinite where there is none."""
    if study == DETECTORS:
        value, low, high = -case["alarms"], -case["alarms_high"], -case["alarms_low"]
    else:
        value, low, high = case["error"], case["error_low"], case["error_high"]
    if not math.isfinite(value):
        return math.inf, math.inf, math.inf
    return value, (value if math.isnan(low) else low), (value if math.isnan(high) else high)


def leaders(rows: list[dict[str, Any]], study: str) -> list[dict[str, Any]]:
    """The best case, then those whose interval overlaps its own, in their order.

    Who failed is not beside who did not: an error that one run of many makes has an interval
    that overlaps everything.
    """
    known = [row for row in rows if math.isfinite(_span(row, study)[0])]
    if not known:
        return []
    best = min(known, key=lambda row: _span(row, study)[0])
    reach = _span(best, study)[2]
    near = [row for row in known if row is not best and _span(row, study)[1] <= reach]
    if study != DETECTORS and not best["failed"]:
        near = [row for row in near if not row["failed"]]
    return [best, *near]


def number(value: float, digits: int = 2) -> str:
    """So many significant digits, without exponent below 100,000."""
    if math.isnan(value) or math.isinf(value):
        return "-" if math.isnan(value) else "inf"
    rounded = float(f"{value:.{digits}g}")
    power = math.floor(math.log10(abs(rounded))) if rounded else 0
    if -5 < power < 5:
        return f"{rounded:.{max(0, digits - 1 - power)}f}" if rounded else "0"
    mantissa, exponent = f"{rounded:.{digits - 1}e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"
