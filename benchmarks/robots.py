"""Two real robots (MRCLAM) whose landmarks and odometry lie: estimators beside each other.

    HOLDFAST_DATA=../shared/data python benchmarks/robots.py [--robots 2 3] [--estimators EKF nisme]

Scales and lag are fitted to the recorded truth of the first 200 s; the attacks start there. `NOISE`
is one choice for both robots, made with the whole unattacked drives in view.
RMSE is of the position, from 200 s to the end; its ratio is to the same estimator without attack.
One landmark's range is shifted by 1 m, each of the 15 in turn; two landmarks take turns every 10 s;
the odometry tells 1.2 times the speed.
"out": share of the falsified sightings that an estimator left out, and of those of them where
another landmark was seen within 1 s; "false": share of all other sightings that it left out. A gate
leaves out what is improbable, a bank what its most probable mode takes for falsified; "odometry":
share of the rows with a sighting at which that is the odometry.
"""

import argparse
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import process_time
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from holdfast import Observation
from holdfast.estimators import extended, nisme
from holdfast.parts import Estimator, Plant
from holdfast.plants.library import unicycle
from holdfast.shell.robot import Drive, read_drive, read_landmarks

FOLDER = Path(os.environ.get("HOLDFAST_DATA", "../shared/data")) / "mrclam6"
DT, FITTED, FROM = 0.1, 200.0, 20.0
NOISE = dict(range_sd=0.03, range_share=0.015, bearing_sd=0.02, speed_noise=0.016, turn_noise=0.03)
P0 = np.diag([0.01, 0.01, 0.001])
MISREAD = ("20", 254.0, 256.0)
"""Robot 3 sees landmark 11 and reads 20: four sightings, a bearing half a turn off."""

PRIOR = {"range": 1.0, "bearing": 1.0, "v": 0.1, "omega": 0.1}
"""How large an attack may well be: 1 m, 1 rad, 0.1 m/s, 0.1 rad/s."""
BEGINS, LASTS = 1e-3, 10.0
"""Attacks per second, and how many seconds one lasts on average. Their product is the share of
time that something is falsified beforehand, and so the budget of false accusations."""


def bank(plant: Plant, x0, P0, *, prior: float = 1.0, **settings) -> nisme.Nisme:
    """A mode for none, one for each landmark (range and bearing), one for the speed."""
    marks = [name.removeprefix("range:") for name in plant.outputs if name.startswith("range:")]
    modes = [[], *([f"range:{mark}", f"bearing:{mark}"] for mark in marks), ["v"]]
    sd = [prior * PRIOR[name.split(":")[0]] for name in plant.attacks]
    return nisme.build(plant, x0, P0, modes=modes, attack_prior_sd=sd, **settings)


def chained(plant: Plant, x0, P0, *, prior: float = 1.0, mixing: bool = True) -> nisme.Nisme:
    """The bank whose modes follow a chain: `BEGINS`, each mode alike, and `LASTS`."""
    modes = len(plant.outputs) // 2 + 2
    chain = np.full((modes, modes), DT * BEGINS / (modes - 1))
    chain[1:, 0] = DT / LASTS
    np.fill_diagonal(chain, 0.0)
    np.fill_diagonal(chain, 1.0 - chain.sum(1))
    settings = dict(transition=chain.tolist(), mixing=mixing, floor=1e-12)
    return bank(plant, x0, P0, prior=prior, **settings)


Make = Callable[[Plant, np.ndarray, np.ndarray], Estimator]
MAKERS: dict[str, Make] = {
    "EKF": extended.build,
    "EKF, gate 0.01": partial(extended.build, gate=0.01),
    "EKF, gate 0.001": partial(extended.build, gate=0.001),
    "nisme": chained,
    "nisme, prior x 10": partial(chained, prior=10.0),
    "nisme, prior / 10": partial(chained, prior=0.1),
    "nisme, not mixed": partial(chained, mixing=False),
    "nisme, floor alone": bank,
}


class Case(NamedTuple):
    """A drive, the plant fitted to its first 200 s, and how well that fits."""

    plant: Plant
    drive: Drive
    fit: dict[str, float]


class Found(NamedTuple):
    """What an estimator said at every row; ``out``: which samples it left out, ``drives``: whether
    it took the odometry for falsified.
    """

    x: np.ndarray
    P: np.ndarray
    residual: np.ndarray
    spread: np.ndarray
    out: np.ndarray
    drives: np.ndarray


def spread_of(e: np.ndarray) -> float:
    """The standard deviation of the bulk of e: outliers do not move it."""
    return float(1.4826 * np.median(np.abs(e - np.median(e))))


