"""What it costs to steer a drone such that all five of its sensors see every mode of the loop.

An observer who does not know the inputs sees the closed loop alone, and the exact decoder corrects
q attacked sensors per step only if every mode is seen by more than 2 q of them.
"""

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from holdfast.analysis.correctable import correctable
from holdfast.analysis.model import model_at
from holdfast.analysis.poles import candidates
from holdfast.controllers.feedback import closed_loop
from holdfast.plants.library import quadrotor

plant = quadrotor.build(sensors=5)
weights = {"state_weight": np.eye(10).tolist(), "input_weight": np.eye(3).tolist()}

table = Table(title="LQR, and its poles made real and spread out", box=box.SIMPLE)
for heading in (
    "spread by",
    "cost",
    "sensors that see a mode",
    "weakest view",
    "l0, long window",
    "l1, T = 10",
):
    table.add_column(heading, justify="right")
for one in candidates(plant, sizes=(0.01, 0.1, 0.3), **weights):
    # of the l0 count the analysis of poles says what a long window corrects
    found = correctable(model_at(closed_loop(plant, one.gain), np.zeros(10)), 10)
    table.add_row(
        f"{one.size:g}" if one.size else "LQR",
        f"{one.cost:.2f}",
        f"{min(one.supports)} to {max(one.supports)}",
        f"{one.weakest:.1e}",
        f"{one.corrected}",
        f"{found.l1.lower}" if found.l1.exact is not None else f"at most {found.l1.upper}",
    )
Console(width=90).print(table)
