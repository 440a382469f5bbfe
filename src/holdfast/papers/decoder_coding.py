"""DECODER's Figs. 1 and 2: attacked windows of random systems, solved in large numbers.

Every trial has a new system, state and attack. Smaller windows are filled up with zeros,
so that the solver is compiled once.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.random import Generator, default_rng

from holdfast.numerics.l1_regression import l1_regression
from holdfast.papers.rows import Row, figure, unstated
from holdfast.plants.library import random_systems

N = 8
"""States, and steps of a window."""
SENSORS = (8, 10, 12)
KINDS = ("ideal", "designed", "poor")
BATCHES, TRIALS = 5, 500
"""The paper has one lot of 500 trials for each point: such lots give its spread."""
ATTACKED = {
    8: (4, 8, 12, 14, 16, 18, 20, 22, 23, 24, 28, 32),
    10: (4, 8, 12, 16, 20, 24, 28, 31, 32, 34, 36, 40),
    12: (8, 16, 20, 24, 28, 32, 36, 39, 40, 42, 44, 48),
}
"""Attacked samples of a window, S."""
CHUNK = 100
"""Windows that are solved in one call."""
EXACT = 1e-6
"""Relative error of the attack vector up to which it is recovered."""
NEAR, WIDE = (0.5, 0.95), (0.1, 0.9)
"""Least and largest pole of the designed systems; others, nearer to 0 and further apart."""


class Curve(NamedTuple):
    """For one p: ``S`` (k,), success rates and mean relative errors (kind x k x batch)."""

    S: np.ndarray
    rate: np.ndarray
    error: np.ndarray

    def at(self, kind: str, S: int) -> np.ndarray:
        """The success rate of each batch."""
        return self.rate[KINDS.index(kind), list(self.S).index(S)]


class Trials(NamedTuple):
    """``Phi`` (trials x p N x n), ``x``, the attack ``E`` and ``Y`` = Phi x + E."""

    Phi: np.ndarray
    x: np.ndarray
    E: np.ndarray
    Y: np.ndarray


def systems(rng: Generator, kind: str, trials: int, p: int) -> np.ndarray:
    """Phi of each trial."""
    if kind == "ideal":
        return random_systems.ideal(rng, trials, p * N, N)
    if kind == "poor":
        return random_systems.poor(rng, trials, N, p).Phi
    poles = WIDE if kind == "wide" else NEAR
    return random_systems.designed(rng, trials, N, p, poles).Phi


def placed(rng: Generator, trials: int, p: int, S: int) -> np.ndarray:
    """Which samples are attacked (trials x p N): floor(S / N) of each step, the others anywhere."""
    each = S // N
    order = np.argsort(np.argsort(rng.random((trials, N, p)), 2), 2)
    first = np.reshape(order < each, (trials, -1))
    left = np.where(first, 2.0, rng.random((trials, p * N)))
    return first | (np.argsort(np.argsort(left, 1), 1) < S - each * N)


def drawn(rng: Generator, kind: str, trials: int, p: int, S: int) -> Trials:
    """One lot of trials; states and attacked samples are standard normal."""
    Phi, x = systems(rng, kind, trials, p), rng.standard_normal((trials, N))
    on = placed(rng, trials, p, S)
    E = np.where(on, rng.standard_normal(on.shape), 0.0)
    return Trials(Phi, x, E, np.einsum("bij,bj->bi", Phi, x) + E)


@eqx.filter_jit
def _solved(Phi, Y):
    found = jax.vmap(l1_regression)(Phi, Y)
    return found.x, found.residual


def decoded(Phi: np.ndarray, Y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The x and E of (12) for each of (trials x m x n) windows, in blocks of one size."""
    trials, m, n = Phi.shape
    more, rows = -trials % CHUNK, max(SENSORS) * N - m
    Phi = np.pad(Phi, ((0, more), (0, rows), (0, N - n))).reshape(-1, CHUNK, rows + m, N)
    Y = np.pad(Y, ((0, more), (0, rows))).reshape(-1, CHUNK, rows + m)
    pairs = [_solved(jnp.asarray(a), jnp.asarray(b)) for a, b in zip(Phi, Y, strict=True)]
    x, E = (np.concatenate(each)[:trials] for each in zip(*pairs, strict=True))
    return x[:, :n], E[:, :m]


def errors(given: Trials) -> np.ndarray:
    """|E^ - E| / |E| of each trial."""
    found = decoded(given.Phi, given.Y)[1]
    return np.linalg.norm(found - given.E, axis=1) / np.linalg.norm(given.E, axis=1)


def curve(p: int, batches: int, trials: int) -> Curve:
    """Figs. 1 and 2 for p sensors."""
    S = np.array(ATTACKED[p])
    rate = np.zeros((len(KINDS), len(S), batches))
    error = np.zeros_like(rate)
    for where in np.ndindex(rate.shape):
        kind, point, batch = where
        rng = default_rng((p, kind, point, batch))
        off = errors(drawn(rng, KINDS[kind], trials, p, int(S[point])))
        rate[where], error[where] = np.mean(off < EXACT), np.mean(off)
    return Curve(S, rate, error)


