"""What `holdfast reach` and `holdfast policy` refuse: one line, exit code 2, nothing written."""

import numpy as np
import pytest

from shell_samples import SCENARIO
from test_bad_input import assert_refused, names

REACH = ["--steps", "5"]
POLICY = ["--limit", "1"]
ALL = ["--compromised", "all"]
BY_NAME = "expected all by itself, or names with commas between: one of 'gps', 'wheel'"
PROBABILITY = "expected a probability between 0 and 1"
WHOLE = "a whole number from 1 up"
FLAG = "every=L,for=F,first=K"

# flags of both commands, and what the message must say
BOTH = {
    "nobody": ([], ["--compromised: found nothing, expected all, or the outputs"]),
    "unknown": (["--compromised", "gsp"], ["found 'gsp'", BY_NAME, "did you mean 'gps'?"]),
    "empty": (["--compromised", ""], ["found an empty name in ''", BY_NAME]),
    "a comma": (["--compromised", "gps,"], ["found an empty name in 'gps,'", BY_NAME]),
    "twice": (["--compromised", "gps,gps"], ["found 'gps' twice"]),
    "level 0": ([*ALL, "--level", "0"], ["--level: found 0.0", PROBABILITY]),
    "level 1": ([*ALL, "--level", "1"], ["--level: found 1.0", PROBABILITY]),
    "level -1": ([*ALL, "--level=-1"], ["--level: found -1.0", PROBABILITY]),
    "level nan": ([*ALL, "--level", "nan"], ["--level: found nan", PROBABILITY]),
    "epsilon 0": ([*ALL, "--epsilon", "0"], ["--epsilon: found 0.0", f"{PROBABILITY} - level"]),
    "epsilon -1": ([*ALL, "--epsilon=-1"], ["--epsilon: found -1.0", PROBABILITY]),
    "epsilon .99": ([*ALL, "--epsilon", "0.99"], ["--epsilon: found 0.99", "1 - level (0.99)"]),
    "epsilon inf": ([*ALL, "--epsilon", "inf"], ["--epsilon: found inf", PROBABILITY]),
    "epsilon of sums": (
        [*ALL, "--epsilon", "0.6", "--detector", "sprt"],
        ["--epsilon: found 0.6, expected a probability under 0.5 with sprt"],
    ),
    "functional missing": ([*ALL, "--functional", "no.csv"], ["no.csv", "no such file"]),
    "functional type": (
        [*ALL, "--functional", "scenario.toml"],
        ["--functional: found 'scenario.toml', expected a .csv file with a matrix"],
    ),
    "functional width": (
        [*ALL, "--functional", "wide.csv"],
        ["wide.csv: found a matrix of 1 x 3, expected finite numbers in 2 columns"],
    ),
    "functional no number": (
        [*ALL, "--functional", "header.csv"], ["header.csv", "row 1, column 1", "'position'"],
    ),
    "functional nan": ([*ALL, "--functional", "nan.csv"], ["nan.csv", "finite numbers"]),
    "functional empty": ([*ALL, "--functional", "empty.csv"], ["empty.csv"]),
    "a file for the folder": (
        [*ALL, "-o", "out.csv"], ["out.csv: found the name of a file, expected a folder"],
    ),
    "a folder that is a file": ([*ALL, "-o", "scenario.toml"], ["scenario.toml: found a file"]),
}  # fmt: skip

ENFORCE = {
    "no key": ("20", [FLAG, "'20'"]),
    "nothing": ("", [FLAG, "''"]),
    "no every": ("for=2", [FLAG, "'for=2'"]),
    "misspelt": ("evry=2", [FLAG, "'evry=2'"]),
    "twice": ("every=2,every=3", [FLAG]),
    "no value": ("every=", [f"every: {WHOLE}", "'every='"]),
    "zero": ("every=0", [f"every: {WHOLE}", "'every=0'"]),
    "negative": ("every=-4", [f"every: {WHOLE}", "'every=-4'"]),
    "a fraction": ("every=4,for=1.5", [f"for: {WHOLE}", "'for=1.5'"]),
    "no first": ("every=4,first=0", [f"first: {WHOLE}", "'first=0'"]),
    "huge": ("every=2147483648", [f"every: {WHOLE}"]),
    "endless": ("every=" + "9" * 5000, [f"every: {WHOLE}"]),
    "unknown": ("gsp:every=4", ["'gsp'", "one of 'gps', 'wheel'; did you mean 'gps'?"]),
    "no name": (":every=4", ["''", "one of 'gps', 'wheel'"]),
    "a name alone": ("gps:", [FLAG]),
}

OF_REACH = {
    "gamma -1": (["--gamma=-1"], ["--gamma: found -1.0, expected a number from 0 up"]),
    "gamma nan": (["--gamma", "nan"], ["--gamma: found nan"]),
    "gamma inf": (["--gamma", "inf"], ["--gamma: found inf"]),
    "all twice": (["--enforce", "every=3", "--enforce", "every=4"], ["two of all outputs", FLAG]),
    "one twice": (
        ["--enforce", "gps:every=3", "--enforce", "gps:every=4"],
        ["--enforce: found 'gps' twice, expected every output once"],
    ),
    "too long": (
        ["--detector", "sprt", "--tight", "--enforce", "every=5000"],
        ["--steps: found 5, which have to be stealthy until step 5000", "at most step 256"],
    ),
    **{f"enforce {case}": (["--enforce", text], words) for case, (text, words) in ENFORCE.items()},
}

