"""`holdfast reach` and `holdfast policy`: JSON that others rely on, files, and what is refused."""

import json
import math

import numpy as np
import pytest

from attackers import asked, together, vehicle, written
from holdfast.reach.bounds import reach
from holdfast.records import Enforcement
from shell_samples import SCENARIO

LEVEL = 0.015
VEHICLE = f"""\
[plant]
kind = "vehicle_tracking"

[estimator]
kind = "kalman"
x0 = [0.0, 0.0]
P0 = [[1.0, 0.0], [0.0, 1.0]]

[detector]
kind = "chi_square"
on = "residual"
level = {LEVEL}
"""
POSITION, SPEED = NAMES = ["measured_position", "measured_speed"]
SYSTEM = vehicle()
SUMS = ["--detector", "sprt"]
ALL = ["--compromised", "all"]
KEYS = {
    "k", "alpha", "norm", "shape", "horizon", "kind", "lower", "exact", "bounded", "radius",
    "reason", "states", "compromised", "detector", "epsilon", "level", "aware",
}  # fmt: skip
POLICY_KEYS = {
    "every", "for", "first", "share", "cost", "worst", "limit", "steps", "proof", "tried",
    "compromised", "detector", "epsilon", "level",
}  # fmt: skip


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "vehicle.toml"
    found.write_text(VEHICLE)
    return found


def told(command, *args):
    """The JSON, which is all that standard output holds."""
    code, out, err = command(*args, "--json")
    assert (code, err) == (0, ""), err
    return json.loads(out, parse_constant=lambda word: pytest.fail(f"{word} in the JSON"))


def reached(command, path, steps, *flags):
    return told(command, "reach", path, "--steps", steps, *(flags or ALL))


def searched(command, path, limit, *flags):
    return told(command, "policy", path, "--limit", limit, *(flags or ALL))


def same(found, setting, steps, tight=False):
    """What the command says is what the library says."""
    direct = reach(setting, steps, tight)
    for key in ("k", "horizon", "exact"):
        assert found[key] == getattr(direct, key).tolist()
    for key in ("alpha", "norm", "lower", "shape"):
        # the filter's gain by two solvers
        np.testing.assert_allclose(found[key], getattr(direct, key), rtol=1e-6, atol=1e-12)


def test_sums_by_the_matrix_of_the_paper(path, command):
    """(49) and (59), written out: every k, with the constraint where its block ends."""
    found = reached(command, path, 10, *ALL, *SUMS, "--enforce", "every=4,for=2,first=3")
    assert set(found) == KEYS
    assert found["k"] == list(range(1, 11))
    assert found["horizon"] == [4, 4, 4, 4, 8, 8, 8, 8, 12, 12]
    assert (found["kind"], found["exact"]) == ("exact", [True] * 10)
    assert (found["detector"], found["level"], found["epsilon"]) == ("sprt", LEVEL, 0.001)
    assert (found["compromised"], found["states"]) == (NAMES, ["position", "speed"])
    assert (found["bounded"], found["radius"], found["aware"]) == (False, pytest.approx(0), True)
    assert "beyond every limit" in found["reason"]
    setting = asked(SYSTEM, "sprt", together(2, 4, 2, 3), level=LEVEL)
    for k, t in zip(found["k"], found["horizon"], strict=True):
        dense = written(setting, t, k)
        ((rows, alpha),) = dense.limits
        assert found["alpha"][k - 1] == pytest.approx(alpha, rel=1e-9)
        theta = np.linalg.inv(rows.T @ rows)
        Y = alpha**2 * dense.errors[k] @ theta @ dense.errors[k].T
        np.testing.assert_allclose(found["shape"][k - 1], Y, rtol=1e-6, atol=1e-12)
        longest = math.sqrt(np.linalg.eigvalsh(Y)[-1])
        assert found["norm"][k - 1] == pytest.approx(longest, rel=1e-7)


def test_gamma_adds_the_covariance_to_the_ellipsoid_alone(path, command):
    bare, more = (
        reached(command, path, 5, *ALL, *SUMS, *gamma) for gamma in ((), ("--gamma", "2.5"))
    )
    added = np.array(more["shape"]) - np.array(bare["shape"])
    np.testing.assert_allclose(added, np.tile(2.5 * SYSTEM.P, (5, 1, 1)), rtol=1e-6)
    assert more["norm"] == bare["norm"]
    # without a policy the constraint is that of the step itself
    assert bare["horizon"] == [1, 2, 3, 4, 5]


ENFORCED = {
    "first is every": (["every=4"], together(2, 4)),
    "all three": (["every=6, for=2, first=3"], together(2, 6, 2, 3)),
    "one of two": ([f"{SPEED}:every=3"], Enforcement.of([1, 3], [0, 1], [1, 3])),
    "each its own": (
        [f"{POSITION}:every=4", f"{SPEED}:every=6,for=2,first=2"],
        Enforcement.of([4, 6], [1, 2], [4, 2]),
    ),
    "one apart": (["every=5", f"{SPEED}:every=2"], Enforcement.of([5, 2], 1, [5, 2])),
    "always": (["every=1"], together(2, 1)),
}


