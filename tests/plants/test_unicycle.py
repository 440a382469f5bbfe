"""The unicycle: its motion beside mpmath's, what it sees beside plain geometry, and its noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from holdfast.parts import InvalidValue
from holdfast.plants.library.unicycle import build

PLACES = [[4.0, 1.0], [1.0, 5.0], [-3.0, 2.0]]
POSE = np.array([0.3, -0.2, 2.9])

transition = eqx.filter_jit(lambda plant, x, u, d: plant.transition(1, x, u, d))
output = eqx.filter_jit(lambda plant, x, d: plant.output(1, x, jnp.zeros(2), d))


def moved(plant, x, u, d=None):
    d = np.zeros(len(plant.attacks)) if d is None else d
    return transition(plant, *map(jnp.asarray, (x, u, d)))


def shown(plant, x, d=None):
    d = np.zeros(len(plant.attacks)) if d is None else d
    return output(plant, jnp.asarray(x), jnp.asarray(d))


def exact(x, v, omega, dt):
    """The pose, and its derivative by omega, in 40 digits: integrals over the arc."""
    with mpmath.workdps(40):
        x = [mpmath.mpf(float(value)) for value in x]
        v, omega, dt = (mpmath.mpf(float(value)) for value in (v, omega, dt))

        def heading(t):
            return x[2] + omega * t

        def integral(f):
            return mpmath.quad(f, mpmath.linspace(0, dt, 9))

        pose = [
            x[0] + v * integral(lambda t: mpmath.cos(heading(t))),
            x[1] + v * integral(lambda t: mpmath.sin(heading(t))),
            x[2] + omega * dt,
        ]
        by_omega = [
            -v * integral(lambda t: t * mpmath.sin(heading(t))),
            v * integral(lambda t: t * mpmath.cos(heading(t))),
            dt,
        ]
        return np.array(pose, float), np.array(by_omega, float)


def test_the_motion_is_exact_and_so_is_its_derivative():
    # dt = 2, so that omega is the half angle: both sides of where the series ends, and next to 0
    plant = build(landmarks=PLACES, dt=2.0)
    both = jax.jit(
        lambda u: (moved(plant, POSE, u), jax.jacfwd(lambda u: moved(plant, POSE, u))(u))
    )
    for omega in (0.0, 1e-300, 1e-15, -1e-9, 1e-4, 0.0499999, 0.05, -0.051, 0.8, -3.0):
        pose, slope = both(np.array([0.7, omega]))
        expected, by_omega = exact(POSE, 0.7, omega, 2.0)
        # rounding of numbers up to 5; near 0.05 the derivative of sin(z) / z loses 1 / 0.05
        np.testing.assert_allclose(pose, expected, rtol=0, atol=4e-15)
        np.testing.assert_allclose(slope[:, 1], by_omega, rtol=0, atol=2e-14)


def test_what_it_sees_is_plain_geometry():
    plant = build(landmarks=PLACES, names=["a", "b", "c"], range_scale=1.05)
    depth = build(landmarks=PLACES, measures="depth", range_scale=1.05)
    assert plant.outputs == tuple(f"{k}:{n}" for k in ("range", "bearing") for n in "abc")
    way = np.array(PLACES) - POSE[:2]
    far = np.linalg.norm(way, axis=1)
    bearing = np.angle(np.exp(1j * (np.arctan2(way[:, 1], way[:, 0]) - POSE[2])))
    np.testing.assert_allclose(shown(plant, POSE), np.r_[1.05 * far, bearing], rtol=1e-14)
    expected = np.r_[1.05 * far * np.cos(bearing), bearing]
    np.testing.assert_allclose(shown(depth, POSE), expected, rtol=1e-13)


def test_bearings_differ_the_shorter_way_round():
    plant = build(landmarks=PLACES)
    y = jnp.array([7.0, 8.0, 9.0, np.pi - 0.01, 0.5, -3.0])
    expected = jnp.array([1.0, 12.0, 9.0, 0.02 - np.pi, 0.2, 3.0 + 4 * np.pi])
    found = plant.innovation(y, expected)
    wanted = [6.0, -4.0, 0.0, -0.03, 0.3, 2 * np.pi - 6.0]
    np.testing.assert_allclose(found, wanted, atol=1e-14)


def test_an_odometry_that_tells_too_much_is_an_attack_of_the_other_sign():
    plant = build(landmarks=PLACES, attacked=["odometry"], speed_scale=0.9, turn_scale=0.8)
    assert plant.attacks == ("v", "omega")
    true, told = np.array([0.3, 0.4]), np.array([0.5, 0.1])
    d = -np.array([0.9, 0.8]) * (told - true)
    found, wanted = moved(plant, POSE, told, d), moved(plant, POSE, true)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(shown(plant, POSE, d), shown(plant, POSE))
    np.testing.assert_allclose(wanted[2], POSE[2] + 0.1 * 0.8 * 0.4, rtol=1e-15)


def test_a_channel_falsifies_the_output_of_its_name():
    plant = build(landmarks=PLACES, attacked=["bearing", "range"])
    assert plant.attacks == (*plant.outputs[3:], *plant.outputs[:3])
    for i, name in enumerate(plant.attacks):
        d = np.eye(6)[i]
        off = np.asarray(shown(plant, POSE, d) - shown(plant, POSE))
        np.testing.assert_allclose(off, [o == name for o in plant.outputs], atol=1e-14)
        np.testing.assert_array_equal(
            moved(plant, POSE, [0.1, 0.2], d), moved(plant, POSE, [0.1, 0.2])
        )


@pytest.mark.parametrize("dt", [0.5, 0.05])
def test_how_far_a_drive_spreads_does_not_depend_on_dt(dt):
    plant = build(
        landmarks=PLACES, dt=dt, speed_noise=0.02, turn_noise=0.03,
        position_floor=0.0, heading_floor=0.0,
    )  # fmt: skip
    u, none = jnp.array([0.4, 0.0]), jnp.zeros(5)

    def row(carry, _):
        x, P = carry
        A = jax.jacfwd(lambda x: plant.transition(1, x, u, none))(x)
        P = A @ P @ A.T + plant.noise(1, x, u)[0]
        return (plant.transition(1, x, u, none), P), None

    start = jnp.array([1.0, 2.0, 0.0]), jnp.zeros((3, 3))
    (_, P), _ = jax.lax.scan(row, start, None, round(10.0 / dt))
    # along x for T: q_v^2 T, q_w^2 T, and a random walk of the heading integrated: v^2 q_w^2 T^3/3
    wanted = [0.02**2 * 10, 0.4**2 * 0.03**2 * 10**3 / 3, 0.03**2 * 10]
    np.testing.assert_allclose(np.diagonal(P), wanted, rtol=1e-2)
    np.testing.assert_allclose(np.diagonal(P)[[0, 2]], np.array(wanted)[[0, 2]], rtol=1e-12)


def test_noise_of_a_row_and_of_a_sample():
    plant = build(
        landmarks=PLACES, range_sd=0.2, range_share=0.1, bearing_sd=0.05,
        speed_noise=0.0, turn_noise=0.0, position_floor=0.01, heading_floor=0.002,
    )  # fmt: skip
    noise = eqx.filter_jit(lambda plant, x, u: plant.noise(1, x, u))
    Q, R = noise(plant, jnp.asarray(POSE), jnp.array([0.5, 0.5]))
    np.testing.assert_allclose(Q, np.diag([1e-4, 1e-4, 4e-6]), atol=1e-18)
    far = np.linalg.norm(np.array(PLACES) - POSE[:2], axis=1)
    np.testing.assert_allclose(R, np.diag(np.r_[0.04 + 0.01 * far**2, [0.0025] * 3]), rtol=1e-14)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"landmarks": []}, "landmarks"),
        ({"landmarks": [[1.0, 2.0, 3.0]]}, "landmarks"),
        ({"landmarks": [[1.0, np.nan]]}, "landmarks"),
        ({"names": ["a", "b"]}, "names"),
        ({"names": ["a", "b", "a"]}, "names"),
        ({"dt": 0.0}, "dt"),
        ({"range_scale": -1.0}, "range_scale"),
        ({"bearing_sd": np.inf}, "bearing_sd"),
        ({"turn_noise": -0.1}, "turn_noise"),
        ({"attacked": ["range", "range"]}, "attacked"),
    ],
)
def test_what_cannot_be_is_refused(keys, words):
    with pytest.raises(InvalidValue, match=words):
        build(**({"landmarks": PLACES} | keys))
