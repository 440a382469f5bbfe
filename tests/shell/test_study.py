"""Study files: what they mean, and what is said of those that cannot be used."""

import json

import pytest

from holdfast.shell.errors import InputError
from holdfast.shell.points import prepare
from holdfast.shell.study import read_study
from studied import scenario_text, study_text


@pytest.fixture
def study(tmp_path):
    (tmp_path / "scenario.toml").write_text(scenario_text())

    def write(axes="", **settings):
        path = tmp_path / "study.toml"
        path.write_text(study_text(axes, **settings))
        return path

    return write


def test_points_are_all_combinations_in_order(study):
    found = read_study(study('"attack.value" = [1, 2.5]\n"detector.level" = [0.01, 0.1, 0.2]'))
    assert len(found.points) == 6
    assert found.labels_of(found.points[4]) == {"attack.value": 2.5, "detector.level": 0.1}
    content, truth = found.content_of(found.points[4])
    assert (content["attack"][0]["value"], content["detector"]["level"], truth) == (2.5, 0.1, None)
    assert found.content["attack"][0]["value"] == 1.5  # the study's own is not touched


def test_whole_tables_lists_of_attacks_and_the_truth_alone(study):
    axes = """
"estimator" = [{ label = "plain", kind = "kalman", x0 = [0, 0], P0 = [1, 1] },
               { kind = "unknown_input", x0 = [0, 0], P0 = [1, 1] }]
"attack" = [[], { kind = "bias", channel = "sensor:gps", value = 1 },
            [{ kind = "freeze", channel = "sensor:gps" },
             { kind = "freeze", channel = "sensor:wheel" }]]
"truth.A" = [[[1.0, 0.1], [0.0, 0.98]], [[1.0, 0.1], [0.0, 0.9]]]
"""
    found = read_study(study(axes))
    assert [axis.labels for axis in found.axes] == [
        ("plain", "unknown_input"), ("none", "bias", "freeze+freeze"), ("number 1", "number 2"),
    ]  # fmt: skip
    prepared = prepare(found, False)
    assert prepared.programs == 2
    last = prepared.cases[-1].scenario
    assert last.plant.A[1, 1] == 0.9
    assert last.monitor.estimator.plant.A[1, 1] == 0.98
    assert len(last.attacks) == 2


def test_an_entry_of_a_matrix_and_of_the_true_one(study):
    found = read_study(study('"plant.R[2,2]" = [0.5]\n"truth.A[2,2]" = [0.9]\n"truth.dt" = [0.1]'))
    case = prepare(found, False).cases[0]
    ours, truth = case.scenario.monitor.estimator.plant, case.scenario.plant
    assert (ours.R[1, 1], truth.R[1, 1]) == (0.5, 0.5)
    assert (ours.A[1, 1], truth.A[1, 1]) == (0.98, 0.9)


def test_keys_come_from_what_a_point_is_and_not_from_its_place(study):
    few = prepare(read_study(study('"attack.value" = [2.0]')), False)
    many = prepare(read_study(study('"attack.value" = [1.0, 2.0]')), False)
    assert (few.keys[0] == many.keys[1]).all()
    assert not (many.keys[0] == many.keys[1]).all()
    common = prepare(read_study(study('"attack.value" = [1.0, 2.0]', common_noise="true")), False)
    assert (common.keys[0] == common.keys[1]).all()


def test_a_calibration_given_is_that_made(study):
    axes = '"detector" = [{ kind = "windowed", on = "residual" }, { kind = "chi_square" }]'
    found = read_study(study(axes))
    made = prepare(found, False)
    given = prepare(found, False, json.loads(json.dumps(made.values)))
    assert made.values[1] is None  # exact
    for ours, theirs in zip(made.cases, given.cases, strict=True):
        a, b = ours.scenario.monitor.detector, theirs.scenario.monitor.detector
        assert a.factor == b.factor


MANY = list(range(400))
WRONG = {
    "no axis of that name": ('"atack.value" = [1]', {}, 'axes."atack.value"', "mean 'attack'"),
    "no list": ('"attack.value" = 1', {}, 'axes."attack.value": found 1', "a list of the values"),
    "an empty list": ('"attack.value" = []', {}, "an empty list", "a list of the values"),
    "twice": ('"attack.value" = [1, 1]', {}, "comes twice", "values that differ"),
    "a third attack": ('"attack[3].value" = [1]', {}, "attack of 1", "attack[1] to attack[1]"),
    "a wrong value": ('"attack.value" = [1, "a"]', {}, "at attack.value = a: attack[1]", "number"),
    "a wrong key": ('"attack.sise" = [1]', {}, "at attack.sise = 1.0", "an unknown key"),
    "a wrong setting": ("", {"runs": 0}, "study.runs: found 0", "from 1 up"),
    "an unknown setting": ("", {"rusn": 5}, "study.rusn", "did you mean 'runs'"),
    "no scenario": ("", {"scenario": '"other.toml"'}, "other.toml", "no such file"),
    "a truth of what": ('"truth" = [1]', {}, "truth.KEY", "one of [plant]"),
    "a true start": ('"truth.x0" = [[1, 1]]', {}, "truth.x0", "plant.x0"),
    "other names": ('"truth.states" = [["a", "b"]]', {}, "a true plant with other states"),
    "outside a matrix": ('"plant.R[4,1]" = [1]', {}, "R of 3", "R[1] to R[3]"),
    "too many": (f'"attack.value" = {MANY}\n"attack.start" = {MANY}', {}, "160000", "100000"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_said_in_a_line(study, name):
    axes, settings, *words = WRONG[name]
    path = study(axes)
    text = path.read_text()
    for key, value in settings.items():
        lines = [line for line in text.splitlines() if not line.startswith(f"{key} =")]
        text = "\n".join([lines[0], f"{key} = {value}", *lines[1:]])
    path.write_text(text)
    with pytest.raises(InputError) as raised:
        prepare(read_study(path), False)
    for word in words:
        assert word in str(raised.value)
    assert "\n" not in str(raised.value)


def test_no_toml(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text("[study\n")
    with pytest.raises(InputError, match="no TOML"):
        read_study(path)
