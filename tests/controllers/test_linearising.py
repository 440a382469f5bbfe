import jax
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.controllers.linearising import build, linearised
from holdfast.parts import InvalidValue
from holdfast.plants.library import swing
from holdfast.records import Estimate

PLANT = swing.network(
    lines=[[1, 2], [2, 3, 0.7], [3, 1, 2.0], [3, 4]], generators=[1, 4], damping=1.2,
    demand=[0.1, 0.2, 0.3, 0.4], attacks=["actuator:2"], switches=[["1-2"]],
)  # fmt: skip


command = jax.jit(lambda controller, x: controller.command(estimate(x)))
rate_of = jax.jit(lambda plant, x, u, d: plant.rate(x, u, d))


def estimate(x):
    return Estimate.without_attack(x, jnp.eye(8), jnp.zeros(12), jnp.eye(12), 0)


def test_every_bus_obeys_the_linear_equation_asked_for():
    """f' = -g1 (theta - theta*) - g2 f, whatever theta and f are."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=8))
    u = command(build(PLANT, gains=[1.5, 3.0]), x)
    rate = rate_of(PLANT, x, u, jnp.zeros(1))
    target = 0.3 * np.sin([1, 2, 3, 4])
    np.testing.assert_allclose(rate[4:], -1.5 * (x[:4] - target) - 3.0 * x[4:], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(rate[:4], x[4:])


def test_an_opened_line_is_not_known_to_it():
    x = jnp.asarray(np.random.default_rng(1).normal(size=8))
    open_line = PLANT.at_position(jnp.asarray(1, jnp.int32))
    commands = [command(build(plant), x) for plant in (PLANT, open_line)]
    np.testing.assert_array_equal(*commands)


def test_studies_feed_it_what_they_measure():
    theta, f = jnp.asarray(np.random.default_rng(2).normal(size=(2, 4)))
    target = swing.operating_point(PLANT)[:4]
    u = jax.jit(linearised)(PLANT, theta, f, target, jnp.asarray([2.0, 2.0]))
    expected = command(build(PLANT), jnp.concatenate([theta, f]))
    np.testing.assert_array_equal(u, expected)


def test_held_over_samples_it_settles_at_the_operating_point():
    """The exact loop is (s + 1)^2 + 1: e^-t. A hold of 0.01 s shifts its poles by under 0.02."""
    target = swing.operating_point(PLANT)
    controller = build(PLANT)

    @jax.jit
    def settled(x):
        def step(_, x):
            return PLANT.transition(1, x, controller.command(estimate(x)), jnp.zeros(1))

        return jax.lax.fori_loop(0, 800, step, x)

    start = target + 0.3 * jnp.cos(jnp.arange(8.0))
    left = np.max(np.abs(settled(start) - target)) / np.max(np.abs(start - target))
    # 8 s: e^-8 = 3.4e-4, times the size of the mode's swing
    assert 1e-5 < left < 1.5e-3


@pytest.mark.parametrize("gains", [[2.0], [2.0, -1.0], [0.0, 2.0], [2.0, float("inf")]])
def test_gains_that_do_not_stabilise_are_refused(gains):
    with pytest.raises(InvalidValue, match="gains: found"):
        build(PLANT, gains=gains)
