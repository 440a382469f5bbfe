"""The file of `holdfast live`: which scenario, from where, to where, by which rules."""

import dataclasses
import os
import stat
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from holdfast.shell.errors import InputError, shown
from holdfast.shell.reading import SCENARIO_LIMIT, decode, read_bytes
from holdfast.shell.scenario import parsed
from holdfast.shell.schema import Strict, Table

WHAT = "the configuration of a live service (TOML text)"
NUMBER = "a number of seconds from 0 up"
ROWS = "a whole number from 1 up"


class ClockKeys(Strict):
    """[clock]: when a frame closes, and what happens to what comes after that."""

    rule: Literal["arrival", "source"] = "arrival"
    grace: float = Field(0.0, ge=0, lt=1e6, description=NUMBER)
    jump: float = Field(1.0, gt=0, lt=1e9, description="a number of seconds above 0")
    late: Literal["drop", "refilter"] = "drop"
    window: int = Field(20, ge=1, le=10_000, description=ROWS)


class SensorKeys(Strict):
    """[sensors]: the rules of the life cycle."""

    enabled: bool = True
    level: float = Field(1e-6, gt=0, lt=1, description="a probability")
    window: int = Field(20, ge=1, le=1000, description=ROWS)
    confirm: int = Field(5, ge=1, le=1000, description=ROWS)
    probation: int = Field(50, ge=1, le=10**6, description=ROWS)
    retry: int = Field(500, ge=1, le=10**9, description=ROWS)


class FallbackKeys(Strict):
    """[fallback]: what counts when the estimator fails."""

    rule: Literal["kalman", "prediction", "none"] = "kalman"
    after: int = Field(5, ge=1, le=10**6, description=ROWS)


class CheckpointKeys(Strict):
    """[checkpoint]: where the state is kept, and how often."""

    file: str = Field(description="the name of a file")
    every: float = Field(5.0, gt=0, lt=1e6, description="a number of seconds above 0")


class AuthKeys(Strict):
    """[auth]: the key of SecOC messages, in hex, and whether a missing message is an alarm."""

    key_env: str | None = Field(None, description="the name of an environment variable")
    key_file: str | None = Field(None, description="the name of a file")
    missing_is_alarm: bool = True


class PageKeys(Strict):
    """[page]: where the page and the metrics are served, and the token that opens them."""

    host: str = "127.0.0.1"
    port: int = Field(8642, ge=0, lt=65536, description="a port")
    token_env: str | None = Field(None, description="the name of an environment variable")
    token_file: str | None = Field(None, description="the name of a file")
    certificate: str | None = Field(None, description="the name of a PEM file")
    key: str | None = Field(None, description="the name of a PEM file")


class FleetKeys(Strict):
    """[fleet]: many plants of the scenario's model."""

    most: int = Field(10_000, ge=1, le=10**7, description="a number of plants")
    retire: float = Field(600.0, gt=0, lt=1e9, description="a number of seconds above 0")
    shards: int | None = Field(None, ge=1, le=10_000, description="a number of shards")
    prefix: str | None = Field(None, description="what the topics of the group begin with")


class LiveTables(Strict):
    """The sections of the file."""

    scenario: str = Field(description="the name of a scenario file, relative to this one")
    name: str | None = Field(None, description="the plant's name on the page")
    clock: dict[str, Any] = Field({}, description="a table: [clock]")
    sensors: dict[str, Any] = Field({}, description="a table: [sensors]")
    fallback: dict[str, Any] = Field({}, description="a table: [fallback]")
    checkpoint: dict[str, Any] | None = Field(None, description="a table: [checkpoint]")
    auth: dict[str, Any] | None = Field(None, description="a table: [auth]")
    fleet: dict[str, Any] | None = Field(None, description="a table: [fleet]")
    events: str | None = Field(None, description="the name of a file for the event log (SQLite)")
    page: dict[str, Any] | None = Field(None, description="a table: [page]")
    source: list[dict[str, Any]] = Field(description="tables: [[source]]")
    sink: list[dict[str, Any]] = Field([], description="tables: [[sink]]")


