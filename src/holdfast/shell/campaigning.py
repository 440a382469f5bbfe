"""`holdfast campaign`: a study run block by block, resumed where it was left, and reported."""

import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import rich.console
import rich.table
import xarray as xr

from holdfast import __version__
from holdfast.campaign.blocks import BLOCK, Block, single
from holdfast.campaign.dataset import campaign_dataset
from holdfast.shell import runtime
from holdfast.shell.block_files import BlockFiles
from holdfast.shell.errors import InputError
from holdfast.shell.executors import Cluster, Local, Task
from holdfast.shell.points import Prepared, prepare
from holdfast.shell.progress import progress
from holdfast.shell.reading import size_in_words
from holdfast.shell.study import Study, read_study
from holdfast.shell.traces import STORE, check_wanted, store_bytes, write_traces
from holdfast.shell.writing import check_place, replacing, write_figures, write_text

MEMORY = 3 * 2**30
"""Bytes that the blocks under way may take together."""
FILES_PER_POINT = 16
"""Files that the blocks of a point go into, if not more are needed to lose little on a stop."""
MOST_BLOCKS = 64
"""Blocks of a file at most."""
INTERRUPTED = 130
"""Exit code after an interrupt, as shells have it."""

Found = dict[tuple[tuple[int, ...], int], Block]


def campaign(
    path: str, output: str | None, scheduler: str | None, workers: int | None, allow_python: bool
) -> None:
    """Run a study, or go on with it; write its results, or print their summary."""
    runtime.configure()
    try:
        result = run_study(
            path, output, scheduler=scheduler, workers=workers, allow_python=allow_python, told=_say
        )
    except KeyboardInterrupt:
        if output is not None:
            _say(f"interrupted: finished blocks are in {output}; the same command goes on")
        sys.exit(INTERRUPTED)
    if output is None:
        _print(result)
    else:
        _say(str(Path(output) / "report.html"))


def run_study(
    path: str | Path,
    output: str | Path | None = None,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    allow_python: bool = False,
    told: Callable[[str], None] = lambda line: None,
) -> xr.Dataset:
    """The scores of every run of a study file, and their summary.

    ``output``: a folder for blocks, results and report; what it holds of the same study is
    gone on with. ``scheduler``: the address of a Dask scheduler, else ``workers`` threads here
    (one per core unless given). ``told`` of what is about to be run.

    Raises `holdfast.shell.errors.InputError`: file, key, what was found, what was expected.
    """
    return study_results(
        path, output, scheduler=scheduler, workers=workers, allow_python=allow_python, told=told
    )[1]


def study_results(
    path: str | Path,
    output: str | Path | None,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    allow_python: bool = False,
    told: Callable[[str], None] = lambda line: None,
) -> tuple[Prepared, xr.Dataset]:
    """What `run_study` runs, and what it gives."""
    if output is not None:
        check_place(output)
    study = read_study(path)
    check_wanted(study, output)
    files = None if output is None else BlockFiles(output, study)
    with progress("points", len(study.points)) as advance:
        prepared = prepare(study, allow_python, advance=lambda: advance(1))
    size = store_bytes(prepared)
    executor: Local | Cluster
    if scheduler is not None:
        executor = Cluster(prepared, scheduler, allow_python)
    else:
        executor = Local(prepared, _threads(prepared, workers))
    if files is not None:
        files.begin()
    if size:
        told(f"records of {_counted(study.settings.traces, 'run')} of each point to {STORE}, "
             f"about {size_in_words(size)} before compression")  # fmt: skip
    found = {} if files is None else files.read()
    try:
        seconds, made = _run(prepared, executor, files, found, told)
    finally:
        if files is not None:
            files.write_manifest()
    result = _dataset(prepared, found, _attrs(study, output, seconds, made, prepared))
    if files is not None:
        _write(files, result)
        with progress("records", study.settings.traces * len(study.points)) as advance:
            write_traces(files, prepared, lambda: advance(1))
    return prepared, result


def _say(line: str) -> None:
    print(line, file=sys.stderr)


def _run(
    prepared: Prepared,
    executor: Local | Cluster,
    files: BlockFiles | None,
    found: Found,
    told: Callable[[str], None],
) -> tuple[float, int]:
    """Compute the blocks that are not there yet into ``found``; seconds, and runs made."""
    study = prepared.study
    runs, points = study.settings.runs, study.points
    blocks = math.ceil(runs / BLOCK)
    per_file = min(MOST_BLOCKS, math.ceil(blocks / FILES_PER_POINT))
    tasks = list(_tasks(prepared, found, blocks, per_file))
    kept = sum(len(block.scores["rows"]) for block in found.values())
    for line in _plan(prepared, executor, per_file, kept):
        told(line)
    start, made = time.perf_counter(), 0
    with progress("runs", runs * len(points), kept) as advance:
        for task, done in executor.run(tasks):
            point = points[task.point]
            if files is not None:
                files.write(point, task.first, done)
            for number, block in enumerate(done, task.first):
                found[point, number] = block
                made += len(block.scores["rows"])
                advance(len(block.scores["rows"]))
    return time.perf_counter() - start, made


