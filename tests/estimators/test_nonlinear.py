"""`extended` and `unscented`: Kalman on linear plants, a hand-written filter on a pendulum."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import systems
from holdfast.estimators import extended, kalman, unscented
from holdfast.estimators.unscented import regress
from holdfast.parts import InvalidValue
from holdfast.plants.nonlinear import nonlinear_plant, sampled
from holdfast.records import Observation
from systems import estimates

DT = 0.05


def pendulum(substeps=1):
    def rate(x, u, d):
        return jnp.array([x[1], -9.81 * jnp.sin(x[0]) - 0.2 * x[1] + u[0] + d[0]])

    return nonlinear_plant(
        sampled(rate, DT, substeps),
        lambda x, u, d: jnp.array([jnp.sin(x[0]), -jnp.cos(x[0])]),
        Q=np.diag([1e-6, 1e-3]),
        R=np.array([[0.01, 0.004], [0.004, 0.02]]),
        dt=DT,
        states=("angle", "speed"),
        inputs=("torque",),
        outputs=("across", "up"),
        attacks=("push",),
    )


@pytest.mark.parametrize("build", [extended.build, unscented.build])
def test_on_a_linear_plant_it_is_kalman(build):
    system = systems.random_system(3, 4, 3, 0, 0)
    u, y, seen = systems.random_log(3, system.plant, 40, 0.3)
    ours = estimates(build(system.plant, system.x0, system.P0), u, y, seen)
    truth = estimates(kalman.build(system.plant, system.x0, system.P0), u, y, seen)
    for name in ("x", "x_cov", "residual", "residual_cov"):
        np.testing.assert_allclose(getattr(ours, name), getattr(truth, name), atol=1e-11)


def numpy_extended(u, y, x, P):
    """The textbook filter with Jacobians by complex steps, in NumPy."""
    Q, R = np.diag([1e-6, 1e-3]), np.array([[0.01, 0.004], [0.004, 0.02]])

    def rate(x, u):
        return np.array([x[1], -9.81 * np.sin(x[0]) - 0.2 * x[1] + u])

    def f(x, u):
        k1 = rate(x, u)
        k2 = rate(x + DT / 2 * k1, u)
        k3 = rate(x + DT / 2 * k2, u)
        k4 = rate(x + DT * k3, u)
        return x + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def jacobian(function, x):
        return np.stack([function(x + 1e-30j * e).imag / 1e-30 for e in np.eye(2)], 1)

    def h(x):
        return np.array([np.sin(x[0]), -np.cos(x[0])])

    for torque, sample in zip(u[:, 0], y, strict=True):
        A = jacobian(lambda x, t=torque: f(x, t), x)
        x, P = f(x, torque), A @ P @ A.T + Q
        C = jacobian(h, x)
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        x, P = x + K @ (sample - h(x)), P - K @ C @ P
    return x, P


def test_extended_is_the_textbook_filter():
    plant = pendulum()
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(60, 1)), rng.normal(scale=0.3, size=(60, 2)) - np.array([0, 1])
    x0, P0 = np.array([0.4, 0.0]), np.diag([0.1, 0.2])
    ours = estimates(extended.build(plant, x0, P0), u, y, np.ones_like(y, bool))
    x, P = numpy_extended(u, y, x0, P0)
    np.testing.assert_allclose(ours.x[-1], x, rtol=1e-10)
    np.testing.assert_allclose(ours.x_cov[-1], P, rtol=1e-9)


def test_regression_has_the_moments_of_a_quadratic():
    """For f = a'x + x'Mx and n <= 3 the mean a'm + m'Mm + tr(MP) is exact, the slope too."""
    rng = np.random.default_rng(1)
    a, M, m = rng.normal(size=3), rng.normal(size=(3, 3)), rng.normal(size=3)
    F = np.tril(rng.normal(size=(3, 3)))
    mean, slope, rest = regress(
        lambda x: jnp.array([a @ x + x @ M @ x]), jnp.asarray(m), jnp.asarray(F)
    )
    expected = a @ m + m @ M @ m + np.trace(M @ F @ F.T)
    np.testing.assert_allclose(mean[0], expected, rtol=1e-12)
    np.testing.assert_allclose(slope[0], (a + (M + M.T) @ m) @ F, rtol=1e-12)
    assert rest[0, 0] > 0


def test_unscented_follows_a_pendulum_better_than_its_prior():
    """Errors within what the filter says of itself: mean NEES of 200 runs near 2."""
    plant = pendulum()
    x0, P0 = jnp.array([0.5, 0.0]), jnp.diag(jnp.array([0.05, 0.1]))
    filter_ = unscented.build(plant, x0, P0)
    steps = 60

    def one(key):
        start, run = jax.random.split(key)
        x = x0 + jnp.linalg.cholesky(P0) @ jax.random.normal(start, (2,))

        def row(carry, inputs):
            x, state = carry
            k, key = inputs
            move, sense = jax.random.split(key)
            nothing = jnp.zeros(1)
            x = plant.advance(move, k, x, nothing, nothing)
            y = plant.measure(sense, k, x, nothing, nothing)
            seen = jnp.ones(2, bool)
            sample = Observation(nothing, y, seen, ~seen, jnp.asarray(0, jnp.int32))
            state, estimate = filter_.step(state, sample)
            error = x - estimate.x
            return (x, state), error @ jnp.linalg.solve(estimate.x_cov, error)

        keys = jax.random.split(run, steps)
        carry = (x, filter_.init()[0])
        return jax.lax.scan(row, carry, (jnp.arange(1, steps + 1, dtype=jnp.int32), keys))[1]

    nees = eqx.filter_jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 200))
    last = np.asarray(nees)[:, -1]
    # 200 chi-square values of 2 degrees of freedom: standard error 2 / sqrt(200) = 0.14
    assert abs(last.mean() - 2.0) < 0.5


def test_runge_kutta_has_fourth_order():
    rate = lambda x, u, d: -x  # noqa: E731
    x = jnp.ones(1)
    errors = [abs(float(sampled(rate, 1.0, n)(x, x, x)[0]) - np.exp(-1.0)) for n in (4, 8)]
    assert 14 < errors[0] / errors[1] < 18


def test_a_function_of_the_wrong_shape_is_told():
    with pytest.raises(InvalidValue, match=r"h: found shape \(3,\), expected shape \(1,\)"):
        nonlinear_plant(
            lambda x, u, d: x,
            lambda x, u, d: jnp.zeros(3),
            Q=np.eye(2),
            R=np.eye(1),
            dt=1.0,
            states=("a", "b"),
            outputs=("c",),
        )
