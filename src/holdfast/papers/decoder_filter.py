"""DECODER, Section IV-C: a Kalman filter on samples that a decoder has cleaned.

On a plant where the l1 test holds for one attacked sensor per step: two axes of position and
speed, every state measured by three sensors. The attack hops; the oracle knows it.
"""

from typing import Any, NamedTuple

import numpy as np

from holdfast.analysis.correctable import Correctable, correctable
from holdfast.analysis.model import model_at
from holdfast.attacks import hopping, ramp
from holdfast.estimators import kalman, l1_kalman
from holdfast.papers.decoder_flight import Air, Flown, Oracle, air, flown, held, rms
from holdfast.papers.rows import Row, claim, claim_over_seeds, figure
from holdfast.parts import Estimator
from holdfast.plants.build import linear_plant
from holdfast.plants.library import quadrotor
from holdfast.plants.linear import LinearPlant

SEEDS, STEPS, WINDOW = 16, 300, 8
SENSORS, SD, ATTACK = 3, 0.05, 3.0
RATE = 0.5
"""Of Fig. 3's attack that increases with time, in m/s."""
SETTLED = 20
"""Rows that are left out: the filter then has settled, and the decoder's window is full."""
WITHOUT, ABOVE_ORACLE = 1.05, 1.20
"""How far above Kalman without attack, and above the oracle under attack, is good enough."""
ROUNDING = 1e-9
ORACLES: dict[str, Oracle] = {"oracle": "subtract", "oracle, left out": "leave out"}
KEPT = ("5, subtracted", "5, left out", "5, inflated")


class Run(NamedTuple):
    """Every estimator's flights without attack, under hopping attacks and under a ramp."""

    window: Correctable
    plant: LinearPlant
    noise: Air
    attack: np.ndarray
    clean: dict[str, Flown]
    hopping: dict[str, Flown]
    ramp: dict[str, Flown]


def plant() -> LinearPlant:
    """Two axes, each state measured by three sensors."""
    states = ["east", "east_speed", "north", "north_speed"]
    return linear_plant(
        time="discrete", dt=0.1,
        A=np.kron(np.eye(2), [[1.0, 0.1], [0.0, 0.98]]), B=np.zeros((4, 0)),
        C=np.repeat(np.eye(4), SENSORS, 0),
        Q=np.diag([1e-5, 1e-3, 1e-5, 1e-3]), R=SD**2 * np.eye(4 * SENSORS),
        states=states, inputs=[],
        outputs=[f"{state}_{i + 1}" for state in states for i in range(SENSORS)],
    )  # fmt: skip


def contest(of: LinearPlant, window: int = WINDOW) -> dict[str, Estimator]:
    """KF and the paper's combination, and the combination with a threshold of 5 sigma."""
    start = np.zeros(4), 0.01 * np.eye(4)
    suspects = dict(zip(KEPT, ("subtract", "gate", "inflate"), strict=True))
    return {
        "KF": kalman.build(of, *start),
        "SE+KF": l1_kalman.build(of, *start, window=window),
        **{
            name: l1_kalman.build(of, *start, window=window, threshold=5.0, suspects=way)
            for name, way in suspects.items()
        },
    }


def drive(seeds: int = SEEDS, steps: int = STEPS) -> Run:
    """All flights; the noises are the same in each."""
    of = plant()
    nothing, course = np.zeros((0, 4)), held(of, steps)
    sensors = [f"sensor:{name}" for name in of.outputs]
    hops = air(of, [hopping.build(of, count=1, sd=ATTACK, channels=sensors)], seeds, steps)
    rises = air(of, [ramp.build(of, rate=RATE, channel=sensors[0])], seeds, steps).e
    calm = hops._replace(e=np.zeros_like(hops.e))
    found: list[dict[str, Flown]] = []
    for wind in (calm, hops, calm._replace(e=rises)):
        flights = {name: flown(of, one, nothing, course, wind) for name, one in contest(of).items()}
        # the decoder inside the raw form is SE alone
        flights["SE"] = flights["SE+KF"]._replace(estimate=flights["SE+KF"].decoded)
        for name, oracle in ORACLES.items():
            filter_ = kalman.build(of, np.zeros(4), 0.01 * np.eye(4))
            flights[name] = flown(of, filter_, nothing, course, wind, oracle=oracle)
        found.append(flights)
    window = correctable(model_at(of, np.zeros(4)), WINDOW)
    return Run(window, of, calm, hops.e, *found)


