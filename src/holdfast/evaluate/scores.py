"""Scores of estimates and alarms: pure functions of arrays.

Time runs along the first axis of what a single run gives; runs, where a function takes them,
come before it. What the data do not determine (infinite variance) or what carries no
information (zero variance) never enters a score: it is left out and counted out.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri, ndtri

from holdfast.numerics.linalg import mahalanobis


class Share(NamedTuple):
    """``hits`` of ``of``, with Wilson's interval; NaN where ``of`` is 0."""

    value: float
    low: float
    high: float
    hits: int
    of: int


class Rate(NamedTuple):
    """``events`` over ``duration`` seconds, per second, with the exact Poisson bounds.

    ``low`` and ``high`` are the two-sided interval; ``upper`` is the one-sided bound.
    """

    value: float
    low: float
    high: float
    upper: float
    events: int
    duration: float


class Consistency(NamedTuple):
    """Sum of normalised squares over its degrees of freedom: 1 where covariances are honest.

    ``low``..``high``: where the ratio lies with the stated confidence if they are. ``rows``:
    how many rows entered, ``independent``: how many independent ones they are worth.
    """

    ratio: float
    low: float
    high: float
    rows: int
    independent: float

    @property
    def consistent(self) -> bool:
        """Whether the ratio lies in the interval."""
        return bool(self.low <= self.ratio <= self.high)


class TradeOff(NamedTuple):
    """For each threshold: delay of the alarm (inf = never) and episodes before the attack."""

    threshold: np.ndarray
    delay: np.ndarray
    episodes: np.ndarray


class Roc(NamedTuple):
    """False and true alarm shares as the threshold falls; ``auc`` with DeLong's interval."""

    threshold: np.ndarray
    false: np.ndarray
    true: np.ndarray
    auc: float
    low: float
    high: float


def rmse(error: ArrayLike, variance: ArrayLike | None = None) -> np.ndarray:
    """sqrt(mean(error^2)) per channel (last axis) over every row that is determined.

    Rows of infinite ``variance`` are left out; NaN where none is left.
    """
    squares, used = _determined(np.square(np.asarray(error, float)), variance)
    count = used.sum(0)
    total = np.where(used, squares, 0.0).sum(0)
    return np.sqrt(np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0))


def worst_error(error: ArrayLike, variance: ArrayLike | None = None) -> np.ndarray:
    """Largest |error| per channel (last axis) over every row that is determined, else NaN."""
    sizes, used = _determined(np.abs(np.asarray(error, float)), variance)
    largest = np.where(used, sizes, -np.inf).max(0, initial=-np.inf)
    return np.where(used.any(0), largest, np.nan)


def _determined(values: np.ndarray, variance: ArrayLike | None) -> tuple[np.ndarray, np.ndarray]:
    used = np.isfinite(values)
    if variance is not None:
        used &= np.isfinite(np.asarray(variance, float))
    channels = values.shape[-1]
    return values.reshape(-1, channels), used.reshape(-1, channels)


