"""`unknown_input` with a delay: attacks that reach the outputs only after some steps."""

import numpy as np
import pytest

import oracles
import systems
from holdfast.estimators import unknown_input
from holdfast.plants.build import linear_plant
from holdfast.records import Status
from systems import estimates

DT = 0.1


def late_system(seed: int, delay: int, direct: bool = False) -> systems.System:
    """A chain of ``delay`` states between an attack and the sensors, full Q and R, stable.

    Three sensors see the chain's end only, so that the attack is felt ``delay`` steps late;
    with ``direct`` a second channel falsifies one of them.
    """
    rng = np.random.default_rng(seed)
    n = delay + 2
    A = np.diag(rng.uniform(0.3, 0.9, n)) + np.diag(rng.uniform(0.5, 1.5, n - 1), 1)
    C = np.zeros((3, n))
    C[:, 0] = rng.uniform(0.5, 1.5, 3)
    G = np.zeros((n, 1 + direct))
    G[delay, 0] = rng.uniform(0.5, 1.5)
    H = np.zeros((3, 1 + direct))
    if direct:
        H[0, 1] = 1.0
    plant = systems.quiet_plant(
        A=A, B=rng.normal(size=(n, 1)), C=C, D=rng.normal(size=(3, 1)), G=G, H=H,
        Q=systems.covariance(rng, n), R=systems.covariance(rng, 3),
    )  # fmt: skip
    return systems.System(plant, rng.normal(size=n), systems.covariance(rng, n))


@pytest.mark.parametrize(("delay", "direct"), [(0, False), (1, False), (1, True), (2, True)])
def test_late_attacks_are_batch_least_squares(delay, direct):
    check_late_attacks(delay, direct, sorted({max(delay - 1, 0), delay}))


@pytest.mark.slow
@pytest.mark.parametrize("direct", [False, True])
@pytest.mark.parametrize("delay", [0, 1, 2, pytest.param(3, marks=pytest.mark.whole)])
def test_late_attacks_are_batch_least_squares_at_every_delay(delay, direct):
    check_late_attacks(delay, direct, range(delay + 2))


def check_late_attacks(delay, direct, delays):
    """At every row: the same quantities are determined as in the batch problem, and agree.

    1e-9 of the standard deviation: condition numbers of these problems stay under 1e5.
    """
    steps = 10
    known_attacks = 0
    for seed in range(2):
        system = late_system(seed, delay, direct)
        plant, n = system.plant, len(system.plant.states)
        u, y, seen = systems.random_log(seed, plant, steps)
        for given in delays:
            estimator = unknown_input.build(plant, system.x0, system.P0, delay=given)
            got = estimates(estimator, u, y, seen)
            rows = np.r_[:n, n + np.arange(1 + direct) + np.where(estimator.direct, 1 + direct, 0)]
            for k in range(1, steps + 1):
                answer = oracles.batch_estimate(
                    systems.matrices(plant), system.x0, system.P0, u[:k], y[:k], seen[:k],
                    delay=given,
                )  # fmt: skip
                value = np.r_[got.x[k - 1], got.d[k - 1]]
                variance = np.r_[np.diagonal(got.x_cov[k - 1]), np.diagonal(got.d_cov[k - 1])]
                known = answer.determined[rows]
                np.testing.assert_array_equal(np.isfinite(variance), known)
                sd = np.sqrt(np.diagonal(answer.cov)[rows][known].astype(float))
                error = np.abs(value[known] - answer.value[rows][known].astype(float))
                assert np.all(error < 1e-9 * (1 + sd))
                np.testing.assert_allclose(np.sqrt(variance[known]), sd, rtol=1e-9)
            late = np.isfinite(np.asarray(got.d_cov)[given + 1 :, 0, 0])
            assert np.all(late == (given >= delay))
            known_attacks += late.sum()
    assert known_attacks > 10


def test_a_push_on_a_cart_is_known_one_row_late():
    """C G = 0: the push of step k-2 is exact in row k; speed awaits the next position."""
    plant = linear_plant(
        A=[[1, DT], [0, 1]], C=[[1, 0]], G=[[0], [DT]], Q=1e-3 * np.eye(2), R=[[0.01]], dt=DT,
        B=[[0], [DT]], inputs=["push"], attacks=["shove"],
        constraints={"attack": {"matrix": [[1]], "bound": [2], "bound_u": [[-1]]}},
    )  # fmt: skip
    rng = np.random.default_rng(0)
    u, y, seen = rng.normal(size=(20, 1)), rng.normal(size=(20, 1)), np.ones((20, 1), bool)
    got = estimates(unknown_input.build(plant, [0, 0], np.eye(2), delay=1), u, y, seen)
    assert Status(int(got.status[0])).words == "UNOBSERVABLE+HIDDEN_INPUT"
    assert {Status(int(s)).words for s in got.status[1:]} == {"HIDDEN_INPUT"}
    assert np.all(np.isinf(got.x_cov[:, 1, 1]))
    assert np.all(np.isfinite(got.d_cov[1:, 0, 0]))
    # the limit on d + u moves with the input of the row over which the attack acted
    np.testing.assert_allclose(got.d_bound[1:, 0], 2 - u[:-1, 0])


def test_gaps_delay_an_attack_until_it_is_felt():
    """With rows missing the attack of that time is not determined, later ones are again."""
    system = late_system(5, 1)
    u, y, seen = systems.random_log(5, system.plant, 15)
    seen[6] = False
    estimator = unknown_input.build(system.plant, system.x0, system.P0, delay=1)
    got = estimates(estimator, u, y, seen)
    n = len(system.plant.states)
    for k in range(2, 16):
        answer = oracles.batch_estimate(
            systems.matrices(system.plant), system.x0, system.P0, u[:k], y[:k], seen[:k], delay=1
        )
        assert np.isfinite(got.d_cov[k - 1, 0, 0]) == answer.determined[n]
        if answer.determined[n]:
            np.testing.assert_allclose(got.d[k - 1, 0], float(answer.value[n]), rtol=1e-9)
    assert np.isinf(got.d_cov[6, 0, 0])
    assert np.isfinite(got.d_cov[14, 0, 0])
