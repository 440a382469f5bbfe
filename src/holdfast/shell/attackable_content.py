"""What `holdfast analyse` shows of stealthy attackers: who is meant, JSON and a table."""

from typing import Any

import rich.table

from holdfast.analysis.attackable import LONGEST, Attackable, Case
from holdfast.analysis.attackable_advice import mode_text
from holdfast.analysis.whole import Analysis
from holdfast.shell.decoding_content import named
from holdfast.shell.errors import InputError, one_of, shown

ALL = "all"
FLAG = "--compromised"


def compromised_outputs(text: str | None, outputs: tuple[str, ...]) -> tuple[int, ...] | None:
    """The outputs that ``--compromised`` names, in its order; None where it was not given."""
    if text is None:
        return None
    if text.strip() == ALL:
        return tuple(range(len(outputs)))
    found: list[int] = []
    for name in (part.strip() for part in text.split(",")):
        if name not in outputs:
            said = shown(name) if name else f"an empty name in {shown(text)}"
            raise InputError(
                FLAG,
                "",
                said,
                f"{ALL} by itself, or names with commas between: {one_of(outputs, name)}",
            )
        if outputs.index(name) in found:
            raise InputError(FLAG, "", f"{shown(name)} twice", "every output once")
        found.append(outputs.index(name))
    return tuple(found)


def attackable_content(found: Analysis) -> dict[str, bool | None]:
    """The field ``attackable``: null where there is no steady-state gain."""
    return {name: case.attackable for name, case in _cases(found.attackable).items()}


def attackable_how(found: Analysis) -> dict[str, Any]:
    """The field ``attackable_how``: along what, and what bounds it."""
    stealth, cases = found.attackable, _cases(found.attackable)
    duration = stealth.duration
    return {
        "radius": {name: case.radius for name, case in cases.items()},
        "modes": {
            name: [
                {
                    "z": [mode.z.real, mode.z.imag],
                    "multiplicity": mode.multiplicity,
                    "directions": [named(v, found.model.states) for v in mode.directions.T],
                }
                for mode in case.modes
            ]
            for name, case in cases.items()
        },
        "theorem_4": stealth.theorem_4,
        "corollary_2": {name: case.corollary_2 for name, case in cases.items()},
        "smallest": None
        if duration is None
        else {
            "longest": LONGEST,
            "usual": duration.usual,
            "others": {str(every): f for every, f in duration.others.items()},
        },
        "shields": list(stealth.shields),
        "reason": stealth.reason,
    }


def attackable_table(found: Attackable) -> rich.table.Table:
    """Whom an attacker alters, and which modes he then moves without limit."""
    table = rich.table.Table(box=None, pad_edge=False)
    for heading in ("altered", "stealthy error", "modes"):
        table.add_column(heading)
    for name, case in _cases(found).items():
        zs = [
            mode_text(mode.z) + (f" ({mode.multiplicity} times)" if mode.multiplicity > 1 else "")
            for mode in case.modes
        ]
        table.add_row(name, "without limit" if case.attackable else "bounded", ", ".join(zs))
    return table


def _cases(found: Attackable) -> dict[str, Case]:
    """By name: each sensor alone, those asked for, and all together."""
    cases = {case.names[0]: case for case in found.each}
    if found.given is not None:
        cases[",".join(found.given.names)] = found.given
    return cases | {ALL: found.all}
