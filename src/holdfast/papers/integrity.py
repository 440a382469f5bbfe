"""INTEGRITY (paper 003), judged: every numbered statement, Algorithm 1 and the prose around them.

Statements about tests are judged by exact distributions, those about errors without bound on
random plants and by what attacks of one unit of energy reach, those of Section V by (10), (11).
"""

from typing import Any, NamedTuple

from holdfast.papers import integrity_algorithm as algorithm
from holdfast.papers import integrity_attackable as attackable
from holdfast.papers import integrity_bounded as bounded
from holdfast.papers import integrity_detection as detection
from holdfast.papers import integrity_figures as studies
from holdfast.papers import integrity_model as model
from holdfast.papers import integrity_reach as regions
from holdfast.papers import integrity_sprt as sprt
from holdfast.papers.rows import Row, Study

ORDER = (
    "Fig. 1", "Fig. 2", "(3)", "(10)", "Remark 1", "(13)", "Definition 2", "Theorem 1", "(20)",
    "Remark 2", "Corollary 1", "Lemma 1", "(23)", "(26)", "Lemma 2", "Remark 3", "Theorem 2",
    "Section III-A", "Theorem 3", "Section IV", "Definition 4", "Remark 4", "Theorem 4",
    "Remark 5", "Lemma 3", "(67)", "(69)", "(72)", "Theorem 5", "(33)", "Fig. 3", "(40)",
    "Theorem 6", "Corollary 2", "Definition 6", "Section IV, 1)", "(44)", "Section V-A", "(46)",
    "(47)", "(48)", "Lemma 4", "(51)", "Theorem 7", "(53)", "(56)", "(59)", "(60)", "Corollary 3",
    "(61)", "Section V-B", "Algorithm 1", "Section VI", "Section VI-A", "Fig. 4", "Fig. 5",
    "Fig. 6", "Section VI-B", "Fig. 7", "Fig. 8",
)  # fmt: skip
"""The paper's own order, by what an id begins with; the proof of Lemma 3 with the lemma."""


class Amount(NamedTuple):
    """How much is drawn: the whole study, or less of it.

    ``plants``: random plants where each is decided in a moment; ``reached``: where what is
    reached on each is computed step by step. ``cases``: the case studies; None leaves them out.
    """

    plants: int = 150
    reached: int = 60
    cases: studies.Amount | None = studies.Amount()


class Run(NamedTuple):
    """What the rows and the figures are made from."""

    amount: Amount
    cases: studies.Run | None = None


def drive(amount: Amount) -> Run:
    """Everything that several rows or figures share: the runs of the case studies."""
    return Run(amount, None if amount.cases is None else studies.drive(amount.cases))


def study(amount: Amount = Amount()) -> Study:  # noqa: B008
    """All rows, and the figures."""
    run = drive(amount)
    return Study(judged(run), lambda: figures(run))


def judged(run: Run) -> tuple[Row, ...]:
    """All rows in the paper's order."""
    return ordered([*statements(), *measured(run), *cases(run)])


def ordered(rows: list[Row]) -> tuple[Row, ...]:
    """Rows as the paper has what they are about."""
    return tuple(sorted(rows, key=_place))


def _place(row: Row) -> tuple[int, bool]:
    """The statement itself comes before what was made of it."""
    heads = [name for name in ORDER if row.id == name or row.id.startswith(f"{name}, ")]
    head = max(heads, key=len)
    return ORDER.index(head), row.id != head


def cases(run: Run) -> list[Row]:
    """The case studies of Section VI and Figs. 1 to 8."""
    return [] if run.cases is None else studies.judged(run.cases)


def figures(run: Run) -> dict[str, Any]:
    """Figs. 4 to 8."""
    return {} if run.cases is None else studies.figures(run.cases)


def statements() -> list[Row]:
    """The rows that need no draws of plants."""
    return [
        *tests(),
        attackable.theorem_3_each(),
        attackable.arbitrary(),
        attackable.definition_4(),
        attackable.definition_4(corrected=True),
        attackable.remark_4(),
        attackable.theorem_4_rotation(),
        attackable.theorem_4_gaps(),
        bounded.lemma_3_limit(),
        bounded.equation_67(),
        bounded.equation_72(),
        bounded.projection_vectors(),
        bounded.theorem_6_sizes(),
        attackable.corollary_2_each(),
        bounded.sensor_wise_general(),
        regions.dense(),
        regions.theorem_7_tight(),
        regions.per_step(),
        regions.equation_56(),
        regions.definition_6(),
        regions.equation_60(),
        regions.corollary_3(),
        regions.corollary_3(corrected=True),
        algorithm.terminating(),
        algorithm.algorithm_1(),
        algorithm.line_4(),
        algorithm.line_9(),
        algorithm.largest_L(),
        *algorithm.unjudged(),
    ]


def tests() -> list[Row]:
    """The rows on alarm probabilities and on what is said of the filter."""
    return [
        model.equation_3(),
        model.equation_3(predicted=True),
        model.remark_1(),
        model.equation_13(),
        model.equation_13(corrected=True),
        model.definition_2(),
        model.equation_53(),
        model.equation_53(corrected=True),
        model.gamma(),
        model.theorem_2_norms(),
        model.theorem_2_norms(root=True),
        model.remark_3(),
        model.remark_3(h=8.4, p=2, grows=True),
        detection.theorem_1(),
        detection.theorem_1_equal(),
        detection.equation_20(),
        detection.remark_2(),
        detection.lemma_1(),
        detection.lemma_1_equal(),
        detection.lemma_1_levels(),
        detection.lemma_1_corrected(),
        detection.equation_23(),
        detection.equation_26(),
        detection.lemma_2(),
        detection.lemma_2_levels(),
        detection.lemma_2_corrected(),
        sprt.equation_46(),
        sprt.equation_46(corrected=True),
        sprt.equation_47(),
        sprt.equation_47(corrected=True),
        sprt.alarms(),
        sprt.alpha_grows(),
        sprt.theorem_4(),
        sprt.lower_threshold(),
    ]


def measured(run: Run) -> list[Row]:
    """The rows that come from random plants."""
    many, few = run.amount.plants, run.amount.reached
    return [
        model.equation_10(few),
        model.theorem_2(few // 4),
        detection.corollary_1(many),
        attackable.theorem_3(many),
        attackable.theorem_3_reached(2 * many),
        attackable.theorem_4(few),
        attackable.theorem_4_less(many),
        attackable.theorem_4_less(many, distinct=True),
        attackable.remark_5(2 * many),
        bounded.lemma_3(few),
        bounded.equation_69(count=few),
        bounded.equation_69(True, few),
        bounded.theorem_5(many),
        bounded.equation_33(few),
        bounded.equation_40(few),
        bounded.theorem_6(many),
        bounded.corollary_2(many),
        bounded.sensor_wise(many),
        bounded.sensor_wise_enough(many),
        regions.equation_44(few),
        regions.equation_48(few),
        regions.lemma_4(few),
        regions.product(few // 4),
        regions.equation_51(count=few),
        regions.equation_51(True, few),
        regions.theorem_7(few // 2),
    ]