def case(robot: int) -> Case:
    """The robot's camera and odometry, fitted; the data stay as they are."""
    landmarks = read_landmarks(FOLDER)
    build = partial(
        unicycle.build, landmarks=landmarks.places.tolist(), names=landmarks.names, dt=DT,
        attacked=("range", "bearing", "odometry"),
    )  # fmt: skip
    raw = read_drive(FOLDER, robot, build())
    rows = raw.log.time < FITTED
    seen = np.asarray(raw.log.observation.seen)[rows, : len(landmarks.names)]
    ranges = np.asarray(raw.log.observation.y)[rows, : len(landmarks.names)]
    truth, u = raw.truth[rows], np.asarray(raw.log.observation.u)[rows]
    way = landmarks.places - truth[:, None, :2]
    ahead = np.cos(truth[:, 2:]) * way[..., 0] + np.sin(truth[:, 2:]) * way[..., 1]
    fit = {"range_scale": float(np.median((ranges / ahead)[seen]))}
    # what the robot really did: forwards along the mean heading of each row, and turned
    pose = np.vstack([raw.start, truth])
    step, heading = np.diff(pose, axis=0), 0.5 * (pose[1:, 2] + pose[:-1, 2])
    moved = np.stack([step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading), step[:, 2]], 1)
    each = round(1.0 / DT)

    def seconds(rates: np.ndarray) -> np.ndarray:
        whole = len(rates) // each * each
        return rates[:whole].reshape(-1, each, 2).sum(1)

    def slopes(lag: int) -> tuple[np.ndarray, float]:
        said, did = seconds(DT * u[: len(u) - lag]), seconds(moved[lag:])
        slope = np.sum(said * did, 0) / np.sum(said * said, 0)
        return slope, spread_of(did[:, 1] - slope[1] * said[:, 1])

    lag = min(range(6), key=lambda lag: slopes(lag)[1])
    fit["speed_scale"], fit["turn_scale"] = map(float, slopes(lag)[0])
    plant = build(measures="depth", **fit, **NOISE)
    return Case(plant, read_drive(FOLDER, robot, plant, lag * DT), fit | {"lag": lag * DT})


@eqx.filter_jit
def _scan(estimator: Estimator, observation: Observation):
    def row(state, sample):
        state, e = estimator.step(state, sample)
        said = (e.x, e.x_cov, e.residual, jnp.diagonal(e.residual_cov))
        return state, (*said, e.a if e.mode is None else e.mode)

    return jax.lax.scan(row, estimator.init()[0], observation)[1]


def filtered(make: Make, case: Case, observation: Observation) -> Found:
    estimator = make(case.plant, case.drive.start, P0)
    *said, told = _scan(estimator, jax.tree.map(jnp.asarray, observation))
    x, P, residual, spread = map(np.asarray, said)
    out, drives = np.zeros(residual.shape, bool), np.zeros(len(x), bool)
    if isinstance(estimator, nisme.Nisme):
        falsified = [mode.split("+") for mode in estimator.modes]
        out = np.array([[name in f for name in case.plant.outputs] for f in falsified])[told]
        out &= np.asarray(observation.seen)
        drives = np.array(["v" in f for f in falsified])[told]
    elif told is not None:
        out = np.asarray(told != 0)
    return Found(x, P, residual, spread, out, drives)


def error(case: Case, found: Found) -> np.ndarray:
    e = found.x - case.drive.truth
    e[:, 2] = np.mod(e[:, 2] + np.pi, 2 * np.pi) - np.pi
    return e


def rmse(case: Case, found: Found, start: float) -> tuple[float, float]:
    """Of position (m) and heading (rad), from ``start`` seconds on."""
    e = error(case, found)[case.drive.log.time >= start]
    return float(np.sqrt(np.mean(np.sum(e[:, :2] ** 2, 1)))), float(np.sqrt(np.mean(e[:, 2] ** 2)))


def without(drive: Drive, plant: Plant, name: str, start: float, stop: float) -> Drive:
    """The drive without the sightings of a landmark in a span of time."""
    o, time = drive.log.observation, drive.log.time
    gone = np.array([output.endswith(f":{name}") for output in plant.outputs])
    seen = np.asarray(o.seen) & ~(gone & ((time >= start) & (time < stop))[:, None])
    log = type(drive.log)(time, Observation.of(o.u, o.y, seen))
    return type(drive)(log, drive.truth, drive.start, drive.count)


