"""Figs. 4 to 7 of NISME drawn again, from the first seed."""

from typing import Any

import numpy as np

from holdfast.papers import nisme_grid as grid
from holdfast.papers.nisme_cases import after_test
from holdfast.papers.nisme_grid import Run, Said

BUS, SENSOR, ACTUATOR = 16, "sensor:P_elec:53", "actuator:14"
APART = 0.15
"""Modes of several banks are drawn so far above one another, not to hide each other."""


def figures(run: Run) -> dict[str, Any]:
    """All four by name."""
    return {
        "nisme-figure-4": figure_4(run),
        "nisme-figure-5": signals(run, "four"),
        "nisme-figure-6": figure_6(run),
        "nisme-figure-7": signals(run, "reduced"),
    }


def time(said: Said) -> np.ndarray:
    """Seconds of every row."""
    return np.arange(1, len(said.place) + 1) * grid.PLANT.dt


def figure_4(run: Run) -> Any:
    """Modes and probabilities, by the evidence and as printed but for the normaliser."""
    from holdfast.report.paper_figures import Panel, stacked

    four, three = run.said["four"], run.said["three, quadratic"]
    modes = {
        "evidence, four modes": four.mode[0],
        "Algorithm 2 without normaliser": after_test(three)[0],
    }
    return stacked(
        time(four),
        [
            _modes("mode (0 none, 1 sensors, 2 actuators, 3 lines)", four, modes),
            Panel("probabilities: evidence, four modes", _probabilities(four, (0, 1, 2, 3))),
            Panel("probabilities: (15) without normaliser", _probabilities(three, (1, 2, 3))),
        ],
    )


def figure_6(run: Run) -> Any:
    """Modes by z-tests, and the probabilities of the four positions."""
    from holdfast.report.paper_figures import Panel, stacked

    budget, printed = run.said["reduced"], run.said["reduced, printed"]
    modes = {
        "z over 1.28 each": printed.mode[0],
        "budget of 1 % over all": budget.mode[0],
    }
    words = ("no line open", *(f"{name} open" for name in grid.PLANT.positions[1:]))
    p = {word: budget.told.p[0, :, j] for j, word in enumerate(words)}
    title = "mode (0 none, 1 sensors, 2 actuators, 3 lines, 4 another)"
    return stacked(
        time(budget),
        [_modes(title, budget, modes), Panel("probabilities of the reduced bank", p)],
    )


def signals(run: Run, bank: str) -> Any:
    """Frequency of a bus, the attack on a sensor, the attack on an actuator: true and estimated."""
    from holdfast.report.paper_figures import Panel, stacked

    said = run.said[bank]
    x, d = np.asarray(run.drawn.x)[0], np.asarray(run.drawn.d)[0]
    state = grid.PLANT.states.index(f"f:{BUS}")
    panels = [Panel(f"f of bus {BUS} (rad/s)", _both(x[:, state], said.told.x[0][:, state]))]
    for name, words in ((SENSOR, "attack on P_elec of bus 53"), (ACTUATOR, "attack on the input "
                        "of bus 14")):  # fmt: skip
        at = grid.PLANT.attacks.index(name)
        both = _both(d[:, at], said.told.d[0][:, at])
        panels.append(Panel(f"{words} (per unit)", both, dotted=True))
    return stacked(time(said), panels)


def _modes(title: str, said: Said, modes: dict[str, np.ndarray]) -> Any:
    """Modes over time, each bank's a little above the one before."""
    from holdfast.report.paper_figures import Panel

    lines = {name: mode + APART * (i + 1) for i, (name, mode) in enumerate(modes.items())}
    return Panel(title, {"truth": grid.true_modes(said.place), **lines}, dotted=True)


def _both(true: np.ndarray, estimate: np.ndarray) -> dict[str, np.ndarray]:
    """The truth drawn over the estimate, which is noisier."""
    return {"estimate": estimate, "truth": true}


def _probabilities(said: Said, modes: tuple[int, ...]) -> dict[str, np.ndarray]:
    return {f"mode {mode}": said.told.p[0, :, i] for i, mode in enumerate(modes)}
