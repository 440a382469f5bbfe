"""DECODER, Section V-C2: a drone that follows a path by an estimate from spoofed samples."""

from typing import Any, NamedTuple

import numpy as np

from holdfast.attacks import hopping, sine
from holdfast.estimators import kalman, l1_kalman
from holdfast.papers.decoder_crafts import PLACES, WINDOW, Craft, as_it_is, circling, remedied
from holdfast.papers.decoder_flight import Air, Course, Flown, Oracle, Steered, air, flown, rms
from holdfast.papers.rows import Row, claim, claim_over_seeds, figure

SEEDS, STEPS = 16, 300
SWING, FREQUENCY, SD, START = 5.0, 0.05, 3.0, 5.0
"""The sine on p_x in m and Hz from ``START`` seconds on; the other attack's deviation in m."""
FIRST = round(START / 0.1)
THRESHOLD = 4.0
AS_BEFORE = 1.10
"""How much of the unattacked deviation is near enough."""
COUNTS = (3, 5, 8)


class Run(NamedTuple):
    """Per craft the course, its flights by estimator under attack, and those without."""

    courses: dict[str, Course]
    hit: dict[str, dict[str, Flown]]
    calm: dict[str, dict[str, Flown]]


def crafts() -> dict[str, Craft]:
    """The paper's three, and the remedied ones."""
    return {str(count): as_it_is(count) for count in COUNTS} | remedied()


def attacks(of: Craft) -> list[Any]:
    """The sine on the first p_x, and noise on one of all position sensors within reach."""
    return [
        sine.build(
            of.plant, amplitude=SWING, frequency=FREQUENCY, channel="sensor:p_x", start=START
        ),
        hopping.build(of.plant, count=1, sd=SD, channels=of.open, start=START),
    ]


def drive(seeds: int = SEEDS, steps: int = STEPS) -> Run:
    """All flights, of each with the same noises as without attack."""
    run = Run({}, {}, {})
    for name, of in crafts().items():
        wind = air(of.plant, attacks(of), seeds, steps)
        calm = wind._replace(e=np.zeros_like(wind.e))
        run.courses[name] = circling(of, steps)
        paper = name in map(str, COUNTS)
        for where, over in ((run.hit, wind), (run.calm, calm)):
            where[name] = _flights(of, run.courses[name], over, paper, name == "authenticated")
    return run


def _flights(of: Craft, course: Course, wind: Air, paper: bool, exact: bool) -> dict[str, Flown]:
    start = np.zeros(10), 0.01 * np.eye(10)

    def steer(estimator, steered: Steered = "estimate", oracle: Oracle = "none") -> Flown:
        return flown(
            of.plant, estimator, of.gain, course, wind, start=start[0], steered=steered,
            oracle=oracle,
        )  # fmt: skip

    filter_ = kalman.build(of.plant, *start)
    found = {"KF": steer(filter_), "oracle": steer(filter_, oracle="subtract")}
    if paper:
        raw = l1_kalman.build(of.plant, *start, window=WINDOW)
        found["KF+SE"], found["SE"] = steer(raw), steer(raw, "decoded")
        found["threshold"] = steer(l1_kalman.build(of.plant, *start, window=WINDOW, threshold=5.0))
        return found
    keys = {"window": WINDOW, "threshold": THRESHOLD, "trusted": of.trusted, "suspects": "gate"}
    found["l1"] = steer(l1_kalman.build(of.plant, *start, **keys))
    if exact:
        found["l0"] = steer(l1_kalman.build(of.plant, *start, norm="l0", **keys))
    return found


def strayed(run: Run, craft: str, name: str, *, calm: bool = False) -> np.ndarray:
    """Root mean square distance of the true place from the path, m, per seed."""
    flights = run.calm if calm else run.hit
    off = (flights[craft][name].x - run.courses[craft].x)[:, FIRST:][..., PLACES]
    return rms(off, (1, 2)) * np.sqrt(3.0)


def over_calm(run: Run, craft: str, name: str, to: str = "KF") -> np.ndarray:
    """The same over that of an unattacked drone steered by ``to``."""
    return strayed(run, craft, name) / strayed(run, craft, to, calm=True)


def judged(run: Run) -> list[Row]:
    """Section V-C2, Figs. 9 to 11, and what does work."""
    rows = [limit(), more_helps(run), figure_9(run), figure_10(run), beside(run), figure_11(run)]
    for name in remedied():
        rows += [out(run, name, label) for label in ("l1", "l0") if label in run.hit[name]]
    return rows


def limit() -> Row:
    """The most that p = 3 sensors allow."""
    found = int(np.floor(3 / 2 - 1))
    return claim(
        "Section V-C2", "the most errors that p = 3 sensors allow, floor(p/2 - 1)", 1, found,
        found == 1, "Proposition 4 has ceil(p/2 - 1), which is 1. That is what p allows: here a "
        f"position is seen by one sensor, and q = {as_it_is(3).found.any.upper}.",
    )  # fmt: skip


def more_helps(run: Run) -> Row:
    """From 3 to 8 sensors."""
    found = np.stack([over_calm(run, str(count), "KF+SE") for count in COUNTS], 1)
    mean = found.mean(0)
    q = [as_it_is(count).found.any.upper for count in COUNTS]
    return claim_over_seeds(
        "Section V-C2, more sensors", "with 5 and 8 sensors KF+SE follows the path perfectly: its "
        "deviation over KF's unattacked, n_y = 3, 5, 8", ["> 1", 1.0, 1.0], found,
        mean[1] <= AS_BEFORE and mean[2] <= AS_BEFORE,
        f"q = {q[0]}, {q[1]}, {q[2]} for any decoder: speeds and angles do not tell where the "
        "drone is. More positions do, or an authenticated one.",
    )  # fmt: skip


