import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from holdfast.campaign.blindness import blindness
from holdfast.detectors import chi_square
from holdfast.estimators import kalman
from holdfast.loop import Monitor
from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from monitors import monitor


def memoryless(level):
    """A state that is nearly zero: the residual is the noise, sd 0.5, plus the attack."""
    plant = linear_plant(A=[[1e-3]], C=[[1.0]], Q=[[1e-12]], R=[[0.25]], outputs=["level"])
    estimator = kalman.build(plant, jnp.zeros(1), 1e-12 * jnp.eye(1))
    return Monitor(estimator, chi_square.build(plant, level=level))


def exact_size(level, target, steps):
    """The bias with 1 - (1 - p)^steps = target, p the power of one row's test."""
    limit = chi2.isf(level, 1)
    need = 1 - (1 - target) ** (1 / steps)
    return 0.5 * brentq(lambda shift: ncx2.sf(limit, 1, shift**2) - need, 1e-3, 10.0)


def test_the_sizes_are_those_of_the_closed_form():
    (found,) = blindness(memoryless(1e-3), steps=5, runs=4000)
    assert found.channel == "sensor:level"
    for one in found.found:
        truth = exact_size(1e-3, one.target, 5)
        assert one.size == pytest.approx(truth, rel=0.03)
        assert one.probability == pytest.approx(one.target, abs=4 * one.standard_error)
    quiet = 1 - 0.999**5
    assert found.false_alarm == pytest.approx(quiet, abs=4 * np.sqrt(quiet / 4000))
    half, most = (f"{one.size:.3g}" for one in found.found)
    assert found.sentence == (
        f"This gate cannot see a shift of level under {most} (95 % within 5 steps; 50 % at {half})."
    )


def test_false_alarms_above_the_target_are_no_detection():
    (found,) = blindness(memoryless(0.3), steps=5, runs=250)
    assert found.false_alarm > 0.5
    assert found.found[0].size is None
    assert found.found[1].size is not None


@pytest.mark.slow
def test_what_no_size_reveals_is_said():
    """An unknown-input filter's residual is blind to the attacks it estimates."""
    watched = monitor("chi_square", "residual", "unknown_input", level=1e-4)
    found = blindness(watched, steps=10, runs=250, channels=["channel:spoof", "sensor:gps"])
    assert found[0].found[1].size is None
    assert "of any size" in found[0].sentence
    assert found[1].found[1].size is not None


def test_a_run_that_an_unstable_plant_cannot_last_is_refused():
    with pytest.raises(InvalidValue) as error:
        blindness(monitor("chi_square", "residual", "kalman", growth=1.5), steps=500)
    assert error.value.key == "steps"
