"""A commented scenario to start from, made from the catalog so that it always fits."""

import inspect
import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from holdfast.catalog import SECTIONS
from holdfast.parts import Plant
from holdfast.shell.errors import InputError, one_of
from holdfast.shell.scenario import judged
from holdfast.shell.schema import in_words, model_of

KINDS = {
    "plant": "linear",
    "estimator": "unknown_input",
    "detector": "chi_square",
    "attack": "bias",
}
"""What a template has unless it is asked for something else."""

NEEDS = {
    "switch": {"plant": "swing", "estimator": "nisme"},
    "linearising": {"plant": "swing"},
}
"""What goes with those that do not work with what a template has."""

REQUIRED = {
    "epsilon": 0.001,
    "value": 3.0,
    "rate": 0.5,
    "amplitude": 3.0,
    "frequency": 0.5,
    "sd": 3.0,
    "count": 1,
    "seconds": 2.0,
    "size": 0.5,
}
"""Values for keys that have no default."""

HEAD = """\
# A holdfast scenario. Lines that begin with # are comments; a key behind one is optional and
# shown with its default. Try:
#     holdfast run THIS_FILE -o report
#     holdfast replay THIS_FILE LOG.csv -o report
"""

LINEAR = """\
[plant]
# Row k: x_k = A x_{k-1} + B u_k + G d_{k-1} + w,  y_k = C x_k + D u_k + H d_k + v,
# w ~ N(0, Q), v ~ N(0, R). B, D, G, H may be left out. Any matrix may be
# { file = "plant.npz", name = "A" } (.mat, .npz, .csv), relative to this file.
kind = "linear"
time = "discrete"               # or "continuous", with method = "zoh" | "euler"
dt = 0.1                        # seconds
A = [[1.0, 0.1], [0.0, 1.0]]
B = [[0.005], [0.1]]
C = [[1.0, 0.0], [0.0, 1.0]]
G = [[0.005], [0.1]]            # how each attack channel moves the state
Q = [[1e-6, 0.0], [0.0, 1e-4]]
R = [[0.25, 0.0], [0.0, 0.0025]]
states = ["position", "speed"]
inputs = ["accel"]
outputs = ["gps", "wheel"]
attacks = ["accel_attack"]      # one name per column of G and H
x0 = [0.0, 0.0]                 # the true initial state (run only)

# [plant.constraints]           # what physics allows: matrix z <= bound (+ bound_u u)
# state  = { matrix = [[1, 0]], bound = [20] }
# attack = { matrix = [[1], [-1]], bound = [3.5, 3.5] }
"""

EXAMPLES: dict[str, dict[str, Any]] = {
    "bicycle": {
        "plant": {"length": 100.0},
        "x0": [2.0, 2.5, 0.0, 10.0],
        "channel": "channel:accel_attack",
    },
    "swing": {
        "plant": {
            "lines": [[1, 2], [2, 3], [3, 1]],
            "generators": [1],
            "attacks": ["actuator:1", "sensor:P_elec:2"],
            "switches": [["1-2"]],
        },
        "x0": [0.3, -0.4, 0.1, 0.0, 0.0, 0.0],
    },
    "tanks": {"plant": {"attacks": ["actuator:pump:1"]}, "x0": [1.4, 1.27, 1.61, 1.44]},
    "unicycle": {"plant": {"landmarks": [[4.0, 1.0], [1.0, 5.0], [-3.0, 2.0], [2.0, -4.0]]}},
}
"""What suits a plant better than zeros: where it starts (power flows only between different
angles, water only out of tanks that are not empty), and what to attack."""

NOTES = {
    "x0": "estimate one sample before the first row",
    "P0": "and its covariance; a list of numbers is its diagonal",
    "mode": "the attack channels that are attacked",
    "modes": 'also: "all", or a list of modes: [] for none, ["NAME", ..], '
    '{ name = .., attacks = [..], switch = ".." }',
    "floor": "no mode's probability falls below it",
    "likelihood": "also: paper, quadratic (to compare with)",
    "attack_prior_sd": "how large an attack may well be; one number, or one per attack",
    "transition": "a number: chance per row that the mode changes; or rows of them",
    "bank": 'the modes that have a filter: a list, or "reduced" (with window = ROWS)',
    "level": "false-alarm budget of naming channels, with a bank",
    "freeze": "hold gains that change by less, in standard deviations",
}
"""What the keys of an estimator are, where their type says too little."""

FEW = 8
"""States up to which a template has the whole of P0."""

RUN = """\
# [enforcement]                 # (run only) samples that are authenticated, so never falsified:
# every = 20                    # of every so many rows
# for = 1                       # the first so many,
# first = 20                    # from this row on; [enforcement.sensors.NAME] for one sensor

[run]
steps = 300
runs = 1
seed = 0
"""


