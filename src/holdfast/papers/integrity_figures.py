"""The case studies of INTEGRITY together: what is computed, the rows, Figs. 4 to 8 drawn again."""

from typing import Any, NamedTuple

import numpy as np

from holdfast.papers import integrity_circle as circle
from holdfast.papers import integrity_dcacc as dcacc
from holdfast.papers import integrity_vehicle as vehicle
from holdfast.papers.rows import Row, read_only, unstated
from holdfast.reach.bounds import Reach

SHOWN = 10
"""Blocks of Fig. 5 that are drawn."""


class Amount(NamedTuple):
    """How much of each study is computed."""

    tracking: vehicle.Amount = vehicle.Amount()
    turning: circle.Amount = circle.Amount()
    following: dcacc.Amount = dcacc.Amount()


class Run(NamedTuple):
    """What the rows and the figures are made from."""

    tracking: vehicle.Run
    turning: circle.Run
    following: dcacc.Run


def drive(amount: Amount = Amount()) -> Run:  # noqa: B008
    """All three computed."""
    return Run(
        vehicle.drive(amount.tracking),
        circle.drive(amount.turning),
        dcacc.drive(amount.following),
    )


def rows(amount: Amount = Amount()) -> list[Row]:  # noqa: B008
    """All rows of the case studies."""
    return judged(drive(amount))


def judged(run: Run) -> list[Row]:
    """The rows of a run."""
    return [
        *unjudged(),
        *vehicle.judged(run.tracking),
        *circle.judged(run.turning),
        *dcacc.judged(run.following),
    ]


def unjudged() -> list[Row]:
    """Sketches, and what the paper does not contain."""
    return [
        read_only(
            "Fig. 1", "two sensors fit on the bus without codes, or with one in each other message",
            None, "A sketch without lengths of messages or frames.",
        ),
        read_only(
            "Fig. 2", "block diagram: plant, sensors, attacker in between, estimator, detector",
            None, "A sketch of (1) to (9) without a statement of its own.",
        ),
        read_only(
            "Fig. 3", "the error between the ends of two enforcement blocks stays in a tube", None,
            "A sketch for the proof of Theorem 4.",
        ),
        unstated(
            "Section VI, third study", "the abstract and the conclusion promise three automotive "
            "case studies", 2,
            "Section VI holds two, the vehicle and dCACC. The third is not in the text; for more "
            "it points to [14] and [15].",
        ),
    ]  # fmt: skip


def figures(run: Run) -> dict[str, Any]:
    """Figs. 4 to 8 by name."""
    return {
        "integrity-figure-4": figure_4(run.tracking),
        "integrity-figure-5": figure_5(run.tracking),
        "integrity-figure-6": figure_6(run.turning),
        "integrity-figure-7": figure_7(run.following),
        "integrity-figure-8": figure_8(run.following),
    }


def figure_4(run: vehicle.Run) -> Any:
    """The vehicle without enforcement, under the sum and per step."""
    from holdfast.report.paper_figures import Panel, against

    summed, single = run.summed[None].norm, run.single[None].norm
    few, k = len(single), np.arange(1, len(summed) + 1)
    limit = np.full(len(k), vehicle.LIMIT)
    first = {"sum of residuals": summed[:few], "test of every step": single}
    panels = [
        Panel(
            "largest expected error (m and m/s) without enforcement, the first steps",
            {**first, "threshold": limit[:few]},
        ),
        Panel("the same, later", {"sum of residuals": summed, "threshold": limit}, x=k),
    ]
    return against(k[:few], panels, "step k", shared=False)