@pytest.mark.parametrize("case", ENFORCED)
def test_when_messages_are_authenticated(path, command, case):
    flags, enforcement = ENFORCED[case]
    flags = [part for flag in flags for part in ("--enforce", flag)]
    found = reached(command, path, 9, *ALL, *SUMS, *flags)
    same(found, asked(SYSTEM, "sprt", enforcement, level=LEVEL), 9)


def test_the_scenario_s_policy_unless_another_is_given(path, command):
    path.write_text(VEHICLE + "[enforcement]\nevery = 5\n")
    found = reached(command, path, 7, *ALL, *SUMS)
    assert found["horizon"] == [5, 5, 5, 5, 5, 10, 10]
    same(found, asked(SYSTEM, "sprt", together(2, 5), level=LEVEL), 7)
    found = reached(command, path, 7, *ALL, *SUMS, "--enforce", "every=3")
    same(found, asked(SYSTEM, "sprt", together(2, 3), level=LEVEL), 7)


@pytest.mark.slow
def test_each_residual_bounded(path, command):
    found = reached(command, path, 8, "--compromised", POSITION, "--enforce", "every=6")
    setting = asked(SYSTEM, "chi_square", together(2, 6), compromised=[True, False], level=LEVEL)
    same(found, setting, 8)
    assert (found["detector"], found["bounded"], found["reason"]) == ("chi_square", True, None)
    assert found["compromised"] == [POSITION]
    assert len(set(found["alpha"])) == 1
    assert np.all(np.array(found["lower"]) <= np.array(found["norm"]))
    assert found["radius"] < 1
    free = reached(command, path, 3, *ALL)
    assert (free["bounded"], free["radius"]) == (False, pytest.approx(1))
    assert "can be moved unseen" in free["reason"]


def test_what_of_the_error_counts(path, command, tmp_path):
    (tmp_path / "position.csv").write_text("1,0\n")
    flags = ["--functional", tmp_path / "position.csv", "--enforce", "every=4"]
    found = reached(command, path, 6, *ALL, *SUMS, *flags)
    setting = asked(SYSTEM, "sprt", together(2, 4), functional=[[1.0, 0.0]], level=LEVEL)
    same(found, setting, 6)
    of_position = np.sqrt(np.array(found["shape"])[:, 0, 0])
    np.testing.assert_allclose(found["norm"], of_position, rtol=1e-9)


def test_who_does_not_know_the_policy(path, command):
    flags = [*ALL, *SUMS, "--enforce", "every=4,for=2"]
    unaware, aware = (reached(command, path, 6, *flags, *more) for more in (["--unaware"], []))
    assert unaware["aware"] is False
    enforcement = together(2, 4, 2)
    same(unaware, asked(SYSTEM, "sprt", enforcement, aware=False, level=LEVEL), 6)
    assert np.all(np.array(unaware["norm"]) <= np.array(aware["norm"]) * (1 + 1e-9))


def test_tight_bounds_every_sum(path, command):
    flags = [*ALL, *SUMS, "--enforce", "every=4", "--level", "0.5"]
    tight, loose = (reached(command, path, 5, *flags, *more) for more in (["--tight"], []))
    same(tight, asked(SYSTEM, "sprt", together(2, 4), level=0.5), 5, tight=True)
    assert tight["bounded"] is None
    less = np.array(tight["norm"]) / np.array(loose["norm"])
    assert np.all(less <= 1 + 1e-7)
    # sums that end before the block have a smaller bound
    assert np.min(less) < 0.9


@pytest.mark.slow
def test_levels_and_windows_of_the_scenario(path, command):
    found = reached(command, path, 3, *ALL, "--level", "0.05", "--epsilon", "0.01")
    assert (found["level"], found["epsilon"]) == (0.05, 0.01)
    same(found, asked(SYSTEM, "chi_square", level=0.05, epsilon=0.01), 3)
    weights = (1.0, 2.0, 0.5)
    text = VEHICLE.replace('"chi_square"', '"windowed"')
    path.write_text(text + f"length = 3\nweights = {list(weights)}\n")
    windows = [*ALL, "--detector", "windowed"]
    found = reached(command, path, 4, *windows)
    same(found, asked(SYSTEM, "windowed", weights=weights, level=LEVEL), 4)
    found = reached(command, path, 4, *windows, "--length", "2")
    same(found, asked(SYSTEM, "windowed", weights=(1.0, 1.0), level=LEVEL), 4)
    path.write_text(VEHICLE)
    found = reached(command, path, 2, *windows)
    same(found, asked(SYSTEM, "windowed", weights=(1.0,) * 10, level=LEVEL), 2)


def test_a_table_and_sentences(path, command):
    code, out, err = command("reach", path, "--steps", "40", *ALL, *SUMS, "--enforce", "every=20")
    assert (code, err) == (0, "")
    head, first, *_ = out.splitlines()
    assert head.startswith("step")
    assert first.split()[0::2] == ["1", "20"]
    assert f'Whoever alters "{POSITION}" and "{SPEED}"' in out
    assert "Nothing is said of all time" in out
    assert "Without limit as time goes on" in command("reach", path, "--steps", "3", *ALL)[1]


