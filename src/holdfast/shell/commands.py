"""What the commands do, once their arguments are known."""

import dataclasses
import platform
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import rich.console
import rich.table

from holdfast import __version__, catalog, loop
from holdfast.campaign.calibrate import Calibration
from holdfast.estimators.kalman import Kalman
from holdfast.estimators.unknown_input import UnknownInput
from holdfast.parts import InvalidValue
from holdfast.plants.linear import LinearPlant
from holdfast.records import Trace
from holdfast.shell import runtime
from holdfast.shell.banks import hypotheses_of
from holdfast.shell.calibrating import busy, calibrated_scenario, dear
from holdfast.shell.errors import InputError
from holdfast.shell.logs import read_log
from holdfast.shell.reading import STANDARD_INPUT
from holdfast.shell.results import csv_blocks, write_result
from holdfast.shell.scenario import ScenarioFile, read_scenario
from holdfast.shell.simulating import simulated
from holdfast.shell.writing import FILES, check_place, unwritable

RUNS = 300
"""Simulated runs behind what a report says of the detector's blindness: the probability of
0.95 is then known to 0.013, and a newcomer waits 10 s."""
COSTLY_RUNS = 60
"""The same where every run has matrices or a covariance of its own, and a row costs a hundred
times as much: known to 0.03."""


def replay(scenario: str, log: str, output: str | None, allow_python: bool) -> None:
    """Estimate and detect over a recorded log; write the result."""
    runtime.configure()
    if scenario == log == STANDARD_INPUT:
        raise InputError("-", "", "scenario and log both from standard input", "one of the two")
    if output is not None:
        check_place(output)
    found = read_scenario(scenario, allow_python=allow_python)
    plant = found.scenario.plant
    recorded = read_log(log, plant)
    _check_length(found, len(recorded.time))
    ready, how = calibrated_scenario(found)
    trace = loop.replay(ready.monitor, recorded.observation)
    if output is None:
        for block in csv_blocks(trace, plant, recorded.time):
            sys.stdout.write(block)
        sys.stdout.flush()
    elif Path(output).suffix.lower() in FILES:
        write_result(output, trace, plant, recorded.time)
    else:
        name = "standard input" if log == STANDARD_INPUT else Path(log).name
        title = f"{Path(scenario).stem}: {name}"
        _report(output, title, found.source, ready, how, trace, recorded.time)


def run(
    scenario: str, runs: int | None, seed: int | None, output: str | None, allow_python: bool
) -> None:
    """Simulate a scenario; write its report, or print the scores."""
    runtime.configure()
    if output is not None:
        check_place(output)
    found = read_scenario(scenario, allow_python=allow_python)
    _check_length(found, found.run.steps)
    ready, how = calibrated_scenario(found)
    runs = found.run.runs if runs is None else runs
    seed = found.run.seed if seed is None else seed
    trace, time = simulated(ready, found.run.steps, runs, seed, found.path)
    if output is not None:
        title = f"{Path(scenario).stem}: {runs} run{'s' if runs > 1 else ''}, seed {seed}"
        _report(output, title, found.source, ready, how, trace, time)
        return
    from holdfast.report.tables import summary

    modes = hypotheses_of(ready.monitor.estimator)
    _print_scores(summary(trace, ready.plant, time, modes=modes))
    print(how.sentence)


def info() -> None:
    """Versions, precision, device, cache and catalog, a line each."""
    folder = runtime.configure()
    versions = {name: _version(name) for name in ("jax", "equinox", "numpy", "scipy", "xarray")}
    lines = {
        "holdfast": __version__,
        "python": platform.python_version(),
        **versions,
        "precision": str(jax.numpy.zeros(()).dtype),
        "device": ", ".join(str(device) for device in jax.devices()),
        "compiled code": str(folder) if folder else "not kept (HOLDFAST_CACHE, or no safe folder)",
    }
    for section, parts in catalog.SECTIONS.items():
        lines[section] = ", ".join(parts)
    width = max(map(len, lines))
    for name, text in lines.items():
        print(f"{name:{width}}  {text}")


def _version(name: str) -> str:
    from importlib.metadata import version

    return version(name)


def _report(
    folder: str,
    title: str,
    source: str,
    scenario: loop.Scenario,
    how: Calibration,
    trace: Trace,
    time: np.ndarray,
) -> None:
    from holdfast.report.page import write_report
    from holdfast.report.tables import summary

    plant, modes = scenario.plant, hypotheses_of(scenario.monitor.estimator)
    sentences, notes = _blind_spots(scenario)
    with busy("writing the report"):
        try:
            page = write_report(
                folder,
                trace=trace,
                plant=plant,
                time=time,
                title=title,
                scenario_text=source,
                summary=summary(trace, plant, time, modes=modes),
                calibration=_told(how),
                blindness=sentences,
                notes=notes,
                modes=modes,
            )
        except OSError as error:
            raise unwritable(folder, error) from None
    print(page)


def _told(how: Calibration) -> dict[str, Any]:
    """What there is to tell of a calibration: no counts of a simulation that was not needed."""
    return {
        name: value
        for name, value in dataclasses.asdict(how).items()
        if value is not None and (value != 0 or name == "seed")
    }


def _print_scores(scores: Mapping[str, Any]) -> None:
    """The scores as a table; ``per_run`` only with a report."""
    table = rich.table.Table(show_header=False, box=None, pad_edge=False)
    for name, value in _flat(scores):
        table.add_row(name, value)
    rich.console.Console().print(table)


def _flat(scores: Any, prefix: str = "") -> list[tuple[str, str]]:
    if not isinstance(scores, Mapping):
        return [(prefix, _number(scores))]
    if {"value", "low", "high"} <= scores.keys():
        value, low, high = (_number(scores[k]) for k in ("value", "low", "high"))
        count = f", {scores['hits']} of {scores['of']}" if "hits" in scores else ""
        return [(prefix, f"{value} ({low} to {high}{count})")]
    rows = []
    for name, value in scores.items():
        if name != "per_run":
            rows += _flat(value, f"{prefix}.{name}" if prefix else str(name))
    return rows


def _number(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _check_length(found: ScenarioFile, rows: int) -> None:
    """Matrices given per step must cover every row."""
    steps = getattr(found.scenario.plant, "steps", None)
    if steps is not None and rows > steps:
        raise InputError(found.path, "plant", f"matrices for {steps} steps", f"{rows}, one per row")


def _blind_spots(scenario: loop.Scenario) -> tuple[list[str], list[str]]:
    """Sentences on what the detector cannot see; or a note on why that is not known."""
    from holdfast.campaign.blindness import blindness

    plant, estimator = scenario.plant, scenario.monitor.estimator
    reason = dear(scenario.monitor)
    if reason:
        return [], [
            f"What the detector cannot see was not simulated: {reason}. "
            "holdfast.campaign.blindness does it, in minutes."
        ]
    constant = isinstance(plant, LinearPlant) and plant.schedule is None
    shared = constant and isinstance(estimator, Kalman | UnknownInput)
    runs = RUNS if shared else COSTLY_RUNS
    with busy("what the detector cannot see"):
        try:
            found = blindness(scenario.monitor, controller=scenario.controller, runs=runs)
        except InvalidValue as error:
            return [], [f"What the detector cannot see was not simulated ({error})."]
    return [one.sentence for one in found], []
