"""What a stealthy attacker of sensors can do to the Kalman filter, in sentences."""

from collections.abc import Iterable

import numpy as np

from holdfast.analysis.attackable import LONGEST, Attackable, Case, Duration
from holdfast.analysis.wording import SHOWN, combination, either, joined, listed, steps

MANY = 6
"""States that a direction in words mixes at most."""


def on_attackable(found: Attackable, states: Iterable[str]) -> list[str]:
    """Who can move the error without limit and along what, and what prevents it."""
    if found.reason is not None:
        return [f"What a stealthy attacker can do to the filter cannot be said: {found.reason}."]
    if not found.all.attackable:
        return [
            "No stealthy attacker can move the estimate without limit, whichever sensors he "
            "alters: the plant has no unstable mode."
        ]
    states = tuple(states)
    if found.given is None:
        return _on_all(found, states) + _on_remedies(found)
    if found.given.attackable:
        return [_moves(found.given, states, len(found.each)), *_on_remedies(found)]
    rest = "the other sensors show every unstable mode"
    return [
        f"A stealthy attacker who alters {_quoted(found.given)} can move the estimate by a "
        f"bounded amount only: {rest}."
    ]


def _on_all(found: Attackable, states: tuple[str, ...]) -> list[str]:
    """Of single sensors, and of all together if that is more."""
    alone = [case for case in found.each if case.attackable]
    said = [_moves(case, states, len(found.each)) for case in alone[:SHOWN]]
    more = len(alone) - SHOWN
    if more > 0:
        said.append(f"The like holds of {more} more sensor{'s' * (more > 1)} altered alone.")
    if not alone:
        said.append("No single sensor, altered, lets the estimate be moved without limit.")
    if len(found.each) > 1:
        said.append(_moves(found.all, states, len(found.each)))
    return said


def _moves(case: Case, states: tuple[str, ...], sensors: int) -> str:
    vectors = [v for mode in case.modes for v in mode.directions.T]
    if max(np.count_nonzero(np.abs(v) > 1e-6 * np.max(np.abs(v))) for v in vectors) > MANY:
        along = f"{len(vectors)} direction{'s' * (len(vectors) > 1)} of the state"
    else:
        along = listed(combination(v, states) for v in vectors)
    zs = [mode_text(mode.z) for mode in case.modes]
    who = "all sensors" if len(case.names) == sensors > 1 else _quoted(case)
    return (
        f"A stealthy attacker who alters {who} can move the estimate along "
        f"{along} without limit (mode{'s' * (len(zs) > 1)} {listed(zs)})."
    )


def mode_text(z: complex) -> str:
    """An eigenvalue, of a pair both."""
    return f"{z.real:.4g}" if z.imag == 0 else f"{z.real:.4g} +- {z.imag:.4g}i"


def _quoted(case: Case) -> str:
    return listed(f'"{name}"' for name in case.names)


def _on_remedies(found: Attackable) -> list[str]:
    which = found.all if found.given is None else found.given
    whom = "all sensors" if found.given is None else _quoted(found.given)
    said = [_on_duration(found.duration, whom, which.corollary_2 or 0)]
    if found.given is None and found.shields and len(found.each) > 1:
        said.append(f"Authenticating {either(found.shields)} alone, always, bounds it as well.")
    said.append(
        "An attacker who does not know which steps are authenticated cannot do it even so: any "
        "step could expose him."
    )
    return said


def _on_duration(found: Duration | None, whom: str, enough: int) -> str:
    count = enough if found is None else found.usual
    row = " in a row" if count > 1 else ""
    text = f"Authenticating {whom} for {steps(count)}{row} in every L bounds this"
    if found is None:
        return f"{text}, for any L."
    if not found.others:
        return f"{text}, for any L up to {LONGEST}."
    unusual = [str(every) for every in found.others]
    most = max(found.others.values())
    if most > found.usual:
        return f"{text}, but not for L = {joined(unusual, 'or')}: there it takes {_up_to(found)}."
    return f"{text}; for L = {joined(unusual, 'or')} {_up_to(found)} will do."


def _up_to(found: Duration) -> str:
    values = sorted(set(found.others.values()))
    return steps(values[0]) if len(values) == 1 else f"{values[0]} to {values[-1]} steps"
