"""A study file: a scenario, the settings that vary, and how many runs of each combination."""

import copy
import hashlib
import itertools
import json
import math
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from holdfast.shell.errors import InputError, one_of, shown
from holdfast.shell.reading import SCENARIO_LIMIT, decode, read_bytes
from holdfast.shell.scenario import parsed, read_content
from holdfast.shell.schema import ScenarioTables, Strict, Table, reject_unusable

WHAT = "a study (TOML text)"
TRUTH = "truth"
"""Section of an axis that changes the simulated plant alone, not the one estimators know."""
MOST_POINTS = 100_000
SECTIONS = tuple(name for name in ScenarioTables.model_fields if name != "run")
_PART = re.compile(r"([\w-]+)(?:\[(\d+(?:, ?\d+)*)\])?")
Dotted = list[tuple[str, tuple[int, ...]]]
"""The parts of a dotted name, each with the numbers in its brackets."""


class StudySettings(Strict):
    """The table [study]."""

    scenario: str = Field(description="the name of a scenario file, relative to the study")
    runs: int = Field(1000, ge=1, le=10**9, description="a whole number from 1 up")
    steps: int | None = Field(None, ge=1, le=10**8, description="a whole number from 1 up")
    seed: int = Field(0, ge=0, lt=2**63, description="a whole number from 0 up")
    start: Literal["drawn", "fixed"] = Field("drawn", description="one of 'drawn', 'fixed'")
    common_noise: bool = Field(False, description="true or false")
    traces: int = Field(0, ge=0, description="a whole number from 0 up")


class StudyTables(Strict):
    """The sections of a study file; the last two are for `holdfast tune`."""

    study: dict[str, Any] = Field(description="a table: [study]")
    axes: dict[str, Any] = Field({}, description="a table: [axes]")
    tune: dict[str, Any] = Field({}, description="a table: [tune]")
    settings: dict[str, Any] = Field({}, description="a table: [settings]")


@dataclass(frozen=True)
class Axis:
    """A setting that varies: its dotted name, its values and what they are called."""

    name: str
    values: tuple[Any, ...]
    labels: tuple[str | float, ...]


@dataclass(frozen=True)
class Study:
    """What a study file says, and the scenario that it varies."""

    path: str
    source: str
    settings: StudySettings
    axes: tuple[Axis, ...]
    scenario_path: str
    scenario_source: str
    content: dict[str, Any]
    tables: StudyTables

    @property
    def folder(self) -> Path:
        """Where the scenario's own files are looked for."""
        return Path(self.scenario_path).parent

    @property
    def points(self) -> list[tuple[int, ...]]:
        """Every combination, by the number of its value on each axis."""
        return list(itertools.product(*(range(len(axis.values)) for axis in self.axes)))

    def content_of(self, point: tuple[int, ...]) -> tuple[dict[str, Any], dict[str, Any] | None]:
        """The scenario at a point, and the [plant] that is simulated where that is another."""
        content = copy.deepcopy(self.content)
        chosen = {a.name: copy.deepcopy(a.values[i]) for a, i in zip(self.axes, point, strict=True)}
        different = {name: value for name, value in chosen.items() if _of_truth(name)}
        for name in chosen.keys() - different.keys():
            (section, numbers), *rest = _path(name)
            if rest or numbers:
                _put(content, _path(name), chosen[name], self.path, name)
            else:
                content[section] = _whole(section, chosen[name])
        if not different:
            return content, None
        truth = copy.deepcopy(content["plant"])
        for name, value in different.items():
            _put(truth, _path(name)[1:], value, self.path, name)
        return content, truth

    def name_of(self, point: tuple[int, ...]) -> str:
        """What a point is called: the same whatever other points there are."""
        chosen = {a.name: a.values[i] for a, i in zip(self.axes, point, strict=True)}
        return json.dumps(chosen, sort_keys=True)

    def labels_of(self, point: tuple[int, ...]) -> dict[str, str | float]:
        """What its value on each axis is called."""
        return {a.name: a.labels[i] for a, i in zip(self.axes, point, strict=True)}

    @property
    def digest(self) -> str:
        """Of all that decides what the runs of a point give, but for its axes."""
        settings = self.settings.model_dump(exclude={"runs", "scenario", "traces"})
        text = json.dumps([settings, self.content], sort_keys=True, default=repr)
        return hashlib.sha256(text.encode()).hexdigest()


def read_study(path: str | Path) -> Study:
    """Read and check a study and its scenario's text. Raises `InputError`."""
    path = str(path)
    source = decode(read_bytes(path, SCENARIO_LIMIT, WHAT), path, WHAT)
    scenario = str(Path(path).parent / _settings(path, source)[0].scenario)
    return study_of(path, source, scenario, read_content(scenario)[0])


def study_of(path: str, source: str, scenario_path: str, scenario_source: str) -> Study:
    """The study of two texts. Raises `InputError`."""
    settings, tables = _settings(path, source)
    content = parsed(scenario_source, scenario_path)
    axes = tuple(_axis(path, name, values) for name, values in tables.axes.items())
    count = math.prod(len(axis.values) for axis in axes)
    if count > MOST_POINTS:
        raise InputError(path, "axes", f"{count} combinations", f"at most {MOST_POINTS}")
    return Study(path, source, settings, axes, scenario_path, scenario_source, content, tables)


