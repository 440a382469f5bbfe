"""The sources and sinks that a configuration names; each kind imports what it needs by itself."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import Field

from holdfast.shell.errors import InputError, one_of, shown
from holdfast.shell.logs import read_log
from holdfast.shell.schema import Strict, Table
from holdfast.shell.service.building import Built
from holdfast.shell.service.config import LiveConfig, secret
from holdfast.shell.service.lines import LineSink, LineSource
from holdfast.shell.service.recorded import RecordedSource
from holdfast.shell.service.records import Labels
from holdfast.shell.service.sinks import Sink
from holdfast.shell.service.sources import Source
from holdfast.shell.service.wire import DECODERS, line_decoder, single

PORT = "a port"
SIGNALS = 'a table: what it is called there = a column such as "y:gps"'


class _StdinKeys(Strict):
    trust: bool = False


class _RecordedKeys(Strict):
    file: str = Field(description="the name of a log, relative to this file")
    speed: float = Field(1.0, ge=0, lt=1e9, description="a number from 0 (at once) up")


class BrokerKeys(Strict):
    """Of everything that speaks to a broker."""

    host: str = "127.0.0.1"
    port: int = Field(1883, ge=1, lt=65536, description=PORT)
    client_id: str | None = None
    username: str | None = None
    password_env: str | None = None
    password_file: str | None = None
    authority: str | None = Field(None, description="a PEM file of those who sign the broker")
    qos: Literal[0, 1] = 0


class _MqttSourceKeys(BrokerKeys):
    topic: str | None = Field(None, description="the topic of whole rows")
    format: Literal["json", "binary"] = "json"
    signals: dict[str, str] = Field({}, description=SIGNALS)
    trust: bool = False


class MqttSinkKeys(BrokerKeys):
    """Of a sink to a broker."""

    prefix: str = Field(description="what every topic begins with")
    capacity: int = Field(10_000, ge=1, le=10**7, description="a whole number from 1 up")


class _CanKeys(Strict):
    interface: str = Field(description='an interface of python-can, such as "socketcan"')
    channel: str = Field(description='its channel, such as "can0"')
    dbc: str = Field(description="the name of a DBC file, relative to this one")
    signals: dict[str, str] = Field(description=SIGNALS)


class _MavlinkKeys(Strict):
    host: str = "127.0.0.1"
    port: int = Field(14550, ge=1, lt=65536, description=PORT)
    signals: dict[str, str] = Field(description=SIGNALS)
    key_env: str | None = None
    key_file: str | None = None


class Parts(NamedTuple):
    """What runs beside the engine. ``told``: lines for the operator at the start."""

    sources: tuple[Source, ...]
    sinks: tuple[Sink, ...]
    metrics: Any
    told: tuple[str, ...]


def build_parts(config: LiveConfig, built: Built, stop: Callable[[], None]) -> Parts:
    """Everything that the configuration names. Raises `InputError`."""
    sources = tuple(_source(table, i, built, config) for i, table in enumerate(config.sources, 1))
    sinks = [_sink(table, i, built.labels, config, stop) for i, table in enumerate(config.sinks, 1)]
    log = None
    if config.events is not None or config.page is not None:
        from holdfast.shell.service.event_log import EventLog

        # the page tells what happened since the start even where nothing is kept
        log = EventLog(config.events or Path(":memory:"))
        sinks.append(log)
    metrics, told = None, ()
    if config.page is not None:
        metrics, page, told = _page(config, built, log, sources, built.engine.ask_reset)
        sinks += [metrics, page]
    return Parts(sources, tuple(sinks), metrics, told)


def _source(table: Table, number: int, built: Built, config: LiveConfig) -> Source:
    kind = table.kind(["stdin", "recorded", "mqtt", "can", "mavlink"])
    name, labels = f"{kind}[{number}]", built.labels
    if kind == "stdin":
        keys: Any = table.checked(_StdinKeys)
        return LineSource(name, line_decoder(labels, keys.trust))
    if kind == "recorded":
        keys = table.checked(_RecordedKeys)
        log = read_log(config.folder / keys.file, built.scenario.plant)
        return RecordedSource(name, log, labels, keys.speed)
    if kind == "mqtt":
        return _mqtt_source(table, name, labels, config)
    if kind == "can":
        from holdfast.shell.service.can import CanSource

        keys = table.checked(_CanKeys)
        signals = _by_column(table, keys.signals, labels)
        return CanSource(name, keys.interface, keys.channel, config.folder / keys.dbc, signals,
                         config.path, table.key)  # fmt: skip
    from holdfast.shell.service.mavlink import MavlinkSource

    keys = table.checked(_MavlinkKeys)
    key = None
    if keys.key_env or keys.key_file:
        key = _key_bytes(table, secret(config.path, f"{table.key}.key", keys.key_env,
                                       keys.key_file, config.folder))  # fmt: skip
    signals = _by_column(table, keys.signals, labels)
    return MavlinkSource(name, keys.host, keys.port, signals, config.path, table.key, key)


def _key_bytes(table: Table, text: str) -> bytes:
    try:
        found = bytes.fromhex(text)
    except ValueError:
        found = b""
    if len(found) != 32:
        raise table.error("key", "a key that cannot be used", "32 bytes as 64 hexadecimal digits")
    return found


def _by_column(table: Table, signals: Mapping[str, str], labels: Labels) -> dict[str, str]:
    """The signals by the plant's column, each column once."""
    found: dict[str, str] = {}
    for signal, column in signals.items():
        if column not in labels.columns:
            raise table.error(f"signals.{signal}", shown(column), one_of(labels.columns, column))
        if column in found:
            raise table.error(f"signals.{signal}", f"{column} twice", "every column once")
        found[column] = signal
    if not found:
        raise table.error("signals", "none", SIGNALS)
    return found


