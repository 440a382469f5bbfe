"""What would help a decoder, what nothing does, and how `holdfast analyse` says it."""

import json

import numpy as np
import pytest
from scipy.linalg import block_diag

from analysis.models import model, plant
from holdfast.analysis import windows
from holdfast.analysis.advice import advice
from holdfast.analysis.correctable import correctable
from holdfast.analysis.decoding_advice import on_decoding
from holdfast.analysis.model import model_at
from holdfast.analysis.remedies import decoding, exposed, remedies, singles
from holdfast.analysis.whole import analysis
from holdfast.shell.analysing import content


def of(A, C):
    A = np.asarray(A, float)
    return model(A, np.zeros((len(A), 0)), np.asarray(C, float))


# an axis of a vehicle: position, speed, tilt; and another one
AXIS = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.5], [0.0, 0.0, 0.6]])
TWO = block_diag(AXIS, [[1.0, 0.1], [0.0, 1.0]])


def sensors(*states):
    return np.eye(5)[list(states)]


def test_what_one_or_two_sensors_see():
    found = exposed(of(TWO, sensors(0, 1, 3, 3)), 5)
    assert [one.sensors for one in found] == [
        ("y1",),
        ("y1", "y2"),
        ("y1", "y2"),
        *[("y3", "y4")] * 2,
    ]
    np.testing.assert_allclose([one.direction for one in found], np.eye(5), atol=1e-9)
    assert exposed(of(TWO, sensors(0, 0, 0, 3, 3, 3)), 5) == ()
    # no attack of one sensor is corrected, wherever it is
    for C in (sensors(0, 1, 3, 3, 3), sensors(0, 0, 3, 3, 3)):
        assert exposed(of(TWO, C), 5)
        assert correctable(of(TWO, C), 5).fixed_l0 == correctable(of(TWO, C), 5).any.exact == 0
    assert correctable(of(TWO, sensors(0, 0, 0, 3, 3, 3)), 5).fixed_l0 == 1


def test_each_remedy_is_the_plant_with_it():
    vehicle = of(TWO, sensors(0, 0, 0, 1, 3, 3, 4))
    for i, remedy in enumerate(singles(vehicle, 5, "authenticate")):
        after = correctable(vehicle, 5, trusted=(i,))
        assert (remedy.name, remedy.l0, remedy.l1) == (f"y{i + 1}", after.l0.exact, after.l1.exact)
    for i, remedy in enumerate(singles(vehicle, 5, "measure")):
        after = correctable(vehicle.measuring(i), 5)
        assert (remedy.l0, remedy.l1) == (after.l0.exact, after.l1.exact)
        assert remedy.name == f"x{i + 1}"


@pytest.mark.parametrize("decoder", ["l0", "l1"])
@pytest.mark.parametrize("q", [1, 2])
def test_a_plan_is_enough_and_not_too_much(decoder, q):
    vehicle, window = of(TWO, sensors(0, 1, 3)), 4
    weight = None if decoder == "l0" else np.array([2.0, 1.0, 1.0])
    plan = remedies(vehicle, window, q, decoder, "measure", 14, weight=weight)
    assert plan.enough
    for left_out in [None, *plan.names]:
        names = list(plan.names)
        if left_out is not None:
            names.remove(left_out)
        after, weights = vehicle, weight
        for name in names:
            after = after.measuring(vehicle.states.index(name))
            weights = None if weights is None else np.append(weights, 1.0)
        found = getattr(correctable(after, window, weight=weights), decoder)
        assert (found.lower >= q) == (left_out is None)
    trusted = remedies(vehicle, window, q, decoder, "authenticate")
    assert (trusted.names, trusted.enough) == (("y1", "y3"), True)
    few = remedies(vehicle, window, q, decoder, "measure", 2)
    assert (len(few.names), few.enough) == (2, False)


def said(A, C, **kw):
    made = plant(A, np.zeros((len(A), 0)), C)
    found = analysis(made, np.zeros(len(A)), np.eye(len(A)), **kw)
    sentences = advice(found, None, decoding=True)
    return sentences, json.loads(json.dumps(content(found, sentences), allow_nan=False))


