"""A PX4 flight, recorded as `.ulg` or as a folder of CSV topics, as a log for the `uav` plant.

Samples keep their values. Each goes into the row whose time is nearest to its own; a row
without a sample stays without one (`seen` False), and whatever is left out is counted.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from holdfast.parts import Plant
from holdfast.plants.library.uav import GPS
from holdfast.records import Observation
from holdfast.shell.errors import InputError, one_of, shown
from holdfast.shell.grid import Log, nearest_samples
from holdfast.shell.topics import Topic, read_topics

GPS_TOPIC, BARO_TOPIC = "vehicle_gps_position", "vehicle_air_data"
ACCURACIES = ("s_variance_m_s", "eph", "epv", "satellites_used")
"""What a receiver says of its own accuracy: m/s, m, m, a count."""
SECOND = 1_000_000
"""Time stamps are in microseconds."""
ALIGNED_OVER = 10.0
"""Seconds at the start of a flight whose time stamps choose where the rows lie."""
MOST_ROWS = 10_000_000


@dataclass(frozen=True)
class Count:
    """What became of the samples of one sensor.

    ``used`` lie in a row; ``duplicate`` had to leave their row to one nearer to its time;
    ``late`` lay further than the tolerance from every row; ``without_fix`` came while the
    receiver had no position in space. ``missing`` did not come though due by the sensor's
    own period; ``faulty`` are those of ``used`` with a value that is not a number.
    """

    used: int
    duplicate: int
    late: int
    without_fix: int
    missing: int
    faulty: int


@dataclass(frozen=True)
class Signal:
    """A series with the times (s) of its own samples."""

    time: np.ndarray
    value: np.ndarray


@dataclass(frozen=True)
class Flight:
    """A flight on the rows of a plant, and what belongs beside it.

    ``accuracies`` are the receiver's claims about itself (`ACCURACIES`, those recorded). They
    are no part of ``log``: a spoofer makes the receiver claim what suits him, so they are a
    signal to watch, not the noise to filter with. ``counts``: "gps" and "baro".
    """

    log: Log
    accuracies: dict[str, Signal]
    counts: dict[str, Count]


def read_flight(
    path: str | Path, plant: Plant, tolerance: float | None = None, allow_cut: bool = False
) -> Flight:
    """The flight as observations of ``plant``, whose outputs are named as the `uav` plant's.

    GPS position becomes metres north, east and down of the first fix (tangent to the WGS84
    ellipsoid: 1 mm at 100 m, 1 m at 3 km, so for flights around one place); barometric height
    counts from its first sample. Rows are ``plant.dt`` apart, at the phase that keeps the
    largest time error of the first seconds smallest. ``tolerance``: seconds a sample may be
    from its row, half of dt if not given. ``allow_cut``: take what a cut-off `.ulg` holds.

    Raises `InputError` naming the file and the topic.
    """
    dt = plant.dt
    tolerance = dt / 2 if tolerance is None else tolerance
    if not 0 < tolerance <= dt / 2:
        raise InputError(path, "tolerance", f"{tolerance} s", f"more than 0, at most {dt / 2} s")
    topics = read_topics(path, [GPS_TOPIC, BARO_TOPIC], allow_cut)
    times = {name: _times(path, name, topic) for name, topic in topics.items()}
    gps, fixed = _gps(path, topics[GPS_TOPIC])
    baro = _column(path, BARO_TOPIC, topics[BARO_TOPIC], "baro_alt_meter")
    finite = baro[np.isfinite(baro)]
    if not len(finite):
        raise InputError(path, f"{BARO_TOPIC}.baro_alt_meter", "no number at all", "heights in m")
    sensors = {
        "gps": (times[GPS_TOPIC], gps, fixed),
        "baro": (times[BARO_TOPIC], (baro - finite[0])[:, None], np.ones((len(baro), 1), bool)),
    }
    rows = _rows(path, [times[GPS_TOPIC][fixed[:, 0]], times[BARO_TOPIC]], dt)
    columns, counts = [], {}
    for name, (time, values, usable) in sensors.items():
        y, seen, counts[name] = _match(rows, dt, time, values, usable, tolerance)
        columns.append((y, seen))
    y, seen = (np.concatenate(parts, 1) for parts in zip(*columns, strict=True))
    order = _order(path, plant)
    observation = Observation.of(np.zeros((len(rows), 0)), y[:, order], seen[:, order])
    accuracies = {
        name: Signal(times[GPS_TOPIC], np.asarray(topics[GPS_TOPIC][name], float))
        for name in ACCURACIES
        if name in topics[GPS_TOPIC]
    }
    return Flight(Log(rows, observation), accuracies, counts)


def _column(path: str | Path, topic: str, columns: Topic, *names: str) -> np.ndarray:
    """The first of these columns that the topic has."""
    for name in names:
        if name in columns:
            return np.asarray(columns[name], float)
    raise InputError(path, f"{topic}.{names[0]}", "no such column", " or ".join(names))


def _times(path: str | Path, name: str, topic: Topic) -> np.ndarray:
    time = _column(path, name, topic, "timestamp") / SECOND
    if not len(time):
        raise InputError(path, name, "no samples", "at least one")
    if not np.all(np.isfinite(time)):
        raise InputError(path, f"{name}.timestamp", "a cell that is no number", "microseconds")
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        i = back[0] + 1
        raise InputError(
            path,
            f"{name}, sample {i + 1}",
            f"{time[i]:.6f} s after {time[i - 1]:.6f} s",
            "time that does not run backwards",
        )
    return time


def _gps(path: str | Path, topic: Topic) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity in the local frame, and which of them the receiver stands by."""

    def column(*names: str) -> np.ndarray:
        return _column(path, GPS_TOPIC, topic, *names)

    # releases before 1.14 log integers: 1e-7 degrees and millimetres
    old = "lat" in topic
    degree, metre = (1e-7, 1e-3) if old else (1.0, 1.0)
    lat = column("latitude_deg", "lat") * degree
    lon = column("longitude_deg", "lon") * degree
    alt = column("altitude_msl_m", "alt") * metre
    fix = column("fix_type") >= 3
    first = np.flatnonzero(fix & np.isfinite(lat + lon + alt))
    if not len(first):
        raise InputError(
            path, f"{GPS_TOPIC}.fix_type", "no fix in space", "3 or more at least once"
        )
    velocity = [column(f"vel_{axis}_m_s") for axis in "ned"]
    valid = fix & (column("vel_ned_valid") > 0)
    position = _local(lat, lon, alt, int(first[0]))
    usable = np.stack([fix] * 3 + [valid] * 3, 1)
    return np.stack([*position, *velocity], 1), usable


