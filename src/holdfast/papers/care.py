"""CARE (paper 000), judged: the vehicle example and every numbered statement."""

from typing import Any

import numpy as np

from holdfast.estimators import care
from holdfast.papers import care_detection as detection
from holdfast.papers import care_estimation as estimation
from holdfast.papers import care_projection as projection
from holdfast.papers import care_stability as stability
from holdfast.papers import care_table as table
from holdfast.papers.care_vehicle import (
    DT,
    PHI,
    SEEDS,
    START,
    STEPS,
    Run,
    Setting,
    drive,
    plant_along,
    watched,
)
from holdfast.papers.rows import Row, Study, read_only

ORDER = (
    "Section 1", "Remark 1", "Fig. 1", "Algorithm 1", "Proposition 2", "Proposition 3", "(17)",
    "Remark 4", "(21)", "(22)", "(27)", "(28)", "(29)", "Lemma 5", "(33)", "Theorem 6",
    "Assumption 7", "Remark 8", "Theorem 9", "Assumption 10", "Remark 11", "Theorem 12",
    "Theorem 13", "Claim 14", "Claim 15", "Fig. 2", "Section 5.1", "(55)", "(56)", "Table 1",
    "Fig. 3", "Fig. 4", "Fig. 5", "Section 5.2", "Theorem 16",
)  # fmt: skip
"""The paper's own order, by what stands before the first comma of an id."""
ASIDE = np.array([3.0, 2.0, 0.1, 0.2])
"""How far off the wrong start of Theorem 13 is."""
TALLEST = 1e18
"""Where an infinite statistic is drawn."""


def study(seeds: int = SEEDS) -> Study:
    """All rows from ``seeds`` runs of the vehicle, and the figures of the first."""
    run = drive(Setting(seeds=seeds))
    return Study(judged(run), lambda: figures(run))


def judged(run: Run) -> tuple[Row, ...]:
    """All rows in the paper's order, those about the vehicle from this run of it."""
    rows = [*statements(), *measured(run)]
    return tuple(sorted(rows, key=lambda row: (ORDER.index(row.id.split(", ")[0]), row.id)))


def statements() -> list[Row]:
    """The rows that need no run of the vehicle."""
    return [
        estimation.contribution_i(),
        read_only(
            "Section 1, contribution iii", "first to study stability of estimation under "
            "inequality constraints; errors practically exponentially stable", "first",
            "Priority is a matter of the literature; for the stability see Theorem 13.",
        ),
        read_only(
            "Fig. 1", "block diagram of CARE: estimate, then project", None,
            "A sketch of Algorithm 1 without a statement of its own.",
        ),
        estimation.algorithm_1(),
        estimation.algorithm_1_corrected(),
        estimation.proposition_2(),
        estimation.proposition_3(),
        estimation.equation_17(),
        estimation.remark_4(),
        estimation.equation_21(),
        *(projection.covariance_of_projected(id) for id in ("(22)", "(27)")),
        *(estimation.equation_28(id) for id in ("(28)", "(29)")),
        projection.lemma_5(),
        projection.equation_33(),
        projection.theorem_6(),
        projection.theorem_6_weighted(),
        projection.theorem_6_strict(),
        projection.remark_8(),
        projection.theorem_9(),
        stability.remark_11(),
        stability.theorem_12(),
        stability.theorem_13(),
        stability.claim_14(),
        stability.claim_15(),
        table.figure_2(),
        table.attack_within_limits(),
        estimation.theorem_16(),
    ]  # fmt: skip


def measured(run: Run) -> list[Row]:
    """The rows that come from running the vehicle."""
    setting = Setting(seeds=len(run.x))
    quiet = drive(setting._replace(attacked=False))
    squared = drive(
        setting._replace(process=setting.process**2, measurement=setting.measurement**2)
    )
    cells = [table.cells(trace, run.x, run.d) for trace in (run.care, run.ise)]
    steps = stability.steps_along(run.speed[0], np.asarray(run.care.estimate.x_cov[0]))
    astray = watched(care.build, run.speed, run.y, setting, START + ASIDE)
    wrong, right = (_squared_errors(trace, run) for trace in (astray, run.care))
    found = detection.detection(run, quiet, squared)
    rates = next(row.ours for row in found if row.id == "Section 1, contribution iv")
    saved = 100.0 * float(1.0 - np.mean(cells[0][:, 0]) / np.mean(cells[1][:, 0]))
    return [
        detection.equation_55(np.asarray(plant_along(run.speed[0], setting).H)),
        table.unstated_settings(len(run.x)),
        table.remark_1(run.outside),
        table.contribution_ii(*cells),
        table.contribution_v(saved, rates[-1], rates[0]),
        stability.assumption_10(run.speed[0], np.stack([step.M for step in steps])),
        stability.theorem_12_bounds(np.stack([step.x_cov for step in steps])),
        stability.theorem_13_vehicle(right, wrong),
        *table.table_1(*cells),
        table.figure_3(run),
        table.figure_4(run),
        *found,
    ]


def _squared_errors(trace, run: Run) -> np.ndarray:
    return np.sum((trace.estimate.x - run.x) ** 2, -1)


def figures(run: Run) -> dict[str, Any]:
    """Figs. 3 to 5 from the first seed, by file name."""
    from holdfast.report.paper_figures import Panel, stacked

    t = DT * np.arange(1, STEPS + 1)
    care_says, ise = run.care.estimate, run.ise.estimate

    def pair(of) -> dict[str, np.ndarray]:
        return {"ISE": of(ise), "CARE": of(care_says)}

    fig_3 = [
        *(
            Panel(f"error of {name} (m)", pair(lambda e, i=i: run.x[0, :, i] - e.x[0, :, i]))
            for i, name in enumerate("xy")
        ),
        Panel("trace of P^x", pair(lambda e: np.trace(e.x_cov[0], axis1=-2, axis2=-1))),
    ]
    fig_4 = [
        *(
            Panel(name, {**pair(lambda e, i=i: e.d[0, :, i]), "truth": run.d[0, :, i]})
            for i, name in enumerate(("attack on beta (rad)", "attack on a (m/s²)"))
        ),
        Panel(
            "trace of P^d",
            pair(lambda e: np.trace(e.d_cov[0], axis1=-2, axis2=-1)),
            log=True,
        ),
    ]
    found = detection.statistics(care_says)
    threshold = {"threshold": np.full(STEPS, detection.limit())}
    states = {
        "ISE": run.ise.verdict.statistic[0],
        "CARE": detection.summed(found.weighted[0], PHI),
    }
    literal = np.minimum(np.abs(found.inverted[0]), TALLEST)
    fig_5 = [
        Panel("detector state S, CARE with the weight (P^{d,u})^-1", states | threshold, log=True),
        Panel(
            f"d' (P^d)^-1 d of CARE as a machine inverts it (infinite at {TALLEST:g})",
            {"CARE": literal} | threshold,
            log=True,
        ),
    ]
    return {
        "care-figure-3": stacked(t, fig_3),
        "care-figure-4": stacked(t, fig_4),
        "care-figure-5": stacked(t, fig_5),
    }
