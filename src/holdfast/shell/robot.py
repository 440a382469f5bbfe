"""A robot's drive of the MRCLAM data set, as a log for the `unicycle` plant beside its truth.

Samples keep their values. Odometry is integrated, so that each row has the mean v and omega
over its interval and no motion is lost; a sighting of a landmark goes into the row nearest to
its time, and whatever is left out is counted.

Source: Leung, Halpern, Kong and Liu (2011), *The UTIAS multi-robot cooperative localization
and mapping dataset*; the files state their columns and units.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from holdfast.parts import Plant
from holdfast.plants.library.unicycle import INPUTS
from holdfast.records import Observation
from holdfast.shell.errors import InputError, shown
from holdfast.shell.grid import Log, nearest_samples
from holdfast.shell.reading import DATA_LIMIT, decode, read_bytes

MOST_ROWS = 10_000_000


@dataclass(frozen=True)
class Landmarks:
    """What the landmarks are called (their subject number) and where they are, (L, 2) in m."""

    names: tuple[str, ...]
    places: np.ndarray


@dataclass(frozen=True)
class Count:
    """What became of the sightings: ``used`` lie in a row; ``duplicate`` had to leave their row
    to one of the same landmark nearer to its time; ``outside`` came before the first row or
    after the last; ``robots`` are of other robots, ``unknown`` of a barcode that nothing has.
    """

    used: int
    duplicate: int
    outside: int
    robots: int
    unknown: int


@dataclass(frozen=True)
class Drive:
    """A drive on the rows of a plant, and what belongs beside it.

    ``log.time`` counts seconds from the first odometry sample; row k lies at k dt. ``truth``
    (T, 3): x, y (m) and heading (rad, not wrapped) at the rows, ``start`` (3,) at time 0.
    """

    log: Log
    truth: np.ndarray
    start: np.ndarray
    count: Count


def read_landmarks(folder: str | Path) -> Landmarks:
    """The landmarks of `Landmark_Groundtruth.dat`, in its order.

    Raises `InputError` naming the file and the line.
    """
    path = Path(folder) / "Landmark_Groundtruth.dat"
    table = _table(path, ("subject", "x", "y", "x_sd", "y_sd"))
    names = _subjects(path, table[:, 0])
    if len(set(names)) != len(names):
        raise InputError(path, "subject", "a landmark twice", "each once")
    return Landmarks(tuple(map(str, names)), table[:, 1:3])


def read_drive(folder: str | Path, robot: int, plant: Plant, lag: float = 0.0) -> Drive:
    """The drive of one robot as observations of ``plant``, a `unicycle` of these landmarks.

    Reads `Robot{N}_Odometry.dat` (time, v, omega), `Robot{N}_Measurement.dat` (time, barcode,
    range, bearing), `Robot{N}_Groundtruth.dat` (time, x, y, heading) and `Barcodes.dat`. v and
    omega hold until the next odometry sample; ``lag``: seconds by which the robot's motion
    comes after what the odometry says of it. The rows end with the odometry or the ground
    truth, whichever ends first; the truth is linear between its samples.

    Raises `InputError` naming the file and the line, or what the plant should be.
    """
    folder = Path(folder)
    if plant.inputs != INPUTS:
        raise InputError(folder, "plant.inputs", shown(plant.inputs), shown(INPUTS))
    odometry = _timed(folder / f"Robot{robot}_Odometry.dat", ("v", "omega"))
    path = folder / f"Robot{robot}_Groundtruth.dat"
    truth = _timed(path, ("x", "y", "heading"))
    begin, end = odometry[0, 0], min(odometry[-1, 0], truth[-1, 0])
    if truth[0, 0] > begin or not end - begin >= plant.dt:
        span = f"{truth[0, 0]:.3f} to {truth[-1, 0]:.3f} s"
        raise InputError(path, "time", span, f"the drive that begins at {begin:.3f} s")
    steps = int((end - begin) / plant.dt)
    if steps > MOST_ROWS:
        raise InputError(path, "time", f"{end - begin:.3g} s", f"at most {MOST_ROWS} rows")
    time = plant.dt * np.arange(steps + 1)
    edges = begin + time
    known = truth[:, 1:].copy()
    known[:, 2] = np.unwrap(known[:, 2])
    poses = np.stack([np.interp(edges, truth[:, 0], column) for column in known.T], 1)
    y, seen, count = _sightings(folder, robot, plant, edges[1:])
    log = Log(time[1:], Observation.of(_held(odometry, edges - lag), y, seen))
    return Drive(log, poses[1:], poses[0], count)


def _held(odometry: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Mean v and omega between the edges, each held from its sample to the next."""
    stamps = odometry[:, 0]
    gone = np.zeros((len(stamps), 2))
    gone[1:] = np.cumsum(odometry[:-1, 1:] * np.diff(stamps)[:, None], 0)
    at_edges = np.stack([np.interp(edges, stamps, column) for column in gone.T], 1)
    return np.diff(at_edges, axis=0) / np.diff(edges)[:, None]


