"""A vehicle with three positions and two speeds, its engine, and streams for it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from holdfast.attacks import bias
from holdfast.detectors import chi_square
from holdfast.estimators import kalman
from holdfast.loop import Monitor, Scenario, simulate
from holdfast.plants.build import linear_plant
from holdfast.shell.live import Live
from holdfast.shell.service.clock import SourceClock
from holdfast.shell.service.engine import Engine
from holdfast.shell.service.estimation import Estimation
from holdfast.shell.service.fallback import Fallback
from holdfast.shell.service.frames import Frames
from holdfast.shell.service.health import Rules
from holdfast.shell.service.records import Labels, Samples
from holdfast.shell.service.watching import watch_of

DT = 0.1
OUTPUTS = ("gps", "radar", "beacon", "wheel", "flow")
RULES = Rules(1e-6, 20, 5, 50)


def vehicle():
    """Position and speed, driven by a known acceleration."""
    return linear_plant(
        dt=DT, A=[[1, DT], [0, 1]], B=[[DT**2 / 2], [DT]],
        C=[[1, 0], [1, 0], [1, 0], [0, 1], [0, 1]],
        Q=np.diag([1e-4, 1e-3]), R=np.diag([1.0, 0.5, 0.8, 0.04, 0.09]),
        states=["position", "speed"], inputs=["accel"], outputs=list(OUTPUTS),
    )  # fmt: skip


def monitor_of(plant):
    """A Kalman filter with a chi-square test."""
    estimator = kalman.build(plant, np.zeros(2), np.diag([1.0, 1.0]))
    return Monitor(estimator, chi_square.build(plant, on="residual"))


PLANT = vehicle()
MONITOR = monitor_of(PLANT)


@dataclasses.dataclass
class Made:
    """Compiled once for all tests: engines differ in their state alone."""

    live: Live
    beside: Live
    watch: object


_made: list[Made] = []


def made() -> Made:
    """The compiled parts."""
    if not _made:
        _made.append(Made(Live(MONITOR), Live(MONITOR), watch_of(PLANT)))
    return _made[0]


def engine(
    grace=0.0, arrival=False, refilter=0, active=True, rule="none", retry=500, rules=RULES,
    pointed=None, authentication=None,
):  # fmt: skip
    """An engine at its beginning. Engines share compiled parts: one at a time."""
    parts = made()
    parts.live.reset()
    parts.beside.reset()
    labels = Labels.of("vehicle", PLANT, MONITOR.estimator.init()[1])
    nothing = np.zeros(len(OUTPUTS), bool)
    estimation = Estimation(
        parts.live, parts.watch, rules, active, retry, refilter, pointed or (lambda _: nothing)
    )
    fallback = Fallback(rule, 5, None if rule == "none" else parts.beside)
    frames = Frames(DT, labels.columns, grace, SourceClock(arrival, 1.0))
    return Engine(labels, frames, estimation, fallback, refilter, authentication)


def trace_of(steps=400, seed=0, attacks=()):
    """A simulated run under these attacks, held at rest by no controller."""
    scenario = Scenario(PLANT, jnp.zeros(2), MONITOR, None, tuple(attacks))
    return simulate(scenario, jax.random.key(seed), steps)


def spoof(channel="sensor:gps", start=10.0, stop=20.0, value=15.0):
    """A bias on one sensor."""
    return bias.build(PLANT, channel=channel, start=start, stop=stop, value=value)


def stream(trace):
    """The trace's rows as whole messages."""
    u, y = np.asarray(trace.observation.u), np.asarray(trace.observation.y)
    for k in range(len(u)):
        values = {"u:accel": float(u[k, 0])}
        values |= {f"y:{name}": float(y[k, i]) for i, name in enumerate(OUTPUTS)}
        yield Samples((k + 1) * DT, values, whole=True)


def played(found, messages, now=0.0):
    """All rows and events of a stream."""
    rows, events = [], []
    for samples in messages:
        worked = found.take(samples, now)
        rows += worked.rows
        events += worked.events
    worked = found.finish()
    return rows + worked.rows, events + worked.events


def states_of(rows):
    """The states of all rows."""
    return np.array([row.estimate.x for row in rows])
