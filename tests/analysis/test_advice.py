"""The sentences: each one where it is due, and not elsewhere."""

import numpy as np

from analysis.models import plant
from holdfast.analysis.advice import advice, combination
from holdfast.analysis.whole import analysis

DOUBLE = np.array([[1.0, 0.1], [0.0, 1.0]])
PUSH = np.array([[0.0], [0.1]])


def said(found_plant, delay=None):
    n = len(found_plant.states)
    return advice(analysis(found_plant, np.zeros(n), np.eye(n)), delay)


def test_a_sound_plant_needs_no_advice():
    assert said(plant(0.5 * DOUBLE, PUSH, np.eye(2))) == []


def test_a_late_attack():
    late = plant(DOUBLE, PUSH, np.array([[1.0, 0.0]]))
    expected = (
        'd1 reaches the outputs only after 1 step: set delay = 1, or measure "x2" and it is '
        "identified at once."
    )
    assert said(late) == [expected]
    assert said(late, 0) == [expected, "The estimator's delay is 0: set it to 1."]
    assert said(late, 1) == [expected]


def test_an_unobservable_plant():
    (state, filter_, hides) = said(plant(DOUBLE, PUSH, np.array([[0.0, 1.0]])))
    assert state == (
        'The outputs do not determine the state: x1 reaches none of them; measure "x1" and they do.'
    )
    assert filter_.startswith("There is no steady-state Kalman filter")
    assert hides == "Without any attack, x1 can move by the mode 1 unseen."


def test_what_hides_and_grows():
    H = np.array([[1.0], [0.0]])
    hides, remedy, grows = said(plant(DOUBLE, np.zeros((2, 1)), np.eye(2), H))
    assert "An attack on d1 that goes like (1)^k hides" in hides
    assert remedy == 'Measure "x1" and nothing that lasts can hide like that.'
    assert "the variance of the estimate of d1 grows without limit" in grows


def test_two_attacks_on_one_output():
    sentences = said(plant(np.diag([0.5, 0.2]), np.eye(2), np.array([[1.0, 1.0]])))
    assert sentences[0].startswith("d1 is never identified: 2 attack channels reach 1 output in")
    assert "moves no output at all" in sentences[2]


def test_a_direction_in_words():
    names = ("a", "b", "c")
    assert combination(np.array([0.0, 2.0, -1.0]), names) == "b - 0.5 c"
    assert combination(np.array([-1.0, 1e-9, 1.0]), names) == "a - c"
    assert combination(np.array([1.0, 1.0j, 0.0]), names) == "a + (0+1j) b"
