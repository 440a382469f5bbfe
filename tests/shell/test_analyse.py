"""`holdfast analyse`: JSON that others rely on, a table, and errors."""

import json
import math
import re

import numpy as np
import pytest

from shell_samples import SCENARIO


def analysed(command, path):
    code, out, err = command("analyse", path, "--json")
    assert (code, err) == (0, "")
    return json.loads(out, parse_constant=lambda word: pytest.fail(f"{word} in the JSON"))


def numbers(value):
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [n for one in value for n in numbers(one)]
    return [value] if isinstance(value, float) else []


def test_json_has_what_others_rely_on(folder, command):
    found = analysed(command, folder / "scenario.toml")
    assert found["observable"] is True
    assert (found["observability_index"], found["unstable"]) == (1, 2)
    assert found["eigenvalues"] == [[1.0, 0.0], [1.0, 0.0]]
    A, C = np.array([[1.0, 0.1], [0.0, 1.0]]), np.eye(2)
    Q, R = np.diag([1e-6, 1e-4]), np.diag([0.25, 0.0025])
    steady = {name: np.array(found["steady_state"][name]) for name in ("K", "P", "P_pred")}
    # the equations of the fixed point, to the accuracy at which the recursion stops
    S = C @ steady["P_pred"] @ C.T + R
    np.testing.assert_allclose(steady["K"] @ S, steady["P_pred"] @ C.T, rtol=1e-9)
    P = (np.eye(2) - steady["K"] @ C) @ steady["P_pred"]
    np.testing.assert_allclose(steady["P"], P, rtol=1e-7)
    np.testing.assert_allclose(steady["P_pred"], A @ steady["P"] @ A.T + Q, rtol=1e-7)
    attacks = found["attacks"]
    assert attacks["channels"]["accel_attack"]["delay"] == 0
    assert (attacks["identified"], attacks["delay"], attacks["rank"]) == (True, 0, 1)
    assert attacks["bounded"][0]["attack"] == {"accel_attack": True}
    assert found["modes"] == {
        "all": 2,
        "kept": [{"position": "normal", "attacks": ["accel_attack"], "samples": 1}],
        "refused": [],
        "confusable": [],
        "local": False,
        "reason": None,
    }
    # a Kalman filter assumes no mode
    assert found["advice"] == []
    assert found["window"] is None
    assert all(math.isfinite(number) for number in numbers(found))


PAPER = """\
[plant]
kind = "linear"
dt = 1.0
A = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -2.0]]
C = [[1.0, 0.0, 0.0], [1.0, 1.0, -1.0], [1.0, 2.0, 1.0], [1.0, -1.0, -0.5], [-0.5, 1.0, 1.0]]
Q = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
R = [[1.0, 0, 0, 0, 0], [0, 1.0, 0, 0, 0], [0, 0, 1.0, 0, 0], [0, 0, 0, 1.0, 0], [0, 0, 0, 0, 1.0]]

[estimator]
kind = "kalman"
x0 = [0.0, 0.0, 0.0]
P0 = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]

[detector]
kind = "chi_square"
on = "residual"
"""


