"""Water tanks, one above the other: pumps fill them, water falls through pipes and outlets.

    A_i h_i' = sum of the pumps into i + sum over pipes j -> i of q_ji
               - sum over pipes i -> l of q_il - outlet of i,
    q = c sqrt(2 g) root(h) of the tank that the water leaves,
    root(h) = h / (h^2 + e^2)^(1/4),   e = 1 mm

h (m) levels, A (m^2) areas, c (m^2) openings, q and the pumps (m^3/s). root stands for the square
root of Torricelli's law: it is smooth and grows everywhere, with the derivative e^(-1/2) at 0 and
less elsewhere; it is below the square root by e^2 / (4 h^2) of it, 1e-3 at 1.6 cm and 1e-4 at 5 cm;
at 0 it is 0, and odd, so that a level that noise took below 0 comes back.

Source: Torricelli's law; a plant of our own.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from holdfast.numerics.linalg import dot
from holdfast.parts import InvalidValue
from holdfast.plants.named import channels
from holdfast.plants.nonlinear import NonlinearPlant, nonlinear_plant, sampled

GRAVITY = 9.81
SMALL = 1e-3
"""e of `root`, m."""
AREAS = (0.5, 0.5, 0.6, 0.7)
PIPES = ((1, 3, 0.003), (2, 4, 0.003), (1, 4, 0.0012))
OUTLETS = ((3, 0.0028), (4, 0.004))
PUMPS, FLOWS = (1, 2), (0.022, 0.015)
METERS = ("2-4", "3-out", "4-out")
"""Two tanks above two others, one pipe crossing over: m^2, [from, to, m^2], [tank, m^2]; the tanks
with a pump and its flow at the operating point, m^3/s; where flow is measured."""


class Network(NamedTuple):
    """What leads where. ``falls`` (n x n): A h' = falls root(h) + pumped u."""

    areas: np.ndarray
    falls: np.ndarray
    pumped: np.ndarray
    ways: dict[str, np.ndarray]
    """The flow through each pipe and outlet by its name, as a row times root(h)."""


def build(
    *,
    areas: Sequence[float] = AREAS,
    pipes: Sequence[Sequence[float]] = PIPES,
    outlets: Sequence[Sequence[float]] = OUTLETS,
    pumps: Sequence[int] = PUMPS,
    meters: Sequence[str] = METERS,
    dt: float = 1.0,
    height: float = 2.5,
    max_flow: float = 0.05,
    process_sd: float = 5e-4,
    level_sd: float = 0.01,
    flow_sd: float = 2e-4,
    attacks: Sequence[str] = (),
) -> NonlinearPlant:
    """A network of tanks 1, 2, .., as many as there are ``areas`` (m^2).

    ``pipes``: rows [from, to, opening in m^2], downwards; ``outlets``: rows [tank, opening];
    ``pumps``: the tanks that a pump fills. All levels are measured, and the flow at ``meters``,
    each a pipe "1-3" or an outlet "3-out". By default four tanks, whose levels can all be told
    without any one of the sensors.

    states level:TANK (m), inputs pump:TANK (m^3/s, the flow itself and not a deviation from
    one), outputs level:TANK (m), then flow:METER (m^3/s). ``attacks``: the attack channels,
    "actuator:pump:1", "sensor:level:3", "sensor:flow:3-out", .. (`holdfast.plants.named`).

    Sampled by Runge-Kutta over ``dt`` seconds, u and d held, in as many steps (2 by default) as
    keep a tank that runs empty from a level below 0. Standard deviations of a step and a sample:
    ``process_sd`` (m), ``level_sd`` (m), ``flow_sd`` (m^3/s). Limits: 0 <= level <= ``height``
    (m), and on command plus attack of a pump 0 and ``max_flow`` (m^3/s); inf for none.

    Raises `InvalidValue` for a number, a tank or a name that cannot be.
    """
    given = {"dt": dt, "process_sd": process_sd, "level_sd": level_sd, "flow_sd": flow_sd}
    for key, value in given.items():
        _above_0(key, value)
    for key, value in {"height": height, "max_flow": max_flow}.items():
        if not value > 0:
            raise InvalidValue(key, value, "a number above 0, or inf for no limit")
    found = _network(areas, pipes, outlets, pumps)
    n, metered = len(areas), _metered(meters, found)
    levels, inputs = [f"level:{i + 1}" for i in range(n)], [f"pump:{tank}" for tank in pumps]
    outputs = [*levels, *(f"flow:{name}" for name in meters)]
    act, sens = channels(attacks, inputs, outputs)
    rate, output = _functions(found, metered, act, sens)
    deviations = np.repeat([level_sd, flow_sd], [n, len(meters)])
    return nonlinear_plant(
        sampled(rate, dt, _substeps(found, dt)),
        output,
        Q=process_sd**2 * np.eye(n),
        R=np.diag(deviations**2),
        dt=dt,
        states=levels,
        inputs=inputs,
        outputs=outputs,
        attacks=attacks,
        constraints=_limits(n, act, height, max_flow),
    )


