import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from holdfast.parts import InvalidValue
from holdfast.plants.library.tanks import FLOWS, SMALL, build, operating_point
from holdfast.shell.files import read_scenario

STEEP = {
    "areas": [0.8, 0.3, 1.1, 0.4, 0.6],
    "pipes": [[4, 1, 0.002], [1, 2, 0.004], [2, 5, 0.0015], [4, 5, 0.003], [1, 5, 0.001]],
    "outlets": [[3, 0.002], [5, 0.005], [2, 0.001]],
    "pumps": [4, 3, 2],
}
"""Five tanks: 4 over 1 over 2 over 5, and 3 by itself."""
DEFAULT = {
    "areas": [0.5, 0.5, 0.6, 0.7],
    "pipes": [[1, 3, 0.003], [2, 4, 0.003], [1, 4, 0.0012]],
    "outlets": [[3, 0.0028], [4, 0.004]],
    "pumps": [1, 2],
}


def root(h):
    return h / (h**2 + 1e-6) ** 0.25


def through(opening, h):
    return opening * np.sqrt(2 * 9.81) * root(h)


def rates(h, pumped, settings):
    """Tank by tank, from the rows as they are given; the last entry is all that has left."""
    gain, gone = np.zeros(len(settings["areas"])), 0.0
    for tank, flow in zip(settings["pumps"], pumped, strict=True):
        gain[tank - 1] += flow
    for source, target, opening in settings["pipes"]:
        gain[source - 1] -= through(opening, h[source - 1])
        gain[target - 1] += through(opening, h[source - 1])
    for source, opening in settings["outlets"]:
        gain[source - 1] -= through(opening, h[source - 1])
        gone += through(opening, h[source - 1])
    return np.append(gain / np.array(settings["areas"]), gone)


def truth(h, pumped, settings, seconds):
    """Levels and the volume that left, by scipy's eighth-order integrator."""
    return solve_ivp(
        lambda _, z: rates(z[:-1], pumped, settings), (0, seconds), np.append(h, 0.0),
        method="DOP853", rtol=1e-13, atol=1e-15,
    ).y[:, -1]  # fmt: skip


def stepped(plant):
    return jax.jit(jax.vmap(lambda x, u, d: plant.transition(1, x, u, d)))


@pytest.mark.parametrize(
    ("dt", "within"),
    [
        # levels fade by r < 0.051 / s: Runge-Kutta over a second is off by h (r s)^5 / 120 < 7e-9
        (1.0, 7e-9),
        # and over a tenth by less than the integrator's 1e-13 of some metres
        (0.1, 1e-12),
    ],
)
@pytest.mark.parametrize("settings", [DEFAULT, STEEP], ids=["default", "steep"])
def test_a_step_is_the_integral_and_no_water_is_lost(settings, dt, within):
    plant = build(**settings, meters=[], dt=dt)
    rng = np.random.default_rng(0)
    n, pumps = len(settings["areas"]), len(settings["pumps"])
    h, u = rng.uniform(0.3, 2.5, size=(8, n)), rng.uniform(0, 0.05, size=(8, pumps))
    found = np.asarray(stepped(plant)(jnp.asarray(h), jnp.asarray(u), jnp.zeros((8, 0))))
    area = np.array(settings["areas"])
    for before, pumped, after in zip(h, u, found, strict=True):
        *levels, gone = truth(before, pumped, settings, dt)
        np.testing.assert_allclose(after, levels, rtol=0, atol=within)
        # five tanks of 1 m^2
        stays = area @ (after - before)
        np.testing.assert_allclose(stays, dt * np.sum(pumped) - gone, rtol=0, atol=5 * within)


def test_the_default_is_the_network_of_the_docstring():
    one, other = build(), build(**DEFAULT)
    x, u = jnp.asarray([1.0, 0.4, 2.0, 0.1]), jnp.asarray([0.01, 0.03])
    moved = one.transition(1, x, u, jnp.zeros(0))
    np.testing.assert_array_equal(moved, other.transition(1, x, u, jnp.zeros(0)))
    assert one.states == ("level:1", "level:2", "level:3", "level:4")
    assert one.inputs == ("pump:1", "pump:2")
    assert one.outputs == (*one.states, "flow:2-4", "flow:3-out", "flow:4-out")
    assert (one.attacks, one.dt) == ((), 1.0)
    Q, R = one.noise(1, x, u)
    np.testing.assert_allclose(Q, 25e-8 * np.eye(4), rtol=1e-14)
    np.testing.assert_allclose(R, np.diag([1e-4] * 4 + [4e-8] * 3), rtol=1e-14)


