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
from holdfast.records import Enforcement, Observation, Status
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


def falsified():
    """Two sensors of a random walk; channels: a lie to the first, a lie to both, a push that the
    second sensor feels at once.
    """
    return linear_plant(
        A=[[1.0]], B=[[2.0]], C=[[1.0], [1.0]], D=[[0.0], [0.5]], G=[[0.0, 0.0, 3.0]],
        H=[[5.0, 1.0, 0.0], [0.0, 1.0, 7.0]], Q=[[0.01]], R=0.04 * np.eye(2),
        states=["x"], inputs=["accel"], outputs=["gps", "odometer"],
        attacks=["spoof", "jam", "push"],
    )  # fmt: skip


EVERYTHING = [
    "sensor:gps", "sensor:odometer", "actuator:accel",
    "channel:spoof", "channel:jam", "channel:push",
]  # fmt: skip


def enforced(enforcement, attacked=EVERYTHING, steps=12):
    plant = falsified()
    monitor = Monitor(kalman.build(plant, [0.0], [[1.0]]), chi_square.build(plant))
    attacks = (bias.build(plant, channels=attacked, value=1.0),) if attacked else ()
    scenario = Scenario(plant, jnp.zeros(1), monitor, None, attacks, enforcement)
    return simulate(scenario, jax.random.key(3), steps)


def test_an_authenticated_sample_arrives_as_it_was_sent():
    """gps at 3, 4, 7, 8, 11, 12, odometer at 2, 5, 8, 11; what moves the state goes on."""
    k = np.arange(1, 13)
    trusted = np.stack([(k >= 3) & ((k - 3) % 4 < 2), (k >= 2) & ((k - 2) % 3 < 1)], 1)
    none = enforced(None)
    some = enforced(Enforcement.of([4, 3], [2, 1], [3, 2]))
    np.testing.assert_array_equal(some.observation.trusted, trusted)
    assert not np.any(none.observation.trusted)
    np.testing.assert_array_equal(some.x, none.x)
    # the same noise in all: what is left beside C x is what was falsified
    noise = enforced(None, None)
    free = noise.observation.y - noise.x
    lies = np.asarray(some.observation.y - some.x - free)
    actuator = np.array([0.0, 0.5])  # D times the push is there, authenticated or not
    np.testing.assert_allclose(lies, np.where(trusted, 0, [7.0, 9.0]) + actuator, atol=1e-12)
    np.testing.assert_array_equal(some.injection.y, np.where(trusted, 0.0, 1.0))
    np.testing.assert_array_equal(some.injection.u, np.ones((12, 1)))
    # a channel counts as used unless nothing of it arrives anywhere
    reached = [~trusted[:, 0], ~(trusted[:, 0] & trusted[:, 1]), np.ones(12, bool)]
    np.testing.assert_array_equal(some.injection.d, np.stack(reached, 1).astype(float))


def test_authentication_alone_changes_no_number():
    never, always = (Enforcement.of([5, 5], n, [1, 1]) for n in (0, 5))
    plain = enforced(None, None)
    for found in (enforced(never, None), enforced(always, None)):
        np.testing.assert_array_equal(found.observation.y, plain.observation.y)
        np.testing.assert_array_equal(found.estimate.x, plain.estimate.x)
    for mine, theirs in zip(
        jax.tree.leaves(enforced(never)), jax.tree.leaves(enforced(None)), strict=True
    ):
        np.testing.assert_array_equal(mine, theirs)


def test_an_estimator_that_relies_on_authentication_is_right_to():
    """`unknown_input` takes H d = 0 where a sample is trusted: the simulation means the same."""
    plant = linear_plant(
        A=[[0.9]], C=[[1.0]], H=[[1.0]], Q=[[0.01]], R=[[0.04]], outputs=["gps"], attacks=["spoof"]
    )
    monitor = Monitor(unknown_input.build(plant, [0.0], [[1.0]]), chi_square.build(plant))
    attack = bias.build(plant, channel="channel:spoof", value=50.0)
    scenario = Scenario(
        plant, jnp.zeros(1), monitor, None, (attack,), Enforcement.of([3], [1], [3])
    )
    trace = simulate(scenario, jax.random.key(0), 300)
    sd = np.sqrt(np.asarray(trace.estimate.x_cov)[:, 0, 0])
    off = (np.asarray(trace.estimate.x) - np.asarray(trace.x))[:, 0]
    # 300 errors that are correlated over a few rows: within 20 % of the covariance, all under 5 sd
    assert np.sqrt(np.mean((off / sd) ** 2)) == pytest.approx(1.0, abs=0.2)
    assert np.max(np.abs(off / sd)) < 5.0
    np.testing.assert_array_equal(trace.estimate.d[2::3], 0.0)
    np.testing.assert_array_equal(trace.injection.d[2::3], 0.0)
