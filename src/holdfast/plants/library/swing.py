"""Swing-equation networks from lists of lines: any, and the 68-bus system of the NISME paper."""

import csv
import itertools
from collections.abc import Sequence
from importlib import resources

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from holdfast.parts import InvalidValue
from holdfast.plants.library.swing_network import MEASURED, SwingNetwork
from holdfast.plants.named import channels

ATTACKS = (
    "sensor:P_elec:26", "sensor:P_elec:53", "sensor:P_elec:54",
    "actuator:14", "actuator:15", "actuator:16",
)  # fmt: skip
SWITCHES = (("56-57",), ("59-60",))
GENERATORS = range(1, 17)
"""Where the paper's attacker can act, and its generators."""


def build(
    *,
    dt: float = 0.01,
    substeps: int = 1,
    strength: float = 1.5,
    damping: float = 1.0,
    generator_inertia: float = 10.0,
    load_inertia: float = 100.0,
    process_sd: float = 0.01,
    sensor_sd: float = 1e-4,
    attacks: Sequence[str] = ATTACKS,
    switches: Sequence[Sequence[str]] = SWITCHES,
) -> SwingNetwork:
    """The IEEE 68-bus system of the paper's case studies: `network` on its 83 branches.

    states (136), inputs (68), outputs (204), attacks (6); buses 1 to 16 are generators.

    Raises `InvalidValue` as `network`.

    Source: NISME, Section 7; topology: NETS-NYPS 68-bus system.
    """
    return network(
        lines=lines68(),
        generators=list(GENERATORS),
        dt=dt,
        substeps=substeps,
        strength=strength,
        damping=damping,
        generator_inertia=generator_inertia,
        load_inertia=load_inertia,
        process_sd=process_sd,
        sensor_sd=sensor_sd,
        attacks=attacks,
        switches=switches,
    )


def lines68() -> list[list[float]]:
    """The two buses of each of the 83 branches of the 68-bus system."""
    text = resources.files("holdfast.plants.library").joinpath("lines68.csv").read_text()
    return [[float(row["from"]), float(row["to"])] for row in csv.DictReader(text.splitlines())]


def network(
    *,
    lines: Sequence[Sequence[float]],
    generators: Sequence[int],
    dt: float = 0.01,
    substeps: int = 1,
    strength: float = 1.5,
    damping: float = 1.0,
    generator_inertia: float = 10.0,
    load_inertia: float = 100.0,
    demand: Sequence[float] | None = None,
    process_sd: float = 0.01,
    sensor_sd: float = 1e-4,
    attacks: Sequence[str] = (),
    switches: Sequence[Sequence[str]] = (),
) -> SwingNetwork:
    """A network from its lines: rows of two bus numbers, and t (per unit) where it is not
    ``strength``. Two rows with the same buses are parallel lines.

    ``generators``: bus numbers; every other bus is a load bus. ``damping`` D;
    ``generator_inertia``, ``load_inertia`` m (s); ``demand``: the constant part of P_L per bus
    in increasing order of their numbers (default 0). ``process_sd``: of w, held over a sample
    of ``dt`` seconds, so that it adds dt w to the state; ``sensor_sd``: of v.

    ``attacks``: "actuator:BUS", "sensor:P_elec:BUS", "sensor:theta:BUS" or "sensor:f:BUS".
    ``switches``: groups of lines "BUS-BUS" that open together. The positions are every
    combination of groups open, fewest first: "normal", "56-57", "59-60", "56-57+59-60".

    Raises `InvalidValue` for a line, bus, attack or switch that cannot be.
    """
    positive = {
        "dt": dt, "damping": damping, "strength": strength, "process_sd": process_sd,
        "sensor_sd": sensor_sd, "generator_inertia": generator_inertia,
        "load_inertia": load_inertia, "substeps": substeps,
    }  # fmt: skip
    for key, value in positive.items():
        if not (np.isfinite(value) and value > 0):
            raise InvalidValue(key, value, "a number above 0")
    ends, strengths = _lines(lines, strength)
    buses = sorted({bus for pair in ends for bus in pair})
    place = {bus: i for i, bus in enumerate(buses)}
    for i, bus in enumerate(generators, 1):
        if bus not in place:
            raise InvalidValue(f"generators[{i}]", bus, "the number of a bus with a line")
    load = np.array([bus not in generators for bus in buses], float)
    n = len(buses)
    places = np.array([[place[bus] for bus in pair] for pair in ends], np.int32).T
    positions, closed = _positions(switches, ends)
    outputs = [f"{kind}:{bus}" for bus in buses for kind in MEASURED]
    written = "'actuator:BUS' or 'sensor:P_elec|theta|f:BUS'"
    actuators, sensors = channels(attacks, [str(bus) for bus in buses], outputs, expected=written)
    arrays = {
        "ends": places,
        "incidence": np.eye(n)[:, places[0]] - np.eye(n)[:, places[1]],
        "strength": strengths,
        "closed": closed,
        "inertia": np.where(load == 1.0, load_inertia, generator_inertia),
        "damping": np.full(n, float(damping)),
        "demand": _demand(demand, n),
        "load": load,
        "actuators": actuators,
        "sensors": sensors,
    }
    return SwingNetwork(
        **{name: jnp.asarray(array) for name, array in arrays.items()},
        position=jnp.asarray(0, jnp.int32),
        deviation=(jnp.full(2 * n, dt * process_sd), jnp.full(3 * n, float(sensor_sd))),
        buses=tuple(buses),
        switched=positions,
        dt=float(dt),
        substeps=substeps,
        states=tuple(f"{kind}:{bus}" for kind in ("theta", "f") for bus in buses),
        inputs=tuple(f"power:{bus}" for bus in buses),
        outputs=tuple(outputs),
        attacks=tuple(attacks),
    )


