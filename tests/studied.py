"""A car whose sensors and actuator may lie, as scenario and study texts for tests."""

import re
from pathlib import Path

PLANT = """\
[plant]
kind = "linear"
dt = 0.1
A = [[1.0, 0.1], [0.0, 0.98]]
B = [[0.005], [0.1]]
C = [[1, 0], [1, 0], [0, 1]]
G = [[0, 0.005], [0, 0.1]]
H = [[1, 0], [0, 0], [0, 0]]
Q = [[1e-5, 0], [0, 4e-4]]
R = [[0.25, 0, 0], [0, 0.09, 0], [0, 0, 0.0025]]
states = ["place", "speed"]
inputs = ["accel"]
outputs = ["gps", "beacon", "wheel"]
attacks = ["gps_spoof", "accel_attack"]
"""
KALMAN = 'kind = "kalman"'
DETECTOR = '[detector]\nkind = "chi_square"\nlevel = 0.05'
SPOOF = '[[attack]]\nkind = "bias"\nchannel = "channel:gps_spoof"\nstart = 2\nvalue = 1.5'


def documented(word: str) -> str:
    """The one Python example in docs/campaigns.md that has this word."""
    text = (Path(__file__).parents[1] / "docs" / "campaigns.md").read_text()
    (found,) = [code for code in re.findall(r"```python\n(.*?)```", text, re.S) if word in code]
    return found


def scenario_text(estimator: str = KALMAN, attack: str = SPOOF, detector: str = DETECTOR) -> str:
    """The scenario with these tables."""
    start = "x0 = [0, 0]\nP0 = [0.01, 0.01]"
    tables = PLANT, f"[estimator]\n{estimator}\n{start}", detector, attack
    return "\n\n".join(tables) + "\n"


def study_text(axes: str = "", **settings) -> str:
    """A study of ``scenario.toml``, 300 runs of 40 steps unless told otherwise."""
    found = {"runs": 300, "steps": 40} | settings
    lines = [f"{name} = {value}" for name, value in found.items()]
    return "\n".join(["[study]", 'scenario = "scenario.toml"', *lines, "", "[axes]", axes]) + "\n"