def test_fusion_of_the_paper_s_example(folder, command):
    (folder / "paper.toml").write_text(PAPER)
    found = analysed(command, folder / "paper.toml")
    fusion = found["fusion"]
    assert set(fusion) == {
        "ratio", "lower", "upper", "bounded", "all_p", "all_p_bounds", "withstood", "untried",
        "sparse_observable", "authenticate", "add", "condition", "derogatory", "reason",
    }  # fmt: skip
    ratio = {"y1": 0.4305, "y2": 1.6873, "y3": 1.1460, "y4": 0.7579, "y5": 0.4379}
    assert fusion["ratio"] == pytest.approx(ratio, abs=5e-5)
    assert fusion["ratio"] == fusion["lower"] == fusion["upper"]
    assert fusion["bounded"] == {name: value < 1 for name, value in ratio.items()}
    assert fusion["all_p"] == pytest.approx({"1": 1.6873, "2": 6.265}, abs=5e-5)
    assert fusion["all_p"] == fusion["all_p_bounds"]["lower"] == fusion["all_p_bounds"]["upper"]
    assert (fusion["withstood"], fusion["sparse_observable"], fusion["reason"]) == (0, 1, None)
    best = fusion["authenticate"][0]
    assert (best["name"], best["enough"], best["ratio"]) == ("y2", True, best["upper"])
    assert [remedy["name"] for remedy in fusion["add"]] == ["x3", "x2", "x1"]
    # the plant has no attack channel: it is its sensors that may lie
    assert found["advice"][0].startswith("Under the LASSO fusion this plant cannot afford a lie")
    _, out, _ = command("analyse", folder / "paper.toml")
    assert re.search(r"sensor +worst ratio +bounded under a lie", out)
    assert re.search(r"y1 +0.431 +yes", out)
    assert re.search(r"y2 +1.69 +no", out)


def test_an_infinite_ratio_is_null(folder, command):
    """Each state has one sensor."""
    text = SCENARIO.replace("A = [[1.0, 0.1], [0.0, 1.0]]", "A = [[0.9, 0.0], [0.0, 0.9]]")
    (folder / "alone.toml").write_text(text)
    found = analysed(command, folder / "alone.toml")
    fusion = found["fusion"]
    assert fusion["ratio"] == fusion["lower"] == fusion["upper"] == {"gps": None, "wheel": None}
    assert fusion["bounded"] == {"gps": False, "wheel": False}
    assert fusion["all_p"] == {"1": None}
    # its attack channel is what this scenario is about
    assert not any("LASSO" in sentence for sentence in found["advice"])


def test_null_where_there_is_none(folder, command):
    """Only the speed is measured: the position is not observable."""
    text = SCENARIO.replace("C = [[1.0, 0.0], [0.0, 1.0]]", "C = [[0.0, 1.0]]")
    text = text.replace("R = [[0.25, 0.0], [0.0, 0.0025]]", "R = [[0.0025]]")
    text = text.replace('["gps", "wheel"]', '["wheel"]').replace("sensor:gps", "sensor:wheel")
    (folder / "speed.toml").write_text(text)
    found = analysed(command, folder / "speed.toml")
    assert (found["observable"], found["observability_index"]) == (False, None)
    assert found["unobserved"] == [{"position": 1.0, "speed": 0.0}]
    assert [found["steady_state"][name] for name in ("K", "P", "P_pred")] == [None] * 3
    assert "unstable mode 1" in found["steady_state"]["reason"]
    assert (found["fusion"]["ratio"], found["fusion"]["withstood"]) == ({}, None)
    assert "one sensor" in found["fusion"]["reason"]
    assert any('measure "position"' in sentence for sentence in found["advice"])


def test_a_table_and_sentences(folder, command):
    text = SCENARIO.replace("G = [[0.005], [0.1]]", "G = [[0.0], [0.1]]")
    text = text.replace("C = [[1.0, 0.0], [0.0, 1.0]]", "C = [[1.0, 0.0]]")
    text = text.replace("R = [[0.25, 0.0], [0.0, 0.0025]]", "R = [[0.25]]")
    text = text.replace('["gps", "wheel"]', '["gps"]')
    text = text.replace('kind = "kalman"', 'kind = "unknown_input"')
    (folder / "late.toml").write_text(text)
    code, out, err = command("analyse", folder / "late.toml")
    assert (code, err) == (0, "")
    assert re.search(r"observable +yes, from 2 rows", out)
    assert re.search(r"accel_attack +the state +1 +yes", out)
    assert 'set delay = 1, or measure "speed" and it is identified at once.' in out
    assert "The estimator's delay is 0: set it to 1." in out


