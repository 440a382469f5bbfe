"""Rows and events as JSON: the columns of a result, and null where there is nothing to tell."""

import json
import math

import equinox as eqx
import numpy as np
import pytest

from holdfast.records import Status
from holdfast.shell.service.episodes import event
from holdfast.shell.service.saying import dumps, event_object, row_object
from live_rows import LABELS, alarm, row


def changed(found, **values):
    """A row with other arrays in its estimate."""
    names = list(values)
    estimate = eqx.tree_at(
        lambda one: [getattr(one, name) for name in names], found.estimate, list(values.values())
    )
    return found._replace(estimate=estimate)


def said(found):
    """As a reader gets it, who takes JSON by its letter."""

    def refuse(word):
        raise ValueError(word)

    return json.loads(dumps(row_object(found, LABELS)), parse_constant=refuse)


def test_the_columns_of_a_result():
    found = row(3, alarm=True, mode="open loop", sensors=("healthy", "stuck"))
    assert said(found) == {
        "frame": 3, "time": pytest.approx(0.3),
        "x:north": 3.0, "x_sd:north": 0.5, "x:east": -3.0, "x_sd:east": 0.2,
        "d:spoof": 0.5, "d_sd:spoof": 1.0,
        "statistic": 25.0, "threshold": 9.0, "alarm": 1,
        "reason": "measurements contradict the model", "status": "OK", "mode": "open loop",
        "sensor:gps": "healthy", "sensor:flow": "stuck",
    }  # fmt: skip


def test_not_ready_says_no_state():
    status = np.array(Status.NOT_READY | Status.MISSING, np.int32)
    found = said(changed(row(1), status=status))
    assert [found[f"x:{name}"] for name in LABELS.states] == [None, None]
    assert [found[f"x_sd:{name}"] for name in LABELS.states] == [None, None]
    assert found["status"] == "MISSING+NOT_READY"


def test_what_is_not_determined():
    found = changed(row(1), x_cov=np.diag([math.inf, 0.04]), d_cov=np.array([[math.inf]]))
    found = said(found)
    assert (found["x:north"], found["x_sd:north"]) == (1.0, None)
    assert (found["x:east"], found["x_sd:east"]) == (-1.0, 0.2)
    assert (found["d:spoof"], found["d_sd:spoof"]) == (None, None)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_nothing_that_json_has_no_word_for(bad):
    found = changed(row(1), x=np.array([bad, 1.0]), x_cov=np.diag([bad, 1.0]), d=np.array([bad]))
    found = said(found)
    assert (found["x:north"], found["d:spoof"]) == (None, None)
    assert found["x_sd:north"] in (None, 0.0)


def test_nothing_to_test():
    found = said(row(1, threshold=math.inf))
    assert (found["statistic"], found["threshold"], found["alarm"]) == (None, None, 0)


def test_an_event():
    assert json.loads(dumps(event_object(alarm(7)))) == alarm(7)._asdict()
    plain = event_object(event(7, 0.7, "clock", "", "begin", "jumped"))
    assert (plain["statistic"], plain["threshold"]) == (None, None)
    with pytest.raises(ValueError, match="JSON"):
        dumps({"time": math.nan})
