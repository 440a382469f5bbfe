"""`nise`, which knows where the attack enters, against batch least squares and Algorithm 1."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import banks
import oracles
import systems
from holdfast.estimators import nise, nisme
from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.library import bicycle, unicycle
from holdfast.plants.nonlinear import nonlinear_plant, sampled
from holdfast.records import Status
from systems import estimates

SHAPES = [(3, 3, 2, 1), (4, 4, 2, 2)]
MORE = [(2, 2, 1, 0), (3, 3, 3, 0), (5, 4, 3, 2), (2, 3, 2, 2), (4, 4, 3, 1), (6, 5, 3, 2)]


def subsets(names):
    return [list(s) for m in range(len(names) + 1) for s in itertools.combinations(names, m)]


def check_batch(seed, shape, mode_of, steps):
    """x, d and covariances of the last row, to 1e-11 of the size of what is compared.

    Rounding comes to 1e-13 and less in most of the systems; 1e-11 is for those where an
    attack or a direction of the state is barely told (`systems.random_system`).
    """
    system = systems.random_system(seed, *shape)
    plant, n = system.plant, shape[0]
    u, y, seen = systems.random_log(seed, plant, steps)
    for mode in mode_of(plant.attacks):
        estimator = nise.build(plant, system.x0, system.P0, mode=mode)
        got = estimates(estimator, u, y, seen)
        A, B, C, D, G, H, Q, R = systems.matrices(plant)
        used = np.flatnonzero(banks.active(plant, mode))
        m = [A, B, C, D, G[:, used], H[:, used], Q, R]
        answer = oracles.batch_estimate(m, system.x0, system.P0, u, y, seen)
        direct = np.asarray(estimator.free.direct)[used]
        rows = np.r_[0:n, n + np.arange(len(used)) + np.where(direct, len(used), 0)]
        assert answer.determined[rows].all()
        wanted, cov = (
            np.asarray(v, float) for v in (answer.value[rows], answer.cov[np.ix_(rows, rows)])
        )
        for ours, truth in (
            (np.r_[got.x[-1], got.d[-1][used]], wanted),
            (got.x_cov[-1], cov[:n, :n]),
            (got.d_cov[-1][np.ix_(used, used)], cov[n:, n:]),
        ):
            size = max(1.0, np.max(np.abs(truth), initial=0.0))
            np.testing.assert_allclose(ours, truth, rtol=0, atol=1e-11 * size)
        others = np.setdiff1d(np.arange(shape[2]), used)
        assert np.all(got.d[:, others] == 0)
        assert np.all(got.d_cov[:, others] == 0)


@pytest.mark.parametrize("shape", SHAPES[:1])
def test_every_mode_is_batch_least_squares_with_free_attacks(shape):
    check_batch(0, shape, subsets, 8)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [*SHAPES, *MORE])
def test_a_hundred_systems_are_batch_least_squares_with_free_attacks(shape):
    """13 of each shape, every mode in turn, 104 in all."""
    for seed in range(200, 213):
        check_batch(
            seed, shape, lambda names, i=seed: [names, subsets(names)[i % 2 ** len(names)]], 15
        )


def check_algorithm_1(plant, model, mode, x0, P0, u, y, tolerance):
    """NISE, and a bank of that one mode, at every row, by the size of what is compared."""
    rows = oracles.algorithm_1(model, x0, P0, banks.active(plant, mode), u, y)
    direct = np.asarray(nise.build(plant, x0, P0, mode=mode).free.direct)
    for estimator in (
        nise.build(plant, x0, P0, mode=mode),
        nisme.build(plant, x0, P0, modes=[mode]),
    ):
        got = jax.tree.map(np.asarray, banks.ran(estimator, banks.log(u, y))[1])
        for k, row in enumerate(rows):
            attack = np.where(direct, row.told, row.found)
            spread = np.where(direct, np.diag(row.told_cov), np.diag(row.found_cov))
            for ours, truth in (
                (got.x[k], row.x), (got.x_cov[k], row.P), (got.d[k], attack),
                (np.diag(got.d_cov[k]), spread),
            ):  # fmt: skip
                size = max(1.0, np.max(np.abs(truth)))
                np.testing.assert_allclose(ours, truth, rtol=0, atol=tolerance * size)


@pytest.mark.slow
def test_a_linear_plant_follows_algorithm_1():
    system = systems.random_system(5, *SHAPES[1])
    u, y, _ = systems.random_log(5, system.plant, 10)
    mode = list(system.plant.attacks)
    model = banks.linear(system.plant, mode)
    check_algorithm_1(system.plant, model, mode, system.x0, system.P0, u, y, 1e-10)


def drive(plant, x, u, d, seed):
    """Measurements of a plant that starts at x, attacked with d at every row, with its noise."""

    d = jnp.asarray(d)

    @jax.jit
    def row(x, inputs):
        u, key = inputs
        one, two = jax.random.split(key)
        x = plant.advance(one, 1, x, u, d)
        return x, plant.measure(two, 1, x, u, d)

    keys = jax.random.split(jax.random.key(seed), len(u))
    return np.asarray(jax.lax.scan(row, jnp.asarray(x), (jnp.asarray(u), keys))[1])


def swinging():
    """A pendulum (rad, rad/s) whose torque and angle sensor may be falsified."""

    def f(x, u, d):
        return jnp.stack([x[1], -9.81 * jnp.sin(x[0]) - 0.1 * x[1] + u[0] + d[0]])

    return nonlinear_plant(
        sampled(f, 0.05, substeps=2),
        lambda x, u, d: jnp.stack([x[0] + d[1], x[1], x[0] + 0.5 * x[1]]),
        Q=np.diag([1e-6, 1e-4]), R=np.diag([1e-4, 4e-4, 2e-4]), dt=0.05,
        states=["angle", "rate"], inputs=["torque"], outputs=["y1", "y2", "y3"],
        attacks=["push", "spoof"],
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    "mode", [["push"], pytest.param(["push", "spoof"], marks=pytest.mark.whole)]
)
def test_a_pendulum_follows_algorithm_1(mode):
    """h is linear, f is not: 1e-9, the size of what 30 rows make of rounding."""
    plant = swinging()
    u = np.sin(np.arange(30.0))[:, None]
    y = drive(plant, [1.2, 0.0], u, banks.active(plant, mode) * jnp.array([0.7, 0.3]), 0)
    model = banks.nonlinear(plant, mode)
    check_algorithm_1(plant, model, mode, [1.0, 0.1], np.diag([0.1, 0.2]), u, y, 1e-9)


@pytest.mark.whole
@pytest.mark.slow
def test_a_car_whose_steering_is_falsified_follows_algorithm_1():
    plant = bicycle.build()
    mode = [plant.attacks[0]]
    u = np.stack([0.2 * np.sin(np.arange(40) / 5), np.ones(40)], 1)
    x0 = np.array([0.0, 0.0, 0.3, 15.0])
    y = drive(plant, x0, u, banks.active(plant, mode) * 0.1, 1)
    model = banks.nonlinear(plant, mode)
    check_algorithm_1(plant, model, mode, x0, 0.01 * np.eye(4), u, y, 1e-9)


@pytest.mark.slow
def test_a_robot_with_a_spoofed_landmark_follows_algorithm_1():
    """h bends, and is linearised at the prediction, as (8) has it; bearings never turn over."""
    plant = unicycle.build(landmarks=[[5, 1], [6, -2], [4, 4]])
    mode = ["range:1"]
    u = np.stack([0.3 + 0 * np.arange(40), 0.2 * np.cos(np.arange(40) / 3)], 1)
    y = drive(plant, np.array([0.0, 0.0, 0.1]), u, banks.active(plant, mode), 2)
    model = banks.nonlinear(plant, mode)
    P0 = np.diag([0.04, 0.04, 0.01])
    check_algorithm_1(plant, model, mode, [0.1, -0.1, 0.0], P0, u, y, 1e-9)


@pytest.mark.slow
def test_an_attack_that_its_row_cannot_see_is_told():
    """C G = 0: the paper's M_2 = 0 would give the speed as if there were no push."""
    plant = linear_plant(
        A=[[1, 0.1], [0, 1]], C=[[1, 0]], G=[[0, 0], [0.1, 0]], H=[[0, 1]],
        Q=1e-3 * np.eye(2), R=[[0.01]], attacks=["push", "spoof"],
    )  # fmt: skip
    words = {}
    for mode in (["push"], ["spoof"], []):
        estimate = nise.build(plant, [0, 0], np.eye(2), mode=mode)
        got = estimates(estimate, np.zeros((5, 0)), np.ones((5, 1)), np.ones((5, 1), bool))
        words[tuple(mode)] = {Status(int(s)).words for s in got.status}
        assert np.isinf(got.x_cov[-1, 1, 1]) == (mode == ["push"])
    assert words == {
        ("push",): {"UNOBSERVABLE+HIDDEN_INPUT"}, ("spoof",): {"OK"}, (): {"OK"},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        (["d3"], "mode: found 'd3', expected one of d1, d2"),
        (["d1", "d1"], r"mode: found \['d1', 'd1'\], expected names that differ"),
    ],
)
def test_a_mode_that_cannot_be_is_told(mode, message):
    system = systems.random_system(0, *SHAPES[0])
    with pytest.raises(InvalidValue, match=message):
        nise.build(system.plant, system.x0, system.P0, mode=mode)


def test_without_a_mode_every_channel_may_be_attacked():
    system = systems.random_system(0, *SHAPES[0])
    every = nise.build(system.plant, system.x0, system.P0)
    assert np.asarray(every.free.active).tolist() == [True, True]
    none = nise.build(system.plant, system.x0, system.P0, mode=[])
    assert np.asarray(none.free.active).tolist() == [False, False]
