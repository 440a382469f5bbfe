"""A power grid of 68 buses: meters lie, generators are pushed, lines open; a bank of modes tells
which of them it is, how large the attack is, and where the grid really stands.
"""

import equinox as eqx
import jax
import numpy as np

from holdfast.attacks import bias, switch
from holdfast.controllers import linearising
from holdfast.detectors import chi_square
from holdfast.estimators import nisme
from holdfast.loop import Monitor, Scenario, simulate
from holdfast.plants.library import swing

plant = swing.build()
start = swing.operating_point(plant)
meters, generators = list(plant.attacks[:3]), list(plant.attacks[3:])
lines = plant.positions[-1]
modes = {
    "nothing": [],
    "meters 26, 53, 54 lie": meters,
    "generators 14, 15, 16 are pushed": generators,
    f"lines {lines} are open": {"switch": lines},
}
bank = nisme.build(
    plant, start, 1e-4 * np.eye(136), modes=list(modes.values()), freeze=1e-4,
    attack_prior_sd=[0.01] * 3 + [0.3] * 3,  # what a meter, a generator may be off by, per unit
)  # fmt: skip

second = 100  # samples
channels = [f"channel:{name}" for name in plant.attacks]
attacks = (
    bias.build(plant, value=0.01, channels=channels[:3], start=1, stop=2),
    bias.build(plant, value=-0.5, channels=channels[3:], start=2, stop=3),
    switch.build(plant, to=lines, start=3, stop=4),
)
monitor = Monitor(bank, chi_square.build(plant, on="attack"))
scenario = Scenario(plant, start, monitor, linearising.build(plant), attacks)


@eqx.filter_jit
def told(scenario, key):
    trace = simulate(scenario, key, 5 * second)
    assert trace.x is not None
    return trace.estimate.mode, trace.estimate.d, trace.estimate.x - trace.x


mode, d, error = map(np.asarray, told(scenario, jax.random.key(0)))
for k, true in enumerate([0, 1, 2, 3, 0]):
    rows = slice(k * second, (k + 1) * second)
    share, half = np.mean(mode[rows] == true), rows.stop - second // 2
    print(f"{k} to {k + 1} s: {list(modes)[true]}: named in {100 * share:.0f} % of the rows")
    assert np.mean(mode[half : rows.stop] == true) > 0.9
print(f"meter 26 is off by {d[150:200, 0].mean():.4f} (0.01), "
      f"generator 14 by {d[250:300, 3].mean():.2f} (-0.50)")  # fmt: skip
print(f"largest error of an angle or a frequency: {np.abs(error).max():.5f} rad or rad/s")
assert np.abs(error[second:]).max() < 1e-3
