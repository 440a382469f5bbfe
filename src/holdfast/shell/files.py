"""Files in and out: scenarios, logs, results."""

from pathlib import Path

from holdfast.loop import Scenario
from holdfast.shell.calibrating import calibrated_scenario
from holdfast.shell.logs import Log, read_log
from holdfast.shell.results import write_result
from holdfast.shell.scenario import read_scenario

__all__ = ["Log", "load_scenario", "read_log", "read_scenario", "write_result"]


def load_scenario(path: str | Path, *, allow_python: bool = False) -> Scenario:
    """The scenario of a file, its detector calibrated as the file asks.

    ``allow_python`` lets ``kind = "python"`` import and call code. Raises
    `holdfast.shell.errors.InputError`: file, key, what was found, what was expected.
    """
    return calibrated_scenario(read_scenario(path, allow_python=allow_python))[0]