@dataclasses.dataclass(frozen=True)
class LiveConfig:
    """What the file says, checked as far as it can be without building anything."""

    path: str
    source_text: str
    folder: Path
    scenario: Path
    name: str
    clock: ClockKeys
    sensors: SensorKeys
    fallback: FallbackKeys
    checkpoint: CheckpointKeys | None
    auth: AuthKeys | None
    fleet: FleetKeys | None
    events: Path | None
    page: PageKeys | None
    sources: tuple[Table, ...]
    sinks: tuple[Table, ...]


def read_config(path: str) -> LiveConfig:
    """Read and check. Raises `InputError` naming the file, the key, what was found."""
    source = decode(read_bytes(path, SCENARIO_LIMIT, WHAT), path, WHAT)
    content = parsed(source, path)
    folder = Path(path).parent
    found: Any = Table(path, "", content, folder).checked(LiveTables)

    def section(key: str, model: type[Strict]) -> Any:
        values = getattr(found, key)
        return None if values is None else Table(path, key, values, folder).checked(model)

    if not found.source:
        raise InputError(path, "source", "none", "one [[source]] or more")
    if found.fleet is not None:
        _check_fleet(path, found)
    return LiveConfig(
        path, source, folder, folder / found.scenario, found.name or Path(found.scenario).stem,
        section("clock", ClockKeys), section("sensors", SensorKeys),
        section("fallback", FallbackKeys), section("checkpoint", CheckpointKeys),
        section("auth", AuthKeys), section("fleet", FleetKeys),
        None if found.events is None else folder / found.events,
        section("page", PageKeys), _tables(path, "source", found.source, folder),
        _tables(path, "sink", found.sink, folder),
    )  # fmt: skip


def _check_fleet(path: str, found: Any) -> None:
    """A fleet has less than a plant has, and says so."""
    refused = {"sensors": found.sensors, "auth": found.auth, "page": found.page,
               "fallback.rule": "rule" in found.fallback, "clock.late": "late" in found.clock,
               "clock.window": "window" in found.clock}  # fmt: skip
    if found.fleet.get("shards") is None and found.fleet.get("prefix") is not None:
        raise InputError(path, "fleet.shards", "nothing beside fleet.prefix",
                         "a number of shards, or no prefix")  # fmt: skip
    if found.fleet.get("shards") is not None:
        if found.checkpoint is None:
            raise InputError(path, "checkpoint", "nothing", "a file: a shard's state follows it")
        if found.fleet.get("prefix") is None:
            raise InputError(path, "fleet.prefix", "nothing", "a topic for the group's own words")
    for key, value in refused.items():
        if value:
            raise InputError(
                path, key, "a setting beside [fleet]", "none: a fleet has no such part"
            )


def _tables(path: str, key: str, tables: list[dict[str, Any]], folder: Path) -> tuple[Table, ...]:
    return tuple(Table(path, f"{key}[{i}]", values, folder) for i, values in enumerate(tables, 1))


def secret(file: str, key: str, env: str | None, name: str | None, folder: Path) -> str:
    """A secret from the environment, or from a file that nobody else can read.

    ``key``: of the table's two keys, without their endings, for errors. Raises `InputError`.
    """
    if (env is None) == (name is None):
        found = "neither" if env is None else "both"
        raise InputError(file, f"{key}_env, {key}_file", found, "one of the two")
    if env is not None:
        value = os.environ.get(env, "")
        if not value:
            raise InputError(file, f"{key}_env", f"no environment variable {shown(env)}",
                             "one that holds the secret")  # fmt: skip
        return value
    place = folder / str(name)
    try:
        status = place.stat()
        content = place.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(place, "", f"no readable file ({error})", "the secret") from None
    if stat.S_IMODE(status.st_mode) & 0o077:
        raise InputError(
            place, "", f"a file that others may use (mode {stat.S_IMODE(status.st_mode):o})",
            "mode 600: chmod 600 it",
        )  # fmt: skip
    if not content:
        raise InputError(place, "", "an empty file", "the secret")
    return content
