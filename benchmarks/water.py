"""A real water network (BATADAL): a linear model from a year without attack, and its detectors.

    HOLDFAST_DATA=../shared/data python benchmarks/water.py [--kinds L F] [--lags 2]

z_k (tank levels L, flows F, pressures P) = sum_l A_l z_{k-l} + B u_k + e: least squares
(`numpy.linalg.lstsq`) over the first two thirds of dataset03, u the pumps' and valves' positions
now and an hour ago, a constant, and four harmonics of the day. Thresholds are calibrated on its
last third to `LEVEL` false alarms an hour, and the detectors scored on dataset04. The plant is
that model with x = (z_k, .., z_{k-l+1}), read exactly.
"""

import argparse
import os
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from scipy.stats import chi2, kurtosis

from holdfast import Monitor, Observation, replay
from holdfast.campaign.calibrate import from_log
from holdfast.detectors import chi_square, cusum, per_channel, windowed
from holdfast.estimators import kalman
from holdfast.evaluate.scores import normalised_squares
from holdfast.plants.build import linear_plant
from holdfast.shell.water import Scada, Scored, read_scada, scored

FOLDER = Path(os.environ.get("HOLDFAST_DATA", "../shared/data")) / "batadal"
LEVEL, HARMONICS, EXACT = 0.01, 4, 1e-8
"""False alarms an hour; harmonics of the day; variance of a reading beside that of its signal."""
DETECTORS = {
    "chi_square": (chi_square, {}),
    "per_channel": (per_channel, {}),
    "windowed, 6 h": (windowed, {"length": 6}),
    "windowed, 12 h": (windowed, {"length": 12}),
    "windowed, 24 h": (windowed, {"length": 24}),
    "cusum, 0.9": (cusum, {"forgetting": 0.9}),
}


class Model(NamedTuple):
    """A_l, B, the covariance of e, and which signals it has."""

    A: list[np.ndarray]
    B: np.ndarray
    Q: np.ndarray
    names: list[str]
    switches: list[str]


def inputs(log: Scada, switches: list[str]) -> np.ndarray:
    now = np.array([log.signals[name] for name in switches]).T
    turns = 2 * np.pi * np.outer(log.hour, np.arange(1, HARMONICS + 1)) / 24
    day = [np.ones((len(now), 1)), np.cos(turns), np.sin(turns)]
    return np.hstack([now, np.vstack([now[:1], now[:-1]]), *day])


def signals(log: Scada, names: list[str]) -> np.ndarray:
    return np.array([log.signals[name] for name in names]).T


def identified(log: Scada, kinds: list[str], lags: int, until: int) -> Model:
    """From the hours before ``until``; signals and switches that never move are left out."""
    moving = [n for n, v in log.signals.items() if np.std(v[:until]) > 1e-3]
    names = [n for n in moving if n[:1] in kinds and len(np.unique(log.signals[n][:until])) > 5]
    switches = [n for n in moving if n.startswith("S_")]
    z, u = signals(log, names), inputs(log, switches)
    past = [z[lags - lag : until - lag] for lag in range(1, lags + 1)]
    X = np.hstack([*past, u[lags:until]])
    W, *_ = np.linalg.lstsq(X, z[lags:until], rcond=None)
    e = z[lags:until] - X @ W
    m = len(names)
    A = [W[lag * m : (lag + 1) * m].T for lag in range(lags)]
    return Model(A, W[lags * m :].T, np.cov(e.T), names, switches)


def plant_of(model: Model):
    m, lags = len(model.names), len(model.A)
    n = m * lags
    A, B, Q = np.zeros((n, n)), np.zeros((n, model.B.shape[1])), np.zeros((n, n))
    A[:m] = np.hstack(model.A)
    A[m:, : n - m] = np.eye(n - m)
    B[:m], Q[:m, :m] = model.B, model.Q
    C = np.hstack([np.eye(m), np.zeros((m, n - m))])
    return linear_plant(
        A=A, B=B, C=C, Q=Q, R=EXACT * np.diag(np.diag(model.Q)), dt=3600.0, outputs=model.names
    )


