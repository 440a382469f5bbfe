"""DECOMPOSE (paper 001), judged: the example, Fig. 2 and every numbered statement."""

from typing import Any, NamedTuple

import numpy as np

from holdfast.papers import decompose_algebra as algebra
from holdfast.papers import decompose_numbers as numbers
from holdfast.papers import decompose_secure as secure
from holdfast.papers import decompose_squares as squares
from holdfast.papers import decompose_stability as stability
from holdfast.papers.decompose_fusion import (
    DRAWS,
    GAMMAS,
    SEEDS,
    STEPS,
    Growth,
    Sweep,
    drawn,
    fused,
    growth,
    sweep,
)
from holdfast.papers.rows import Row, Study, read_only

ORDER = (
    "Fig. 1", "Assumption 1", "(5)", "(7)", "Assumption 2", "Section III", "Remark 1", "(12)",
    "Theorem 1", "(15)", "(16)", "Corollary 1", "(20)", "Lemma 1", "(22)", "(23)", "(29)",
    "Theorem 2", "Remark 2", "(31)", "Theorem 3", "(32)", "(33)", "Remark 3", "Theorem 4",
    "(34)", "Section VI", "Fig. 2", "Remark 4", "Lemma 2", "Lemma 3", "(36)", "(38)",
    "Appendix A", "(39)", "(40)", "(41)",
)  # fmt: skip
"""The paper's own order, by what stands before the first comma of an id."""


SIZES = (*np.geomspace(1.0, 100.0, 13), *np.geomspace(1e3, stability.LARGER, 6))
"""Of the attacks: close together where the errors stop growing."""


class Amount(NamedTuple):
    """How much is drawn: the whole study, or less of it."""

    seeds: int = SEEDS
    draws: int = DRAWS
    steps: int = STEPS
    gammas: tuple[float, ...] = GAMMAS
    shares: int = secure.SHARES
    solved: int = 400
    sizes: tuple[float, ...] = SIZES
    attacked: int = 25


class Run(NamedTuple):
    """What the rows and the figures are made from."""

    amount: Amount
    sweep: Sweep
    over_time: np.ndarray
    solved: dict[tuple[float, int], secure.Solved]
    shares: np.ndarray
    noise: np.ndarray
    grown: Growth
    authenticated: tuple[Growth, ...]


def drive(amount: Amount) -> Run:
    """Everything that is drawn and solved."""
    noise = drawn(amount.seeds, amount.attacked, 15)
    few = np.array([stability.LARGE, stability.LARGER])
    sizes = np.array(amount.sizes)
    residual = noise[..., :12]
    solved = {
        (gamma, sensor): secure.solved(
            gamma, secure.SIZE if sensor else 0.0, amount.solved, max(sensor - 1, 0)
        )
        for gamma in (0.3, 2.0, 30.0)
        for sensor in range(6)
    }
    return Run(
        amount,
        sweep(fused(), amount.seeds, amount.draws, amount.gammas),
        secure.over_time(amount.seeds, amount.steps),
        solved,
        secure.shares(fused(), amount.seeds, amount.shares),
        noise,
        growth(sizes, residual),
        tuple(growth(sizes if i == 1 else few, residual, authenticated=(i,)) for i in range(5)),
    )


def study(amount: Amount = Amount()) -> Study:  # noqa: B008
    """All rows, and the figures."""
    run = drive(amount)
    return Study(judged(run), lambda: figures(run))


def judged(run: Run) -> tuple[Row, ...]:
    """All rows in the paper's order."""
    rows = [*statements(), *measured(run)]
    return tuple(sorted(rows, key=_place))


def _place(row: Row) -> tuple[int, bool]:
    """The statement itself comes before what was made of it."""
    return ORDER.index(row.id.split(", ")[0]), ", " in row.id


def statements() -> list[Row]:
    """The rows that need no draws."""
    return [
        read_only(
            "Fig. 1", "block diagram: sensors, local estimators, fusion", None,
            "A sketch of (11), (12) and (31) without a statement of its own.",
        ),
        algebra.assumption_1(),
        algebra.assumption_1_beside(),
        algebra.equation_5(),
        algebra.equation_7(),
        algebra.equation_7(corrected=True),
        algebra.assumption_2(),
        algebra.observable_part(),
        algebra.remark_1(),
        algebra.remark_1_simple(),
        algebra.equation_12(),
        algebra.theorem_1(),
        algebra.equation_15(),
        algebra.equation_16(),
        algebra.corollary_1(),
        algebra.equation_20(),
        algebra.lemma_1(),
        algebra.equation_22(),
        algebra.equation_23(),
        squares.equation_29(),
        squares.theorem_2(),
        squares.theorem_2_repeated(),
        squares.theorem_2_kkt(),
        squares.remark_2(),
        squares.remark_2_squares(),
        secure.minimiser(),
        secure.complex_entries(),
        stability.condition(),
        stability.authenticated(),
        numbers.unobservable(),
        *numbers.numbers(),
        *squares.appendix(),
    ]  # fmt: skip


def measured(run: Run) -> list[Row]:
    """The rows that come from draws and runs."""
    amount = run.amount
    benign = [one for (_, sensor), one in run.solved.items() if sensor == 0]
    attacked = [one for (_, sensor), one in run.solved.items() if sensor > 0]
    often = run.solved[30.0, 0]
    observed = float(np.mean(~np.any(often.f != 0, 1)))
    return [
        secure.equation_32("Theorem 3, part 1", benign),
        secure.equation_32("(32)", attacked),
        secure.theorem_3_part_2(often),
        secure.equation_33(often),
        secure.remark_3(run.shares, observed, amount.solved),
        stability.theorem_4(run.noise),
        stability.each_sensor(run.grown),
        stability.authenticated_errors(run.authenticated),
        numbers.settings(amount.seeds, amount.draws, amount.steps),
        secure.figure_2(run.sweep),
        secure.figure_2_attacked(run.sweep),
        secure.figure_2_every(run.sweep),
        secure.figure_2_over_time(run.sweep, run.over_time),
        secure.remark_4(run.sweep, run.shares),
    ]


def figures(run: Run) -> dict[str, Any]:
    """Fig. 2 with every sensor attacked, and the error against the size of the attack."""
    from holdfast.report.paper_figures import Panel, over

    names = [f"sensor {i} attacked" for i in range(1, 6)]
    benign, *attacked = run.sweep.errors.mean(2)
    curves = {**dict(zip(names, attacked, strict=True)), "all benign": benign}
    title = f"mean squared error over tr P; attack of {secure.SIZE:g}"

    def errors(grown: Growth) -> dict[str, np.ndarray]:
        lines = zip(names, grown.errors, strict=True)
        return {name: line for name, line in lines if np.all(np.isfinite(line))}

    rms = "root mean squared error, gamma 0.75"
    sizes = [
        Panel(rms, errors(run.grown), log=True),
        Panel(f"{rms}, sensor 2 always authenticated", errors(run.authenticated[1]), log=True),
    ]
    return {
        "decompose-figure-2": over(
            np.array(run.sweep.gammas), [Panel(title, curves, log=True)], "gamma"
        ),
        "decompose-attack-size": over(run.grown.sizes, sizes, "constant attack a", same=True),
    }
