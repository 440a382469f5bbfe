"""A scenario file, from TOML to parts that have been built and checked."""

import dataclasses
import functools
import importlib
import inspect
import re
import sys
import tomllib
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from holdfast.catalog import ATTACKS, CONTROLLERS, DETECTORS, ESTIMATORS, PLANTS
from holdfast.loop import Monitor, Scenario
from holdfast.parts import Detector, Estimator, InvalidValue, Plant
from holdfast.plants.build import covariance
from holdfast.shell.banks import reduce_bank
from holdfast.shell.enforcing import enforcement_of
from holdfast.shell.errors import InputError, shown
from holdfast.shell.reading import SCENARIO_LIMIT, STANDARD_INPUT, decode, read_bytes
from holdfast.shell.schema import (
    RunSettings,
    ScenarioTables,
    Table,
    plant_type,
    reject_unusable,
)

WHAT = "a scenario (TOML text)"

_DEEP_KEY = re.compile(r"""(?:\.[ \t]*(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*){100}""")
"""A dotted key of a hundred parts: the parser would take hours over a long one."""


@dataclasses.dataclass(frozen=True)
class ScenarioFile:
    """What a scenario file says: the parts, how to run them, and the text itself.

    ``threshold`` and ``calibrate`` are what [detector] asks for; the monitor has not been
    calibrated yet (`holdfast.shell.files.load_scenario` does that).
    """

    path: str
    source: str
    scenario: Scenario
    run: RunSettings
    threshold: str | float
    calibrate: Path | None


def read_scenario(path: str | Path, *, allow_python: bool = False) -> ScenarioFile:
    """Read, validate and build. Raises `InputError`.

    ``allow_python`` lets ``kind = "python"`` import and call code.
    """
    path = str(path)
    source, content = read_content(path)
    return build_scenario(path, source, content, allow_python)


def read_content(path: str) -> tuple[str, dict[str, Any]]:
    """The text of a scenario file, and its tables as they stand. Raises `InputError`."""
    source = decode(read_bytes(path, SCENARIO_LIMIT, WHAT), path, WHAT)
    return source, parsed(source, path)


def parsed(source: str, path: str) -> dict[str, Any]:
    """The tables of a scenario's text. Raises `InputError`."""
    if _DEEP_KEY.search(source):
        raise _too_deep(path)
    try:
        content = tomllib.loads(source)
        reject_unusable(content, path)
    except RecursionError:
        raise _too_deep(path) from None
    except ValueError as error:  # not TOML, or a number of more digits than Python converts
        raise InputError(path, "", f"no TOML: {error}", WHAT) from None
    return content


def build_scenario(
    path: str,
    source: str,
    content: dict[str, Any],
    allow_python: bool,
    plant: Plant | None = None,
) -> ScenarioFile:
    """Build what the tables say. Raises `InputError`.

    ``plant``: one that has been built from the same [plant] before.
    """
    folder = Path() if path == STANDARD_INPUT else Path(path).parent
    try:
        return _build(path, folder, source, content, allow_python, plant)
    except RecursionError:
        raise _too_deep(path) from None


def _too_deep(path: str) -> InputError:
    return InputError(path, "", "tables or lists nested too deep", WHAT)


def _build(
    path: str, folder: Path, source: str, content: dict[str, Any], allow_python: bool,
    known: Plant | None,
) -> ScenarioFile:  # fmt: skip
    sections: Any = Table(path, "", content, folder).checked(ScenarioTables)
    run: Any = Table(path, "run", sections.run, folder).checked(RunSettings)
    plant_table = Table(path, "plant", sections.plant, folder)
    x0 = plant_table.values.pop("x0", None)
    plant = _plant(plant_table, allow_python) if known is None else known
    n = len(plant.states)
    start = np.zeros(n) if x0 is None else plant_table.array("x0", x0, (n,))
    estimator = _estimator(Table(path, "estimator", sections.estimator, folder), plant)
    detector_table = Table(path, "detector", sections.detector, folder)
    threshold = detector_table.values.get("threshold", "calibrated")
    calibrate = _calibration_log(detector_table)
    detector = _detector(detector_table, plant, estimator)
    controller = None
    if sections.controller is not None:
        table = Table(path, "controller", sections.controller, folder)
        controller = _part(table, CONTROLLERS, plant)
    enforcement = None
    if sections.enforcement is not None:
        table = Table(path, "enforcement", sections.enforcement, folder)
        enforcement = enforcement_of(table, plant)
    shared = {"enforcement": enforcement}
    attacks = tuple(
        _part(Table(path, f"attack[{i}]", values, folder), ATTACKS, plant, shared=shared)
        for i, values in enumerate(sections.attack, 1)
    )
    monitor = Monitor(estimator, detector)
    scenario = Scenario(plant, jnp.asarray(start), monitor, controller, attacks, enforcement)
    return ScenarioFile(path, source, scenario, run, threshold, calibrate)


