"""The `holdfast` command. Whatever needs JAX is imported inside a command."""

import sys
import warnings
from typing import Annotated, Literal

import typer

from holdfast.shell.errors import InputError, one_line

app = typer.Typer(
    name="holdfast",
    help="State estimation that holds when sensors and actuators lie.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

ScenarioArgument = Annotated[str, typer.Argument(help="Scenario file (TOML).", show_default=False)]
AllowPython = Annotated[
    bool,
    typer.Option("--allow-python", help='Let kind = "python" run code that the scenario names.'),
]


@app.command()
def replay(
    scenario: ScenarioArgument,
    log: Annotated[
        str,
        typer.Argument(
            help="Recorded log: .csv, .npz, .nc, .ulg, a folder of PX4 topics, or - for stdin.",
            show_default=False,
        ),
    ],
    output: Annotated[
        str | None,
        typer.Option(
            "-o",
            help="est.csv, est.nc, or a folder for a report. Default: CSV to standard output.",
            show_default=False,
        ),
    ] = None,
    allow_python: AllowPython = False,
) -> None:
    """Estimate and detect over a recorded log."""
    from holdfast.shell import commands

    commands.replay(scenario, log, output, allow_python)


@app.command()
def run(
    scenario: ScenarioArgument,
    runs: Annotated[
        int | None,
        typer.Option("--runs", min=1, help="Number of runs; default the scenario's."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, help="Seed of the noise; default the scenario's."),
    ] = None,
    output: Annotated[
        str | None,
        typer.Option("-o", help="Folder for the report. Default: print the scores."),
    ] = None,
    allow_python: AllowPython = False,
) -> None:
    """Simulate plant, attack, estimator and detector."""
    from holdfast.shell import commands

    commands.run(scenario, runs, seed, output, allow_python)


@app.command()
def analyse(
    scenario: ScenarioArgument,
    compromised: Annotated[
        str | None,
        typer.Option(
            "--compromised",
            help="Outputs that a stealthy attacker alters: A,B or all.",
            show_default=False,
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="JSON to standard output, and nothing else.")
    ] = False,
    allow_python: AllowPython = False,
) -> None:
    """Say what can be said before any data: observability, attacks, sensors to add."""
    from holdfast.shell import analysing

    analysing.analyse(scenario, compromised, as_json, allow_python)


Compromised = Annotated[
    str | None,
    typer.Option(
        "--compromised", help="Outputs that the attacker alters: A,B or all.", show_default=False
    ),
]
DetectorName = Annotated[
    Literal["chi_square", "windowed", "sprt"],
    typer.Option("--detector", help="The test that the attacker must not raise."),
]
Epsilon = Annotated[
    float, typer.Option("--epsilon", help="By how much he may raise its alarm probability.")
]
Level = Annotated[
    float | None,
    typer.Option(
        "--level", help="False-alarm probability; default the scenario's.", show_default=False
    ),
]
Length = Annotated[
    int | None,
    typer.Option(
        "--length", min=1, help="Rows of a windowed test; default the scenario's, or 10.",
        show_default=False,
    ),
]  # fmt: skip
Functional = Annotated[
    str | None,
    typer.Option(
        "--functional", help="CSV matrix whose image of the error counts. Default: all of it.",
        show_default=False,
    ),
]  # fmt: skip
Unaware = Annotated[
    bool, typer.Option("--unaware", help="The attacker does not know when messages are checked.")
]
AsJson = Annotated[bool, typer.Option("--json", help="JSON to standard output, and nothing else.")]
Folder = Annotated[
    str | None,
    typer.Option("-o", help="Folder for the JSON and a picture.", show_default=False),
]


@app.command()
def reach(
    scenario: ScenarioArgument,
    steps: Annotated[int, typer.Option("--steps", min=1, max=10**6, help="How many steps.")],
    compromised: Compromised = None,
    enforce: Annotated[
        list[str] | None,
        typer.Option(
            "--enforce",
            help="every=L,for=F,first=K: authenticated steps; NAME:every=.. for one output, "
            "repeatable. Default: the scenario's.",
            show_default=False,
        ),
    ] = None,
    detector: DetectorName = "chi_square",
    epsilon: Epsilon = 0.001,
    level: Level = None,
    length: Length = None,
    gamma: Annotated[
        float, typer.Option("--gamma", help="Times the covariance, added to the ellipsoids.")
    ] = 0.0,
    functional: Functional = None,
    unaware: Unaware = False,
    tight: Annotated[
        bool, typer.Option("--tight", help="sprt: bound the sums at every step (few steps).")
    ] = False,
    as_json: AsJson = False,
    output: Folder = None,
    allow_python: AllowPython = False,
) -> None:
    """Say how far a stealthy attacker can move the estimate, step by step."""
    from holdfast.shell import reaching

    asked = reaching.Asked(
        compromised, detector, epsilon, level, length, functional, unaware, as_json, output,
        allow_python,
    )  # fmt: skip
    reaching.run_reach(scenario, asked, enforce or [], steps, gamma, tight)


@app.command()
def policy(
    scenario: ScenarioArgument,
    limit: Annotated[float, typer.Option("--limit", help="What the error must stay under.")],
    compromised: Compromised = None,
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps", min=1, max=10**6, help="Over so many steps. Default: for ever.",
            show_default=False,
        ),
    ] = None,
    per_sensor: Annotated[
        bool, typer.Option("--per-sensor", help="Let every output have a schedule of its own.")
    ] = False,
    cost: Annotated[
        str | None,
        typer.Option(
            "--cost", help="NAME=NUMBER,..: what a message costs; 1 unless named.",
            show_default=False,
        ),
    ] = None,
    detector: DetectorName = "chi_square",
    epsilon: Epsilon = 0.001,
    level: Level = None,
    length: Length = None,
    functional: Functional = None,
    unaware: Unaware = False,
    as_json: AsJson = False,
    output: Folder = None,
    allow_python: AllowPython = False,
) -> None:  # fmt: skip
    """Find the rarest authentication that keeps that error under a limit."""
    from holdfast.shell import reaching

    asked = reaching.Asked(
        compromised, detector, epsilon, level, length, functional, unaware, as_json, output,
        allow_python,
    )  # fmt: skip
    reaching.run_policy(scenario, asked, limit, steps, per_sensor, cost)


