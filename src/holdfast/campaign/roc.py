"""Detectors compared at equal false-alarm rates, found by simulation on the same noise.

Rows of one run are correlated, runs are not: every interval is a bootstrap that draws whole
runs, with their rows with and without attack and under every detector together.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from holdfast.attacks.window import Window
from holdfast.campaign.attack_free import over_runs, start_state
from holdfast.evaluate.scores import margin
from holdfast.loop import Monitor, Scenario, simulate
from holdfast.parts import Attack, Detector, Estimator, InvalidValue
from holdfast.records import Estimate, Injection, Knowledge, Verdict

RATES = np.union1d(np.geomspace(1e-3, 1.0, 61)[:54], [0.05, 0.5])
"""The false-alarm rates of a curve, 20 to a decade."""
KNOTS = np.unique(np.concatenate([RATES, np.geomspace(1e-4, 0.1, 200), np.linspace(0.1, 1.0, 182)]))
"""False-alarm rates at whose thresholds a curve is computed; between them it is linear."""
FEWEST_RUNS = 20
"""Fewer runs say too little of how runs differ."""
FEWEST_ROWS = 10_000
"""Attack-free rows that the lowest rate needs: ten false alarms."""
RESAMPLES = 2000
TAILS = (2.5, 97.5)
"""Per cent: an interval is what lies between, for each rate by itself."""
DIGITS = 9
"""Decimals of a statistic over its threshold: equal values that rounding split are ties."""


class Interval(NamedTuple):
    """A value (at every rate, or one) and its 95 % interval from the spread between runs."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def at(self, rate: float) -> tuple[float, float, float]:
        """Value, low and high at one false-alarm rate of a curve."""
        value, low, high = (float(np.interp(rate, RATES, curve)) for curve in self)
        return value, low, high


class Curves(NamedTuple):
    """ROC curves by the detector's name; detection probabilities are at `RATES`.

    ``gain``, ``area_gain``: what each detector has over the first, on the same runs.
    """

    detection: dict[str, Interval]
    area: dict[str, Interval]
    gain: dict[str, Interval]
    area_gain: dict[str, Interval]

    def verdict(self, name: str, rate: float) -> str:
        """What the interval of ``name``'s gain at one rate says of it against the first."""
        _, low, high = self.gain[name].at(rate)
        return "better" if low > 0 else "worse" if high < 0 else "no difference seen"


class Signal(Attack):
    """``values[k]`` on the attack channels at step k; its last row from then on."""

    values: Float[Array, "t nd"]

    def init(self, key: PRNGKeyArray, known: Knowledge) -> tuple:
        """Nothing to remember."""
        return ()

    def step(self, state: tuple, known: Knowledge) -> tuple[tuple, Injection]:
        """The values of this step."""
        now = self.values[jnp.minimum(known.k, self.values.shape[0] - 1)]
        return state, Injection(jnp.zeros_like(known.u), jnp.zeros_like(known.y), now)


class Margins(NamedTuple):
    """Statistic over threshold of the same runs (run, row); NaN where nothing was tested."""

    quiet: np.ndarray
    attacked: np.ndarray


def compare(
    estimator: Estimator,
    detectors: Mapping[str, Detector],
    attacks: tuple[Attack, ...],
    *,
    first: int,
    steps: int,
    runs: int = 250,
    seed: int = 0,
) -> Curves:
    """ROC curves of ``detectors`` on one estimator, against ``attacks`` of its plant.

    Every run is simulated with and without the attacks on the same noise, from a start drawn
    as the estimator believes it; rows ``first`` to ``steps`` count (row 1 is the first). All
    of them count as attacked: the attacks must act throughout. Differences are to the first
    of ``detectors``.

    Raises `InvalidValue` for fewer than 20 runs, or rows too few for the lowest rate.
    """
    if not 1 <= first <= steps:
        raise InvalidValue("first", first, f"a row from 1 to {steps}")
    _enough(runs, runs * (steps - first + 1))
    key, bootstrap = jax.random.split(jax.random.key(seed))
    keys = jax.random.split(key, runs)
    monitor = Monitor(estimator, _Together(tuple(detectors.values())))
    found = over_runs(lambda some: _judged(monitor, attacks, some, steps), keys)
    ratio = margin(*found)[:, :, first - 1 :]
    pairs = [Margins(ratio[:, 0, :, i], ratio[:, 1, :, i]) for i in range(len(detectors))]
    return curves(dict(zip(detectors, pairs, strict=True)), bootstrap)


class _Together(Detector):
    """Several detectors of the same estimates: verdicts with an axis over detectors."""

    detectors: tuple[Detector, ...]

    def init(self) -> tuple:
        """The states of all."""
        return tuple(detector.init() for detector in self.detectors)

    def step(self, state: tuple, estimate: Estimate) -> tuple[tuple, Verdict]:
        """The verdicts of all on one row; which channels alarmed is left out."""
        pairs = zip(self.detectors, state, strict=True)
        state, said = zip(*(d.step(own, estimate) for d, own in pairs), strict=True)
        return state, Verdict(
            jnp.stack([jnp.asarray(one.statistic) for one in said]),
            jnp.stack([jnp.asarray(one.threshold) for one in said]),
            jnp.stack([jnp.asarray(one.alarm) for one in said]),
            jnp.stack([jnp.asarray(one.reason) for one in said]),
            jnp.zeros((len(said), 0), bool),
        )


