"""The case studies of NISME on the 68-bus network, judged.

Accuracy is the share of the rows of [0, 10), [10, 20), [20, 30), [30, 40) s in which the mode is
named that is true then: sensors, actuators, lines, none.
"""

from typing import Any

import numpy as np
from scipy.special import chdtri

from holdfast.analysis.modes import reduce
from holdfast.papers import nisme_grid as grid
from holdfast.papers.nisme_grid import Amount, Run, Said, drive
from holdfast.papers.rows import DEVIATIONS, Row, claim, claim_over_seeds, figure, unstated
from holdfast.plants.library import swing

NEAR = (0.99, 0.90, 0.97, 0.96)
"""Accuracy from which the estimates count as coincident with the true modes; attacks are small
near 10 s."""
FULL = (0.98, 0.0, 0.98, 0.0)
"""The same for the bank of all 256 modes; `away` from the transitions it is .98 everywhere."""
SETTLING = (1.0, 2.5, 1.0, 1.0)
"""Seconds from the beginning of each interval that count as its transition."""
PRINTED_LEVEL = 0.75
SENSOR_SD, ACTUATOR_SD = 1.27e-4, 0.1414
"""Standard deviations of the attack estimates, by the errata."""


def cases(amount: Amount = Amount()) -> list[Row]:  # noqa: B008
    """All rows of the case studies."""
    return judged(drive(amount))


def judged(run: Run) -> list[Row]:
    """The rows of a run."""
    return [setting(), *first(run), *second(run)]


def first(run: Run) -> list[Row]:
    """Case study 1."""
    said = run.said
    return [
        accurate("Fig. 4", "evidence, attack-free mode in the bank", said["four"]),
        accurate("Fig. 4, (15)", "likelihood (15)", said["four, paper"]),
        accurate("Fig. 4, quadratic", "(15) without normaliser", said["four, quadratic"]),
        accurate("Fig. 4, prior x 10", "evidence, prior ten times larger",
                 said["four, prior x 10"]),
        accurate("Fig. 4, prior / 10", "evidence, prior ten times smaller",
                 said["four, prior / 10"]),
        algorithm_2(said["three, paper"], "Fig. 4, Algorithm 2", "(15)",
                    "Mode 3 wins where no attack is large, and nothing in it is tested."),
        algorithm_2(said["three, quadratic"], "Fig. 4, Algorithm 2, quadratic",
                    "(15) without normaliser", "More free attacks always fit better: mode 3 "
                    "loses, and a test at .75 passes at most .75 of the rows without attack."),
        near_ten(said["four"]),
        swinging(said["three, paper"], "Fig. 4, after 30 s", "(15)",
                 "Both are true with d = 0, but mode 3 wins, which is not: each output that a mode "
                 "gives up for an attack costs it about 8 nats a row."),
        swinging(said["three, quadratic"], "Fig. 4, after 30 s, quadratic",
                 "(15) without normaliser"),
        bounded(run, "Fig. 5", "four"),
        spread(run, "Fig. 5, attacks", "four"),
        consistent(run.said["four"]),
    ]  # fmt: skip


def second(run: Run) -> list[Row]:
    """Case study 2."""
    said = run.said
    budget = said["reduced"]
    return [
        from_256_to_4(),
        accurate("Fig. 6", "reduced bank, each z over 1.28", said["reduced, printed"],
                 "Six tests at 20 % false alarms each."),
        accurate("Fig. 6, z = 2.58", "reduced bank, each z over 2.58", said["reduced, strict"]),
        accurate("Fig. 6, budget", "reduced bank, false alarms at 1 % of rows over all channels",
                 budget, "An actuator's estimate of one row has a sd of 0.14."),
        accurate("Fig. 6, (15)", "reduced bank, budget, (15)", said["reduced, paper"],
                 "All its modes have the same channels: no likelihood is favoured."),
        accurate("Fig. 6, quadratic", "reduced bank, budget, (15) without normaliser",
                 said["reduced, quadratic"]),
        accurate("Fig. 6, prior x 10", "reduced bank, budget, prior ten times larger",
                 said["reduced, prior x 10"]),
        accurate("Fig. 6, prior / 10", "reduced bank, budget, prior ten times smaller",
                 said["reduced, prior / 10"]),
        one_position(budget),
        similar(said["four"], budget),
        bounded(run, "Fig. 7", "reduced"),
        accurate("Case study 2, full bank", "all 256 modes, evidence", said["full"],
                 "An open line tells itself by 0.18 nats a row: from even odds some 5 rows are "
                 "wrong for each of two lines, whatever the filter.", FULL),
        away(said["full"]),
        accurate("Case study 2, full bank, (15)", "all 256 modes, (15), intervals of 1 s",
                 said["full, paper"], "", FULL),
        accurate("Case study 2, full bank, quadratic", "all 256 modes, (15) without normaliser, "
                 "intervals of 1 s", said["full, quadratic"], "", FULL),
    ]  # fmt: skip


