"""What the scores say, in sentences."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

MINUS, DASH = "\N{MINUS SIGN}", "\N{EN DASH}"
NBSP = "\N{NO-BREAK SPACE}"
"""Between a number and its unit, which a line break must not part."""


class Verdict(NamedTuple):
    """``level``: "attack", "missed", "alarm" or "quiet"; one sentence, and what to add to it."""

    level: str
    sentence: str
    more: tuple[str, ...]


def verdict(scores: Mapping[str, Any], units: Mapping[str, str]) -> Verdict:
    """The verdict at the top of a report, from `holdfast.report.tables.summary`."""
    more = [] if scores["tested"]["value"] else ["Nothing could be tested at any row."]
    right = modes(scores)
    more += [right] if right else []
    if scores["runs"] > 1:
        return _over_runs(scores, more)
    run, dt = scores["per_run"][0], scores["dt_s"]
    if scores["attack"] is None:
        return _without_attack(scores, run["episodes"], units, more)
    begin = seconds(scores["attack"]["start_s"], dt)
    before = run["episodes_before"]
    quiet_s = seconds(max(0.0, scores["attack"]["start_s"] - scores["begin_s"]), dt)
    if before:
        more.append(f"{count(before, 'false-alarm episode')} in the {quiet_s} before the attack.")
    else:
        more.append(f"No false alarm in the {quiet_s} before the attack.")
    found = run["detection"]
    if found is None:
        stop = scores["attack"]["stop_s"]
        until = "to the end" if stop is None else f"to {seconds(stop, dt)}"
        sentence = f"The attack from {begin} {until} raised no alarm."
        return Verdict("missed", sentence, tuple(more))
    delay = "at once" if run["delay_s"] == 0 else f"{seconds(run['delay_s'], dt)} after it began"
    at = seconds(found["begin_s"], dt)
    if found["channel_kind"] == "attack":
        sentence = f"Alarm at {at}: attack on {found['channel']}, {delay}"
        sentence += f"; estimated size {size(found, units)}." if "estimate" in found else "."
    else:
        began = delay.replace("it began", "the attack began")
        sentence = f"Alarm at {at}, {began}: {reason(found)}."
    return Verdict("attack", sentence, tuple(more))


def _over_runs(scores: Mapping[str, Any], more: list[str]) -> Verdict:
    runs, alarms = scores["runs"], sum(bool(run["episodes"]) for run in scores["per_run"])
    if scores["detection"] is None:
        kind = "false alarm" if scores["simulated"] else "alarm"
        sentence = f"{alarms} of {runs} runs had {article(kind)}."
        return Verdict("alarm" if alarms else "quiet", sentence, tuple(more))
    found = scores["detection"]["runs"]
    sentence = f"The attack raised an alarm in {found['hits']} of {runs} runs"
    median = scores["detection"]["median_delay_s"]
    if median is not None:
        sentence += f", in half of them all within {seconds(median, scores['dt_s'])}"
    more.append(
        f"Chance of an alarm: {percent(found['value'])} "
        f"({percent(found['low'])} to {percent(found['high'])} with 95 % confidence)."
    )
    level = "attack" if found["hits"] else "missed"
    return Verdict(level, sentence + ".", tuple(more))


def _without_attack(scores, episodes, units, more) -> Verdict:
    dt = scores["dt_s"]
    length = seconds(scores["end_s"] - scores["begin_s"] + dt, dt)
    if not episodes:
        return Verdict("quiet", f"No alarm in {length} ({scores['rows']} rows).", tuple(more))
    first = episodes[0]
    if scores["simulated"]:
        sentence = f"{count(len(episodes), 'false-alarm episode')} in {length} without attack."
        return Verdict("alarm", sentence, tuple(more))
    sentence = f"Alarm at {seconds(first['begin_s'], dt)}: {reason(first)}"
    if "estimate" in first:
        sentence += f"; estimated size {size(first, units)}"
    if len(episodes) > 1:
        more.append(f"{len(episodes)} alarm episodes in {length}.")
    return Verdict("alarm", sentence + ".", tuple(more))


def modes(scores: Mapping[str, Any]) -> str | None:
    """How often the mode believed in was the true one; None where that is not known."""
    found = scores["modes"]
    if found is None or found["accuracy"] is None or not found["accuracy"]["of"]:
        return None
    right, rows = found["accuracy"], count(found["accuracy"]["of"], "row")
    said = f"The mode believed in was the true one in {percent(right['value'])} of {rows}"
    unlisted = found["unlisted"]["hits"]
    return f"{said}; in {unlisted} more no mode told apart was true." if unlisted else f"{said}."


def reason(episode: Mapping[str, Any]) -> str:
    """The reason of an alarm with the channel it points at."""
    words, channel = episode["words"] or "no reason given", episode["channel"]
    if channel is None:
        return words
    named = episode["reason"].endswith("_CHANNEL")
    return f"{words} {channel}" if named else f"{words}, most at {channel}"


def size(episode: Mapping[str, Any], units: Mapping[str, str]) -> str:
    """An attack estimate with twice its standard deviation, and its unit."""
    unit = units.get(episode["channel"], "")
    if episode.get("estimate") is None or episode.get("estimate_sd") is None:
        return "not determined"
    found = within(episode["estimate"], 2 * episode["estimate_sd"])
    return f"{found}{NBSP}{unit}" if unit else found


def within(value: float, half: float) -> str:
    """The text "value ± half", both to the second digit of half."""
    if not half > 0:
        return number(value)
    places = 1 - math.floor(math.log10(half))
    if -4 < places < 7:
        shown = (f"{round(v, places):.{max(0, places)}f}" for v in (value, half))
    else:
        shown = f"{value:.3g}", f"{half:.2g}"
    return f"{NBSP}±{NBSP}".join(shown).replace("-", MINUS)


def seconds(value: float | None, dt: float) -> str:
    """A time with as many decimals as the sample time gives it."""
    if value is None:
        return "never"
    places = min(6, max(0, math.ceil(-math.log10(dt) - 1e-9)))
    return f"{value:.{places}f}{NBSP}s".replace("-", MINUS)


def number(value: float | None) -> str:
    """Three significant digits; a dash for what is not known."""
    if value is None or not math.isfinite(value):
        return DASH
    text = f"{value:.3g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa}e{int(exponent)}"
    return text.replace("-", MINUS)


def percent(value: float | None) -> str:
    """A share in percent."""
    if value is None:
        return DASH
    return f"{100 * value:.3g}{NBSP}%"


def count(n: int, thing: str) -> str:
    """The number with its noun, in the plural where it takes one."""
    return f"{n} {thing}" if n == 1 else f"{n} {thing}s"


def article(noun: str) -> str:
    """The noun with a or an."""
    return f"an {noun}" if noun[0] in "aeiou" else f"a {noun}"
