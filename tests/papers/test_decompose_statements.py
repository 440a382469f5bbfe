"""The rows against the list of statements; and every verdict turned by other inputs."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from holdfast.papers import decompose
from holdfast.papers import decompose_algebra as algebra
from holdfast.papers import decompose_numbers as numbers
from holdfast.papers import decompose_secure as secure
from holdfast.papers import decompose_squares as squares
from holdfast.papers import decompose_stability as stability
from holdfast.papers.decompose_example import (
    COMPLEX,
    DEFECTIVE,
    EXAMPLE,
    REPEATED,
    diagonalised,
    example,
)
from holdfast.report.tables import json_safe

pytestmark = pytest.mark.slow  # whole studies are computed
LISTED = tomllib.loads((Path(__file__).parent / "decompose_statements.toml").read_text())
LISTED = LISTED["statement"]
OPPOSITE = {
    "holds": "fails",
    "fails": "holds",
    "reproduced": "not reproduced",
    "not reproduced": "reproduced",
}
SMALL = decompose.Amount(
    seeds=4, draws=25, steps=75, gammas=(0.05, 0.25, 0.75, 2.0, 30.0), shares=4000,
    solved=100, sizes=(1.0, 1e4, 1e8),
)  # fmt: skip


@pytest.fixture(scope="module")
def run():
    """A hundred draws of everything."""
    return decompose.drive(SMALL)


@pytest.fixture(scope="module")
def found(run):
    """Every row, by id."""
    return {row.id: row for row in decompose.judged(run)}


def test_every_statement_has_its_row_in_order(found):
    assert list(found) == [statement["id"] for statement in LISTED]


def test_the_list_holds_everything_that_the_paper_numbers(shared_data):
    texts = sorted((shared_data.parent / "papers").glob("001_*.txt"))
    if not texts:
        pytest.skip("the paper's text is not here")
    text = texts[0].read_text().split("REFERENCES\n")[0]
    kinds = "Assumption|Theorem|Corollary|Lemma|Remark"
    numbered = {" ".join(pair) for pair in re.findall(rf"\b({kinds}) (\d+)\b", text)}
    numbered |= {f"Fig. {n}" for n in re.findall(r"Fig(?:ure|\.) (\d)", text)}
    assert len(numbered) == 16
    listed = {statement["id"].split(", ")[0] for statement in LISTED}
    assert numbered <= listed
    # and every printed matrix and number of the example
    printed = {float(one) for one in re.findall(r"-?\d+\.\d{4}\b", text)}
    kept = (numbers.K, numbers.P, numbers.EIGENVALUES, numbers.TRACE, numbers.G)
    assert printed == {x for one in kept for x in np.ravel(one).tolist()} - {0.0}


def test_what_is_not_computed_is_said_so(found):
    assert [id for id, row in found.items() if row.verdict == "proof read only"] == ["Fig. 1"]
    assert {id for id, row in found.items() if row.verdict == "unstated"} == {
        "(31), complex eigenvalues", "Section VI, settings",
    }  # fmt: skip


def test_rows_are_fit_for_json(found):
    text = json.dumps(json_safe([row.as_dict() for row in found.values()]), allow_nan=False)
    assert len(json.loads(text)) == len(found)
    assert "NaN" not in text
    assert all(row.ours is None or "null" not in json.dumps(json_safe(row.ours)) for row in
               found.values())  # fmt: skip


NEARLY = example(gain=1.1)
OTHER = example(R=2.0)
SCALAR = diagonalised(*(np.array([[z]]) for z in (0.9, 1.0, 1.0, 1.0, 0.5)))
NUMBERS = {row.id: i for i, row in enumerate(numbers.numbers())}
WITHOUT_DRAWS = {
    "Assumption 1": lambda: algebra.assumption_1(algebra.SINGULAR),
    "Assumption 1, beside Assumption 2": lambda: algebra.assumption_1_beside(EXAMPLE.A),
    "(5)": lambda: algebra.equation_5(NEARLY),
    # sensors so bad that the gain is 0 with any covariance
    "(7), Sigma = P": lambda: algebra.equation_7(given=example(R=1e14, modes=(0.5, 0.4, 0.3))),
    "(7), Sigma = P_+": lambda: algebra.equation_7(True, NEARLY),
    "Assumption 2": lambda: algebra.assumption_2(EXAMPLE._replace(A=algebra.SINGULAR)),
    "Section III, 1)": lambda: algebra.observable_part(
        blind=EXAMPLE._replace(C=np.roll(EXAMPLE.C, 1, 0))
    ),
    "Remark 1": lambda: algebra.remark_1(EXAMPLE),
    "Remark 1, one block per eigenvalue": lambda: algebra.remark_1_simple(REPEATED),
    "(12), zeta_i(0) = 0": lambda: algebra.equation_12(np.zeros(3)),
    "Theorem 1": lambda: algebra.theorem_1(off=0.01),
    "(15)": lambda: algebra.equation_15(off=0.01),
    # block diagonal, not Toeplitz
    "(16)": lambda: algebra.equation_16(X=np.diag([1.0, 2.0, 3.0])[None]),
    "Corollary 1": lambda: algebra.corollary_1(moved=0.01),
    "(20)": lambda: algebra.equation_20(moved=0.01),
    "Lemma 1": lambda: algebra.lemma_1(moved=0.01),
    "(22)": lambda: algebra.equation_22(shift=0.01),
    "(23)": lambda: algebra.equation_23(shift=0.01),
    "(29)": lambda: squares.equation_29(growth=1.1),
    "Theorem 2": lambda: squares.theorem_2([NEARLY]),
    "Theorem 2, several Jordan blocks": lambda: squares.theorem_2_repeated(EXAMPLE),
    "Theorem 2, without the inverse": lambda: squares.theorem_2_kkt(NEARLY),
    "Remark 2": lambda: squares.remark_2(off=0.01),
    "Remark 2, least squares": lambda: squares.remark_2_squares([EXAMPLE]),
    # a majority is one point
    "(31), the minimizer": lambda: secure.minimiser(sensors=3),
    "Theorem 4, condition on the example": lambda: stability.condition(stability.SIX),
    "Theorem 4, one sensor authenticated": lambda: stability.authenticated(stability.SIX),
    "Section VI, observability": lambda: numbers.unobservable(
        EXAMPLE._replace(A=np.diag([1.0, 0.5, -2.0]), C=np.ones((5, 3)))
    ),
    **{id: lambda i=i: numbers.numbers(OTHER)[i] for id, i in NUMBERS.items()},
    "Lemma 2": lambda: squares.lemma_2([NEARLY]),
    # real simple eigenvalues: J is J^H
    **{
        id: lambda id=id: squares.lyapunov(id, [EXAMPLE], False, "")
        for id in ("Lemma 3", "(36)", "(39)", "(40)")
    },
    **{
        f"{id}, with J^H": lambda id=id: squares.lyapunov(f"{id}, with J^H", [COMPLEX], False, "")
        for id in ("(36)", "(39)", "(40)")
    },
    "(38)": lambda: squares.equation_38([NEARLY]),
    "(41)": lambda: squares.equation_41(off=0.01),
    "Appendix A, G_{o,l,j}": lambda: squares.rows_not_zero(eigenvalue=-0.5),
    "Appendix A, V J V^-1 K_i": lambda: squares.misprinted_product(given=SCALAR),
    "Appendix A, V J V^-1 F_i": lambda: squares.misprinted_product(
        True, DEFECTIVE._replace(K=1.1 * DEFECTIVE.K)
    ),
}


@pytest.mark.parametrize("id", WITHOUT_DRAWS)
def test_other_inputs_turn_the_verdict(found, id):
    turned = WITHOUT_DRAWS[id]()
    assert turned.id == id
    assert turned.verdict == OPPOSITE[found[id].verdict]


def at_three_quarters(sweep):
    """Curves with their least where the paper has it."""
    away = 1.0 + np.abs(np.log(np.array(sweep.gammas) / 0.75))
    return sweep._replace(errors=away[None, :, None] * np.ones_like(sweep.errors))


def attacked(run):
    return [one for (_, sensor), one in run.solved.items() if sensor]


FROM_DRAWS = {
    "Theorem 3, part 1": lambda run: secure.equation_32(
        "Theorem 3, part 1", [run.solved[2.0, 0]], bound=0.5
    ),
    "(32)": lambda run: secure.equation_32("(32)", attacked(run), bound=0.5),
    "Theorem 3, part 2": lambda run: secure.theorem_3_part_2(run.solved[30.0, 0], factor=2.0),
    "(33)": lambda run: secure.equation_33(run.solved[30.0, 0], factor=0.5),
    "Remark 3": lambda run: secure.remark_3(run.shares, 0.9, 100),
    "Theorem 4": lambda run: stability.theorem_4(run.noise, EXAMPLE),
    "Theorem 4, sensor by sensor": lambda run: stability.each_sensor(
        run.grown._replace(errors=run.grown.errors[::-1])
    ),
    "Theorem 4, one sensor authenticated, errors": lambda run: stability.authenticated_errors(
        [run.grown] * 5
    ),
    "Fig. 2": lambda run: secure.figure_2(run.sweep._replace(errors=1.1 * run.sweep.errors)),
    "Fig. 2, sensor 1 attacked": lambda run: secure.figure_2_attacked(at_three_quarters(run.sweep)),
    "Fig. 2, every sensor attacked": lambda run: secure.figure_2_every(
        at_three_quarters(run.sweep)
    ),
    "Fig. 2, over time": lambda run: secure.figure_2_over_time(run.sweep, 2.0 * run.over_time),
    "Remark 4": lambda run: secure.remark_4(
        run.sweep._replace(errors=run.sweep.errors[:, ::-1]), run.shares
    ),
}


@pytest.mark.parametrize("id", FROM_DRAWS)
def test_other_draws_turn_the_verdict(found, run, id):
    turned = FROM_DRAWS[id](run)
    assert turned.id == id
    assert turned.verdict == OPPOSITE[found[id].verdict]


def test_every_computed_verdict_has_been_turned(found):
    turned = {*WITHOUT_DRAWS, *FROM_DRAWS}
    assert turned == {id for id, row in found.items() if row.verdict in OPPOSITE}


def test_the_figures_show_what_the_run_says(run):
    drawn = decompose.figures(run)
    assert list(drawn) == ["decompose-figure-2", "decompose-attack-size"]
    lines = {
        (panel.get_title(loc="left"), line.get_label()): line.get_ydata()
        for figure in drawn.values()
        for panel in figure.axes
        for line in panel.get_lines()
    }
    assert len(lines) == 6 + 5 + 4
    title = "mean squared error over tr P; attack of 100"
    np.testing.assert_array_equal(lines[title, "all benign"], run.sweep.errors[0].mean(1))
    title = "root mean squared error, gamma 0.75"
    np.testing.assert_array_equal(lines[title, "sensor 3 attacked"], run.grown.errors[2])
    assert all(np.all(np.isfinite(values)) for values in lines.values())
    assert {panel.get_xscale() for figure in drawn.values() for panel in figure.axes} == {"log"}


PAGE = (Path(__file__).parents[2] / "docs" / "papers.md").read_text().split("## DECOMPOSE")[-1]


def test_the_page_on_the_papers_tells_what_does_not_depend_on_draws(found):
    for id in ("Theorem 4, condition on the example", "Theorem 4, one sensor authenticated"):
        for ratio in found[id].ours:
            assert f"{ratio:.4f}".lstrip("0") in PAGE
    assert f"{len(found)} rows" in PAGE


@pytest.mark.whole
def test_the_page_on_the_papers_tells_the_numbers_of_the_whole_run(found):
    rows = {row.id: row for row in decompose.study().rows}
    assert {id: row.verdict for id, row in rows.items()} == {
        id: row.verdict for id, row in found.items()
    }
    gamma, least, printed = rows["Fig. 2, sensor 1 attacked"].ours
    assert 0.25 <= gamma <= 0.30
    for value in (least, printed, *rows["Remark 3"].ours[2:]):
        assert f"{value:.2f}".lstrip("0") in PAGE
    assert f"{rows['Remark 3'].ours[1]:.4f}".lstrip("0") in PAGE
    for value in rows["Theorem 4, sensor by sensor"].ours[1:3]:
        assert abs(value / float(f"{value:.3g}") - 1) < 0.01
        assert f"{value:.0f}" in PAGE
