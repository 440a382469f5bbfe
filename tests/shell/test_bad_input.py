"""Whatever is wrong: one line that names file and key, exit code 2, no output file."""

import io
import os
import warnings
import zipfile
from pathlib import Path

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from holdfast.shell.errors import InputError
from holdfast.shell.files import read_log, read_scenario
from shell_samples import LOG, SCENARIO

EYE = "[[1.0, 0.0], [0.0, 1.0]]"

# what to replace in the scenario, by what, and what the message must name
SCENARIOS = {
    "misspelt section": ("[detector]", "[detecter]", ["detecter", "did you mean 'detector'"]),
    "misspelt key": ("dt = 0.1", "td = 0.1", ["plant.td", "unknown key", "did you mean 'dt'"]),
    "misspelt setting": ("level =", "levle =", ["detector.levle", "did you mean 'level'"]),
    "misspelt run": ("steps =", "stpes =", ["run.stpes", "did you mean 'steps'"]),
    "missing key": ("A = [[1.0, 0.1], [0.0, 1.0]]\n", "", ["plant.A", "nothing", "a matrix"]),
    "missing section": ("[estimator]", "[run.estimator]", ["estimator", "nothing"]),
    "missing kind": ('kind = "kalman"\n', "", ["estimator.kind", "nothing", "'kalman'"]),
    "unknown kind": ('"kalman"', '"kallman"', ["estimator.kind", "'kallman'", "mean 'kalman'"]),
    "kind no text": ('"kalman"', "3", ["estimator.kind", "found 3"]),
    "wrong shape": ("B = [[0.005], [0.1]]", "B = [[0.1]]", ["plant.B", "1 x 1", "2 x 1"]),
    "ragged": ("A = [[1.0, 0.1], [0.0, 1.0]]", "A = [[1.0], [0.0, 1.0]]", ["plant.A[2]"]),
    "text in matrix": ("[[0.005], [0.1]]\nC", '[["a"], [0.1]]\nC', ["plant.B[1][1]", "'a'"]),
    "truth in matrix": ("[[0.005], [0.1]]\nC", "[[true], [1.0]]\nC", ["plant.B[1][1]", "True"]),
    "NaN matrix": ("Q = [[1e-6", "Q = [[nan", ["plant.Q[1][1]", "nan", "finite"]),
    "infinite matrix": ("Q = [[1e-6", "Q = [[inf", ["plant.Q", "infinity"]),
    "Q not symmetric": ("Q = [[1e-6, 0.0]", "Q = [[1e-6, 1e-9]", ["plant.Q", "not symmetric"]),
    "Q indefinite": ("Q = [[1e-6", "Q = [[-1e-6", ["plant.Q", "eigenvalue", "-1e-06"]),
    "R singular": ("R = [[0.25", "R = [[0.0", ["plant.R", "zero on the diagonal"]),
    "P0 shape": (f"P0 = {EYE}", "P0 = [[1.0]]", ["estimator.P0", "1 x 1", "2 x 2"]),
    "P0 indefinite": (f"P0 = {EYE}", "P0 = [[1.0, 2.0], [2.0, 1.0]]", ["estimator.P0", "-1"]),
    "P0 missing": (f"P0 = {EYE}\n", "", ["estimator.P0", "nothing", "rows of numbers"]),
    "x0 length": ("x0 = [0.0, 0.0]", "x0 = [0.0]", ["estimator.x0", "1 numbers", "2 numbers"]),
    "unknown channel": ('"sensor:gps"', '"sensor:gsp"', ["attack[1].channel", "'sensor:gps'?"]),
    "too few names": ('["gps", "wheel"]', '["gps"]', ["plant.outputs", "2 names"]),
    "same names": ('["gps", "wheel"]', '["gps", "gps"]', ["plant.outputs", "differ"]),
    "unknown state": ("dt = 0.1", 'dt = 0.1\nscheduling = "sped"', ["plant.scheduling", "'sped'"]),
    "unknown choice": ("dt = 0.1", 'dt = 0.1\ntime = "discreet"', ["plant.time", "'discrete'"]),
    "level no number": ("level = 0.01", 'level = "low"', ["detector.level", "'low'", "a number"]),
    "level out of range": ("level = 0.01", "level = 1.5", ["detector.level", "1.5"]),
    "threshold": ("level = 0.01", 'threshold = "papre"', ["detector.threshold", "mean 'paper'"]),
    "steps no integer": ("steps = 30", "steps = 30.5", ["run.steps", "30.5", "a whole number"]),
    "no steps": ("steps = 30", "steps = 0", ["run.steps", "0", "from 1 up"]),
    "huge integer": ("steps = 30", f"steps = {'9' * 30}", ["run.steps", "64 bits"]),
    "endless integer": ("steps = 30", f"steps = {'9' * 5000}", ["no TOML"]),
    "attack no list": ("[[attack]]", "[attack]", ["attack", "[[attack]]"]),
    "attack lacks value": ("value = 5.0\n", "", ["attack[1].value", "nothing", "a number"]),
    "no TOML": ("[plant]", "[plant", ["no TOML", "line 1"]),
    "constraint key": (
        "[estimator]",
        "[plant.constraints]\nstate = { matrix = [[1, 0]], bund = [2] }\n[estimator]",
        ["plant.constraints.state.bund", "did you mean 'bound'"],
    ),
    "constraint side": (
        "[estimator]",
        "[plant.constraints]\nstates = { matrix = [[1, 0]], bound = [2] }\n[estimator]",
        ["plant.constraints.states", "did you mean 'state'"],
    ),
    "constraint shape": (
        "[estimator]",
        "[plant.constraints]\nstate = { matrix = [[1]], bound = [2] }\n[estimator]",
        ["plant.constraints.state.matrix", "(1, 2)"],
    ),
    "missing matrix file": ("[[0.005], [0.1]]\nC", '{ file = "b.csv" }\nC', ["b.csv", "no such"]),
    "matrix file type": ("[[0.005], [0.1]]\nC", '{ file = "b.pkl" }\nC', ["plant.B.file", ".npz"]),
    "matrix file key": ("[[0.005], [0.1]]\nC", '{ fiel = "b.npz" }\nC', ["plant.B.fiel", "'file'"]),
    "grid alone": ("[[0.005], [0.1]]\nC", "{ grid = [0, 1] }\nC", ["plant.B.values", "nothing"]),
    "target without consent": (
        'kind = "linear"', 'kind = "python"\ntarget = "os:abort"',
        ["plant.target", "os:abort", "--allow-python"],
    ),
    "calibrate beside a number": (
        "level = 0.01", 'threshold = 9.0\ncalibrate = "log.csv"', ["detector.calibrate"],
    ),
    "calibration log missing": ("level = 0.01", 'calibrate = "no.csv"', ["no.csv", "no such file"]),
    "seed below 0": ("steps = 30", "steps = 30\nseed = -1", ["run.seed", "-1"]),
}  # fmt: skip