def shifted(case: Case, outputs: list[str]) -> tuple[Observation, np.ndarray]:
    """1 m more on the ranges, which take turns every 10 s; and which sightings are falsified."""
    o, time = case.drive.log.observation, case.drive.log.time
    turn = ((time - FITTED) // 10).astype(int) % len(outputs)
    hit = np.zeros(np.shape(o.y), bool)
    for i, name in enumerate(outputs):
        hit[:, case.plant.outputs.index(name)] = (time >= FITTED) & (turn == i)
    hit &= np.asarray(o.seen)
    return Observation.of(o.u, np.asarray(o.y) + hit, o.seen), hit


def faster(case: Case) -> tuple[Observation, np.ndarray]:
    """Odometry that tells 1.2 times the speed; no sighting is falsified."""
    o = case.drive.log.observation
    u = np.asarray(o.u) * np.where(case.drive.log.time >= FITTED, 1.2, 1.0)[:, None] ** [1, 0]
    return Observation.of(u, o.y, o.seen), np.zeros(np.shape(o.y), bool)


def unattacked(case: Case) -> None:
    """What was fitted, how sound the data are, and every estimator on them."""
    o, plant = case.drive.log.observation, case.plant
    print("fitted", {key: round(value, 4) for key, value in case.fit.items()}, case.drive.count)
    seen, L = np.asarray(o.seen), len(plant.outputs) // 2
    model = jax.vmap(lambda x, u: plant.output(0, x, u, jnp.zeros(len(plant.attacks))))
    sd = jax.vmap(lambda x, u: jnp.sqrt(jnp.diagonal(plant.noise(0, x, u)[1])))
    at = jnp.asarray(case.drive.truth), jnp.asarray(o.u)
    apart = np.asarray(jax.vmap(plant.innovation)(jnp.asarray(o.y), model(*at)))
    share = apart / np.asarray(sd(*at))
    for kind, half in (("range", np.arange(2 * L) < L), ("bearing", np.arange(2 * L) >= L)):
        use = seen & half
        print(
            f"{kind} against the truth: sd of the bulk {spread_of(apart[use]):.4f}, all "
            f"{apart[use].std():.4f}, largest {np.abs(apart[use]).max():.3f}; of the sd assumed "
            f"{spread_of(share[use]):.2f}, beyond 3.3 of it {np.mean(np.abs(share[use]) > 3.3):.4f}"
        )
    for name, make in MAKERS.items():
        filtered(make, case, o)
        start = process_time()
        found = filtered(make, case, o)
        took = process_time() - start
        e, since = error(case, found), case.drive.log.time >= FROM
        position, heading = rmse(case, found, FROM)
        nees = np.einsum("ti,tij,tj->t", e, np.linalg.inv(found.P), e)[since]
        z = found.residual / np.sqrt(np.where(found.spread > 0, found.spread, 1.0))
        far, out = (
            [f"{np.mean(bad[:, k][seen[:, k]]):.4f}" for k in (slice(L), slice(L, None))]
            for bad in (np.abs(z) > 3.3, found.out)
        )
        print(
            f"{name}: RMSE {position:.3f} m, {heading:.3f} rad from {FROM:.0f} s, largest "
            f"{np.hypot(*e[since, :2].T).max():.2f} m; NEES mean {nees.mean():.1f}, median "
            f"{np.median(nees):.1f} (3, 2.4 expected); ranges, bearings with an innovation beyond "
            f"3.3 sd {', '.join(far)}; left out {', '.join(out)}; "
            f"{took / len(e) * 1e6:.0f} us of processor time a row"
        )


def sightings(case: Case, found: Found, seen: np.ndarray, hit: np.ndarray) -> str:
    """Which sightings an estimator left out, rightly and wrongly."""
    L = len(case.plant.outputs) // 2
    out, seen, hit = (v[:, :L] | v[:, L:] for v in (found.out, seen, hit))
    second = np.ones(2 * round(1.0 / DT) + 1)
    near = np.stack([np.convolve(column, second, "same") > 0 for column in seen.T], 1)
    beside = hit & (near.sum(1)[:, None] - near > 0)
    caught = f"out {out[hit].mean():.3f}, {out[beside].mean():.3f} " if hit.any() else ""
    odometry = f" odometry {found.drives[seen.any(1)].mean():.4f}" if found.drives.any() else ""
    return f"{caught}false {out[seen & ~hit].mean():.4f}{odometry}"


def attacked(case: Case) -> None:
    """The table: one row per attack, RMSE and its ratio for every estimator."""
    o = case.drive.log.observation
    none = np.zeros(np.shape(o.y), bool)
    ranges = [name for name in case.plant.outputs if name.startswith("range:")]
    most = sorted(ranges, key=lambda r: -np.asarray(o.seen)[:, case.plant.outputs.index(r)].sum())
    attacks = {"none": (o, none)} | {name: shifted(case, [name]) for name in ranges}
    attacks[f"{most[0]} and {most[1]} in turn"] = shifted(case, most[:2])
    attacks["odometry v x 1.2"] = faster(case)
    calm = {}
    for attack, (observation, hit) in attacks.items():
        cells = []
        for name, make in MAKERS.items():
            found = filtered(make, case, observation)
            now = rmse(case, found, FITTED)[0]
            cell = f"{now:.4f} x{now / calm.setdefault(name, now):.2f}"
            if found.out.any() or found.drives.any():
                cell += " " + sightings(case, found, np.asarray(o.seen), hit)
            cells.append(cell)
        print(f"{attack:24s} {hit.sum():4d} | {' | '.join(cells)}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", type=int, nargs="+", default=[2, 3])
    parser.add_argument("--estimators", nargs="+", choices=list(MAKERS), default=list(MAKERS))
    asked = parser.parse_args()
    MAKERS = {name: MAKERS[name] for name in asked.estimators}
    for robot in asked.robots:
        print(f"== robot {robot} | {' | '.join(MAKERS)}")
        recorded = case(robot)
        unattacked(recorded)
        attacked(recorded)
        if robot == 3:
            print("== robot 3 without the four misread sightings")
            clean = recorded._replace(drive=without(recorded.drive, recorded.plant, *MISREAD))
            unattacked(clean)
            attacked(clean)
