"""`holdfast arena`: every estimator and detector against every attack, on plants of all kinds."""

import sys
import time
import warnings
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path

import pandas as pd

from holdfast.shell import runtime
from holdfast.shell.arena_cases import cases_of
from holdfast.shell.campaigning import INTERRUPTED, study_results
from holdfast.shell.errors import InputError, one_of
from holdfast.shell.progress import progress
from holdfast.shell.writing import check_place, unwritable, write_figures, write_text

GROUNDS = "holdfast.shell.grounds"
"""A folder for each plant: the scenario, and the studies on it."""
SCENARIO = "scenario.toml"
FIRST = "estimators"
"""The comparison that every plant has."""
QUICK = "vehicle"
"""The plant that is run where there is little time."""


def grounds() -> dict[str, list[str]]:
    """The studies of each plant by name, the comparison of estimators first."""
    found = {}
    for folder in sorted(resources.files(GROUNDS).iterdir(), key=lambda f: f.name):
        if folder.is_dir() and folder.joinpath(SCENARIO).is_file():
            names = sorted(
                file.name.removesuffix(".toml")
                for file in folder.iterdir()
                if file.name.endswith(".toml") and file.name != SCENARIO
            )
            found[folder.name] = sorted(names, key=lambda name: name != FIRST)
    return found


def arena(names: list[str] | None, output: str | None, quick: bool) -> None:
    """Run the arena; print its tables, or write them with everything behind them."""
    from holdfast.report.arena_tables import markdown

    runtime.configure()
    start = time.perf_counter()
    try:
        found = run_arena(names, output, quick=quick, told=_say)
    except KeyboardInterrupt:
        if output is not None:
            _say(f"interrupted: what is finished is in {output}; the same command goes on")
        sys.exit(INTERRUPTED)
    minutes = (time.perf_counter() - start) / 60
    if output is None:
        print(markdown(found))
    else:
        _write(Path(output), found)
        _say(str(Path(output) / "report.html"))
    _say(f"{len(found)} cases in {minutes:.1f} min")


def run_arena(
    names: list[str] | None = None,
    output: str | Path | None = None,
    *,
    quick: bool = False,
    told: Callable[[str], None] = lambda line: None,
) -> pd.DataFrame:
    """A row per case: plant, attack, estimator, detector, truth, and what came of it.

    The columns are those of `holdfast.shell.arena_cases.cases_of`. ``names``: plants, all of them
    unless given; ``quick``: one of them. ``output``: a folder that gets a copy of each study and
    its campaign, and is gone on with. ``told`` of each study that is begun.

    Raises `InputError` for a plant that there is not, and as `run_study`.
    """
    if output is not None:
        check_place(output)
    if quick and names:
        raise InputError("arena", "--quick", f"plants as well ({', '.join(names)})", "one of both")
    wanted = list(_wanted([QUICK] if quick else names))
    tables = []
    with progress("studies", len(wanted)) as advance:
        for ground, study in wanted:
            told(f"{ground}: {study}")
            tables.append(_ran(ground, study, None if output is None else Path(output)))
            runtime.forget_programs()
            advance(1)
    return pd.concat(tables, ignore_index=True)


def _wanted(names: list[str] | None) -> Iterator[tuple[str, str]]:
    known = grounds()
    for name in names or known:
        if name not in known:
            raise InputError("arena", "", f"the plant {name!r}", one_of(known, name))
        yield from ((name, study) for study in known[name])


def _ran(ground: str, name: str, output: Path | None) -> pd.DataFrame:
    with resources.as_file(resources.files(GROUNDS).joinpath(ground)) as source:
        folder, target = source, None
        if output is not None:
            # what ran stands beside its results, and runs again by itself
            folder, target = output / ground, output / ground / name
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise unwritable(folder, error) from None
            for file in (SCENARIO, f"{name}.toml"):
                write_text(folder / file, (source / file).read_text("utf-8"))
        with warnings.catch_warnings():
            # a large bank is not calibrated: said once is enough, not for every attack
            warnings.filterwarnings(
                "ignore", message=".*too dear to simulate", category=UserWarning
            )
            prepared, result = study_results(folder / f"{name}.toml", target)
    return cases_of(ground, name, prepared, result)


def _write(folder: Path, found: pd.DataFrame) -> None:
    from holdfast.report.arena_figures import figures
    from holdfast.report.arena_page import page
    from holdfast.report.arena_tables import markdown

    write_text(folder / "cases.csv", found.to_csv(index=False))
    write_text(folder / "arena.md", markdown(found))
    write_figures(folder, figures(found))
    write_text(folder / "report.html", page(found))


def _say(line: str) -> None:
    print(line, file=sys.stderr)
