"""The rows on INTEGRITY's statements against their list; every verdict turned by other inputs."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from holdfast.papers import integrity
from holdfast.papers import integrity_algorithm as algorithm
from holdfast.papers import integrity_attackable as attackable
from holdfast.papers import integrity_bounded as bounded
from holdfast.papers import integrity_detection as detection
from holdfast.papers import integrity_model as model
from holdfast.papers import integrity_reach as regions
from holdfast.papers import integrity_sprt as sprt
from holdfast.papers.integrity_systems import VEHICLE, Policy, sure
from holdfast.report.tables import json_safe

pytestmark = pytest.mark.slow

LISTED = tomllib.loads((Path(__file__).parent / "integrity_statements.toml").read_text())
LISTED = LISTED["statement"]
OPPOSITE = {"holds": "fails", "fails": "holds"}
SMALL = integrity.Amount(plants=30, reached=12, cases=None)
FEW = 20


@pytest.fixture(scope="module")
def found():
    """Every row on a statement of Sections II to V, by id, on fewer plants."""
    rows = [*integrity.statements(), *integrity.measured(integrity.drive(SMALL))]
    return {row.id: row for row in integrity.ordered(rows)}


def test_every_statement_has_its_row_in_order_and_its_verdict(found):
    assert {id: row.verdict for id, row in found.items()} == {
        statement["id"]: statement["verdict"] for statement in LISTED
    }
    assert list(found) == [statement["id"] for statement in LISTED]


def test_the_list_holds_everything_that_the_paper_numbers(shared_data):
    texts = sorted((shared_data.parent / "papers").glob("003_*.txt"))
    if not texts:
        pytest.skip("the paper's text is not here")
    text = texts[0].read_text().split("REFERENCES\n")[0]
    kinds = "Theorem|Corollary|Lemma|Remark|Algorithm"
    numbered = {" ".join(pair) for pair in re.findall(rf"\b({kinds}) (\d+)\b", text)}
    assert len(numbered) == 7 + 4 + 3 + 5 + 1
    assert numbered <= {statement["id"].split(", ")[0] for statement in LISTED}


ERRATA = {
    1: ["Corollary 3", "(61), sqrt(lambda_max)"],
    2: ["(46)", "(46), c with e^(-p/2)", "(47)", "(47), c with e^(-p/2)"],
    3: [
        "Section V-A, alpha(t)", "Section V-A, alarms without attack", "Algorithm 1",
        "Section V-B, terminating condition", "Theorem 4, with the sum of (46)",
        "Theorem 7, chi-square test",
    ],
    4: ["Theorem 7", "Theorem 7, the whole of (47)"],
    5: ["Lemma 1", "Lemma 1, corrected", "Lemma 2", "Lemma 2, corrected"],
    6: ["(3), (4)", "(3), (4), a priori", "(13)", "(13), (I - KC) Sigma", "(53)",
        "(53), (I - KC) Sigma"],
    7: ["Algorithm 1, line 9", "Theorem 2, 1/lambda", "Theorem 2, 1/sqrt(lambda)",
        "Definition 4, t^i_(k+1)", "Definition 4, t^i_k + 1"],
    8: ["Theorem 4, f - 1", "Theorem 4, f - 1 on a rotation"],
    9: ["Theorem 3", "Theorem 3, one eigenvector each"],
    10: ["Section V-A, efficient", "(59), by recursion"],
}  # fmt: skip


def test_every_erratum_has_its_rows():
    listed = {statement["id"] for statement in LISTED}
    for ids in ERRATA.values():
        assert set(ids) <= listed


def test_what_is_not_computed_is_said_so(found):
    assert [id for id, row in found.items() if row.verdict == "proof read only"] == [
        "Section IV, overhead", "Section V-A, other detectors",
    ]  # fmt: skip


def test_rows_are_fit_for_json(found):
    rows = [row.as_dict() for row in found.values()]
    text = json.dumps(json_safe(rows), allow_nan=False)
    assert len(json.loads(text)) == len(found)
    assert all(row.ours is None or "null" not in json.dumps(json_safe(row.ours)) for row in
               found.values())  # fmt: skip


BLIND = sure([[0.5]], [[1.0]], 1.0, 1e14)
"""Sensors so bad that a sample changes nothing."""
NEARLY = VEHICLE._replace(K=1.1 * VEHICLE.K)
WHITE = VEHICLE._replace(S=np.eye(2))
SIZE = regions.corollary_3(corrected=True).ours
UNIT = sure(VEHICLE.A, VEHICLE.C, 0.26984 / SIZE**2, 10.144 / SIZE**2)
"""The vehicle in units in which its largest error at k = 10 is 1."""
GONE = sure([[0.0]], [[1.0]])
"""A plant without memory."""
JORDAN = np.array([[1.1, 1.0], [0.0, 1.1]])
TURNED = {
    "(3), (4)": lambda: model.equation_3(plants=[BLIND]),
    "(3), (4), a priori": lambda: model.equation_3(True, [NEARLY]),
    "(10), (11)": lambda: model.equation_10(5, off=0.01),
    "Remark 1": lambda: model.remark_1(before=1.0),
    "(13)": lambda: model.equation_13(of=BLIND),
    "(13), (I - KC) Sigma": lambda: model.equation_13(True, NEARLY),
    "Definition 2": lambda: model.definition_2((0.0,)),
    "Theorem 1": lambda: detection.theorem_1(off=1.01),
    "Theorem 1, epsilon = 1 - beta": lambda: detection.theorem_1_equal(room=(0.5, 0.49, 0.48)),
    "(20), F decreases": lambda: detection.equation_20(sign=-1.0),
    "Remark 2": lambda: detection.remark_2(beyond=0.999),
    "Corollary 1": lambda: detection.corollary_1(50, factor=1.05),
    "Lemma 1": lambda: detection.lemma_1(c=(1.0, 1.0)),
    "Lemma 1, equal weights": lambda: detection.lemma_1_equal(off=1.01),
    "Lemma 1, by false-alarm rate": lambda: detection.lemma_1_levels(bound=0.6),
    "Lemma 1, corrected": lambda: detection.lemma_1_corrected(off=1.05),
    "(23)": lambda: detection.equation_23(cmax=1.0),
    "(26)": lambda: detection.equation_26(c=(1.0, 1.0)),
    "Lemma 2": lambda: detection.lemma_2(c=(1.0,)),
    "Lemma 2, by false-alarm rate": lambda: detection.lemma_2_levels(bound=0.35),
    "Lemma 2, corrected": lambda: detection.lemma_2_corrected(off=0.95),
    "Remark 3": lambda: model.remark_3(last=1),
    # a test that alarms a third of the time
    "Remark 3, threshold 2h + kp": lambda: model.remark_3(0.01, 1, True, 5),
    "Theorem 2": lambda: model.theorem_2(3, scale=1.1),
    "Theorem 2, 1/lambda": lambda: model.theorem_2_norms(plants=[WHITE]),
    "Theorem 2, 1/sqrt(lambda)": lambda: model.theorem_2_norms(True, off=1.1),
    "Section III-A, arbitrary changes": lambda: attackable.arbitrary((1.1, 1.2)),
    "Theorem 3": lambda: attackable.theorem_3(FEW, modulus=1.05),
    "Theorem 3, one eigenvector each": lambda: attackable.theorem_3_each(sensor=0),
    # nothing can be reached
    "Theorem 3, v reachable": lambda: attackable.theorem_3_reached(FEW, gain=0.0),
    "Definition 4, t^i_(k+1)": lambda: attackable.definition_4(of=bounded.IDENTITY),
    "Definition 4, t^i_k + 1": lambda: attackable.definition_4(True, f=1),
    "Remark 4": lambda: attackable.remark_4(late=1),
    "Theorem 4": lambda: attackable.theorem_4(6, less=1),
    "Theorem 4, with the sum of (46)": lambda: sprt.theorem_4((3, 4)),
    "Theorem 4, f - 1": lambda: attackable.theorem_4_less(FEW, less=0),
    "Theorem 4, distinct eigenvalues": lambda: attackable.theorem_4_less(
        FEW, distinct=True, less=1
    ),
    "Theorem 4, f - 1 on a rotation": lambda: attackable.theorem_4_rotation(bounded.IDENTITY),
    "Theorem 4, gaps that vary": lambda: attackable.theorem_4_gaps(f=1, gaps=(2, 4)),
    "Remark 5": lambda: attackable.remark_5(50, spare=1),
    "Lemma 3": lambda: bounded.lemma_3(5, on=False),
    "Lemma 3, alpha_i tends to infinity": lambda: bounded.lemma_3_limit(back=False),
    "(67), real coefficients": lambda: bounded.equation_67(VEHICLE),
    "(69), A^(j-1)": lambda: bounded.equation_69(plants=[sure([[1.0]], [[1.0]])]),
    "(69), A^j": lambda: bounded.equation_69(True, 5, off=0.01),
    "(72)": lambda: bounded.equation_72(off=0.01),
    "Theorem 5": lambda: bounded.theorem_5(FEW, less=1),
    "Theorem 5, projection vectors": lambda: bounded.projection_vectors(JORDAN),
    "(33)": lambda: bounded.equation_33(5, off=0.01),
    # residues fifty times too large
    "(40)": lambda: bounded.equation_40(5, size=50.0),
    "Theorem 6": lambda: bounded.theorem_6(FEW, aware=True),
    "Theorem 6, its bound": lambda: bounded.theorem_6_sizes(aware=True),
    "Corollary 2": lambda: bounded.corollary_2(FEW, less=1),
    "Corollary 2, one eigenvector each": lambda: attackable.corollary_2_each(sensor=0),
    "Definition 6, by (53)": lambda: regions.definition_6(t=40),
    # the first sensor is never authenticated
    "Section IV, 1)": lambda: bounded.sensor_wise(FEW, every=False),
    "Section IV, 1), more unstable eigenvalues": lambda: bounded.sensor_wise_general(VEHICLE),
    "Section IV, 1), q_un steps each": lambda: bounded.sensor_wise_enough(FEW, less=1),
    "(44), (45)": lambda: regions.equation_44(5, off=0.01),
    "(46)": lambda: sprt.equation_46(h=2.0),
    "(46), c with e^(-p/2)": lambda: sprt.equation_46(True, mean=3.0),
    "(47)": lambda: sprt.equation_47(h=2.0),
    "(47), c with e^(-p/2)": lambda: sprt.equation_47(True, off=1.01),
    "(48), (49)": lambda: regions.equation_48(5, off=0.01),
    "Section V-A, alarms without attack": lambda: sprt.alarms(h=1000.0),
    "Section V-A, alpha(t)": lambda: sprt.alpha_grows((10, 11, 12)),
    "Section V-A, the lower threshold": lambda: sprt.lower_threshold(t=1),
    "Section V-A, efficient": lambda: regions.dense(A=0.9),
    "Lemma 4": lambda: regions.lemma_4(5, moved_by=10.0),
    "(51)": lambda: regions.equation_51(plants=[GONE]),
    "(51), minus": lambda: regions.equation_51(True, 5, off=1.1),
    "Theorem 7": lambda: regions.theorem_7(5, shrink=0.5),
    "Theorem 7, the whole of (47)": lambda: regions.theorem_7_tight(t=10),
    "Theorem 7, chi-square test": lambda: regions.per_step(steps=(1,)),
    "(53)": lambda: model.equation_53(of=BLIND),
    "(53), (I - KC) Sigma": lambda: model.equation_53(True, NEARLY),
    "(53), gamma": lambda: model.gamma(5, scale=0.9),
    # alpha falls at first where h is large
    "(56), prior attacks": lambda: regions.equation_56(h=16.8),
    "(59), by recursion": lambda: regions.product(2, h=5.0),
    "(60), gamma = 0": lambda: regions.equation_60(k=10),
    "Corollary 3": lambda: regions.corollary_3(of=UNIT),
    "(61), sqrt(lambda_max)": lambda: regions.corollary_3(True, off=1.01),
    "Section V-B, terminating condition": lambda: algorithm.terminating(blocks=3),
    "Algorithm 1": lambda: algorithm.algorithm_1(limit=100.0),
    "Algorithm 1, line 4": lambda: algorithm.line_4(2),
    "Algorithm 1, line 9": lambda: algorithm.line_9(policy=Policy(1, 4)),
    "Algorithm 1, the largest L": lambda: algorithm.largest_L(limit=10.0),
}


@pytest.mark.parametrize("id", TURNED)
def test_other_inputs_turn_the_verdict(found, id):
    turned = TURNED[id]()
    assert turned.id == id
    assert turned.verdict == OPPOSITE[found[id].verdict]


def test_every_computed_verdict_has_been_turned(found):
    assert set(TURNED) == {id for id, row in found.items() if row.verdict in OPPOSITE}


@pytest.mark.whole
@pytest.mark.slow
def test_the_whole_study_has_the_same_verdicts():
    rows = [
        *integrity.statements(),
        *integrity.measured(integrity.drive(integrity.Amount(cases=None))),
    ]
    assert {row.id: row.verdict for row in rows} == {
        statement["id"]: statement["verdict"] for statement in LISTED
    }
