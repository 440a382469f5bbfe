"""What `holdfast analyse` shows of a bank of modes: JSON and a table."""

from typing import Any

import rich.table

from holdfast.analysis.mode_advice import mode_name
from holdfast.analysis.modes import Reduction

MOST = 12
"""Attack channels up to which the sets are listed."""
STEPS = 50
"""Steps of a plant with per-step matrices that are looked at."""


def modes_content(found: Reduction) -> dict[str, Any]:
    """The field ``modes``: null what is not known, with a reason."""
    known = found.reason is None
    kept, refused, confusable = [], [], []
    for position in found.positions:
        for k in position.kept:
            kept.append(_named(found, position.name, k.channels) | {"samples": k.samples})
        for r in position.refused:
            refused.append(_named(found, position.name, r.channels) | {"reason": r.reason})
        for pair in position.confusable:
            names = [mode_name(found, position.kept[k].channels, position) for k in pair]
            confusable.append(names)
    return {
        "all": found.all,
        "kept": kept if known else None,
        "refused": refused if known else None,
        "confusable": confusable if known else None,
        "local": bool(found.note),
        "reason": found.reason,
    }


def _named(found: Reduction, position: str, channels: tuple[int, ...]) -> dict[str, Any]:
    return {"position": position, "attacks": [found.attacks[i] for i in channels]}


def modes_table(found: Reduction) -> rich.table.Table:
    """The modes that are enough, and how many samples each needs to forget where it started."""
    table = rich.table.Table(box=None, pad_edge=False)
    for heading in ("mode", "determined from"):
        table.add_column(heading)
    for position in found.positions:
        for k in position.kept:
            rows = f"{k.samples} row{'s' if k.samples > 1 else ''}"
            table.add_row(mode_name(found, k.channels, position), rows)
    return table