def figure_5(run: vehicle.Run) -> Any:
    """The three policies: their first blocks, more of them, and against a test of every step."""
    from holdfast.report.paper_figures import Panel, against

    def panel(title: str, found: dict, blocks: int, steps: int) -> Panel:
        k = np.arange(1, steps + 1)
        lines = {f"L = {L}": _until(one, steps, blocks * L) for L, one in found.items() if L}
        return Panel(title, {**lines, "threshold": np.full(steps, vehicle.LIMIT)}, x=k)

    longest = max(vehicle.POLICIES)
    panels = [
        panel("largest expected error (m and m/s), sum of residuals: three blocks",
              run.summed, vehicle.FIRST_BLOCKS, vehicle.FIRST_BLOCKS * longest),
        panel(f"the same, {SHOWN} blocks", run.summed, SHOWN, SHOWN * longest),
        panel("the same, test of every step", run.single, SHOWN, len(run.single[30].norm)),
    ]  # fmt: skip
    return against(np.arange(1, 2), panels, "step k", shared=False)


def _until(found: Reach, steps: int, last: int) -> np.ndarray:
    """The norms at the steps 1 .. ``steps``; NaN from ``last`` on."""
    values = np.full(steps, np.nan)
    count = min(steps, last, len(found.norm))
    values[:count] = found.norm[:count]
    return values


def figure_6(run: circle.Run) -> Any:
    """The first seed's way round, with the estimate where the two part."""
    from holdfast.report.paper_figures import Plane, planes

    course = circle.circle(run.deviation[circle.CASES[0]].shape[1])
    since = run.first - 1

    def way(case: str, start: int = 0) -> np.ndarray:
        return (course + run.deviation[case][0])[start:, ::2]

    free, held = circle.CASES[1:]
    far = 1.6 * circle.RADIUS
    lines = {
        "course": course[:, ::2],
        "vehicle, no enforcement": way(free, since),
        f"vehicle, {held}": way(held),
    }
    seen = (course + run.deviation[free][0] - run.error[free][0])[since:, ::2]
    return planes([
        Plane("the vehicle; attack from 100 s", lines, "x (m)", "y (m)", True, (-far, far)),
        Plane("what the estimator says", {"course": course[:, ::2],
              "estimate, no enforcement": seen}, "x (m)", "y (m)", True, (-far, far)),
    ])  # fmt: skip


def figure_7(run: dcacc.Run) -> Any:
    """The cruise control."""
    from holdfast.report.paper_figures import Panel, against

    def panel(title: str, steps: int) -> Panel:
        found = {
            "L = 20": run.held,
            "L = 22, twenty unsecured between": run.spaced,
            "no enforcement": run.free,
        }
        lines = {name: one.norm[:steps] for name, one in found.items()}
        lines["threshold"] = np.full(steps, dcacc.LIMIT)
        return Panel(title, lines, log=True, x=np.arange(1, steps + 1))

    title = "largest expected error (m, m/s and m/s^2), sum of residuals: three blocks"
    steps = vehicle.FIRST_BLOCKS * (dcacc.EVERY + dcacc.DURATION)
    later = min(len(run.free.norm), len(run.held.norm))
    panels = [panel(title, steps), panel("the same, later", later)]
    return against(np.arange(1, 2), panels, "step k", shared=False)


def figure_8(run: dcacc.Run) -> Any:
    """The regions of Fig. 8, distance against speed and speed against acceleration."""
    from holdfast.report.paper_figures import Plane, planes

    names = ("distance (m)", "speed (m/s)", "acceleration (m/s^2)")
    regions = {
        f"{word}, k = {k}": found.shape[k - 1]
        for word, found in (("no enforcement", run.free), ("L = 22", run.spaced))
        for k in dcacc.LOOKED
    }
    return planes([
        Plane(title, {name: ellipse(shape[np.ix_(of, of)]) for name, shape in regions.items()},
              names[of[0]], names[of[1]])
        for title, of in (("reachable expected errors", [0, 1]), ("the same", [1, 2]))
    ])  # fmt: skip


def ellipse(shape: np.ndarray) -> np.ndarray:
    """The border of e' Y^-1 e <= 1 (N x 2); of a projection where Y is a block of a larger one."""
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    return np.stack([np.cos(angle), np.sin(angle)], 1) @ np.linalg.cholesky(shape).T
