"""`holdfast analyse`: what can be said of a scenario's plant before any data."""

import json
from typing import Any

import numpy as np
import rich.console
import rich.table

from holdfast.analysis.advice import advice
from holdfast.analysis.assumptions import on_assumptions
from holdfast.analysis.fusion import Fusion, Remedy
from holdfast.analysis.mode_advice import on_modes
from holdfast.analysis.modes import Reduction, reduce
from holdfast.analysis.whole import Analysis, analysis
from holdfast.analysis.wording import between
from holdfast.analysis.zeros import Zero
from holdfast.estimators.l1_decoder import L1Decoder
from holdfast.estimators.nise import Nise
from holdfast.estimators.nisme import Nisme
from holdfast.loop import Scenario
from holdfast.shell import runtime
from holdfast.shell.attackable_content import (
    attackable_content,
    attackable_how,
    attackable_table,
    compromised_outputs,
)
from holdfast.shell.calibrating import busy
from holdfast.shell.decoding_content import (
    decoders_table,
    decoding_content,
    finite,
    named,
    ratio,
)
from holdfast.shell.modes_content import MOST, STEPS, modes_content, modes_table
from holdfast.shell.scenario import read_scenario

FUSING = ("decomposition", "secure_fusion")
"""Estimators that fuse local estimates."""
DECODING = ("l1_decoder", "l1_kalman")
"""Estimators that decode a window of samples."""
WEIGHING = ("nise", "nisme")
"""Estimators that assume a set of attacked channels, or weigh several."""


def analyse(scenario: str, compromised: str | None, as_json: bool, allow_python: bool) -> None:
    """Analyse the plant of a scenario; print a table and sentences, or JSON.

    ``compromised``: outputs that a stealthy attacker alters, separated by commas; or "all".
    """
    runtime.configure()
    found = read_scenario(scenario, allow_python=allow_python).scenario
    x0, P0 = _start(found)
    altered = compromised_outputs(compromised, found.plant.outputs)
    with busy("analysing the plant"):
        result = analysis(found.plant, x0, P0, **_decoder(found), compromised=altered)
        modes = reduce(found.plant, x0, STEPS, most=MOST)
    about = _about(found, altered is not None)
    delay = getattr(found.monitor.estimator, "delay", None)
    sentences = advice(result, delay, **about)
    weighed = _kind(found) in WEIGHING or len(found.plant.positions) > 1
    if weighed:
        sentences += on_modes(modes)
    sentences += on_assumptions(found.plant, x0, P0, _assumed(found))
    if as_json:
        shown = content(result, sentences) | {"modes": modes_content(modes)}
        print(json.dumps(shown, allow_nan=False, indent=1))
    else:
        _print(result, sentences, modes if weighed else None, **about)