def operating_point(plant: SwingNetwork) -> Float[Array, " nx"]:
    """theta_i = 0.3 sin(i) rad for the bus with number i, f = 0 (errata 11).

    At a flat point the flows are so small that switching a line can hardly be seen.
    """
    theta = 0.3 * jnp.sin(jnp.asarray(plant.buses, float))
    return jnp.concatenate([theta, jnp.zeros_like(theta)])


def _lines(
    lines: Sequence[Sequence[float]], strength: float
) -> tuple[list[tuple[int, int]], np.ndarray]:
    """The buses of each line, and its t."""
    if not len(lines):
        raise InvalidValue("lines", "an empty list", "at least one line")
    ends, strengths = [], []
    for i, row in enumerate(lines, 1):
        if len(row) not in (2, 3):
            raise InvalidValue(f"lines[{i}]", f"{len(row)} numbers", "two buses, or also t")
        pair = [int(bus) if np.isfinite(bus) else -1 for bus in row[:2]]
        if pair != list(row[:2]) or min(pair) < 0 or pair[0] == pair[1]:
            raise InvalidValue(f"lines[{i}]", list(row), "the numbers of two different buses")
        t = row[2] if len(row) == 3 else strength
        if not (np.isfinite(t) and t > 0):
            raise InvalidValue(f"lines[{i}]", f"t = {t}", "t above 0")
        ends.append((pair[0], pair[1]))
        strengths.append(float(t))
    return ends, np.array(strengths)


def _demand(demand: Sequence[float] | None, n: int) -> np.ndarray:
    found = np.zeros(n) if demand is None else np.asarray(demand, float)
    if found.shape != (n,) or not np.all(np.isfinite(found)):
        raise InvalidValue("demand", f"shape {found.shape}", f"{n} finite numbers, one per bus")
    return found


def _positions(
    switches: Sequence[Sequence[str]], ends: list[tuple[int, int]]
) -> tuple[tuple[str, ...], np.ndarray]:
    """The name of every position, and which lines are closed in it."""
    known = {f"{a}-{b}": {a, b} for first, last in ends for a, b in ((first, last), (last, first))}
    for i, group in enumerate(switches, 1):
        for line in group:
            if line not in known:
                raise InvalidValue(f"switches[{i}]", repr(line), "a line of the network, as '1-2'")
    opened = [line for group in switches for line in group]
    if not all(switches) or len({frozenset(known[line]) for line in opened}) != len(opened):
        raise InvalidValue("switches", [list(g) for g in switches], "groups, each line once")
    names, closed = [], []
    for count in range(len(switches) + 1):
        for groups in itertools.combinations(switches, count):
            opened = [line for group in groups for line in group]
            names.append("+".join(opened) or "normal")
            gone = [known[line] for line in opened]
            closed.append([float(set(pair) not in gone) for pair in ends])
    return tuple(names), np.array(closed)