def test_outputs_are_levels_and_flows():
    plant = build(**STEEP, meters=["4-5", "2-out", "1-2"], level_sd=2.0, flow_sd=3.0)
    h = np.array([0.5, 1.0, 1.5, 2.0, 2.4])
    y = plant.output(1, jnp.asarray(h), jnp.zeros(3), jnp.zeros(0))
    flows = [through(0.003, 2.0), through(0.001, 1.0), through(0.004, 0.5)]
    np.testing.assert_allclose(y, [*h, *flows], rtol=1e-14)
    assert plant.outputs[5:] == ("flow:4-5", "flow:2-out", "flow:1-2")
    np.testing.assert_allclose(plant.noise(1, h, h)[1], np.diag([4.0] * 5 + [9.0] * 3), rtol=1e-14)


@pytest.mark.parametrize("settings", [DEFAULT, STEEP], ids=["default", "steep"])
def test_at_the_operating_point_nothing_moves(settings):
    flows = [0.022, 0.015, 0.003][: len(settings["pumps"])]
    h = operating_point(flows, **settings)
    np.testing.assert_allclose(rates(h, flows, settings)[:-1], 0.0, atol=1e-16)
    plant = build(**settings, meters=[])
    moved = plant.transition(1, jnp.asarray(h), jnp.asarray(flows), jnp.zeros(0))
    np.testing.assert_allclose(moved, h, rtol=0, atol=1e-14)


def test_the_default_operating_point():
    """By Torricelli's law itself, sqrt for root: they differ by e^2 / (4 h^2) < 2e-7."""
    c = np.sqrt(2 * 9.81)
    upper = [FLOWS[0] / (0.0042 * c), FLOWS[1] / (0.003 * c)]
    third = 0.003 / 0.0042 * FLOWS[0] / (0.0028 * c)
    fourth = (0.0012 / 0.0042 * FLOWS[0] + FLOWS[1]) / (0.004 * c)
    h = np.array([*upper, third, fourth]) ** 2
    np.testing.assert_allclose(operating_point(), h, rtol=1e-6)
    np.testing.assert_allclose(operating_point(), [1.398, 1.274, 1.605, 1.443], atol=5e-4)
    np.testing.assert_array_equal(operating_point([0.0, 0.0]), np.zeros(4))


def tangents(plant, x, u):
    d = jnp.zeros(len(plant.attacks))
    A, G = plant.jacobian(1, jnp.asarray(x), jnp.asarray(u), d)
    C = jax.jacfwd(lambda x: plant.output(1, x, jnp.asarray(u), d))(jnp.asarray(x))
    return np.asarray(A), np.asarray(G), np.asarray(C)


def test_every_level_is_seen_without_any_one_sensor():
    A, _, C = tangents(build(), operating_point(), FLOWS)
    for lost in range(len(C) + 1):
        rest = np.delete(C, [lost] if lost < len(C) else [], axis=0)
        seen = np.vstack([rest @ np.linalg.matrix_power(A, k) for k in range(4)])
        scale = np.linalg.svd(seen / np.linalg.norm(seen, axis=0))[1]
        assert scale[-1] > 1e-3
    poles = np.sort(np.linalg.eigvals(A).real)
    # a tank by itself forgets in 2 A h / (what flows through it)
    h, flow = operating_point(), np.array([0.022, 0.015, 0.022 / 1.4, 0.022 * 2 / 7 + 0.015])
    alone = np.exp(-flow / (2 * np.array(DEFAULT["areas"]) * h))
    np.testing.assert_allclose(poles, np.sort(alone), rtol=1e-8)


def test_a_tank_that_empties_stops_at_0():
    """From all sorts of levels, with pumps on, then off until nothing is left."""
    rng = np.random.default_rng(2)
    runs = 500
    for settings, dt in ((DEFAULT, 1.0), (STEEP, 1.0), (STEEP, 7.0)):
        step = stepped(build(**settings, meters=[], dt=dt))
        n, pumps = len(settings["areas"]), len(settings["pumps"])
        x = 10 ** rng.uniform(-6, 0.4, size=(runs, n)) * (rng.uniform(size=(runs, n)) > 0.2)
        u = rng.uniform(0, 0.05, size=(runs, pumps)) * (rng.uniform(size=(runs, pumps)) > 0.5)
        x, none = jnp.asarray(x), jnp.zeros((runs, 0))
        for k in range(round(1500 / dt)):
            x = step(x, jnp.asarray(u * (k * dt < 60)), none)
            assert np.all(np.asarray(x) >= -1e-15)
        assert np.all(np.asarray(x) < 1e-6)


