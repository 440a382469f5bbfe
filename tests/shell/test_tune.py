"""`holdfast tune`: what it finds where the best is known, and what it refuses."""

import json

import pytest

SCENARIO = """
[plant]
kind = "linear"
dt = 1.0
A = [[0.95]]
C = [[1.0]]
G = [[1.0]]
Q = [[1.0]]
R = [[1.0]]

[estimator]
kind = "kalman"
x0 = [0.0]
P0 = [[1.0]]

[detector]
kind = "chi_square"
on = "residual"
level = 0.05
"""
STUDY = """
[study]
scenario = "scenario.toml"
runs = 256
steps = 100

[axes]
"truth.R" = [[[100.0]]]

[tune]
objective = "state_rmse:x1"
evaluations = 40
{more}

[settings]
"plant.R[1,1]" = [1.0, 10000.0]
"""


@pytest.fixture
def study(tmp_path):
    def write(text=STUDY, scenario=SCENARIO, more=""):
        (tmp_path / "scenario.toml").write_text(scenario)
        path = tmp_path / "tune.toml"
        path.write_text(text.replace("{more}", more))
        return path

    return write


def test_the_noise_of_a_sensor_is_found(study, command):
    """The best filter is the one that knows the noise: R = 100 (its error is flat about it)."""
    path = study()
    code, out, err = command("tune", path, "-o", path.parent / "out")
    assert (code, err) == (0, "")
    found = json.loads((path.parent / "out" / "tune.json").read_text())
    best = found["trials"][0]
    assert 50 < best["settings"]["plant.R[1,1]"] < 200
    near = [t for t in found["trials"] if t["settings"]["plant.R[1,1]"] < 5]
    assert all(t["objective"] > 1.1 * best["objective"] for t in near)
    text = (path.parent / "out" / "settings.toml").read_text()
    assert text == f"plant.R[1,1] = {best['settings']['plant.R[1,1]']!r}\n"
    assert "best" in out


@pytest.mark.slow
def test_a_benign_loss_and_a_limit_bind(study, command):
    """A large R makes the filter slow: that withstands a lie of the sensor, and costs without."""
    axes = '"attack" = [[], { kind = "bias", channel = "sensor:y1", value = 10, start = 20 }]'
    text = STUDY.replace('"truth.R" = [[[100.0]]]', axes)
    objectives = {}
    for loss in (0.02, 0.5):
        path = study(text, more=f"benign_loss = {loss}")
        folder = path.parent / str(loss)
        assert command("tune", path, "-o", folder)[0] == 0
        best = json.loads((folder / "tune.json").read_text())["trials"][0]
        assert best["broken"] == 0
        objectives[loss] = best["objective"], best["settings"]["plant.R[1,1]"]
    assert objectives[0.5][0] < objectives[0.02][0]
    assert objectives[0.5][1] > objectives[0.02][1] >= 1.0
    path = study(text, more='limits = { "false_alarm_rate" = 1e-9 }')
    code, out, _ = command("tune", path)
    assert code == 0
    assert "broken by" in out or "kept" in out


WRONG = {
    "an objective": ('"state_rmse:x1"', '"state_rmse:x2"', "did you mean 'state_rmse:x1'"),
    "a setting": (
        '"plant.R[1,1]" = [1.0, 10000.0]',
        '"plant.R[1,1]" = 3',
        "the lowest and the highest",
    ),
    "an order": ("[1.0, 10000.0]", "[2.0, 1.0]", "the lower one first"),
    "a name": ('"plant.R[1,1]" = [1', '"plant R" = [1', 'settings."plant R"'),
    "no settings": ('"plant.R[1,1]" = [1.0, 10000.0]', "", "settings: found nothing"),
    "a key": ("evaluations = 40", "evaluation = 40", "did you mean 'evaluations'"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_said_in_a_line(study, command, name):
    old, new, words = WRONG[name]
    code, out, err = command("tune", study(STUDY.replace(old, new)))
    assert (code, out) == (2, "")
    assert words in err
    assert err.count("\n") == 1


def test_a_loss_of_nothing_without_a_benign_point(study, command):
    attacked = SCENARIO + '\n[[attack]]\nkind = "bias"\nchannel = "sensor:y1"\nvalue = 1\n'
    code, _, err = command("tune", study(scenario=attacked, more="benign_loss = 0.1"))
    assert code == 2
    assert "no point without attack" in err
