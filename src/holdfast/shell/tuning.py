"""`holdfast tune`: settings for a stated objective, by runs of a study."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import rich.console
import rich.table
from pydantic import Field

from holdfast.campaign.aggregate import STATISTICS, aggregated
from holdfast.campaign.blocks import BLOCK
from holdfast.campaign.tune import Judged, Span, Trial, tuned
from holdfast.report.tables import json_safe
from holdfast.shell import runtime
from holdfast.shell.errors import InputError, one_of, shown
from holdfast.shell.executors import Local, Task
from holdfast.shell.points import Prepared, prepare
from holdfast.shell.progress import progress
from holdfast.shell.schema import Strict, Table
from holdfast.shell.study import Axis, Study, check_name, read_study, value_at
from holdfast.shell.writing import check_place, unwritable, write_text

BENIGN = "none"
"""Label of a point without attack."""


class TuneSettings(Strict):
    """The table [tune]."""

    objective: str = Field(description="a score, such as state_rmse:NAME")
    goal: Literal["minimise", "maximise"] = Field(
        "minimise", description="one of 'minimise', 'maximise'"
    )
    over: Literal["worst", "mean"] = Field("worst", description="one of 'worst', 'mean'")
    benign_loss: float | None = Field(None, ge=0, description="a share from 0 up, such as 0.05")
    limits: dict[str, float] = Field({}, description="scores with the largest mean allowed")
    evaluations: int = Field(60, ge=1, le=10**5, description="a whole number from 1 up")


class Plan(NamedTuple):
    """A study, what is tuned in it between which bounds, and the objective."""

    study: Study
    names: tuple[str, ...]
    spans: tuple[Span, ...]
    settings: TuneSettings


def tune(path: str, output: str | None, allow_python: bool) -> None:
    """Search the settings; print the best and write what was tried."""
    runtime.configure()
    if output is not None:
        check_place(output)
    plan = _read(path)
    start = prepare(plan.study, allow_python)
    reference = _Scores(start)
    loss = _reference(plan, reference)
    current = _current(plan)

    def judge(settings: tuple[float | int, ...]) -> Judged:
        prepared = prepare(_with(plan, settings), allow_python)
        return _judged(plan, _Scores(prepared), loss)

    with progress("settings tried", plan.settings.evaluations) as advance:
        trials = tuned(
            plan.spans, judge, evaluations=plan.settings.evaluations,
            seed=plan.study.settings.seed, first=current, told=lambda trial: advance(1),
        )  # fmt: skip
    _print(plan, trials, current)
    if output is not None:
        _write(plan, trials, output)


def _read(path: str) -> Plan:
    """The plan of a file: a study with [tune] and [settings]. Raises `InputError`."""
    study = read_study(path)
    settings: Any = Table(path, "tune", study.tables.tune, study.folder).checked(TuneSettings)
    wanted = study.tables.settings
    if not wanted:
        raise InputError(path, "settings", "nothing", 'a setting: "estimator.gamma" = [0.1, 60]')
    names, spans = tuple(wanted), tuple(_span(path, *pair) for pair in wanted.items())
    common = study.settings.model_copy(update={"common_noise": True})
    return Plan(dataclasses.replace(study, settings=common), names, spans, settings)


def _span(file: str, name: str, value: Any) -> Span:
    key = f'settings."{name}"'
    check_name(file, key, name)
    pair = isinstance(value, list) and len(value) == 2
    if not pair or any(isinstance(v, bool) or not isinstance(v, int | float) for v in value):
        raise InputError(file, key, shown(value), "the lowest and the highest value: [0.1, 60]")
    low, high = value
    if not low < high or not math.isfinite(high - low):
        raise InputError(file, key, shown(value), "two finite numbers, the lower one first")
    whole = isinstance(low, int) and isinstance(high, int)
    return Span(low, high, whole, log=low > 0 and high / low >= 20)


def _with(plan: Plan, settings: tuple[float | int, ...]) -> Study:
    """The study with these settings at all points; their names are no part of the noise."""
    axes = tuple(
        Axis(name, (value,), (float(value),))
        for name, value in zip(plan.names, settings, strict=True)
    )
    return dataclasses.replace(plan.study, axes=(*axes, *plan.study.axes))


def _current(plan: Plan) -> tuple[float | int, ...] | None:
    """The settings in the scenario itself, where it has all of them as numbers."""
    found = [value_at(plan.study.content, name) for name in plan.names]
    if any(isinstance(v, bool) or not isinstance(v, int | float) for v in found):
        return None
    return tuple(found)


class _Scores:
    """Means of every score at every point."""

    def __init__(self, prepared: Prepared):
        self.study = prepared.study
        runs = prepared.study.settings.runs
        blocks = math.ceil(runs / BLOCK)
        tasks = [Task(i, 0, blocks) for i in range(len(prepared.cases))]
        self.by_point: list[dict[str, float]] = [{} for _ in tasks]
        for task, found in Local(prepared, runtime.cores()).run(tasks):
            plant = prepared.cases[task.point].scenario.plant
            names = {"state": plant.states, "attack": plant.attacks}
            joined = {
                name: np.concatenate([block.scores[name] for block in found])
                for name in found[0].scores
            }
            means = aggregated(joined, names)
            where = STATISTICS.index("mean")
            self.by_point[task.point] = {k: float(v[where]) for k, v in means.items()}

    def __getitem__(self, score: str) -> np.ndarray:
        known = {name for found in self.by_point for name in found}
        if score not in known:
            raise InputError(self.study.path, "tune", shown(score), one_of(sorted(known), score))
        return np.array([found.get(score, np.nan) for found in self.by_point])

    @property
    def benign(self) -> np.ndarray:
        """Which points have no attack."""
        contents = (self.study.content_of(point)[0] for point in self.study.points)
        return np.array([not content.get("attack") for content in contents])


def _reference(plan: Plan, found: _Scores) -> float | None:
    """The objective without attack that ``benign_loss`` is a loss of: that of the study's own
    estimator with the settings it has.
    """
    values = found[plan.settings.objective]
    for score in plan.settings.limits:
        found[score]
    if plan.settings.benign_loss is None:
        return None
    if not np.any(found.benign):
        raise InputError(
            plan.study.path, "tune.benign_loss", "no point without attack",
            'one: an axis "attack" with [] among its values',
        )  # fmt: skip
    if plan.settings.goal == "maximise":
        raise InputError(
            plan.study.path, "tune.benign_loss", "an objective to maximise", "one to minimise"
        )
    return float(np.max(values[found.benign]))


def _judged(plan: Plan, found: _Scores, reference: float | None) -> Judged:
    settings = plan.settings
    sign = 1.0 if settings.goal == "minimise" else -1.0
    values = sign * found[settings.objective]
    broken = 0.0
    attacked = ~found.benign if np.any(~found.benign) else found.benign
    if reference is not None:
        allowed = (1.0 + (settings.benign_loss or 0.0)) * reference
        broken += max(0.0, float(np.max(values[found.benign])) / allowed - 1.0)
    for score, most in settings.limits.items():
        worst = float(np.nanmax(found[score]))
        broken += max(0.0, (worst - most) / max(abs(most), 1e-12))
    objective = np.max(values[attacked]) if settings.over == "worst" else np.mean(values[attacked])
    return Judged(float(objective), broken)


def _print(plan: Plan, trials: list[Trial], current: tuple[float | int, ...] | None) -> None:
    sign = 1.0 if plan.settings.goal == "minimise" else -1.0
    table = rich.table.Table("", *plan.names, plan.settings.objective, "limits", box=None)
    shown_trials = [("best", trials[0]), *[("", trial) for trial in trials[1:5]]]
    shown_trials += [("now", t) for t in trials if t.settings == current]
    for word, trial in shown_trials:
        numbers = (f"{v:.6g}" for v in (*trial.settings, sign * trial.judged.objective))
        kept = "kept" if trial.judged.broken == 0 else f"broken by {trial.judged.broken:.2g}"
        table.add_row(word, *numbers, kept)
    console = rich.console.Console()
    if not console.is_terminal:
        console.width = 160
    console.print(table)
    if trials[0].judged.broken > 0:
        console.print("No settings tried keep the limits.")


def _write(plan: Plan, trials: list[Trial], output: str) -> None:
    """``settings.toml``, lines to paste into the scenario, and all trials."""
    folder = Path(output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(folder, error) from None
    best = zip(plan.names, trials[0].settings, strict=True)
    write_text(folder / "settings.toml", "".join(f"{name} = {value!r}\n" for name, value in best))
    sign = 1.0 if plan.settings.goal == "minimise" else -1.0
    rows = [
        {
            "settings": dict(zip(plan.names, trial.settings, strict=True)),
            "objective": sign * trial.judged.objective,
            "broken": trial.judged.broken,
        }
        for trial in trials
    ]
    text = json.dumps(
        json_safe({"objective": plan.settings.model_dump(), "trials": rows}), indent=1
    )
    write_text(folder / "tune.json", text + "\n")
