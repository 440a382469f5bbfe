"""The rarest authentication that keeps a stealthy attacker's error under a limit."""

import math
from collections.abc import Sequence

import numpy as np

from holdfast.parts import InvalidValue
from holdfast.reach.search import Policy, Search, cost_of
from holdfast.reach.setting import Setting
from holdfast.records import Enforcement

SCALES = (0.3, 0.5, 0.7, 0.85, 1.0, 1.25, 1.6, 2.0, 3.0)
"""Of a policy's distances, for the trade-off."""


def policy(
    setting: Setting,
    limit: float,
    steps: int | None = None,
    costs: Sequence[float] | None = None,
    per_sensor: bool = False,
) -> Policy:
    """The policy of least cost with |functional E e_k| <= ``limit`` at every k (<= ``steps``).

    All outputs together, ``for`` steps in a row every ``every``, the first block at ``every``;
    ``for`` up to the smaller of observability index and unstable modes (Theorem 4). With
    ``per_sensor`` also each output its own: which of them, staggered, at distances of their own.
    ``costs`` (p,): of an authenticated message of each output, 1 unless given. The setting's own
    enforcement is not looked at.

    Raises `InvalidValue` for a limit or a cost that is none.

    Source: INTEGRITY, Algorithm 1, with a stopping rule that is a proof.
    """
    p = len(setting.compromised)
    price = np.ones(p) if costs is None else np.asarray(costs, float)
    if price.shape != (p,) or not np.all(np.isfinite(price)) or np.any(price <= 0):
        raise InvalidValue("cost", costs, f"{p} positive numbers, one per output")
    if not (math.isfinite(limit) and limit > 0):
        raise InvalidValue("limit", limit, "a positive number")
    search = Search(setting, limit, steps, price)
    free = search.reached(None)
    if free.value <= limit:
        return search.found(None, free)
    best = search.together(1)
    for duration in search.durations()[1:]:
        best = search.rarer(best, duration)
    if per_sensor:
        best = min(best, search.apart(best), key=cost_of)
    return best._replace(tried=len(search.known))


def trade_off(
    setting: Setting, best: Policy, steps: int | None, costs: Sequence[float] | None = None
) -> list[Policy]:
    """Error against share: the policy's distances between blocks scaled down and up."""
    held = best.enforcement
    if held is None:
        return [best]
    p = len(setting.compromised)
    price = np.ones(p) if costs is None else np.asarray(costs, float)
    search = Search(setting, math.inf, steps, price)
    found, seen = [], set()
    for scale in SCALES:
        every = np.rint(scale * np.asarray(held.every))
        every = np.maximum(np.maximum(held.duration, 1), every).astype(int)
        if tuple(every) in seen:
            continue
        seen.add(tuple(every))
        first = np.maximum(1, np.rint(scale * np.asarray(held.first))).astype(int)
        made = Enforcement.of(every, held.duration, first)
        reached = search.reached(made)
        if math.isfinite(reached.value):
            found.append(search.found(made, reached)._replace(limit=best.limit))
    return found
