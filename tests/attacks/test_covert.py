"""The covert attack: the watcher sees nothing, and the plant is where the attacker wants it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.attacks import covert
from holdfast.controllers import feedback
from holdfast.detectors import chi_square
from holdfast.estimators import kalman
from holdfast.loop import Monitor, Scenario, simulate
from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.library import bicycle
from holdfast.records import Enforcement

STEPS = 60
EYE = [[1.0, 0.0], [0.0, 1.0]]
A = np.array([[1.0, 0.1], [0.02, 0.95]])
B = np.array([[0.0, 0.005], [0.05, 0.1]])
G = np.array([[0.3], [0.0]])
C = np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 1.0]])
D = np.array([[0.0, 0.0], [0.2, 0.0], [0.0, 0.4]])
H = np.array([[0.7], [0.0], [0.0]])


@pytest.fixture(scope="module")
def plant():
    return linear_plant(
        A=A, B=B, C=C, D=D, G=G, H=H, Q=0.01 * np.eye(2), R=0.04 * np.eye(3), dt=0.1,
        states=["position", "speed"], inputs=["brake", "motor"],
        outputs=["gps", "wheel", "flow"], attacks=["wind"],
    )  # fmt: skip


def run(plant, attack, enforcement=None):
    """In closed loop: the controller acts on what the estimator believes."""
    monitor = Monitor(kalman.build(plant, [0.0, 0.0], np.eye(2)), chi_square.build(plant))
    controller = feedback.build(plant, state_weight=EYE, input_weight=EYE)
    attacks = () if attack is None else (attack,)
    scenario = Scenario(plant, jnp.zeros(2), monitor, controller, attacks, enforcement)
    return simulate(scenario, jax.random.key(5), STEPS)


def response(u, d):
    """The state at rows 1 .. STEPS from zero, and the outputs, of injections at 0 .. STEPS."""
    x, states, outputs = np.zeros(2), [], []
    for k in range(1, STEPS + 1):
        x = A @ x + B @ u[k - 1] + G @ d[k - 1]
        states.append(x)
        outputs.append(C @ x + D @ u[k] + H @ d[k])
    return np.array(states), np.array(outputs)


def pushed(size, brake, motor, wind, first, last):
    """Injections at 0 .. STEPS."""
    k = np.arange(STEPS + 1)
    on = (size * ((k >= first) & (k < last)))[:, None]
    return on * [brake, motor], on * [wind]


# names, what is pushed, which sensors are falsified
CHANNELS = {
    "default": (None, (1, 1, 0), (1, 1, 1)),
    "one actuator": (["actuator:motor"], (0, 1, 0), (1, 1, 1)),
    "attack channel": (["channel:wind"], (0, 0, 1), (1, 1, 1)),
    "both": (["channel:wind", "actuator:brake"], (1, 0, 1), (1, 1, 1)),
    "some sensors": (["actuator:motor", "sensor:gps", "sensor:flow"], (0, 1, 0), (1, 0, 1)),
    "sensors alone": (["sensor:wheel"], (1, 1, 0), (0, 1, 0)),
}


@pytest.mark.parametrize("which", CHANNELS)
def test_what_it_moves_and_what_it_hides(plant, which):
    names, moved, told = CHANNELS[which]
    attack = covert.build(plant, size=1.5, channels=names, start=1.0, stop=3.0)
    found = run(plant, attack)
    x, y = response(*pushed(1.5, *moved, 10, 30))
    shown = np.where(told, 0.0, y)
    if all(told):
        quiet = run(plant, None)
        for mine, theirs in zip(
            jax.tree.leaves((found.estimate, found.verdict, found.observation)),
            jax.tree.leaves((quiet.estimate, quiet.verdict, quiet.observation)),
            strict=True,
        ):
            # numbers of size 10, added and taken away again
            np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.x - quiet.x, x, rtol=0, atol=1e-12)
        assert np.abs(x[-1]).max() > 0.1  # long after the push has ended
    u, d = pushed(1.5, *moved, 10, 30)
    np.testing.assert_array_equal(found.injection.u, u[1:])
    np.testing.assert_array_equal(found.injection.d, d[1:])
    np.testing.assert_allclose(found.injection.y, shown - y, rtol=0, atol=1e-12)


def test_it_pushes_from_time_zero(plant):
    found, quiet = run(plant, covert.build(plant, size=-0.5)), run(plant, None)
    x, _ = response(*pushed(-0.5, 1, 1, 0, 0, STEPS + 1))
    np.testing.assert_allclose(found.x - quiet.x, x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.estimate.x, quiet.estimate.x, rtol=0, atol=1e-12)


def test_an_authenticated_sample_gives_it_away(plant):
    attack = covert.build(plant, size=1.5, channel="actuator:motor", start=1.0)
    found = run(plant, attack, Enforcement.of([20, 1, 1], [1, 0, 0], [40, 1, 1]))
    quiet = run(plant, None)
    before, at = np.arange(STEPS) < 39, 39
    np.testing.assert_allclose(
        found.estimate.residual[before], quiet.estimate.residual[before], rtol=0, atol=1e-12
    )
    _, y = response(*pushed(1.5, 0, 1, 0, 10, STEPS + 1))
    shown = np.asarray(found.observation.y - quiet.observation.y)[at]
    np.testing.assert_allclose(shown, [y[at, 0], 0.0, 0.0], rtol=0, atol=1e-12)


def test_a_batch_of_sizes_is_one_compilation(plant):
    count = 0

    @eqx.filter_jit
    def last(attack):
        nonlocal count
        count += 1
        return run(plant, attack).x[-1]

    x = [last(covert.build(plant, size=size, start=1.0)) for size in (1.0, 2.0)]
    np.testing.assert_allclose(
        x[1] - x[0], response(*pushed(1.0, 1, 1, 0, 10, STEPS + 1))[0][-1], rtol=0, atol=1e-11
    )
    assert count == 1


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"size": np.inf}, "size: found inf, expected a finite number"),
        ({"size": 1.0, "channel": "actuator:engine"}, "found 'actuator:engine', expected one of"),
        ({"size": 1.0, "channels": []}, "channels: found an empty list"),
        ({"size": 1.0, "start": 2.0, "stop": 1.0}, "stop: found 1.0, expected seconds after"),
    ],
)
def test_wrong_settings_are_named(plant, keys, message):
    with pytest.raises(InvalidValue) as caught:
        covert.build(plant, **keys)
    assert message in str(caught.value)


def test_plants_it_cannot_work_on():
    still = linear_plant(A=[[0.5]], C=[[1.0]], Q=[[1.0]], R=[[1.0]])
    with pytest.raises(InvalidValue, match="the plant has no input"):
        covert.build(still, size=1.0)
    with pytest.raises(InvalidValue, match="the plant has no input"):
        covert.build(still, size=1.0, channel="sensor:y1")
    varying = linear_plant(A=0.5 * np.ones((9, 1, 1)), C=[[1.0]], Q=[[1.0]], R=[[1.0]])
    with pytest.raises(InvalidValue, match="varies in time, expected a constant one for covert"):
        covert.build(varying, size=1.0)
    with pytest.raises(InvalidValue, match="NonlinearPlant, expected a linear plant"):
        covert.build(bicycle.build(), size=1.0)
