from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from holdfast.campaign.attack_free import attack_free, horizon
from holdfast.campaign.calibrate import calibrated, content_key, from_log
from holdfast.loop import Scenario, replay, simulate
from holdfast.parts import InvalidValue
from holdfast.records import Observation
from monitors import DETECTORS, monitor, rate

LEVEL = 0.01
EVERY = [
    (name, on, estimator)
    for on, estimator in (
        ("residual", "kalman"),
        ("residual", "unknown_input"),
        ("attack", "unknown_input"),
    )
    for name in DETECTORS
]


def check(name, on, estimator, runs, steps):
    watched, how = calibrated(monitor(name, on, estimator, level=LEVEL), seed=1)
    found, error = rate(watched, runs, steps)
    error = np.hypot(error, how.standard_error or 0.0)
    assert found == pytest.approx(LEVEL, abs=3 * error)
    assert error < 0.1 * LEVEL
    return how


@pytest.mark.parametrize(
    ("name", "on", "estimator", "method"),
    [
        ("windowed", "residual", "kalman", "exact"),
        pytest.param("sprt", "attack", "unknown_input", "simulated", marks=pytest.mark.slow),
    ],
)
def test_the_false_alarm_rate_is_the_level(name, on, estimator, method):
    how = check(name, on, estimator, 250, 500)
    assert how.method == method
    assert f"{LEVEL:g}" in how.sentence


@pytest.mark.whole
@pytest.mark.slow
@pytest.mark.parametrize(("name", "on", "estimator"), EVERY)
def test_a_thousand_runs_of_a_thousand_rows(name, on, estimator):
    check(name, on, estimator, 1000, 1000)


def test_correlated_attack_estimates_need_more_than_the_quantile():
    """Sums over correlated rows vary more: the factor is above 1, and the row alone is exact."""
    _, sums = calibrated(monitor("windowed", "attack", "unknown_input"), runs=500)
    assert sums.method == "simulated"
    assert sums.value > 1.02
    assert (sums.seed, sums.runs, sums.steps, sums.burn_in) == (0, 500, 500, 100)
    _, row = calibrated(monitor("chi_square", "attack", "unknown_input"))
    assert row.method == "exact"
    # the same content: the same record, not simulated again
    again = calibrated(monitor("windowed", "attack", "unknown_input"), runs=500)[1]
    assert again is sums


@pytest.mark.slow
def test_a_bank_that_believes_in_no_attack_has_passed_its_test():
    """Its false-alarm rate is per row, not per row in which it believes in an attack."""
    watched = monitor("chi_square", "attack", "nisme", level=LEVEL)
    calm, how = calibrated(watched, runs=50)
    assert how.method == "simulated"
    assert "at most 0.01" in how.sentence
    judged = attack_free(calm, None, jax.random.split(jax.random.key(7), 50), 500)
    assert 0 < np.mean(np.isfinite(judged.threshold)) < 0.5
    assert np.mean(judged.alarm) <= LEVEL
    assert float(calm.detector.factor) >= 1.0
    quiet = Observation.of(np.zeros((300, 1)), 0.1 * np.random.default_rng(0).normal(size=(300, 4)))
    logged, how = from_log(watched, quiet)
    assert float(logged.detector.factor) >= 1.0
    assert how.steps == 300


def test_a_key_depends_on_content_alone():
    one, same, other = (monitor("cusum", "attack", "kalman", level=v) for v in (0.01, 0.01, 0.02))
    assert content_key(one, (0,)) == content_key(same, (0,))
    assert content_key(one, (0,)) != content_key(other, (0,))
    assert content_key(one, (0,)) != content_key(one, (1,))


@pytest.mark.parametrize("threshold", ["paper", 7.0])
def test_a_given_threshold_is_left_alone(threshold):
    watched = monitor("cusum", "attack", "unknown_input", threshold=threshold)
    same, how = calibrated(watched)
    assert same is watched
    assert how.method == "given"


def test_unstable_plants_run_shortly():
    watched = monitor("windowed", "attack", "unknown_input", growth=1.5)
    most = horizon(watched.estimator.plant, None)
    assert most == int(np.log(1e8) / np.log(1.5))
    _, how = calibrated(watched, runs=500)
    assert how.steps == most
    assert how.burn_in == most // 2


def test_a_level_out_of_reach_is_refused():
    with pytest.raises(InvalidValue) as error:
        calibrated(monitor("per_channel", "residual", "kalman", level=1e-9))
    assert error.value.key == "level"


@cache
def whole_log(seed):
    watched = monitor("chi_square", "residual", "kalman")
    scenario = Scenario(watched.estimator.plant, jnp.zeros(2), watched)
    found = simulate(scenario, jax.random.key(seed), 2000).observation
    return np.asarray(found.u), np.asarray(found.y)


def log_of(rows, seed):
    u, y = whole_log(seed)
    return Observation.of(u[:rows], y[:rows])


def test_a_log_sets_the_threshold():
    """The noise is twice what the model says; the log knows."""
    watched = monitor("chi_square", "residual", "kalman", level=0.05)
    log = log_of(2000, 0)
    doubled = eqx.tree_at(lambda o: o.y, log, 2.0 * log.y)
    set_by_log, how = from_log(watched, doubled)
    assert how.method == "log"
    alarms = int(np.sum(replay(set_by_log, doubled).verdict.alarm))
    assert alarms == int(0.05 * 2001) - 1
    # scaling every y and x by 2 scales the statistic by 4, but for the start
    assert how.value == pytest.approx(4 * from_log(watched, log)[1].value, rel=0.05)
    # about 100 alarms: 95 % above 99 is 117
    assert 0.055 < how.upper < 0.065
    assert "95 %" in how.sentence


@pytest.mark.slow
def test_the_confidence_of_a_log_holds():
    """Over 200 logs of 300 rows the true rate lies under the bound in 95 %."""
    watched = monitor("chi_square", "residual", "kalman", level=0.02)
    held = 0
    for seed in range(200):
        _, how = from_log(watched, log_of(300, seed))
        held += chi2.sf(how.value * chi2.isf(0.02, 4), 4) <= how.upper
    assert held / 200 == pytest.approx(0.95, abs=3 * np.sqrt(0.05 * 0.95 / 200))


@pytest.mark.parametrize("name", ["chi_square", "sprt"])
def test_a_short_log_says_what_it_supports(name):
    watched = monitor(name, "residual", "kalman", level=1e-3)
    log = log_of(300, 3)
    set_by_log, how = from_log(watched, log)
    assert not np.any(replay(set_by_log, log).verdict.alarm)
    assert how.upper >= 1 - 0.05 ** (1 / 300) - 1e-12
    assert "too few" in how.sentence
    assert "2995" in how.sentence


def test_a_log_with_nothing_to_test_is_refused():
    watched = monitor("chi_square", "attack", "kalman")
    with pytest.raises(InvalidValue):
        from_log(watched, log_of(50, 0))
