import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.catalog import PLANTS
from holdfast.controllers.feedback import closed_loop
from holdfast.controllers.pole_placement import build, distance, placed, unreached
from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.records import Estimate


def plant_of(A, B, **others):
    n = np.shape(A)[-1]
    keys = {"C": np.eye(n), "Q": np.eye(n), "R": np.eye(n), **others}
    return linear_plant(A=A, B=B, **keys)


def command(controller, x):
    n = len(x)
    return np.asarray(
        controller.command(
            Estimate.without_attack(
                jnp.asarray(x, float), jnp.eye(n), jnp.zeros(n), jnp.eye(n), jnp.asarray(0)
            )
        )
    )


def loop_of(plant, controller):
    """A - B K from what the controller commands at unit states."""
    n = len(plant.states)
    zero = command(controller, np.zeros(n))
    by_x = np.stack([command(controller, row) - zero for row in np.eye(n)], axis=1)
    return np.asarray(plant.A) + np.asarray(plant.B) @ by_x


def test_double_integrator_closed_form():
    # z^2 + (k2 dt + k1 dt^2/2 - 2) z + 1 - k2 dt + k1 dt^2/2 = (z - a)(z - b)
    dt, a, b = 0.1, 0.8, 0.6
    K = np.linalg.solve([[dt**2 / 2, dt], [dt**2 / 2, -dt]], [2 - a - b, a * b - 1])
    plant = plant_of([[1, dt], [0, 1]], [[dt**2 / 2], [dt]])
    controller = build(plant, poles=[a, b], reference=[3.0, 0.0])
    np.testing.assert_allclose(controller.gain, [K], rtol=1e-9)
    np.testing.assert_allclose(command(controller, [2.0, 0.5]), [K[0] - 0.5 * K[1]], rtol=1e-9)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "poles",
    [
        [0.9, 0.5, 0.1, -0.3, 0.0],
        [[0.5, 0.2], [0.5, -0.2], 0.3, [0.1, 0.6], [0.1, -0.6]],
        [0.5, 0.5, 0.7, 0.2, 0.1],
    ],
)
def test_the_characteristic_polynomial_is_that_of_the_poles(seed, poles):
    rng = np.random.default_rng(seed)
    plant = plant_of(rng.normal(size=(5, 5)), rng.normal(size=(5, 2)))
    loop = loop_of(plant, build(plant, poles=poles))
    wanted = [complex(*pole) if isinstance(pole, list) else pole for pole in poles]
    # the coefficients, unlike the poles themselves, are well conditioned where poles repeat
    np.testing.assert_allclose(np.poly(loop), np.poly(wanted).real, atol=1e-6)


def test_the_quadrotor_holds_a_place():
    plant = PLANTS["quadrotor"]()
    poles = [0.9, 0.88, 0.86, 0.84, 0.82, 0.8, 0.5, 0.45, [0.6, 0.1], [0.6, -0.1]]
    reference = np.array([2.0, 0, 0, 0, -1.0, 0, 0, 0, 3.0, 0])
    controller = build(plant, poles=poles, reference=reference.tolist())
    x = np.zeros(10)
    for _ in range(300):
        x = np.asarray(plant.A) @ x + np.asarray(plant.B) @ command(controller, x)
    np.testing.assert_allclose(x, reference, atol=1e-8)


def test_inputs_that_depend_on_each_other_are_put_together():
    A, b = np.array([[1.2, 0.3], [0.1, 0.9]]), np.array([[1.0], [0.5]])
    alone = placed(A, b, np.array([0.5, 0.4]))
    for B in (np.hstack([b, 2 * b]), np.hstack([0 * b, b])):
        K = placed(A, B, np.array([0.5, 0.4]))
        np.testing.assert_allclose(B @ K, b @ alone, rtol=1e-9)


def test_distance_pairs_poles():
    asked = np.array([0.9, 0.1, 0.5])
    assert distance(np.array([0.5, 0.9, 0.1]), asked) == 0
    assert distance(np.array([0.5, 0.9, 0.1 + 0.2j]), asked) == pytest.approx(0.2)


@pytest.mark.parametrize("units", [1.0, 1e5, 1e-5])
def test_modes_that_no_input_reaches(units):
    A, B = np.array([[0.5, 1.0, 0], [0, 0.3, 0], [0, 0.0, 0.7]]), np.array([[0.0], [1], [0]])
    size = np.array([1.0, units, 1.0])
    found = unreached(A * size / size[:, None], B / size[:, None])
    np.testing.assert_allclose(found, [0.7], rtol=1e-9)