def monitored(model: Model, log: Scada, lags: int, detector, **settings):
    """A monitor that begins at the log's first hours, and the rows after them."""
    plant, z = plant_of(model), signals(log, model.names)
    x0 = z[lags - 1 :: -1][:lags].ravel()
    start = kalman.build(plant, x0, EXACT * np.eye(len(x0)))
    rows = Observation.of(inputs(log, model.switches)[lags:], z[lags:])
    return Monitor(start, detector.build(plant, level=LEVEL, on="residual", **settings)), rows


def part(log: Scada, first: int) -> Scada:
    cut = {name: values[first:] for name, values in log.signals.items()}
    return Scada(cut, log.hour[first:], log.attacked[first:])


def judged(model: Model, lags: int, held_out: Scada, log: Scada) -> dict[str, tuple[Scored, float]]:
    """Of every detector: its score, and the false alarms an hour over the hours without attack
    that lie a day or more after the last one.
    """
    found = {}
    for name, (detector, settings) in DETECTORS.items():
        monitor, rows = monitored(model, held_out, lags, detector, **settings)
        monitor, _ = from_log(monitor, rows)
        start, rows = monitored(model, log, lags, detector, **settings)
        verdict = replay(Monitor(start.estimator, monitor.detector), rows).verdict
        alarm = np.concatenate([np.zeros(lags, bool), np.asarray(verdict.alarm)])
        recent = np.convolve(log.attacked, np.ones(25))[: len(alarm)] > 0
        found[name] = scored(alarm, log.attacked), float(alarm[~recent].mean())
    return found


def residuals(model: Model, lags: int, log: Scada):
    monitor, rows = monitored(model, log, lags, chi_square)
    return replay(monitor, rows).estimate


def whiteness(model: Model, lags: int, held_out: Scada) -> None:
    """What is left of the model's assumptions, on hours it was not fitted to."""
    estimate = residuals(model, lags, held_out)
    e = np.asarray(estimate.residual) / np.sqrt(np.diag(model.Q))
    hours = len(e)
    rho = np.array([np.mean(e[k:] * e[:-k], 0) / np.mean(e**2, 0) for k in range(1, 25)])
    ljung = hours * (hours + 2) * np.sum(rho**2 / (hours - np.arange(1, 25))[:, None], 0)
    white = np.sum(ljung < chi2.ppf(0.99, 24))
    squares, degrees = normalised_squares(estimate.residual, estimate.residual_cov)
    print(
        f"held out, {hours} hours: NIS {squares.sum() / degrees.sum():.2f} (1 expected); "
        f"autocorrelation after 1 h {np.abs(rho[0]).max():.2f}, after 24 h "
        f"{np.abs(rho[23]).max():.2f} at most; {white} of {e.shape[1]} channels white over a day "
        f"(Ljung-Box, 1 %); excess kurtosis {np.median(kurtosis(e)):.1f} in the median, "
        f"{kurtosis(e).max():.0f} at most"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kinds", nargs="+", default=["L", "F"], help="signals: L, F, P")
    parser.add_argument("--lags", type=int, default=2)
    asked = parser.parse_args()
    quiet, log = read_scada(FOLDER / "dataset03.csv"), read_scada(FOLDER / "dataset04.csv")
    until = 2 * len(quiet.hour) // 3
    model = identified(quiet, asked.kinds, asked.lags, until)
    held_out = part(quiet, until)
    print(f"{len(model.names)} signals, {asked.lags} lags, {len(model.switches)} switches")
    whiteness(model, asked.lags, held_out)
    first = int(np.argmax(log.attacked)) - asked.lags
    estimate = residuals(model, asked.lags, log)
    squares, degrees = normalised_squares(estimate.residual[:first], estimate.residual_cov[:first])
    print(
        f"dataset04 before its first attack, {first} hours: NIS {squares.sum() / degrees.sum():.2f}"
    )
    print("detector: S = (S_TTD + S_CLF) / 2, true positive and negative rates, false alarms an "
          "hour a day or more after an attack, hours to each alarm")  # fmt: skip
    for name, (s, false) in judged(model, asked.lags, held_out, log).items():
        delays = ", ".join(f"{d:g}" for d in s.delays)
        print(
            f"{name:15s} S {s.score:.3f} ({s.detection:.3f}, {s.classification:.3f}), "
            f"{s.true_positive:.3f}, {s.true_negative:.3f}, {false:.4f}; {delays}"
        )


if __name__ == "__main__":
    main()
