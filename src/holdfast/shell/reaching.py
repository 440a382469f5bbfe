"""`holdfast reach` and `holdfast policy`: what a stealthy attacker attains, and what bounds it."""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rich.console
import rich.table

from holdfast.detectors.windowed import Windowed
from holdfast.numerics.stealth import Stealth
from holdfast.parts import InvalidValue
from holdfast.plants.watched import watched
from holdfast.reach.bounds import Reach, reach
from holdfast.reach.forever import Forever, forever
from holdfast.reach.policy import Policy, policy, trade_off
from holdfast.reach.setting import Setting
from holdfast.report.tables import json_safe
from holdfast.shell import runtime
from holdfast.shell.attackable_content import compromised_outputs
from holdfast.shell.calibrating import busy
from holdfast.shell.enforcing import enforcement_flags
from holdfast.shell.errors import InputError, one_of, shown
from holdfast.shell.matrices import matrix
from holdfast.shell.reach_content import (
    policy_content,
    policy_sentences,
    reach_content,
    reach_sentences,
)
from holdfast.shell.scenario import ScenarioFile, read_scenario
from holdfast.shell.writing import FILES, check_place, write_figures, write_text

LINES = 14
"""Rows of the table that a person reads."""


class Asked(NamedTuple):
    """The flags that `reach` and `policy` share, as given."""

    compromised: str | None
    detector: str
    epsilon: float
    level: float | None
    length: int | None
    functional: str | None
    unaware: bool
    as_json: bool
    output: str | None
    allow_python: bool


def run_reach(
    scenario: str, asked: Asked, enforce: list[str], steps: int, gamma: float, tight: bool
) -> None:
    """Print the largest error at every step, or its JSON; pictures to a folder."""
    found, setting = _setting(scenario, asked, enforce)
    if not (math.isfinite(gamma) and gamma >= 0):
        raise InputError("--gamma", "", str(gamma), "a number from 0 up")
    with busy("what a stealthy attacker reaches"):
        reached = _told(lambda: reach(setting, steps, tight), found.path)
        ever = None if tight else _told(lambda: forever(setting), found.path)
    content = reach_content(setting, reached, ever, gamma)
    text = json.dumps(json_safe(content), allow_nan=False)
    if asked.output is not None:
        _write(asked.output, "reach", text, _reach_figure(reached))
    if asked.as_json:
        print(text)
        return
    _print_reach(setting, reached, ever)


def run_policy(
    scenario: str,
    asked: Asked,
    limit: float,
    steps: int | None,
    per_sensor: bool,
    cost: str | None,
) -> None:
    """Print the rarest policy, or its JSON; the trade-off to a folder."""
    found, setting = _setting(scenario, asked, [])
    costs = _costs(cost, found.scenario.plant.outputs)
    with busy("searching the rarest policy"):
        best = _told(lambda: policy(setting, limit, steps, costs, per_sensor), found.path)
        curve = []
        if asked.output is not None:
            curve = _told(lambda: trade_off(setting, best, steps, costs), found.path)
    content = policy_content(setting, best, curve, per_sensor)
    text = json.dumps(json_safe(content), allow_nan=False)
    if asked.output is not None:
        _write(asked.output, "policy", text, _policy_figure(best, curve))
    if asked.as_json:
        print(text)
        return
    console = rich.console.Console()
    for sentence in policy_sentences(setting, best, per_sensor):
        console.print(sentence, markup=False, highlight=False, soft_wrap=True)


def _told(work, file: str) -> Any:
    """What the core refuses, as a message about the file or the flag."""
    try:
        return work()
    except InvalidValue as error:
        key = error.key
        place = (f"--{key}", "") if key in ("steps", "limit", "cost") else (file, f"plant.{key}")
        raise InputError(*place, str(error.found), error.expected) from None


def _setting(scenario: str, asked: Asked, enforce: list[str]) -> tuple[ScenarioFile, Setting]:
    runtime.configure()
    if asked.output is not None:
        if Path(asked.output).suffix.lower() in FILES:
            raise InputError(asked.output, "", "the name of a file", "a folder for the figures")
        check_place(asked.output)
    found = read_scenario(scenario, allow_python=asked.allow_python)
    plant = found.scenario.plant
    if asked.compromised is None:
        expected = "all, or the outputs that the attacker alters: A,B"
        raise InputError("--compromised", "", "nothing", expected)
    hit = np.zeros(len(plant.outputs), bool)
    hit[list(compromised_outputs(asked.compromised, plant.outputs) or ())] = True
    enforcement = found.scenario.enforcement
    if enforce:
        enforcement = enforcement_flags(enforce, plant.outputs)
    system = _told(lambda: watched(plant), found.path)
    functional = _functional(asked.functional, plant.states)
    stealth = _stealth(asked, found)
    return found, Setting(system, stealth, hit, enforcement, functional, not asked.unaware)