def error(flight: Flown, first: int = SETTLED, last: int | None = None) -> np.ndarray:
    """The root mean square error of the state, per seed."""
    return rms((flight.estimate - flight.x)[:, first:last], (1, 2))


def ratio(flights: dict[str, Flown], name: str, to: dict[str, Flown], other: str) -> np.ndarray:
    """Of two errors, per seed."""
    return error(flights[name]) / error(to[other])


def judged(run: Run) -> list[Row]:
    """The rows of Section IV-C."""
    return [
        equation_14(),
        figure_3(run),
        kalman_fails(run),
        algorithm_1(run),
        refilters(run),
        until_the_window_is_full(run),
        *(kept(run, name) for name in KEPT),
        noise_left(run),
        whiteness(run),
    ]


def equation_14() -> Row:
    """The second line's left-hand side."""
    of = quadrotor.build()
    sizes = [len(of.inputs), len(of.outputs)]
    return claim(
        "(14)", "second line: u = C x + e + v: entries of u and of C x, Section V's quadrotor with "
        "5 sensors", "equal", sizes, sizes[0] == sizes[1],
        "A misprint: the measurement y, not the input, is C x + e + v, as Algorithm 1 has it.",
    )  # fmt: skip


def figure_3(run: Run) -> Row:
    """The sketch, as a run: an attack on one sensor that grows with time."""
    names = ("KF", "SE", "SE+KF", KEPT[1])
    over = np.stack([ratio(run.ramp, name, run.clean, "KF") for name in names], 1)
    mean = over.mean(0)
    return figure(
        "Fig. 3", "one sensor's attack grows with time: KF fails, SE errs at times, SE+KF tracks "
        "perfectly; error over KF's unattacked, and threshold 5", [None, None, 1.0, None],
        over, mean[0] > 3.0 and mean[2] < mean[1] and mean[2] < WITHOUT,
        f"{RATE:g} m/s on one of three sensors of a position. KF fails; SE+KF is no better than "
        "SE, as it filters nothing but SE's own answer. With a threshold it does track.",
    )  # fmt: skip


def kalman_fails(run: Run) -> Row:
    """KF with the attack taken for noise."""
    times = ratio(run.hopping, "KF", run.clean, "KF")
    return claim_over_seeds(
        "Section IV-C", "a KF is expected to fail under attacks that Gaussian noise models poorly: "
        "error under hopping attacks over that without", "> 1", times, times.min() > 3.0,
        f"One of {len(run.plant.outputs)} sensors at each step, sd {ATTACK:g} against noise of "
        f"{SD:g}.",
    )  # fmt: skip


def algorithm_1(run: Run) -> Row:
    """The raw form beside Kalman and the decoder alone."""
    found = np.stack(
        [
            ratio(run.clean, "SE+KF", run.clean, "KF"),
            ratio(run.hopping, "SE+KF", run.hopping, "oracle"),
            ratio(run.hopping, "SE+KF", run.hopping, "SE"),
        ],
        1,
    )
    mean = found.mean(0)
    return claim_over_seeds(
        "Algorithm 1", "improves performance: error over KF's without attack; under hopping ones "
        "over the oracle's, and over SE's", ["1", "1", "< 1"], found,
        mean[0] <= WITHOUT and mean[1] <= ABOVE_ORACLE and mean[2] < 1.0,
        f"The l1 test holds here (q = {run.window.l1.lower}, worst ratio "
        f"{run.window.upper[0]:.2f}): the decoder is not at its limit. RMSE without attack and "
        f"under: KF {_both(run, 'KF')}, SE {_both(run, 'SE')}, SE+KF {_both(run, 'SE+KF')}; "
        f"oracle {error(run.hopping['oracle']).mean():.4f}.",
    )  # fmt: skip


def _both(run: Run, name: str) -> str:
    found = (error(flights[name]).mean() for flights in (run.clean, run.hopping))
    return " and ".join(f"{one:.4f}" for one in found)


def refilters(run: Run) -> Row:
    """Line 8 of the algorithm with no threshold: y - e^ against C x of the decoder."""
    decoder, raw = run.hopping["SE"], run.hopping["SE+KF"]
    told = (raw.y - raw.a)[:, WINDOW:]
    off = float(np.max(np.abs(told - decoder.estimate[:, WINDOW:] @ np.asarray(run.plant.C).T)))
    return claim(
        "Algorithm 1, line 8", "y - e^ is a measurement with noise e - e^ + v: its largest "
        "distance from C x^ of the decoder", "> 0", off, off > ROUNDING,
        "y - e^ = C x^_SE to rounding: the filter sees no sample at all, only the decoder's "
        "answer, which it takes for one with noise of covariance R.",
    )  # fmt: skip


