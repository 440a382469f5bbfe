"""The rows on NISME's statements against their list; every verdict turned by other inputs."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from holdfast.papers import nisme
from holdfast.papers import nisme_assumptions as conditions
from holdfast.papers import nisme_claims as claims
from holdfast.papers import nisme_derivation as derivation
from holdfast.papers import nisme_filter as lines
from holdfast.papers import nisme_modes as modes
from holdfast.papers import nisme_stability as stability
from holdfast.papers import nisme_tests as tests
from holdfast.papers.nisme_claims import Plane
from holdfast.papers.nisme_systems import Text
from holdfast.report.tables import json_safe

pytestmark = pytest.mark.slow

LISTED = tomllib.loads((Path(__file__).parent / "nisme_statements.toml").read_text())["statement"]
OPPOSITE = {"holds": "fails", "fails": "holds"}


@pytest.fixture(scope="module")
def found():
    """Every row but the case studies', by id."""
    rows = nisme.ordered(nisme.statements())
    assert len({row.id for row in rows}) == len(rows)
    return {row.id: row for row in rows}


def test_every_statement_has_its_row_in_order_and_its_verdict(found):
    assert {id: row.verdict for id, row in found.items()} == {
        statement["id"]: statement["verdict"] for statement in LISTED
    }
    assert list(found) == [statement["id"] for statement in LISTED]


OTHERS = {"Definition 3.1", "Theorem 4.5"}
"""Of [22] and [20]."""


def test_the_list_holds_everything_that_the_paper_numbers(shared_data):
    texts = sorted((shared_data.parent / "papers").glob("004_*.txt"))
    if not texts:
        pytest.skip("the paper's text is not here")
    text = texts[0].read_text().split("## References\n")[0]
    kinds = "Definition|Assumption|Theorem|Lemma|Claim|Remark"
    numbered = {" ".join(pair) for pair in re.findall(rf"\b({kinds}) (\d\.\d|[A-C]\.\d)\b", text)}
    numbered |= {f"Algorithm {k}" for k in re.findall(r"\bAlgorithm (\d)\b", text)}
    numbered -= OTHERS
    assert len(numbered) == 3 + 5 + 2 + 3 + 6 + 4 + 5
    assert numbered <= {statement["id"].split(", ")[0] for statement in LISTED}


ERRATA = {
    1: [
        "Algorithm 1, line 11", "Lemma 8.1, P_(k|k-1)", "Lemma 8.1, P_k", "Algorithm 1, line 3",
        "Algorithm 1, line 3, sizes", "Algorithm 1, line 2", "Algorithm 1, line 4", "(20)",
        "(11), C_(1,k)", "Algorithm 1, corrected",
    ],
    2: [
        "Section 5, R_2 and R_3 as printed", "Section 5, R_2 and R_3 exchanged", "(8), Sigmabar",
        "(8), Sigmabar Vbar_1'",
    ],
    3: ["Algorithm 1, line 1", "Algorithm 1, line 1, Vbar_1", "Remark 4.1"],
    4: ["Section 4.2, BLUE, d_2", "Section 4.2, BLUE, x and d_1", "Algorithm 1, the library"],
    5: [
        "Algorithm 1, line 15", "Algorithm 1, line 15, evidence", "Section 8.2, N_k^j",
        "Section 8.2, N_k^j, with a prior",
    ],
    6: ["Algorithm 2, line 14, no attack"],
    7: [
        "Algorithm 2, significance level", "Algorithm 2, confidence level",
        "Algorithm 4, significance level", "Algorithm 4, confidence level",
        "Algorithm 4, six tests",
    ],
    8: ["Algorithm 4, d_1(l_1)", "Algorithm 4, V_1 d_1 + V_2 d_2"],
    9: [
        "Algorithm 3", "Algorithm 3, i = s + m : 0", "(13), i = 1 .. n + m", "Algorithm 5",
        "Algorithm 2, P_0^d1 and P_0^(x d1)", "Algorithm 2, line 15 else",
        "Algorithm 2, line 14, <", "Definition 1.2, Phi C C' Phi'", "Definition 1.2, Phi' C'C Phi",
    ],
    10: ["(2), d_s,i in R", "(2), P_elec", "(4), locations"],
}  # fmt: skip


