"""The scenario px4_gps.toml on two recorded flights, beside a filter written in numpy alone."""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.campaign.calibrate import from_log
from holdfast.detectors import chi_square
from holdfast.estimators import unknown_input
from holdfast.evaluate.scores import episodes
from holdfast.loop import Monitor, replay
from holdfast.plants.library import uav
from holdfast.shell.files import load_scenario
from holdfast.shell.uav import read_flight

SCENARIO = Path(__file__).parents[1] / "examples" / "scenarios" / "px4_gps.toml"
START = 375.744085  # the label; the fix at this moment is still clean
FITTED = dict(
    acceleration_noise=0.097, down_acceleration_noise=0.041,
    position_walk=0.0, down_position_walk=0.084,
    gps_position_sd=0.058, gps_speed_sd=0.132, gps_correlation=0.58,
    gps_down_sd=0.088, gps_down_speed_sd=0.080, gps_down_correlation=0.63,
    baro_sd=0.136, baro_walk=0.140,
)  # fmt: skip
WALKS = ("acceleration_noise", "position_walk", "baro_walk")


@pytest.fixture(scope="module")
def scenario():
    return load_scenario(SCENARIO)


@pytest.fixture(scope="module")
def flights(shared_data, scenario):
    folder = shared_data / "px4_gps_spoof"
    if not folder.is_dir():
        pytest.skip(f"no flights at {folder}")
    pytest.importorskip("pyulog")
    return {
        "benign": read_flight(folder, scenario.plant),
        "spoofed": read_flight(folder / "spoof.ulg", scenario.plant),
    }


@pytest.fixture(scope="module")
def traces(flights, scenario):
    return {k: replay(scenario.monitor, f.log.observation) for k, f in flights.items()}


def fixes(flight):
    return np.asarray(flight.log.observation.seen[:, 0])


def model(dt=0.2, **settings):
    s = FITTED | settings
    F = np.eye(7)
    Q, R = np.zeros((7, 7)), np.zeros((7, 7))
    H = np.eye(7)
    H[6, 2] = -1.0
    for axis in range(3):
        down = "down_" if axis == 2 else ""
        q, w = s[f"{down}acceleration_noise"] ** 2, s[f"{down}position_walk"] ** 2
        rp, rv = s["gps_down_sd" if down else "gps_position_sd"], s[f"gps_{down}speed_sd"]
        pair = np.ix_([axis, axis + 3], [axis, axis + 3])
        F[axis, axis + 3] = dt
        Q[pair] = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        Q[axis, axis] += w * dt
        cross = s[f"gps_{down}correlation"] * rp * rv
        R[pair] = [[rp**2, cross], [cross, rv**2]]
    Q[6, 6], R[6, 6] = s["baro_walk"] ** 2 * dt, s["baro_sd"] ** 2
    return F, Q, H, R


def numpy_filter(observation, gps_until=None, warm=50, **settings):
    """Textbook form. Rows from ``gps_until`` on use the height alone; the offset of the GPS
    from that is kept. Returns states, chi-square per row, GPS offsets and sds, log-likelihood.
    """
    F, Q, H, R = model(**settings)
    y, seen = np.asarray(observation.y), np.asarray(observation.seen)
    x, P = np.zeros(7), np.diag([25.0, 25, 25, 1, 1, 1, 1])
    xs, chi, offsets, sds, likelihood = [], [], [], [], 0.0
    for k in range(len(y)):
        x, P = F @ x, F @ P @ F.T + Q
        free = gps_until is not None and k >= gps_until
        m = seen[k] & (np.arange(7) == 6) if free else seen[k]
        e, S = y[k, m] - H[m] @ x, H[m] @ P @ H[m].T + R[np.ix_(m, m)]
        chi.append(e @ np.linalg.solve(S, e))
        if k >= warm:
            likelihood -= (chi[-1] + np.linalg.slogdet(2 * np.pi * S)[1]) / 2
        K = np.linalg.solve(S, H[m] @ P).T
        x, P = x + K @ e, P - K @ S @ K.T
        # with the height used first: the attack is what the GPS says over the state
        offsets.append(np.where(seen[k, :6], y[k, :6] - H[:6] @ x, np.nan))
        sds.append(np.sqrt(np.diag(H[:6] @ P @ H[:6].T + R[:6, :6])))
        xs.append(x)
    return np.array(xs), np.array(chi), np.array(offsets), np.array(sds), likelihood