def _sightings(
    folder: Path, robot: int, plant: Plant, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Count]:
    """Ranges and bearings in the rows, which came, and what became of all sightings."""
    path = folder / f"Robot{robot}_Measurement.dat"
    table = _timed(path, ("barcode", "range", "bearing"))
    landmarks = read_landmarks(folder)
    subject_of = _barcodes(folder / "Barcodes.dat", landmarks.names)
    subjects = np.array([subject_of.get(code, -1) for code in table[:, 1]])
    marked = np.isin(subjects, [int(name) for name in landmarks.names])
    wanted = [f"{kind}:{name}" for kind in ("range", "bearing") for name in landmarks.names]
    if list(plant.outputs) != wanted:
        found = next((o for o in plant.outputs if o not in wanted), "others, or another order")
        raise InputError(folder, "plant.outputs", shown(found), f"{wanted[0]} to {wanted[-1]}")
    y = np.zeros((len(rows), len(wanted)))
    seen = np.zeros(y.shape, bool)
    used = inside = 0
    for i, name in enumerate(landmarks.names):
        mine = table[subjects == int(name)]
        taken, chosen, candidates = nearest_samples(mine[:, 0], rows[0], len(rows), plant.dt)
        columns = np.array([i, i + len(landmarks.names)])
        y[taken[:, None], columns], seen[taken[:, None], columns] = mine[chosen, 2:], True
        used, inside = used + len(chosen), inside + candidates
    return y, seen, Count(
        used=used,
        duplicate=inside - used,
        outside=int(marked.sum()) - inside,
        robots=int(((subjects >= 0) & ~marked).sum()),
        unknown=int((subjects < 0).sum()),
    )  # fmt: skip


def _barcodes(path: Path, needed: tuple[str, ...]) -> dict[float, int]:
    """Whose each barcode is; every landmark has one."""
    table = _table(path, ("subject", "barcode"))
    found = dict(zip(table[:, 1].tolist(), _subjects(path, table[:, 0]), strict=True))
    if len(found) != len(table):
        raise InputError(path, "barcode", "one barcode on two subjects", "each on one")
    bare = [name for name in needed if int(name) not in found.values()]
    if bare:
        raise InputError(path, "subject", f"no barcode of landmark {bare[0]}", "one for each")
    return found


def _subjects(path: Path, column: np.ndarray) -> list[int]:
    if np.any(column != np.rint(column)) or np.any(column < 0):
        raise InputError(path, "subject", "a number that is no whole one", "whole numbers")
    return [int(value) for value in column]


def _timed(path: Path, columns: tuple[str, ...]) -> np.ndarray:
    """A table whose first column is a time that does not run backwards."""
    table = _table(path, ("time", *columns))
    back = np.flatnonzero(np.diff(table[:, 0]) < 0)
    if len(back):
        before, after = table[back[0], 0], table[back[0] + 1, 0]
        raise InputError(
            path,
            f"sample {back[0] + 2}",
            f"{after:.3f} s after {before:.3f} s",
            "time that does not run backwards",
        )
    return table


def _table(path: Path, columns: tuple[str, ...]) -> np.ndarray:
    """The numbers of a `.dat` file: columns between blanks, lines that begin with # left out."""
    what = f"a table of {', '.join(columns)}"
    rows = []
    for number, line in enumerate(
        decode(read_bytes(path, DATA_LIMIT, what), path, what).splitlines(), 1
    ):
        cells = line.split()
        if not cells or cells[0].startswith("#"):
            continue
        if len(cells) != len(columns):
            raise InputError(path, f"line {number}", f"{len(cells)} numbers", what)
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError:
            raise InputError(path, f"line {number}", shown(line.strip()), what) from None
    table = np.array(rows).reshape(len(rows), len(columns))
    if not len(table) or not np.all(np.isfinite(table)):
        found = "a value that is not finite" if len(table) else "no numbers"
        raise InputError(path, "", found, what)
    return table