def _plant(table: Table, allow_python: bool) -> Plant:
    kind = table.kind([*PLANTS, "python"])
    if kind != "python":
        return table.built(PLANTS[kind])
    target = table.values.pop("target", None)
    if not isinstance(target, str) or not re.fullmatch(r"[\w.]+:\w+", target):
        found = "nothing" if target is None else shown(target)
        raise table.error("target", found, '"package.module:function"')
    if not allow_python:
        raise table.error(
            "target",
            f"{target!r}, which would run Python code",
            "--allow-python on the command line, if you trust this scenario",
        )
    plant = table.built(_told_as_target(_imported(table, target)))
    if not isinstance(plant, Plant):
        raise table.error("target", f"a function that returns {type(plant).__name__}", "a Plant")
    return plant


def _imported(table: Table, target: str) -> Callable[..., Any]:
    """The function that ``target`` names, looked for beside the scenario first."""
    module, name = target.split(":")
    sys.path.insert(0, str(table.folder.resolve()))
    try:
        found = getattr(importlib.import_module(module), name, None)
    except Exception as error:
        raise table.error(
            "target", f"{target!r} ({_in_short(error)})", "a module that can be imported"
        ) from None
    finally:
        sys.path.pop(0)
    if not callable(found):
        raise table.error("target", f"{target!r}", f"a function {name!r} in {module}")
    return found


def _told_as_target(make: Callable[..., Any]) -> Callable[..., Any]:
    """``make`` whose errors about anything but its own settings are errors of its target."""
    settings = inspect.signature(make).parameters

    @functools.wraps(make)
    def told(**values):
        try:
            return make(**values)
        except InvalidValue as error:
            if error.key in settings:
                raise
            found = f"{error.key}: {error.found}"
            raise InvalidValue("target", found, error.expected) from None
        except Exception as error:
            raise InvalidValue(
                "target", _in_short(error), "a function that returns a Plant"
            ) from None

    return told


def _in_short(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0]


def _part(
    table: Table,
    catalog: dict[str, Callable[..., Any]],
    plant: Plant,
    skip: Sequence[str] = (),
    shared: dict[str, Any] | None = None,
) -> Any:
    kind = table.kind(list(catalog))
    build = catalog[kind]
    wanted = plant_type(build)
    if wanted is not None and not isinstance(plant, wanted):
        raise table.error("kind", f"{kind!r}", f"one that works with a {type(plant).__name__}")
    return table.built(build, plant, skip=skip, shared=shared)


def _estimator(table: Table, plant: Plant) -> Estimator:
    n = len(plant.states)
    if "x0" in table.values:
        table.values["x0"] = table.array("x0", table.values["x0"], (n,))
    if "P0" in table.values:
        given = table.array("P0", table.values["P0"], (n, n), (n,))
        try:
            table.values["P0"] = covariance("P0", np.diag(given) if given.ndim == 1 else given)
        except InvalidValue as error:
            raise table.error(error.key, str(error.found), error.expected) from None
    if table.values.get("kind") == "nisme":
        reduce_bank(table, plant)
    return _part(table, ESTIMATORS, plant, skip=("x0", "P0"))


def _calibration_log(table: Table) -> Path | None:
    name = table.values.pop("calibrate", None)
    if name is None:
        return None
    if not isinstance(name, str):
        raise table.error("calibrate", shown(name), "the name of a log without attack")
    if table.values.get("threshold", "calibrated") != "calibrated":
        raise table.error(
            "calibrate", "a log beside a threshold that is given", 'threshold = "calibrated"'
        )
    return table.folder / name


def judged(estimator: Estimator) -> str:
    """What a detector judges unless told: the attack estimate where there is one."""
    return "attack" if estimator.init()[1].d.shape[0] else "residual"


def _detector(table: Table, plant: Plant, estimator: Estimator) -> Detector:
    best = judged(estimator)
    if table.values.setdefault("on", best) == "attack" and best != "attack":
        warnings.warn(
            f'{table.file}: detector.on: the estimator estimates no attack, so on = "attack" '
            'leaves nothing to test; "residual" is what it can judge',
            stacklevel=2,
        )
    return _part(table, DETECTORS, plant)