def test_every_fix_and_nearly_every_height_is_used(flights):
    for name, gps, baro in (("benign", 248, 1231), ("spoofed", 138, 682)):
        counts = flights[name].counts
        assert (counts["gps"].used, counts["baro"].used) == (gps, baro)
        assert counts["baro"].duplicate == 1
        assert counts["gps"].late == counts["gps"].missing == counts["baro"].faulty == 0


def test_states_and_statistic_are_those_of_a_filter_in_numpy(flights, traces):
    for name, flight in flights.items():
        x, chi, *_ = numpy_filter(flight.log.observation)
        np.testing.assert_allclose(traces[name].estimate.x, x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(traces[name].verdict.statistic, chi, rtol=1e-9, atol=1e-9)


def test_alarm_at_the_first_spoofed_fix_and_never_before(flights, traces):
    alarm = {name: np.asarray(trace.verdict.alarm) for name, trace in traces.items()}
    assert not np.any(alarm["benign"])
    time = flights["spoofed"].log.time
    rows = np.flatnonzero(alarm["spoofed"])
    spoofed = np.flatnonzero(fixes(flights["spoofed"]) & (time > START + 0.5))
    assert rows[0] == spoofed[0]
    stamps = flights["spoofed"].accuracies["eph"].time
    first = stamps[np.flatnonzero(fixes(flights["spoofed"])).searchsorted(rows[0])]
    assert first - START == pytest.approx(0.98, abs=0.005)


def test_the_threshold_is_twice_the_largest_value_without_attack(flights, traces, scenario):
    statistic = {k: np.asarray(t.verdict.statistic)[fixes(flights[k])] for k, t in traces.items()}
    largest = statistic["benign"].max()
    assert pytest.approx(2 * largest, rel=5e-4) == 191.5
    attack = flights["spoofed"].log.time[fixes(flights["spoofed"])] > START + 0.5
    assert statistic["spoofed"][~attack].max() < largest
    assert 4.4 < statistic["spoofed"][attack][0] / largest < 4.5
    assert np.all(statistic["spoofed"][attack][:4] > 191.5)


@pytest.mark.parametrize(
    ("level", "threshold", "alarms_before"), [(0.001, 95.77, 0), (0.01, 26.58, 3)]
)
def test_the_threshold_from_the_benign_log_alone(
    flights, scenario, level, threshold, alarms_before
):
    detector = chi_square.build(scenario.plant, level=level)
    benign = flights["benign"].log.observation
    monitor, _ = from_log(Monitor(scenario.monitor.estimator, detector), benign)
    verdict = replay(monitor, flights["spoofed"].log.observation).verdict
    rows = np.flatnonzero(verdict.alarm)
    attack = np.flatnonzero(fixes(flights["spoofed"]) & (flights["spoofed"].log.time > START + 0.5))
    assert np.sum(rows < attack[0]) == alarms_before
    assert attack[0] in rows
    assert verdict.threshold[attack[0]] == pytest.approx(threshold, abs=0.01)


def test_attack_estimate_is_the_offset_from_dead_reckoning(flights, traces, scenario):
    flight = flights["spoofed"]
    k = int(np.argmax(np.asarray(traces["spoofed"].verdict.alarm)))
    observation = flight.log.observation
    before = jnp.arange(len(observation.y))[:, None] < k
    observation = eqx.tree_at(lambda o: o.trusted, observation, observation.seen & before)
    kalman = scenario.monitor.estimator
    estimator = unknown_input.build(scenario.plant, kalman.x0, kalman.P0)
    estimate = replay(Monitor(estimator, scenario.monitor.detector), observation).estimate
    rows = np.flatnonzero(fixes(flight))
    rows = rows[rows >= k]
    x, _, offsets, sds, _ = numpy_filter(flight.log.observation, gps_until=k)
    np.testing.assert_allclose(estimate.x, x, rtol=0, atol=1e-7)
    np.testing.assert_allclose(estimate.d[rows], offsets[rows], rtol=0, atol=1e-7)
    d_sd = np.sqrt(np.asarray(estimate.d_cov)[rows][:, range(6), range(6)])
    np.testing.assert_allclose(d_sd, sds[rows], rtol=1e-7)
    # at the second spoofed fix the vehicle is said to be 8 m north, 6 m/s fast
    assert offsets[rows[1], 0] == pytest.approx(8.0, abs=0.5)
    assert offsets[rows[1], 3] == pytest.approx(6.3, abs=0.5)


def scaled(process, sensors):
    """The settings with every process and every sensor variance times a factor."""
    return {
        name: value * np.sqrt(process if name.endswith(WALKS) else sensors)
        for name, value in FITTED.items()
        if "correlation" not in name
    }


FIRST_HALF = dict(
    acceleration_noise=0.098, gps_position_sd=0.046, gps_speed_sd=0.121, gps_correlation=0.439,
    down_acceleration_noise=0.029, gps_down_sd=0.074, gps_down_speed_sd=0.084,
    baro_sd=0.138, baro_walk=0.136, down_position_walk=0.096, gps_down_correlation=0.548,
)  # fmt: skip
SECOND_HALF = dict(
    acceleration_noise=0.095, gps_position_sd=0.066, gps_speed_sd=0.145, gps_correlation=0.691,
    down_acceleration_noise=0.045, gps_down_sd=0.105, gps_down_speed_sd=0.078,
    baro_sd=0.135, baro_walk=0.138, down_position_walk=0.073, gps_down_correlation=0.764,
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("as fitted", FITTED),
        *((f"Q x {q}, R x {r}", scaled(q, r)) for q in (0.5, 2) for r in (0.5, 2)),
        ("fitted on the first half", FIRST_HALF),
        ("fitted on the second half", SECOND_HALF),
    ],
)
def test_the_result_survives_other_noises_with_the_threshold_found_anew(flights, name, settings):
    chi = {k: numpy_filter(f.log.observation, **settings)[1][fixes(f)] for k, f in flights.items()}
    time = flights["spoofed"].log.time[fixes(flights["spoofed"])]
    attack = time > START + 0.5
    largest, before = chi["benign"].max(), chi["spoofed"][~attack].max()
    first = chi["spoofed"][attack][0]
    print(f"{name}: benign {largest:.1f}, before {before:.1f}, first spoofed fix {first:.0f}")
    assert 2 * largest < first
    assert before < largest
    assert not episodes(time, (chi["spoofed"] > 2 * largest) & ~attack, 1.5)


def test_half_a_benign_flight_cannot_set_the_threshold(flights):
    f = flights["benign"]
    chi = numpy_filter(f.log.observation)[1][fixes(f)]
    first, second = chi[: len(chi) // 2], chi[len(chi) // 2 :]
    print(f"largest in the first half {first.max():.1f}, in the second {second.max():.1f}")
    assert second.max() > 2 * first.max()


def test_the_plants_noises_are_the_likeliest_for_the_benign_flight(flights):
    plant = uav.build()
    _, Q, _, R = model()
    np.testing.assert_allclose(plant.Q, Q, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(plant.R, R, rtol=1e-12)
    observation = flights["benign"].log.observation
    best = numpy_filter(observation)[-1]
    for name, value in FITTED.items():
        if value == 0:  # at its bound, and flat there
            assert numpy_filter(observation, **{name: 0.03})[-1] < best
            continue
        for factor in (0.9, 1.1):
            found = numpy_filter(observation, **{name: factor * value})[-1]
            assert found < best, (name, factor)
