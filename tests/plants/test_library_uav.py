import math

import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.parts import InvalidValue
from holdfast.plants.library.uav import build

# Written by hand from the docstring's formulas: dt = 0.5, q = 2 and 3, w = 0.5 and 0.25, ...
SETTINGS = dict(
    dt=0.5,
    acceleration_noise=2.0,
    down_acceleration_noise=3.0,
    position_walk=0.5,
    down_position_walk=0.25,
    gps_position_sd=1.5,
    gps_speed_sd=0.5,
    gps_correlation=0.4,
    gps_down_sd=2.0,
    gps_down_speed_sd=0.25,
    gps_down_correlation=-0.2,
    baro_sd=0.75,
    baro_walk=0.3,
)


@pytest.fixture(scope="module")
def plant():
    return build(**SETTINGS)


def test_dynamics_and_noise_are_the_closed_form(plant):
    A = np.eye(7)
    A[[0, 1, 2], [3, 4, 5]] = 0.5
    Q = np.zeros((7, 7))
    for i, (q, w) in enumerate([(2.0, 0.5), (2.0, 0.5), (3.0, 0.25)]):
        Q[np.ix_([i, i + 3], [i, i + 3])] = q**2 * np.array([[1 / 24, 1 / 8], [1 / 8, 1 / 2]])
        Q[i, i] += w**2 / 2
    Q[6, 6] = 0.09 / 2
    np.testing.assert_allclose(plant.A, A, atol=1e-14)
    np.testing.assert_allclose(plant.Q, Q, rtol=1e-12, atol=1e-14)


def test_outputs_and_their_noise(plant):
    x = jnp.arange(1.0, 8.0)
    y = plant.output(1, x, jnp.zeros(0), jnp.zeros(6))
    np.testing.assert_allclose(y, [1, 2, 3, 4, 5, 6, -3 + 7], rtol=1e-14)
    R = np.diag([1.5, 1.5, 2.0, 0.5, 0.5, 0.25, 0.75]) ** 2
    R[0, 3] = R[3, 0] = R[1, 4] = R[4, 1] = 0.4 * 1.5 * 0.5
    R[2, 5] = R[5, 2] = -0.2 * 2.0 * 0.25
    np.testing.assert_allclose(plant.R, R, rtol=1e-14)


def test_each_attack_adds_to_the_gps_output_of_its_name(plant):
    for i, name in enumerate(plant.attacks):
        d = 2.0 * jnp.eye(6)[i]
        change = plant.output(1, jnp.zeros(7), jnp.zeros(0), d)
        assert np.flatnonzero(change).tolist() == [plant.outputs.index(name.removesuffix("_spoof"))]
        assert change[i] == 2.0
    np.testing.assert_array_equal(plant.G, np.zeros((7, 6)))


def test_names(plant):
    assert plant.states == (
        "north", "east", "down", "north_speed", "east_speed", "down_speed", "baro_bias",
    )  # fmt: skip
    assert plant.outputs == (
        "gps_north", "gps_east", "gps_down",
        "gps_north_speed", "gps_east_speed", "gps_down_speed", "baro",
    )  # fmt: skip
    assert plant.dt == 0.5


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("acceleration_noise", -0.1),
        ("baro_walk", math.nan),
        ("gps_down_sd", 0.0),
        ("baro_sd", math.inf),
        ("gps_correlation", 1.0),
        ("gps_down_correlation", math.nan),
        ("dt", 0.0),
    ],
)
def test_a_setting_without_meaning_is_refused_by_its_name(key, value):
    with pytest.raises(InvalidValue, match=key):
        build(**{key: value})
