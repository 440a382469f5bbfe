"""The 68-bus scenario by its formulas; rows by runs made up, the demanded figures by real ones."""

import jax
import numpy as np
import pytest

from holdfast.papers import nisme_cases as cases
from holdfast.papers import nisme_figures, nisme_grid
from holdfast.papers.nisme_grid import PLANT, Amount, Drawn, Run, Told, drive, judged_by
from holdfast.plants.library import swing
from holdfast.report.paper_figures import png

SPELL, N = 0.1, 40
PLACE = nisme_grid.interval(4000)
THETA = np.asarray(swing.operating_point(PLANT))[:68]


@pytest.fixture(scope="module")
def drawn():
    """Two seeds with intervals of ten rows."""
    return jax.tree.map(
        np.asarray, nisme_grid.drawn(nisme_grid.keys(2), nisme_grid.attacks(SPELL), N)
    )


def moved(x, u, d, opened):
    """A sample of the swing equation, written out line by line."""
    lines = [tuple(map(int, pair)) for pair in swing.lines68()]
    m = np.where(np.arange(68) < 16, 10.0, 100.0)

    def rate(x):
        theta, f = np.split(x, 2)
        flow = np.zeros(68)
        for a, b in lines:
            if not (opened and {a, b} in ({56, 57}, {59, 60})):
                p = 1.5 * np.sin(theta[a - 1] - theta[b - 1])
                flow[a - 1] += p
                flow[b - 1] -= p
        pushed = np.zeros(68)
        pushed[13:16] = d
        return np.concatenate([f, (u + pushed - f - flow) / m])

    k1 = rate(x)
    k2 = rate(x + 0.005 * k1)
    k3 = rate(x + 0.005 * k2)
    return x + 0.01 / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + 0.01 * k3))


def test_the_attacks_are_those_of_section_7(drawn):
    t = 0.01 * np.arange(N + 1)
    sensors = np.where(t < SPELL, 0.01 * np.cos(0.12 * t), 0.0)
    actuators = np.where((t >= SPELL) & (t < 2 * SPELL), 0.1 - 0.6 * np.sin(0.3 * t), 0.0)
    for channel in range(3):
        np.testing.assert_allclose(drawn.d[:, :, channel], [sensors[1:]] * 2, atol=1e-12)
        # row k tells the attack of k - 1
        np.testing.assert_allclose(drawn.d[:, :, 3 + channel], [actuators[:-1]] * 2, atol=1e-12)
    load = (np.arange(68) >= 16).astype(float)
    off = drawn.y[:, :, ::3] - (drawn.x[:, :, 68:] - load * drawn.u)
    off[:, :, [25, 52, 53]] -= sensors[1:, None]
    assert np.max(np.abs(off)) < 6e-4
    assert abs(np.std(off) / 1e-4 - 1) < 0.05


def test_the_network_moves_as_it_should(drawn):
    """W is all that is left; a line taken for closed would add 4e-5 to f of its buses."""
    noise, wrong = [], []
    for x, u, d in zip(drawn.x, drawn.u, drawn.d, strict=True):
        for k in range(1, N):
            opened = 2 * SPELL <= 0.01 * k < 3 * SPELL  # d of row k + 1 acts from k
            noise.append(x[k] - moved(x[k - 1], u[k], d[k, 3:], opened))
            if opened:
                wrong.append(x[k] - moved(x[k - 1], u[k], d[k, 3:], False))
    noise = np.array(noise)
    assert abs(np.std(noise) / 1e-4 - 1) < 0.02
    buses = 68 + np.array([55, 56, 58, 59])
    across = np.sign(THETA[[55, 58]] - THETA[[56, 59]])[[0, 0, 1, 1]]
    off = np.array(wrong)[:, buses] @ (across * [1.0, -1.0, 1.0, -1.0]) / 4.0
    assert np.mean(off) > 3e-5 > 2 * 5e-5 / np.sqrt(len(off))


def test_the_controller_sees_what_was_measured(drawn):
    y = drawn.y[0, :-1].reshape(N - 1, 68, 3)
    theta, f = y[..., 1], y[..., 2]
    flow = np.zeros_like(theta)
    for a, b in swing.lines68():
        a, b = int(a) - 1, int(b) - 1
        p = 1.5 * np.sin(theta[:, a] - theta[:, b])
        flow[:, a] += p
        flow[:, b] -= p
    m = np.where(np.arange(68) < 16, 10.0, 100.0)
    np.testing.assert_allclose(
        drawn.u[0, 1:], f + flow + m * (-2 * (theta - THETA) - 2 * f), atol=1e-9
    )


