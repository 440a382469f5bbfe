"""What the decoders of a window correct, in sentences."""

from collections.abc import Iterable

from holdfast.analysis.correctable import Correctable
from holdfast.analysis.remedies import Decoder, Decoding, Exposed, Plan, Way
from holdfast.analysis.windows import Bound
from holdfast.analysis.wording import SHOWN, between, combination, listed

NAMES: dict[Decoder, str] = {"l0": "l0", "l1": "the l1 decoder"}
DOING: dict[Way, str] = {"authenticate": "Authenticate {}", "measure": "Measure {} as well"}
DONE: dict[Way, str] = {"authenticate": "authenticated", "measure": "added"}


def on_decoding(found: Decoding, states: Iterable[str]) -> list[str]:
    """What the decoders correct, what nobody can, and what to add or to authenticate."""
    which = found.correctable
    if which.reason is not None:
        return [f"What the decoders correct cannot be said: {which.reason}."]
    if not which.observed:
        said = [f"A window of {which.window} does not determine the state: nothing is corrected."]
    else:
        said = [_on_attacks(which)]
    return said + _on_exposed(found.exposed, tuple(states)) + _on_plans(found.plans)


def _on_attacks(found: Correctable) -> str:
    """Of the form: l0 corrects 1 attack per step from T = 9; the l1 decoder .. 0."""
    first = [small.exact for small in found.smallest]
    at = max(1, found.l0.lower)
    since = first[at - 1] if at <= len(first) else None
    text = f"With a window of {found.window}, l0 corrects {_attacks(found.l0)} per step"
    if since is not None and found.l0.lower:
        text += f", from T = {since}"
    elif since is not None and not found.l0.upper:
        text += f" (1 from T = {since})"
    q = min(found.l1.upper + 1, found.most)
    ratio = between(float(found.lower[q - 1]), float(found.upper[q - 1]))
    if found.l1.exact is None:
        sure = f"certain to correct {found.l1.lower}, and no more than {found.l1.upper}"
    else:
        sure = f"certain to correct {found.l1.lower}"
    return f"{text}; the l1 decoder is {sure} (worst ratio for {q}: {ratio})."


def _attacks(count: Bound) -> str:
    if count.exact is None:
        return f"{count.lower} to {count.upper} attacks"
    return f"{count.lower} attack{'s' if count.lower != 1 else ''}"


def _on_exposed(found: tuple[Exposed, ...], states: tuple[str, ...]) -> list[str]:
    said, groups = [], dict.fromkeys(one.sensors for one in found)
    for sensors in groups:
        seen = [combination(one.direction, states) for one in found if one.sensors == sensors]
        verb = "is" if len(seen) == 1 else "are"
        if len(sensors) == 1:
            said.append(
                f'{listed(seen)} {verb} seen by one sensor only, "{sensors[0]}": an attack on it '
                "cannot be corrected by any decoder."
            )
        else:
            said.append(
                f'{listed(seen)} {verb} seen by two sensors only, "{sensors[0]}" and '
                f'"{sensors[1]}": which of them is attacked cannot be told by any decoder.'
            )
    more = len(said) - 2 * SHOWN
    return said[: 2 * SHOWN] + ([f"The like holds {more} times more."] if more > 0 else [])


def _on_plans(plans: tuple[Plan, ...]) -> list[str]:
    alike: dict[tuple, list[Plan]] = {}
    for plan in sorted(plans, key=lambda plan: plan.way):
        alike.setdefault(plan[1:], []).append(plan)
    return [_on_plan(same[0], [NAMES[plan.decoder] for plan in same]) for same in alike.values()]


def _on_plan(plan: Plan, decoders: list[str]) -> str:
    whom, verb = listed(decoders), "corrects" if len(decoders) == 1 else "correct"
    doing = DOING[plan.way].format(_counted(plan.names)) if plan.names else ""
    if plan.enough:
        return f"{doing} and {whom} {verb} 1 attack per step."
    if plan.names:
        return f"{doing}: a beginning, but more is needed before {whom} {verb} 1 attack per step."
    if plan.untried:
        return f"Which sensor, {DONE[plan.way]}, would help {whom} was too dear to find out."
    return f"No single sensor, {DONE[plan.way]}, helps {whom}."


def _counted(names: tuple[str, ...]) -> str:
    times = {name: names.count(name) for name in names}
    return listed(
        [f'"{name}"' + (f" ({count} times)" if count > 1 else "") for name, count in times.items()]
    )