# --- policy ---------------------------------------------------------------------------------------


def test_a_policy_and_what_is_reached_under_it(path, command):
    found = searched(command, path, 0.7, *ALL, *SUMS, "--steps", "90")
    assert set(found) == POLICY_KEYS
    assert found["every"] == found["first"] >= 30
    assert (found["for"], found["proof"], found["steps"]) == (1, "horizon", 90)
    assert (found["limit"], found["share"]) == (0.7, 1 / found["every"])
    every = found["every"]
    norm = reached(command, path, 90, *ALL, *SUMS, "--enforce", f"every={every}")["norm"]
    assert max(norm) == pytest.approx(found["worst"], rel=1e-9)
    assert found["worst"] <= 0.7
    norm = reached(command, path, 90, *ALL, *SUMS, "--enforce", f"every={every + 1}")["norm"]
    assert max(norm) > 0.7


@pytest.mark.slow
def test_a_policy_in_words(path, command):
    """The first line is what the other command takes."""
    code, out, _ = command("policy", path, "--limit", "1e-4", *ALL)
    assert code == 0
    assert out.startswith("--enforce every=1,for=1,first=1\n100 % of all messages")
    assert "for ever (limit 0.0001;" in out


@pytest.mark.slow
def test_a_policy_for_ever(path, command):
    found = searched(command, path, 0.7)
    assert [found[key] for key in ("every", "for", "first")] == [3, 1, 3]
    assert (found["steps"], found["proof"], found["detector"]) == (None, "period", "chi_square")
    assert found["worst"] <= 0.7
    seen = reached(command, path, 12, *ALL, "--enforce", "every=3")
    assert (seen["bounded"], max(seen["lower"]) <= found["worst"]) == (True, True)


@pytest.mark.slow
def test_every_output_its_own(path, command):
    who = ["--compromised", POSITION]
    flags = [*who, "--steps", "8", "--cost", f"{POSITION}=3", "--per-sensor"]
    found = searched(command, path, 0.3, *flags)
    assert set(found) == POLICY_KEYS | {"per_sensor"}
    # the other one is not attacked
    assert set(found["per_sensor"]) == {POSITION}
    row = found["per_sensor"][POSITION]
    assert set(row) == {"every", "for", "first"}
    assert [found[key] for key in ("every", "for", "first")] == [None] * 3
    assert found["share"] == pytest.approx(row["for"] / row["every"] / 2)
    assert found["cost"] == pytest.approx(3 * row["for"] / row["every"])
    text = ",".join(f"{key}={value}" for key, value in row.items())
    enforce = ["--enforce", f"{POSITION}:{text}"]
    norm = reached(command, path, 8, *who, *enforce)["norm"]
    assert max(norm) <= found["worst"] * (1 + 1e-9) <= 0.3 * (1 + 1e-9)
    code, out, _ = command("policy", path, "--limit", "0.3", *flags)
    assert (code, out.splitlines()[0]) == (0, " ".join(enforce))


def test_nothing_need_be_done(folder, command):
    text = SCENARIO.replace("[[1.0, 0.1], [0.0, 1.0]]", "[[0.5, 0.1], [0.0, 0.5]]", 1)
    (folder / "calm.toml").write_text(text)
    found = searched(command, folder / "calm.toml", 10.0, *ALL, "--per-sensor")
    assert [found[key] for key in ("every", "for", "first", "share")] == [None, 0, None, 0.0]
    assert (found["per_sensor"], found["proof"]) == ({}, "period")
    assert 0 < found["worst"] <= 10.0
    _, out, _ = command("policy", folder / "calm.toml", "--limit", "10", *ALL)
    assert out.startswith("Nothing need be authenticated")


@pytest.mark.parametrize("name", ["reach", "policy"])
def test_a_folder(path, command, tmp_path, name):
    flags = ["--steps", "20", *([] if name == "reach" else ["--limit", "0.5"])]
    place = tmp_path / "new" / "folder"
    code, out, err = command(name, path, *flags, *ALL, *SUMS, "-o", place, "--json")
    assert (code, err) == (0, "")
    assert sorted(p.name for p in place.iterdir()) == [f"{name}.json", f"{name}.png"]
    assert (place / f"{name}.json").read_text() == out
    picture = (place / f"{name}.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert picture.endswith(b"IEND\xaeB`\x82")
    found = json.loads(out, parse_constant=lambda word: pytest.fail(f"{word} in the JSON"))
    if name == "policy":
        (mine,) = [p for p in found["trade_off"] if p["share"] == found["share"]]
        assert mine["worst"] == pytest.approx(found["worst"], rel=1e-9)
        assert {"every", "for", "share", "cost", "worst"} == set(mine)


def test_a_figure_and_words(path, command, tmp_path):
    flags = ["--steps", "4", "--detector", "windowed", "--length", "3", *ALL]
    code, out, _ = command("reach", path, *flags, "-o", tmp_path)
    assert (code, out.split()[0]) == (0, "step")
    assert (tmp_path / "reach.png").stat().st_size > 1000