def said(mode, p=None, size=1e3, dof=200, nis=None, names=nisme_grid.NAMES):
    """What a bank would have said that believed in these modes (seeds x 4000)."""
    seeds, steps = mode.shape
    p = np.eye(4)[np.minimum(mode, 3)] if p is None else p
    nothing = np.zeros((seeds, steps, 6))
    whole = np.full((seeds, steps), dof)
    told = Told(
        mode, p, np.zeros((seeds, steps, 136)), nothing, nothing, np.full((seeds, steps), size),
        whole.astype(float) if nis is None else nis, whole,
    )  # fmt: skip
    return judged_by(told, names, PLACE)


def truth():
    return np.tile(nisme_grid.true_modes(PLACE), (2, 1))


def test_accuracy_by_hand():
    mode = truth()
    assert mode[0, [0, 998, 999, 1998, 1999, 2998, 2999, 3999]].tolist() == [1, 1, 2, 2, 3, 3, 0, 0]
    mode[1, 999:1249] = 0
    found = said(mode)
    np.testing.assert_array_equal(found.accuracy, [[1, 1, 1, 1], [1, 0.75, 1, 1]])
    names = ("none", "another", nisme_grid.NAMES[1])
    assert nisme_grid.of_case_1(np.array([2, 1, 0]), names).tolist() == [1, 4, 0]


def test_a_mean_that_few_seeds_leave_open_is_let_through():
    flat = np.full((4, 4), 0.97)
    assert not cases.reached(flat, 0.98)
    assert cases.reached(flat + np.array([[0.01], [-0.01], [0.01], [-0.01]]), 0.98)


def test_line_14_of_algorithm_2():
    """Only modes with attacks are tested; the quantile of chi-square with 3 is 4.11."""
    mode = truth()
    mode[:, 2999:] = 1
    for size, wanted in ((4.10, [0, 0, 3, 0]), (4.12, [1, 2, 3, 1])):
        after = cases.after_test(said(mode, size=size))
        assert after[0, [500, 1500, 2500, 3500]].tolist() == wanted


def test_other_modes_turn_the_verdicts():
    right, none = said(truth()), said(np.zeros_like(truth()))
    late = truth()
    late[:, 1800:1900] = 0
    turns = truth()
    turns[:, 3000::2], turns[:, 3001::2] = 1, 2
    even = np.full((*truth().shape, 4), 0.25)
    loud = said(truth(), nis=np.full(truth().shape, 215.0))
    for function, good, bad in (
        (lambda s: cases.accurate("Fig. 4", "", s), right, none),
        (lambda s: cases.algorithm_2(s, "Fig. 4", "", ""), said(truth(), size=1e3), none),
        (cases.near_ten, said(np.where(np.arange(4000) < 1100, 1, truth())), said(late)),
        (lambda s: cases.swinging(s, "Fig. 4", ""), said(turns), right),
        (cases.consistent, right, loud),
        (cases.away, right, none),
        (cases.one_position, none, said(truth(), even)),
        (lambda s: cases.similar(right, s), right, none),
    ):
        assert function(good).verdict in ("holds", "reproduced")
        assert function(bad).verdict in ("fails", "not reproduced")


def made_up():
    """A run whose estimates are off by a sensor's and an actuator's noise."""
    rng = np.random.default_rng(0)
    one = said(truth())
    d = np.zeros((2, 4000, 6))
    sd = np.array([1.27e-4] * 3 + [0.1414] * 3)
    told = one.told._replace(d=sd * rng.normal(size=d.shape), sd=np.broadcast_to(sd, d.shape))
    drawn = Drawn(np.zeros((2, 4000, 136)), np.zeros((2, 4000, 68)), np.zeros((2, 4000, 204)), d)
    names = ("four", "reduced", "reduced, printed", "three, quadratic")
    return Run(drawn, dict.fromkeys(names, one._replace(told=told)))