def test_matrices_per_step(folder, command):
    C = np.zeros((6, 1, 2))
    C[:3, 0, 0] = C[3:, 0, 1] = 1.0
    np.savez(folder / "plant.npz", C=C)
    text = SCENARIO.replace(
        "C = [[1.0, 0.0], [0.0, 1.0]]", 'C = { file = "plant.npz", name = "C" }'
    ).replace("A = [[1.0, 0.1], [0.0, 1.0]]", "A = [[1.0, 0.0], [0.0, 0.9]]")
    text = text.replace("R = [[0.25, 0.0], [0.0, 0.0025]]", "R = [[0.25]]")
    text = text.replace('["gps", "wheel"]', '["gps"]')
    (folder / "steps.toml").write_text(text)
    found = analysed(command, folder / "steps.toml")
    assert found["of"] == "the matrices of step 1 of 6"
    # of step 1 alone the speed is hidden, over the window the fourth row shows it
    assert found["observable"] is False
    assert found["window"] == {"steps": 6, "rows": 4, "undetermined": {"accel_attack": 0}}


def test_a_nonlinear_plant_is_linearised(folder, command):
    (folder / "pendulum.py").write_text(
        "import jax.numpy as jnp, numpy as np\n"
        "from holdfast.plants.nonlinear import nonlinear_plant\n"
        "def make():\n"
        "    f = lambda x, u, d: x + 0.1 * jnp.array([x[1], -jnp.sin(x[0]) + d[0]])\n"
        "    return nonlinear_plant(f, lambda x, u, d: x[:1], Q=np.eye(2), R=np.eye(1), dt=0.1,\n"
        "        states=('angle', 'rate'), outputs=('encoder',), attacks=('torque',))\n"
    )
    (folder / "nonlinear.toml").write_text(
        '[plant]\nkind = "python"\ntarget = "pendulum:make"\n'
        '[estimator]\nkind = "extended"\nx0 = [0.0, 0.0]\nP0 = [[1.0, 0.0], [0.0, 1.0]]\n'
        '[detector]\nkind = "chi_square"\non = "residual"\n'
    )
    code, out, _ = command("analyse", folder / "nonlinear.toml", "--json", "--allow-python")
    assert code == 0
    found = json.loads(out)
    # x' = (1, 0.1; -0.1, 1) x about rest: 1 +- 0.1 i
    np.testing.assert_allclose(found["eigenvalues"], [[1.0, 0.1], [1.0, -0.1]], rtol=1e-12)
    assert found["attacks"]["channels"]["torque"]["delay"] == 1
    assert "linearised" in found["of"]
    assert found["of"] in found["advice"][0]


def test_errors_are_those_of_the_other_commands(folder, command):
    code, out, err = command("analyse", folder / "absent.toml", "--json")
    assert (code, out) == (2, "")
    assert "absent.toml" in err
    assert err.count("\n") == 1


HOPPING = """\
[plant]
kind = "linear"
A = [[1.0]]
C = [[100.0], [1.0], [1.0]]
Q = [[1e-6]]
R = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]

[estimator]
kind = "l1_decoder"
window = 4

[detector]
kind = "chi_square"
"""


def test_what_decoders_correct_is_two_numbers(tmp_path, command):
    """The errata's counterexample: the paper's condition holds for l0, and l1 corrects nothing."""
    path = tmp_path / "hopping.toml"
    path.write_text(HOPPING)
    found = analysed(command, path)
    said = found["correctable"]
    assert (said["window"], said["l0"], said["l1"]) == (4, 1, 0)
    # (100 of 102) over (2 of 102), at every step
    assert said["l1_ratio"]["1"] == pytest.approx(50.0, rel=1e-12)
    assert said["relaxed"] == 5
    assert any("l0 corrects 1 attack per step" in text for text in found["advice"])
    assert all(math.isfinite(number) for number in numbers(found))