@eqx.filter_jit
def _judged(
    monitor: Monitor, attacks: tuple[Attack, ...], keys: Key[Array, " runs"], steps: int
) -> tuple[Float[Array, "runs 2 t m"], Float[Array, "runs 2 t m"]]:
    """Statistic and threshold: run, without and with attack, row, detector."""
    never, ever = jnp.asarray(0, jnp.int32), jnp.asarray(jnp.iinfo(jnp.int32).max, jnp.int32)

    def run(key: PRNGKeyArray, last):
        start_key, run_key = jax.random.split(key)
        x0 = start_state(monitor.estimator, start_key)
        switched = tuple(Window(attack, never, last) for attack in attacks)
        scenario = Scenario(monitor.estimator.plant, x0, monitor, attacks=switched)
        verdict = simulate(scenario, run_key, steps).verdict
        return jnp.asarray(verdict.statistic), jnp.asarray(verdict.threshold)

    # one axis for both, in blocks of which projections work
    lasts = jnp.tile(jnp.stack([never, ever]), keys.shape[0])
    said = jax.vmap(run)(jnp.repeat(keys, 2), lasts)
    return jax.tree.map(lambda rows: rows.reshape(-1, 2, *rows.shape[1:]), said)


def curves(margins: Mapping[str, Margins], key: PRNGKeyArray) -> Curves:
    """ROC curves of statistics at hand, every array (run, row) of the same runs.

    With t(a) the threshold that a share a of all attack-free rows reaches, the detection at
    the false-alarm rate a is the share of attacked rows that reach t(a), linear in between: at
    a rate that falls on tied values, what a test that draws lots among them detects. ``area``
    is that below the whole curve, rates 0 to 1. Rows of NaN are left out.

    Intervals: percentiles over `RESAMPLES` draws of as many runs, thresholds found anew in
    each draw. ``key`` makes the draws.

    Raises `InvalidValue` for fewer than 20 runs, or rows too few for the lowest rate.
    Source: Efron, Tibshirani, An Introduction to the Bootstrap (1993), chapters 8 and 13.
    """
    for pair in margins.values():
        _enough(len(pair.quiet), int(np.sum(~np.isnan(pair.quiet))))
    reference = next(iter(margins))
    weights = _draws(len(margins[reference].quiet), key)
    drawn = {name: _curve(pair, weights) for name, pair in margins.items()}
    detection = {name: curve for name, (curve, _) in drawn.items()}
    area = {name: below for name, (_, below) in drawn.items()}
    others = [name for name in margins if name != reference]
    return Curves(
        {name: _interval(curve) for name, curve in detection.items()},
        {name: _interval(below) for name, below in area.items()},
        {name: _interval(detection[name] - detection[reference]) for name in others},
        {name: _interval(area[name] - area[reference]) for name in others},
    )


def _enough(runs: int, rows: int) -> None:
    if runs < FEWEST_RUNS:
        raise InvalidValue("runs", runs, f"at least {FEWEST_RUNS}")
    if rows < FEWEST_ROWS:
        raise InvalidValue("runs, steps", f"{rows} rows without attack", f"at least {FEWEST_ROWS}")


def _draws(runs: int, key: PRNGKeyArray) -> np.ndarray:
    """How often each run is drawn: (1 + `RESAMPLES`, run), first every run once."""
    drawn = np.asarray(jax.random.randint(key, (RESAMPLES, runs), 0, runs))
    counts = np.apply_along_axis(np.bincount, 1, drawn, minlength=runs)
    return np.concatenate([np.ones((1, runs)), counts])


def _curve(pair: Margins, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Detection at `RATES` and the area, for every draw of runs."""
    quiet, attacked = (np.round(rows, DIGITS) for rows in pair)
    inner = np.unique(np.nanquantile(quiet, 1.0 - KNOTS))[::-1]
    # everything above the highest attack-free value is found without any false alarm
    above = np.nextafter(np.nanmax(quiet), np.inf)
    knots = np.concatenate([[np.inf, above], inner, [-np.inf]])
    false, true = (_shares(rows, knots, weights) for rows in (quiet, attacked))
    found = [np.interp(RATES, f, t) for f, t in zip(false, true, strict=True)]
    return np.stack(found), np.trapezoid(true, false, axis=1)


def _shares(rows: np.ndarray, knots: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The share of the rows drawn that reach each of the falling ``knots``: (draw, knot)."""
    tested = np.sum(~np.isnan(rows), 1)
    # NaN sorts last, beyond every knot
    below = np.stack([np.searchsorted(np.sort(row), knots, side="left") for row in rows])
    reached = tested[:, None] - below
    return (weights @ reached) / (weights @ tested)[:, None]


def _interval(drawn: Any) -> Interval:
    low, high = np.percentile(drawn[1:], TAILS, axis=0)
    return Interval(np.asarray(drawn[0]), low, high)
