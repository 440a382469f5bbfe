"""Thresholds that give the false-alarm rate they promise.

Every detector of this package is built with thresholds that are exact for independent
Gaussian estimates. Where the estimates are not (attack estimates are correlated in time,
outputs with each other, nonlinear filters are not quite Gaussian) one number per detector is
found by simulation or from an attack-free log: the factor on its thresholds, for Wald's test
the amount added to its boundary.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.special import betaincinv

from holdfast.campaign.attack_free import Judged, attack_free, horizon
from holdfast.detectors.chi_square import ChiSquare
from holdfast.detectors.cusum import Cusum
from holdfast.detectors.likelihood_ratio import LikelihoodRatio
from holdfast.detectors.per_channel import PerChannel
from holdfast.detectors.sprt import Sprt
from holdfast.detectors.windowed import Windowed
from holdfast.estimators.care import Care
from holdfast.estimators.decomposition import Decomposition
from holdfast.estimators.kalman import Kalman
from holdfast.estimators.nisme import Nisme
from holdfast.estimators.unknown_input import UnknownInput
from holdfast.loop import Monitor, replay
from holdfast.parts import Controller, Detector, Estimator, InvalidValue
from holdfast.plants.linear import LinearPlant
from holdfast.records import Array, Estimate, Observation, Verdict

ALARMS = 5000
"""False alarms wanted in a simulation: their rate is then known to 1.4 % if independent."""
LEAST_ALARMS = 20
MOST_ROWS = 20_000_000
BURN_IN = 100
CANDIDATES = 33

Calibratable = ChiSquare | Windowed | Cusum | Sprt | PerChannel | LikelihoodRatio


@dataclass(frozen=True)
class Calibration:
    """How a threshold came about and what false-alarm rate it gives.

    ``value``: the factor on the detector's thresholds (Wald's test: the amount added).
    ``standard_error``: of the false-alarm rate, between runs (simulated). ``upper``: the rate
    not exceeded with 95 % confidence (log). ``steps`` counts the rows of a run, the first
    ``burn_in`` of which were left out.
    """

    method: Literal["exact", "bound", "simulated", "log", "given"]
    level: float
    value: float
    sentence: str
    standard_error: float | None = None
    upper: float | None = None
    seed: int | None = None
    runs: int = 0
    steps: int = 0
    burn_in: int = 0


_known: dict[str, Calibration] = {}


def calibrated(
    monitor: Monitor,
    *,
    seed: int = 0,
    runs: int | None = None,
    steps: int = 500,
    controller: Controller | None = None,
) -> tuple[Monitor, Calibration]:
    """The monitor with the false-alarm rate of its detector's level, and how that was done.

    Nothing is simulated where a distribution exists or where the threshold was not asked to
    be calibrated. Otherwise ``runs`` attack-free runs of ``steps`` rows (as many as give
    5000 false alarms if left out; short ones where the plant is unstable and no controller
    holds it), the true x0 drawn from the estimator's own N(x0, P0). Results are kept in
    memory under `content_key`.

    Raises `InvalidValue` for a level too small to simulate.
    """
    detector = monitor.detector
    if not isinstance(detector, Calibratable):
        return monitor, Calibration(
            "given", float("nan"), 1.0, "The detector sets its own threshold."
        )
    level = float(detector.level)
    if detector.rule != "calibrated":
        origin = "the paper's formula" if detector.rule == "paper" else "a number"
        sentence = f"Threshold from {origin}, not calibrated to a false-alarm rate."
        return monitor, Calibration("given", level, 1.0, sentence)
    if isinstance(detector, LikelihoodRatio) and detector.test == "possible":
        sentence = (
            f"False-alarm rate at most {level:g} per step, whatever attack within the limits "
            "there is, for Gaussian noise of the covariances stated."
        )
        return monitor, Calibration("bound", level, 1.0, sentence)
    if _exact(monitor.estimator, detector):
        sentence = (
            f"False-alarm rate {level:g} per step, exact for Gaussian noise of the "
            "covariances stated."
        )
        return monitor, Calibration("exact", level, 1.0, sentence)
    key = content_key((monitor, controller), (seed, runs, steps))
    if key not in _known:
        _known[key] = _simulated(monitor, controller, seed, runs, steps)
    found = _known[key]
    return with_value(monitor, found.value), found


def content_key(parts: Any, settings: tuple) -> str:
    """A name for a calibration: the same for the same numbers, names and settings."""
    leaves, structure = jax.tree.flatten(parts)
    digest = hashlib.sha256(repr((str(structure), settings)).encode())
    for leaf in leaves:
        array = np.asarray(leaf)
        digest.update(repr((array.shape, str(array.dtype))).encode())
        digest.update(array.tobytes() if array.dtype != object else repr(leaf).encode())
    return digest.hexdigest()


def with_value(monitor: Monitor, value: float) -> Monitor:
    """The monitor with a calibration's ``value`` in its detector."""
    where = "offset" if isinstance(monitor.detector, Sprt) else "factor"
    return eqx.tree_at(lambda m: getattr(m.detector, where), monitor, jnp.asarray(value, float))


