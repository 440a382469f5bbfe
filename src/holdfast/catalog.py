"""Every part by the name that a scenario gives it. A new part is one line here.

The keys of a scenario's table are the keyword parameters of the function listed.
"""

from collections.abc import Callable
from typing import Any

from holdfast.attacks import (
    bias,
    covert,
    delay,
    freeze,
    hopping,
    noise,
    ramp,
    replay,
    sine,
    stealthy,
    switch,
    zero_dynamics,
)
from holdfast.controllers import feedback, linearising, pole_placement
from holdfast.detectors import (
    care_paper,
    chi_square,
    cusum,
    likelihood_ratio,
    per_channel,
    sprt,
    windowed,
)
from holdfast.estimators import (
    care,
    decomposition,
    extended,
    huber,
    kalman,
    l1_decoder,
    l1_kalman,
    nise,
    nisme,
    secure_fusion,
    unknown_input,
    unscented,
)
from holdfast.plants import build
from holdfast.plants.library import (
    bicycle,
    dcacc,
    five_sensors,
    gps_imu,
    quadrotor,
    swing,
    tanks,
    uav,
    unicycle,
    vehicle_tracking,
)

Builders = dict[str, Callable[..., Any]]

PLANTS: Builders = {
    "linear": build.linear_plant,
    "uav": uav.build,
    "bicycle": bicycle.build,
    "five_sensors": five_sensors.build,
    "quadrotor": quadrotor.build,
    "gps_imu": gps_imu.build,
    "vehicle_tracking": vehicle_tracking.build,
    "dcacc": dcacc.build,
    "unicycle": unicycle.build,
    "swing": swing.network,
    "swing68": swing.build,
    "tanks": tanks.build,
}

ESTIMATORS: Builders = {
    "kalman": kalman.build,
    "huber": huber.build,
    "unknown_input": unknown_input.build,
    "care": care.build,
    "extended": extended.build,
    "unscented": unscented.build,
    "decomposition": decomposition.build,
    "secure_fusion": secure_fusion.build,
    "l1_decoder": l1_decoder.build,
    "l1_kalman": l1_kalman.build,
    "nise": nise.build,
    "nisme": nisme.build,
}

DETECTORS: Builders = {
    "chi_square": chi_square.build,
    "windowed": windowed.build,
    "cusum": cusum.build,
    "sprt": sprt.build,
    "per_channel": per_channel.build,
    "likelihood_ratio": likelihood_ratio.build,
    "care_paper": care_paper.build,
}

ATTACKS: Builders = {
    "bias": bias.build,
    "ramp": ramp.build,
    "sine": sine.build,
    "noise": noise.build,
    "hopping": hopping.build,
    "replay": replay.build,
    "delay": delay.build,
    "freeze": freeze.build,
    "covert": covert.build,
    "stealthy": stealthy.build,
    "zero_dynamics": zero_dynamics.build,
    "switch": switch.build,
}

CONTROLLERS: Builders = {
    "lqr": feedback.build,
    "pole_placement": pole_placement.build,
    "linearising": linearising.build,
}

SECTIONS: dict[str, Builders] = {
    "plant": PLANTS,
    "estimator": ESTIMATORS,
    "detector": DETECTORS,
    "controller": CONTROLLERS,
    "attack": ATTACKS,
}
"""Every table of a scenario that has a ``kind``, and what it can be."""
