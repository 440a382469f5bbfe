"""The table [enforcement] of a scenario: which outputs are authenticated when."""

from typing import Any

from pydantic import Field

from holdfast.parts import Plant
from holdfast.records import Enforcement
from holdfast.shell.errors import InputError, one_of, shown
from holdfast.shell.schema import Strict, Table

WHOLE = "a whole number from 1 up"
SENSORS = "tables: [enforcement.sensors.NAME]"
NEVER = (1, 0, 1)
"""every, for and first of an output that is never authenticated."""


class _Keys(Strict):
    every: int = Field(ge=1, lt=2**31, description=WHOLE)
    duration: int = Field(1, alias="for", ge=1, lt=2**31, description=WHOLE)
    first: int | None = Field(None, ge=1, lt=2**31, description=WHOLE)


class _Common(_Keys):
    """The keys for every output, with tables for some or without."""

    sensors: dict[str, dict[str, Any]] = Field({}, description=SENSORS)


class _Named(Strict):
    """Tables alone: what has none is never authenticated."""

    sensors: dict[str, dict[str, Any]] = Field(description=SENSORS)


def enforcement_of(table: Table, plant: Plant) -> Enforcement:
    """Authenticated at the rows k >= first with (k - first) mod every < for, per output.

    ``for`` is 1 and ``first`` is ``every`` unless given. A sensor's own table stands in the place
    of the common keys, none of which it takes over; without common keys a sensor that has no
    table is never authenticated. Raises `InputError`.
    """
    alone = table.values.keys() == {"sensors"} and table.values["sensors"] != {}
    common: Any = table.checked(_Named if alone else _Common)
    found = dict.fromkeys(plant.outputs, NEVER if alone else _numbers(common))
    sensors = Table(table.file, f"{table.key}.sensors", common.sensors, table.folder)
    for name, keys in common.sensors.items():
        if name not in plant.outputs:
            raise sensors.error(name, "an unknown sensor", one_of(plant.outputs, name))
        own = Table(table.file, f"{sensors.key}.{name}", keys, table.folder)
        found[name] = _numbers(own.checked(_Keys))
    return Enforcement.of(*([row[i] for row in found.values()] for i in range(3)))


def _numbers(keys: Any) -> tuple[int, int, int]:
    return keys.every, keys.duration, keys.every if keys.first is None else keys.first


FLAG = "--enforce"
WANTED = "every=L,for=F,first=K (for and first may be left out), or NAME:every=L,.."


def enforcement_flags(flags: list[str], outputs: tuple[str, ...]) -> Enforcement:
    """Of ``every=L,for=F,first=K`` for all outputs, and of ``NAME:every=..`` for one.

    As in the table: for is 1 and first is every unless given, and with names alone the other
    outputs are never authenticated. Raises `InputError`.
    """
    common: dict[str, int] | None = None
    named: dict[str, dict[str, int]] = {}
    for flag in flags:
        name, colon, keys = flag.rpartition(":")
        if not colon:
            if common is not None:
                raise InputError(FLAG, "", f"two of all outputs: {shown(flag)}", WANTED)
            common = _numbers_of(keys, flag)
        elif name not in outputs:
            raise InputError(FLAG, "", f"{shown(name)}", one_of(outputs, name))
        elif name in named:
            raise InputError(FLAG, "", f"{shown(name)} twice", "every output once")
        else:
            named[name] = _numbers_of(keys, flag)
    rows = []
    for name in outputs:
        keys = named.get(name, common)
        if keys is None:
            rows.append(NEVER)
        else:
            rows.append((keys["every"], keys.get("for", 1), keys.get("first", keys["every"])))
    return Enforcement.of(*([row[i] for row in rows] for i in range(3)))


def _numbers_of(text: str, flag: str) -> dict[str, int]:
    found: dict[str, int] = {}
    for part in text.split(","):
        key, _, value = (piece.strip() for piece in part.partition("="))
        if key not in ("every", "for", "first") or key in found:
            raise InputError(FLAG, "", shown(flag), WANTED)
        if not (value.isascii() and value.isdigit() and 1 <= int(value[:11]) < 2**31):
            raise InputError(FLAG, "", f"{shown(part)} in {shown(flag)}", f"{key}: {WHOLE}")
        found[key] = int(value)
    if "every" not in found:
        raise InputError(FLAG, "", shown(flag), WANTED)
    return found