def setting() -> Row:
    """What Section 7 does not say."""
    return unstated(
        "Section 7, setting", "operating point, controller, x_0, P_0, attack prior", None,
        "Chosen: theta_i = 0.3 sin(i) rad (at a flat one a line can hardly be seen), feedback "
        "linearisation from measured theta and f, x_0 ~ N(theta*, 0.01^2), w held over a sample; "
        f"prior sd .01 (sensors) and .3 (actuators), floor {grid.FLOOR:g}.",
    )  # fmt: skip


def reached(shares: np.ndarray, least: Any) -> bool:
    """Whether means over seeds (seeds x 4) may be ``least`` or more: three standard errors below
    it are allowed, as few seeds tell no better.
    """
    error = shares.std(0, ddof=1) / np.sqrt(len(shares))
    return bool(np.all(shares.mean(0) + DEVIATIONS * error >= least))


def accurate(id: str, what: str, said: Said, note: str = "", least=NEAR) -> Row:
    """Whether a bank's modes are nearly always the true ones."""
    found = said.accuracy
    wanted = [f">= {share:g}" for share in least]
    return claim_over_seeds(
        id, f"estimates coincide with the true modes: share of rows, {len(found)} seeds; {what}",
        wanted, found, reached(found, least), note,
    )  # fmt: skip


def after_test(said: Said, level: float = PRINTED_LEVEL) -> np.ndarray:
    """Modes after line 14 of Algorithm 2: 0 where d^' P^-1 d^ is under the quantile.

    An empty d_1 or d_2 is passed over; in mode 3, which has neither, nothing is tested.
    """
    insignificant = said.told.size < chdtri(3, 1.0 - level)
    return np.where((said.mode != 3) & insignificant, 0, said.mode)


def algorithm_2(said: Said, id: str, likelihood: str, note: str) -> Row:
    """Three modes and a test for the fourth, as printed."""
    mode = after_test(said)
    found = said._replace(right=mode == grid.true_modes(said.place))
    return accurate(id, f"modes 1 to 3, {likelihood}, line 14 at .75", found, note)


def near_ten(said: Said) -> Row:
    """Where the errors of [10, 20) lie."""
    rows = np.flatnonzero(said.place == 1)
    soon = rows < rows[0] + round(SETTLING[1] / grid.PLANT.dt)
    wrong = ~said.right[:, rows]
    share = wrong[:, soon].sum(1) / np.maximum(wrong.sum(1), 1)
    return figure(
        "Fig. 4, near 10 s", "mode estimation is inaccurate near 10 s: share of all wrong rows of "
        "[10, 20) that lie before 12.5 s, evidence", "most", share, bool(np.all(share > 0.5)),
    )  # fmt: skip


