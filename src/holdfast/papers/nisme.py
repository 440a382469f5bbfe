"""NISME (paper 004), judged: every numbered statement, Algorithms 1 to 5 and the case studies.

Algorithm 1 is judged line by line against batch least squares on linear plants, the modes of
Section 6 on plants of small integers, the proof of Theorem 5.1 by the numbers in it.
"""

from holdfast.papers import nisme_assumptions as conditions
from holdfast.papers import nisme_cases as studies
from holdfast.papers import nisme_claims as claims
from holdfast.papers import nisme_derivation as derivation
from holdfast.papers import nisme_figures as drawn
from holdfast.papers import nisme_filter as lines
from holdfast.papers import nisme_grid as grid
from holdfast.papers import nisme_modes as modes
from holdfast.papers import nisme_stability as stability
from holdfast.papers import nisme_tests as tests
from holdfast.papers.rows import Row, Study, read_only

ORDER = (
    "Definition 1.1", "Definition 1.2", "(2)", "(3)", "(4)", "Remark 4.1", "Fig. 1", "(5)", "(6)",
    "(8)", "Assumption 4.1", "Fig. 2", "Section 4.2", "(11)", "Algorithm 1", "Algorithm 2",
    "Assumption 5.1", "Section 5", "Assumption 5.2", "Assumption 5.3", "Assumption 5.4",
    "Theorem 5.1", "Lemma 5.1", "Remark 5.1", "(13)", "Definition 6.1", "Section 6.1",
    "Algorithm 3", "Remark 6.1", "Algorithm 4", "Algorithm 5", "Remark 7.1", "Lemma 8.1",
    "Theorem 8.1", "(20)", "Section 8.1.4", "(22)", "Section 8.2", "Lemma 8.2", "Section 8.3.2",
    "Claim B.1", "Claim B.2", "Claim B.3", "Claim B.4", "Claim B.5", "Claim C.1",
)  # fmt: skip
"""The paper's own order, by what an id begins with."""
LAST = "Remark 7.1"
"""After it come the case studies, which are the rest of Section 7."""


def study() -> Study:
    """All rows, and Figs. 4 to 7."""
    run = grid.drive()
    return Study(judged(run), lambda: drawn.figures(run))


def judged(run: grid.Run) -> tuple[Row, ...]:
    """All rows in the paper's order, those of the case studies from a run."""
    rows = ordered(statements())
    until = sum(_place(row)[0] <= ORDER.index(LAST) for row in rows)
    return (*rows[:until], *studies.judged(run), *rows[until:])


def ordered(rows: list[Row]) -> tuple[Row, ...]:
    """Rows as the paper has what they are about."""
    return tuple(sorted(rows, key=_place))


def _place(row: Row) -> tuple[int, bool]:
    """The statement itself comes before what was made of it."""
    heads = [name for name in ORDER if row.id == name or row.id.startswith(f"{name}, ")]
    head = max(heads, key=len)
    return ORDER.index(head), row.id != head


def statements() -> list[Row]:
    """Every row but the case studies'."""
    return [*filtering(), *weighing(), *reducing(), *assuming(), *proving(), *unjudged()]


def filtering() -> list[Row]:
    """(5) to (22), Algorithm 1, Lemma 8.1 and Theorem 8.1."""
    return [
        lines.equation_5(),
        lines.decomposed(),
        lines.equation_8(),
        lines.equation_8(corrected=True),
        lines.section_5(),
        lines.section_5(corrected=True),
        lines.remark_4_1(),
        lines.blue(),
        lines.blue(state=True),
        lines.algorithm_1_printed(),
        lines.algorithm_1(),
        lines.the_library(),
        lines.line_1(),
        lines.line_1(corrected=True),
        *(lines.as_printed(id) for id in lines.LINES),
        lines.line_3_sizes(),
        derivation.lemma_8_1(),
        derivation.lemma_8_1_covariance(),
        derivation.lemma_8_1_covariance(corrected=True),
        derivation.theorem_8_1(),
        derivation.equation_20(),
        derivation.equation_22(),
        derivation.gain_equation(),
        derivation.gain_equation(corrected=True),
    ]