def test_a_level_below_0_comes_back():
    step = stepped(build())
    x = jnp.asarray([[-0.02, -1e-9, -0.5, 0.0]])
    for _ in range(200):
        x = step(x, jnp.zeros((1, 2)), jnp.zeros((1, 0)))
    np.testing.assert_allclose(x, 0.0, atol=1e-6)


@pytest.mark.parametrize("level", [0.0, 1e-300, 1e-9, -1e-3, -2.0])
def test_derivatives_are_finite_at_0_and_below(level):
    """And none is above that of root at 0."""
    plant = build(attacks=["actuator:pump:1"])
    A, G, C = tangents(plant, [level] * 4, [0.0, 0.0])
    for found in (A, G, C):
        assert np.all(np.isfinite(found))
    steepest = 0.003 * np.sqrt(2 * 9.81) / np.sqrt(SMALL)
    assert 0 < C[4, 1] <= steepest * (1 + 1e-12)
    if level == 0.0:
        np.testing.assert_allclose(C[4, 1], steepest, rtol=1e-12)


@pytest.mark.parametrize(("level", "within"), [(0.016, 1e-3), (0.05, 1.01e-4), (1.0, 3e-7)])
def test_it_is_torricellis_law_above_a_few_centimetres(level, within):
    y = build().output(1, jnp.full(4, level), jnp.zeros(2), jnp.zeros(0))
    np.testing.assert_allclose(y[4], 0.003 * np.sqrt(2 * 9.81 * level), rtol=within)


def test_attack_channels_are_falsified_pumps_and_sensors():
    attacks = ["sensor:flow:3-out", "actuator:pump:2", "sensor:level:1"]
    plant, clean = build(attacks=attacks), build()
    assert plant.attacks == tuple(attacks)
    x, u, none = jnp.asarray([1.0, 0.4, 2.0, 0.1]), jnp.asarray([0.01, 0.03]), jnp.zeros(0)
    d = jnp.asarray([0.2, 0.005, -0.3])
    pushed = clean.transition(1, x, u + jnp.asarray([0.0, 0.005]), none)
    np.testing.assert_allclose(plant.transition(1, x, u, d), pushed, rtol=0, atol=1e-16)
    added = np.array([-0.3, 0, 0, 0, 0, 0.2, 0])
    np.testing.assert_allclose(plant.output(1, x, u, d), clean.output(1, x, u, none) + added)


def test_limits():
    """Of pumps on command plus attack, and only of those that can be attacked."""
    attacks = ["sensor:level:1", "actuator:pump:2"]
    limits = build(attacks=attacks, height=2.0, max_flow=0.04).constraints
    rows, bound = map(np.asarray, limits.attack.at(1, jnp.asarray([0.09, 0.03])))
    for d, allowed in (
        ([5.0, 0.0099], True), ([5.0, 0.0101], False),
        ([-5.0, -0.0299], True), ([-5.0, -0.0301], False),
    ):  # fmt: skip
        assert np.all(rows @ np.array(d) <= bound) == allowed
    rows, bound = map(np.asarray, limits.state.at(1, jnp.zeros(2)))
    for h, allowed in (
        ([0.0, 1.0, 2.0, 0.5], True), ([0.0, 1.0, 2.1, 0.5], False),
        ([0.0, -0.1, 2.0, 0.5], False),
    ):  # fmt: skip
        assert np.all(rows @ np.array(h) <= bound) == allowed


def test_limits_may_be_left_out():
    free = build(attacks=["actuator:pump:2"], height=np.inf, max_flow=np.inf).constraints
    np.testing.assert_array_equal(free.attack.at(1, jnp.zeros(2))[1], [np.inf, 0.0])
    np.testing.assert_array_equal(free.state.at(1, jnp.zeros(2))[1], [np.inf] * 4 + [0.0] * 4)
    assert build().constraints.attack.matrix.shape == (0, 0)