def _exact(estimator: Estimator, detector: Calibratable) -> bool:
    if isinstance(estimator, Care) and estimator.project != "feedback":
        estimator = estimator.free  # what is tested is before the projection
    plant = estimator.plant
    if detector.needs == "simulation" or getattr(detector, "projected", False):
        return False
    if isinstance(estimator, Decomposition):
        # each innovation has the covariance it says; one after the other they are white only
        # once a Kalman gain has settled
        return detector.needs not in ("white", "independent")
    if not (isinstance(estimator, Kalman | UnknownInput) and isinstance(plant, LinearPlant)):
        return False
    if plant.schedule is not None and plant.schedule[0] == "state":
        return False  # linearised at an estimate
    if detector.needs == "white":
        return detector.on == "residual"
    if detector.needs == "independent":
        return detector.table.shape[0] == 2
    return True


def _simulated(
    monitor: Monitor, controller: Controller | None, seed: int, runs: int | None, steps: int
) -> Calibration:
    detector = monitor.detector
    assert isinstance(detector, Calibratable)
    level = float(detector.level)
    most = horizon(monitor.estimator.plant, controller)
    steps = steps if most is None else min(steps, most)
    burn_in = min(BURN_IN, steps // 2)
    kept = steps - burn_in
    if runs is None:
        runs = min(max(200, -int(-ALARMS / level // kept)), MOST_ROWS // kept)
    if runs < 2 or runs * kept * level < LEAST_ALARMS:
        raise InvalidValue(
            "level",
            level,
            f"at least {LEAST_ALARMS / (max(runs, 2) * kept):.2g} to be calibrated by {runs} runs "
            f'of {kept} rows: use more, threshold = "paper", or a number',
        )
    keys = jax.random.split(jax.random.key(seed), runs)
    monitor = with_value(monitor, 0.0 if isinstance(detector, Sprt) else 1.0)
    if isinstance(detector, Sprt):

        def rates_at(offsets: np.ndarray) -> np.ndarray:
            judged = attack_free(_bank(monitor, offsets), controller, keys, steps)
            return _rates(judged, burn_in)

        value, rates = _crossing(rates_at, level, detector)
    else:
        judged = attack_free(monitor, controller, keys, steps)
        ratio = _passed(monitor, _ratio(judged)[:, burn_in:])
        tested = np.sort(ratio[np.isfinite(ratio)])[::-1]
        if len(tested) * level < LEAST_ALARMS:
            raise InvalidValue(
                "threshold",
                f"{len(tested)} rows of the simulation with anything to test",
                f"{LEAST_ALARMS / level:.0f} or more: is what is tested ever determined?",
            )
        value = _highest(monitor, tested[int(level * len(tested))])
        alarms = np.sum(ratio > value, 1)
        rates = alarms / np.maximum(np.sum(np.isfinite(ratio), 1), 1)
    error = float(np.std(rates, ddof=1) / np.sqrt(runs))
    how = f"raised by {value:.4g}" if isinstance(detector, Sprt) else f"scaled by {value:.4g}"
    rate = f"{np.mean(rates):.2g}, at most {level:g}," if _believes(monitor) else f"{level:g}"
    sentence = (
        f"False-alarm rate {rate} +- {error:.2g} (standard error) per step over {runs} "
        f"attack-free runs of {steps} rows, the first {burn_in} left out (seed {seed}); "
        f"threshold {how}."
    )
    return Calibration("simulated", level, value, sentence, error, None, seed, runs, steps, burn_in)


def _believes(monitor: Monitor) -> bool:
    """Whether what is tested is an attack that a bank of modes believes in, if it does at all."""
    detector = monitor.detector
    return isinstance(monitor.estimator, Nisme) and getattr(detector, "on", None) == "attack"


def _passed(monitor: Monitor, ratio: np.ndarray) -> np.ndarray:
    """The ratio, 0 where a bank believes in no attack: a row that has passed its test."""
    return np.where(np.isnan(ratio), 0.0, ratio) if _believes(monitor) else ratio


def _highest(monitor: Monitor, value: float) -> float:
    """The factor with ``value`` just not above it; of a bank never under the quantile's own."""
    return max(1.0, _above(value)) if _believes(monitor) else _above(value)


def _above(value: float) -> float:
    """A hair above, so that the row the threshold is taken from raises no alarm."""
    return float(value * (1.0 + 1e-12))


def _ratio(judged: Judged | Verdict) -> np.ndarray:
    """Statistic over threshold; NaN where there was nothing to test."""
    statistic, threshold = np.asarray(judged.statistic), np.asarray(judged.threshold)
    tested = np.isfinite(threshold)
    return np.where(tested, statistic / np.where(tested, threshold, 1.0), np.nan)


def _rates(judged: Judged, burn_in: int) -> np.ndarray:
    """Alarms per row tested, for each run."""
    tested = np.isfinite(np.asarray(judged.threshold))[:, burn_in:]
    alarms = np.sum(np.asarray(judged.alarm)[:, burn_in:], 1)
    return alarms / np.maximum(np.sum(tested, 1), 1)


class _Bank(Detector):
    """One Wald test with many boundaries at once; its verdicts have one entry for each."""

    detector: Sprt
    offsets: Float[Array, " m"]

    def init(self) -> Float[Array, " m"]:
        """No evidence yet, for any."""
        return jnp.zeros(self.offsets.shape)

    def step(
        self, state: Float[Array, " m"], estimate: Estimate
    ) -> tuple[Float[Array, " m"], Verdict]:
        """The verdict of each."""

        def one(offset, state):
            detector = eqx.tree_at(lambda d: d.offset, self.detector, offset)
            return detector.step(state, estimate)

        return jax.vmap(one)(self.offsets, state)


def _bank(monitor: Monitor, offsets: np.ndarray) -> Monitor:
    assert isinstance(monitor.detector, Sprt)
    return Monitor(monitor.estimator, _Bank(monitor.detector, jnp.asarray(offsets)))


def _crossing(
    rates: Callable[[np.ndarray], np.ndarray], target: float, detector: Sprt
) -> tuple[float, np.ndarray]:
    """The smallest offset whose mean rate is at most ``target``, and its rates, run by run.

    By three ever finer grids: the offset is then known to 0.003 or better for boundaries
    under 6, and the rate, which goes with exp(-boundary), to 0.3 %.
    """
    size = np.max(np.abs(np.asarray(detector.table[1:]))) + float(detector.shift) ** 2
    low, high = -2.0 * size, 10.0 * size + 20.0
    offsets, found, first = np.zeros(1), np.zeros((1, 1)), 0
    for _ in range(3):
        offsets = np.linspace(low, high, CANDIDATES)
        found = rates(offsets)
        under = np.flatnonzero(np.mean(found, 0) <= target)
        if not len(under):
            raise InvalidValue(
                "threshold", "calibrated", "a number: alarms come at any boundary tried"
            )
        first = int(under[0])
        low, high = offsets[max(first - 1, 0)], offsets[max(first, 1)]
    return float(offsets[first]), found[:, first]


def from_log(monitor: Monitor, observations: Observation) -> tuple[Monitor, Calibration]:
    """The monitor with the threshold that an attack-free log supports, and what it supports.

    With N rows tested, the k + 1-th largest ratio of statistic to threshold is taken as
    factor, k + 1 = floor(level (N + 1)), so that the expected rate is at most the level; if
    the log is too short for that, the largest. The rate is below ``upper`` with 95 %
    confidence: the Beta(k + 1, N - k) quantile of order statistics, with N and k reduced by
    the autocorrelation of the log.

    Raises `InvalidValue` if the detector cannot be calibrated or nothing was ever tested.
    """
    detector = monitor.detector
    if not isinstance(detector, Calibratable):
        raise InvalidValue("detector", type(detector).__name__, "one that can be calibrated")
    level = float(detector.level)
    neutral = with_value(monitor, 0.0 if isinstance(detector, Sprt) else 1.0)
    verdict = replay(neutral, observations).verdict
    ratio = _passed(monitor, _ratio(verdict))
    tested = np.isfinite(ratio)
    ratio = ratio[tested]
    n = len(ratio)
    if n < 2:
        raise InvalidValue("calibrate", f"{n} rows to test", "an attack-free log of many rows")
    alarms = max(int(level * (n + 1)) - 1, 0)
    if isinstance(detector, Sprt):

        def rates(offsets: np.ndarray) -> np.ndarray:
            found = replay(_bank(neutral, offsets), observations).verdict
            return np.mean(np.asarray(found.alarm)[tested], 0, keepdims=True)

        value, _ = _crossing(rates, alarms / n, detector)
    else:
        value = _highest(monitor, np.sort(ratio)[::-1][alarms])
        alarms = int(np.sum(ratio > value))
    free = n / _correlation_rows(ratio)
    upper = float(betaincinv(alarms * free / n + 1.0, free * (1.0 - alarms / n), 0.95))
    seen = f"{n} attack-free rows (worth {free:.0f} independent ones)"
    if level * (n + 1) < 1.0:
        needed = int(np.ceil(np.log(0.05) / np.log1p(-level)))
        sentence = (
            f"{seen} are too few for a level of {level:g}: above all of them the false-alarm "
            f"rate is below {upper:.2g} per step with 95 % confidence; {needed} independent "
            f"rows would support {level:g}."
        )
    else:
        sentence = (
            f"On {seen} the threshold leaves {alarms} alarms; the false-alarm rate is below "
            f"{upper:.2g} per step with 95 % confidence, if what comes is like this log."
        )
    found = Calibration("log", level, value, sentence, upper=upper, runs=1, steps=n)
    return with_value(monitor, value), found


def _correlation_rows(series: np.ndarray) -> float:
    """How many rows count as one: 1 + 2 sum of autocorrelations until they leave the noise."""
    centred = series - np.mean(series)
    n = len(series)
    spectrum = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    covariance = np.fft.irfft(spectrum)[:n]
    if covariance[0] <= 0:
        return 1.0
    correlation = covariance[1:] / covariance[0]
    noise = np.flatnonzero(correlation < 2.0 / np.sqrt(n))
    last = noise[0] if len(noise) else n - 1
    return float(min(1.0 + 2.0 * np.sum(correlation[:last]), n))