def scenario_text(kind: str | None) -> str:
    """The template, with the part of the catalog called ``kind`` in its place."""
    kinds: dict[str, str] = dict(KINDS)
    if kind is not None:
        section = next((name for name, parts in SECTIONS.items() if kind in parts), None)
        if section is None:
            known = [name for parts in SECTIONS.values() for name in parts]
            raise InputError("new", "KIND", repr(kind), one_of(known, kind))
        kinds[section] = kind
        kinds |= NEEDS.get(kind, {})
    build = SECTIONS["plant"][kinds["plant"]]
    example = EXAMPLES.get(kinds["plant"], {})
    plant_text = LINEAR
    if kinds["plant"] != "linear":
        plant_text = _table("plant", kinds["plant"], build, 0, example.get("plant"))
    plant = _built(plant_text, kinds["plant"])
    start = _start(plant) | {name: example[name] for name in ("x0",) if name in example}
    if "x0" in example:
        plant_text += _line("x0", example["x0"], "the true initial state (run only)") + "\n"
    build = SECTIONS["estimator"][kinds["estimator"]]
    begin = np.asarray(start["x0"]), np.eye(len(plant.states))
    estimator = build(plant, *begin)
    parts = [HEAD, plant_text, _table("estimator", kinds["estimator"], build, 1, start, NOTES)]
    values: dict[str, Callable[..., dict[str, Any]]] = {
        "detector": lambda _: {"level": 0.01, "on": judged(estimator)},
        "controller": lambda build: _steering(build, plant),
        "attack": lambda build: _injection(
            build, plant, example.get("channel"), pushes=kinds["attack"] == "covert"
        ),
    }
    for section, given in values.items():
        if section in kinds:
            build = SECTIONS[section][kinds[section]]
            parts.append(_table(section, kinds[section], build, 1, given(build)))
    return "\n".join([*parts, RUN])


def _built(text: str, kind: str) -> Plant:
    import tomllib

    values = tomllib.loads(text)["plant"]
    return SECTIONS["plant"][kind](
        **{name: value for name, value in values.items() if name not in ("kind", "x0")}
    )


def _identity(n: int) -> list[list[float]]:
    return [[float(i == j) for j in range(n)] for i in range(n)]


def _start(plant: Plant) -> dict[str, Any]:
    n = len(plant.states)
    # of many states the diagonal alone
    return {"x0": [0.0] * n, "P0": _identity(n) if n <= FEW else [1.0] * n}


def _steering(build: Callable[..., Any], plant: Plant) -> dict[str, Any]:
    """What a controller needs: weights, or where the poles are to be."""
    n = len(plant.states)
    given = {
        "state_weight": _identity(n),
        "input_weight": _identity(len(plant.inputs)),
        "poles": [round(0.9 - 0.4 * i / n, 3) for i in range(n)],
    }
    fields = model_of(build, 1).model_fields
    return {name: value for name, value in given.items() if name in fields}


def _injection(
    build: Callable[..., Any], plant: Plant, channel: str | None, pushes: bool
) -> dict[str, Any]:
    """What an attack needs: where, when, and the keys without default."""
    fields = model_of(build, 1).model_fields
    # what plays back recorded samples cannot hit an attack channel, which carries none
    target = f"sensor:{plant.outputs[0]}"
    if "value" in fields and plant.attacks:
        target = channel or f"channel:{plant.attacks[0]}"
    if pushes:
        target = f"actuator:{plant.inputs[0]}"
    known = REQUIRED | {"to": plant.positions[-1]}
    needed = {name: known[name] for name in fields if name in known}
    where = {"channel": target} if "channel" in fields else {}
    begin = 100 * plant.dt
    return {**where, "start": begin, "stop": 2 * begin, **needed}


def _table(
    section: str,
    kind: str,
    build: Callable[..., Any],
    given: int,
    values: dict[str, Any] | None = None,
    notes: dict[str, str] | None = None,
) -> str:
    """One table: the values, then every other key of the kind with its default, commented."""
    values, notes = values or {}, notes or {}
    lines = ["[[attack]]" if section == "attack" else f"[{section}]"]
    others = [name for name in SECTIONS[section] if name != kind]
    lines.append(_line("kind", kind, f"also: {', '.join(others)}" if others else ""))
    if section == "detector":
        notes = {"level": "false alarms per step", "on": "attack | residual"}
    if section == "attack":
        notes = {
            "channel": "sensor:NAME, actuator:NAME or channel:NAME (a column of G, H)",
            "start": "seconds; active for start <= t < stop",
        }
    lines += [_line(name, value, notes.get(name, "")) for name, value in values.items()]
    fields = model_of(build, given).model_fields
    for name in list(inspect.signature(build).parameters)[given:]:
        if (
            name not in values
            and name != "channels"
            and name in fields
            and not fields[name].is_required()
        ):
            field = fields[name]
            words = notes.get(name) or in_words(field.annotation)
            if field.default is None:
                lines.append(f"# {name} = ..".ljust(31) + f" # {words or 'default: none'}")
            elif section != "plant":
                lines.append(_line(f"# {name}", field.default, words))
            else:
                lines.append(_line(name, field.default, ""))
    if section == "detector":
        lines.append(_line("# calibrate", "benign.csv", "a log without attack"))
    return "\n".join(lines) + "\n"


def _line(name: str, value: Any, words: str) -> str:
    line = f"{name} = {_toml(value)}"
    return f"{line.ljust(31)} # {words}" if words else line


def _toml(value: Any) -> str:
    if isinstance(value, list) and len(value) > 2 and isinstance(value[0], list):
        return "[\n" + "".join(f"    {json.dumps(row)},\n" for row in value) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return "inf" if value > 0 else "-inf"
    return json.dumps(value)
