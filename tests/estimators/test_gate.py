"""The gate of `extended`, and angles as outputs of `extended` and `unscented`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import systems
from holdfast.estimators import extended, kalman, unscented
from holdfast.estimators.unscented import regress
from holdfast.parts import InvalidValue
from holdfast.plants.library import unicycle
from holdfast.records import Observation
from systems import estimates

FIELDS = ("x", "x_cov", "residual", "residual_cov", "status")


def system_and_log(count=30):
    system = systems.random_system(3, 4, 3, 0, 0)
    return system, systems.random_log(3, system.plant, count, 0.2)


def test_without_a_gate_nothing_changes():
    """Bit for bit what a gate gives that is too wide for anything, and what `Kalman` gives."""
    system, (u, y, seen) = system_and_log()
    start = system.plant, system.x0, system.P0
    free = estimates(extended.build(*start), u, y, seen)
    wide = estimates(extended.build(*start, gate=1e-300), u, y, seen)
    assert free.a is None
    np.testing.assert_array_equal(wide.a, 0.0)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(wide, name), getattr(free, name))
    np.testing.assert_allclose(free.x, estimates(kalman.build(*start), u, y, seen).x, atol=1e-11)


def test_a_sample_too_far_off_corrects_nothing_and_is_reported():
    system, (u, y, seen) = system_and_log()
    start = system.plant, np.zeros(4), system.P0
    # from rest, without input, all is 0 as expected: only what is put in here is off
    u, y, seen = np.zeros_like(u), np.zeros_like(y), np.array(seen)
    k, i = 12, 1
    seen[k] = True
    without, trusted = seen.copy(), np.zeros(seen.shape, bool)
    without[k, i], trusted[k, i] = False, True
    y[k, i] = 1000.0
    gated = extended.build(*start, gate=1e-9)
    found = estimates(gated, u, y, seen)
    wanted = estimates(extended.build(*start), u, y, without)
    np.testing.assert_array_equal(wanted.x, 0.0)
    np.testing.assert_array_equal(found.x, 0.0)
    np.testing.assert_allclose(found.x_cov, wanted.x_cov, rtol=0, atol=1e-12)
    off = np.zeros(y.shape)
    off[k, i] = 1000.0
    np.testing.assert_array_equal(found.a, off)
    np.testing.assert_array_equal(found.residual, off)
    assert found.residual_cov[k, i, i] > 0
    # what is authenticated is believed
    believed = estimates(gated, u, y, seen, trusted)
    np.testing.assert_array_equal(believed.a[k], 0.0)
    free = estimates(extended.build(*start), u, y, seen)
    np.testing.assert_allclose(believed.x[k], free.x[k], rtol=1e-12)
    assert np.linalg.norm(free.x[k]) > 1


def test_the_gate_leaves_out_the_share_it_is_asked_for():
    """Of 15 000 samples of a linear plant's own noise; a gate of 0.01 hardly feeds back."""
    system, _ = system_and_log()
    filter_ = extended.build(system.plant, system.x0, system.P0, gate=0.01)
    nothing = jnp.zeros(3, bool), jnp.zeros(len(system.plant.inputs)), jnp.zeros(0)

    def row(carry, keys):
        x, state = carry
        k, u, d = state.k + 1, nothing[1], nothing[2]
        x = system.plant.advance(keys[0], k, x, u, d)
        y = system.plant.measure(keys[1], k, x, u, d)
        sample = Observation(u, y, ~nothing[0], nothing[0], jnp.asarray(0, jnp.int32))
        state, estimate = filter_.step(state, sample)
        return (x, state), estimate.a != 0

    keys = jax.random.split(jax.random.key(0), (5000, 2))
    start = (jnp.asarray(system.x0), filter_.init()[0])
    out = eqx.filter_jit(lambda keys: jax.lax.scan(row, start, keys)[1])(keys)
    # 15 000 trials: 0.01 with a standard deviation of 8e-4; what leaving out costs is second order
    assert abs(np.mean(np.asarray(out)) - 0.01) < 4 * 8e-4


@pytest.mark.parametrize("gate", [0.0, 1.0, -0.1, np.nan])
def test_a_gate_is_a_probability(gate):
    system, _ = system_and_log(1)
    with pytest.raises(InvalidValue, match="gate"):
        extended.build(system.plant, system.x0, system.P0, gate=gate)


def test_regression_on_an_angle_is_that_on_the_unwrapped_angle():
    m, F = jnp.array([np.pi - 0.05, 0.3]), jnp.array([[0.2, 0.0], [0.1, 0.3]])

    def angle(x):
        return jnp.stack([x[0] + 0.1 * x[1] ** 2])

    def wrap(z):
        return z - 2 * jnp.pi * jnp.round(z / (2 * jnp.pi))

    found = regress(lambda x: wrap(angle(x)), m, F, lambda a, b: wrap(a - b))
    wanted = regress(angle, m, F)
    np.testing.assert_allclose(wrap(found[0] - wanted[0]), 0.0, atol=1e-14)
    for i in (1, 2):
        np.testing.assert_allclose(found[i], wanted[i], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("build", [extended.build, unscented.build])
def test_bearings_that_cross_half_a_turn_do_no_harm(build):
    """A robot that turns slowly has a landmark straight behind it: sigma points on both sides."""
    plant = unicycle.build(landmarks=[[4.0, 1.0], [1.0, 5.0], [-3.0, 2.0]], dt=0.1)
    u = np.tile([0.05, 0.05], (150, 1))
    none, rng = jnp.zeros(5), np.random.default_rng(0)
    start = np.array([0.1, 0.2, np.arctan2(1.8, -3.1) - np.pi - 0.4])
    x, truth = jnp.asarray(start), []
    move = jax.jit(lambda x, u: plant.transition(1, x, u, none))
    see = jax.jit(lambda x, u: plant.output(1, x, u, none))
    for row in u:
        x = move(x, row)
        truth.append(np.asarray(x))
    y = np.stack([see(x, row) for x, row in zip(truth, u, strict=True)])
    sd = np.array([0.1] * 3 + [0.02] * 3)
    y = y + sd * rng.normal(size=y.shape)
    y[:, 3:] = np.angle(np.exp(1j * y[:, 3:]))
    assert np.any(np.abs(np.diff(y[:, 3:], axis=0)) > 6)
    filter_ = build(plant, start, 0.01 * np.eye(3))
    found = estimates(filter_, u, y, np.ones_like(y, bool))
    error = np.asarray(found.x) - np.array(truth)
    # every row has six samples: the error stays far below a landmark's distance
    assert np.max(np.abs(error)) < 0.1
    variance = np.diagonal(found.residual_cov, axis1=1, axis2=2)
    assert np.max(np.abs(np.asarray(found.residual)) / np.sqrt(variance)) < 5
    # the prior's heading and position, and the sensor: 0.01 + 0.01 / 3.6^2 + 0.0004
    assert np.max(variance[:, 3:]) < 0.013
