"""DECODER (paper 002), judged: every numbered statement, and the figures.

Statements about windows are decided on small whole-number systems (`decoder_exact`), Figs. 1 and
2 on random ones (`decoder_coding`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from holdfast.papers import decoder_algebra as algebra
from holdfast.papers import decoder_appendix as appendix
from holdfast.papers import decoder_coding as coding
from holdfast.papers import decoder_counting as counting
from holdfast.papers import decoder_design as design
from holdfast.papers import decoder_filter as filtered
from holdfast.papers import decoder_programs as programs
from holdfast.papers import decoder_uav as uav
from holdfast.papers.decoder_exact import Case, cases
from holdfast.papers.rows import Row, Study

ORDER = (
    "Definition 1", "Proposition 1", "(2)", "Section II-A", "Lemma 1", "(4)", "Section II-B", "(5)",
    "Definition 2", "(6)", "Proposition 2", "(7)", "(8)", "(9)", "(10)", "(11)", "(12)", "Lemma 2",
    "Section III-B", "(13)", "Lemma 3", "Theorem 1", "Proposition 3", "Section III-D",
    "Proposition 4", "Section III-E", "Section IV", "Section IV-A", "Fig. 1", "Fig. 2",
    "Section IV-B", "(14)", "Fig. 3", "Algorithm 1", "Section IV-C", "Fig. 4", "(15)",
    "Section V-A", "Fig. 5", "Section V-B", "Section V-C1", "Fig. 6", "Fig. 7", "Fig. 8",
    "Section V-C2", "Fig. 9", "Fig. 10", "Fig. 11", "Section V", "Section VI", "Lemma 4",
    "Lemma 5", "Lemma 6", "Proposition 5",
)  # fmt: skip
"""The paper's own order, by what stands before the first comma of an id."""


class Part(NamedTuple):
    """A part of the study with runs of its own: ``drive`` makes them from a number of seeds."""

    drive: Callable[[int], Any]
    judged: Callable[[Any], list[Row]]
    figures: Callable[[Any], dict[str, Any]]


PARTS = (
    Part(filtered.drive, filtered.judged, filtered.figures),
    Part(uav.drive, uav.judged, uav.figures),
)
"""Sections IV-C and V."""


class Amount(NamedTuple):
    """How much is drawn: the whole study, or less of it.

    ``seeds`` are those of `PARTS`; 0 leaves them out.
    """

    cases: int = 400
    solved: int = 40
    batches: int = coding.BATCHES
    trials: int = coding.TRIALS
    coded: int = design.CODED
    plants: int = 200
    seeds: int = uav.SEEDS


class Run(NamedTuple):
    """What the rows and the figures are made from."""

    amount: Amount
    cases: list[Case]
    solved: programs.Solved
    curves: dict[int, coding.Curve]
    wide: np.ndarray
    isometry: dict[str, design.Isometry]
    parts: tuple[Any, ...]


def drive(amount: Amount) -> Run:
    """Everything that is drawn and solved."""
    lots = amount.batches, amount.trials
    return Run(
        amount,
        cases(amount.cases),
        programs.solved(amount.solved),
        {p: coding.curve(p, *lots) for p in coding.SENSORS},
        coding.wide(*lots),
        {kind: design.isometry(kind, amount.coded) for kind in coding.KINDS},
        tuple(part.drive(amount.seeds) for part in PARTS if amount.seeds),
    )


def study(amount: Amount = Amount()) -> Study:  # noqa: B008
    """All rows, and the figures."""
    run = drive(amount)
    return Study(judged(run), lambda: figures(run))


def judged(run: Run) -> tuple[Row, ...]:
    """All rows in the paper's order."""
    parts = zip(PARTS[: len(run.parts)], run.parts, strict=True)
    further = [row for part, own in parts for row in part.judged(own)]
    rows = [*measured(run), *counted(run.cases), *statements(), *further]
    return tuple(sorted(rows, key=_place))


def _place(row: Row) -> tuple[int, bool]:
    """The statement itself comes before what was made of it."""
    return ORDER.index(row.id.split(", ")[0]), ", " in row.id


