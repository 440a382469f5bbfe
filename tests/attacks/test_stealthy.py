"""The planned stealthy attack: what it does to a filter, what it reaches, what a test sees of it.

Of a linear filter with a fixed gain the attack moves the estimate by the same in every run: the
pairs of runs here differ in the attack alone. The recursion that they are held to, the gain and
the tails of the chi-squares are not the product's (scipy's Riccati solver, its ncx2).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, ncx2

from attackers import alpha, asked, filtered
from holdfast import load_scenario
from holdfast.attacks import stealthy
from holdfast.detectors import chi_square, windowed
from holdfast.estimators import kalman
from holdfast.loop import Monitor, Scenario, simulate
from holdfast.numerics.noncentral import tail
from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.library import bicycle, vehicle_tracking
from holdfast.plants.watched import watched
from holdfast.reach.bounds import reach
from holdfast.records import Enforcement

LEVEL, EPSILON = 0.015, 1e-3
BOTH = ["sensor:measured_position", "sensor:measured_speed"]
FIRST, LAST, STEPS = 10, 50, 70
WHEN = {"start": 0.1, "stop": 0.5}
NEVER = Enforcement.of([1, 1], 0, 1)
POLICIES = {
    "never": NEVER,
    "together": Enforcement.of([12, 12], 1, 15),
    "blocks": Enforcement.of([12, 12], 3, 15),
    "each its own": Enforcement.of([7, 12], [1, 2], [11, 18]),
    "one": Enforcement.of([9, 1], [1, 0], [12, 1]),
}


@pytest.fixture(scope="module")
def plant():
    return vehicle_tracking.build()


@pytest.fixture(scope="module")
def system(plant):
    return filtered(*(np.asarray(m) for m in (plant.A, plant.C, plant.Q, plant.R)))


def build(plant, channels=BOTH, **keys):
    keys = {"epsilon": EPSILON, "level": LEVEL, **WHEN, **keys}
    return stealthy.build(plant, channels=list(channels), **keys)


def scenario(plant, attack, enforcement=NEVER, detector=chi_square):
    filters = kalman.build(plant, [0.0, 0.0], watched(plant).P)
    monitor = Monitor(filters, detector.build(plant, level=LEVEL, on="residual"))
    return Scenario(plant, jnp.zeros(2), monitor, None, (attack,), enforcement)


@eqx.filter_jit
def runs(of, keys, starts):
    def one(key, x0):
        return simulate(eqx.tree_at(lambda s: s.x0, of, x0), key, STEPS)

    return jax.vmap(one)(keys, starts)


def pair(of, count=200):
    """Runs with the attack and without it, of the same noise; the filter's first error is as large
    as it says.
    """
    keys = jax.random.split(jax.random.key(3), count)
    half = np.linalg.cholesky(of.monitor.estimator.P0)
    starts = jnp.asarray(np.random.default_rng(3).normal(size=(count, 2)) @ half.T)
    (attack,) = of.attacks
    still = eqx.tree_at(lambda s: s.attacks[0].attack.plan, of, 0.0 * attack.attack.plan)
    return runs(of, keys, starts), runs(still, keys, starts)


def predicted(system, plan):
    """Shifts of the estimate and of the innovation, from the first sample of the plan on."""
    x, shifts, innovations = np.zeros(len(system.A)), [], []
    for a in plan:
        z = a - system.C @ system.A @ x
        x = system.A @ x + system.K @ z
        shifts.append(x)
        innovations.append(z)
    return np.array(shifts), np.array(innovations)


def planned(attack):
    return np.asarray(attack.attack.plan)


def costs(system, plan):
    _, z = predicted(system, plan)
    return np.einsum("ti,ij,tj->t", z, np.linalg.inv(system.Q), z)


CASES = {
    "never": ({}, "never"),
    "together": ({}, "together"),
    "blocks": ({"at": 0.3}, "blocks"),
    "each its own": ({}, "each its own"),
    "one": ({"direction": [1.0, 0.0]}, "one"),
    "position": ({"channels": BOTH[:1]}, "each its own"),
    "speed": ({"channels": BOTH[1:]}, "never"),
    "windowed": ({"detector": "windowed", "length": 5}, "together"),
    "sprt": ({"detector": "sprt"}, "together"),
}


@pytest.mark.parametrize("case", CASES)
def test_runs_with_and_without_it(plant, system, case):
    keys, policy = CASES[case]
    enforcement = POLICIES[policy]
    attack = build(plant, enforcement=enforcement, **keys)
    found, quiet = pair(scenario(plant, attack, enforcement))
    np.testing.assert_array_equal(found.x, quiet.x)
    a = np.zeros((STEPS, 2))
    a[FIRST - 1 : LAST - 1] = planned(attack)
    # what the attacker planned arrives as planned: he knew what would be stopped
    np.testing.assert_array_equal(found.injection.y, np.broadcast_to(a, (200, STEPS, 2)))
    hit = np.array([name in keys.get("channels", BOTH) for name in BOTH])
    free = hit & ~np.asarray(enforcement.at(jnp.arange(1, STEPS + 1, dtype=jnp.int32)))
    free[: FIRST - 1] = free[LAST - 1 :] = False
    np.testing.assert_array_equal(a != 0, free)
    shifts, innovations = predicted(system, a)
    # sums of a few hundred rounding errors of numbers of size 100
    moved = np.asarray(found.estimate.x - quiet.estimate.x)
    np.testing.assert_allclose(moved, np.broadcast_to(shifts, moved.shape), rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.mean(moved, 0), shifts, rtol=0, atol=1e-9)
    told = np.asarray(found.estimate.residual - quiet.estimate.residual)
    np.testing.assert_allclose(told, np.broadcast_to(innovations, told.shape), rtol=0, atol=1e-9)
    assert np.max(np.abs(moved)) > 0.1


WORST = {
    "chi_square": ({}, {}),
    "windowed": ({"detector": "windowed", "length": 3}, {}),
    "sprt": ({"detector": "sprt"}, {"tight": True}),
}


@pytest.mark.parametrize("detector", WORST)
@pytest.mark.parametrize(("every", "direction"), [(None, None), (10, None), (10, [1.0, 0.0])])
def test_it_reaches_what_can_be_reached(plant, system, detector, every, direction):
    """At step 15; the plan goes on to the end of the block behind it."""
    keys, how = WORST[detector]
    enforcement = None if every is None else Enforcement.of([every, every], 1, every)
    stop = 0.16 if every is None else 0.21
    attack = build(
        plant, start=0.01, stop=stop, at=0.15, direction=direction, enforcement=enforcement, **keys
    )
    on = np.eye(2) if direction is None else np.array([direction])
    setting = asked(system, detector, enforcement, functional=on, level=LEVEL, epsilon=EPSILON)
    bound = reach(setting, 15, **how)
    assert bound.exact[14]
    shifts, _ = predicted(system, planned(attack))
    reached = np.linalg.norm(on @ shifts[14])
    # two interior-point solutions of one cone program
    assert reached == pytest.approx(bound.norm[14], rel=1e-7)
    if every is None:
        again = build(plant, start=0.01, stop=stop, direction=direction, **keys)
        np.testing.assert_array_equal(planned(again), planned(attack))


def test_what_counts_decides_the_plan(plant, system):
    plans = [build(plant, direction=d) for d in ([1.0, 0.0], [0.0, 1.0])]
    ends = np.abs([predicted(system, planned(one))[0][-1] for one in plans])
    assert ends[0, 0] > ends[1, 0]
    assert ends[1, 1] > ends[0, 1]
    early, late = (
        np.linalg.norm(predicted(system, planned(build(plant, at=at)))[0], axis=1)
        for at in (0.2, None)
    )
    assert early[FIRST] > late[FIRST]
    assert late[-1] > early[-1]


def sums(values, length):
    return np.array([np.sum(values[max(0, k + 1 - length) : k + 1]) for k in range(len(values))])


@pytest.mark.parametrize("policy", ["never", "together", "each its own"])
@pytest.mark.parametrize("detector", ["chi_square", "windowed", "sprt"])
def test_no_alarm_is_more_probable_than_it_may_be(plant, system, detector, policy):
    attack = build(plant, detector=detector, length=6, enforcement=POLICIES[policy])
    cost = costs(system, planned(attack))
    k = np.arange(1, len(cost) + 1)
    h = chi2.isf(LEVEL, 2)
    spent = sums(cost, {"chi_square": 1, "windowed": 6, "sprt": len(cost)}[detector])
    dof = {"chi_square": 2 + 0 * k, "windowed": 12 + 0 * k, "sprt": 2 * k}[detector]
    limit = 2 * h + dof if detector == "sprt" else chi2.isf(LEVEL, dof)
    without = chi2.sf(limit, dof)
    if detector != "sprt":
        np.testing.assert_allclose(without, LEVEL, rtol=1e-12)
    rise = [tail(*map(float, of)) for of in zip(spent, dof, limit, strict=True)] - without
    assert np.all(rise <= EPSILON + 1e-12)
    np.testing.assert_allclose(ncx2.sf(limit, dof, spent), without + rise, rtol=0, atol=1e-10)
    # and he takes what he may, somewhere
    assert np.max(rise) == pytest.approx(EPSILON, rel=1e-5)
    assert np.max(spent[-1] / alpha(EPSILON, dof[-1], limit[-1]) ** 2) <= 1 + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("detector", [chi_square, windowed])
def test_how_often_the_alarm_is_raised(plant, system, detector):
    """Of 8000 runs; 4 standard errors at each of 40 rows."""
    count, name = 8000, detector.__name__.rsplit(".", 1)[1]
    enforcement = POLICIES["together"]
    attack = build(plant, detector=name, epsilon=0.05, enforcement=enforcement)
    found, quiet = pair(scenario(plant, attack, enforcement, detector), count)
    length = 1 if name == "chi_square" else 10
    spent = sums(costs(system, planned(attack)), length)
    limit = chi2.isf(LEVEL, 2 * length)
    rows = slice(FIRST - 1, LAST - 1)
    for trace, expected in (
        (found, ncx2.sf(limit, 2 * length, np.maximum(spent, 1e-12))),
        (quiet, np.full(len(spent), LEVEL)),
    ):
        often = np.mean(np.asarray(trace.verdict.alarm)[:, rows], 0)
        error = np.sqrt(expected * (1 - expected) / count)
        assert np.all(np.abs(often - expected) < 4 * error)
    assert np.max(np.mean(np.asarray(found.verdict.alarm)[:, rows], 0)) > 3 * LEVEL


def test_a_scenario_tells_it_the_policy(tmp_path):
    text = (
        '[plant]\nkind = "vehicle_tracking"\n'
        '[estimator]\nkind = "kalman"\nx0 = [0.0, 0.0]\nP0 = [[1.0, 0.0], [0.0, 1.0]]\n'
        '[detector]\nkind = "chi_square"\nlevel = 0.015\non = "residual"\n'
        "[enforcement.sensors.measured_position]\nevery = 6\nfor = 2\n"
        "[enforcement.sensors.measured_speed]\nevery = 8\nfirst = 13\n"
        '[[attack]]\nkind = "stealthy"\nepsilon = 0.001\nlevel = 0.015\nstart = 0.1\nstop = 0.4\n'
        'channels = ["sensor:measured_position", "sensor:measured_speed"]\n[run]\nsteps = 50\n'
    )
    (tmp_path / "s.toml").write_text(text)
    found = load_scenario(tmp_path / "s.toml")
    (attack,) = found.attacks
    k = np.arange(10, 40)
    held = np.column_stack([(k >= 6) & (k % 6 < 2), (k >= 13) & ((k - 13) % 8 == 0)])
    assert held.any(0).all()
    np.testing.assert_array_equal(planned(attack) == 0, held)


@pytest.mark.slow
def test_without_a_policy_it_goes_on_and_on(plant, system):
    sizes = []
    for stop in (1.0, 10.0, 100.0):
        plan = planned(build(plant, start=0.01, stop=stop))
        shifts, _ = predicted(system, plan)
        most = alpha(EPSILON, 2, chi2.isf(LEVEL, 2)) ** 2
        assert np.max(costs(system, plan)) <= most * (1 + 1e-6)
        sizes.append(np.linalg.norm(shifts[-1]))
    assert len(plan) == 9999
    assert sizes[1] > 10 * sizes[0]
    assert sizes[2] > 10 * sizes[1]


WRONG = [
    ({"channels": ["actuator:accel"]}, "channels: found ['actuator:accel'], expected sensors"),
    ({"channels": ["sensor:gps"]}, "found 'sensor:gps', expected one of"),
    ({"stop": np.inf}, "stop: found inf, expected seconds at which the attack ends"),
    ({"stop": 0.1}, "stop: found 0.1, expected at least one sample after start"),
    ({"stop": 1e6}, "stop: found 1000000.0, expected at most 20000 samples"),
    ({"stop": 50.0, "detector": "sprt"}, "expected at most 2000 samples"),
    ({"start": np.nan}, "start: found nan, expected a finite number of seconds"),
    ({"epsilon": 0.0}, "epsilon: found 0.0, expected between 0 and 1 - level (0.985)"),
    ({"epsilon": 0.6, "detector": "sprt"}, "expected a probability under 0.5 with sprt"),
    ({"level": 1.5}, "level: found 1.5, expected a probability between 0 and 1"),
    ({"length": 0, "detector": "windowed"}, "length: found 0, expected a whole number of rows"),
    ({"at": 0.05}, "at: found 0.05, expected seconds from 0.1 to before 0.5"),
    ({"direction": [1.0]}, "direction: found [1.0], expected 2 finite numbers, not all 0"),
]


@pytest.mark.parametrize(("keys", "message"), WRONG)
def test_wrong_settings_are_named(plant, keys, message):
    with pytest.raises(InvalidValue) as caught:
        build(plant, **keys)
    assert message in str(caught.value)


def test_plants_it_cannot_be_planned_for():
    keys = {"epsilon": 0.01, "stop": 1.0}
    car = bicycle.build()
    with pytest.raises(InvalidValue, match="a linear plant with constant matrices"):
        stealthy.build(car, channel=f"sensor:{car.outputs[0]}", **keys)
    varying = linear_plant(A=0.5 * np.ones((9, 1, 1)), C=[[1.0]], Q=[[1.0]], R=[[1.0]])
    with pytest.raises(InvalidValue, match="a linear plant with constant matrices"):
        stealthy.build(varying, channel="sensor:y1", **keys)
    hidden = linear_plant(A=[[1.0]], C=[[0.0]], Q=[[1.0]], R=[[1.0]])
    with pytest.raises(InvalidValue, match="no steady-state Kalman filter"):
        stealthy.build(hidden, channel="sensor:y1", **keys)
