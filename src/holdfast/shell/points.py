"""The points of a study, built and calibrated: what a worker runs."""

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import equinox as eqx
from jaxtyping import PRNGKeyArray

from holdfast.campaign.blocks import Case, case_of, point_key
from holdfast.campaign.calibrate import content_key, with_value
from holdfast.campaign.choice import structure_of, together
from holdfast.loop import Scenario
from holdfast.parts import Plant
from holdfast.plants.linear import LinearPlant
from holdfast.shell import runtime
from holdfast.shell.calibrating import calibrated_scenario
from holdfast.shell.errors import InputError
from holdfast.shell.scenario import ScenarioFile, build_scenario
from holdfast.shell.study import Study

COMMON = "common noise"
"""What every point is called where all have the same noise."""


@dataclass(frozen=True)
class Prepared:
    """A study ready to run: a case, a key and a calibration per point.

    ``values``: what calibration gave each detector, None where it needs none; a worker that
    builds the study again takes them instead of calibrating.
    """

    study: Study
    cases: tuple[Case, ...]
    keys: tuple[PRNGKeyArray, ...]
    values: tuple[float | None, ...]
    programs: int


def prepare(
    study: Study,
    allow_python: bool,
    values: Sequence[float | None] | None = None,
    advance: Callable[[], None] = lambda: None,
) -> Prepared:
    """Build every point; ``values``: of a calibration made before. Raises `InputError`."""
    plants: dict[str, Plant] = {}
    built: list[tuple[ScenarioFile, Scenario]] = []
    steps = []
    for point in study.points:
        try:
            built.append(_built(study, point, allow_python, plants))
        except InputError as error:
            raise _at_point(study, point, error) from None
        found, scenario = built[-1]
        steps.append(study.settings.steps or found.run.steps)
        _check_steps(study, scenario, steps[-1])
    if values is None:
        values = _calibrations(study, [found for found, _ in built], advance)
    scenarios = [_with(scenario, v) for (_, scenario), v in zip(built, values, strict=True)]
    scenarios, programs = _grouped(scenarios)
    drawn = study.settings.start == "drawn"
    cases = tuple(case_of(s, n, drawn) for s, n in zip(scenarios, steps, strict=True))
    common = study.settings.common_noise
    names = [COMMON if common else study.name_of(point) for point in study.points]
    keys = tuple(point_key(study.settings.seed, name) for name in names)
    return Prepared(study, cases, keys, tuple(values), programs)


def _built(
    study: Study, point: tuple[int, ...], allow_python: bool, plants: dict[str, Plant]
) -> tuple[ScenarioFile, Scenario]:
    """The scenario of a point, as its file would be, and as it is in truth."""
    content, truth = study.content_of(point)
    # points that share a plant share its functions, and so the compiled program
    name = _named(content["plant"])
    found = build_scenario(
        study.scenario_path, study.scenario_source, content, allow_python, plants.get(name)
    )
    plants.setdefault(name, found.scenario.plant)
    if truth is None:
        return found, found.scenario
    changed = content | {"plant": truth}
    name = _named(changed["plant"])
    if name not in plants:
        built = build_scenario(study.scenario_path, study.scenario_source, changed, allow_python)
        plants[name] = built.scenario.plant
    plant = plants[name]
    ours = found.scenario.plant
    for kind in ("states", "inputs", "outputs", "attacks", "dt"):
        if getattr(plant, kind) != getattr(ours, kind):
            raise InputError(
                study.path, "axes", f"a true plant with other {kind}", f"the same {kind}"
            )
    scenario = found.scenario
    parts = scenario.monitor, scenario.controller, scenario.attacks, scenario.enforcement
    return found, Scenario(plant, scenario.x0, *parts)


def _named(plant: dict[str, Any]) -> str:
    return json.dumps({k: v for k, v in plant.items() if k != "x0"}, sort_keys=True, default=repr)


def _calibrations(
    study: Study, found: list[ScenarioFile], advance: Callable[[], None]
) -> list[float | None]:
    """What calibration gives the detector of every point; the same monitor is calibrated once,
    and several at a time: compiled code runs without Python's lock.
    """
    parts = [(f.scenario.monitor, f.scenario.controller) for f in found]
    names = [
        content_key(p, (str(f.threshold), str(f.calibrate)))
        for p, f in zip(parts, found, strict=True)
    ]
    pool = ThreadPoolExecutor(runtime.cores())
    try:
        at_work = {}
        for name, scenario in zip(names, found, strict=True):
            if name not in at_work:
                at_work[name] = pool.submit(calibrated_scenario, scenario, alone=False)
        values = []
        for point, name in zip(study.points, names, strict=True):
            try:
                how = at_work[name].result()[1]
            except InputError as error:
                raise _at_point(study, point, error) from None
            values.append(how.value if how.method in ("simulated", "log") else None)
            advance()
    finally:
        # an error or an interrupt does not wait for what has not begun
        pool.shutdown(wait=False, cancel_futures=True)
    return values


def _with(scenario: Scenario, value: float | None) -> Scenario:
    if value is None:
        return scenario
    monitor = with_value(scenario.monitor, value)
    return eqx.tree_at(lambda s: s.monitor, scenario, monitor)


def _grouped(scenarios: list[Scenario]) -> tuple[list[Scenario], int]:
    """The scenarios with attacks chosen by number where the rest shares a program; how many
    programs there are.
    """
    groups: dict[tuple, list[int]] = {}
    for number, scenario in enumerate(scenarios):
        without = eqx.tree_at(lambda s: s.attacks, scenario, ())
        groups.setdefault(structure_of(without), []).append(number)
    found = list(scenarios)
    for numbers in groups.values():
        merged = together([scenarios[i] for i in numbers])
        for i, scenario in zip(numbers, merged, strict=True):
            found[i] = scenario
    return found, len(groups)


def _check_steps(study: Study, scenario: Scenario, steps: int) -> None:
    plant = scenario.plant
    most = plant.steps if isinstance(plant, LinearPlant) else None
    if most is not None and steps > most:
        raise InputError(study.path, "study.steps", str(steps), f"at most {most}, which the "
                         "plant's matrices have")  # fmt: skip


def _at_point(study: Study, point: tuple[int, ...], error: InputError) -> InputError:
    """An error of a point, with the values of the axes that lead to it."""
    if not study.axes or error.file != study.scenario_path:
        return error
    where = ", ".join(f"{name} = {label}" for name, label in study.labels_of(point).items())
    return InputError(study.path, f"at {where}: {error.key}", error.found, error.expected)