def statements() -> list[Row]:
    """The rows that need no draws."""
    return [
        *algebra.definitions(),
        algebra.one_step(),
        algebra.hopping(),
        algebra.lemma_1(),
        algebra.lemma_1_rows(),
        algebra.equation_4(),
        algebra.equation_5(),
        algebra.equation_6(),
        algebra.feedback(),
        algebra.inverse_map(),
        programs.scalar(),
        programs.explicit(),
        counting.equation_13_needed(),
        counting.theorem_1_set(),
        counting.theorem_1_signs(),
        counting.even(),
        counting.complex_pair(),
        counting.proposition_4(),
        counting.relaxed_alone(),
        counting.largest(),
        counting.over_q(),
        counting.largest(down=True),
        counting.at_the_bound(),
        design.imu_and_gps(),
        design.window_for_certain(),
        coding.limits(),
        appendix.lemma_4(),
        appendix.lemma_4(zero=True),
        appendix.lemma_4_many(),
    ]


def counted(found: list[Case]) -> list[Row]:
    """The rows of small systems."""
    return [
        algebra.proposition_1(found),
        algebra.equation_2(found),
        algebra.definition_2(found),
        algebra.proposition_2(found),
        algebra.proposition_2_rows(found),
        counting.equation_13(found),
        counting.lemma_3(found),
        counting.theorem_1(found),
        counting.proposition_3(found),
        programs.proposition_3(found),
        counting.relaxed(found),
        appendix.each_sensor("Lemma 5, part 1", found, 2),
        appendix.window_bound("Lemma 5, part 2", found, 2),
        appendix.each_sensor("Lemma 6, part 1", found, 3),
        appendix.window_bound("Lemma 6, part 2", found, 3),
        appendix.proposition_5(found),
    ]


def measured(run: Run) -> list[Row]:
    """The rows that come from random systems."""
    curves, ten = run.curves, run.curves[10]
    return [
        *programs.equations(run.solved),
        programs.equation_10(run.solved),
        programs.equation_11(run.solved),
        programs.equation_12(run.solved),
        programs.lemma_2(run.solved),
        programs.along_eigenvectors(run.amount.plants),
        design.one_attack(run.isometry["ideal"]),
        design.random_matrices(run.isometry),
        design.condition_5(run.amount.plants),
        design.poles(ten, run.wide),
        coding.figure_1(ten),
        coding.three(ten, "1", 10),
        coding.mean_error(ten, "1", 10),
        coding.figure_2(curves),
        *(coding.three(curves[p], "2", p) for p in (8, 12)),
        *(coding.mean_error(curves[p], "2", p) for p in (8, 12)),
        coding.settings(ten),
        coding.above(ten, 10, 0.8),
        coding.above(curves[12], 12, 0.9),
        design.lines(curves),
        design.window_of_n(curves),
        design.constants(run.isometry),
    ]


def figures(run: Run) -> dict[str, Any]:
    """Figs. 1 and 2, and those of `PARTS`."""
    from holdfast.report.paper_figures import Panel, against

    names = ("ideal coding", "designed feedback", "feedback for control alone")

    def panel(p: int, what: str) -> Panel:
        curve = run.curves[p]
        values = curve.rate if what == "success rate" else curve.error
        marks = {
            "T q_max": float(coding.limit(p)),
            "(pT - n) / 2": float(coding.limit_ideal(p)),
        }
        lines = {name: line for name, line in zip(names, values.mean(2), strict=True)}
        return Panel(f"{what}, p = {p}", lines, x=curve.S, marks=marks)

    label, longest = "attacked samples S of the window", run.curves[12].S
    both = ("success rate", "mean error |E^ - E| / |E|")
    drawn = {"decoder-figure-1": [panel(10, what) for what in both]}
    for what, name in zip(both, ("success", "error"), strict=True):
        drawn[f"decoder-figure-2-{name}"] = [panel(p, what) for p in coding.SENSORS]
    own = {
        name: against(run.curves[10].S if name.endswith("1") else longest, panels, label)
        for name, panels in drawn.items()
    }
    for part, its in zip(PARTS[: len(run.parts)], run.parts, strict=True):
        own |= part.figures(its)
    return own