def test_errors_of_state_and_attack():
    run = made_up()
    with_more = {
        "x": run.said["four"].told._replace(x=run.drawn.x + 7e-4),
        "d": run.said["four"].told._replace(d=1.2 * run.said["four"].told.d),
    }
    found, stated = cases.errors_of_attacks(run, "four")
    np.testing.assert_allclose(found, np.tile([1.27e-4, 0.1414], (2, 1)), rtol=0.05)
    np.testing.assert_allclose(stated, np.tile([1.27e-4, 0.1414], (2, 1)))
    for function, key in ((cases.bounded, "x"), (cases.spread, "d")):
        off = run._replace(said={"four": run.said["four"]._replace(told=with_more[key])})
        assert function(off, "Fig. 5", "four").verdict in ("fails", "not reproduced")
    assert cases.bounded(run, "Fig. 5", "four").verdict == "reproduced"


def test_the_figures_show_what_was_said():
    run = made_up()
    drawn = nisme_figures.figures(run)
    assert list(drawn) == [f"nisme-figure-{i}" for i in range(4, 8)]
    assert all(len(png(figure)) > 10_000 for figure in drawn.values())
    lines = {line.get_label(): line for line in drawn["nisme-figure-5"].axes[2].get_lines()}
    np.testing.assert_array_equal(lines["estimate"].get_ydata(), run.said["four"].told.d[0, :, 3])
    assert lines["estimate"].get_linestyle() == "None"
    assert lines["truth"].get_linestyle() == "--"


@pytest.fixture(scope="module")
def run():
    """Every bank; the full one and the four-mode one over ten seeds."""
    return drive(Amount(full=10))


@pytest.mark.whole
@pytest.mark.slow
def test_the_demanded_figures(run):
    """Means over ten seeds as they are, no allowance."""
    four, full = run.said["four"], run.said["full"]
    assert len(four.accuracy) == len(full.accuracy) == 10
    assert np.all(four.accuracy.mean(0) >= cases.NEAR)
    assert np.all(full.accuracy.mean(0) >= cases.FULL)
    kept = cases.settled(full.place)
    assert np.all(nisme_grid.accuracy(full.right[:, kept], full.place[kept]).mean(0) >= 0.98)
    found, stated = cases.errors_of_attacks(run, "four")
    np.testing.assert_allclose(found.mean(0), [1.27e-4, 0.1414], rtol=0.03)
    np.testing.assert_allclose(stated.mean(0), [1.27e-4, 0.1414], rtol=0.03)
    assert np.all(np.abs(cases.consistent(four).ours) < 3)


@pytest.mark.whole
@pytest.mark.slow
def test_the_verdicts(run):
    rows = {row.id: row for row in cases.judged(run)}
    assert {id: row.verdict for id, row in rows.items()} == VERDICTS
    # errata 5 to 7: what the printed algorithms score
    np.testing.assert_allclose(rows["Fig. 4, Algorithm 2"].ours, [1, 0.725, 1, 0], atol=0.02)
    np.testing.assert_allclose(rows["Fig. 6, z = 2.58"].ours, [0.88, 0.51, 0.91, 0.90], atol=0.1)
    assert max(rows["Fig. 6"].ours) < 0.55
    assert 5 < rows["Fig. 4, after 30 s, quadratic"].ours < 30


VERDICTS = {
    "Section 7, setting": "unstated", "Fig. 4": "holds", "Fig. 4, (15)": "fails",
    "Fig. 4, quadratic": "fails", "Fig. 4, prior x 10": "fails", "Fig. 4, prior / 10": "holds",
    "Fig. 4, Algorithm 2": "fails", "Fig. 4, Algorithm 2, quadratic": "fails",
    "Fig. 4, near 10 s": "reproduced", "Fig. 4, after 30 s": "not reproduced",
    "Fig. 4, after 30 s, quadratic": "reproduced", "Fig. 5": "reproduced",
    "Fig. 5, attacks": "holds", "Fig. 5, residuals": "holds", "Case study 2": "holds",
    "Fig. 6": "fails", "Fig. 6, z = 2.58": "fails", "Fig. 6, budget": "fails",
    "Fig. 6, (15)": "fails", "Fig. 6, quadratic": "fails", "Fig. 6, prior x 10": "fails",
    "Fig. 6, prior / 10": "fails", "Fig. 6, after 30 s": "reproduced",
    "Section 7, reduced bank": "fails", "Fig. 7": "reproduced",
    "Case study 2, full bank": "holds", "Case study 2, full bank, settled": "holds",
    "Case study 2, full bank, (15)": "fails", "Case study 2, full bank, quadratic": "fails",
}  # fmt: skip
