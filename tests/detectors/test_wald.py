import numpy as np
import pytest
from scipy.special import hyp0f1
from scipy.stats import chi2, ncx2

from holdfast.detectors.wald import alarm_rate, boundary, increments


def simulated_rate(h, shift, dof, seed, walks=4000, steps=1500):
    rng = np.random.default_rng(seed)
    total, alarms = np.zeros(walks), np.zeros(walks)
    for k in range(steps):
        s = rng.chisquare(dof, walks)
        total += np.log(hyp0f1(dof / 2, shift**2 * s / 4)) - shift**2 / 2
        up = total > h
        if k >= 300:
            alarms += up
        total[up | (total < -abs(h))] = 0.0
    rates = alarms / (steps - 300)
    return rates.mean(), rates.std() / np.sqrt(walks)


@pytest.mark.parametrize(("shift", "dof"), [(1.0, 2), (2.5, 1)])
def test_the_boundary_gives_the_level(shift, dof):
    rate, error = simulated_rate(boundary(0.01, shift, dof), shift, dof, 0)
    assert error < 0.01 * 0.01
    assert rate == pytest.approx(0.01, abs=3 * error)


def test_a_large_shift_makes_every_row_decide():
    """The likelihood ratio then is a chi-square test of one row."""
    h = boundary(0.01, 8.0, 2)
    assert h < 0
    s = chi2.isf(0.01, 2)
    assert h == pytest.approx(ncx2.logpdf(s, 2, 64.0) - chi2.logpdf(s, 2), abs=1e-6)


@pytest.mark.parametrize(
    ("shift", "dof", "level"), [(1.0, 2, 1e-4), (0.3, 3, 0.01), (3.0, 1, 1e-6)]
)
def test_the_cells_are_fine_enough(shift, dof, level):
    h = boundary(level, shift, dof)
    rate = alarm_rate(h, increments(shift, dof)[0], 1601)
    assert rate == pytest.approx(level, rel=5e-3)
