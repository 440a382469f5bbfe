import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.library import dcacc, five_sensors, quadrotor, vehicle_tracking
from holdfast.plants.linear import LinearPlant
from holdfast.plants.named import channels

PLANTS = {
    "vehicle": vehicle_tracking.build,
    "vehicles": lambda **keys: vehicle_tracking.build(axes=2, **keys),
    "dcacc": dcacc.build,
    "dcacc_slow": lambda **keys: dcacc.build(dt=0.5, **keys),
    "quadrotor": quadrotor.build,
    "quadrotor_twice": lambda **keys: quadrotor.build(sensors=["p_x", "v_z", "p_x"], **keys),
    "five_sensors": five_sensors.build,
    "five_stable": lambda **keys: five_sensors.build(stable=True, **keys),
}


def names(plant):
    return [
        *(f"actuator:{name}" for name in plant.inputs),
        *(f"sensor:{name}" for name in plant.outputs),
    ]


def test_the_matrices_pick_inputs_and_outputs():
    act, sens = channels(["sensor:c", "actuator:b", "sensor:a"], ["a", "b"], ["a", "b", "c"])
    np.testing.assert_array_equal(act, [[0, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(sens, [[0, 0, 1], [0, 0, 0], [1, 0, 0]])


def test_no_attack_is_no_column():
    act, sens = channels([], ["a"], ["b", "c"])
    assert (act.shape, sens.shape) == ((1, 0), (2, 0))
    act, sens = channels(["sensor:b"], [], ["b", "c"])
    assert (act.shape, sens.shape) == ((0, 1), (2, 1))


@pytest.mark.parametrize("build", PLANTS.values(), ids=PLANTS)
def test_a_channel_does_what_the_same_number_on_sensor_or_actuator_does(build):
    clean = build()
    attacks = names(clean)[::-1]
    plant = build(attacks=attacks)
    assert plant.attacks == tuple(attacks)
    rng = np.random.default_rng(1)
    none = jnp.zeros(0)
    x, u = jnp.asarray(rng.normal(size=len(plant.states))), rng.normal(size=len(plant.inputs))
    for j, name in enumerate(attacks):
        d = np.zeros(len(attacks))
        d[j] = 0.7
        falsified, added = u.copy(), np.zeros(len(plant.outputs))
        kind, _, where = name.partition(":")
        if kind == "actuator":
            falsified[plant.inputs.index(where)] += 0.7
        else:
            added[plant.outputs.index(where)] += 0.7
        moved = plant.transition(1, x, jnp.asarray(u), jnp.asarray(d))
        by_hand = clean.transition(1, x, jnp.asarray(falsified), none)
        # numbers of order 1 to 10, summed in another order
        np.testing.assert_allclose(moved, by_hand, rtol=0, atol=1e-14)
        shown = plant.output(1, x, jnp.asarray(u), jnp.asarray(d))
        by_hand = clean.output(1, x, jnp.asarray(falsified), none) + added
        np.testing.assert_allclose(shown, by_hand, rtol=0, atol=1e-14)


@pytest.mark.parametrize("build", PLANTS.values(), ids=PLANTS)
def test_nothing_else_moves(build):
    """Channels add columns; the rest of the plant is the one without them."""
    clean = build()
    plant = build(attacks=names(clean)[:1])
    for key in ("A", "B", "C", "D", "Q", "R"):
        # sampling takes the exponential of a matrix with the columns of G in it
        np.testing.assert_allclose(getattr(plant, key), getattr(clean, key), rtol=0, atol=1e-15)


def tilting():
    """x' = A x + B u of the quadrotor near hover."""
    A, B = np.zeros((10, 10)), np.zeros((10, 3))
    for axis, p in enumerate((0, 4)):
        A[p, p + 1], A[p + 1, p + 2] = 1.0, 9.81
        A[p + 2, [p + 2, p + 3]] = -8.0, 1.0
        A[p + 3, p + 2], B[p + 3, axis] = -10.0, 10.0
    A[8, 9], B[9, 2] = 1.0, 0.91
    return A, B, np.diag([0.0, 0.1, 0.0, 0.1, 0.0, 0.1, 0.0, 0.1, 0.0, 0.1]) ** 2


def settings():
    """The plants as they are without `channels`: matrices alone."""
    yield vehicle_tracking.build(), {
        "A": [[1.0, 0.01], [0.0, 1.0]], "B": [[0.0001], [0.01]], "C": np.eye(2),
        "Q": 0.26984 * np.eye(2), "R": 10.144 * np.eye(2), "dt": 0.01,
    }  # fmt: skip
    yield dcacc.build(), {
        "A": [[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1 / 0.8]], "B": [[0.0], [0.0], [1.0]],
        "C": np.eye(3)[:2], "Q": np.diag([0.0, 0.0, 2.0 / 0.8]), "R": np.diag([0.01, 0.01]),
        "dt": 0.01, "time": "continuous", "noise": "white",
    }  # fmt: skip
    A, B, Q = tilting()
    yield quadrotor.build(), {
        "A": A, "B": B, "C": np.eye(10)[[0, 4, 8, 1, 5]], "Q": Q, "R": np.diag([0.1] * 5) ** 2,
        "dt": 0.1, "time": "continuous", "noise": "white",
    }  # fmt: skip
    C = [[1, 0, 0], [1, 1, -1], [1, 2, 1], [1, -1, -0.5], [-0.5, 1, 1]]
    yield five_sensors.build(), {
        "A": np.diag([1.0, 1.0, -2.0]), "C": C, "Q": np.eye(3), "R": np.eye(5),
    }  # fmt: skip


def test_without_attacks_the_plants_are_what_they_were_to_the_last_bit():
    for plant, matrices in settings():
        assert isinstance(plant, LinearPlant)
        assert plant.attacks == ()
        truth = linear_plant(**matrices)
        for key in ("A", "B", "C", "D", "G", "H", "Q", "R"):
            np.testing.assert_array_equal(getattr(plant, key), getattr(truth, key))
        assert eqx.tree_equal(plant.white, truth.white)


@pytest.mark.parametrize(
    ("attacks", "message"),
    [
        (
            ["sensor:a", "sensor:c"],
            "attacks[2]: found 'sensor:c', expected one of actuator:u, sensor:a, sensor:b",
        ),
        (["actuator:a"], "attacks[1]: found 'actuator:a', expected one of actuator:u"),
        (["a"], "attacks[1]: found 'a', expected one of actuator:u"),
        (
            ["sensor:a", "actuator:u", "sensor:a"],
            "attacks: found ['sensor:a', 'actuator:u', 'sensor:a'], expected names that differ",
        ),
    ],
)
def test_wrong_names_are_told(attacks, message):
    with pytest.raises(InvalidValue) as caught:
        channels(attacks, ["u"], ["a", "b"])
    assert message in str(caught.value)


def test_long_lists_are_cut_short():
    with pytest.raises(InvalidValue) as caught:
        channels(["y"], [], [str(i) for i in range(12)])
    assert caught.value.expected.endswith(", sensor:11")
    with pytest.raises(InvalidValue) as caught:
        channels(["y"], [], [str(i) for i in range(13)])
    assert caught.value.expected.endswith(", sensor:11, ..")
    with pytest.raises(InvalidValue) as caught:
        channels(["y"], [], ["1"], expected="'sensor:NUMBER'")
    assert caught.value.expected == "'sensor:NUMBER'"


@pytest.mark.parametrize("build", PLANTS.values(), ids=PLANTS)
def test_the_plants_refuse_what_they_do_not_have(build):
    with pytest.raises(InvalidValue, match=r"attacks\[1\]: found 'sensor:mood'") as caught:
        build(attacks=["sensor:mood"])
    assert names(build())[0] in caught.value.expected
    with pytest.raises(InvalidValue, match="names that differ"):
        build(attacks=names(build())[-1:] * 2)