def _start(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """The estimate before the first row; an estimator that has none: the plant's x0, and I."""
    estimator = scenario.monitor.estimator
    x0 = getattr(estimator, "x0", scenario.x0)
    P0 = getattr(estimator, "P0", np.eye(len(scenario.plant.states)))
    return np.asarray(x0, float), np.asarray(P0, float)


def _kind(scenario: Scenario) -> str:
    return type(scenario.monitor.estimator).__module__.rpartition(".")[2]


def _assumed(scenario: Scenario) -> list[tuple[int, ...]]:
    """The sets of channels that the filters of NISE or NISME take as attacked."""
    estimator, active = scenario.monitor.estimator, []
    if isinstance(estimator, Nise):
        active = [estimator.free.active]
    if isinstance(estimator, Nisme):
        active = list(np.asarray(estimator.sets.active))
    return [tuple(np.flatnonzero(mode).tolist()) for mode in active]


def _about(scenario: Scenario, asked: bool) -> dict[str, bool]:
    """Whether the scenario is about fusion, decoding or stealth: by its estimator.

    Of other estimators, where the plant has no attack channels, it may be about any of them;
    and about stealth where that was ``asked`` for.
    """
    kind, open_to_all = _kind(scenario), not scenario.plant.attacks
    return {
        "fusion": kind in FUSING or (open_to_all and kind not in DECODING),
        "decoding": kind in DECODING or (open_to_all and kind not in FUSING),
        "stealth": asked or (open_to_all and kind not in FUSING + DECODING),
    }


def _decoder(scenario: Scenario) -> dict[str, Any]:
    """Of a decoder: its window, whom it always trusts, whether it weighs samples by their noise."""
    estimator = scenario.monitor.estimator
    decoder = getattr(estimator, "decoder", estimator)
    if not isinstance(decoder, L1Decoder):
        return {}
    return {
        "window": decoder.window.length,
        "trusted": tuple(np.flatnonzero(decoder.window.honest).tolist()),
        "weighted": decoder.weights == "noise",
    }


def content(found: Analysis, sentences: list[str]) -> dict[str, Any]:
    """The analysis as JSON has it: plain lists and numbers, None for what there is not."""
    seen, steady, window = found.observability, found.steady, found.window
    return {
        "observable": seen.observable,
        "observability_index": seen.rows,
        "unobserved": [named(v, found.model.states) for v in seen.hidden.T],
        "eigenvalues": [_pair(value) for value in seen.eigenvalues],
        "unstable": seen.unstable,
        "steady_state": {
            "K": None if steady.K is None else steady.K.tolist(),
            "P": None if steady.P is None else steady.P.tolist(),
            "P_pred": None if steady.P_pred is None else steady.P_pred.tolist(),
            "reason": steady.reason,
        },
        "attacks": _attacks(found),
        "window": None if window is None else window._asdict(),
        "correctable": decoding_content(found.decoding, found.model.states),
        "fusion": _fusion(found.fusion),
        "attackable": attackable_content(found),
        "attackable_how": attackable_how(found),
        "of": found.model.note or None,
        "advice": sentences,
    }


def _attacks(found: Analysis) -> dict[str, Any]:
    attacks, names = found.attacks, found.model.attacks
    return {
        "channels": {
            channel.name: {
                "direct": channel.direct,
                "delay": channel.delay,
                "reason": channel.reason,
                "sensors": [sensor._asdict() for sensor in channel.sensors],
            }
            for channel in attacks.channels
        },
        "delay": attacks.delay,
        "identified": all(channel.delay is not None for channel in attacks.channels),
        "rank": attacks.transfer.rank,
        "invisible": [named(v, names) for v in attacks.transfer.lost.T],
        "zeros": [_zero(zero, found) for zero in attacks.transfer.zeros],
        "shields": list(attacks.shields),
        "bounded": [bounds._asdict() for bounds in found.bounds],
    }


def _fusion(found: Fusion) -> dict[str, Any]:
    by_name = [dict(zip(found.sensors, v.tolist(), strict=True)) for v in found[2:4]]
    by_count = [{str(p): x for p, x in enumerate(v.tolist(), 1)} for v in found[4:6]]
    return {
        "ratio": {name: ratio(by_name[0][name], by_name[1][name]) for name in found.sensors},
        "lower": finite(by_name[0]),
        "upper": finite(by_name[1]),
        "bounded": dict(zip(found.sensors, found.bounded, strict=True)),
        "all_p": {p: ratio(by_count[0][p], by_count[1][p]) for p in by_count[0]},
        "all_p_bounds": {"lower": finite(by_count[0]), "upper": finite(by_count[1])},
        "withstood": found.withstood,
        "sparse_observable": found.sparse_observable,
        "authenticate": [_remedy(remedy) for remedy in found.authenticate],
        "add": [_remedy(remedy) for remedy in found.add],
        "untried": found.untried,
        "condition": found.condition,
        "derogatory": found.derogatory,
        "reason": found.reason,
    }


def _remedy(remedy: Remedy) -> dict[str, Any]:
    bounds = finite({"lower": remedy.lower, "upper": remedy.upper})
    known = ratio(remedy.lower, remedy.upper)
    return {"name": remedy.name, "ratio": known, **bounds, "enough": remedy.enough}


def _zero(zero: Zero, found: Analysis) -> dict[str, Any]:
    model = found.model
    return {
        "z": _pair(zero.z),
        "unstable": zero.unstable,
        "multiplicity": zero.multiplicity,
        "attack": [_complex(v, model.attacks) for v in zero.attack.T],
        "state": [_complex(v, model.states) for v in zero.state.T],
    }


def _complex(vector: np.ndarray, names: tuple[str, ...]) -> dict[str, list[float]]:
    return {name: _pair(value) for name, value in zip(names, vector, strict=True)}


def _pair(value: complex) -> list[float]:
    value = complex(value)
    return [value.real + 0.0, value.imag + 0.0]


def _print(
    found: Analysis,
    sentences: list[str],
    modes: Reduction | None,
    fusion: bool,
    decoding: bool,
    stealth: bool,
) -> None:
    console = rich.console.Console()
    table = rich.table.Table(show_header=False, box=None, pad_edge=False)
    for name, text in _rows(found):
        table.add_row(name, text)
    console.print(table)
    if found.attacks.channels:
        console.print(_channels(found))
    if fusion and found.fusion.sensors:
        console.print(_liars(found.fusion))
    if decoding and found.decoding.correctable.reason is None:
        console.print(decoders_table(found.decoding.correctable))
    if stealth and found.attackable.reason is None:
        console.print(attackable_table(found.attackable))
    if modes is not None and modes.reason is None:
        console.print(modes_table(modes))
    for sentence in sentences:
        console.print(f"- {sentence}", markup=False, highlight=False, soft_wrap=True)


def _rows(found: Analysis) -> list[tuple[str, str]]:
    seen, steady = found.observability, found.steady
    index = "" if seen.rows is None else f", from {seen.rows} row{'s' if seen.rows > 1 else ''}"
    rows = [
        ("observable", f"{'yes' if seen.observable else 'no'}{index}"),
        ("eigenvalues", ", ".join(f"{_number(value)}" for value in seen.eigenvalues)),
        ("unstable", str(seen.unstable)),
    ]
    if steady.P is not None:
        deviations = zip(found.model.states, np.sqrt(np.diagonal(steady.P)), strict=True)
        rows.append(("steady-state sd", ", ".join(f"{n} {sd:.3g}" for n, sd in deviations)))
    if found.attacks.transfer.zeros:
        zeros = ", ".join(
            _number(zero.z) + (f" ({zero.multiplicity} times)" if zero.multiplicity > 1 else "")
            for zero in found.attacks.transfer.zeros
        )
        rows.append(("invariant zeros", zeros))
    return rows


def _channels(found: Analysis) -> rich.table.Table:
    table = rich.table.Table(box=None, pad_edge=False)
    for heading in ("attack", "enters", "identified with delay", "variance settles"):
        table.add_column(heading)
    last = found.bounds[-1]
    words = {True: "yes", False: "no", None: f"not within {last.steps} steps"}
    for channel in found.attacks.channels:
        never = channel.delay is None
        table.add_row(
            channel.name,
            "an output" if channel.direct else "the state",
            "never" if never else str(channel.delay),
            "-" if never else words[last.attack[channel.name]],
        )
    return table


def _liars(found: Fusion) -> rich.table.Table:
    table = rich.table.Table(box=None, pad_edge=False)
    for heading in ("sensor", "worst ratio", "bounded under a lie"):
        table.add_column(heading)
    for name, lower, upper, bounded in zip(
        found.sensors, found.lower, found.upper, found.bounded, strict=True
    ):
        table.add_row(name, between(lower, upper), "yes" if bounded else "no")
    return table


def _number(value: complex) -> str:
    value = complex(value)
    return f"{value.real:.4g}" if abs(value.imag) <= 1e-12 * abs(value) else f"{value:.4g}"
