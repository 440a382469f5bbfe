"""DECODER, Sections V-B and V-C1 without noise: does placing poles let the l1 decoder see?"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.random import default_rng

from holdfast.analysis.poles import Candidate, candidates
from holdfast.controllers.feedback import closed_loop
from holdfast.numerics.l1_regression import l1_regression
from holdfast.papers.decoder_crafts import WEIGHTS, WINDOW, as_it_is
from holdfast.papers.rows import Row, claim, figure
from holdfast.plants.build import linear_plant
from holdfast.plants.library.quadrotor import GPS, STATES
from holdfast.plants.linear import LinearPlant

PAIRS, WINDOWS = 30, 10
"""Draws of the two sensors besides the positions; windows of each design."""
RATE, SD = 1.0, 3.0
"""The ramp on p_x in m/s, and the deviation of the other attack."""
EXACT = 1e-4
"""Largest error of the state, relative to its largest entry, of a window that is exact."""


class Windows(NamedTuple):
    """Per design and window: the error of the state relative to it, the l1 objective of what was
    returned over that of the truth, the rms error of e^ and e itself (T x p).
    """

    error: np.ndarray
    objective: np.ndarray
    missed: np.ndarray
    attack: np.ndarray


class Placed(NamedTuple):
    """All designs (pairs x sizes, LQR first), and the windows of LQR, of placed poles, and of
    those who know u.
    """

    designs: list[tuple[Candidate, ...]]
    lqr: Windows
    poles: Windows
    told: Windows
    reference: float


CHUNK = 100
"""Windows that are decoded in one call of the compiled solver."""


def _decoded(Phi: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """State and objective of (12) for each window."""
    spare = -len(y) % CHUNK
    padded = [np.concatenate([part, np.repeat(part[:1], spare, 0)]) for part in (Phi, y)]
    parts = [
        _chunk(*(jnp.asarray(part[i : i + CHUNK]) for part in padded))
        for i in range(0, len(padded[1]), CHUNK)
    ]
    x, objective = (np.concatenate(part)[: len(y)] for part in zip(*parts, strict=True))
    return x, objective


@jax.jit
def _chunk(Phi, y):
    def one(problem):
        found = l1_regression(*problem)
        return found.x, found.objective

    return jax.lax.map(one, (Phi, y))


def _phi(A: np.ndarray, C: np.ndarray) -> np.ndarray:
    rows = [C]
    for _ in range(WINDOW - 1):
        rows.append(rows[-1] @ A)
    return np.concatenate(rows)


def _windows(systems: list[tuple[np.ndarray, np.ndarray]], windows: int) -> Windows:
    """Of each (A, C): windows along a flight home, under the two attacks."""
    rng, Phi, states, attacks = default_rng(5), [], [], []
    for A, C in systems:
        p, stacked = len(C), _phi(A, C)
        for k in range(windows):
            x = rng.normal(size=10) * np.where(np.isin(np.arange(10), (0, 4, 8)), 10.0, 1.0)
            e = np.zeros((WINDOW, p))
            e[np.arange(WINDOW), rng.integers(1, p, WINDOW)] = SD * rng.normal(size=WINDOW)
            e[:, 0] = RATE * 0.1 * (10 * k + 1 + np.arange(WINDOW))
            Phi.append(stacked)
            states.append(x)
            attacks.append(e)
    Phi, x, e = (np.array(part) for part in (Phi, states, attacks))
    y = np.einsum("wij,wj->wi", Phi, x) + e.reshape(len(e), -1)
    found, objective = _decoded(Phi, y)
    said = y - np.einsum("wij,wj->wi", Phi, found)
    shape = (len(systems), windows)
    error = np.max(np.abs(found - x), 1) / np.max(np.abs(x), 1)
    missed = np.sqrt(np.mean((said - e.reshape(said.shape)) ** 2, 1))
    return Windows(
        error.reshape(shape), (objective / np.abs(e).sum((1, 2))).reshape(shape),
        missed.reshape(shape), e.reshape(*shape, *e.shape[1:]),
    )  # fmt: skip


def drive(pairs: int = PAIRS, windows: int = WINDOWS) -> Placed:
    """Designs for the positions and two states more, drawn at random."""
    rng, plants, designs = default_rng(3), [], []
    others = [name for name in STATES if name not in GPS]
    for seed in range(pairs):
        plants.append(_measuring([*GPS, *rng.choice(others, 2, replace=False).tolist()]))
        designs.append(candidates(plants[-1], draws=1, seed=seed, **WEIGHTS))

    def loops(which: slice) -> list[tuple[np.ndarray, np.ndarray]]:
        return [
            _matrices(closed_loop(plant, one.gain))
            for plant, found in zip(plants, designs, strict=True)
            for one in found[which]
        ]

    return Placed(
        designs,
        _windows(loops(slice(0, 1)), windows),
        _windows(loops(slice(1, None)), windows),
        _windows([_matrices(plant) for plant in plants], windows),
        _held_elsewhere(plants[0], designs[0][1]),
    )


def _measuring(names: list[str]) -> LinearPlant:
    """The quadrotor with these sensors; sampled once for all."""
    whole = as_it_is(5).plant
    deviations = {"p": 0.1, "v": 0.1, "theta": 0.01}
    sd = [deviations[name.split("_")[0]] if "rate" not in name else 0.05 for name in names]
    return linear_plant(
        time="discrete", dt=whole.dt, A=whole.A, B=whole.B, Q=whole.Q, R=np.diag(sd) ** 2,
        C=np.eye(10)[[STATES.index(name) for name in names]], states=STATES,
        inputs=whole.inputs, outputs=names,
    )  # fmt: skip


def _matrices(plant: LinearPlant) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(plant.A), np.asarray(plant.C)


def _held_elsewhere(plant: LinearPlant, design: Candidate) -> float:
    """What the closed loop makes of a drone that hovers 10 m aside, unattacked: error in m."""
    A, C = _matrices(closed_loop(plant, design.gain))
    x = np.zeros(10)
    x[0] = 10.0
    y, Phi = np.tile(C @ x, WINDOW), _phi(A, C)
    first, _ = _decoded(Phi[None], y[None])
    return float(abs((np.linalg.matrix_power(A, WINDOW - 1) @ first[0] - x)[0]))


def judged(run: Placed) -> list[Row]:
    """Figs. 5 to 7, Section V-B, and what is exact of Section V-C1."""
    return [
        figure_5(run), support_small(run), section_v_b(run), exact_windows(run), smaller(run),
        told(run), reference(run), figure_6(run), figure_7(run),
    ]  # fmt: skip


def figure_5(run: Placed) -> Row:
    """The supports of both controllers."""
    lqr = [min(found[0].supports) for found in run.designs]
    placed = [min(one.supports for one in found[1:])[0] for found in run.designs]
    per = np.stack([lqr, placed], 1)
    return figure(
        "Fig. 5", "smallest |supp(C v)| of 5 sensors: optimal feedback, and poles placed beside it",
        [1, 5], per, np.all(per[:, 0] <= 2) and np.all(per[:, 1] == 5),
        f"Over {len(run.designs)} draws of the two sensors besides the positions. Optimal feedback "
        "leaves the three axes apart; gains that place the poles couple them.",
    )  # fmt: skip


def support_small(run: Placed) -> Row:
    """How small the entries that are not zero are."""
    placed = [one for found in run.designs for one in found[1:]]
    numbers = np.median([[one.moved, one.cost, one.weakest] for one in placed], 0)
    return claim(
        "Fig. 5, what it costs", "small moves of the poles keep good control and estimation: "
        "medians of poles' move, cost over the optimal, smallest entry of C v over its largest",
        ["small", "near 1", "-"], numbers, numbers[1] < 2.0 and numbers[2] > 1e-2,
        f"{len(placed)} designs. Control stays good. The entries that make up the support are "
        "nearly zero: a sensor counts that hardly sees the mode.",
    )  # fmt: skip


def section_v_b(run: Placed) -> Row:
    """That the supports allow two errors, and whether the l1 decoder corrects them."""
    share = float(np.mean(run.poles.error < EXACT))
    allowed = {one.corrected for found in run.designs for one in found[1:]}
    return claim(
        "Section V-B", "with |supp(C v)| = p for all v the decoder corrects the most errors p "
        "allows, 2 of 5: q by the supports, share of windows with 2 attacks that it does",
        [2, 1.0], [min(allowed), share], share > 0.99,
        "The condition is one of the l0 problem; nothing is said by it about the l1 decoder. "
        "|supp| > q is printed for > 2 q.",
    )  # fmt: skip


def exact_windows(run: Placed) -> Row:
    """Windows of placed designs that are decoded exactly."""
    share = np.mean(run.poles.error < EXACT, 1)
    return figure(
        "Section V-C1", "ramp on p_x and noise on one more sensor, noise-free samples, poles "
        f"placed: share of exact windows (p = 5, T = {WINDOW})", "nearly 1", share,
        share.mean() > 0.9,
        f"{share.size} designs, {run.poles.error.size} windows. Median error of the state over its "
        f"largest entry: {np.median(run.poles.error):.2g}. LQR: "
        f"{np.mean(run.lqr.error < EXACT):.3f} exact.",
    )  # fmt: skip


def smaller(run: Placed) -> Row:
    """That it is not the solver."""
    less = run.poles.objective < 1.0 - 1e-9
    return claim(
        "Section V-C1, the decoder", "(12) returns the true state: windows in which what it "
        "returns has a strictly smaller objective than the truth, of all", [0, less.size],
        [int(less.sum()), less.size], not less.any(),
        "So it is the decoder that is wrong, not the program that solves it.",
    )  # fmt: skip


def told(run: Placed) -> Row:
    """The observer who knows u."""
    share = np.mean(run.told.error < EXACT, 1)
    return figure(
        "Section V-C1, u known", "the receiver who knows u decodes with A_0: share of exact "
        "windows", "nearly 1", share, share.mean() > 0.9,
        "p_x is seen by one sensor only then, whatever the feedback: nothing tells its ramp from "
        f"a flight ({np.mean(run.told.objective < 1.0 - 1e-9):.3f} of the windows have a smaller "
        "objective than the truth).",
    )  # fmt: skip


def reference(run: Placed) -> Row:
    """Closed loop where the drone is not steered to the origin."""
    return claim(
        "Section V-C1, reference", "x+ = (A_0 + B G) x also where u = G (x - x_r): error in m of "
        "p_x for a drone that hovers at p_x = 10 m, no attack, no noise", 0.0, run.reference,
        run.reference < 1e-3,
        "The closed loop is that of x - x_r: whoever does not know x_r cannot use it, and whoever "
        "knows u decodes with A_0.",
    )  # fmt: skip


def figure_6(run: Placed) -> Row:
    """E^ - e of both controllers."""
    size = np.sqrt(np.mean(run.lqr.attack**2, (1, 2, 3)))
    sets = len(size)
    found = [np.median(part.missed.reshape(sets, -1), 1) / size for part in (run.lqr, run.poles)]
    shows = np.mean(found[1]) < 0.5 * np.mean(found[0])
    return figure(
        "Fig. 6", "the attack is estimated much more accurately with poles placed: error of e^ "
        "over e, rms, LQR and placed", ["large", "near 0"], np.stack(found, 1), shows,
        "Medians over windows. Both decoders give a state that the truth does not come near to.",
    )  # fmt: skip


def figure_7(run: Placed) -> Row:
    """What the attack is like."""
    e = run.poles.attack
    most = int(np.max(np.sum(e != 0, -1)))
    same = float(np.mean(np.all((e[:, :, 1:] != 0) == (e[:, :, :-1] != 0), -1)))
    return claim(
        "Fig. 7", "attacked sensors change with time, at most 2 at each step: most at a step, "
        "share of steps with those of the step before", [2, "< 1"], [most, same],
        most <= 2 and same < 1.0,
        "The text says one of all sensors besides p_x, the figure that positions alone are "
        "attacked; here all, in Fig. 8 positions. Sizes are not stated: "
        f"{RATE:g} m/s and sd {SD:g}.",
    )  # fmt: skip


def figures(run: Placed) -> dict[str, Any]:
    """Nothing is drawn: Figs. 5 to 7 are in the numbers."""
    return {}
