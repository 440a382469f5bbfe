"""How far an attacker gets who raises no alarm, and how few messages need a tag to stop him."""

import numpy as np

from holdfast.numerics.stealth import Stealth
from holdfast.plants.library import vehicle_tracking
from holdfast.plants.watched import watched
from holdfast.reach.bounds import reach
from holdfast.reach.forever import forever
from holdfast.reach.policy import policy
from holdfast.reach.setting import Setting

LIMIT = 2.0

plant = vehicle_tracking.build()
everything = Setting(
    system=watched(plant),
    stealth=Stealth("chi_square", epsilon=0.001, level=0.015, dof=2),
    compromised=np.array([True, True]),
    enforcement=None,
    functional=np.eye(2),
)

free = reach(everything, steps=60)
print(f"without tags: {free.norm[9]:.3f} after 10 steps, {free.norm[-1]:.3f} after 60")
ever = forever(everything)
print(f"bounded for ever: {ever.bounded} ({ever.reason})")

best = policy(everything, LIMIT)
every = int(best.enforcement.every[0])
print(
    f"one message in {every} authenticated ({100 * best.share:.1f} %): "
    f"no more than {best.worst:.3f}, for ever"
)

checked = reach(everything._replace(enforcement=best.enforcement), steps=2 * every)
assert np.max(checked.norm) <= best.worst * (1 + 1e-6) <= LIMIT * (1 + 1e-6)
assert np.all(checked.lower >= checked.norm * (1 - 1e-6))  # an attack reaches every bound