def _tasks(prepared: Prepared, found: Found, blocks: int, per_file: int) -> Iterator[Task]:
    """Neighbouring blocks that are missing, ``per_file`` at most in a task."""
    for number, point in enumerate(prepared.study.points):
        missing = [i for i in range(blocks) if (point, i) not in found]
        while missing:
            first, count = missing[0], 1
            while count < min(per_file, len(missing)) and missing[count] == first + count:
                count += 1
            yield Task(number, first, count)
            missing = missing[count:]


def _threads(prepared: Prepared, wanted: int | None) -> int:
    """Blocks at a time: as many as there are cores, as long as memory lasts."""
    most = max(1, MEMORY // block_bytes(prepared))
    return min(wanted or runtime.cores(), most)


def block_bytes(prepared: Prepared) -> int:
    """Bytes that the records of the largest block take."""

    def size(case) -> int:
        record: Any = eqx.filter_eval_shape(single, case, jax.random.key(0), 0)
        leaves = jax.tree.leaves(record)
        return BLOCK * sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in leaves)

    shapes = {(jax.tree.structure(case), case.steps): case for case in prepared.cases}
    largest = max(size(case) for case in shapes.values())
    if largest > 4 * MEMORY:
        raise InputError(
            prepared.study.path,
            "study.steps",
            f"blocks of {size_in_words(largest)}",
            f"fewer steps: {BLOCK} runs go side by side, in {size_in_words(4 * MEMORY)} at most",
        )
    return largest


def _plan(prepared: Prepared, executor: Local | Cluster, per_file: int, kept: int) -> list[str]:
    """What is about to be run, in lines."""
    study, steps = prepared.study, max(case.steps for case in prepared.cases)
    lines = [
        f"{_counted(len(study.points), 'point')} of {study.settings.runs} runs, {steps} steps; "
        f"{_counted(prepared.programs, 'program')} to compile",
        f"blocks of {BLOCK} runs, {per_file} to a file, {executor.workers} at a time, "
        f"about {size_in_words(block_bytes(prepared))} each",
    ]
    if kept:
        lines.append(
            f"going on: {kept} of {study.settings.runs * len(study.points)} runs are there"
        )
    return lines


def _counted(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"


def _attrs(
    study: Study, output: str | Path | None, seconds: float, made: int, prepared: Prepared
) -> dict[str, Any]:
    steps = max(case.steps for case in prepared.cases)
    return {
        "study": Path(study.path).stem,
        "scenario": Path(study.scenario_path).name,
        "runs": study.settings.runs,
        "points": len(study.points),
        "steps": steps,
        "seed": study.settings.seed,
        "holdfast": __version__,
        "command": f"holdfast campaign {Path(study.path).name}"
        + ("" if output is None else f" -o {Path(output).name}"),
        "microseconds_per_step": 1e6 * seconds / (made * steps) if made else math.nan,
        "bytes_per_step": block_bytes(prepared) / (BLOCK * steps),
    }


def _dataset(prepared: Prepared, found: Found, attrs: dict[str, Any]) -> xr.Dataset:
    study = prepared.study
    blocks = math.ceil(study.settings.runs / BLOCK)
    by_point = {p: [found[p, i] for i in range(blocks)] for p in study.points}
    plants = [case.scenario.plant for case in prepared.cases]
    names = {
        point: {"state": plant.states, "attack": plant.attacks}
        for point, plant in zip(study.points, plants, strict=True)
    }
    axes = {axis.name: axis.labels for axis in study.axes}
    return campaign_dataset(axes, by_point, names, attrs)


def _write(files: BlockFiles, result: xr.Dataset) -> None:
    from holdfast.report.campaign_figures import figures
    from holdfast.report.campaign_page import page

    packed = {name: {"zlib": True, "complevel": 4} for name in result.data_vars}
    with replacing(files.folder / "result.nc") as temporary:
        result.to_netcdf(temporary, engine="h5netcdf", encoding=packed)
    write_text(files.folder / "summary.csv", _summary_table(result).to_csv(index=False))
    write_figures(files.folder, figures(result))
    write_text(files.folder / "report.html", page(result))
    files.write_manifest()


def _summary_table(result: xr.Dataset) -> Any:
    """A row per point and score."""
    table = result.summary.to_dataset("statistic").drop_vars("unit").to_dataframe()
    return table.reset_index().dropna(how="all", subset=list(result.statistic.values))


def _print(result: xr.Dataset) -> None:
    table = _summary_table(result)
    shown = rich.table.Table(*table.columns, box=None, pad_edge=False)
    for row in table.itertuples(index=False):
        shown.add_row(*(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row))
    console = rich.console.Console()
    if not console.is_terminal:
        console.width = 160
    console.print(shown)
