"""DECODER's lemmas on cancellations (appendix), by exact counts and determinants."""

import itertools
from fractions import Fraction

import numpy as np
from numpy.random import default_rng

from holdfast.papers.decoder_exact import Case, case, supports
from holdfast.papers.rows import Row, claim

VALUES = (1, 2, 3, 4, 5, 6)


def determinant(rows: list[list[int]]) -> Fraction:
    """Of whole numbers, by elimination."""
    left, found = [[Fraction(x) for x in row] for row in rows], Fraction(1)
    for k in range(len(left)):
        pivot = next((r for r in range(k, len(left)) if left[r][k]), None)
        if pivot is None:
            return Fraction(0)
        if pivot != k:
            left[k], left[pivot], found = left[pivot], left[k], -found
        found *= left[k][k]
        for r in range(k + 1, len(left)):
            factor = left[r][k] / left[k][k]
            left[r] = [x - factor * y for x, y in zip(left[r], left[k], strict=True)]
    return found


def least_minor(first: int, values: tuple[int, ...] = VALUES, last: int = 6) -> tuple[int, int]:
    """How many generalised Vandermonde matrices, the least determinant; exponents from first."""
    every = []
    for m in range(1, 5):
        for x in itertools.combinations(range(first, last + 1), m):
            if first == 0 and x[0] != 0:
                continue
            for few in itertools.combinations(values, m):
                every.append(determinant([[v**e for v in few] for e in x]))
    return len(every), int(min(every, key=lambda d: (d > 0, d)))


def lemma_4(zero: bool = False, values: tuple[int, ...] = VALUES) -> Row:
    """Least determinant, of exponents from 1, or with 0 among them."""
    count, least = least_minor(0 if zero else 1, values)
    if zero:
        id, what, note = (
            "Lemma 4, x_1 = 0",
            "holds with the exponent 0 too, as Lemmas 5 and 6 use it (t = 0)",
            "The lemma is stated for 0 < x_1, and Lemma 5 writes 0 < l although l may be 0.",
        )
    else:
        id, what, note = "Lemma 4", "generalised Vandermonde matrices are nonsingular", (
            "Exact, l_i of 1 .. 6, x_i up to 6, m up to 4: all determinants are positive."
        )  # fmt: skip
    return claim(id, f"{what}: matrices, least determinant", ["-", "> 0"], [count, least],
                 least > 0, note)  # fmt: skip


def parts_of(one: Case, m: int) -> list[Case]:
    """The same plant left with m of its eigenvectors at a time."""
    n = len(one.values)
    return [
        case(one.values[list(few)], one.C[:, list(few)], one.q, one.T)
        for few in itertools.combinations(range(n), m)
    ]


def mixed(part: Case) -> np.ndarray:
    """Every support of Phi z (k x T x p) over the z with a part along each eigenvector."""
    n, p = len(part.values), len(part.C)
    rows = np.concatenate([part.C * part.values**t for t in range(part.T)])
    # the parts themselves as further rows, which must not be zero
    both = supports(np.concatenate([np.eye(n, dtype=int).astype(object), rows]))
    return both[np.all(both[:, :n], 1), n:].reshape(-1, part.T, p)


def cancelled(part: Case) -> np.ndarray:
    """At how many steps each sensor that sees all eigenvectors misses z (k x sensors)."""
    return np.sum(~mixed(part)[:, :, np.all(part.C != 0, 1)], 1)


def each_sensor(id: str, found: list[Case], m: int, less: int = 0) -> Row:
    """The most steps at which a sensor is cancelled."""
    counts = [int(np.max(cancelled(part), initial=0)) for one in found for part in parts_of(one, m)]
    return claim(
        id, f"with {m} eigenvectors a sensor that sees them all is cancelled at most {m - 1} "
        "times: spans looked at, most", ["-", m - 1], [len(counts), max(counts)],
        max(counts) <= m - 1 - less and max(counts) > 0,
        "All z with a part along each, exactly.",
    )  # fmt: skip


def window_bound(id: str, found: list[Case], m: int, tight: bool = True) -> Row:
    """|supp(Phi z)| over z with a part along each of m eigenvectors against the bound's proof."""
    shown, short, slack = 0, 0, None
    for one in found:
        if not one.guaranteed or len(one.values) < m:
            continue
        for part in parts_of(one, m):
            lost = (m - 2) * len(one.C) + int(np.min(part.s))
            least = int(np.min(np.sum(mixed(part), (1, 2))))
            gap = least - (one.T * int(np.max(part.s)) - (lost if tight else 0))
            short += gap < 0 or least <= 2 * one.q * one.T
            shown, slack = shown + 1, gap if slack is None else min(slack, gap)
    lower = "min s" if m == 2 else "(p + min s)"
    return claim(
        id, f"T > {lower} / (max s - 2q): |supp(Phi z)| >= T max s - {lower} > 2qT: "
        "spans, those where it fails, least slack of the first", ["-", 0, ">= 0"],
        [shown, short, slack if slack is not None else 0], short == 0 and shown > 0,
        "T at its least. Where few sensors see several eigenvectors a shorter T is enough: of a "
        "sensor that sees k of them k - 1 samples are lost.",
    )  # fmt: skip


def proposition_5(found: list[Case], less: int = 0) -> Row:
    """All cancellations of the sensors that see every eigenvector, together."""
    over, shown, reached = 0, 0, 0
    for one in found:
        for m in range(2, len(one.values) + 1):
            for part in parts_of(one, m):
                count = int(np.max(np.sum(cancelled(part), 1)))
                allowed = (m - 1) * int(np.sum(np.all(part.C != 0, 1))) - less
                shown, over = shown + 1, over + (count > allowed)
                reached += count == allowed > 0
    return claim(
        "Proposition 5", "cancellations over T steps <= (m - 1) s_{1..m}: spans looked at, those "
        "with more, those with just as many", ["-", 0, "-"], [shown, over, reached],
        over == 0 and shown > 0, "Two and three eigenvectors, exactly.",
    )  # fmt: skip


def lemma_4_many(count: int = 200, shift: float = 0.0) -> Row:
    """Signs of the determinants of larger matrices with random real l_i and x_i."""
    rng, wrong = default_rng(8), 0
    for _ in range(count):
        m = int(rng.integers(2, 7))
        values = np.cumsum(rng.uniform(0.2, 1.0, m)) - shift
        x = np.sort(rng.choice(10, m, replace=False))
        sign = np.linalg.slogdet(values[None, :] ** x[:, None].astype(float))[0]
        wrong += sign <= 0
    return claim(
        "Lemma 4, real l_i", "larger matrices, l_i real: those of 200 with a determinant that is "
        "not positive", 0, int(wrong), wrong == 0,
    )  # fmt: skip
