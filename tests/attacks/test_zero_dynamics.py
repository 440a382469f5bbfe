"""The attack along a zero, against the response of the plant written down by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import null_space

from holdfast.attacks import zero_dynamics
from holdfast.detectors import chi_square
from holdfast.estimators import kalman
from holdfast.loop import Monitor, Scenario, simulate
from holdfast.numerics import zeros
from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.library import bicycle
from holdfast.records import Knowledge

FIRST, STEPS = 10, 40


def single(poles, numerator):
    """numerator(z) / prod(z - poles) in controllable canonical form; G = B, H = D = 0."""
    n = len(poles)
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = -np.poly(poles)[:0:-1]
    C = np.zeros((1, n))
    C[0, : len(numerator)] = numerator[::-1]
    return plant_of(A, np.eye(n)[:, -1:], C)


def plant_of(A, B, C, D=None, G=None, H=None):
    n, ny = len(A), len(C)
    return linear_plant(
        A=A, B=B, C=C, D=D, G=G, H=H, Q=1e-3 * np.eye(n), R=1e-2 * np.eye(ny), dt=0.1
    )


def run(plant, attack):
    n = len(plant.states)
    monitor = Monitor(kalman.build(plant, np.zeros(n), np.eye(n)), chi_square.build(plant))
    attacks = () if attack is None else (attack,)
    return simulate(Scenario(plant, jnp.ones(n), monitor, None, attacks), jax.random.key(2), STEPS)


def moved(plant, attack):
    """What the attack changes, rows 1 .. STEPS: state, outputs, and what was injected."""
    found, quiet = run(plant, attack), run(plant, None)
    added = np.hstack([found.injection.u, found.injection.y, found.injection.d])
    return (
        np.asarray(found.x - quiet.x),
        np.asarray(found.observation.y - quiet.observation.y),
        added,
    )


def response(plant, added):
    """x and y from zero under these injections, row by row."""
    nu, ny = len(plant.inputs), len(plant.outputs)
    A, B, C, D, G, H = map(np.asarray, (plant.A, plant.B, plant.C, plant.D, plant.G, plant.H))
    x, before, states, outputs = np.zeros(len(A)), np.zeros(added.shape[1]), [], []
    for now in added:
        x = A @ x + B @ before[:nu] + G @ before[nu + ny :]
        states.append(x)
        outputs.append(C @ x + D @ now[:nu] + now[nu : nu + ny] + H @ now[nu + ny :])
        before = now
    return np.array(states), np.array(outputs)


# numerator's roots, of which the first is the one of largest modulus
ROOTS = {
    "unstable": [1.25, 0.3],
    "on the circle": [-1.0],
    "fading": [0.6, -0.2],
    "complex": [0.8 + 0.7j, 0.8 - 0.7j, 0.2],
    "at once": [0.0],
}


@pytest.mark.parametrize("which", ROOTS)
def test_a_zero_of_one_input_and_one_output(which):
    roots = ROOTS[which]
    plant = single([0.5, -0.4, 0.7, 0.2], np.atleast_1d(np.poly(roots)).real)
    attack = zero_dynamics.build(plant, size=2.0, channel="actuator:u1", start=FIRST * 0.1)
    x, y, added = moved(plant, attack)
    j = np.arange(1, STEPS + 1) - FIRST
    z = complex(roots[0])
    power = np.where(j < 0, 0.0, z ** np.maximum(j, 0))
    # powers up to 1e3, and the zero itself is found to 1e-9 (tests/analysis/test_zeros.py)
    scale = 1e-9 * STEPS * np.abs(power).max()
    np.testing.assert_allclose(added[:, 0], 2.0 * power.real, rtol=0, atol=scale)
    # x_0 of this form: (zI - A)^-1 B, which is (1, z, z^2, ..) over the denominator
    A, C = np.asarray(plant.A), np.asarray(plant.C)
    x0 = np.linalg.solve(z * np.eye(4) - A, np.eye(4)[:, -1])
    forgotten = [np.linalg.matrix_power(A, max(i, 0)) @ x0.real for i in j]
    moves = np.where((j < 0)[:, None], 0, np.outer(power, x0).real - forgotten)
    np.testing.assert_allclose(x, 2.0 * moves, rtol=0, atol=10 * scale)
    shown = np.where(j < 0, 0, -2.0 * np.array(forgotten) @ C[0])
    np.testing.assert_allclose(y[:, 0], shown, rtol=0, atol=10 * scale)
    # 30 steps later the outputs have forgotten, 0.7^30 = 2e-5 times a factor of its mode
    assert np.abs(y[-1]) < 1e-3 * np.abs(y).max() + scale
    if abs(z) > 1:
        assert np.abs(x[-1]).max() > 5 * np.abs(y).max()


@pytest.mark.slow
def test_several_channels_and_sensors_among_them():
    """Two actuators, three sensors of which one may be falsified, and an attack channel."""
    rng = np.random.default_rng(8)
    A = rng.normal(size=(4, 4))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    plant = plant_of(
        A, rng.normal(size=(4, 2)), rng.normal(size=(3, 4)), rng.normal(size=(3, 2)),
        rng.normal(size=(4, 1)), rng.normal(size=(3, 1)),
    )  # fmt: skip
    names = ["actuator:u2", "sensor:y1", "channel:d1"]
    attack = zero_dynamics.build(plant, size=0.3, channels=names, start=FIRST * 0.1)
    x, y, added = moved(plant, attack)
    hit = [1, 2, 5]
    assert np.all(np.delete(added, hit, 1) == 0)
    np.testing.assert_allclose(np.abs(added[FIRST - 1]).max(), 0.3, rtol=1e-12)
    # the truth: the generalised eigenvalues of the square pencil, the largest of them
    B = np.hstack([plant.B, np.zeros((4, 3)), plant.G])[:, hit]
    D = np.hstack([plant.D, np.eye(3), plant.H])[:, hit]
    pencil = np.block([[A, B], [np.asarray(plant.C), D]])
    shift = np.diag([1.0] * 4 + [0.0] * 3)
    z = max(np.linalg.eigvals(A - B @ np.linalg.solve(D, np.asarray(plant.C))), key=abs)
    (pair,) = null_space(pencil - z * shift, rcond=1e-10).T
    pair = 0.3 * pair / max(pair[4:], key=abs)
    j = np.arange(STEPS + 1 - FIRST)
    np.testing.assert_allclose(
        added[FIRST - 1 :, hit], np.outer(z**j, pair[4:]).real, rtol=0,
        atol=1e-9 * max(1.0, abs(z)) ** j[-1],
    )  # fmt: skip
    states, outputs = response(plant, added)
    size = np.abs(states).max()
    # the same sums in another order
    np.testing.assert_allclose(x, states, rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(y, outputs, rtol=0, atol=1e-12 * size)
    forgotten = [-plant.C @ np.linalg.matrix_power(A, i) @ pair[:4].real for i in j]
    np.testing.assert_allclose(y[FIRST - 1 :], forgotten, rtol=0, atol=1e-9 * size)


def test_all_sensors_of_an_unstable_plant():
    """INTEGRITY, Theorem 3: the samples of a plant that starts elsewhere along its largest mode."""
    A = np.array([[1.1, 0.4], [0.0, 0.5]])
    plant = plant_of(A, None, [[1.0, 0.0], [1.0, 1.0]])
    names = ["sensor:y1", "sensor:y2"]
    attack = zero_dynamics.build(plant, size=0.01, channels=names, start=FIRST * 0.1)
    x, y, added = moved(plant, attack)
    np.testing.assert_array_equal(x, 0.0)
    j = np.arange(STEPS + 1 - FIRST)
    # the mode 1.1 has the eigenvector (1, 0): C sees 1 on both
    np.testing.assert_allclose(y[FIRST - 1 :], 0.01 * np.outer(1.1**j, [1, 1]), rtol=1e-9)
    np.testing.assert_allclose(added[:, :2], y, rtol=0, atol=1e-12)


def test_it_stops_growing_before_numbers_end():
    plant = single([0.5, 0.2], [1.0, -4.0])
    attack = zero_dynamics.build(plant, size=1.0, channel="actuator:u1")
    known = Knowledge(jnp.asarray(20_000, jnp.int32), jnp.zeros(1), jnp.zeros(1))
    added = attack.step(attack.init(jax.random.key(0), known), known)[1]
    assert float(added.u[0]) == pytest.approx(1e100)
    early = zero_dynamics.build(plant, size=1.0, channel="actuator:u1", start=1e6)
    assert float(early.step((), known)[1].u[0]) == 0.0


@pytest.mark.parametrize(
    ("channels", "C"),
    [
        # one output that sees the input one step later: nothing hides
        (["actuator:u1"], [[0.0, 1.0]]),
        # a mode that no output sees is a zero, but no input keeps it up
        (["actuator:u1"], [[1.0, 0.0]]),
    ],
)
def test_where_nothing_hides(channels, C):
    plant = plant_of([[0.5, 0.0], [0.0, 0.9]], [[1.0], [1.0]], C)
    with pytest.raises(InvalidValue, match=r"without an invariant zero.*sensors among them"):
        zero_dynamics.build(plant, size=1.0, channels=channels)


def test_where_everything_hides():
    """An actuator and every sensor: any push at all, and so no zero."""
    plant = plant_of([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], np.eye(2))
    names = ["actuator:u1", "sensor:y1", "sensor:y2"]
    with pytest.raises(InvalidValue, match=r"a push hides whatever its signal.*fewer channels"):
        zero_dynamics.build(plant, size=1.0, channels=names)


def test_the_largest_zero_that_takes_an_attack_is_chosen():
    """A hidden mode at 2, zeros of the rest at 1.5 and 0.3."""
    rest = single([0.5, -0.4, 0.7], np.poly([1.5, 0.3]))
    A = np.zeros((4, 4))
    A[:3, :3], A[3, 3] = rest.A, 2.0
    G, C = np.vstack([rest.B, [[1.0]]]), np.hstack([rest.C, [[0.0]]])
    found = zeros.driven(A, G, C, np.zeros((1, 1)))
    assert found is not None
    z, state, attack = found
    np.testing.assert_allclose(z, 1.5, rtol=1e-9)
    np.testing.assert_allclose((A - z * np.eye(4)) @ state + G @ attack, 0, atol=1e-9)
    np.testing.assert_allclose(C @ state, 0, atol=1e-9)
    assert (
        zeros.driven(np.diag([0.5, 2.0]), np.array([[1.0], [0]]), np.eye(2)[:1], 0 * G[:1]) is None
    )


def test_wrong_settings_are_named():
    plant = single([0.5, 0.2], [1.0, -4.0])
    with pytest.raises(InvalidValue, match="size: found nan"):
        zero_dynamics.build(plant, size=np.nan, channel="actuator:u1")
    with pytest.raises(InvalidValue, match="found neither, expected one of the two"):
        zero_dynamics.build(plant, size=1.0)
    varying = linear_plant(A=0.5 * np.ones((9, 1, 1)), C=[[1.0]], Q=[[1.0]], R=[[1.0]])
    with pytest.raises(InvalidValue, match="constant one for zero_dynamics"):
        zero_dynamics.build(varying, size=1.0, channel="sensor:y1")
    with pytest.raises(InvalidValue, match="a linear plant"):
        zero_dynamics.build(bicycle.build(), size=1.0, channel="actuator:accel")
