"""NISME's filter judged: (5) to (22) and Algorithm 1, line by line, against batch least squares.

Systems are drawn with f and h linear: there Algorithm 1 is exact, so that what a line gets wrong
is not the linearisation's.
"""

import equinox as eqx
import jax
import numpy as np
from numpy.random import default_rng

from holdfast.estimators import nise as library
from holdfast.papers.nisme_systems import (
    EPSILON,
    STEPS,
    Data,
    System,
    Text,
    batch,
    drawn,
    gap,
    nise,
    simulated,
    split,
)
from holdfast.papers.rows import Row, claim
from holdfast.plants.build import linear_plant
from holdfast.records import Observation

EXACT = 1e-8
"""Relative: rounding over the smallest kept singular value (0.2), squared, and over 6 steps."""
SEEN = 1e-3
"""Relative distance from which on a line is wrong rather than rounded."""
COUNT = 20


def some(
    count: int = COUNT,
    u: float = 1.0,
    scale: float = 1.0,
    attack: float = 3.0,
    apart: bool = False,
    **how,
):
    """Systems of all sizes with their data; ``apart``: what enters an output moves no state."""
    rng, found = default_rng(4), []
    for s in drawn(count, 4, **how):
        V2 = split(s, 1).V2
        one = s._replace(x0=scale * s.x0, G=s.G @ V2 @ V2.T if apart else s.G)
        found.append((one, simulated(one, rng, u, scale, attack)))
    return found


def decomposed(off: float = 0.0) -> Row:
    """Covariances between z_1, z_2 and z_3."""
    worst = 0.0
    for s, _ in some():
        T = split(s, 1).T
        for i, j in ((0, 1), (0, 2), (1, 2)):
            worst = max(worst, float(np.max(np.abs(T[i] @ s.R @ T[j].T), initial=0.0)) + off)
    return claim(
        "(6), (7)", "the noises of z_1, z_2, z_3 are uncorrelated: largest covariance", 0.0, worst,
        worst < EXACT,
    )  # fmt: skip


def equation_8(corrected: bool = False, alone: bool = False, off: float = 0.0) -> Row:
    """C_2 G V_2 of (8); ``alone``: with one attack through the state, where Vbar_1 is +-1."""
    worst = 0.0
    for s, _ in some(size=(3, 4, 2, 1)) if alone else some(size=(4, 5, 3, 1)):
        at = split(s, 1)
        found, wanted = at.T[1] @ s.C[1] @ s.G @ at.V2, at.Sbar
        if corrected:
            wanted = wanted @ at.Vbar.T
        if alone:
            found = np.abs(found)
        worst = max(worst, gap((1.0 + off) * found, wanted))
    says = "Sigmabar Vbar_1'" if corrected else "Sigmabar"
    return claim(
        f"(8), {says}", f"C_2 G V_2 = {says}: largest relative distance", 0.0, worst, worst < EXACT
    )


def section_5(corrected: bool = False, diagonal: bool = False, off: float = 0.0) -> Row:
    """R_2 and R_3 as Section 5 has them, or exchanged."""
    worst = 0.0
    for s, _ in some(size=(4, 6, 4, 2)):
        one = s._replace(R=np.eye(6)) if diagonal else s
        T = split(one, 1).T
        v = [t @ np.linalg.cholesky(one.R) for t in T]
        named = (T[1], T[2]) if corrected else (T[2], T[1])
        for own, printed in zip(v[1:], named, strict=True):
            worst = max(worst, gap((1.0 + off) * printed @ one.R @ printed.T, own @ own.T))
    says = "exchanged" if corrected else "as printed"
    return claim(
        f"Section 5, R_2 and R_3 {says}", f"R_2 and R_3, {says}, are the covariances of v_2 and "
        "v_3: largest relative distance", 0.0, worst, worst < EXACT,
        "" if corrected else "z_2 is taken by Tbar_1 and z_3 by Tbar_2.",
    )  # fmt: skip


def equation_5(x: float = 1.0) -> Row:
    """That f ~ A x + B u at the point where it is linearised: f = sin."""
    off = abs(float(np.sin(x) - np.cos(x) * x))
    return claim(
        "(5), (8), linearised", f"f(x) = A x where it is linearised: f = sin, x = {x:g}, distance",
        0.0, off, off < EXACT,
        "f(x^) - A x^ is left out. Algorithm 1 evaluates f and h themselves, so it does no harm.",
    )  # fmt: skip