def operating_point(
    flows: Sequence[float] = FLOWS,
    *,
    areas: Sequence[float] = AREAS,
    pipes: Sequence[Sequence[float]] = PIPES,
    outlets: Sequence[Sequence[float]] = OUTLETS,
    pumps: Sequence[int] = PUMPS,
) -> np.ndarray:
    """The levels (m) that stay where they are while the pumps give ``flows`` (m^3/s).

    0 = falls root(h) + pumped u is linear in root(h), and root has an inverse:
    h^2 = (r^4 + sqrt(r^8 + 4 e^2 r^4)) / 2. Whether the tanks are that high is not asked.

    Raises `InvalidValue` as `build`, for flows that cannot be, and for a tank that nothing leaves.
    """
    found = _network(areas, pipes, outlets, pumps)
    if len(flows) != len(pumps) or not all(np.isfinite(q) and q >= 0 for q in flows):
        raise InvalidValue("flows", list(flows), f"{len(pumps)} flows, 0 or more")
    for tank, closed in enumerate(np.diagonal(found.falls) == 0, 1):
        if closed:
            raise InvalidValue("outlets", f"no way out of tank {tank}", "one out of every tank")
    fourth = np.linalg.solve(-found.falls, found.pumped @ np.asarray(flows, float)) ** 4
    return np.sqrt((fourth + np.sqrt(fourth**2 + 4 * SMALL**2 * fourth)) / 2)


def _root(h):
    return h / jnp.sqrt(jnp.sqrt(h * h + SMALL**2))


def _functions(
    found: Network, metered: np.ndarray, act: np.ndarray, sens: np.ndarray
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The rate of the levels and the measurement, of x, u, d."""
    falls, filled = (jnp.asarray(m / found.areas[:, None]) for m in (found.falls, found.pumped))
    flows, acting, shown = map(jnp.asarray, (metered, act, sens))

    def rate(x, u, d):
        return dot(falls, _root(x)) + dot(filled, u + dot(acting, d))

    def output(x, u, d):
        return jnp.concatenate([x, dot(flows, _root(x))]) + dot(shown, d)

    return rate, output


def _substeps(found: Network, dt: float) -> int:
    """So many that no step is longer than the shortest time in which a tank's level fades.

    The stages of an emptying tank's step then stay at 0 or above, because root(h) <= h e^(-1/2).
    """
    fastest = np.max(-np.diagonal(found.falls) / found.areas) / np.sqrt(SMALL)
    return max(1, int(np.ceil(dt * fastest)))


def _limits(n: int, act: np.ndarray, height: float, max_flow: float) -> dict[str, dict[str, Any]]:
    """Levels within the tanks; pumps that can be attacked give neither too much nor less than 0."""
    each = np.eye(len(act))[np.any(act, axis=1)]
    both = np.vstack([each, -each])
    return {
        "state": {
            "matrix": np.vstack([np.eye(n), -np.eye(n)]),
            "bound": np.repeat([height, 0.0], n),
        },
        "attack": {
            "matrix": both @ act,
            "bound": np.repeat([max_flow, 0.0], len(each)),
            "bound_u": -both,
        },
    }


def _network(
    areas: Sequence[float],
    pipes: Sequence[Sequence[float]],
    outlets: Sequence[Sequence[float]],
    pumps: Sequence[int],
) -> Network:
    """The matrices of a network whose parts have been checked."""
    if not len(areas):
        raise InvalidValue("areas", "an empty list", "at least one area")
    for i, area in enumerate(areas, 1):
        _above_0(f"areas[{i}]", area)
    n = len(areas)
    falls, above, ways = np.zeros((n, n)), np.zeros((n, n), bool), {}
    for key, rows, ends in (("pipes", pipes, 2), ("outlets", outlets, 1)):
        for i, row in enumerate(rows, 1):
            source, *target, opening = _way(f"{key}[{i}]", row, ends, n)
            name = f"{source + 1}-{target[0] + 1 if target else 'out'}"
            if name in ways:
                raise InvalidValue(f"{key}[{i}]", list(row), f"one row for {name}")
            flow = opening * np.sqrt(2 * GRAVITY)
            ways[name] = flow * np.eye(n)[source]
            falls[source, source] -= flow
            for tank in target:
                falls[tank, source] += flow
                above[tank, source] = True
    if np.any(np.linalg.matrix_power(above, n)):
        raise InvalidValue("pipes", "pipes in a circle", "pipes that lead downwards")
    for i, tank in enumerate(pumps, 1):
        if tank not in range(1, n + 1) or tank in pumps[: i - 1]:
            raise InvalidValue(f"pumps[{i}]", tank, f"a tank, 1 to {n}, each once")
    pumped = np.eye(n)[:, [tank - 1 for tank in pumps]]
    return Network(np.asarray(areas, float), falls, pumped, ways)


def _way(key: str, row: Sequence[float], ends: int, n: int) -> tuple[Any, ...]:
    """The places of the tanks at the ends of a pipe or an outlet, and its opening."""
    *tanks, opening = row if len(row) else (np.nan,)
    known = all(tank in range(1, n + 1) for tank in tanks)
    if len(tanks) != ends or not known or len(set(tanks)) != ends:
        named = "[tank, opening]" if ends == 1 else "[from, to, opening], two different tanks"
        raise InvalidValue(key, list(row), f"{named}, 1 to {n}")
    if not (np.isfinite(opening) and opening > 0):
        raise InvalidValue(key, list(row), "an opening above 0")
    return *(int(tank) - 1 for tank in tanks), float(opening)


def _metered(meters: Sequence[str], found: Network) -> np.ndarray:
    """The rows of the flows that are measured."""
    for i, name in enumerate(meters, 1):
        if name not in found.ways:
            raise InvalidValue(f"meters[{i}]", repr(name), f"one of {', '.join(found.ways)}")
    if len(set(meters)) != len(meters):
        raise InvalidValue("meters", list(meters), "names that differ")
    return np.array([found.ways[name] for name in meters]).reshape(-1, len(found.areas))


def _above_0(key: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise InvalidValue(key, value, "a number above 0")