@app.command()
def campaign(
    study: Annotated[str, typer.Argument(help="Study file (TOML).", show_default=False)],
    output: Annotated[
        str | None,
        typer.Option(
            "-o", help="Folder for results and report; one that is there is gone on with. "
            "Default: print the summary.", show_default=False,
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler", help="Address of a Dask scheduler. Default: this machine.",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers", min=1, help="Blocks at a time here. Default: one per core.",
            show_default=False,
        ),
    ] = None,
    allow_python: AllowPython = False,
) -> None:  # fmt: skip
    """Simulate a scenario many times over a grid of settings."""
    from holdfast.shell import campaigning

    campaigning.campaign(study, output, scheduler, workers, allow_python)


@app.command()
def arena(
    plants: Annotated[
        list[str] | None,
        typer.Argument(help="Plants, such as vehicle. Default: all there are.", show_default=False),
    ] = None,
    output: Annotated[
        str | None,
        typer.Option(
            "-o", help="Folder for tables, figures, report and studies; one that is there is gone "
            "on with. Default: print the tables.", show_default=False,
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="One plant, in some minutes.")
    ] = False,
) -> None:  # fmt: skip
    """Every estimator and detector against every attack, and what was promised of each."""
    from holdfast.shell import arena

    arena.arena(plants, output, quick)


@app.command()
def tune(
    study: Annotated[
        str, typer.Argument(help="Study with [tune] and [settings] (TOML).", show_default=False)
    ],
    output: Annotated[
        str | None,
        typer.Option("-o", help="Folder for the settings and all that was tried."),
    ] = None,
    allow_python: AllowPython = False,
) -> None:
    """Find the settings that serve an objective best."""
    from holdfast.shell import tuning

    tuning.tune(study, output, allow_python)


@app.command()
def live(
    config: Annotated[str, typer.Argument(help="Configuration (TOML).", show_default=False)],
    allow_python: AllowPython = False,
) -> None:
    """Run the estimator on a live stream, and serve what it says."""
    from holdfast.shell.service import serve

    serve.live(config, allow_python)


@app.command()
def papers(
    name: Annotated[
        str | None,
        typer.Argument(help="A paper, such as care. Default: all there are.", show_default=False),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="JSON to standard output, and nothing else.")
    ] = False,
    output: Annotated[
        str | None,
        typer.Option("-o", help="Folder for papers.json and the figures.", show_default=False),
    ] = None,
) -> None:
    """Run the papers' examples and claims again, and judge them."""
    from holdfast.shell import judging

    judging.papers(name, as_json, output)


@app.command()
def new(
    kind: Annotated[
        str | None,
        typer.Argument(help="A plant, estimator, detector, controller or attack of the catalog."),
    ] = None,
) -> None:
    """Print a commented scenario to start from."""
    from holdfast.shell import template

    print(template.scenario_text(kind), end="")


@app.command()
def info() -> None:
    """Print versions, precision, device and catalog."""
    from holdfast.shell import commands

    commands.info()


def main() -> None:
    """Run the command; 2 after input that cannot be used, with one line that says why."""
    warnings.showwarning = _warn
    try:
        app()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)


def _warn(message, category, filename, lineno, file=None, line=None) -> None:
    print(f"warning: {one_line(str(message))}", file=sys.stderr)