def test_sentences():
    assert said(TWO, sensors(0, 0, 0, 1, 3, 3, 3), window=6)[0] == [
        "With a window of 6, l0 corrects 1 attack per step, from T = 4; the l1 decoder is certain "
        "to correct 0 (worst ratio for 1: 4.25).",
        'Authenticate "y1" and the l1 decoder corrects 1 attack per step.',
        'Measure "x2" as well and the l1 decoder corrects 1 attack per step.',
    ]
    assert said(TWO, sensors(0, 0, 0, 1, 3, 3, 3), window=2)[0] == [
        "With a window of 2, l0 corrects 0 attacks per step (1 from T = 4); the l1 decoder is "
        "certain to correct 0 (worst ratio for 1: infinite).",
        'x3 is seen by one sensor only, "y4": an attack on it cannot be corrected by any decoder.',
        'Authenticate "y4" and l0 and the l1 decoder correct 1 attack per step.',
        'Measure "x2" (2 times) as well and l0 and the l1 decoder correct 1 attack per step.',
    ]
    (attacks, one, other, two, *plans) = said(TWO, sensors(0, 1, 3))[0]
    assert attacks.startswith("With a window of 5, l0 corrects 0 attacks per step; the l1 decoder")
    assert one.startswith('x1 is seen by one sensor only, "y1"')
    assert other.startswith('x4 and x5 are seen by one sensor only, "y3"')
    assert two == (
        'x2 and x3 are seen by two sensors only, "y1" and "y2": which of them is attacked cannot '
        "be told by any decoder."
    )
    assert plans[0].startswith('Authenticate "y1" and "y3" and l0 and the l1 decoder correct 1')
    assert all("a beginning, but more is needed" in plan for plan in plans[1:])
    (short, *_) = said(TWO, sensors(0, 0, 0, 3, 3, 3), window=2)[0]
    assert short == "A window of 2 does not determine the state: nothing is corrected."
    (large,) = on_decoding(decoding(of(0.5 * np.eye(40), np.ones((26, 40))), 2), ())
    assert large.startswith("What the decoders correct cannot be said: 26 sensors, 40 states")


def test_json():
    found = said(TWO, sensors(0, 0, 0, 1, 3, 3, 3), window=6)[1]["correctable"]
    assert (found["window"], found["l0"], found["l1"], found["any"]) == (6, 1, 0, 1)
    assert found["lower"] == found["upper"] == {"l0": 1, "l1": 0, "any": 1}
    assert found["l1_ratio"]["1"] == pytest.approx(4.2534, abs=1e-4)
    assert found["l1_ratio_bounds"]["upper"]["3"] is None
    assert (found["fixed"]["l0"], found["fixed"]["l1"]) == (1, 0)
    assert (found["cospark"], found["relaxed"], found["supports"]) == (15, 7, [3, 3, 3, 3, 4])
    assert (found["theorem_1_window"], found["sharper_window"]) == ({"1": None}, {"1": None})
    assert found["exact_window"] == {"1": 4}
    assert found["trusted"]["y1"] == {"l0": 1, "l1": 1}
    assert set(found["measured"]) == {"x1", "x2", "x3", "x4", "x5"}
    assert found["remedies"]["l0"] == {}
    assert found["remedies"]["l1"]["measure"] == {"names": ["x2"], "enough": True}
    lost = said(TWO, sensors(0, 1, 3))[1]["correctable"]["exposed"]
    assert lost[0] == {"sensors": ["y1"], "state": {"x1": 1.0, "x2": 0, "x3": 0, "x4": 0, "x5": 0}}
    nothing = said(0.5 * np.eye(4), np.ones((5, 4)), window=2000)[1]["correctable"]
    assert (nothing["l0"], nothing["l1"], nothing["lower"]) == (None, None, None)
    assert "too many" in nothing["reason"]
    json.dumps(said(np.diag([0.5, 0.4]), np.array([[1.0, 0.0]] * 3))[1], allow_nan=False)


def test_weights_are_those_of_the_decoder():
    """1 / sd of each sample given the last state: y_t = C A^-k x + noise."""
    Q, R, C = np.diag([1.0, 2.0, 0.5, 0.1, 3.0]), np.diag([1.0, 4.0, 9.0]), sensors(0, 1, 3)
    made = plant(TWO, np.zeros((5, 0)), C, Q=Q, R=R)
    found = windows.noise_weights(model_at(made, np.zeros(5)), 4)
    back, S, variance = np.linalg.inv(TWO), np.zeros((5, 5)), []
    for _ in range(4):
        variance.insert(0, np.diagonal(C @ S @ C.T + R))
        S = back @ (S + Q) @ back.T
    np.testing.assert_allclose(found, 1.0 / np.sqrt(variance), rtol=1e-9)
    both = analysis(made, np.zeros(5), np.eye(5), 4, (0,), True).decoding.correctable
    alone = correctable(model_at(made, np.zeros(5)), 4, (0,), found)
    np.testing.assert_array_equal(both.upper, alone.upper)