def broker_of(table: Table, keys: Any, config: LiveConfig) -> Any:
    """The broker that `BrokerKeys` name. Raises `InputError`."""
    import ssl

    from holdfast.shell.service.broker import Broker, check_package

    check_package(table.file, table.key)
    password = None
    if keys.password_env or keys.password_file:
        if keys.username is None:
            raise table.error("username", "none beside a password", "whose password it is")
        password = secret(config.path, f"{table.key}.password", keys.password_env,
                          keys.password_file, config.folder)  # fmt: skip
    tls = None
    if keys.authority is not None:
        try:
            tls = ssl.create_default_context(cafile=str(config.folder / keys.authority))
        except (OSError, ssl.SSLError) as error:
            raise table.error("authority", f"no usable file ({error})", "a PEM file") from None
    return Broker(
        host=keys.host, port=keys.port, client_id=keys.client_id, username=keys.username,
        password=password, tls=tls, qos=keys.qos,
    )  # fmt: skip


def check_topic(table: Table, topic: str) -> None:
    """Raises `InputError` for what MQTT does not take for a topic."""
    from aiomqtt import Wildcard

    try:
        Wildcard(topic)
    except ValueError:
        raise table.error(
            "topic", shown(topic), "a topic of MQTT, wildcards as its parts"
        ) from None


def _mqtt_source(table: Table, name: str, labels: Labels, config: LiveConfig) -> Source:
    from holdfast.shell.service.mqtt import MqttSource

    keys: Any = table.checked(_MqttSourceKeys)
    broker = broker_of(table, keys, config)
    if (keys.topic is None) == (not keys.signals):
        found = "neither" if keys.topic is None else "both"
        raise table.error("topic, signals", found, "one of the two")
    for topic in [keys.topic] if keys.topic is not None else keys.signals:
        check_topic(table, topic)
    if keys.topic is not None:
        decoders = {keys.topic: DECODERS[keys.format](labels, keys.trust)}
    else:
        columns = _by_column(table, keys.signals, labels)
        decoders = {topic: single(column) for column, topic in columns.items()}
    return MqttSource(name, broker, decoders)


def _sink(
    table: Table, number: int, labels: Labels, config: LiveConfig, stop: Callable[[], None]
) -> Sink:
    kind = table.kind(["stdout", "mqtt"])
    name = f"{kind}[{number}]"
    if kind == "stdout":
        table.checked(Strict)
        return LineSink(name, labels, stop)
    from holdfast.shell.service.mqtt import MqttSink, said_of

    keys: Any = table.checked(MqttSinkKeys)
    return MqttSink(
        name, broker_of(table, keys, config), said_of(labels), keys.prefix, keys.capacity
    )


def _page(
    config: LiveConfig, built: Built, log: Any, sources: tuple[Source, ...],
    reset: Callable[[], None],
) -> tuple[Any, Sink, tuple[str, ...]]:  # fmt: skip
    keys: Any = config.page
    token = secret(config.path, "page.token", keys.token_env, keys.token_file, config.folder)
    if len(token) < 16:
        raise InputError(config.path, "page.token", "a short token", "16 characters or more")
    if (keys.certificate is None) != (keys.key is None):
        raise InputError(config.path, "page.certificate, page.key", "one", "both or none")
    from holdfast.shell.service.metrics import Metrics
    from holdfast.shell.service.page import Page

    labels, frames = built.labels, built.engine.frames
    metrics = Metrics(
        labels, lambda: {source.name: source.counters for source in sources},
        lambda: (frames.counts, frames.clock.drift),
    )  # fmt: skip

    def place(name: str | None) -> Path | None:
        return None if name is None else config.folder / name

    page = Page(labels, log, metrics, token, reset, keys.host, keys.port,
                place(keys.certificate), place(keys.key))  # fmt: skip
    scheme = "http" if keys.certificate is None else "https"
    told = [f"page: {scheme}://{keys.host}:{keys.port}/"]
    if keys.host not in ("127.0.0.1", "::1", "localhost") and keys.certificate is None:
        told.append("warning: the page is open to the network without TLS: "
                    "name a certificate and a key under [page]")  # fmt: skip
    return metrics, page, tuple(told)
