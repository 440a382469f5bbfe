"""Gains that are held while they repeat themselves: how little it costs, and when it ends."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import banks
import systems
from holdfast.detectors import chi_square
from holdfast.estimators import nisme
from holdfast.loop import Monitor, replay
from holdfast.plants.build import linear_plant
from holdfast.plants.nonlinear import nonlinear_plant, sampled
from holdfast.records import Held, Status

TOLERANCE = 1e-3


def pair():
    return linear_plant(A=[[0.9]], C=[[1], [2]], H=[[1], [0]], Q=[[0.1]], R=np.eye(2))


def build(plant, freeze, **settings):
    n = len(plant.states)
    modes = [[], list(plant.attacks)]
    return nisme.build(plant, np.zeros(n), np.eye(n), modes=modes, freeze=freeze, **settings)


def refreshed(state) -> np.ndarray:
    """At which rows gains were computed: a row that holds them leaves P bit for bit."""
    P = np.asarray(state.kept.value.cov.P)
    flat = P.reshape(len(P), -1)
    return np.concatenate([[True], np.any(flat[1:] != flat[:-1], 1)])


def compare(plant, observations, **settings):
    """Held gains against none held: where they were computed, and how far off the worst estimate
    is in its standard deviations.
    """
    exact = banks.ran(build(plant, 0.0, **settings), observations)[1]
    state, got = banks.ran(build(plant, TOLERANCE, **settings), observations)
    sd = np.sqrt(np.diagonal(exact.x_cov, axis1=1, axis2=2))
    off = np.max(np.abs(got.x - exact.x) / sd)
    return state, got, exact, float(off)


def test_gains_are_held_and_thaw_where_samples_go_and_come_back():
    plant = pair()
    u, y, _ = systems.random_log(0, plant, 100)
    seen = np.ones(y.shape, bool)
    seen[60:63, 1] = False
    state, got, exact, off = compare(plant, banks.log(u, y, seen), attack_prior_sd=5.0)
    computed = refreshed(state)
    settled = np.flatnonzero(~computed)
    assert settled[0] < 20
    assert not np.any(computed[settled[0] : 60])
    # all rows without the sample, and those until the covariance has forgotten them
    assert np.all(computed[60:64])
    again = 60 + np.flatnonzero(~computed[60:])[0]
    assert 64 <= again < 80
    assert not np.any(computed[again:])
    assert off <= TOLERANCE
    np.testing.assert_allclose(got.p, exact.p, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(got.d_cov, exact.d_cov, rtol=TOLERANCE)


@pytest.mark.slow
def test_nothing_is_kept_where_nothing_is_held():
    state, _ = build(pair(), 0.0).init()
    assert not isinstance(state.kept, Held)
    state, _ = build(pair(), TOLERANCE).init()
    assert isinstance(state.kept, Held)
    assert not bool(state.kept.value.settled)


@pytest.mark.slow
def test_authenticated_samples_are_never_met_with_held_gains():
    plant = pair()
    u, y, seen = systems.random_log(1, plant, 80)
    trusted = np.zeros(y.shape, bool)
    trusted[50, 0] = True
    state, _, _, off = compare(plant, banks.log(u, y, seen, trusted))
    assert refreshed(state)[50:52].all()
    assert off <= TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, 11])
@pytest.mark.parametrize(
    "tolerance",
    [
        pytest.param(1e-1, marks=pytest.mark.whole),
        1e-3,
        pytest.param(1e-6, marks=pytest.mark.whole),
    ],
)
def test_what_holding_costs_is_within_what_is_asked(n, tolerance):
    """Estimates and probabilities, small plants and large, to the tolerance asked for."""
    plant = banks.plant_of(1, n, 5)
    u, y, seen = systems.random_log(2, plant, 120)
    given = dict(modes=banks.MODES)
    x0, P0 = np.ones(n), np.eye(n)
    exact = banks.ran(nisme.build(plant, x0, P0, **given), banks.log(u, y, seen))
    held = banks.ran(nisme.build(plant, x0, P0, freeze=tolerance, **given), banks.log(u, y, seen))
    assert not np.all(refreshed(held[0]))
    n_rows = np.diagonal(exact[1].x_cov, axis1=1, axis2=2)
    for number in range(len(banks.MODES)):
        s, j = (int(i) for i in nisme.build(plant, x0, P0, **given).places[number])
        apart = np.abs(held[0].means.x[:, s, j] - exact[0].means.x[:, s, j])
        assert np.all(apart <= tolerance * np.sqrt(np.max(n_rows, 1, keepdims=True)))
    np.testing.assert_allclose(held[1].p, exact[1].p, rtol=0, atol=10 * tolerance)


def swinging(length: float = 1.0):
    def f(x, u, d):
        return jnp.stack([x[1], -9.81 / length * jnp.sin(x[0]) - 0.2 * x[1] + u[0]])

    return nonlinear_plant(
        sampled(f, 0.05), lambda x, u, d: jnp.stack([x[0] + d[0], x[1], x[0] + x[1]]),
        Q=np.diag([1e-5, 1e-3]), R=np.diag([1e-2, 4e-2, 2e-2]), dt=0.05, inputs=["torque"],
        states=["angle", "rate"], outputs=["a", "b", "c"], attacks=["spoof"],
    )  # fmt: skip


@pytest.mark.slow
def test_gains_thaw_where_the_linearised_plant_moves():
    """A pendulum at rest, pushed over, at rest again: gains are held at rest, computed while it
    swings, and estimates stay within the tolerance of those with none held.
    """
    plant = swinging()
    u = np.zeros((400, 1))
    u[100:160] = 15.0

    @jax.jit
    def drive(u, key):
        def row(x, inputs):
            u, key = inputs
            one, two = jax.random.split(key)
            x = plant.advance(one, 1, x, u, jnp.zeros(1))
            return x, plant.measure(two, 1, x, u, jnp.zeros(1))

        return jax.lax.scan(row, jnp.zeros(2), (u, jax.random.split(key, len(u))))[1]

    y = np.asarray(drive(jnp.asarray(u), jax.random.key(0)))
    state, got, exact, off = compare(plant, banks.log(u, y))
    computed = refreshed(state)
    assert np.mean(computed[100:250]) > 0.95
    assert off <= 2 * TOLERANCE  # the tolerance is of a row; rows before it add what they missed
    np.testing.assert_allclose(got.p, exact.p, rtol=0, atol=0.01)
    loose = banks.ran(build(plant, 0.3), banks.log(u, y))[0]
    assert np.mean(refreshed(loose)[50:100]) < 0.5


def rooted():
    """x moves by the square root of 50 and the input: no number where that is negative, nor then
    a slope of what is measured.
    """
    return nonlinear_plant(
        lambda x, u, d: 0.9 * x + jnp.sqrt(u + 50),
        lambda x, u, d: jnp.stack([x[0] + d[0], x[0] + 0.01 * x[0] ** 2]),
        Q=[[0.1]], R=np.eye(2), dt=1.0, states=["x"], inputs=["u"], outputs=["a", "b"],
        attacks=["spoof"],
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("freeze", [0.0, TOLERANCE])
def test_a_row_without_numbers_is_told_and_gone_afterwards(freeze):
    """DIVERGED in that row alone; then as if it had not been."""
    plant = rooted()
    rng = np.random.default_rng(0)
    u, y = np.full((60, 1), -49.0), np.array([10.0, 11.0]) + rng.normal(size=(60, 2))
    monitor = Monitor(build(plant, freeze), chi_square.build(plant, on="residual"))
    truth = replay(monitor, banks.log(u, y)).estimate
    u[30] = -60.0
    got = replay(monitor, banks.log(u, y)).estimate
    told = np.flatnonzero(np.asarray(got.status) & int(Status.DIVERGED))
    np.testing.assert_array_equal(told, [30])
    for part in (got.x, got.d, got.p, got.residual):
        assert np.all(np.isfinite(part))
    # the filter forgets with 0.6 a row: 30 rows are 1e-7 of what the lost one made
    np.testing.assert_allclose(got.x[-1], truth.x[-1], rtol=0, atol=1e-5)
    np.testing.assert_allclose(got.p.sum(1)[31:], 1.0, rtol=0, atol=1e-12)
    wide = np.diagonal(got.x_cov, axis1=1, axis2=2)
    assert np.all(np.isfinite(np.delete(wide, 30, 0)))


@pytest.mark.slow
@pytest.mark.parametrize("freeze", [0.0, TOLERANCE])
def test_a_sample_out_of_all_range_does_not_poison_a_bank(freeze):
    """y = 1e200, whose square is no number: told, and forgotten as fast as the filters forget."""
    plant = pair()
    u, y, _ = systems.random_log(3, plant, 1500)
    monitor = Monitor(build(plant, freeze), chi_square.build(plant, on="residual"))
    truth = replay(monitor, banks.log(u, y)).estimate
    lost = y.copy()
    lost[40] = 1e200
    got = replay(monitor, banks.log(u, lost)).estimate
    assert int(got.status[40]) & int(Status.DIVERGED)
    assert np.all(np.isfinite(got.x))
    assert np.all(np.isfinite(got.p))
    np.testing.assert_allclose(got.x[-1], truth.x[-1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.p[-1], truth.p[-1], rtol=0, atol=1e-9)
    assert got.status[-1] == 0
