"""The rows against the list of statements; and every verdict turned by other inputs."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from holdfast.papers import decoder
from holdfast.papers import decoder_algebra as algebra
from holdfast.papers import decoder_appendix as appendix
from holdfast.papers import decoder_coding as coding
from holdfast.papers import decoder_counting as counting
from holdfast.papers import decoder_design as design
from holdfast.papers import decoder_programs as programs
from holdfast.papers.rows import Row
from holdfast.plants.library import random_systems
from holdfast.report.tables import json_safe

LIST = Path(__file__).parent / "decoder_statements.toml"
EVERY: list[dict[str, str]] = tomllib.loads(LIST.read_text())["statement"]
# the others fly and filter: `test_decoder_uav` has them, and the whole run below
pytestmark = pytest.mark.slow  # whole studies are computed
LISTED = [statement for statement in EVERY if "runs" not in statement]
OPPOSITE = {
    "holds": "fails",
    "fails": "holds",
    "reproduced": "not reproduced",
    "not reproduced": "reproduced",
}
SMALL = decoder.Amount(cases=60, solved=8, batches=2, trials=100, coded=3, plants=40, seeds=0)


@pytest.fixture(scope="module")
def run():
    """A hundred trials at each point."""
    return decoder.drive(SMALL)


@pytest.fixture(scope="module")
def found(run):
    """Every row, by id."""
    return {row.id: row for row in decoder.judged(run)}


def test_every_statement_has_its_row_in_order_and_its_verdict(found):
    assert list(found) == [statement["id"] for statement in LISTED]
    for statement in LISTED:
        assert (statement["id"], found[statement["id"]].verdict) == (
            statement["id"], statement["verdict"],
        )  # fmt: skip


def test_the_list_holds_everything_that_the_paper_numbers(shared_data):
    texts = sorted((shared_data.parent / "papers").glob("002_*.txt"))
    if not texts:
        pytest.skip("the paper's text is not here")
    text = texts[0].read_text().split("\nREFERENCES\n")[0]
    kinds = "Definition|Proposition|Lemma|Theorem"
    numbered = {" ".join(pair) for pair in re.findall(rf"\b({kinds}) (\d)\b", text)}
    assert len(numbered) == 2 + 5 + 6 + 1
    listed = {statement["id"].split(", ")[0] for statement in EVERY}
    assert numbered <= listed
    # Fig. 4 is a sketch of channels
    assert {f"Fig. {i}" for i in range(1, 12)} - {"Fig. 4"} <= listed
    assert "Algorithm 1" in listed
    assert listed <= set(decoder.ORDER)


def test_what_is_not_computed_is_said_so(found):
    only_read = [id for id, row in found.items() if row.verdict == "proof read only"]
    assert only_read == ["Definition 1", "Definition 2"]
    assert {id for id, row in found.items() if row.verdict == "unstated"} == {
        "Fig. 1, fundamental limits", "Section IV-B, settings",
    }  # fmt: skip


def test_rows_are_fit_for_json(found):
    text = json.dumps(json_safe([row.as_dict() for row in found.values()]), allow_nan=False)
    assert len(json.loads(text)) == len(found)
    for row in found.values():
        assert row.ours is None or "null" not in json.dumps(json_safe(row.ours))


def diagonal(rng, trials, n, p):
    """Plants whose modes are one state each."""
    given = random_systems.poor(rng, trials, n, p)
    return given._replace(A=np.broadcast_to(np.diag(np.linspace(0.1, 0.8, n)), given.A.shape))


FOUR = [[1, 1], [1, -1], [1, 2], [2, 1]]
WITHOUT_DRAWS = {
    "Section II-A, T = 1": lambda: algebra.one_step(sensors=5),
    "Section II-A, attacked sensors that change": lambda: algebra.hopping(cycled=False),
    "Lemma 1": lambda: algebra.lemma_1(short=1),
    "Lemma 1, m >= 2q": lambda: algebra.lemma_1_rows(short=1),
    "(4)": lambda: algebra.equation_4(off=0.01),
    "(5)": lambda: algebra.equation_5(inputs=10),
    "(6)": lambda: algebra.equation_6(off=0.01),
    "Section III-B, feedback": lambda: algebra.feedback((-0.1, -0.2)),
    # all sensors attacked
    "Section III-B, the map [Phi I]": lambda: algebra.inverse_map(q=10),
    "Proposition 2, decoder (12)": lambda: programs.scalar(first=1.0),
    "Theorem 1, decoder (12)": lambda: programs.explicit(scale=1),
    "(13), (ii) as a condition for a decoder to exist": lambda: counting.equation_13_needed((1, 2)),
    "Theorem 1, S as a set": lambda: counting.theorem_1_set(T=4),
    "Theorem 1, positive eigenvalues": lambda: counting.theorem_1_signs(second=2),
    "Section III-D, even p": lambda: counting.even(p=9),
    "Section III-D, complex eigenvalues": lambda: counting.complex_pair(np.diag([1.0, 2.0])),
    "Proposition 4": lambda: counting.proposition_4(zero=True),
    "Proposition 4, decoder (12)": lambda: programs.along_eigenvectors(10, sensors=(0,)),
    "Section III-E, a decoder that corrects q per step": lambda: counting.relaxed_alone(T=4),
    "Section III-E, q_max": lambda: counting.largest(blind=1),
    "Section V-C2, q_max": lambda: counting.largest(down=True, blind=1),
    "Section IV-A, |supp(C v)| > q": lambda: counting.over_q(factor=2),
    "Section IV-A, condition 5": lambda: design.condition_5(10, poor=diagonal),
    "Section IV-B, T = 35": lambda: counting.at_the_bound(T=36),
    "Section IV-B, IMU and GPS": lambda: design.imu_and_gps(coupled=True),
    "Section IV-B, relaxing T": lambda: design.window_for_certain(sensors=(8,)),
    "Lemma 4": lambda: appendix.lemma_4(values=(-1, 1, 2)),
    "Lemma 4, x_1 = 0": lambda: appendix.lemma_4(zero=True, values=(-1, 1, 2)),
    "Lemma 4, real l_i": lambda: appendix.lemma_4_many(shift=3.0),
}


@pytest.mark.parametrize("id", WITHOUT_DRAWS)
def test_other_inputs_turn_the_verdict(found, id):
    turned = WITHOUT_DRAWS[id]()
    assert turned.id == id
    assert turned.verdict == OPPOSITE[found[id].verdict]


def reversed_kinds(curve):
    """Ideal coding and poor feedback have changed places."""
    return curve._replace(rate=curve.rate[::-1], error=curve.error[::-1])


def shifted(curve, by):
    """Other success rates."""
    return curve._replace(rate=curve.rate + by)


def mirrored(isometry):
    """The same of isometries."""
    return dict(zip(isometry, reversed(isometry.values()), strict=True))


def never_beyond(curve):
    """No success above T q_max."""
    beyond = coding.limit(10) < curve.S
    return curve._replace(rate=np.where(beyond[:, None], 0.0, curve.rate))


FROM_DRAWS = {
    "Proposition 1": lambda run: algebra.proposition_1(run.cases, factor=1),
    "(2)": lambda run: algebra.equation_2(run.cases, more=1),
    "Definition 2, beside Definition 1": lambda run: algebra.definition_2(run.cases, more=1),
    "Proposition 2": lambda run: algebra.proposition_2(run.cases, factor=1),
    "Proposition 2, 2qT <= pT - n": lambda run: algebra.proposition_2_rows(run.cases, less=3),
    "(13)": lambda run: counting.equation_13(run.cases, T=2),
    "Lemma 3": lambda run: counting.lemma_3(run.cases, factor=1),
    "Theorem 1": lambda run: counting.theorem_1(run.cases, factor=1),
    "Proposition 3": lambda run: counting.proposition_3(run.cases, short=True),
    "Proposition 3, decoder (12)": lambda run: programs.proposition_3(run.cases, most=1e9),
    "Section III-E, relaxed sum": lambda run: counting.relaxed(run.cases, more=1),
    "Lemma 5, part 1": lambda run: appendix.each_sensor("Lemma 5, part 1", run.cases, 2, less=1),
    "Lemma 6, part 1": lambda run: appendix.each_sensor("Lemma 6, part 1", run.cases, 3, less=1),
    "Lemma 5, part 2": lambda run: appendix.window_bound("Lemma 5, part 2", run.cases, 2, False),
    "Lemma 6, part 2": lambda run: appendix.window_bound("Lemma 6, part 2", run.cases, 3, False),
    "Proposition 5": lambda run: appendix.proposition_5(run.cases, less=1),
    **{
        id: lambda run, i=i: programs.equations(run.solved, off=0.01)[i]
        for i, id in enumerate(("(7)", "(8)", "(9)"))
    },
    "(10)": lambda run: programs.equation_10(run.solved, off=0.01),
    "(11)": lambda run: programs.equation_11(run.solved, off=0.01),
    "(12)": lambda run: programs.equation_12(run.solved, off=0.01),
    "Lemma 2": lambda run: programs.lemma_2(run.solved, off=0.01),
    "Section II-B, l0 and l1": lambda run: design.one_attack(run.isometry["poor"]),
    "Section IV, isometry": lambda run: design.random_matrices(mirrored(run.isometry)),
    "Section IV-B, restricted isometry constants": lambda run: design.constants(
        mirrored(run.isometry)
    ),
    "Section IV-A, poles": lambda run: design.poles(run.curves[10], run.wide + 0.5),
    "Fig. 1": lambda run: coding.figure_1(
        run.curves[10]._replace(rate=run.curves[10].rate[:, ::-1])
    ),
    "Fig. 2": lambda run: coding.figure_2({**run.curves, 12: shifted(run.curves[12], -0.5)}),
    **{
        f"Fig. {n}, {what}, p = {p}": lambda run, n=n, p=p, row=row: row(
            reversed_kinds(run.curves[p]), n, p
        )
        for n, p in (("1", 10), ("2", 8), ("2", 12))
        for what, row in (("three systems", coding.three), ("mean error", coding.mean_error))
    },
    "Section IV-B, above 0.8": lambda run: coding.above(shifted(run.curves[10], -0.2), 10, 0.8),
    "Section IV-B, above 0.9": lambda run: coding.above(shifted(run.curves[12], -0.2), 12, 0.9),
    "Section IV-B, fundamental limits": lambda run: design.lines(
        {10: never_beyond(run.curves[10])}
    ),
    "Section IV-B, T = n": lambda run: design.window_of_n(run.curves, least=0.99),
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
    names = ["decoder-figure-1", "decoder-figure-2-success", "decoder-figure-2-error"]
    drawn = decoder.figures(run)
    assert list(drawn)[:3] == names
    drawn = {name: drawn[name] for name in names}
    lines = {
        (name, panel.get_title(loc="left"), line.get_label()): line
        for name, figure in drawn.items()
        for panel in figure.axes
        for line in panel.get_lines()
    }
    # three systems and two limits in each panel
    assert len(lines) == 5 * (2 + 3 + 3)
    line = lines["decoder-figure-2-success", "success rate, p = 12", "designed feedback"]
    np.testing.assert_array_equal(line.get_xdata(), run.curves[12].S)
    np.testing.assert_array_equal(line.get_ydata(), run.curves[12].rate[1].mean(1))
    line = lines["decoder-figure-1", "success rate, p = 10", "T q_max"]
    np.testing.assert_array_equal(line.get_xdata(), [32.0, 32.0])
    assert {panel.get_xscale() for figure in drawn.values() for panel in figure.axes} == {"linear"}


PAGE = (Path(__file__).parents[2] / "docs" / "papers.md").read_text().split("## DECODER")[-1]


def _as_the_command_gives_them() -> list[Row]:
    """In a process of its own: some fifty compiled flights on top of a worker's are too many."""
    run = [sys.executable, "-c", "from holdfast.shell.cli import main; main()"]
    done = subprocess.run([*run, "papers", "decoder", "--json"], capture_output=True, check=True)
    return [Row(**row) for row in json.loads(done.stdout)]


@pytest.mark.whole
def test_the_page_on_the_papers_tells_the_numbers_of_the_whole_run():
    rows = {row.id: row for row in _as_the_command_gives_them()}
    assert [(id, row.verdict) for id, row in rows.items()] == [
        (statement["id"], statement["verdict"]) for statement in EVERY
    ]
    shown = [
        *rows["Fig. 1, three systems, p = 10"].ours,
        *rows["Fig. 2, three systems, p = 8"].ours,
        *rows["Fig. 2, three systems, p = 12"].ours,
        *rows["Fig. 2"].ours,
        *rows["Section IV-A, poles"].ours,
        *rows["Section IV-B, relaxing T"].ours[1:],
    ]
    for value in shown:
        assert f"{value:.2f}".lstrip("0") in PAGE
    kept, certain, alike = rows["Proposition 3, decoder (12)"].ours
    assert f"{certain} of {kept}" in PAGE
    assert f"{alike} with sensors" in PAGE