def normalised_squares(vectors: ArrayLike, covariances: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Squares v' cov^+ v and their degrees of freedom, row by row (any number of leading axes).

    The NEES of a state error with its covariance, the NIS of a residual with its own.
    Entries of zero or infinite variance count neither in the value nor in the degrees.
    """
    v, cov = jnp.asarray(vectors, float), jnp.asarray(covariances, float)
    n = v.shape[-1]
    values, degrees = _normalised_rows(v.reshape(-1, n), cov.reshape(-1, n, n))
    shape = v.shape[:-1]
    return np.asarray(values).reshape(shape), np.asarray(degrees).reshape(shape)


_normalised_rows = jax.jit(jax.vmap(mahalanobis))


def consistency(
    values: ArrayLike, degrees: ArrayLike, *, confidence: float = 0.95, white: bool = True
) -> Consistency:
    """sum(values) / sum(degrees) beside the chi-square interval it should lie in.

    ``white``: rows are independent, as residuals are when the model is right. Where they are
    not (a state error moves slowly) the rows are worth their number over the correlation time
    1 + 2 sum rho_k, and the interval widens accordingly. Shapes (time) or (run, time).
    Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications, section 5.4.
    """
    values = np.atleast_2d(np.asarray(values, float))
    degrees = np.atleast_2d(np.asarray(degrees, float))
    used = degrees > 0
    rows, total = int(used.sum()), float(degrees[used].sum())
    if rows == 0:
        return Consistency(np.nan, np.nan, np.nan, 0, 0.0)
    worth = 1.0 if white else 1.0 / correlation_time(values, used)
    tail, nu = (1 - confidence) / 2, total * worth
    low, high = chdtri(nu, [1 - tail, tail]) / nu
    ratio = float(values[used].sum() / total)
    return Consistency(ratio, float(low), float(high), rows, rows * worth)


def correlation_time(values: ArrayLike, used: ArrayLike | None = None) -> float:
    """1 + 2 sum_k rho_k in rows, the sum cut at the first pair that is not positive.

    ``values`` (run, time); rows not ``used`` are left out. Never under 1 nor over the length.
    Source: Geyer, Practical Markov Chain Monte Carlo (1992), initial positive sequence.
    """
    values = np.atleast_2d(np.asarray(values, float))
    used = np.ones(values.shape, bool) if used is None else np.atleast_2d(np.asarray(used))
    length = values.shape[-1]
    centred = np.where(used, values - values[used].mean(), 0.0)
    spectrum = np.fft.rfft(centred, 2 * length)
    covariance = np.fft.irfft(np.abs(spectrum) ** 2).sum(0)[:length]
    if covariance[0] <= 0 or length < 3:
        return 1.0
    rho = covariance / covariance[0]
    pairs = rho[1 : length - 1 : 2] + rho[2:length:2]
    stop = np.argmax(pairs <= 0) if np.any(pairs <= 0) else len(pairs)
    return float(np.clip(1 + 2 * pairs[:stop].sum(), 1.0, length))


def share(count: int, of: int, *, confidence: float = 0.95) -> Share:
    """The share count / of with Wilson's score interval.

    Source: Wilson (1927); Brown, Cai, DasGupta, Statistical Science 16 (2001), eq. 4.
    """
    if of == 0:
        return Share(np.nan, np.nan, np.nan, 0, 0)
    z = float(ndtri(0.5 + confidence / 2))
    p = count / of
    centre = (p + z * z / (2 * of)) / (1 + z * z / of)
    half = z * np.sqrt(p * (1 - p) / of + z * z / (4 * of * of)) / (1 + z * z / of)
    low = 0.0 if count == 0 else float(centre - half)
    high = 1.0 if count == of else float(centre + half)
    return Share(p, low, high, int(count), int(of))


def false_alarm_rate(
    alarm: ArrayLike, benign: ArrayLike, tested: ArrayLike | None = None, *,
    confidence: float = 0.95,
) -> Share:  # fmt: skip
    """Share of benign rows with an alarm. Rows where nothing was ``tested`` do not count.

    The interval takes the rows as independent, which those of a detector with memory are not.
    """
    rows = _rows(benign, tested)
    return share(int((np.asarray(alarm, bool) & rows).sum()), int(rows.sum()),
                 confidence=confidence)  # fmt: skip


def missed_share(
    alarm: ArrayLike, attacked: ArrayLike, tested: ArrayLike | None = None, *,
    confidence: float = 0.95,
) -> Share:  # fmt: skip
    """Share of attacked rows without an alarm. Rows where nothing was ``tested`` do count:
    an attack that cannot be seen is missed.
    """
    rows = np.asarray(attacked, bool)
    quiet = ~np.asarray(alarm, bool)
    if tested is not None:
        quiet |= ~np.asarray(tested, bool)
    return share(int((quiet & rows).sum()), int(rows.sum()), confidence=confidence)


def _rows(mask: ArrayLike, tested: ArrayLike | None) -> np.ndarray:
    mask = np.asarray(mask, bool)
    return mask if tested is None else mask & np.asarray(tested, bool)


def detection_delay(time: ArrayLike, alarm: ArrayLike, start: float, stop: float = np.inf) -> float:
    """Seconds from ``start`` to the first alarm with start <= t < stop; inf if there is none."""
    time, alarm = np.asarray(time, float), np.asarray(alarm, bool)
    hits = time[alarm & (time >= start) & (time < stop)]
    return float(hits[0] - start) if hits.size else np.inf


def episodes(time: ArrayLike, alarm: ArrayLike, gap: float) -> list[tuple[int, int]]:
    """(first row, last row) of each episode: alarms at most ``gap`` seconds apart are one."""
    time, rows = np.asarray(time, float), np.flatnonzero(np.asarray(alarm, bool))
    if rows.size == 0:
        return []
    # rows one dt apart differ by rounding only: without the slack a gap of dt would split
    slack = 1e-9 * max(1.0, float(np.abs(time).max()))
    cuts = np.flatnonzero(np.diff(time[rows]) > gap + slack)
    firsts = rows[np.concatenate([[0], cuts + 1])]
    lasts = rows[np.concatenate([cuts, [rows.size - 1]])]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def event_rate(count: int, duration: float, *, confidence: float = 0.95) -> Rate:
    """Events per second with exact Poisson bounds; without an event the rule of three.

    upper = chi2_{confidence}(2 count + 2) / (2 duration), so 3.00 / duration for none at
    95 %. Source: Garwood, Biometrika 28 (1936).
    """
    if not duration > 0:
        return Rate(np.nan, np.nan, np.nan, np.nan, int(count), 0.0)
    tail = (1 - confidence) / 2
    low = chdtri(2 * count, 1 - tail) / 2 if count else 0.0
    high = chdtri(2 * count + 2, tail) / 2
    upper = chdtri(2 * count + 2, 1 - confidence) / 2
    rate, low, high, upper = (float(v / duration) for v in (count, low, high, upper))
    return Rate(rate, low, high, upper, int(count), float(duration))


def margin(statistic: ArrayLike, threshold: ArrayLike) -> np.ndarray:
    """Statistic over threshold: over 1 where an alarm is due, NaN where nothing was tested."""
    statistic, threshold = np.asarray(statistic, float), np.asarray(threshold, float)
    tested = np.isfinite(threshold) & np.isfinite(statistic) & (threshold > 0)
    return np.divide(
        statistic, threshold, out=np.full(np.broadcast(statistic, threshold).shape, np.nan),
        where=tested,
    )  # fmt: skip


def trade_off(
    time: ArrayLike, statistic: ArrayLike, start: float, *, stop: float = np.inf,
    gap: float = 0.0, thresholds: Sequence[float] | None = None, points: int = 200,
) -> TradeOff:  # fmt: skip
    """Delay against episodes before the attack, threshold by threshold.

    ``statistic`` NaN where nothing was tested (see `margin`, which also puts a threshold that
    varies onto one scale); an alarm is statistic > threshold. Without ``thresholds``, up to
    ``points`` of the values that the statistic takes, where the curve can change.
    """
    time, statistic = np.asarray(time, float), np.asarray(statistic, float)
    before = time < start
    if thresholds is None:
        found = np.unique(statistic[np.isfinite(statistic) & (time < stop)])
        keep = np.unique(np.linspace(0, len(found) - 1, min(points, len(found))).astype(int))
        values = found[keep]
    else:
        values = np.asarray(thresholds, float)
    delays, counts = [], []
    for value in values:
        alarm = statistic > value  # False for NaN
        delays.append(detection_delay(time, alarm, start, stop))
        counts.append(len(episodes(time, alarm & before, gap)))
    return TradeOff(values, np.asarray(delays, float), np.asarray(counts, int))


def roc(statistic: ArrayLike, attacked: ArrayLike, *, confidence: float = 0.95) -> Roc:
    """Alarm share among attacked and benign rows over every threshold, and the area below.

    Rows where the statistic is NaN (nothing tested) are left out. AUC is the chance that an
    attacked row has the larger statistic, ties counting half; its interval is DeLong's with
    rows taken as independent, NaN with fewer than two rows of a kind.
    Source: DeLong, DeLong, Clarke-Pearson, Biometrics 44 (1988).
    """
    from scipy.stats import rankdata  # takes as long to import as JAX

    statistic, attacked = np.ravel(np.asarray(statistic, float)), np.ravel(np.asarray(attacked))
    used = ~np.isnan(statistic)
    statistic, attacked = statistic[used], attacked[used].astype(bool)
    bad, good = statistic[attacked], statistic[~attacked]
    if bad.size == 0 or good.size == 0:
        empty = np.zeros(0)
        return Roc(empty, empty, empty, np.nan, np.nan, np.nan)
    thresholds = np.concatenate([[np.inf], np.unique(statistic)[::-1]])
    false = 1 - np.searchsorted(np.sort(good), thresholds, side="left") / good.size
    true = 1 - np.searchsorted(np.sort(bad), thresholds, side="left") / bad.size
    ranks = rankdata(np.concatenate([bad, good]))
    above = (ranks[: bad.size] - rankdata(bad)) / good.size
    below = 1 - (ranks[bad.size :] - rankdata(good)) / bad.size
    auc = float(above.mean())
    if bad.size < 2 or good.size < 2:
        return Roc(thresholds, false, true, auc, np.nan, np.nan)
    sd = np.sqrt(above.var(ddof=1) / bad.size + below.var(ddof=1) / good.size)
    half = float(ndtri(0.5 + confidence / 2) * sd)
    return Roc(thresholds, false, true, auc, max(0.0, auc - half), min(1.0, auc + half))