CALM = SCENARIO.replace("G = [[0.005], [0.1]]\n", "").replace('attacks = ["accel_attack"]\n', "")
"""The cart without attack channels."""


def test_who_moves_the_filter_unseen(folder, command):
    code, out, err = command(
        "analyse", folder / "scenario.toml", "--compromised", "wheel, gps", "--json"
    )
    assert (code, err) == (0, "")
    found = json.loads(out, parse_constant=lambda word: pytest.fail(f"{word} in the JSON"))
    assert found["attackable"] == {"gps": True, "wheel": False, "wheel,gps": True, "all": True}
    how = found["attackable_how"]
    assert set(how) == {
        "radius", "modes", "theorem_4", "corollary_2", "smallest", "shields", "reason",
    }  # fmt: skip
    assert how["radius"] == {"gps": 1.0, "wheel": 0.0, "wheel,gps": 1.0, "all": 1.0}
    (mode,) = how["modes"]["gps"]
    assert (mode["z"], mode["multiplicity"]) == ([1.0, 0.0], 1)
    assert mode["directions"] == [{"position": 1.0, "speed": 0.0}]
    assert (how["theorem_4"], how["corollary_2"]["wheel"], how["reason"]) == (1, 0, None)
    assert how["smallest"] == {"longest": 100, "usual": 1, "others": {}}
    assert how["shields"] == ["gps"]
    assert all(math.isfinite(number) for number in numbers(found))


def test_stealth_is_told_of_where_it_is_asked_for(folder, command):
    (folder / "calm.toml").write_text(CALM)
    _, out, _ = command("analyse", folder / "calm.toml")
    assert re.search(r"altered +stealthy error +modes", out)
    assert re.search(r"gps +without limit +1", out)
    assert re.search(r"wheel +bounded", out)
    assert 'who alters "gps" can move the estimate along position without limit (mode 1).' in out
    # with attack channels it is told only on request; a decoder's scenario likewise
    _, out, _ = command("analyse", folder / "scenario.toml")
    assert "stealthy" not in out
    _, out, _ = command("analyse", folder / "scenario.toml", "--compromised", "all")
    assert re.search(r"all +without limit +1 \(2 times\)", out)
    assert 'Authenticating "gps" and "wheel" for 1 step in every L bounds this' in out
    path = folder / "hopping.toml"
    path.write_text(HOPPING)
    _, out, _ = command("analyse", path)
    assert "stealthy" not in out


BY_NAME = "expected all by itself, or names with commas between: one of 'gps', 'wheel'"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("gsp", f"found 'gsp', {BY_NAME}; did you mean 'gps'?"),
        ("", f"found an empty name in '', {BY_NAME}"),
        ("gps,", f"found an empty name in 'gps,', {BY_NAME}"),
        ("gps,wheel,gps", "found 'gps' twice, expected every output once"),
        ("all,gps", f"found 'all', {BY_NAME}"),
    ],
)
def test_names_that_are_none(folder, command, text, expected):
    code, out, err = command("analyse", folder / "scenario.toml", "--compromised", text, "--json")
    assert (code, out) == (2, "")
    assert err.startswith("--compromised: ")
    assert expected in err
    assert err.count("\n") == 1


def test_no_gain_is_null_for_every_name(folder, command):
    """Only the speed is measured, twice: there is no steady-state filter."""
    text = SCENARIO.replace("C = [[1.0, 0.0], [0.0, 1.0]]", "C = [[0.0, 1.0], [0.0, 1.0]]")
    (folder / "speed.toml").write_text(text)
    code, out, _ = command("analyse", folder / "speed.toml", "--compromised", "gps,wheel", "--json")
    assert code == 0
    found = json.loads(out)
    assert found["attackable"] == dict.fromkeys(["gps", "wheel", "gps,wheel", "all"])
    assert "no steady-state" in found["attackable_how"]["reason"]
    assert found["attackable_how"]["radius"]["all"] is None
    assert "cannot be said" in found["advice"][-1]
