"""A folder with sound files, and the command run in this process."""

import io
import sys

import pytest

from holdfast.shell import cli
from shell_samples import LOG, SCENARIO


@pytest.fixture(autouse=True)
def _no_cache(monkeypatch):
    monkeypatch.setenv("HOLDFAST_CACHE", "off")


@pytest.fixture
def folder(tmp_path):
    """A folder with the scenario and the log, both sound."""
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    (tmp_path / "log.csv").write_text(LOG)
    return tmp_path


@pytest.fixture
def command(monkeypatch, capsys):
    """`holdfast ARGS`, as (exit code, standard output, standard error)."""

    def run(*args, stdin=b""):
        monkeypatch.setattr(sys, "argv", ["holdfast", *map(str, args)])
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(stdin)))
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    return run