def wide(batches: int, trials: int) -> np.ndarray:
    """Success rates at p = 10, S = 32 with poles `WIDE`, of each batch."""
    lots = [drawn(default_rng((1, batch)), "wide", trials, 10, 32) for batch in range(batches)]
    return np.array([np.mean(errors(lot) < EXACT) for lot in lots])


def limit(p: int) -> int:
    """T q_max: what a decoder of a plant can be certain of."""
    return N * ((p - 1) // 2)


def limit_ideal(p: int) -> int:
    """Half of what sees every z in a matrix without structure: ceil((p T - n + 1) / 2) - 1."""
    return (p * N - N) // 2


def _falls(values: np.ndarray) -> bool:
    """Means over batches (k x batch) that never rise by more than chance."""
    rise = np.diff(values.mean(1))
    return bool(np.all(rise <= 3.0 * chance(values)) and values[-1].mean() < values[0].mean())


def chance(values: np.ndarray) -> float:
    """The largest standard error of a mean over batches."""
    return float(np.max(values.std(1, ddof=1))) / np.sqrt(values.shape[1])


def figure_1(found: Curve) -> Row:
    """Success against S at p = 10."""
    shown = np.stack([found.at("designed", S) for S in (8, 16, 24, 32)], 1)
    return figure(
        "Fig. 1", "the success rate falls as more is attacked: designed feedback at S = 8, 16, 24, "
        "32", "falls", shown, all(_falls(rate) for rate in found.rate),
        f"All three systems. {_lots(found)} The paper prints no numbers but those of Section IV-B.",
    )  # fmt: skip


def _lots(found: Curve) -> str:
    return f"{found.rate.shape[2]} lots of trials at each S; the paper has one of {TRIALS}."


def three(found: Curve, number: str, p: int) -> Row:
    """The order of the three systems at every S."""
    S = limit(p)
    shown = np.stack([found.at(kind, S) for kind in KINDS], 1)
    means = found.rate.mean(2)
    return figure(
        f"Fig. {number}, three systems, p = {p}", "ideal best, designed feedback above poorly "
        f"designed: success at S = {S}", "falls", shown, np.all(np.diff(means, axis=0) <= 0.0),
        "At every S. Poorly designed: the optimal feedback for control alone.",
    )  # fmt: skip


def mean_error(found: Curve, number: str, p: int) -> Row:
    """The same of mean errors."""
    S = limit(p)
    shown = found.error[:, list(found.S).index(S)].T
    means = found.error.mean(2)
    return figure(
        f"Fig. {number}, mean error, p = {p}", "designed feedback lowers it; ideal, designed, "
        f"poorly designed at S = {S}", "rises", shown, np.all(np.diff(means, axis=0) >= -ROUNDED),
        "Mean of |E^ - E| / |E|: what the paper averages is not said.",
    )  # fmt: skip


ROUNDED = 1e-9
"""Mean errors under which all trials succeed: rounding has no order."""


def figure_2(found: dict[int, Curve], S: int = 32) -> Row:
    """Success at one S for every p."""
    shown = np.stack([found[p].at("designed", S) for p in SENSORS], 1)
    return figure(
        "Fig. 2", f"more sensors help: success of the designed feedback at S = {S}, p = 8, 10, 12",
        "rises", shown, np.all(np.diff(shown.mean(0)) > 0),
        "With other systems, not with the same and more sensors: in a given plant a further sensor "
        "may add nothing (Section IV-B, IMU and GPS).",
    )  # fmt: skip


def limits() -> Row:
    """Where the vertical lines stand."""
    both = [[limit(p), limit_ideal(p)] for p in SENSORS]
    return unstated(
        "Fig. 1, fundamental limits", "where the lines stand: for plants T q_max, for ideal coding "
        "the floor of (pT - n) / 2 (chosen); p = 8, 10, 12", np.ravel(both),
        "Half of the least |supp(Phi z)| of a matrix without structure, p T - n + 1.",
    )  # fmt: skip


def settings(found: Curve) -> Row:
    """What had to be chosen."""
    return unstated(
        "Section IV-B, settings", "A0, B, C, poles, poor feedback, attack, mean error (chosen): "
        "lots, states, inputs, least and largest pole",
        [found.rate.shape[2], N, random_systems.INPUTS, *NEAR],
        "A0 and B (8 x 4) normal; C with one entry a row of size .5 to 1.5; poles spread evenly; "
        "poor: minimises sum |x|^2 + |u|^2; E normal. Only signs of E matter to success.",
    )  # fmt: skip


def above(found: Curve, p: int, least: float) -> Row:
    """The success of the designed systems just below T q_max."""
    S = limit(p) - 1
    shown, at = found.at("designed", S), found.at("designed", S + 1).mean()
    near = shown.mean() - least < shown.std(ddof=1)
    return figure(
        f"Section IV-B, above {least:g}", f"with p = {p} the designed feedback succeeds in more "
        f"than {least:g} of the trials for all S below {S + 1}: at S = {S}", f"> {least:g}", shown,
        shown.mean() >= least - shown.std(ddof=1),
        f"At S = {S + 1} it is {at:.3f}."
        + (" On the line: a single lot is above it or below it." if near else ""),
    )  # fmt: skip