GOOD = {"A": [[1.1, 1.0], [0, 0.5]], "B": [[0], [1]], "poles": [0.4, 0.5]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"A": [[1.1, 0], [0, 0.5]]}, "plant.B: found no input that reaches the mode 1.1"),
        ({"B": np.zeros((2, 1))}, "plant.B: found no input that reaches the mode 1.1"),
        ({"B": np.zeros((2, 0))}, "plant.B: found no inputs"),
        ({"A": np.ones((3, 2, 2))}, "plant: found matrices that change"),
        ({"poles": [0.4]}, "poles: found 1 poles, expected 2, one per state"),
        ({"poles": [0.4, [0.5, 0.1, 0.2]]}, "poles[2]: found [0.5, 0.1, 0.2], expected a number"),
        ({"poles": [[0.4, 0.1], 0.5]}, "poles: found 0.4+0.1j without its conjugate"),
        ({"poles": [[0.4, 0.1], [0.4, -0.2]]}, "poles: found 0.4+0.1j without its conjugate"),
        ({"poles": [0.4, 0.4]}, "poles: found 0.4 2 times, expected each pole at most 1 times"),
        ({"poles": [-1.5, 0.5]}, "poles[1]: found -1.5, expected a pole inside the unit circle"),
        ({"poles": [0.5, float("nan")]}, "poles[2]: found nan"),
        ({"reference": [1.0]}, "reference: found [1.0], expected 2 finite numbers"),
    ],
)
def test_wrong_settings_are_named(changes, message):
    keys = {**GOOD, **changes}
    plant = plant_of(keys.pop("A"), keys.pop("B"))
    with pytest.raises(InvalidValue) as caught:
        build(plant, **keys)
    assert message in str(caught.value)


def test_poles_out_of_reach_of_float64_are_said_to_be():
    # fifteen integrators in a row and one input: 1e-16 in the gain moves the poles by far more
    plant = plant_of(np.eye(15) + np.eye(15, k=1), np.eye(15)[:, -1:])
    with pytest.raises(InvalidValue, match="poles: found a gain that misses them by"):
        build(plant, poles=np.linspace(0.1, 0.102, 15).tolist())


def walked(plant, x, us, ds):
    """States and outputs without noise."""
    A, B, C, D, G, H = (
        np.asarray(m) for m in (plant.A, plant.B, plant.C, plant.D, plant.G, plant.H)
    )
    xs, ys, before = [], [], 0 * ds[0]
    for k, d in enumerate(ds):
        u = us(x) if us else np.zeros(0)
        x = A @ x + B @ u + G @ before
        xs.append(x)
        ys.append(C @ x + D @ u + H @ d)
        before = ds[k]
    return np.array(xs), np.array(ys)


@pytest.mark.parametrize("told", [[], [1], [0, 1, 2]])
def test_closed_loop_moves_as_the_plant_with_its_feedback(told):
    rng = np.random.default_rng(len(told))
    A, B, K = 0.4 * rng.normal(size=(4, 4)), rng.normal(size=(4, 3)), rng.normal(size=(3, 4))
    D = np.zeros((2, 3))
    D[:, told] = rng.normal(size=(2, len(told)))
    plant = plant_of(
        A, B, C=rng.normal(size=(2, 4)), D=D, G=rng.normal(size=(4, 2)), H=rng.normal(size=(2, 2)),
        R=np.diag([1.0, 4.0]), inputs=["left", "mid", "right"], dt=0.3,
    )  # fmt: skip
    closed = closed_loop(plant, 0.1 * K)
    x, ds = rng.normal(size=4), rng.normal(size=(7, 2))
    xs, ys = walked(plant, x, lambda x: -0.1 * K @ x, ds)
    start = np.concatenate([x, rng.normal(size=len(told))])  # an input before the first: unused
    found_x, found_y = walked(closed, start, None, ds)
    np.testing.assert_allclose(found_x[:, :4], xs, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(found_y, ys, rtol=1e-11, atol=1e-11)
    assert closed.states == (*plant.states, *(plant.inputs[i] for i in told))
    assert (closed.inputs, closed.outputs, closed.dt) == ((), plant.outputs, 0.3)
    np.testing.assert_array_equal(closed.Q, np.pad(np.eye(4), ((0, len(told)),) * 2))
    np.testing.assert_array_equal(closed.R, plant.R)
    x = jnp.asarray(start)
    assert closed.transition(1, x, jnp.zeros(0), jnp.zeros(2)).shape == x.shape


def test_closed_loop_keeps_limits_that_do_not_move_with_the_input():
    limits = {"state": {"matrix": [[1.0, 0.0]], "bound": [1.5]}}
    plant = plant_of(GOOD["A"], GOOD["B"], D=[[0.0], [1.0]], constraints=limits)
    closed = closed_loop(plant, [[0.0, 0.3]])
    rows, bound = closed.constraints.state.at(1, jnp.zeros(0))
    np.testing.assert_array_equal(rows, [[1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(bound, [1.5])
    limits["state"]["bound_u"] = [[1.0]]
    plant = plant_of(GOOD["A"], GOOD["B"], constraints=limits)
    with pytest.raises(InvalidValue, match=r"plant.constraints: found a bound that moves with u"):
        closed_loop(plant, [[0.0, 0.3]])


@pytest.mark.parametrize("gain", [[[1.0]], [[1.0, np.nan]], [1.0, 2.0]])
def test_closed_loop_wants_a_gain_that_fits(gain):
    with pytest.raises(InvalidValue, match=r"gain: found .* expected finite numbers, 1 x 2"):
        closed_loop(plant_of(GOOD["A"], GOOD["B"]), gain)