def _settings(path: str, source: str) -> tuple[Any, Any]:
    """The table [study], and all tables."""
    try:
        content = tomllib.loads(source)
    except (ValueError, RecursionError) as error:
        raise InputError(path, "", f"no TOML: {error}", WHAT) from None
    reject_unusable(content, path)
    folder = Path(path).parent
    tables: Any = Table(path, "", content, folder).checked(StudyTables)
    settings: Any = Table(path, "study", tables.study, folder).checked(StudySettings)
    if settings.traces > settings.runs:
        expected = f"at most {settings.runs}, the runs of a point"
        raise InputError(path, "study.traces", str(settings.traces), expected)
    return settings, tables


def check_name(file: str, key: str, name: str) -> None:
    """Whether a dotted name can be a setting of a scenario. Raises `InputError` about ``key``."""
    parts = _path(name)
    known = (*SECTIONS, TRUTH)
    if not parts or parts[0][0] not in known:
        section = parts[0][0] if parts else name
        expected = f"a setting such as attack.value, in {one_of(known, section)}"
        raise InputError(file, key, f"the section {section!r}", expected)
    if parts[0][0] == TRUTH and len(parts) < 2:
        raise InputError(file, key, shown(name), "truth.KEY, KEY being one of [plant]")
    if parts[0][0] == TRUTH and parts[1][0] == "x0":
        raise InputError(file, key, shown(name), "plant.x0, which is the true start already")


def _axis(file: str, name: str, values: Any) -> Axis:
    key = f'axes."{name}"'
    check_name(file, key, name)
    if not isinstance(values, list) or not values:
        found = "an empty list" if values == [] else shown(values)
        raise InputError(file, key, found, "a list of the values to try")
    cleaned, labels = [], []
    for number, value in enumerate(values, 1):
        value, label = _labelled(value, number)
        cleaned.append(value)
        labels.append(label)
    if len({json.dumps(v, sort_keys=True, default=repr) for v in cleaned}) < len(cleaned):
        raise InputError(file, key, "a value that comes twice", "values that differ")
    if not all(isinstance(label, float) for label in labels):
        labels = [_text(label) for label in labels]
    if len(set(labels)) < len(labels):
        labels = [f"{label} ({i})" for i, label in enumerate(labels, 1)]
    return Axis(name, tuple(cleaned), tuple(labels))


def _labelled(value: Any, number: int) -> tuple[Any, str | float]:
    """The value without its own ``label``, and what to call it."""
    if isinstance(value, dict):
        value = dict(value)
        label = value.pop("label", value.get("kind", f"number {number}"))
        return value, str(label)
    if isinstance(value, bool | str):
        return value, str(value).lower() if isinstance(value, bool) else value
    if isinstance(value, int | float):
        return value, float(value)
    if isinstance(value, list):
        kinds = [v.get("label", v.get("kind")) if isinstance(v, dict) else v for v in value]
        cleaned = [
            {k: w for k, w in v.items() if k != "label"} if isinstance(v, dict) else v
            for v in value
        ]
        flat = all(isinstance(k, str | int | float) for k in kinds)
        text = "+".join(map(str, kinds)) or "none"
        return cleaned, text if flat and len(text) <= 40 else f"number {number}"
    return value, shown(value)


def _text(label: str | float) -> str:
    return label if isinstance(label, str) else f"{label:g}"


def _path(name: str) -> Dotted:
    found = []
    for part in name.split("."):
        matched = _PART.fullmatch(part)
        if matched is None:
            return []
        numbers = matched[2].split(",") if matched[2] else ()
        found.append((matched[1], tuple(map(int, numbers))))
    return found


def _of_truth(name: str) -> bool:
    return _path(name)[0][0] == TRUTH


def _whole(section: str, value: Any) -> Any:
    """A table, or for attacks a list of them."""
    return [value] if section == "attack" and isinstance(value, dict) else value


def value_at(content: dict[str, Any], name: str) -> Any:
    """What stands at a dotted name; None where there is nothing."""
    place: Any = content
    for part, numbers in _path(name):
        place = place.get(part) if isinstance(place, dict) else None
        for number in numbers:
            inside = isinstance(place, list) and 1 <= number <= len(place)
            place = place[number - 1] if inside else None
    return place


def _put(content: dict[str, Any], path: Dotted, value: Any, file: str, name: str) -> None:
    """``value`` where the path leads: a key of a table, or an entry of a list or matrix there."""
    key = f'axes."{name}"'
    place: Any = content
    for depth, (part, numbers) in enumerate(path):
        last = depth == len(path) - 1
        if last and not numbers:
            place[part] = value
            return
        place = place.setdefault(part, [] if part == "attack" else {})
        if isinstance(place, list) and not numbers and len(place) == 1:
            numbers = (1,)
        if isinstance(place, list) and not numbers:
            expected = f"{part}[1] to {part}[{len(place)}]" if place else f"a [[{part}]]"
            raise InputError(file, key, f"{part} of {len(place)}", expected)
        for i, number in enumerate(numbers):
            if not isinstance(place, list):
                raise InputError(file, key, f"{part}[{number}]", f"{part}, which is no list")
            if not 1 <= number <= len(place):
                expected = f"{part}[1] to {part}[{len(place)}]" if place else f"a [[{part}]]"
                raise InputError(file, key, f"{part} of {len(place)}", expected)
            if last and i == len(numbers) - 1:
                place[number - 1] = value
                return
            place = place[number - 1]
        if not isinstance(place, dict):
            raise InputError(file, key, f"{part} = {shown(place)}", "a table")
