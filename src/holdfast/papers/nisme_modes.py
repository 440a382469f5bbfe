"""NISME's Section 6 judged: uniform observability, which modes are kept, and what that loses.

Plants of small integers with many zeros, all sets of their channels: ranks are exact there.
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import default_rng

from holdfast.analysis.admissible import only, samples, units
from holdfast.analysis.model import Model, model_at
from holdfast.analysis.nise_pair import nise_pair
from holdfast.numerics.gramian import uniformly_observable
from holdfast.papers.nisme_filter import some
from holdfast.papers.nisme_systems import nise
from holdfast.papers.rows import Row, claim, unstated
from holdfast.plants.library import swing

PLANTS = 60
STEPPED = np.array([[1.0, 1.0], [0.0, 1.0]])
"""A step of position and speed."""
Set = tuple[int, ...]


def model(A, G, C, H) -> Model:
    """With noise of unit covariance."""
    A, G, C, H = (np.atleast_2d(np.asarray(m, float)) for m in (A, G, C, H))
    names = [tuple(f"{k}{i}" for i in range(m)) for k, m in (("x", len(A)), ("y", len(C)),
                                                             ("d", G.shape[1]))]  # fmt: skip
    return Model(A, G, C, H, np.eye(len(A)), np.eye(len(C)), *names, "")


def integers(count: int, apart: bool = False) -> list[Model]:
    """``apart``: each channel enters the state or the outputs, not both."""
    rng, found = default_rng(6), []
    while len(found) < count:
        n, p, nd = (int(rng.integers(2, 5)) for _ in range(3))
        A, C, G, H = (
            rng.integers(-2, 3, shape) * (rng.random(shape) < keep)
            for shape, keep in (((n, n), 0.6), ((p, n), 0.6), ((n, nd), 0.4), ((p, nd), 0.3))
        )
        if apart:
            G = np.where(np.any(H != 0, 0), 0, G)
        found.append(model(A, G, C, H))
    return found


def sets(m: Model) -> list[Set]:
    """All sets of channels of which none does what the others do, largest first."""
    both, count = np.vstack([m.G, m.H]), m.G.shape[1]
    every = [s for r in range(count, -1, -1) for s in itertools.combinations(range(count), r)]
    return [s for s in every if np.linalg.matrix_rank(both[:, list(s)]) == len(s)]


def observed(m: Model, s: Set) -> bool:
    """M^ob of the paper: no input is hidden, and (C_3, Abar) observable."""
    pair = nise_pair([m], s)
    A, C = np.asarray(pair.A), np.asarray(pair.C)
    rows = np.vstack([C @ np.linalg.matrix_power(A, i) for i in range(len(A))])
    return not pair.hidden and int(np.linalg.matrix_rank(rows, 1e-8)) == len(A)


def admissible(m: Model, s: Set) -> bool:
    """Whether finitely many samples determine the last state and the attack between them."""
    return samples(only(units([m]), s)) is not None


def definition_1_2(corrected: bool = False, A: np.ndarray = STEPPED, count: int = 3) -> Row:
    """The printed sum of Phi C C' Phi' over ``count`` samples, for A and C = diag(1, 0)."""
    C, gramian = np.diag([1.0, 0.0]), np.zeros((2, 2))
    for i in range(count):
        power = np.linalg.matrix_power(A, i)
        gramian += power.T @ C.T @ C @ power if corrected else power @ C @ C.T @ power.T
    wanted = int(np.linalg.matrix_rank(np.vstack([C, C @ A])))
    rank = int(np.linalg.matrix_rank(gramian))
    says = "Phi' C'C Phi" if corrected else "Phi C C' Phi'"
    return claim(
        f"Definition 1.2, {says}", "the Gramian's rank is what the outputs tell: of position and "
        "speed, position measured", wanted, rank, rank == wanted,
        "" if corrected else "C C' has the size of y: the sum exists only where p = n.",
    )  # fmt: skip


def definition_1_2_constant(count: int = PLANTS, steps: int | None = None) -> Row:
    """Uniform observability of constant pairs against the rank of [C; CA; ..]."""
    wrong = 0
    for m in integers(count):
        rows = [m.C @ np.linalg.matrix_power(m.A, i) for i in range(steps or len(m.A))]
        full = np.linalg.matrix_rank(np.vstack(rows)) == len(m.A)
        wrong += uniformly_observable(m.A, m.C).observable != full
    return claim(
        "Definition 1.2", f"for constant plants it is observability: exceptions among {count}", 0,
        wrong, wrong == 0,
    )  # fmt: skip


def definition_6_1(count: int = PLANTS, spare: int = 2) -> Row:
    """A window of n + ``spare`` samples of a constant plant against an endless one."""
    wrong = 0
    for m in integers(count):
        T = len(m.A) + spare
        window = uniformly_observable([m.A] * T, [m.C] * T)
        wrong += window.observable != uniformly_observable(m.A, m.C).observable
    return claim(
        "Definition 6.1", "over [c1, c2], c2 growing, it becomes uniform observability: "
        f"exceptions among {count} constant plants, n + {spare} samples", 0, wrong, wrong == 0,
    )  # fmt: skip


def index(states: int | None = None) -> Row:
    """The set K_1 of (13): i = 1 .. n + m, of a matrix K^j with s + m rows."""
    plant = swing.build()
    n = len(plant.states) if states is None else states
    s, m = len(plant.inputs), len(plant.outputs)
    return claim(
        "(13), i = 1 .. n + m", "as many indices as K^j has rows, s + m, on the 68-bus network",
        s + m, n + m, n == s,
    )  # fmt: skip


def equation_2(count: int = 3, kinds: Sequence[int] = (0, 1, 2)) -> Row:
    """Rank of the outputs of each bus."""
    plant = swing.build()
    C = model_at(plant, np.asarray(swing.operating_point(plant))).C
    rows = C.reshape(len(plant.buses), 3, -1)[:, list(kinds)]
    ranks = {int(np.linalg.matrix_rank(of_bus)) for of_bus in rows}
    return claim(
        "(2), P_elec", "the three outputs of a bus tell three things: their rank at every bus",
        count, max(ranks), ranks == {count},
        "P_elec = P_L + D f with P_L known is D times the measured f: a second copy of it.",
    )  # fmt: skip


def equation_2_size(entries: int = 1) -> Row:
    """Of d_s,i, which (2) adds to three outputs."""
    return claim(
        "(2), d_s,i in R", "it has as many entries as the outputs of a bus that it is added to",
        3, entries, entries == 3, "R^3 is meant.",
    )  # fmt: skip


def equation_4(load: bool = True) -> Row:
    """What an attack d_a at one bus adds to its outputs by (1), (2): P_elec = P_L + D f."""

    def outputs(u: float) -> np.ndarray:
        P_L = 0.3 - u if load else 0.3
        return np.array([P_L + 0.02, 0.1, 0.02])

    attacked = int(np.sum(outputs(1.0) != outputs(0.0)))
    return claim(
        "(4), locations", "K^j names what is attacked: sensors that d'_s of (4) counts when one "
        "actuator at a load bus is, and no sensor", 0, attacked, attacked == 0,
        "u enters h there. In the case studies the actuators are at generators.",
    )  # fmt: skip


def capabilities(sensor: bool = False) -> Row:
    """x+ = 0.9 x + d + w, y = x + v: what stays, and the sd of d there, from y_k - 0.9 y_(k-1).

    With ``sensor`` d is on one of two sensors.
    """
    one = model(0.9, 1.0, 1.0, 0.0)
    if sensor:
        one = model(0.9, 0.0, [[1], [1]], [[1], [0]])
    kept = algorithm_3(one, observed, least=0)
    sd = float(np.sqrt(0.81 + 1.0 + 1.0))
    told = admissible(one, (0,))
    return claim(
        "Section 6.1, same detection capabilities", "as the power set: x+ = .9 x + d + w, "
        "y = x + v: d is in a mode that is kept; sd of d if it were", [True, "finite"],
        [(0,) in kept, sd if told else None], (0,) in kept,
        "y determines x with one sample, but (C_3, Abar) has no row of C_3: the criterion is "
        "sufficient, not necessary.",
    )  # fmt: skip


def sufficient(count: int = PLANTS, weaker: bool = False) -> Row:
    """Sets that the paper keeps and that samples do not determine."""
    wrong = 0
    for m in integers(count):
        wrong += sum((weaker or observed(m, s)) and not admissible(m, s) for s in sets(m))
    return claim(
        "Section 6.1, M^ob", "in each of its modes samples determine state and attack: exceptions "
        f"among all sets of {count} plants", 0, wrong, wrong == 0,
    )  # fmt: skip


def subsets(
    corrected: bool = False, count: int = PLANTS, apart: bool = False, odd: bool = False
) -> Row:
    """Pairs of sets of which the larger is kept and the smaller is not; ``odd`` sets alone are."""

    def judge(m: Model, s: Set) -> bool:
        good = admissible(m, s) if corrected else observed(m, s)
        return good and (not odd or len(s) % 2 == 1)

    example = model(np.eye(2), np.eye(2), [[1, 0], [0, 1], [1, 0]], [[0, 1], [0, 0], [0, 0]])
    wrong = 0
    for m in [*integers(count, apart), *([] if apart else [example])]:
        good = {s: judge(m, s) for s in sets(m)}
        wrong += sum(good[t] and not good[s] for t in good for s in good if set(s) < set(t))
    how = "determined by samples" if corrected else "observable"
    return claim(
        f"Section 6.1, subsets{' that samples determine' if corrected else ''}",
        f"a mode with fewer attacks than one whose pair is {how} is so too: exceptions", 0, wrong,
        wrong == 0,
        "" if corrected else "Where a channel enters both the state and an output, freeing it "
        "makes z_1 of the first sample count.",
    )  # fmt: skip


def redundant(dropped: int = 1) -> Row:
    """The variance of the state with one channel too many against the mode without it."""
    ratios = []
    for s, data in some(size=(4, 6, 3, 1)):
        fewer = s._replace(G=s.G[:, dropped:], H=s.H[:, dropped:])
        ratios.append(np.trace(nise(s, data).P) / np.trace(nise(fewer, data).P))
    median = float(np.median(ratios))
    return claim(
        "Section 6.1, redundant", "a mode with fewer attacks adds nothing: trace of P^x with a "
        "channel too many over that without it, median", 1.0, median, median < 1.0 + 1e-9,
        "Each freed channel costs accuracy; which is attacked is then left to tests.",
    )  # fmt: skip


def algorithm_3(m: Model, judge: Callable[[Model, Set], bool], least: int = 1) -> list[Set]:
    """As printed: from all channels down to sets of ``least``."""
    kept = []
    for s in sets(m):
        if len(s) >= least and judge(m, s) and not any(set(s) < set(t) for t in kept):
            kept.append(s)
    return kept


def algorithm_3_finds(
    corrected: bool = False, count: int = PLANTS, empty: bool = True, least: int = 0
) -> Row:
    """Algorithm 3 against the definition of M^d; ``empty``: plants that are left without a mode.

    Corrected it goes down to sets of ``least``.
    """
    wrong = without = 0
    for m in integers(count):
        good = [s for s in sets(m) if observed(m, s)]
        wanted = [s for s in good if not any(set(s) < set(t) for t in good)]
        kept = algorithm_3(m, observed, least if corrected else 1)
        if empty or kept:
            wrong += set(kept) != set(wanted)
            without += bool(wanted) and not kept
    says = ", i = s + m : 0" if corrected else ""
    return claim(
        f"Algorithm 3{says}", f"it finds M^d of its definition: exceptions among {count} plants, "
        "and those left without any filter", [0, 0], [wrong, without], wrong == 0,
        "" if corrected else "i = s + m : 1 never tries the attack-free set.",
    )  # fmt: skip


def remark_6_1(moved: bool = True) -> Row:
    """One sensor that tells sin of an angle: the pair where it is 0 and where it is a right one."""
    found = []
    for angle in (0.0, np.pi / 2 if moved else 0.0):
        C = [[np.cos(angle) * (abs(np.cos(angle)) > 1e-9), 0.0]]
        found.append(uniformly_observable(STEPPED, np.array(C)).observable)
    return claim(
        "Remark 6.1", "observability depends on where a nonlinear plant is linearised: angle and "
        "rate, sin of the angle measured, at 0 and at a right angle", [True, False], found,
        found == [True, False],
        "`holdfast analyse` gives the answer along given states and says that it is local.",
    )  # fmt: skip


def unsaid() -> list[Row]:
    """What Algorithms 2 and 5 leave out, and what was chosen."""
    return [
        unstated(
            "Algorithm 2, P_0^d1 and P_0^(x d1)", "its input has d^_(1,0) without covariances",
            "M_1 (C_1 P_0 C_1' + R_1) M_1', -P_0 (M_1 C_1)'",
            "By lines 11 and 12. The library starts a sample earlier, with d_0 free.",
        ),
        unstated(
            "Algorithm 2, line 15 else", "which mode is returned where a test rejects", "j^_k",
            "The else branch is missing. In the library being free of attack is a mode.",
        ),
        unstated(
            "Algorithm 5", "mu, x^, P of a mode that was not in the last window's set",
            "all of the bank's modes run all the time",
            "Line 5 forms a new set of modes every T steps and says nothing about those that are "
            "new in it. The library keeps one set; for a constant plant T is infinite.",
        ),
    ]  # fmt: skip