OF_POLICY = {
    "limit 0": (["--limit", "0"], ["--limit: found 0.0, expected a positive number"]),
    "limit -1": (["--limit=-1"], ["--limit: found -1.0"]),
    "limit nan": (["--limit", "nan"], ["--limit: found nan"]),
    "limit inf": (["--limit", "inf"], ["--limit: found inf"]),
    "sums for ever": (
        ["--detector", "sprt"],
        ["--steps: found none with the detector sprt", "expected a number of steps, or the detect"],
    ),
    "cost of nobody": (["--cost", "gsp=2"], ["--cost: found 'gsp'", "did you mean 'gps'?"]),
    "cost of all": (["--cost", "all=2"], ["--cost: found 'all', expected one of 'gps', 'wheel'"]),
    "cost twice": (["--cost", "gps=2,gps=3"], ["--cost: found 'gps' twice"]),
    "no cost": (["--cost", "gps"], ["--cost: found 'gps', expected NAME=NUMBER"]),
    "cost empty": (["--cost", ""], ["--cost: found ''", "one of 'gps', 'wheel'"]),
    "cost a word": (["--cost", "gps=much"], ["--cost: found 'gps=much', expected NAME=NUMBER"]),
    "cost 0": (["--cost", "gps=0"], ["--cost: found [0.0, 1.0], expected 2 positive numbers"]),
    "cost nan": (["--cost", "wheel=nan"], ["--cost: found [1.0, nan]"]),
}


@pytest.fixture
def spoilt(folder, monkeypatch):
    """A folder with the scenario and matrices that are none, and the current one."""
    (folder / "wide.csv").write_text("1,0,0\n")
    (folder / "header.csv").write_text("position,speed\n1,0\n")
    (folder / "nan.csv").write_text("nan,0\n")
    (folder / "empty.csv").write_text("")
    monkeypatch.chdir(folder)
    return folder


def refused(command, folder, flags, words, output=("-o", "report")):
    before = names(folder)
    for as_json in ((), ("--json",)):
        flags = [*flags, *as_json]
        outcome = command(*flags, *(() if "-o" in flags else output))
        assert_refused(outcome, folder, words, before)


@pytest.mark.parametrize("case", BOTH)
@pytest.mark.parametrize("name", ["reach", "policy"])
def test_of_both(spoilt, command, name, case):
    flags, words = BOTH[case]
    asked = REACH if name == "reach" else POLICY
    refused(command, spoilt, [name, "scenario.toml", *asked, *flags], words)


@pytest.mark.parametrize("case", OF_REACH)
def test_of_reach(spoilt, command, case):
    flags, words = OF_REACH[case]
    refused(command, spoilt, ["reach", "scenario.toml", *REACH, *ALL, *flags], words)


@pytest.mark.parametrize("case", OF_POLICY)
def test_of_policy(spoilt, command, case):
    flags, words = OF_POLICY[case]
    refused(command, spoilt, ["policy", "scenario.toml", *POLICY, *ALL, *flags], words)


@pytest.mark.parametrize(
    "flags",
    [
        ["reach", *ALL],
        ["reach", *ALL, "--steps", "0"],
        ["reach", *ALL, "--steps=-3"],
        ["reach", *ALL, "--steps", "2.5"],
        ["reach", *ALL, "--steps", "1000001"],
        ["reach", *ALL, *REACH, "--length", "0"],
        ["reach", *ALL, *REACH, "--detector", "cusum"],
        ["reach", *ALL, *REACH, "--epsilon", "much"],
        ["reach", *ALL, *REACH, "--enforced", "every=3"],
        ["policy", *ALL],
        ["policy", *ALL, "--limit", "much"],
        ["policy", *ALL, *POLICY, "--steps", "0"],
        ["policy", *ALL, *POLICY, "--length=-1"],
    ],
)
def test_what_the_command_line_itself_refuses(spoilt, command, flags):
    """As with every other command: how it is used, and what was wrong."""
    before = names(spoilt)
    code, out, err = command(flags[0], "scenario.toml", *flags[1:], "-o", "report")
    assert (code, out) == (2, "")
    assert "Error" in err
    assert names(spoilt) == before


def plants(folder):
    """Scenarios whose plant has no filter in the long run."""
    C = np.tile(np.eye(2), (6, 1, 1))
    np.savez(folder / "plant.npz", C=C)
    eye = "C = [[1.0, 0.0], [0.0, 1.0]]"
    yield (
        SCENARIO.replace(eye, 'C = { file = "plant.npz", name = "C" }'),
        "a plant that changes, expected a linear plant with constant matrices",
    )
    yield (
        SCENARIO.replace(eye, "C = [[0.0, 1.0], [0.0, 2.0]]"),
        "no steady-state Kalman filter",
    )
    yield (
        '[plant]\nkind = "bicycle"\n[estimator]\nkind = "extended"\n'
        "x0 = [0.0, 0.0, 0.0, 0.0]\nP0 = "
        f"{np.eye(4).tolist()}\n[detector]\nkind = 'chi_square'\non = 'residual'\n",
        "a plant that changes, expected a linear plant with constant matrices",
    )


def test_plants_without_a_filter_in_the_long_run(spoilt, command):
    for text, expected in plants(spoilt):
        (spoilt / "scenario.toml").write_text(text)
        for name, asked in (("reach", REACH), ("policy", POLICY)):
            flags = [name, "scenario.toml", *asked, *ALL]
            refused(command, spoilt, flags, ["scenario.toml: plant.kind: found ", expected])