def until_the_window_is_full(run: Run) -> Row:
    """Lines 3 to 7."""
    early = [error(run.hopping[name], 0, WINDOW - 1) for name in ("SE+KF", "KF")]
    over = early[0] / early[1]
    return claim_over_seeds(
        "Algorithm 1, lines 3 to 7", "before t = T the attack is taken for 0: error of SE+KF there "
        "over KF's", 1.0, over, np.max(np.abs(over - 1.0)) < ROUNDING,
        "Nothing protects these rows: the product says NOT_READY.",
    )  # fmt: skip


def kept(run: Run, name: str) -> Row:
    """The combination with a threshold, one way of treating what is over it."""
    found = np.stack(
        [
            ratio(run.clean, name, run.clean, "KF"),
            ratio(run.hopping, name, run.hopping, "oracle"),
        ],
        1,
    )
    mean = found.mean(0)
    return claim_over_seeds(
        f"Algorithm 1, threshold {name}", "what is over 5 sigma alone is an attack: error over "
        "KF's without attack, and over the oracle's under hopping ones",
        [f"<= {WITHOUT}", f"<= {ABOVE_ORACLE}"], found,
        mean[0] <= WITHOUT and mean[1] <= ABOVE_ORACLE,
        f"RMSE without attack and under: {_both(run, name)}. In place of the paper's claim, that "
        "of the product. The oracle that knows only which samples are attacked: "
        f"{ratio(run.hopping, 'oracle, left out', run.hopping, 'oracle').mean():.3f}.",
    )  # fmt: skip


def _left(run: Run, name: str) -> tuple[np.ndarray, np.ndarray]:
    """V~ = e - e^ + v and v after the window has filled."""
    flight = run.hopping[name]
    left = flight.y - flight.a - flight.x @ np.asarray(run.plant.C).T
    return left[:, SETTLED:], run.noise.v[:, SETTLED:]


def noise_left(run: Run) -> Row:
    """How many samples have v~ = v."""
    raw, kept_ = (
        np.mean(np.abs(left - v) < ROUNDING, (1, 2))
        for left, v in (_left(run, name) for name in ("SE+KF", KEPT[0]))
    )
    return claim_over_seeds(
        "Section IV-C, v~ = v", "e^ is usually e, so that v~ = v: share of the samples where it "
        "is, raw and with threshold 5", ["most", "-"], np.stack([raw, kept_], 1), raw.mean() > 0.5,
        "With noise v, e^ = e + v - C (x^ - x): equal to e only at the few samples that the "
        "decoder meets exactly. What is under the threshold is left as it is.",
    )  # fmt: skip


def whiteness(run: Run) -> Row:
    """How alike v~ is from one step to the next."""
    found = []
    for name in ("SE+KF", KEPT[0]):
        left, _ = _left(run, name)
        found.append(np.mean(left[:, 1:] * left[:, :-1], (1, 2)) / np.mean(left**2, (1, 2)))
    return claim_over_seeds(
        "Section IV-C, whiteness", "v~ is close to white noise: its correlation with the next "
        "step's, raw and with threshold 5", [0.0, "-"], np.stack(found, 1),
        found[0].mean() < 0.2,
        "Windows of T rows have T - 1 in common, so that the decoder's errors are alike; KF takes "
        "them for independent and trusts them too much.",
    )  # fmt: skip


def figures(run: Run) -> dict[str, Any]:
    """Fig. 3: the position whose sensor is attacked, and the error under hopping attacks."""
    from holdfast.report.paper_figures import Panel, stacked

    names = ("KF", "SE", "SE+KF", KEPT[1])
    labels = dict(zip(names, ("KF", "SE", "SE+KF", "SE+KF, threshold 5"), strict=True))
    t = 0.1 * np.arange(1, run.attack.shape[1] + 1)
    truth = {"truth": run.ramp["KF"].x[0, :, 0]}
    rising = {labels[name]: run.ramp[name].estimate[0, :, 0] for name in names}
    errors = {
        labels[name]: rms(run.hopping[name].estimate - run.hopping[name].x, 2)[0] for name in names
    }
    return {
        "decoder-figure-3": stacked(
            t,
            [
                Panel(f"position (m), one sensor of three drifts by {RATE:g} m/s", truth | rising),
                Panel("root mean square error, one of twelve sensors attacked", errors, log=True),
            ],
        )
    }
