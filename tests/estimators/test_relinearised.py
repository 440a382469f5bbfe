"""`unknown_input` and `care` on nonlinear plants: relinearised until they settle."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import systems
from holdfast.estimators import care, unknown_input
from holdfast.plants.nonlinear import nonlinear_plant
from holdfast.records import Status
from systems import estimates


@pytest.mark.parametrize("shape", [(4, 4, 2, 0), (4, 4, 2, 1)])
def test_a_linear_plant_written_as_functions(shape):
    """The same numbers as from matrices; 1e-12, the tangent's offset is a difference."""
    system = systems.random_system(3, *shape)
    A, B, C, D, G, H, Q, R = map(jnp.asarray, systems.matrices(system.plant))
    plant = nonlinear_plant(
        lambda x, u, d: A @ x + B @ u + G @ d,
        lambda x, u, d: C @ x + D @ u + H @ d,
        Q=Q, R=R, dt=1.0, states=system.plant.states, outputs=system.plant.outputs,
        inputs=system.plant.inputs, attacks=system.plant.attacks,
    )  # fmt: skip
    u, y, seen = systems.random_log(3, plant, 20, 0.1)
    ours = estimates(unknown_input.build(plant, system.x0, system.P0), u, y, seen)
    truth = estimates(unknown_input.build(system.plant, system.x0, system.P0), u, y, seen)
    np.testing.assert_array_equal(ours.status, truth.status)
    known = np.isfinite(np.diagonal(truth.x_cov, axis1=1, axis2=2))
    np.testing.assert_allclose(ours.x[known], truth.x[known], atol=1e-11)
    np.testing.assert_allclose(ours.d, truth.d, atol=1e-11)
    np.testing.assert_allclose(ours.d_cov, truth.d_cov, atol=1e-11)


def bent(limit: float | None = None):
    """Bent in the attack and in what is measured, straight in the state before it."""

    def f(x, u, d):
        return jnp.stack([x[0] + 0.5 * x[1] + d[0] + 0.2 * d[0] ** 3, 0.8 * x[1] + u[0]])

    def h(x, u, d):
        return jnp.stack([x[0] + 0.1 * jnp.sin(x[1]), x[1] + 0.05 * x[0] ** 2, x[0] - x[1]])

    sides = {"matrix": [[1], [-1]], "bound": [limit, limit]} if limit else None
    return nonlinear_plant(
        f, h, Q=np.diag([0.02, 0.01]), R=np.diag([0.01, 0.02, 0.03]), dt=1.0,
        states=["a", "b"], inputs=["u"], outputs=["p", "q", "r"], attacks=["push"],
        constraints={"attack": sides} if sides else None,
    )  # fmt: skip


@pytest.mark.parametrize("push", [0.0, 0.7, -1.5])
def test_one_row_is_the_nonlinear_least_squares_estimate(push):
    """min over (x_0, d_0, x_1) of all squared errors in their deviations, by scipy.

    f is straight in x_0, so that linearising about the row's own d and x_1 loses nothing; the
    iteration stops at 1e-3 of a deviation, Gauss-Newton's next error being far smaller.
    """
    plant = bent()
    x0, P0 = np.array([0.2, -0.3]), np.diag([0.3, 0.2])
    rng = np.random.default_rng(1)
    truth = np.asarray(plant.f(x0, np.array([0.1]), np.array([push])))
    y = np.asarray(plant.h(truth, None, None)) + 0.1 * rng.normal(size=3)
    given = np.array([[0.1]]), y[None], np.ones((1, 3), bool)
    got = estimates(unknown_input.build(plant, x0, P0), *given)

    def errors(z):
        before, d, x = z[:2], z[2:3], z[3:]
        return np.concatenate(
            [
                (before - x0) / np.sqrt(np.diag(P0)),
                (x - np.asarray(plant.f(before, np.array([0.1]), d))) / np.sqrt([0.02, 0.01]),
                (y - np.asarray(plant.h(x, None, None))) / np.sqrt([0.01, 0.02, 0.03]),
            ]
        )

    start = np.concatenate([x0, [push], truth])
    found = least_squares(errors, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    sd = np.sqrt(got.d_cov[0, 0, 0])
    assert abs(got.d[0, 0] - found.x[2]) < 2e-3 * sd
    np.testing.assert_allclose(got.x[0], found.x[3:], atol=2e-3 * 0.1)
    cov = np.linalg.inv(found.jac.T @ found.jac)
    np.testing.assert_allclose(got.d_cov[0, 0, 0], cov[2, 2], rtol=1e-2)
    assert got.status[0] == 0


def test_care_holds_a_nonlinear_plant_to_its_limits():
    plant = bent(0.5)
    rng = np.random.default_rng(2)
    x, y = np.array([0.2, -0.3]), []
    for k in range(25):
        x = np.asarray(plant.f(x, np.zeros(1), np.array([0.45 if k > 10 else 0.0])))
        x = x + 0.1 * rng.normal(size=2)
        y.append(np.asarray(plant.h(x, None, None)) + 0.12 * rng.normal(size=3))
    given = np.zeros((25, 1)), np.array(y), np.ones((25, 3), bool)
    got = estimates(care.build(plant, [0.2, -0.3], 0.1 * np.eye(2)), *given)
    assert np.all(np.abs(got.d) <= 0.5 + 1e-12)
    assert np.any(np.abs(got.d_free) > 0.5)
    assert {Status(int(s)).words for s in got.status} == {"OK"}
