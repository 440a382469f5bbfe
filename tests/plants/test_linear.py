"""Linear plants: sampling against integrals, per-step and scheduled matrices, refusals."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.linear import Table

A = np.array([[0.0, 1.0], [-2.0, -0.3]])
B, G = np.array([[0.0], [1.0]]), np.array([[1.0], [0.5]])
C, R = np.array([[1.0, 0.0]]), np.array([[0.1]])
Q = np.array([[0.2, 0.05], [0.05, 0.4]])
DT = 0.3
I2 = np.eye(2)


def integral(function):
    return quad_vec(function, 0.0, DT, epsabs=1e-13)[0]


def at(plant, k=1, x=(0.0, 0.0), u=(0.0,)):
    return plant.at(k, jnp.asarray(x), jnp.asarray(u))


@pytest.mark.parametrize("noise", ["held", "white"])
def test_zero_order_hold_is_the_integral(noise):
    plant = linear_plant(A=A, B=B, C=C, G=G, Q=Q, R=R, dt=DT, time="continuous", noise=noise)
    m = at(plant)
    held = integral(lambda s: expm(A * s))
    np.testing.assert_allclose(m.A, expm(A * DT), atol=1e-13)
    np.testing.assert_allclose(m.B, held @ B, atol=1e-13)
    np.testing.assert_allclose(m.G, held @ G, atol=1e-13)
    white = integral(lambda s: expm(A * s) @ Q @ expm(A * s).T)
    np.testing.assert_allclose(m.Q, held @ Q @ held.T if noise == "held" else white, atol=1e-12)
    np.testing.assert_array_equal(m.R, R)


@pytest.mark.parametrize(("noise", "factor"), [("held", DT * DT), ("white", DT)])
def test_euler(noise, factor):
    plant = linear_plant(
        A=A, B=B, C=C, Q=Q, R=R, dt=DT, time="continuous", method="euler", noise=noise
    )
    m = at(plant)
    np.testing.assert_allclose(m.A, np.eye(2) + DT * A, atol=1e-15)
    np.testing.assert_allclose(m.B, DT * B, atol=1e-15)
    np.testing.assert_allclose(m.Q, factor * Q, atol=1e-15)


def test_per_step_matrices_start_with_row_1():
    steps = np.stack([np.eye(2), 2 * np.eye(2), 3 * np.eye(2)])
    plant = linear_plant(A=steps, B=B, C=C, Q=Q, R=R)
    assert plant.steps == 3
    for k in (1, 2, 3):
        np.testing.assert_array_equal(at(plant, k).A, k * np.eye(2))


def test_scheduled_matrices_interpolate_and_hold_beyond_the_grid():
    table = Table(jnp.asarray([0.0, 2.0, 10.0]), jnp.asarray(np.stack([I2, 3 * I2, 5 * I2])))
    plant = linear_plant(A=table, B=B, C=C, Q=Q, R=R, states=["speed", "other"], scheduling="speed")
    for speed, factor in [(-5.0, 1.0), (0.0, 1.0), (1.0, 2.0), (2.0, 3.0), (6.0, 4.0), (99, 5.0)]:
        np.testing.assert_allclose(at(plant, x=(float(speed), 7.0)).A, factor * I2, atol=1e-14)


def test_scheduled_continuous_plant_is_sampled_at_every_value():
    table = Table(jnp.asarray([0.0, 1.0]), jnp.asarray(np.stack([A, 2 * A])))
    plant = linear_plant(
        A=table, B=B, C=C, Q=Q, R=R, dt=DT, time="continuous", scheduling="u1", noise="white"
    )
    m = at(plant, u=(0.5,))
    np.testing.assert_allclose(m.A, expm(1.5 * A * DT), atol=1e-13)
    white = integral(lambda s: expm(1.5 * A * s) @ Q @ expm(1.5 * A * s).T)
    np.testing.assert_allclose(m.Q, white, atol=1e-12)


def test_a_discrete_plant_that_looks_continuous_is_told():
    with pytest.warns(UserWarning, match='time = "continuous"'):
        linear_plant(A=A, C=C, Q=Q, R=R)


GOOD = {"A": 0.9 * np.eye(2), "B": B, "C": C, "Q": Q, "R": R}


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("A", [[1.0, 0.0]], "2 x 2|1 x 1"),
        ("B", np.zeros((3, 1)), "2 x 1"),
        ("Q", [[1.0, 0.5], [0.4, 1.0]], "covariance"),
        ("Q", [[1.0, 2.0], [2.0, 1.0]], "no negative eigenvalue"),
        ("R", [[0.0]], "positive definite"),
        ("R", [[-1.0]], "positive definite"),
        ("A", [[np.nan, 0.0], [0.0, 1.0]], "finite"),
        ("A", [["a", 0.0], [0.0, 1.0]], "numbers"),
        ("states", ["x", "x"], "differ"),
        ("states", ["x"], "2 names"),
        ("dt", -1.0, "positive"),
        ("time", "discret", "'discrete' or 'continuous'"),
        ("scheduling", "wind", "an input or a state"),
    ],
)
def test_bad_values_name_key_and_expectation(key, value, expected):
    with pytest.raises(InvalidValue, match=expected) as caught:
        linear_plant(**{**GOOD, key: value})
    assert key in str(caught.value)


def test_rounding_in_a_covariance_is_mended():
    skew = Q + np.array([[0.0, 1e-12], [0.0, 0.0]])
    m = at(linear_plant(**{**GOOD, "Q": skew}))
    np.testing.assert_array_equal(m.Q, np.asarray(m.Q).T)