def swinging(said: Said, id: str, likelihood: str, note: str = "") -> Row:
    """How often modes 1 and 2 take turns once nobody attacks."""
    last = said.place == 3
    mode = said.mode[:, last][:, np.sum(last) // 10 :]
    turns = np.isin(mode[:, 1:], (1, 2)) & np.isin(mode[:, :-1], (1, 2)) & (np.diff(mode) != 0)
    each = turns.mean(1) / grid.PLANT.dt
    return figure(
        id, f"after 30 s the probabilities of modes 1 and 2 oscillate: changes per second from "
        f"31 s on, {likelihood}", "> 0", each, bool(np.all(each > 1.0)),
        note,
    )  # fmt: skip


def bounded(run: Run, id: str, bank: str) -> Row:
    """The largest error of a state, in standard deviations of a measurement."""
    told = run.said[bank].told
    error = np.abs(told.x - np.asarray(run.drawn.x)[: len(told.x)])
    sensor = float(grid.PLANT.deviation[1][0])
    worst = error[:, round(0.1 / grid.PLANT.dt) :].max((1, 2)) / sensor
    return figure(
        id, "state errors stay bounded through all changes of mode: the largest from 0.1 s on, in "
        "sd of a sensor", "bounded", worst, bool(np.all(worst < 6.0)),
    )  # fmt: skip


def errors_of_attacks(run: Run, bank: str) -> tuple[np.ndarray, np.ndarray]:
    """Per seed (seeds x 2: sensors, actuators), where the mode is right and settled: sd of the
    errors of the estimate, and sd stated.
    """
    said = run.said[bank]
    gap = said.told.d - np.asarray(run.drawn.d)[: len(said.told.d)]
    late = settled(said.place)
    found, stated = [], []
    for seed, right in enumerate(said.right):
        rows = [right & late & (said.place == i) for i in range(2)]
        channels = slice(0, 3), slice(3, 6)
        pairs = list(zip(rows, channels, strict=True))
        found.append([np.sqrt(np.mean(gap[seed][r][:, c] ** 2)) for r, c in pairs])
        stated.append([np.mean(said.told.sd[seed][r][:, c]) for r, c in pairs])
    return np.array(found), np.array(stated)


def spread(run: Run, id: str, bank: str) -> Row:
    """How well one row tells an attack."""
    found, stated = errors_of_attacks(run, bank)
    wanted = np.array([SENSOR_SD, ACTUATOR_SD])
    close = np.abs(np.stack([found.mean(0), stated.mean(0)]) / wanted - 1.0) < 0.03
    return claim_over_seeds(
        id, "the attacks are well estimated: root mean square error of one row's estimate, sensors "
        "and actuators", wanted.tolist(), found, bool(np.all(close)),
        "The bank states {:.4g} and {:.4g}; the numbers beside are those of the errata.".format(
            *stated.mean(0)
        ),
    )  # fmt: skip


def consistent(said: Said) -> Row:
    """The mean normalised residual of the true mode's filter, in standard deviations of a mean."""
    use = said.right & settled(said.place) & (said.told.dof > 0)
    off = np.where(use, said.told.nis - said.told.dof, 0.0)
    scores = [
        off[:, said.place == i].sum()
        / np.sqrt(2.0 * (said.told.dof * use)[:, said.place == i].sum())
        for i in range(4)
    ]
    return claim(
        "Fig. 5, residuals", "of the true mode's filter: mean of r' S^+ r less its degrees of "
        "freedom, in sd of the mean, by interval", "within 3", scores,
        bool(np.all(np.abs(scores) < 3.0)),
        f"Every {grid.EVERY}th row, away from the transitions.",
    )  # fmt: skip


def settled(place: np.ndarray) -> np.ndarray:
    """Rows away from the transitions; the run's beginning counts as none."""
    since = np.arange(len(place)) - np.searchsorted(place, place)
    return (place == 0) | (since * grid.PLANT.dt >= np.array(SETTLING)[place])


def away(said: Said) -> Row:
    """The full bank once a change of mode is over."""
    kept = settled(said.place)
    found = grid.accuracy(said.right[:, kept], said.place[kept])
    return claim_over_seeds(
        "Case study 2, full bank, settled", "all 256 modes, evidence, but for 1 s after each "
        f"switch and 2.5 s after 10 s: share of right rows, {len(found)} seeds",
        [">= 0.98"] * 4, found, reached(found, 0.98),
    )  # fmt: skip


def from_256_to_4() -> Row:
    """Algorithms 3 and 5 at every position of the switches."""
    found = reduce(grid.PLANT, np.asarray(swing.operating_point(grid.PLANT)))
    kept = [len(one.channels) for position in found.positions for one in position.kept]
    return claim(
        "Case study 2", "256 modes are reduced to four, one for each position of the switches, "
        "each with all six channels", [256, 4, 6], [found.all, found.kept, min(kept)],
        (found.all, kept) == (256, [6] * 4),
    )  # fmt: skip


def one_position(said: Said) -> Row:
    """Which position the reduced bank believes in when only j_1 is true."""
    rows = (said.place == 3) & settled(said.place)
    p = said.told.p[:, rows, 0]
    return figure(
        "Fig. 6, after 30 s", "from 31 s on the probabilities do not oscillate, j_1 alone being "
        "true: share of rows in which it is the likeliest", "all", (p > 0.5).mean(1),
        bool(np.all(p > 0.5)),
    )  # fmt: skip


def similar(four: Said, reduced: Said) -> Row:
    """Whether fewer modes name as well as the right ones."""
    lost = four.accuracy[: len(reduced.accuracy)] - reduced.accuracy
    return claim_over_seeds(
        "Section 7, reduced bank", "the reduced bank shows similar results: accuracy lost against "
        "the four modes of case study 1", "little", lost, bool(np.all(lost.mean(0) < 0.05)),
        "Six z-tests on one row each see less than modes weighed over many rows.",
    )  # fmt: skip