def _gaps(s: System, data: Data, text: Text) -> list[float]:
    a, b = nise(s, data, text), batch(s, data)
    pairs = (a.x, b.x), (a.P, b.P), (a.d1, b.d1), (a.P1, b.P1), (a.d2s, b.d2), (a.P2s, b.P2)
    return [gap(p, q) for p, q in pairs]


PRINTED = Text(False, True, False, True, False, False)
"""All that can be run as printed: of line 3 the last term cannot, line 4 lacks a derivative."""


def algorithm_1_printed(text: Text = PRINTED) -> Row:
    """Algorithm 1 as printed, against least squares: medians."""
    found = np.array([_gaps(s, data, text) for s, data in some()])
    medians = np.median(found, 0)[:4]
    return claim(
        "Algorithm 1", "as printed, with the sizes of line 3 and the derivative of line 4 mended: "
        "distances of x, P, d_1, P^d1 from least squares, medians", [0.0] * 4, medians,
        bool(np.max(found[:, :4]) < EXACT), "Line by line in the next rows; the other lines hold.",
    )  # fmt: skip


def algorithm_1(count: int = COUNT, text: Text = Text()) -> Row:  # noqa: B008
    """All lines as the errata have them, against least squares."""
    found = [_gaps(s, data, text) for s, data in some(count)]
    worst = float(np.max(found))
    return claim(
        "Algorithm 1, corrected", "x, d_1 and d_2 (smoothed by nu_3) with covariances are least "
        "squares of all states, all attacks free: largest distance", 0.0, worst, worst < EXACT,
        "Errata 1 to 4: h_2 inside M_2(.), M_2 on C_2 G_1, P^(d1 x), P_k in line 11, "
        "M_1 C_(1,k-1) in (11), d_2 = Vbar_1' V_2' d.",
    )  # fmt: skip


LINES = {
    "Algorithm 1, line 2": ("line_2", "h_2 outside M_2(.), as in (16)", "d2"),
    "Algorithm 1, line 3": ("line_3", "C_2 G_1 without M_2", "P2"),
    "Algorithm 1, line 4": ("line_4", "x^(t) = f(x^(t), ..), as in (18), solved for x^", "x"),
    "Algorithm 1, line 11": ("line_11", "P_(k|k-1) of x for P_k", "P1"),
    "(11), C_(1,k)": ("eq_11", "Abar and Qbar with C_(1,k), C different at k - 1", "x"),
}
"""By id: the field of `Text`, what is printed, and the estimate or covariance that shows it."""


def as_printed(id: str, **how) -> Row:
    """One line as printed, the others corrected: how far what it gives is from what it means."""
    field, says, shown = LINES[id]
    text, distances = Text(**{field: False}), []
    for s, data in some(**how):
        printed, right = (getattr(nise(s, data, t), shown) for t in (text, Text()))
        distances.append(gap(printed, right))
    median = float(np.median(distances))
    return claim(
        id, f"{says}: relative distance of {shown} from the corrected line's, median of {COUNT}",
        0.0, median, median < EXACT,
        "(11) also has M_(1,k); H does not move, so that M_1 is the same." if "(11)" in id else "",
    )  # fmt: skip


def line_3_sizes(size: tuple[int, int, int, int] | None = None) -> Row:
    """Whether the last product of line 3 can be formed: C_2 G_1 (. x rank H) on P^x (n x n)."""
    formed = 0
    for s, data in some(size=size):
        try:
            nise(s, data, Text(line_3_size=False))
            formed += 1
        except ValueError:
            pass
    return claim(
        "Algorithm 1, line 3, sizes", "its last term can be formed: share of the systems", 1.0,
        formed / COUNT, formed == COUNT,
        "P^x stands where P^(d1 x) is meant: rank H columns meet n rows.",
    )  # fmt: skip


