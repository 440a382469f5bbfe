"""`holdfast analyse` on a bank of modes: the field ``modes``, a table and sentences."""

import json
import re

import numpy as np
import pytest

from holdfast.analysis.modes import reduce
from holdfast.shell.modes_content import MOST, modes_content
from systems import quiet_plant


def test_the_field():
    """Two sensors of the position, each of which may lie, and a push."""
    plant = quiet_plant(
        A=[[1.0, 0.1], [0.0, 1.0]], C=[[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]],
        G=[[0.0, 0.0, 0.005], [0.0, 0.0, 0.1]],
        H=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]],
        Q=1e-4 * np.eye(2), R=np.eye(3), attacks=("of_gps", "of_beacon", "push"),
    )  # fmt: skip
    found = modes_content(reduce(plant, np.zeros(2)))
    assert json.loads(json.dumps(found, allow_nan=False)) == {
        "all": 8,
        "kept": [
            {"position": "normal", "attacks": ["of_gps", "push"], "samples": 1},
            {"position": "normal", "attacks": ["of_beacon", "push"], "samples": 1},
        ],
        "refused": [
            {
                "position": "normal",
                "attacks": ["of_gps", "of_beacon"],
                "reason": "the samples then do not determine the state",
            }
        ],
        "confusable": [["of_gps+push", "of_beacon+push"]],
        "local": False,
        "reason": None,
    }


@pytest.mark.slow
def test_an_assumption_that_is_not_met_is_said(tmp_path, command):
    """Of the channels that the scenario's estimator assumes attacked."""
    path = tmp_path / "still.toml"
    path.write_text(STILL)
    code, out, err = command("analyse", path)
    assert (code, err) == (0, "")
    said = " ".join(out.split())
    assert "With d1 attacked, Assumption 5.2 of NISE is not met: the process noise has no" in said


STILL = """
[plant]
kind = "linear"
dt = 1.0
A = [[0.9]]
C = [[1.0]]
G = [[1.0]]
Q = [[0.0]]
R = [[1.0]]

[estimator]
kind = "nise"
x0 = [0.0]
P0 = [[1.0]]

[detector]
kind = "chi_square"
"""


def test_more_channels_than_are_listed():
    wide = quiet_plant(A=0.5 * np.eye(2), C=np.eye(2), G=np.ones((2, 13)), Q=np.eye(2), R=np.eye(2))
    modes = modes_content(reduce(wide, np.zeros(2), most=MOST))
    assert (modes["all"], modes["reason"]) == (2**13, "13 attack channels, over 12")
    assert [modes[key] for key in ("kept", "refused", "confusable")] == [None] * 3


NETWORK = """\
[plant]
kind = "swing"
lines = [[1, 2], [2, 3], [1, 3]]
generators = [1]
attacks = ["actuator:1", "sensor:P_elec:2"]
switches = [["1-3"]]

[estimator]
kind = "extended"
x0 = [0, 0, 0, 0, 0, 0]
P0 = [[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0], \
[0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 1]]

[detector]
kind = "chi_square"
on = "residual"
"""


@pytest.mark.slow
def test_switches_are_positions(tmp_path, command):
    path = tmp_path / "network.toml"
    path.write_text(NETWORK)
    code, out, err = command("analyse", path)
    assert (code, err) == (0, "")
    both = "actuator:1+sensor:P_elec:2"
    assert re.search(rf"normal: {re.escape(both)} +1 row", out)
    assert re.search(rf"1-3: {re.escape(both)} +1 row", out)
    assert f"Of 8 modes, 2 are enough: {both}, at each of 2 positions." in out
    assert "The reduction holds for the plant linearised there" in out