def _local(lat, lon, alt, origin: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Metres north, east and down of one sample, with the ellipsoid's radii there."""
    a, e2 = 6378137.0, 0.00669437999014
    s = np.sin(np.radians(lat[origin]))
    across = a / np.sqrt(1 - e2 * s**2)
    along = across * (1 - e2) / (1 - e2 * s**2)
    turn = (lon - lon[origin] + 180.0) % 360.0 - 180.0
    return (
        np.radians(lat - lat[origin]) * (along + alt[origin]),
        np.radians(turn) * (across + alt[origin]) * np.cos(np.radians(lat[origin])),
        alt[origin] - alt,
    )


def _rows(path: str | Path, times: list[np.ndarray], dt: float) -> np.ndarray:
    """The times of the rows, from the first sample to the last.

    The rows lie where the time stamps of all sensors, modulo dt, are farthest from the
    switch to the next row: opposite the widest gap between them. Anchored at one sensor, the
    other may straddle that switch, and neighbouring samples would compete for one row. A
    sensor faster than the rows has a sample near every row wherever they lie.
    """
    start, end = min(time[0] for time in times), max(time[-1] for time in times)
    if (end - start) / dt > MOST_ROWS:
        raise InputError(path, "timestamp", f"{end - start:.3g} s", "a flight in one piece")
    slow = [t for t in times if _period(t) > 0.75 * dt] or times
    phase = np.sort(np.concatenate([t[t < t[0] + ALIGNED_OVER] for t in slow]) % dt)
    gaps = np.diff(phase, append=phase[0] + dt)
    widest = np.argmax(gaps)
    offset = phase[widest] + gaps[widest] / 2 + dt / 2
    first, last = (np.rint((moment - offset) / dt) for moment in (start, end))
    return offset + dt * np.arange(first, last + 1)


def _match(
    rows: np.ndarray,
    dt: float,
    time: np.ndarray,
    values: np.ndarray,
    usable: np.ndarray,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray, Count]:
    """The samples of one sensor in the rows nearest to them: y, seen and what became of all."""
    y = np.zeros((len(rows), values.shape[1]))
    seen = np.zeros(y.shape, bool)
    off = np.abs(time - rows[0] - dt * np.rint((time - rows[0]) / dt))
    fixed = usable.any(1)
    # half a microsecond: a sample exactly between two rows belongs to one of them
    late = fixed & (off > tolerance + 0.5 / SECOND)
    in_time = np.flatnonzero(fixed & ~late)
    taken, which, candidates = nearest_samples(time[in_time], rows[0], len(rows), dt)
    chosen = in_time[which]
    y[taken], seen[taken] = np.where(usable[chosen], values[chosen], 0.0), usable[chosen]
    count = Count(
        used=len(chosen),
        duplicate=candidates - len(chosen),
        late=int(late.sum()),
        without_fix=int((~fixed).sum()),
        missing=_missing(time[fixed]),
        faulty=int((~np.isfinite(y[taken])).any(1).sum()),
    )
    return y, seen, count


def _missing(time: np.ndarray) -> int:
    """How many samples did not come, by the period of those that did."""
    steps = np.diff(np.unique(time)) / _period(time)
    return int(np.maximum(np.rint(steps) - 1, 0).sum())


def _period(time: np.ndarray) -> float:
    """A sensor's own period; two steps at a time, because stamps often alternate."""
    time = np.unique(time)
    return float(np.median(time[2:] - time[:-2])) / 2 if len(time) > 2 else np.inf


def _order(path: str | Path, plant: Plant) -> list[int]:
    names = [*GPS, "baro"]
    if plant.inputs:
        raise InputError(
            path, "plant.inputs", shown(plant.inputs[0]), "none: a flight holds no input"
        )
    for name in plant.outputs:
        if name not in names:
            raise InputError(path, "plant.outputs", shown(name), one_of(names, name))
    return [names.index(name) for name in plant.outputs]