def line_1(corrected: bool = False, active: bool = False, dropped: int = 0) -> Row:
    """The modes of three sensors and two actuators: is eps C_2 G_2 square in all?

    ``active``: only where all are attacked; ``dropped``: rows of C_2 left out.
    """
    rng, square, all_ = default_rng(5), 0, 0
    C, B = rng.normal(size=(1, 6, 4)), rng.normal(size=(4, 2))
    one = drawn(1, 6)[0]._replace(C=C, R=np.eye(6))
    for mode in range(31 if active else 0, 32):
        on = np.diag([float(mode >> i & 1) for i in range(5)])
        G, H = np.hstack([B, np.zeros((4, 3))]) @ on, np.eye(6)[:, :5] @ np.diag([0, 0, 1, 1, 1])
        s = one._replace(A=np.zeros((4, 4)), G=G, H=H @ on)
        at = split(s, 0)
        if len(at.Sbar):
            free = s.G @ at.V2 @ (at.Vbar if corrected else np.eye(at.V2.shape[1]))
            rows, columns = (at.T[1][dropped:] @ C[0] @ free).shape
            square, all_ = square + (rows == columns), all_ + 1
    says = ", Vbar_1" if corrected else ""
    return claim(
        f"Algorithm 1, line 1{says}", "(eps C_2 G_2)^-1 exists: modes with an attacked actuator of "
        f"3 sensors and 2 actuators{', G_2 = G V_2 Vbar_1' if corrected else ''}", all_, square,
        square == all_,
        "" if corrected else "d has an entry for every location in every mode: C_2 G_2 is square "
        "only if all locations are attacked.",
    )  # fmt: skip


def remark_4_1(hidden: bool = True, steps: int = 400, size: float = 1.0) -> Row:
    """An attack on a chain of two states, of which the first is measured: C G = 0, M_2 = 0.

    With ``hidden`` False both are measured, and the attack is estimated.
    """
    A, g = np.array([[0.9, 0.1], [0.0, 0.9]]), np.array([0.0, 1.0])
    C = np.eye(2)[: 1 if hidden else 2]
    R, Q = 0.01 * np.eye(len(C)), 0.01 * np.eye(2)
    moving, P, e = g if hidden else np.zeros(2), np.eye(2), np.zeros(2)
    for _ in range(steps):
        e = A @ e + size * moving
        P = A @ P @ A.T + Q
        L = np.linalg.solve(C @ P @ C.T + R, C @ P).T
        e, P = e - L @ C @ e, P - L @ C @ P
    off = float(np.max(np.abs(e) / np.sqrt(np.diagonal(P))))
    return claim(
        "Remark 4.1", "any K^j will do: d = 1 on the second of two states in a row, the first "
        "measured, M_2 = 0: bias in reported standard deviations", 0.0, off, off < 1.0,
        "Where G V_2 Vbar_2 is not 0 the attack reaches no output of the next sample; "
        "M_2 = 0 hides it. The library flags such a mode (HIDDEN_INPUT).",
    )  # fmt: skip


def blue(state: bool = False, text: Text = Text(), **how) -> Row:  # noqa: B008
    """Variances of line 2's d_2 over the least that y_0 .. y_k allow; or of x and d_1."""
    ratios = []
    for s, data in some(**how):
        a, b = nise(s, data, text), batch(s, data)
        ours, best = ((a.P, a.P1), (b.P, b.P1)) if state else ((a.P2,), (b.P2,))
        ratios += [np.trace(p) / np.trace(q) for p, q in zip(ours, best, strict=True)]
    median = float(np.median(ratios))
    which = "x and d_1" if state else "d_2"
    return claim(
        f"Section 4.2, BLUE, {which}", f"{which} best linear unbiased: trace of the covariance "
        "over that of least squares, median", 1.0, median,
        bool(np.allclose(ratios, 1.0, atol=EXACT)),
        "" if state else "Line 2 does not use z_3; corrected by nu_3 like the state it is (above). "
        f"Largest ratio {max(ratios):.3g}.",
    )  # fmt: skip


def the_library(count: int = 10, off: float = 0.0) -> Row:
    """`holdfast`'s NISE on constant systems without input, from x_0 with all attacks free."""
    worst = 0.0
    for s, data in some(count, u=0.0, size=(4, 5, 3, 1), moving=False):
        plant = linear_plant(
            A=s.F, C=s.C[0], G=EPSILON * s.G, H=s.H, Q=EPSILON**2 * s.Q, R=(1 + off) * s.R
        )
        estimator = library.build(plant, s.x0, s.P0)
        found = _run(estimator, Observation.of(np.zeros((STEPS, 0)), data.y[1:]))
        b = batch(s, data, start=False)
        worst = max(worst, gap(np.asarray(found.x[-1]), b.x), gap(np.asarray(found.x_cov[-1]), b.P))
    return claim(
        "Algorithm 1, the library", "its nise gives x and P of least squares: largest relative "
        f"distance, {count} systems", 0.0, worst, worst < EXACT,
    )  # fmt: skip


@eqx.filter_jit
def _run(estimator, observations):
    start = estimator.init()[0]
    return jax.lax.scan(lambda s, o: estimator.step(s, o), start, observations)[1]
