"""What the rows of DECOMPOSE are computed with, against independent computations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from holdfast.detectors import chi_square
from holdfast.estimators import penalty, secure_fusion
from holdfast.loop import Monitor, replay
from holdfast.papers.decompose_example import EXAMPLE, example
from holdfast.papers.decompose_fusion import drawn, fused, minimisers, simulated, squares
from holdfast.papers.decompose_secure import solved
from holdfast.plants.library import five_sensors
from holdfast.records import Observation

GAMMA = 0.75


def test_the_product_gives_the_same_estimate(monkeypatch):
    """`secure_fusion` in its own basis, on the stable variant; (12) and (31) in the paper's."""
    monkeypatch.setattr(penalty, "DRAWS", 10)  # what gamma costs is of no interest here
    plant = five_sensors.build(stable=True)
    given = example(modes=(1.0, 1.0, five_sensors.CALM))
    x, zeta, y, local = np.zeros(3), np.zeros((5, 3)), [], []
    for k, noise in enumerate(drawn(1, 100, 8)[0]):
        x = given.A @ x + noise[:3]
        y.append(given.C @ x + noise[3:] + [50.0 * (k > 40), 0, 0, 0, 0])
        zeta = zeta @ np.real(given.J).T + y[-1][:, None]
        local.append(zeta.ravel())
    found, F = fused(given), np.real(given.stacked()[1])
    zeta = np.array(local)
    f = minimisers(found.rows, GAMMA, -zeta @ found.Z)
    mine = (zeta + f) @ F.T
    monitor = Monitor(secure_fusion.build(plant, gamma=GAMMA), chi_square.build(plant))
    log = jax.tree.map(jnp.asarray, Observation.of(np.zeros((100, 0)), np.array(y)))
    # coordinates of condition 1e3, estimates of order 10
    np.testing.assert_allclose(replay(monitor, log).estimate.x, mine, atol=1e-8)
    assert np.max(np.abs(zeta @ F.T - mine)[45:]) > 1.0


@pytest.mark.parametrize("attack", [0.0, 100.0, 1e6])
def test_the_minimizer_fulfils_what_makes_it_one(attack):
    """Subgradients of (31), and G' W^-1 phi = 0 for the free state: both to rounding."""
    one = solved(GAMMA, attack, count=100, sensor=3)
    G = np.real(EXAMPLE.stacked()[0])
    # |W^-1| = 1500 makes 1e-13 of rounding in eps and f, of the size of the attack
    size = max(1.0, 1e-3 * attack)
    assert np.max(np.abs(one.pull @ G)) < 1e-9 * size
    assert np.max(np.abs(one.pull)) < GAMMA + 1e-9 * size
    on = one.f != 0
    assert np.max(np.abs((one.pull - GAMMA * np.sign(one.f))[on])) < 1e-9 * size


@pytest.mark.parametrize(("sensor", "slope"), [(0, 0.0), (1, 0.5558), (2, 0.4210), (3, 0.0)])
def test_growth_by_linear_programming(sensor, slope):
    """What (31) tends to for a large lie s: the least of sum |G u - s|_1 over u."""
    found, G = fused(), np.real(EXAMPLE.stacked()[0])
    N, n = G.shape
    # u, t:  t >= +-(G u - s)
    A = np.block([[G, -np.eye(N)], [-G, -np.eye(N)]])
    s = found.settled[sensor]
    answer = linprog(np.append(np.zeros(n), np.ones(N)), A, np.append(s, -s), bounds=(None, None))
    assert np.linalg.norm(answer.x[:n]) == pytest.approx(slope, abs=1e-4)
    draws = drawn(1, 100, 12)
    rms = np.sqrt(squares(found, GAMMA, 1e8 * s, draws)[0]) / 1e8
    assert rms == pytest.approx(slope, abs=1e-4)


def test_a_penalty_that_is_never_paid_is_the_kalman_filter():
    """With gamma out of reach: tr P, and over time too; with an attack of 1, F (I - J)^-1 1."""
    found = fused()
    draws = drawn(2, 50, 12)
    assert squares(found, 1e9, np.zeros(15), draws) == pytest.approx(found.trace, rel=1e-12)
    bias = np.sum((found.F @ found.settled[0]) ** 2)
    M, K = EXAMPLE.M, EXAMPLE.K
    np.testing.assert_allclose(
        -found.F @ found.settled[0], np.linalg.solve(np.eye(3) - M, K[:, 0]), rtol=1e-9
    )
    attacked = squares(found, 1e9, found.settled[0], draws)
    assert attacked == pytest.approx(found.trace + bias, rel=1e-9)
    # 2000 correlated squares: 3 % of the mean is two standard deviations and more
    over_time = simulated(found, 1e9, np.zeros(5), 4, 500)
    assert over_time.mean() == pytest.approx(1.0, abs=0.1)
