"""One step in three places, what a simulation means, and what happens when numbers run away."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import systems
from holdfast.attacks import bias
from holdfast.detectors import chi_square
from holdfast.estimators import kalman, unknown_input
from holdfast.loop import Monitor, Scenario, replay, simulate
from holdfast.plants.build import linear_plant
from holdfast.records import Observation, Status
from holdfast.shell.live import Live


def monitor_of(system, build=unknown_input.build, on="attack"):
    estimator = build(system.plant, system.x0, system.P0)
    return Monitor(estimator, chi_square.build(system.plant, on=on))


def test_live_replay_and_simulation_say_the_same():
    """All three to 1e-12, gaps, faults and authenticated samples among the rows."""
    system = systems.random_system(5, 4, 4, 2, 1)
    monitor = monitor_of(system)
    scenario = Scenario(system.plant, jnp.asarray(system.x0), monitor)
    simulated = simulate(scenario, jax.random.key(0), 40)
    replayed = replay(monitor, simulated.observation)
    for mine, theirs in zip(
        jax.tree.leaves((simulated.estimate, simulated.verdict)),
        jax.tree.leaves((replayed.estimate, replayed.verdict)),
        strict=True,
    ):
        np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-12)

    rng = np.random.default_rng(0)
    u, y, seen = systems.random_log(5, system.plant, 40, 0.2)
    y[7, 1], y[12, 0], u[9, 0] = np.nan, np.inf, np.nan
    log = Observation.of(u, y, seen, rng.random(y.shape) < 0.1)
    recorded = replay(monitor, log)
    live = Live(monitor)
    for k in range(40):
        row = jax.tree.map(lambda a, k=k: a[k], log)
        said = live.push(row)
        expected = jax.tree.map(lambda a, k=k: a[k], (recorded.estimate, recorded.verdict))
        for mine, theirs in zip(jax.tree.leaves(said), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-12)


def test_a_fault_is_a_gap_with_another_name():
    """NaN and infinity: BAD_INPUT in that row, the numbers of a log where nothing came."""
    system = systems.random_system(6, 3, 3, 0, 0)
    monitor = monitor_of(system, kalman.build, "residual")
    u, y, seen = systems.random_log(6, system.plant, 30)
    faulty, gaps = y.copy(), seen.copy()
    faulty[4, 1], faulty[11, :] = np.nan, np.inf
    gaps[4, 1], gaps[11, :] = False, False
    bad = replay(monitor, Observation.of(u, faulty, seen))
    missing = replay(monitor, Observation.of(u, y, gaps))
    np.testing.assert_array_equal(bad.estimate.x, missing.estimate.x)
    np.testing.assert_array_equal(bad.estimate.x_cov, missing.estimate.x_cov)
    status = np.asarray(bad.estimate.status)
    assert {Status(int(s)).words for s in status[[4, 11]]} == {"BAD_INPUT"}
    assert not np.any(np.delete(status, [4, 11]))
    assert {Status(int(s)).words for s in np.asarray(missing.estimate.status)[[4, 11]]} == {
        "MISSING"
    }


def test_an_input_that_is_no_number_holds_the_last_one():
    system = systems.random_system(6, 3, 3, 0, 0)
    monitor = monitor_of(system, kalman.build, "residual")
    u, y, seen = systems.random_log(6, system.plant, 10)
    held = u.copy()
    held[5] = held[4]
    faulty = u.copy()
    faulty[5] = np.nan
    first = replay(monitor, Observation.of(faulty, y, seen))
    second = replay(monitor, Observation.of(held, y, seen))
    np.testing.assert_array_equal(first.estimate.x, second.estimate.x)
    assert Status(int(first.estimate.status[5])) == Status.BAD_INPUT


@pytest.mark.parametrize("channel", ["channel:push", "sensor:gps", "actuator:accel"])
def test_where_and_when_an_attack_acts(channel):
    """An attack over [0.3, 0.5) at dt = 0.1 hits samples 3 and 4: the dynamics of rows 4 and 5
    (sample k-1), the measurements of rows 3 and 4 (sample k).
    """
    plant = linear_plant(
        A=[[1.0]], B=[[2.0]], C=[[1.0]], G=[[3.0]], H=[[5.0]], Q=[[0.0]], R=[[1e-30]],
        dt=0.1, states=["x"], inputs=["accel"], outputs=["gps"], attacks=["push"],
    )  # fmt: skip
    monitor = Monitor(kalman.build(plant, [0.0], [[1.0]]), chi_square.build(plant))
    attack = bias.build(plant, channel=channel, start=0.3, stop=0.5, value=1.0)
    scenario = Scenario(plant, jnp.zeros(1), monitor, attacks=(attack,))
    trace = simulate(scenario, jax.random.key(0), 7)
    moved = {"channel:push": 3.0, "sensor:gps": 0.0, "actuator:accel": 2.0}[channel]
    added = {"channel:push": 5.0, "sensor:gps": 1.0, "actuator:accel": 0.0}[channel]
    x = moved * np.array([0, 0, 0, 1, 2, 2, 2.0])
    np.testing.assert_allclose(trace.x[:, 0], x, atol=1e-12)
    y = x + added * np.array([0, 0, 1, 1, 0, 0, 0.0])
    np.testing.assert_allclose(trace.observation.y[:, 0], y, atol=1e-12)


def test_numbers_that_run_away_are_reported_and_never_nan():
    """An unstable mode that no sensor sees overflows after a while: DIVERGED, finite numbers."""
    plant = linear_plant(A=[[1e30, 0.0], [0.0, 0.5]], C=[[0.0, 1.0]], Q=np.eye(2), R=[[1.0]])
    monitor = Monitor(kalman.build(plant, [1.0, 0.0], np.eye(2)), chi_square.build(plant))
    trace = replay(monitor, Observation.of(np.zeros((30, 0)), np.zeros((30, 1))))
    for leaf in jax.tree.leaves(trace):
        assert not np.any(np.isnan(np.asarray(leaf, float)))
    assert Status(int(trace.estimate.status[-1])) & Status.DIVERGED
    assert not Status(int(trace.estimate.status[0])) & Status.DIVERGED


def test_200_plants_are_one_compilation():
    """Plant arrays are arguments: a new plant of the same shape compiles nothing."""
    count = 0

    @eqx.filter_jit
    def run(monitor, log):
        nonlocal count
        count += 1
        return replay(monitor, log)

    for seed in range(3):
        system = systems.random_system(seed, 3, 2, 0, 0)
        u, y, seen = systems.random_log(seed, system.plant, 5)
        run(monitor_of(system, kalman.build, "residual"), Observation.of(u, y, seen))
    assert count == 1


def test_the_simulated_truth_stops_at_the_limits():
    """A cart pushed against a wall, by a push beyond what the drive can give."""
    plant = linear_plant(
        A=[[1, 0.1], [0, 1]], B=[[0], [0.1]], C=np.eye(2), G=[[0], [0.1]], Q=1e-4 * np.eye(2),
        R=1e-2 * np.eye(2), dt=0.1,
        constraints={
            "state": {"matrix": [[1, 0]], "bound": [1.0]},
            "attack": {"matrix": [[1]], "bound": [2.0], "bound_u": [[-1]]},
        },
    )  # fmt: skip
    estimator = unknown_input.build(plant, [0, 0], 0.01 * np.eye(2))
    monitor = Monitor(estimator, chi_square.build(plant, on="attack"))
    push = bias.build(plant, channel="channel:d1", value=5.0, start=0.5)
    scenario = Scenario(plant, jnp.zeros(2), monitor, attacks=(push,))
    trace = simulate(scenario, jax.random.key(0), 60)
    assert np.all(np.asarray(trace.x)[:, 0] <= 1.0 + 1e-12)
    assert np.asarray(trace.x)[-1, 0] == pytest.approx(1.0, abs=1e-12)
    injected = np.asarray(trace.injection.d)[:, 0]
    np.testing.assert_allclose(injected[6:], 2.0, rtol=1e-12)
    assert np.all(injected[:3] == 0.0)
