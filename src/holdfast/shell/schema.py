"""Tables of a scenario, validated against the signature of what they build."""

import inspect
import re
import types
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model
from pydantic_core import PydanticUndefined

from holdfast.parts import InvalidValue
from holdfast.shell.errors import InputError, did_you_mean, one_of, shown
from holdfast.shell.matrices import matrix

ARRAYS = {"x0": "a list of numbers", "P0": "rows of numbers, or the numbers of the diagonal"}
"""Parameters that are arrays whatever they are annotated with, in words."""
FROM_SCENARIO = ("enforcement",)
"""Keyword parameters of a part that the scenario as a whole gives, not the part's own table."""


class Strict(BaseModel):
    """A table whose keys are all known and whose values have the type stated."""

    model_config = ConfigDict(extra="forbid", strict=True, arbitrary_types_allowed=True)


class RunSettings(Strict):
    """How long, how often and from which seed a scenario is simulated."""

    steps: int = Field(1000, ge=1, le=10**8, description="a whole number from 1 up")
    runs: int = Field(1, ge=1, le=10**7, description="a whole number from 1 up")
    seed: int = Field(0, ge=0, lt=2**63, description="a whole number from 0 up")


class ScenarioTables(Strict):
    """The sections of a scenario file."""

    plant: dict[str, Any] = Field(description="a table: [plant]")
    estimator: dict[str, Any] = Field(description="a table: [estimator]")
    detector: dict[str, Any] = Field({"kind": "chi_square"}, description="a table: [detector]")
    controller: dict[str, Any] | None = Field(None, description="a table: [controller]")
    attack: list[dict[str, Any]] = Field([], description="tables: [[attack]]")
    enforcement: dict[str, Any] | None = Field(None, description="a table: [enforcement]")
    run: dict[str, Any] = Field({}, description="a table: [run]")


class _ConstraintSet(Strict):
    matrix: Any = Field(description="rows of numbers")
    bound: Any = Field(description="one number per row of matrix")
    bound_u: Any = Field(None, description="rows of numbers")


class _ConstraintSets(Strict):
    state: dict[str, Any] | None = Field(None, description="{ matrix, bound }")
    attack: dict[str, Any] | None = Field(None, description="{ matrix, bound }")


class Table:
    """One table of a scenario: its file, its key path, its values."""

    def __init__(self, file: str, key: str, values: dict[str, Any], folder: Path):
        self.file, self.key, self.values, self.folder = file, key, dict(values), folder

    def error(self, key: str, found: str, expected: str) -> InputError:
        """The error about one of its keys."""
        return InputError(self.file, f"{self.key}.{key}" if self.key else key, found, expected)

    def kind(self, known: Sequence[str]) -> str:
        """Take out ``kind``, which must be one of the known."""
        found = self.values.pop("kind", None)
        if found is None:
            raise self.error("kind", "nothing", one_of(known))
        if not isinstance(found, str) or found not in known:
            raise self.error("kind", shown(found), one_of(known, str(found)))
        return found

    def array(self, key: str, value: Any, *shapes: tuple[int, ...]) -> np.ndarray:
        """The value as an array of one of these shapes, finite."""
        found = matrix(value, self.file, f"{self.key}.{key}", self.folder)
        if not isinstance(found, np.ndarray):
            raise self.error(key, "a table on a grid", "numbers")
        if found.shape not in shapes:
            raise self.error(key, _size(found.shape), " or ".join(map(_size, shapes)))
        if not np.all(np.isfinite(found)):
            raise self.error(key, "NaN or infinity", "finite numbers")
        return found

    def checked(self, model: type[BaseModel]) -> BaseModel:
        """The values as the model understands them."""
        try:
            return model.model_validate(self.values)
        except ValidationError as error:
            raise self._translated(error, model) from None

    def _translated(self, error: ValidationError, model: type[BaseModel]) -> InputError:
        # a misspelt key says more than the missing one that it was meant to be
        problems = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        name = str(problems[0]["loc"][0])
        fields = {field.alias or name: field for name, field in model.model_fields.items()}
        if problems[0]["type"] == "extra_forbidden":
            return self.error(name, "an unknown key", one_of(fields, name))
        field = fields[name]
        expected = field.description or in_words(field.annotation)
        if problems[0]["type"] == "missing":
            return self.error(name, "nothing", expected)
        value = self.values[name]
        choices = [c for c in _choices(field.annotation) if isinstance(c, str)]
        if isinstance(value, str) and choices:
            expected = in_words(field.annotation, value)
        return self.error(name, shown(value), expected)

    def built(
        self,
        build: Callable[..., Any],
        *given: Any,
        skip: Sequence[str] = (),
        shared: dict[str, Any] | None = None,
    ) -> Any:
        """``build(*given, **values)``: the values checked against its signature first.

        The first ``len(given)`` parameters are ``given``; those in ``skip`` are dropped from
        the values where the signature lacks them. ``shared``: what the scenario gives to those
        that ask for it (`FROM_SCENARIO`), by name.
        """
        model = model_of(build, len(given))
        for name in skip:
            if name not in model.model_fields:
                self.values.pop(name, None)
        self._read_arrays(model)
        self.checked(model)
        asked = inspect.signature(build).parameters
        extra = {name: value for name, value in (shared or {}).items() if name in asked}
        try:
            return build(*given, **self.values, **extra)
        except InvalidValue as error:
            close = did_you_mean(str(error.found).strip("'"), _names_in(error.expected))
            expected = f"{error.expected}; did you mean {close!r}?" if close else error.expected
            raise self.error(error.key, str(error.found), expected) from None

    def _read_arrays(self, model: type[BaseModel]) -> None:
        for name, field in model.model_fields.items():
            value = self.values.get(name)
            if value is None:
                continue
            if name == "constraints":
                self.values[name] = self._constraints(value)
            elif isinstance(value, np.ndarray):
                continue
            elif field.annotation is Any:
                self.values[name] = matrix(value, self.file, f"{self.key}.{name}", self.folder)
            elif isinstance(value, dict) and "file" in value and _is_list(field.annotation):
                found = matrix(value, self.file, f"{self.key}.{name}", self.folder)
                self.values[name] = found.tolist()

    def _constraints(self, value: Any) -> dict[str, dict[str, Any]]:
        if not isinstance(value, dict):
            raise self.error("constraints", shown(value), "a table: [plant.constraints]")
        where = f"{self.key}.constraints"
        sets = Table(self.file, where, value, self.folder)
        sets.checked(_ConstraintSets)
        found = {}
        for side, entries in value.items():
            one = Table(self.file, f"{where}.{side}", entries, self.folder)
            one.checked(_ConstraintSet)
            found[side] = {
                name: matrix(entry, self.file, f"{where}.{side}.{name}", self.folder)
                for name, entry in entries.items()
            }
        return found


