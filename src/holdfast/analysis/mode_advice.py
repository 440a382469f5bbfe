"""How far a bank of modes can be reduced, and what that costs, in sentences."""

from holdfast.analysis.modes import Position, Reduction
from holdfast.analysis.wording import listed

NONE = "none"
"""The name of the mode in which no channel is attacked."""


def mode_name(found: Reduction, channels: tuple[int, ...], position: Position) -> str:
    """Names joined by +, after the position where there are several."""
    name = "+".join(found.attacks[i] for i in channels) or NONE
    return f"{position.name}: {name}" if len(found.positions) > 1 else name


def on_modes(found: Reduction) -> list[str]:
    """What is enough, what no mode can have, what looks alike, and what the tests must tell."""
    if found.reason is not None:
        return [f"How far the bank of modes can be reduced cannot be said: {found.reason}."]
    said = [_on_kept(found)]
    for position in _different(found):
        at = "" if len(_different(found)) == 1 else f" at {position.name}"
        for refused in position.refused:
            names = "+".join(found.attacks[i] for i in refused.channels)
            what = f"have {names} attacked" if names else "be tracked, not even without attack"
            said.append(f"No mode{at} can {what}: {refused.reason}.")
        for i, j in position.confusable:
            one, other = (mode_name(found, position.kept[k].channels, position) for k in (i, j))
            said.append(f"An attack in {one} can look for ever like one in {other}.")
    if found.kept < found.all and any(k.channels for p in found.positions for k in p.kept):
        said.append(
            "Which channels of a mode are attacked is then told by z-tests on its estimates, "
            "not by how probable the mode is."
        )
    if found.note:
        said.append(f"The reduction holds for {found.note}.")
    return said


def _on_kept(found: Reduction) -> str:
    different = _different(found)
    same = len(different) == 1 and len(found.positions) > 1
    names = [
        mode_name(found if not same else found._replace(positions=different), k.channels, position)
        for position in different
        for k in position.kept
    ]
    if not names:
        return f"Of {found.all} modes none can be kept."
    each = f", at each of {len(found.positions)} positions" if same else ""
    are = "is" if found.kept == 1 else "are"
    return f"Of {found.all} modes, {found.kept} {are} enough: {listed(names)}{each}."


def _different(found: Reduction) -> tuple[Position, ...]:
    """The positions; only the first where what is said of all is the same."""
    alike = {(tuple(k.channels for k in p.kept), p.refused, p.confusable) for p in found.positions}
    return found.positions[:1] if len(alike) == 1 else found.positions
