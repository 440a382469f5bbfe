"""`holdfast papers`: names, JSON, the table, the folder."""

import json
import sys

import numpy as np
import pytest

from holdfast.papers import care, rows
from holdfast.papers.care_vehicle import STEPS
from holdfast.report.paper_figures import Panel, stacked
from holdfast.shell import cli, judging

PNG = b"\x89PNG\r\n\x1a\n"
KEYS = ["id", "what", "paper", "ours", "spread", "verdict", "note"]


def small():
    """Two rows and one figure, in no time."""
    t = np.arange(1.0, 11.0)
    panels = [
        Panel("error", {"ISE": np.sin(t), "CARE": np.cos(t)}),
        Panel("state", {"CARE": np.exp(t), "threshold": np.full(10, 50.0)}, log=True),
    ]
    found = (
        rows.claim("Theorem 1", "what is claimed", "[0, 1)", [0.5, float("inf")], False, "why"),
        rows.number("Table 1, row 1", "a sum", 1.0, np.array([0.9, 1.1])),
    )
    return rows.Study(found, lambda: {"figure-1": stacked(t, panels)})


@pytest.fixture
def command(monkeypatch, capsys):
    """`holdfast ARGS` with the small study, as (exit code, standard output, standard error)."""
    monkeypatch.setattr(judging, "STUDIES", {"care": small})

    def run(*args):
        monkeypatch.setattr(sys, "argv", ["holdfast", *map(str, args)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    return run


@pytest.mark.parametrize("name", [("care",), ()])
def test_json_alone_and_without_infinity(command, name):
    code, out, err = command("papers", *name, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out, parse_constant=lambda word: pytest.fail(f"{word} in JSON"))
    assert [list(row) for row in found] == [KEYS, KEYS]
    assert found[0]["ours"] == [0.5, None]
    assert found[1]["verdict"] == "reproduced"


@pytest.mark.parametrize("name", ["nisme", "decoder", "Care"])
def test_what_is_not_built_is_refused_with_what_there_is(command, name):
    code, out, err = command("papers", name)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert name in err
    assert "expected 'care'" in err


def test_the_table_and_the_folder(command, tmp_path):
    folder = tmp_path / "new" / "out"
    code, out, err = command("papers", "care", "-o", folder)
    assert (code, err) == (0, "")
    assert "Theorem 1 " in out
    assert "[0, 1)" in out  # not taken for markup
    assert "1 ± 0.14" in out
    assert "1 reproduced, 1 fails" in out
    assert {path.name for path in folder.iterdir()} == {"papers.json", "figure-1.png"}
    assert (folder / "figure-1.png").read_bytes().startswith(PNG)
    assert [row["id"] for row in json.loads((folder / "papers.json").read_text())] == [
        "Theorem 1", "Table 1, row 1",
    ]  # fmt: skip


def test_a_place_that_cannot_be_written_is_refused_first(command, tmp_path, monkeypatch):
    monkeypatch.setattr(judging, "STUDIES", {"care": lambda: pytest.fail("judged")})
    (tmp_path / "taken").write_text("")
    for place in ("taken", "rows.csv"):
        code, out, err = command("papers", "care", "-o", tmp_path / place)
        assert (code, out) == (2, "")
        assert place in err


@pytest.mark.slow
def test_the_real_figures_show_what_the_run_says(run):
    drawn = care.figures(run)
    assert list(drawn) == ["care-figure-3", "care-figure-4", "care-figure-5"]
    lines = {
        (panel.get_title(loc="left"), line.get_label()): line.get_ydata()
        for figure in drawn.values()
        for panel in figure.axes
        for line in panel.get_lines()
    }
    error = run.x[0, :, 1] - run.ise.estimate.x[0, :, 1]
    np.testing.assert_array_equal(lines["error of y (m)", "ISE"], error)
    np.testing.assert_array_equal(lines["attack on beta (rad)", "truth"], run.d[0, :, 0])
    assert all(len(values) == STEPS for values in lines.values())