def test_every_erratum_has_its_rows():
    listed = {statement["id"] for statement in LISTED}
    for ids in ERRATA.values():
        assert set(ids) <= listed


def test_what_is_not_computed_is_said_so(found):
    assert [id for id, row in found.items() if row.verdict not in OPPOSITE] == [
        "(3), unique solution", "Fig. 1", "Fig. 2", "Algorithm 2, P_0^d1 and P_0^(x d1)",
        "Algorithm 2, line 15 else", "Assumption 5.1", "Remark 5.1", "Algorithm 5",
    ]  # fmt: skip


def test_rows_are_fit_for_json(found):
    rows = [row.as_dict() for row in found.values()]
    text = json.dumps(json_safe(rows), allow_nan=False)
    assert len(json.loads(text)) == len(found)
    for row in found.values():
        assert row.ours is None or "null" not in json.dumps(json_safe(row.ours)), row.id


ALIKE = Plane(1.0, 1.0, 1.0)
"""All noise of one size."""
NO_Z3 = (3, 3, 3, 1)
"""As many outputs as attacks: nothing is left for z_3."""


def network_without(name):
    """The network's assumptions, one of them not met in mode 2."""
    found = conditions.network()
    found[2][name] = found[2][name]._replace(holds=False)
    return found


TURNED = {
    "Definition 1.1": lambda: stability.definition_1_1(walking=True),
    "Definition 1.2": lambda: modes.definition_1_2_constant(steps=1),
    # nothing moves, and C is symmetric
    "Definition 1.2, Phi C C' Phi'": lambda: modes.definition_1_2(A=np.eye(2)),
    "Definition 1.2, Phi' C'C Phi": lambda: modes.definition_1_2(True, count=1),
    "(2), P_elec": lambda: modes.equation_2(kinds=(0, 1), count=2),
    "(2), d_s,i in R": lambda: modes.equation_2_size(entries=3),
    "(4), locations": lambda: modes.equation_4(load=False),
    "Remark 4.1": lambda: lines.remark_4_1(hidden=False),
    "(5), (8), linearised": lambda: lines.equation_5(x=0.0),
    "(6), (7)": lambda: lines.decomposed(off=1e-3),
    "(8), Sigmabar": lambda: lines.equation_8(alone=True),
    "(8), Sigmabar Vbar_1'": lambda: lines.equation_8(True, off=0.01),
    "Assumption 4.1, 68-bus network": lambda: conditions.each(
        network_without("Assumption 4.1"), "Assumption 4.1"
    ),
    "Assumption 4.1, unicycle": lambda: conditions.assumption_4_1(odometry=False),
    "Section 4.2, BLUE, d_2": lambda: lines.blue(size=NO_Z3),
    "Section 4.2, BLUE, x and d_1": lambda: lines.blue(True, Text(line_11=False)),
    "(11), C_(1,k)": lambda: lines.as_printed("(11), C_(1,k)", moving=False),
    "Algorithm 1": lambda: lines.algorithm_1_printed(Text()),
    "Algorithm 1, corrected": lambda: lines.algorithm_1(text=Text(line_11=False)),
    "Algorithm 1, the library": lambda: lines.the_library(2, off=0.01),
    "Algorithm 1, line 1": lambda: lines.line_1(active=True),
    "Algorithm 1, line 1, Vbar_1": lambda: lines.line_1(True, dropped=1),
    "Algorithm 1, line 2": lambda: lines.as_printed("Algorithm 1, line 2", u=0.0),
    "Algorithm 1, line 3": lambda: lines.as_printed("Algorithm 1, line 3", apart=True),
    "Algorithm 1, line 4": lambda: lines.as_printed("Algorithm 1, line 4", scale=0.0),
    "Algorithm 1, line 11": lambda: lines.as_printed("Algorithm 1, line 11", size=NO_Z3),
    # two states, H of rank 2
    "Algorithm 1, line 3, sizes": lambda: lines.line_3_sizes((2, 4, 3, 2)),
    "Algorithm 1, line 15": lambda: tests.line_15(units=(1.0,)),
    "Algorithm 1, line 15, evidence": lambda: tests.line_15(True, by_unit=2.0),
    "Algorithm 2, line 10, delta": lambda: tests.floor(count=1),
    "Algorithm 2, line 10, delta / (1 + (|M| - 1) delta)": lambda: tests.floor(True, floored=False),
    "Algorithm 2, line 14": lambda: tests.chi_square_of_d(factor=1.1),
    "Algorithm 2, line 14, <": lambda: tests.empty(sensors=2),
    "Algorithm 2, line 14, <=": lambda: tests.empty(True, statistic=9.0),
    "Algorithm 2, line 14, no attack": lambda: tests.afterthought(limit=11.34),
    "Algorithm 2, significance level": lambda: tests.levels("Algorithm 2", 0.25, 3, 4.11),
    "Algorithm 2, confidence level": lambda: tests.levels("Algorithm 2", 0.25, 3, 4.11, True),
    "Section 5, R_2 and R_3 as printed": lambda: lines.section_5(diagonal=True),
    "Section 5, R_2 and R_3 exchanged": lambda: lines.section_5(True, off=0.01),
    "Assumption 5.2, 68-bus network": lambda: conditions.each(
        network_without("Assumption 5.2"), "Assumption 5.2"
    ),
    "Assumption 5.2, bi-Lipschitz": lambda: conditions.bi_lipschitz(shear=0.1),
    "Assumption 5.3": lambda: conditions.assumption_5_3(lambda x: 2 * x, lambda x: 2.0),
    "Assumption 5.3, rho": lambda: conditions.assumption_5_3_rho(rate=0.0),
    "Assumption 5.3, Hoelder": lambda: conditions.hoelder(np.ones_like),
    "Assumption 5.3, 68-bus network": lambda: conditions.each(
        network_without("Assumption 5.3"), "Assumption 5.3"
    ),
    "Assumption 5.4, 68-bus network": lambda: conditions.each(
        network_without("Assumption 5.4"), "Assumption 5.4"
    ),
    # faster, and never corrected
    "Theorem 5.1": lambda: stability.theorem_5_1(gain=False, faster=3.0),
    "Theorem 5.1, nonlinear": lambda: stability.theorem_5_1_nonlinear(linear=True),
    "Lemma 5.1": lambda: stability.lemma_5_1(start=1.0),
    "Lemma 5.1, k >= 1": lambda: stability.lemma_5_1(True, noise=0.0),
    "(13), i = 1 .. n + m": lambda: modes.index(states=68),
    "Definition 6.1": lambda: modes.definition_6_1(spare=-1),
    "Section 6.1, same detection capabilities": lambda: modes.capabilities(sensor=True),
    "Section 6.1, M^ob": lambda: modes.sufficient(weaker=True),
    "Section 6.1, subsets": lambda: modes.subsets(apart=True),
    # judged by what may not be: an odd number of channels
    "Section 6.1, subsets that samples determine": lambda: modes.subsets(True, odd=True),
    "Section 6.1, redundant": lambda: modes.redundant(dropped=0),
    "Algorithm 3": lambda: modes.algorithm_3_finds(empty=False),
    "Algorithm 3, i = s + m : 0": lambda: modes.algorithm_3_finds(True, least=1),
    "Remark 6.1": lambda: modes.remark_6_1(moved=False),
    "Algorithm 4, significance level": lambda: tests.levels("Algorithm 4", 0.2, None, 1.28),
    "Algorithm 4, confidence level": lambda: tests.levels("Algorithm 4", 0.2, None, 1.28, True),
    "Algorithm 4, six tests": lambda: tests.six_tests(limit=3.0),
    "Algorithm 4, d_1(l_1)": lambda: tests.named(turned=0.0),
    "Algorithm 4, V_1 d_1 + V_2 d_2": lambda: tests.named(True, attacked=1.0),
    "Remark 7.1": lambda: conditions.remark_7_1(network_without("Assumption 5.2")),
    "Remark 7.1, Assumption 5.1": lambda: conditions.case_study_attack(jump=0.0),
    "Lemma 8.1": lambda: derivation.lemma_8_1(noise=-1.0),
    "Lemma 8.1, P_(k|k-1)": lambda: derivation.lemma_8_1_covariance(size=NO_Z3),
    "Lemma 8.1, P_k": lambda: derivation.lemma_8_1_covariance(True, off=0.01),
    "Theorem 8.1": lambda: derivation.theorem_8_1(tilt=0.01, longer=1.1),
    "(20)": lambda: derivation.equation_20(scale=0.0),
    "Section 8.1.4, (C_3 P)'": lambda: derivation.gain_equation(identity=True),
    "Section 8.1.4, C_3 P C_3'": lambda: derivation.gain_equation(True, off=0.01),
    "(22)": lambda: derivation.equation_22(off=0.01),
    "Section 8.2, N_k^j": lambda: tests.line_15_density(attacked=False),
    "Section 8.2, N_k^j, with a prior": lambda: tests.line_15_parts(off=0.01),
    "Lemma 8.2": lambda: stability.lemma_8_2(k=1),
    "Lemma 8.2, one sample": lambda: stability.lemma_8_2_one(phi=1.0, rate=200.0),
    "Lemma 8.2, d_2": lambda: stability.lemma_8_2_attack(g1=1.0),
    "Lemma 8.2, l = pbar c_3 r_3": lambda: claims.lemma_8_2_gain(of=Plane(1.0, 1.0, 2.0)),
    "Lemma 8.2, l = pbar c_3 / r_3": lambda: claims.lemma_8_2_gain(True, factor=0.5),
    "Section 8.3.2, q": lambda: claims.lower_q(ALIKE),
    "Section 8.3.2, qbar": lambda: claims.upper_q(ALIKE),
    "Section 8.3.2, V": lambda: claims.equation_27(Plane(4.0, 4.0, 4.0)),
    "Section 8.3.2, epsilon_0": lambda: claims.epsilon_0(apart=True),
    "Claim B.1": lambda: claims.claim_b_1(of=Plane(1.0, 0.01, 1.0)),
    "Claim B.1, q = eps^2 q'": lambda: claims.claim_b_1(True, factor=0.5),
    "Claim B.2": lambda: claims.claim_b_2(of=Plane(10.0, 10.0, 10.0)),
    "Claim B.2, 1/p": lambda: claims.claim_b_2(True, factor=1e-3),
    "Claim B.3": lambda: claims.claim_b_3(bend=0.0),
    "Claim B.4": lambda: claims.claim_b_4(chi=1e-4),
    "Claim B.4, 1/p": lambda: claims.claim_b_4(True, factor=1e-4),
    "Claim B.5": lambda: claims.claim_b_5(k=5),
    "Claim C.1": lambda: stability.claim_c_1(off=0.1),
}


@pytest.mark.parametrize("id", TURNED)
def test_other_inputs_turn_the_verdict(found, id):
    turned = TURNED[id]()
    assert turned.id == id
    assert turned.verdict == OPPOSITE[found[id].verdict]


def test_every_computed_verdict_has_been_turned(found):
    assert set(TURNED) == {id for id, row in found.items() if row.verdict in OPPOSITE}