def test_a_single_tank_without_pump_or_meter():
    plant = build(areas=[0.5], pipes=[], outlets=[[1, 0.003]], pumps=[], meters=[])
    moved = plant.transition(1, jnp.ones(1), jnp.zeros(0), jnp.zeros(0))
    alone = {"areas": [0.5], "pipes": [], "outlets": [[1, 0.003]], "pumps": []}
    np.testing.assert_allclose(moved, truth([1.0], [], alone, 1.0)[:1], rtol=1e-10)


def test_a_scenario_gives_the_plant_of_its_keys(tmp_path):
    (tmp_path / "pipes.csv").write_text("1,2,0.003\n2,3,0.004\n")
    (tmp_path / "tanks.toml").write_text(
        '[plant]\nkind = "tanks"\nareas = [0.5, 1, 0.7]\npipes = { file = "pipes.csv" }\n'
        'outlets = [[3, 0.002]]\npumps = [1]\nmeters = ["1-2"]\nattacks = ["actuator:pump:1"]\n'
        '[estimator]\nkind = "extended"\nx0 = [1, 1, 1]\nP0 = [1, 1, 1]\n'
        '[[attack]]\nkind = "bias"\nchannel = "channel:actuator:pump:1"\nvalue = 0.01\n'
        "start = 1.0\nstop = 2.0\n"
    )
    found = read_scenario(tmp_path / "tanks.toml").scenario.plant
    assert found.outputs == ("level:1", "level:2", "level:3", "flow:1-2")
    assert found.attacks == ("actuator:pump:1",)


@pytest.mark.parametrize(
    ("changes", "key", "found"),
    [
        ({"areas": []}, "areas", "empty"),
        ({"areas": [0.5, 0.0, 1.0, 1.0]}, "areas[2]", "0.0"),
        ({"pipes": [[1, 3, 0.003], [1, 5, 0.003]]}, "pipes[2]", "5"),
        ({"pipes": [[1, 1, 0.003]]}, "pipes[1]", "[1, 1"),
        ({"pipes": [[1, 0.003]]}, "pipes[1]", "[1, 0.003]"),
        ({"pipes": [[1.5, 3, 0.003]]}, "pipes[1]", "1.5"),
        ({"pipes": [[]]}, "pipes[1]", "[]"),
        ({"pipes": [[1, 3, -0.1]]}, "pipes[1]", "-0.1"),
        ({"pipes": [[1, 3, 0.1], [1, 3, 0.1]]}, "pipes[2]", "[1, 3, 0.1]"),
        ({"pipes": [[1, 3, 0.1], [3, 4, 0.1], [4, 1, 0.1]]}, "pipes", "circle"),
        ({"outlets": [[3, 0.1], [0, 0.1]]}, "outlets[2]", "[0, 0.1]"),
        ({"outlets": [[3, np.inf]]}, "outlets[1]", "inf"),
        ({"outlets": [[3, 0.1], [3, 0.1]]}, "outlets[2]", "[3, 0.1]"),
        ({"pumps": [1, 5]}, "pumps[2]", "5"),
        ({"pumps": [1, 1]}, "pumps[2]", "1"),
        ({"meters": ["2-4", "2-3"]}, "meters[2]", "2-3"),
        ({"meters": ["2-4", "2-4"]}, "meters", "2-4"),
        ({"dt": 0.0}, "dt", "0.0"),
        ({"height": 0.0}, "height", "0.0"),
        ({"max_flow": np.nan}, "max_flow", "nan"),
        ({"process_sd": -1.0}, "process_sd", "-1.0"),
        ({"level_sd": 0.0}, "level_sd", "0.0"),
        ({"flow_sd": np.inf}, "flow_sd", "inf"),
        ({"attacks": ["actuator:pump:3"]}, "attacks[1]", "actuator:pump:3"),
    ],
)
def test_what_cannot_be_is_named(changes, key, found):
    with pytest.raises(InvalidValue) as refused:
        build(**changes)
    assert refused.value.key == key
    assert found in str(refused.value.found)


@pytest.mark.parametrize(
    ("flows", "changes", "key"),
    [
        ([0.02], {}, "flows"),
        ([0.02, -0.01], {}, "flows"),
        ([0.02, np.nan], {}, "flows"),
        ([0.02, 0.01], {"outlets": [[3, 0.002]]}, "outlets"),
        ([0.02, 0.01], {"pumps": [1, 7]}, "pumps[2]"),
    ],
)
def test_an_operating_point_that_cannot_be_is_named(flows, changes, key):
    with pytest.raises(InvalidValue) as refused:
        operating_point(flows, **changes)
    assert refused.value.key == key
