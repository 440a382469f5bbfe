"""What estimators promise in numbers, against linear programs, enumeration and attackers."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from holdfast.analysis.model import model_at
from holdfast.analysis.promises import (
    Hit,
    _largest,
    _ratio,
    _size_of_sum,
    decoupled,
    of_decoder,
    of_fusion,
)
from holdfast.estimators import l1_decoder, secure_fusion
from holdfast.numerics.local import decompose
from holdfast.numerics.steady_state import steady_state
from holdfast.plants.build import linear_plant
from holdfast.records import Observation


def sensors(mask, nu=0, nd=0, at_once=None):
    return Hit(np.zeros(nu, bool), np.array(mask, bool), np.zeros(nd, bool), at_once)


def three_receivers(**changes):
    """Position and speed; three position sensors, two of speed."""
    keys = dict(
        A=[[1.0, 0.1], [0.0, 1.0]],
        C=[[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]],
        Q=np.diag([4e-4, 2.5e-3]),
        R=np.diag([0.25, 0.25, 0.49, 0.04, 0.09]),
        dt=0.1,
    )
    return linear_plant(**(keys | changes))


@pytest.mark.parametrize("seed", range(5))
def test_the_largest_entry_is_that_of_a_linear_program(seed):
    rng = np.random.default_rng(seed)
    M, row = rng.normal(size=(7, 3)), rng.normal(size=3)
    # primal: max row z, -t <= M z <= t, sum t <= 1
    A = np.block([[M, -np.eye(7)], [-M, -np.eye(7)], [np.zeros((1, 3)), np.ones((1, 7))]])
    b = np.append(np.zeros(14), 1.0)
    bounds = [(None, None)] * 3 + [(0, None)] * 7
    primal = linprog(np.append(-row, np.zeros(7)), A_ub=A, b_ub=b, bounds=bounds)
    assert _largest(M, row) == pytest.approx(-primal.fun, rel=1e-9)


def test_what_no_row_sees_has_no_bound():
    assert _largest(np.array([[1.0, 0.0]]), np.array([0.0, 1.0])) == np.inf
    assert _largest(np.zeros((0, 1)), np.ones(1)) == np.inf
    assert _largest(np.zeros((0, 1)), np.zeros(1)) == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_the_ratio_is_the_worst_of_all_signs(seed):
    """On each pattern of signs of the attacked rows the sum is linear: a linear program each."""
    rng = np.random.default_rng(seed)
    M, rows = rng.normal(size=(8, 3)), np.arange(8) < 3
    best = 0.0
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        best = max(best, _largest(M[~rows], np.array(signs) @ M[rows]))
    assert _ratio(M, rows) == pytest.approx(best, rel=1e-7)


def test_the_size_of_a_sum_of_moduli():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 4))
    drawn = np.abs(rng.normal(size=(1_000_000, 4)) @ root.T).sum(1)
    # the mean square of a million draws is known to 0.2 %
    assert _size_of_sum(root @ root.T) == pytest.approx(np.sqrt(np.mean(drawn**2)), rel=5e-3)


HIT = [np.eye(5, dtype=bool)[0], pytest.param(np.eye(5, dtype=bool)[4], marks=pytest.mark.slow)]
SIZES = np.array([0.0, 0.5, 3.0, 1e3, 1e6])


@pytest.mark.parametrize("weights", ["none", pytest.param("noise", marks=pytest.mark.slow)])
@pytest.mark.parametrize("mask", HIT, ids=["a receiver", "the worse speed"])
def test_no_attack_on_a_decoder_exceeds_its_bound(weights, mask):
    """Attacks of all sizes keep the bound in the mean, and it is not infinite."""
    plant = three_receivers()
    estimator = l1_decoder.build(plant, np.zeros(2), np.eye(2), window=4, weights=weights)
    assert estimator.window.laid is not None
    bound = of_decoder(model_at(plant, np.zeros(2)), estimator.window.laid, weights == "noise",
                       sensors(mask))  # fmt: skip
    assert np.all(np.isfinite(bound))
    error = errors_of(plant, estimator, SIZES[:, None, None] * mask)
    assert np.all(np.sqrt(np.mean(error**2, (1, 2))) <= bound)


def errors_of(plant, estimator, attacks, steps=30, runs=50, skip=5):
    """Errors (attacks x runs x rows x n) of an estimator whose sensors are off by each of
    ``attacks`` (attacks x rows or 1 x m).
    """
    rng = np.random.default_rng(1)
    A, C, Q, R = (np.asarray(m) for m in (plant.A, plant.C, plant.Q, plant.R))
    n, m = len(A), len(C)
    w = rng.normal(size=(runs, steps, n)) @ np.linalg.cholesky(Q).T
    v = rng.normal(size=(runs, steps, m)) @ np.linalg.cholesky(R).T
    x, states = np.zeros((runs, n)), []
    for k in range(steps):
        x = x @ A.T + w[:, k]
        states.append(x)
    x = np.stack(states, 1)
    # he pushes to and fro, so that the filters do not get used to it
    turns = np.where(np.arange(steps) % 7 < 4, 1.0, -1.0)[:, None]
    y = (x @ C.T + v)[None] + (np.asarray(attacks) * turns)[:, None]

    def run(y):
        def step(state, row):
            told = Observation(
                jnp.zeros(0), row, jnp.ones(m, bool), jnp.zeros(m, bool), jnp.asarray(0, jnp.int32)
            )
            state, estimate = estimator.step(state, told)
            return state, estimate.x

        return jax.lax.scan(step, estimator.init()[0], y)[1]

    found = np.asarray(jax.jit(jax.vmap(run))(jnp.asarray(y.reshape(-1, steps, m))))
    return (found.reshape(len(y), runs, steps, n) - x)[:, :, skip:]


def test_three_like_sensors_in_closed_form():
    """Window of one row: kappa = 1/2, m = 1/2, so the bound is 2 (|e_2| + |e_3|), whose mean
    square is 4 (2 + 4 / pi).
    """
    plant = linear_plant(A=[[1.0]], C=np.ones((3, 1)), Q=[[0.0]], R=np.eye(3))
    estimator = l1_decoder.build(plant, np.zeros(1), np.eye(1), window=1)
    assert estimator.window.laid is not None
    bound = of_decoder(model_at(plant, np.zeros(1)), estimator.window.laid, False,
                       sensors([1, 0, 0]))  # fmt: skip
    assert bound == pytest.approx(2.0 * np.sqrt(2.0 + 4.0 / np.pi), rel=1e-9)


def test_the_bound_of_a_scalar_fusion_by_hand():
    plant = linear_plant(A=[[0.9]], C=np.ones((4, 1)), Q=[[1.0]], R=np.diag([1.0, 2.0, 1.0, 3.0]))
    local, gamma = fused(plant), 2.0
    # the paper's coordinate of a bank of one mode is the one with b = 1
    G, W = local.G[:, 0] / local.b[0], local.W / local.b[0] ** 2
    kappa = abs(G[0]) / np.sum(np.abs(G[1:]))
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(3), W[1:, 1:], 1_000_000)
    noise = np.sqrt(np.mean(np.sum(np.abs(drawn), 1) ** 2))
    lost = gamma / 2 * np.sum(np.abs(W))
    by_hand = (2 * noise + lost) / np.sum(np.abs(G[1:])) / (1 - kappa)
    # a million draws know the noise to 0.1 %
    assert of_fusion(local, gamma, sensors([1, 0, 0, 0])) == pytest.approx(by_hand, rel=5e-3)


def test_where_the_others_can_be_outvoted_a_decoder_promises_nothing():
    plant = three_receivers()
    estimator = l1_decoder.build(plant, np.zeros(2), np.eye(2), window=4)
    assert estimator.window.laid is not None
    model = model_at(plant, np.zeros(2))
    two = of_decoder(model, estimator.window.laid, False, sensors([1, 1, 0, 0, 0]))
    assert np.all(np.isinf(two))
    pushed = Hit(np.ones(1, bool), np.zeros(5, bool), np.zeros(0, bool))
    assert np.all(np.isinf(of_decoder(model, estimator.window.laid, False, pushed)))


def test_hopping_attacks_have_a_bound_where_every_step_can_be_corrected():
    """A scalar seen by five sensors: one lie a step is outvoted; three are not."""
    plant = linear_plant(A=[[0.9]], C=np.ones((5, 1)), Q=[[0.01]], R=np.eye(5))
    estimator = l1_decoder.build(plant, np.zeros(1), np.eye(1), window=3)
    assert estimator.window.laid is not None
    model = model_at(plant, np.zeros(1))
    one, three = (
        of_decoder(model, estimator.window.laid, False, sensors(np.ones(5), at_once=k))
        for k in (1, 3)
    )
    assert np.isfinite(one[0])
    assert np.isinf(three[0])
    rng = np.random.default_rng(3)
    lies = np.zeros((30, 5))
    lies[np.arange(30), rng.integers(0, 5, 30)] = 1e4
    error = errors_of(plant, estimator, lies[None])
    assert np.sqrt(np.mean(error**2)) <= one[0]


FIVE = dict(
    A=np.diag([1.0, 1.0, -2.0]),
    C=[[1.0, 0.0, 0.0], [1.0, 1.0, -1.0], [1.0, 2.0, 1.0], [1.0, -1.0, -0.5], [-0.5, 1.0, 1.0]],
    Q=np.eye(3),
    R=np.eye(5),
)


def fused(plant):
    model = model_at(plant, np.zeros(len(plant.states)))
    steady = steady_state(model.A, model.C, model.Q, model.R)
    assert steady.K is not None
    return decompose(model.A, model.C, model.Q, model.R, steady.K)


def test_the_fusion_promises_what_the_paper_says_of_its_sensors():
    """Ratios .4305, 1.6873, 1.1460, .7579, .4379: lies of y1, y4, y5 alone are bounded."""
    local = fused(linear_plant(**FIVE))
    finite = [bool(np.all(np.isfinite(of_fusion(local, 2.0, sensors(row))))) for row in np.eye(5)]
    assert finite == [True, False, False, True, True]


@pytest.mark.slow
@pytest.mark.parametrize("oscillating", [False, True], ids=["real", "complex"])
def test_no_attack_on_a_fusion_exceeds_its_bound(oscillating):
    changes = {}
    if oscillating:
        turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
        changes = dict(A=0.99 * turn, C=np.tile(np.eye(2), (3, 1)), Q=np.eye(2), R=np.eye(6))
    plant = linear_plant(**(FIVE | dict(A=np.diag([1.0, 1.0, 0.8])) | changes))
    n, m = len(plant.states), len(plant.outputs)
    local = fused(plant)
    assert oscillating == bool(np.any(np.bincount(local.coordinates.group) > 1))
    estimator = secure_fusion.build(plant, np.zeros(n), np.eye(n), gamma=3.0)
    bound = of_fusion(local, 3.0, sensors(np.arange(m) == 0))
    assert np.all(np.isfinite(bound))
    attacks = SIZES[:, None, None] * (np.arange(m) == 0)
    error = errors_of(plant, estimator, attacks, steps=60, skip=40)
    assert np.all(np.sqrt(np.mean(error**2, (1, 2))) <= bound)


@pytest.mark.parametrize(
    ("outputs", "inputs", "attacks", "active", "said"),
    [
        ([1, 0], [0], [0, 0], [1, 1], True),
        ([0, 1], [0], [0, 0], [1, 1], False),
        ([0, 0], [1], [0, 0], [1, 1], True),
        ([0, 0], [1], [0, 0], [1, 0], False),
        ([0, 0], [0], [1, 1], [1, 1], True),
        ([0, 0], [0], [0, 1], [1, 0], False),
        ([0, 0], [0], [0, 0], [0, 0], True),
        ([1, 0], [0], [0, 0], [0, 0], False),
    ],
)
def test_what_attack_channels_can_say(outputs, inputs, attacks, active, said):
    """Channels: one adds to the first output, the other to the state as the input does."""
    plant = linear_plant(
        A=[[1.0, 0.1], [0.0, 1.0]], B=[[0.0], [0.1]], C=np.eye(2), G=[[0.0, 0.0], [0.0, 0.1]],
        H=[[1.0, 0.0], [0.0, 0.0]], Q=np.eye(2), R=np.eye(2),
    )  # fmt: skip
    hit = Hit(*(np.array(v, bool) for v in (inputs, outputs, attacks)))
    B, D = np.asarray(plant.B), np.asarray(plant.D)
    assert decoupled(model_at(plant, np.zeros(2)), B, D, hit, np.array(active, bool)) == said