def assert_refused(outcome, folder, words, before):
    code, out, err = outcome
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1, err
    for word in words:
        assert word in err, err
    assert sorted(p.name for p in folder.iterdir()) == before


def names(folder):
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize("case", SCENARIOS)
def test_scenario(case, folder, command):
    old, new, words = SCENARIOS[case]
    assert old in SCENARIO
    (folder / "scenario.toml").write_text(SCENARIO.replace(old, new, 1))
    before = names(folder)
    outcome = command("run", folder / "scenario.toml", "-o", folder / "report")
    if case != "missing matrix file" and case != "calibration log missing":
        words = [*words, "scenario.toml"]
    assert_refused(outcome, folder, words, before)


# the whole scenario, and what the message must name
CONTENTS = {
    "empty": (b"", ["empty file"]),
    "binary garbage": (bytes(range(128, 256)) * 9, ["not text"]),
    "zeros": (bytes(1000), ["binary data"]),
    "deep list": (b"a = " + b"[" * 100_000, ["nested too deep"]),
    "deep tables": (b"a" + b".a" * 20_000 + b" = 1", ["nested too deep", "unknown key"]),
    "comment only": (b"# nothing\n", ["plant", "nothing"]),
}


@pytest.mark.parametrize("case", CONTENTS)
def test_content(case, folder, command):
    content, words = CONTENTS[case]
    (folder / "scenario.toml").write_bytes(content)
    before = names(folder)
    outcome = command("run", folder / "scenario.toml", "-o", folder / "report")
    assert any(word in outcome[2] for word in words), outcome[2]
    assert_refused(outcome, folder, ["scenario.toml"], before)


