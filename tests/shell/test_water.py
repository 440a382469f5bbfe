"""The BATADAL reader and its score; the real network, where the data are."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from holdfast.shell.errors import InputError
from holdfast.shell.water import read_scada, scored

SOUND = """DATETIME,L_T1 , S_PU1,ATT_FLAG
06/01/14 22,1.5,1,-999
06/01/14 23,2.5,0,0
07/01/14 00,3.5,1,1
"""


def written(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)
    return path


def test_hours_and_signals(tmp_path):
    found = read_scada(written(tmp_path, SOUND))
    assert {name: values.tolist() for name, values in found.signals.items()} == {
        "L_T1": [1.5, 2.5, 3.5], "S_PU1": [1, 0, 1],
    }  # fmt: skip
    assert found.hour.tolist() == [22, 23, 0]
    assert found.attacked.tolist() == [False, False, True]


WRONG = {
    "another file": ("DATETIME", "DATE", "columns"),
    "an hour left out": ("06/01/14 23,2.5,0,0\n", "", "line 3: found 2:00:00 after"),
    "no number": ("2.5", "x", "line 3"),
    "no time": ("06/01/14 23", "soon", "line 3"),
    "a cell too few": ("2.5,0,0", "2.5,0", "line 3: found 3 cells, expected 4"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_log_is_said(tmp_path, name):
    old, new, words = WRONG[name]
    with pytest.raises(InputError, match=words):
        read_scada(written(tmp_path, SOUND.replace(old, new)))


def test_no_file(tmp_path):
    with pytest.raises(InputError, match="a BATADAL file"):
        read_scada(tmp_path / "none.csv")


def test_the_score_by_hand():
    """Two attacks of 4 and 5 hours: one found after an hour, the other not."""
    attacked = np.array([0, 0, 1, 1, 1, 1, 0, 1, 1, 1, 1, 1, 0], bool)
    alarm = np.array([0, 1, 0, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0], bool)
    found = scored(alarm, attacked)
    assert found.delays == (1.0, np.inf)
    assert found.detection == pytest.approx(1 - (0.25 + 1) / 2)
    assert (found.true_positive, found.true_negative) == (pytest.approx(2 / 9), 0.75)
    assert found.classification == pytest.approx((2 / 9 + 0.75) / 2)
    assert found.score == pytest.approx((found.detection + found.classification) / 2)
    always = scored(np.ones(13, bool), attacked)
    assert (always.score, always.detection, always.classification) == (0.75, 1.0, 0.5)


@pytest.mark.whole
@pytest.mark.slow
def test_the_figures_of_the_page(shared_data, monkeypatch):
    """docs/water_network.md, from the benchmark's own code."""
    monkeypatch.setenv("HOLDFAST_DATA", str(shared_data))
    path = Path(__file__).parents[2] / "benchmarks" / "water.py"
    spec = importlib.util.spec_from_file_location("water", path)
    water = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(water)
    quiet, log = (read_scada(water.FOLDER / f"dataset0{i}.csv") for i in (3, 4))
    until = 2 * len(quiet.hour) // 3
    model = water.identified(quiet, ["L", "F"], 2, until)
    found = water.judged(model, 2, water.part(quiet, until), log)
    page = (Path(__file__).parents[2] / "docs" / "water_network.md").read_text()
    for name, (s, false) in found.items():
        kind, *window = name.split(", ")
        words = {"0.9": "forgetting 0.9"}.get(*window, *window) if window else None
        row = f"| `{kind}`" + (f", {words}" if words else "") + " |"
        line = next(line for line in page.splitlines() if line.startswith(row))
        cells = [cell.strip() for cell in line.strip("|").split("|")][1:]
        numbers = s.score, s.detection, s.classification, s.true_positive, s.true_negative, false
        assert [float(cell) for cell in cells[:6]] == pytest.approx(numbers, abs=6e-4)
        assert [float(cell) for cell in cells[6].split(",")] == list(s.delays)