def _stealth(asked: Asked, found: ScenarioFile) -> Stealth:
    detector = found.scenario.monitor.detector
    level = float(getattr(detector, "level", 0.01)) if asked.level is None else asked.level
    if not 0.0 < level < 1.0:
        raise InputError("--level", "", str(level), "a probability between 0 and 1")
    room = 1.0 - level
    if not 0.0 < asked.epsilon < room:
        expected = f"a probability between 0 and 1 - level ({room:g})"
        raise InputError("--epsilon", "", str(asked.epsilon), expected)
    if asked.detector == "sprt" and asked.epsilon >= 0.5:
        # of sums as long as can be, half raise the alarm by themselves
        raise InputError("--epsilon", "", str(asked.epsilon), "a probability under 0.5 with sprt")
    weights = (1.0,) * 10
    if asked.length is not None:
        weights = (1.0,) * asked.length
    elif isinstance(detector, Windowed):
        weights = tuple(float(c) for c in np.asarray(detector.weights))
    p = len(found.scenario.plant.outputs)
    return Stealth(asked.detector, asked.epsilon, level, p, weights)


def _functional(file: str | None, states: tuple[str, ...]) -> np.ndarray:
    if file is None:
        return np.eye(len(states))
    if Path(file).suffix.lower() != ".csv":
        raise InputError("--functional", "", shown(file), "a .csv file with a matrix")
    rows = matrix({"file": str(Path(file).absolute())}, file, "--functional", Path())
    if rows.ndim != 2 or rows.shape[1] != len(states) or not np.all(np.isfinite(rows)):
        size = " x ".join(map(str, rows.shape))
        expected = f"finite numbers in {len(states)} columns, one per state"
        raise InputError(file, "", f"a matrix of {size}", expected)
    return rows


def _costs(text: str | None, outputs: tuple[str, ...]) -> list[float] | None:
    """``NAME=3,NAME=1``: what a message of each output costs, 1 where it is not named."""
    if text is None:
        return None
    found: dict[str, float] = {}
    for part in text.split(","):
        name, _, value = (piece.strip() for piece in part.partition("="))
        if name not in outputs:
            raise InputError("--cost", "", shown(name), one_of(outputs, name))
        if name in found:
            raise InputError("--cost", "", f"{shown(name)} twice", "every output once")
        try:
            found[name] = float(value)
        except ValueError:
            expected = "NAME=NUMBER with commas between"
            raise InputError("--cost", "", shown(part), expected) from None
    return [found.get(name, 1.0) for name in outputs]


def _write(folder: str, name: str, text: str, figure: Any) -> None:
    write_figures(folder, {name: figure})
    write_text(Path(folder) / f"{name}.json", text + "\n")


def _reach_figure(found: Reach) -> Any:
    from holdfast.report.paper_figures import Panel, against

    lines = {"no more than": found.norm}
    if not np.all(found.exact):
        lines["an attack reaches"] = found.lower
    return against(found.k, [Panel("largest expected error of a stealthy attacker", lines)], "step")


def _policy_figure(best: Policy, curve: list[Policy]) -> Any:
    from holdfast.report.paper_figures import Panel, against

    ordered = sorted(curve, key=lambda one: one.share)
    shares = 100.0 * np.array([one.share for one in ordered])
    lines = {
        "largest expected error": np.array([one.worst for one in ordered]),
        "threshold": np.full(len(ordered), best.limit),
    }
    title = "error that a stealthy attacker reaches"
    return against(shares, [Panel(title, lines)], "authenticated messages (%)")


def _print_reach(setting: Setting, found: Reach, ever: Forever | None) -> None:
    console = rich.console.Console()
    table = rich.table.Table(box=None, pad_edge=False)
    outer = not np.all(found.exact)
    for heading in ("step", "no more than", *["an attack reaches"] * outer, "stealthy until"):
        table.add_column(heading, justify="right")
    count = len(found.k)
    rows = np.unique(np.rint(np.linspace(0, count - 1, min(count, LINES))).astype(int))
    for i in np.union1d(rows, [int(np.argmax(found.norm))]):
        lower = [f"{found.lower[i]:.4g}"] * outer
        table.add_row(str(found.k[i]), f"{found.norm[i]:.4g}", *lower, str(found.horizon[i]))
    console.print(table)
    for sentence in reach_sentences(setting, found, ever):
        console.print(f"- {sentence}", markup=False, highlight=False, soft_wrap=True)