def weighing() -> list[Row]:
    """Line 15 of Algorithm 1, Algorithms 2 and 4."""
    return [
        tests.line_15(),
        tests.line_15(corrected=True),
        tests.line_15_density(),
        tests.line_15_parts(),
        tests.floor(),
        tests.floor(corrected=True),
        tests.chi_square_of_d(),
        tests.empty(),
        tests.empty(corrected=True),
        tests.afterthought(),
        tests.levels("Algorithm 2", 0.75, 3, 4.11),
        tests.levels("Algorithm 2", 0.75, 3, 4.11, confidence=True),
        tests.levels("Algorithm 4", 0.8, None, 1.28),
        tests.levels("Algorithm 4", 0.8, None, 1.28, confidence=True),
        tests.six_tests(),
        tests.named(),
        tests.named(corrected=True),
    ]


def reducing() -> list[Row]:
    """The network's outputs, Section 6, and what Algorithms 2 and 5 leave out."""
    return [
        modes.definition_1_2(),
        modes.definition_1_2(corrected=True),
        modes.definition_1_2_constant(),
        modes.equation_2(),
        modes.equation_2_size(),
        modes.equation_4(),
        modes.index(),
        modes.definition_6_1(),
        modes.capabilities(),
        modes.sufficient(),
        modes.subsets(),
        modes.subsets(corrected=True),
        modes.redundant(),
        modes.algorithm_3_finds(),
        modes.algorithm_3_finds(corrected=True),
        modes.remark_6_1(),
        *modes.unsaid(),
    ]


def assuming() -> list[Row]:
    """The assumptions, and which of them the network meets."""
    met = conditions.network()
    return [
        conditions.each(met, "Assumption 4.1"),
        conditions.assumption_4_1(),
        conditions.assumption_5_1(),
        conditions.each(met, "Assumption 5.2"),
        conditions.bi_lipschitz(),
        conditions.assumption_5_3(),
        conditions.assumption_5_3_rho(),
        conditions.hoelder(),
        conditions.each(met, "Assumption 5.3"),
        conditions.each(met, "Assumption 5.4"),
        conditions.remark_7_1(met),
        conditions.case_study_attack(),
    ]


def proving() -> list[Row]:
    """Definition 1.1, Theorem 5.1, Lemmas 5.1 and 8.2, and the claims."""
    return [
        stability.definition_1_1(),
        stability.lemma_5_1(),
        stability.lemma_5_1(later=True),
        stability.theorem_5_1(),
        stability.theorem_5_1_nonlinear(),
        stability.remark_5_1(),
        stability.lemma_8_2(),
        stability.lemma_8_2_one(),
        stability.lemma_8_2_attack(),
        stability.claim_c_1(),
        claims.lemma_8_2_gain(),
        claims.lemma_8_2_gain(corrected=True),
        claims.lower_q(),
        claims.upper_q(),
        claims.equation_27(),
        claims.epsilon_0(),
        claims.claim_b_1(),
        claims.claim_b_1(corrected=True),
        claims.claim_b_2(),
        claims.claim_b_2(corrected=True),
        claims.claim_b_3(),
        claims.claim_b_4(),
        claims.claim_b_4(corrected=True),
        claims.claim_b_5(),
    ]


def unjudged() -> list[Row]:
    """Sketches, and what rests on another text."""
    return [
        read_only(
            "Fig. 1", "the bank of NISE, the mode estimator, the choice of the likeliest", None,
            "A sketch of Algorithm 2 without a statement of its own.",
        ),
        read_only(
            "Fig. 2", "the recursion of the NISE: predict, correct, estimate d_1 and d_2", None,
            "A sketch of Algorithm 1 without a statement of its own.",
        ),
        read_only(
            "(3), unique solution", "a weak one-sided Lipschitz condition on f' is sufficient",
            None, "It is the statement of [35], for each time between switches.",
        ),
    ]  # fmt: skip