def model_of(build: Callable[..., Any], given: int) -> type[BaseModel]:
    """A pydantic model of the parameters of ``build`` after the first ``given``.

    Less those that a table cannot set (`FROM_SCENARIO`).
    """
    hints = typing.get_type_hints(build)
    fields: dict[str, Any] = {}
    open_ended = False
    for parameter in list(inspect.signature(build).parameters.values())[given:]:
        if parameter.kind is inspect.Parameter.VAR_KEYWORD:
            open_ended = True
            continue
        if given and parameter.name in FROM_SCENARIO:
            continue
        annotation = hints.get(parameter.name, Any)
        needed = parameter.default is inspect.Parameter.empty
        default = PydanticUndefined if needed else parameter.default
        if parameter.name in ARRAYS:
            fields[parameter.name] = (Any, Field(default, description=ARRAYS[parameter.name]))
        else:
            fields[parameter.name] = (annotation, Field(default))
    config = ConfigDict(
        extra="allow" if open_ended else "forbid",
        strict=True,
        arbitrary_types_allowed=True,
        protected_namespaces=(),
    )
    return create_model("Settings", __config__=config, **fields)


def plant_type(build: Callable[..., Any]) -> type | None:
    """The class of plant that ``build`` asks for, where it names one."""
    first = next(iter(inspect.signature(build).parameters))
    hint = typing.get_type_hints(build).get(first)
    return hint if isinstance(hint, type) else None


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[0]} numbers" if len(shape) == 1 else " x ".join(map(str, shape)) or "a number"


def _names_in(expected: str) -> list[str]:
    """The names that a message offers after "one of"."""
    _, listed, names = expected.partition("one of ")
    return re.split(r", | or ", names.replace("'", "")) if listed else []


def in_words(annotation: Any, found: str = "") -> str:
    """What a value of this type is, as a message says it."""
    choices = _choices(annotation)
    if choices:
        words = one_of([c for c in choices if isinstance(c, str)], found)
        others = [in_words(a) for a in typing.get_args(annotation) if not _choices(a)]
        others = [word for word in others if word]
        return f"{' or '.join(others)}, or {words}" if others else words
    origin, inside = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(word for word in map(in_words, inside) if word)
    if _is_list(annotation):
        return f"a list of {_plural(inside[0])}" if inside and inside[0] is not Any else "a list"
    if annotation is Any:
        return "a matrix: rows of numbers, or { file = .., name = .. }"
    return _WORDS.get(annotation, "")


_WORDS = {float: "a number", int: "a whole number", bool: "true or false", str: "text in quotes"}


def _plural(annotation: Any) -> str:
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return " or ".join(map(_plural, typing.get_args(annotation)))
    if _is_list(annotation):
        inside = typing.get_args(annotation)
        return f"lists of {_plural(inside[0])}" if inside else "lists"
    return {float: "numbers", int: "whole numbers", str: "texts in quotes"}.get(
        annotation, f"({in_words(annotation)})"
    )


def _choices(annotation: Any) -> tuple[Any, ...]:
    if typing.get_origin(annotation) is Literal:
        return typing.get_args(annotation)
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return tuple(c for a in typing.get_args(annotation) for c in _choices(a))
    return ()


def _is_list(annotation: Any) -> bool:
    origin = typing.get_origin(annotation)
    if origin in (typing.Union, types.UnionType):
        return any(_is_list(a) for a in typing.get_args(annotation))
    return (
        isinstance(origin or annotation, type)
        and issubclass(origin or annotation, Sequence)
        and (annotation is not str)
    )


def reject_unusable(value: Any, file: str, key: str = "") -> None:
    """NaN and whole numbers beyond 64 bits are errors wherever they stand."""
    if isinstance(value, dict):
        for name, entry in value.items():
            reject_unusable(entry, file, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for i, entry in enumerate(value, 1):
            reject_unusable(entry, file, f"{key}[{i}]")
    elif isinstance(value, float) and np.isnan(value):
        raise InputError(file, key, "nan", "a finite number")
    elif isinstance(value, int) and abs(value) >= 2**63:
        raise InputError(file, key, "a whole number beyond 64 bits", "a smaller one")
