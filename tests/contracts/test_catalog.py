"""Every part of the catalog keeps the contracts of its kind."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.catalog import ATTACKS, CONTROLLERS, DETECTORS, ESTIMATORS
from holdfast.loop import Monitor, replay
from holdfast.plants.build import linear_plant
from holdfast.plants.library import swing
from holdfast.records import Estimate, Observation
from holdfast.shell.live import Live
from holdfast.testing import check_attack, check_detector, check_estimator


def walker(**changes):
    """Position and speed; a position sensor under attack, speed twice, one of them attacked."""
    keys = dict(
        A=[[1.0, 0.1], [0.0, 0.97]],
        B=[[0.005], [0.1]],
        C=[[1.0, 0.0], [0.0, 1.0], [0.3, 1.0]],
        D=[[0.0], [0.1], [0.0]],
        G=[[0.0, 0.005], [0.0, 0.1]],
        H=[[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]],
        Q=[[0.02, 0.01], [0.01, 0.03]],
        R=[[0.5, 0.1, 0.0], [0.1, 0.2, 0.05], [0.0, 0.05, 0.3]],
        dt=0.1,
        inputs=["accel"],
        outputs=["gps", "wheel", "flow"],
        attacks=["spoof", "push"],
    )
    return linear_plant(**(keys | changes))


LIMITS = {
    "state": {"matrix": [[1.0, 0.0], [-1.0, 0.0]], "bound": [1.5, 1.5]},
    "attack": {"matrix": [[0.0, 1.0]], "bound": [1.0], "bound_u": [[-1.0]]},
}
PLANTS = {
    "both": walker(),
    "limits": walker(constraints=LIMITS),
    "sensor attack alone": walker(G=[[0.0], [0.0]], H=[[1.0], [0.0], [0.0]], attacks=["spoof"]),
    "actuator attack alone": walker(G=[[0.005], [0.1]], H=[[0.0]] * 3, attacks=["push"]),
    "no attack": walker(G=None, H=None, attacks=None),
}
SWITCHED = swing.network(
    lines=[[1, 2], [2, 3]], generators=[1], attacks=["actuator:1"], switches=[["1-2"], ["2-3"]]
)
"""What works with no other plant runs on this one."""
X0, P0 = np.array([0.3, -0.2]), np.array([[2.0, 0.3], [0.3, 1.0]])

# What each kind is given beyond its defaults. A new entry of the catalog needs a line here.
ESTIMATOR_SETTINGS = {
    "kalman": {},
    "huber": {},
    "unknown_input": {},
    "care": {},
    "extended": {},
    "nise": {},
    "nisme": {},
    "unscented": {},
    "decomposition": {},
    "secure_fusion": {"gamma": 2.0},
    "l1_decoder": {"window": 3},
    "l1_kalman": {"window": 3, "threshold": 5.0},
}
# Each compiles for half a minute; their own tests cover them in the quick tier.
LONG = {"care", "huber", "l1_decoder", "l1_kalman", "nisme", "secure_fusion"}
WHOLE = [pytest.mark.slow, pytest.mark.whole]
# Filters with a fixed gain: where a sensor never arrives its gain is not used, but those of the
# others stay, and so the filter is not that of a plant without the sensor.
FIXED_GAIN = {"decomposition", "secure_fusion"}
DETECTOR_SETTINGS = {
    "chi_square": {},
    "windowed": {"length": 4},
    "cusum": {"forgetting": 0.3},
    "sprt": {},
    "per_channel": {},
    "likelihood_ratio": {},
    "care_paper": {"forgetting": 0.3},
}
ATTACK_SETTINGS = {
    "bias": {"value": 2.0},
    "ramp": {"rate": 3.0},
    "sine": {"amplitude": 2.0, "frequency": 0.7, "phase": 0.4},
    "noise": {"sd": 1.5},
    "hopping": {"count": 1, "sd": 1.5},
    "replay": {"seconds": 0.4},
    "delay": {"seconds": 0.4},
    "freeze": {},
    "covert": {"size": 1.5},
    "stealthy": {"epsilon": 0.01},
    # from one channel of this plant nothing can hide; from these two a shift of the position can
    "zero_dynamics": {"size": 1.5, "channel": None, "channels": ["sensor:gps", "sensor:flow"]},
    "switch": {"to": "1-2+2-3"},
}
CONTROLLER_SETTINGS = {
    "lqr": {"state_weight": [[1, 0], [0, 1]], "input_weight": [[1]]},
    "pole_placement": {"poles": [[0.6, 0.1], [0.6, -0.1]]},
    "linearising": {},
}


def _long(kind):
    return [pytest.mark.slow] if kind in LONG else []


@pytest.mark.parametrize(
    ("catalog", "covered"),
    [
        (ESTIMATORS, ESTIMATOR_SETTINGS),
        (DETECTORS, DETECTOR_SETTINGS),
        (ATTACKS, ATTACK_SETTINGS),
        (CONTROLLERS, CONTROLLER_SETTINGS),
    ],
    ids=["estimators", "detectors", "attacks", "controllers"],
)
def test_every_entry_is_covered(catalog, covered):
    assert covered.keys() == catalog.keys()


@pytest.mark.parametrize(
    ("kind", "plant"),
    # what the attacks of the plant are concerns only those that estimate them
    [
        pytest.param(kind, "limits" if kind == "care" else "both", marks=_long(kind))
        for kind in ESTIMATOR_SETTINGS
    ]
    + [
        # the same code on parts of the plant above
        pytest.param("unknown_input", "actuator attack alone", marks=WHOLE),
        pytest.param("unknown_input", "sensor attack alone", marks=WHOLE),
        pytest.param("unknown_input", "no attack", marks=WHOLE),
    ],
)
def test_estimators(kind, plant):
    def build(plant):
        return ESTIMATORS[kind](plant, X0, P0, **ESTIMATOR_SETTINGS[kind])

    if kind in FIXED_GAIN:
        check_estimator(build(PLANTS[plant]), steps=20)
    else:
        check_estimator(build, PLANTS[plant], steps=20)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({"refit": True, "trusted": ["wheel"]}, marks=WHOLE),
        {"norm": "group"},
        pytest.param({"authenticated": ["gps", "flow"]}, marks=WHOLE),
    ],
    ids=["refit", "group", "authenticated"],
)
def test_secure_fusion_with_other_settings(settings):
    built = ESTIMATORS["secure_fusion"](PLANTS["both"], X0, P0, gamma=2.0, **settings)
    check_estimator(built, steps=20)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("l1_decoder", {"norm": "l1l2", "weights": "noise"}),
        pytest.param("l1_decoder", {"norm": "l1linf"}, marks=WHOLE),
        pytest.param("l1_decoder", {"norm": "l0", "threshold": 5.0}, marks=WHOLE),
        pytest.param("l1_decoder", {"trusted": ["wheel"]}, marks=WHOLE),
        ("l1_kalman", {"suspects": "gate"}),
        pytest.param("l1_kalman", {"suspects": "inflate", "threshold": 2.0}, marks=WHOLE),
    ],
)
def test_decoders_with_other_settings(kind, settings):
    def build(plant):
        trusted = [name for name in settings.get("trusted", ()) if name in plant.outputs]
        return ESTIMATORS[kind](plant, X0, P0, window=3, **(settings | {"trusted": trusted}))

    check_estimator(build, PLANTS["both"], steps=20)


@pytest.mark.parametrize("on", ["attack", "residual"])
@pytest.mark.parametrize("kind", DETECTOR_SETTINGS)
def test_detectors(kind, on):
    settings = DETECTOR_SETTINGS[kind]
    check_detector(DETECTORS[kind](PLANTS["both"], on=on, **settings), PLANTS["both"])


@pytest.mark.parametrize("channel", ["sensor:wheel", "actuator:accel", "channel:push"])
@pytest.mark.parametrize("kind", ATTACK_SETTINGS)
def test_attacks(kind, channel):
    if kind in ("replay", "delay", "freeze") and channel.startswith("channel:"):
        return  # tests/attacks holds that these are refused
    if kind == "zero_dynamics" and channel != "sensor:wheel":
        return  # it names its own
    if kind == "stealthy" and not channel.startswith("sensor:"):
        return  # tests/attacks holds that these are refused
    if kind == "switch":
        if channel == "sensor:wheel":  # once: it has no channel
            thrown = ATTACKS[kind](SWITCHED, start=0.1, stop=0.2, **ATTACK_SETTINGS[kind])
            check_attack(thrown, SWITCHED)
        return
    keys = {"channel": channel, "start": 1.0, "stop": 2.5, **ATTACK_SETTINGS[kind]}
    check_attack(ATTACKS[kind](PLANTS["both"], **keys), PLANTS["both"])


@pytest.mark.parametrize("kind", CONTROLLER_SETTINGS)
def test_controllers(kind):
    plant = SWITCHED if kind == "linearising" else PLANTS["both"]
    controller = CONTROLLERS[kind](plant, **CONTROLLER_SETTINGS[kind])
    n, ny = len(plant.states), len(plant.outputs)
    x = jnp.linspace(0.3, -0.2, n)
    estimate = Estimate.without_attack(x, jnp.eye(n), jnp.zeros(ny), jnp.eye(ny), 0)
    command = controller.command(estimate)
    assert command.shape == (len(plant.inputs),)
    assert np.all(np.isfinite(command))


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=_long(kind)) for kind in ESTIMATOR_SETTINGS]
)
def test_live_gives_the_numbers_of_a_replay(kind):
    plant = PLANTS["both"]
    estimator = ESTIMATORS[kind](plant, X0, P0, **ESTIMATOR_SETTINGS[kind])
    monitor = Monitor(estimator, DETECTORS["windowed"](plant, length=4))
    rng = np.random.default_rng(1)
    u, y = rng.normal(size=(20, 1)), rng.normal(size=(20, 3))
    u[4], y[6, 1], y[9] = np.nan, np.inf, np.nan
    seen = rng.random((20, 3)) > 0.2
    trace = replay(monitor, Observation.of(u, y, seen))
    live = Live(monitor)
    for k in range(20):
        said = live.push(Observation.of(u[k], y[k], seen[k]))
        expected = jax.tree.map(lambda leaf, k=k: leaf[k], (trace.estimate, trace.verdict))
        for found, leaf in zip(jax.tree.leaves(said), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(found, leaf, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("catalog", [ESTIMATORS, DETECTORS, ATTACKS, CONTROLLERS])
def test_settings_are_keywords_with_types(catalog):
    for kind, build in catalog.items():
        found = inspect.signature(build).parameters
        skip = 3 if catalog is ESTIMATORS else 1
        for name, parameter in list(found.items())[skip:]:
            assert parameter.kind is parameter.KEYWORD_ONLY, (kind, name)
            assert parameter.annotation is not parameter.empty, (kind, name)
