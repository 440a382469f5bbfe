"""What `holdfast reach` and `holdfast policy` say: JSON and sentences."""

from typing import Any

import numpy as np

from holdfast.analysis.wording import listed
from holdfast.reach.bounds import Reach
from holdfast.reach.forever import Forever
from holdfast.reach.policy import Policy
from holdfast.reach.setting import Setting


def reach_content(setting: Setting, found: Reach, ever: Forever | None, gamma: float) -> dict:
    """The fields of ``reach --json``."""
    system = setting.system
    return {
        "k": found.k.tolist(),
        "alpha": found.alpha.tolist(),
        "norm": found.norm.tolist(),
        "shape": (found.shape + gamma * system.P).tolist(),
        "horizon": found.horizon.tolist(),
        "kind": "exact" if np.all(found.exact) else "outer",
        "lower": found.lower.tolist(),
        "exact": found.exact.tolist(),
        "bounded": None if ever is None else ever.bounded,
        "radius": None if ever is None else ever.radius,
        "reason": None if ever is None else ever.reason,
        "states": list(system.states),
        "compromised": [system.outputs[i] for i in np.flatnonzero(setting.compromised)],
        "detector": setting.stealth.detector,
        "epsilon": setting.stealth.epsilon,
        "level": setting.stealth.level,
        "aware": setting.aware,
    }


def reach_sentences(setting: Setting, found: Reach, ever: Forever | None) -> list[str]:
    """What the numbers mean."""
    who = listed([f'"{setting.system.outputs[i]}"' for i in np.flatnonzero(setting.compromised)])
    top = int(np.argmax(found.norm))
    first = found.k[top]
    said = [
        f"Whoever alters {who} and raises the alarm rate of the {setting.stealth.detector} test by "
        f"{setting.stealth.epsilon:g} at most moves the expected estimate by up to "
        f"{found.norm[top]:.4g} within {len(found.k)} steps (at step {first})."
    ]
    gap = np.max(found.norm / np.where(found.lower > 0, found.lower, np.inf), initial=0.0)
    if not np.all(found.exact) and gap > 1.0:
        said.append(
            f"The bounds are at most {100 * (gap - 1):.2g} % above an attack that was found."
        )
    if ever is None:
        return said
    if ever.bounded is False and ever.radius >= 1 - 1e-7:
        said.append(f"Without limit as time goes on: {ever.reason}.")
    elif ever.kept is not None:
        said.append("Bounded for ever: a set of errors is kept from period to period.")
    elif ever.reason is not None:
        said.append(f"Nothing is said of all time: {ever.reason}.")
    return said


def policy_content(
    setting: Setting, best: Policy, curve: list[Policy], per_sensor: bool
) -> dict[str, Any]:
    """The fields of ``policy --json``; every, for and first are null where sensors differ."""
    names = setting.system.outputs
    held = best.enforcement
    rows = {} if held is None else _rows(held, names)
    alike = {tuple(row.values()) for row in rows.values()} if len(rows) == len(names) else set()
    every, duration, first = next(iter(alike)) if len(alike) == 1 else (None, None, None)
    return {
        "every": every,
        "for": 0 if held is None else duration,
        "first": first,
        **({"per_sensor": rows} if per_sensor else {}),
        "share": best.share,
        "cost": best.cost,
        "worst": best.worst,
        "limit": best.limit,
        "steps": best.steps,
        "proof": best.proof,
        "tried": best.tried,
        **({"trade_off": [_point(one) for one in curve]} if curve else {}),
        "compromised": [names[i] for i in np.flatnonzero(setting.compromised)],
        "detector": setting.stealth.detector,
        "epsilon": setting.stealth.epsilon,
        "level": setting.stealth.level,
    }


def _rows(held, names: tuple[str, ...]) -> dict[str, dict[str, int]]:
    return {
        name: {
            "every": int(held.every[i]), "for": int(held.duration[i]), "first": int(held.first[i]),
        }
        for i, name in enumerate(names)
        if held.duration[i] > 0
    }  # fmt: skip


def _point(one: Policy) -> dict[str, float | int | None]:
    held = one.enforcement
    return {
        "every": None if held is None else int(np.max(held.every)),
        "for": None if held is None else int(np.max(held.duration)),
        "share": one.share,
        "cost": one.cost,
        "worst": one.worst,
    }


def policy_sentences(setting: Setting, best: Policy, per_sensor: bool) -> list[str]:
    """The policy in words, and as flags of `reach`."""
    span = "for ever" if best.proof == "period" else f"over {best.steps} steps"
    if best.enforcement is None:
        return [
            f"Nothing need be authenticated: unseen, the error stays under {best.worst:.4g} {span} "
            f"(limit {best.limit:g})."
        ]
    rows = _rows(best.enforcement, setting.system.outputs)
    flags = [f"every={r['every']},for={r['for']},first={r['first']}" for r in rows.values()]
    if len(set(flags)) == 1 and len(rows) == len(setting.system.outputs):
        text = f"--enforce {flags[0]}"
    else:
        text = " ".join(f"--enforce {n}:{f}" for n, f in zip(rows, flags, strict=True))
    return [
        f"{text}",
        f"{100 * best.share:.3g} % of all messages are authenticated; a stealthy attacker's "
        f"expected error stays under {best.worst:.4g} {span} (limit {best.limit:g}; "
        f"{best.tried} policies looked at).",
    ]