def test_scenario_of_a_gigabyte_is_not_read(folder, command):
    with open(folder / "scenario.toml", "wb") as file:
        file.truncate(2**30)
    outcome = command("run", folder / "scenario.toml")
    assert_refused(outcome, folder, ["scenario.toml", "1 GiB", "16 MiB"], names(folder))


def npz(**arrays):
    content = io.BytesIO()
    np.savez(content, **arrays)
    return content.getvalue()


def pickled():
    content = io.BytesIO()
    np.savez(content, A=np.array([{"a": 1}], object))
    return content.getvalue()


def bomb():
    """An array said to be of 2^60 numbers."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1152921504606846976,), }"
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        padded = header + b" " * (117 - len(header)) + b"\n"
        archive.writestr("A.npy", b"\x93NUMPY\x01\x00" + len(padded).to_bytes(2, "little") + padded)
    return content.getvalue()


MATRIX_FILES = {
    "garbage.npz": (b"garbage", ["damaged"]),
    "cut.npz": (npz(A=np.eye(2))[:-30], ["damaged"]),
    "pickle.npz": (pickled(), ["damaged", "pickle"]),
    "bomb.npz": (bomb(), ["damaged"]),
    "other.npz": (npz(AA=np.eye(2)), ["no matrix 'A'", "'AA'"]),
    "text.npz": (npz(A=np.array([["a"]])), ["<U1", "real numbers"]),
    "complex.npz": (npz(A=np.eye(2) * 1j), ["complex128", "real numbers"]),
    "garbage.mat": (b"garbage" * 100, ["damaged"]),
    "empty.mat": (b"", ["empty file"]),
    "hdf.mat": (b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x89HDF", ["-v7"]),
    "garbage.csv": (b"\xff\xfe\x00", ["not text"]),
    "header.csv": (b"a,b\n1,2\n3,4\n", ["row 1, column 1", "'a'", "no header"]),
    "ragged.csv": (b"1,2\n3\n", ["row 2", "1 numbers"]),
}


@pytest.mark.parametrize("name", MATRIX_FILES)
def test_matrix_file(name, folder, command):
    content, words = MATRIX_FILES[name]
    (folder / name).write_bytes(content)
    reference = f'{{ file = "{name}" }}' if name.endswith(".csv") else (
        f'{{ file = "{name}", name = "A" }}'
    )  # fmt: skip
    text = SCENARIO.replace("A = [[1.0, 0.1], [0.0, 1.0]]", f"A = {reference}")
    (folder / "scenario.toml").write_text(text)
    outcome = command("run", folder / "scenario.toml")
    assert_refused(outcome, folder, [name, *words], names(folder))


def rows(*changes):
    """The log with lines replaced: (row, line)."""
    lines = LOG.splitlines()
    for row, line in changes:
        lines[row] = line
    return ("\n".join(lines) + "\n").encode()


LOGS = {
    "empty": (b"", ["empty file"]),
    "header only": (LOG.splitlines()[0].encode(), ["no rows"]),
    "binary garbage": (bytes(range(128, 256)) * 9, ["not text"]),
    "zeros": (bytes(1000), ["binary data"]),
    "unclosed quote": (b'time,"u:accel\n1,2\n', ["no CSV"]),
    "missing column": (rows((0, "time,u:accel,y:gps,wheel")), ["'y:wheel'", "but 'wheel'"]),
    "missing time": (rows((0, "zeit,u:accel,y:gps,y:wheel")), ["'time'", "no such column"]),
    "unknown column": (rows((0, "time,u:accel,y:gps,y:whel")), ["'y:whel'", "mean 'y:wheel'"]),
    "misspelt trust": (
        rows((0, "time,u:accel,y:gps,y:wheel,trustd:gps")), ["trustd:gps", "mean 'trusted:gps'"],
    ),
    "column twice": (rows((0, "time,u:accel,y:gps,y:gps")), ["'y:gps'", "twice"]),
    "too few cells": (rows((3, "0.3,1")), ["row 3", "2 cells", "4 as in the header"]),
    "too many cells": (rows((3, "0.3,1,2,3,4")), ["row 3", "5 cells"]),
    "blank line": (rows((3, "")), ["row 3", "0 cells"]),
    "no number": (rows((3, "0.3,1,x,3")), ["row 3, column 'y:gps'", "'x'", "a number"]),
    "underscore": (rows((3, "0.3,1,1_0,3")), ["row 3, column 'y:gps'", "'1_0'"]),
    "no time": (rows((3, ",1,2,3")), ["row 3, column 'time'", "an empty cell"]),
    "time nan": (rows((3, "nan,1,2,3")), ["row 3, column 'time'", "nan"]),
    "time backwards": (rows((3, "0.1,1,2,3")), ["row 3, column 'time'", "0.1 after 0.2"]),
    "time stands": (rows((3, "0.2,1,2,3")), ["row 3, column 'time'", "0.2 after 0.2"]),
    "jitter": (rows((3, "0.312,1,2,3")), ["row 3, column 'time'", "dt = 0.1 s"]),
    "half a step": (rows((3, "0.25,1,2,3")), ["row 3, column 'time'", "dt = 0.1 s"]),
    "endless gap": (rows((12, "1e9,1,2,3")), ["row 12, column 'time'", "at most"]),
}  # fmt: skip


@pytest.mark.parametrize("case", LOGS)
def test_log(case, folder, command):
    content, words = LOGS[case]
    (folder / "bad.csv").write_bytes(content)
    before = names(folder)
    outcome = command(
        "replay", folder / "scenario.toml", folder / "bad.csv", "-o", folder / "o.csv"
    )
    assert_refused(outcome, folder, ["bad.csv", *words], before)


def test_trusted_is_0_or_1(folder, command):
    lines = LOG.splitlines()
    text = "\n".join([lines[0] + ",trusted:gps", *(line + ",2" for line in lines[1:])])
    (folder / "bad.csv").write_text(text)
    outcome = command("replay", folder / "scenario.toml", folder / "bad.csv")
    assert_refused(outcome, folder, ["row 1, column 'trusted:gps'", "2.0", "0 or 1"], names(folder))


ARRAYS = {
    "garbage.npz": (b"garbage", ["no readable .npz"]),
    "garbage.nc": (b"garbage", ["no readable NetCDF"]),
    "pickle.npz": (pickled(), ["no readable .npz"]),
    "missing.npz": (npz(time=np.arange(3.0)), ["'u:accel'"]),
    "shape.npz": (
        npz(**{"time": np.arange(3.0), "u:accel": np.zeros(3), "y:gps": np.zeros(2),
               "y:wheel": np.zeros(3)}),
        ["'y:gps'", "(2,)", "(3,)"],
    ),
    "empty.nc": (b"", ["empty file"]),
    "garbage.ulg": (b"garbage", ["garbage.ulg"]),
}  # fmt: skip


@pytest.mark.parametrize("name", ARRAYS)
def test_log_of_arrays(name, folder, command):
    content, words = ARRAYS[name]
    (folder / name).write_bytes(content)
    before = names(folder)
    outcome = command("replay", folder / "scenario.toml", folder / name, "-o", folder / "o.csv")
    assert_refused(outcome, folder, [name, *words], before)


@pytest.mark.parametrize(
    ("scenario", "log", "output", "words"),
    [
        ("no.toml", "log.csv", "o.csv", ["no.toml", "no such file"]),
        (".", "log.csv", "o.csv", ["a folder", "a file"]),
        ("scenario.toml", "no.csv", "o.csv", ["no.csv", "no such file"]),
        ("scenario.toml", "log.csv", "no/such/o.csv", ["no/such", "no folder"]),
        ("scenario.toml", "log.csv", "log.csv/o.csv", ["log.csv/o.csv"]),
        ("scenario.toml", "log.csv", "scenario.toml", ["a file", "a folder for the report"]),
        ("scenario.toml", "log.csv", "log.csv/report", ["log.csv"]),
        ("-", "-", "o.csv", ["standard input"]),
    ],
)
def test_paths(scenario, log, output, words, folder, command, monkeypatch):
    monkeypatch.chdir(folder)
    before = names(folder)
    assert_refused(command("replay", scenario, log, "-o", output), folder, words, before)


def test_folder_without_permission(folder, command):
    # root may write anywhere but in a virtual file system
    closed = Path("/sys") if os.geteuid() == 0 else folder / "closed"
    closed.mkdir(mode=0o500, exist_ok=True)
    outcome = command(
        "replay", folder / "scenario.toml", folder / "log.csv", "-o", closed / "o.csv"
    )
    assert_refused(outcome, folder, ["o.csv", "ermi"], names(folder))


def test_device_is_not_replaced(folder, command):
    outcome = command("replay", folder / "scenario.toml", folder / "log.csv", "-o", "/dev/full")
    assert_refused(outcome, folder, ["/dev/full", "a device"], names(folder))


def refusal(read):
    """What an `InputError` says; None where all is well. Any other error gets through."""
    try:
        read()
    except InputError as error:
        return str(error)
    return None


@hypothesis.settings(max_examples=60)
@hypothesis.given(
    row=st.integers(0, 12),
    cell=st.integers(0, 3),
    text=st.one_of(
        st.text(max_size=8), st.sampled_from(["", "nan", "-inf", "1e400", '"', ",", "\n", "0.3"])
    ),
)
def test_any_cell_may_be_spoilt(tmp_path_factory, row, cell, text):
    folder = tmp_path_factory.mktemp("fuzz")
    (folder / "scenario.toml").write_text(SCENARIO)
    lines = [line.split(",") for line in LOG.splitlines()]
    lines[row][cell] = text
    content = "\n".join(map(",".join, lines)).encode("utf-8", "surrogatepass")
    (folder / "log.csv").write_bytes(content)
    plant = read_scenario(folder / "scenario.toml").scenario.plant
    message = refusal(lambda: read_log(folder / "log.csv", plant))
    assert message is None or ("log.csv" in message and "\n" not in message)


@hypothesis.settings(max_examples=60)
@hypothesis.given(
    line=st.integers(0, 28),
    at=st.integers(0, 60),
    text=st.text("[]{}=.,\"'#\n0123456789aeinft", max_size=4),
)
def test_any_character_of_a_scenario_may_be_spoilt(tmp_path_factory, line, at, text):
    folder = tmp_path_factory.mktemp("fuzz")
    lines = SCENARIO.splitlines()
    lines[line] = lines[line][:at] + text + lines[line][at + 1 :]
    (folder / "scenario.toml").write_text("\n".join(lines))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a plant that now looks continuous
        message = refusal(lambda: read_scenario(folder / "scenario.toml"))
    assert message is None or ("scenario.toml" in message and "\n" not in message)
