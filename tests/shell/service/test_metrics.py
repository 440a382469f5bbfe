"""The metrics: the numbers that rows and events add up to, in Prometheus' own reading."""

import equinox as eqx
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from holdfast.shell.service.frames import Counts
from holdfast.shell.service.metrics import FORGETTING, Metrics
from holdfast.shell.service.sources import Counters
from live_rows import LABELS, alarm, row


@pytest.fixture
def metrics():
    return Metrics(LABELS, lambda: {'a "source"': Counters(7, 2, 1, 3)}, lambda: (Counts(), 0.0))


def told(metrics):
    """Every sample by its name and labels."""
    text = metrics.exposition().decode()
    return {
        (sample.name, *sorted(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_rows_alarms_and_what_did_not_arrive(metrics):
    for frame in range(1, 6):
        metrics.row(row(frame, alarm=frame > 3))
    metrics.event(alarm(4))
    found = told(metrics)
    assert found["holdfast_rows_total",] == 5
    assert found["holdfast_alarms_total",] == 2
    assert found["holdfast_alarm",] == 1
    assert found["holdfast_missing_total", "gps"] == 0
    assert found["holdfast_missing_total", "flow"] == 5
    assert found["holdfast_events_total", "alarm"] == 1


def test_before_the_first_row_nothing_is_made_up(metrics):
    found = told(metrics)
    assert found["holdfast_rows_total",] == 0
    assert ("holdfast_alarm",) not in found
    assert ("holdfast_sensor_state", "gps") not in found


def test_states_of_the_service(metrics):
    metrics.row(row(1, mode="fallback", sensors=("isolated", "probation")))
    metrics.blind(True)
    found = told(metrics)
    assert found["holdfast_degraded",] == 1
    assert found["holdfast_blind",] == 1
    assert found["holdfast_sensor_state", "gps"] == 2
    assert found["holdfast_sensor_state", "flow"] == 3


def test_the_mean_squared_innovation_is_what_its_formula_says(metrics):
    expected = np.ones(2)
    for frame in range(1, 300):
        metrics.row(row(frame))
        # residuals of 0.1 and 0.2, variances of 0.01 and 0.08
        expected += FORGETTING * (np.array([1.0, 0.5]) - expected)
    found = told(metrics)
    nis = [found["holdfast_innovation_nis", name] for name in LABELS.outputs]
    np.testing.assert_allclose(nis, expected, rtol=1e-12)


@pytest.mark.parametrize("variance", [0.0, np.inf, np.nan])
def test_an_output_that_told_nothing_does_not_count(metrics, variance):
    made = row(1)
    cov = np.diag([variance, 0.08])
    metrics.row(made._replace(estimate=eqx.tree_at(lambda e: e.residual_cov, made.estimate, cov)))
    assert told(metrics)["holdfast_innovation_nis", "gps"] == 1.0


def test_the_histogram_adds_up(metrics):
    for seconds in (5e-5, 1e-4, 2e-3, 0.3, 7.0):
        metrics.latency(seconds)
    found = told(metrics)
    assert found["holdfast_latency_seconds_bucket", "0.0001"] == 2
    assert found["holdfast_latency_seconds_bucket", "0.0025"] == 3
    assert found["holdfast_latency_seconds_bucket", "+Inf"] == 5
    assert found["holdfast_latency_seconds_count",] == 5
    assert found["holdfast_latency_seconds_sum",] == pytest.approx(7.30215)


def test_sources_by_name(metrics):
    found = told(metrics)
    for name, value in (
        ("messages", 7),
        ("rejected", 2),
        ("disconnects", 1),
        ("lost", 3),
    ):
        assert found[f"holdfast_source_{name}_total", 'a "source"'] == value


def test_one_residual_that_is_no_number_does_not_stay(metrics):
    made = row(1)
    bad = np.array([np.nan, 0.2])
    metrics.row(made._replace(estimate=eqx.tree_at(lambda e: e.residual, made.estimate, bad)))
    assert told(metrics)["holdfast_innovation_nis", "gps"] == 1.0