def figure_9(run: Run) -> Row:
    """E^ - e: KF's e^ is y - C x^."""
    found = []
    for count in COUNTS:
        for name in ("KF", "KF+SE"):
            flight, C = run.hit[str(count)][name], np.asarray(as_it_is(count).plant.C)
            e = _attack(run, str(count))
            said = flight.y - flight.estimate @ C.T if name == "KF" else flight.a
            found.append(rms((said - e)[:, FIRST:], (1, 2)) / rms(e[:, FIRST:], (1, 2)))
    per = np.stack(found, 1)
    mean = per.mean(0)
    return figure(
        "Fig. 9", "KF misses the attack, KF+SE finds it with n_y = 5 and 8: error of e^ over e, "
        "KF and KF+SE at n_y = 3, at 5, at 8", [None, None, None, 0.0, None, 0.0], per,
        mean[3] < 0.1 and mean[5] < 0.1,
    )  # fmt: skip


def _attack(run: Run, name: str) -> np.ndarray:
    of, flight = crafts()[name], run.hit[name]["KF"]
    seeds, steps = flight.x.shape[:2]
    return air(of.plant, attacks(of), seeds, steps).e


def figure_10(run: Run) -> Row:
    """How far the drone strays."""
    kalman_ = np.stack([over_calm(run, str(count), "KF") for count in COUNTS], 1)
    mean = kalman_.mean(0)
    return figure(
        "Fig. 10", "steered by KF the drone leaves the path whatever n_y: deviation over that "
        "without attack, n_y = 3, 5, 8", ["> 1"] * 3, kalman_, bool(np.all(mean > 3.0)),
        "KF+SE does so too: see Section V-C2, more sensors. Without attack, in m: "
        + ", ".join(f"{strayed(run, str(c), 'KF', calm=True).mean():.3f}" for c in COUNTS) + ".",
    )  # fmt: skip


def beside(run: Run) -> Row:
    """Other ways of steering with the paper's sensors."""
    names = ("SE", "threshold")
    found = np.stack([over_calm(run, "5", name) for name in names], 1)
    return claim_over_seeds(
        "Fig. 10, SE and threshold 5", "SE alone, and KF+SE with a threshold, n_y = 5: deviation "
        "over KF's without attack", [1.0, 1.0], found, bool(np.all(found.mean(0) <= AS_BEFORE)),
        "No treatment of the samples helps where one sensor alone knows the place.",
    )  # fmt: skip


def figure_11(run: Run) -> Row:
    """The axes."""
    off = (run.hit["3"]["KF"].x - run.courses["3"].x)[:, FIRST:][..., PLACES]
    along = rms(off, 1)
    mean = along.mean(0)
    both = strayed(run, "3", "KF+SE") / strayed(run, "3", "KF")
    return figure(
        "Fig. 11", "KF, n_y = 3: deviations are largest along x and z; KF+SE follows much more "
        "closely: deviation in m along x, y, z, and KF+SE's over KF's",
        ["large", "-", "large", "< .5"],
        np.column_stack([along, both]), bool(mean[2] > mean[1] and both.mean() < 0.5),
        "The sine is on p_x, the noise on all three alike: nothing singles out z.",
    )  # fmt: skip


def out(run: Run, craft: str, label: str) -> Row:
    """One remedy."""
    found = np.stack([over_calm(run, craft, label), over_calm(run, craft, label, label)], 1)
    return claim_over_seeds(
        f"Section V-C2, {craft}, {label}", f"true path within {AS_BEFORE - 1:.0%} of the "
        "unattacked deviation: over KF's without attack, over its own without attack",
        [f"<= {AS_BEFORE}"] * 2, found, bool(np.all(found.mean(0) <= AS_BEFORE)),
        f"{len(crafts()[craft].plant.outputs)} sensors as in Section V-C1. Largest over seeds: "
        f"{found.max(0)[0]:.3f}, {found.max(0)[1]:.3f}; KF there: "
        f"{over_calm(run, craft, 'KF').mean():.1f}.",
    )  # fmt: skip


def figures(run: Run) -> dict[str, Any]:
    """Figs. 10 and 11: the true p_x of drones with 3, 5, 8 sensors, and of the remedied ones."""
    from holdfast.report.paper_figures import Panel, stacked

    t = 0.1 * np.arange(1, run.courses["3"].x.shape[0] + 1)
    panels, away = [], {}
    for craft, flights in run.hit.items():
        path = run.courses[craft].x
        if "KF+SE" in flights:
            lines = {name: flights[name].x[0, :, 0] for name in ("KF", "KF+SE")}
            title = f"flown p_x (m), n_y = {craft}; truth: what is wanted"
            panels.append(Panel(title, {"truth": path[:, 0]} | lines))
        else:
            label = "l0" if "l0" in flights else "l1"
            off = (flights[label].x[0] - path)[:, PLACES]
            away[f"{craft}, {label}"] = np.sqrt(np.sum(off**2, 1))
    panels.append(Panel("KF+SE remedied: distance of the true place from the path (m)", away))
    return {"decoder-figure-11": stacked(t, panels)}
