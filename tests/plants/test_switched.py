import jax
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.attacks import switch
from holdfast.detectors import chi_square
from holdfast.estimators import extended
from holdfast.loop import Monitor, Scenario, simulate
from holdfast.parts import InvalidValue
from holdfast.plants.nonlinear import sampled
from holdfast.plants.switched import switched_plant

NAMES = ["normal", "open", "shorted"]
STEPS = jnp.asarray([1.0, 10.0, 100.0])
SHOWN = jnp.asarray([0.0, 0.25, 0.5])


def staircase(**changes):
    """X grows by 1, 10 or 100 a sample; what is shown of it is off by 0, 1/4 or 1/2."""
    keys = dict(
        f=lambda x, u, d, j: x + STEPS[j] + u[0],
        h=lambda x, u, d, j: x + SHOWN[j],
        positions=NAMES, Q=[[0.0]], R=[[1e-24]], dt=0.5, states=["x"], inputs=["u"],
        outputs=["y"],
    )  # fmt: skip
    return switched_plant(**(keys | changes))


def ran(plant, attacks, x0=0.0, steps=8):
    estimator = extended.build(plant, np.zeros(1), np.eye(1))
    monitor = Monitor(estimator, chi_square.build(plant, on="residual"))
    scenario = Scenario(plant, jnp.asarray([x0]), monitor, attacks=attacks)
    trace = simulate(scenario, jax.random.key(0), steps)
    return (
        np.asarray(trace.x)[:, 0],
        np.asarray(trace.observation.y)[:, 0],
        np.asarray(trace.injection.switch),
    )


def thrown(plant, *pieces):
    return tuple(switch.build(plant, to=to, start=a, stop=b) for to, a, b in pieces)


def test_dynamics_take_the_position_before_a_row_and_outputs_that_of_the_row():
    plant = staircase()
    # t = k / 2: before row 1 shorted, in rows 2, 3, 4 open, in rows 6, 7 shorted
    pieces = ("shorted", 0.0, 0.5), ("open", 1.0, 2.5), ("shorted", 3.0, 4.0)
    x, y, position = ran(plant, thrown(plant, *pieces))
    np.testing.assert_array_equal(position, [0, 1, 1, 1, 0, 2, 2, 0])
    moved = [100.0, 1.0, 10.0, 10.0, 10.0, 1.0, 100.0, 100.0]
    np.testing.assert_allclose(np.diff(x, prepend=0.0), moved, rtol=0, atol=1e-9)
    np.testing.assert_allclose(y - x, np.asarray(SHOWN)[position], rtol=0, atol=1e-9)


def test_a_jump_happens_once_and_before_the_measurement():
    """A state that is reset whenever the position changes, by how far it changes."""

    def jump(x, position, asked):
        return x + 1000.0 * (asked - position).astype(float), asked

    plant = staircase(jump=jump)
    x, y, position = ran(plant, thrown(plant, ("open", 1.0, 2.0)), steps=5)
    np.testing.assert_array_equal(position, [0, 1, 1, 0, 0])
    moved = [1.0, 1.0 + 1000.0, 10.0, 10.0 - 1000.0, 1.0]
    np.testing.assert_allclose(np.diff(x, prepend=0.0), moved, rtol=0, atol=1e-9)
    np.testing.assert_allclose(y - x, np.asarray(SHOWN)[position], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_jump_set_switches_by_itself():
    """(3): a relay that trips where x >= 4, resets x by -3, and stays open."""

    def jump(x, position, asked):
        trips = (x[0] >= 4.0) & (position == 0)
        return jnp.where(trips, x - 3.0, x), jnp.where(trips, 1, position)

    x, _, position = ran(staircase(jump=jump), (), steps=6)
    np.testing.assert_array_equal(position, [0, 0, 0, 1, 1, 1])
    np.testing.assert_allclose(x, [1.0, 2.0, 3.0, 1.0, 11.0, 21.0], rtol=0, atol=1e-9)


def test_a_continuous_rate_is_sampled_at_its_position():
    rates = jnp.asarray([-1.0, -2.0, 0.5])
    plant = staircase(f=sampled(lambda x, u, d, j: rates[j] * x, 0.5, substeps=4))
    at = jnp.asarray([1.0])

    @jax.jit
    @jax.vmap
    def moved(j):
        return plant.at_position(j).transition(1, at, at, jnp.zeros(0))[0]

    found = moved(jnp.arange(3, dtype=jnp.int32))
    # 4 substeps, each off by less than (rate dt / 4)^5 / 120 < 9e-6
    np.testing.assert_allclose(found, np.exp(0.5 * np.asarray(rates)), rtol=0, atol=4e-5)


@pytest.mark.slow
def test_limits_and_angles_are_those_of_a_nonlinear_plant():
    limits = {"state": {"matrix": [[1.0]], "bound": [0.5]}}
    plant = staircase(constraints=limits, angles=["y"])
    x, u = jnp.asarray([2.0]), jnp.asarray([0.0])
    assert plant.confined(1, u, x)[0] == pytest.approx(0.5)
    assert plant.saturated(1, u, jnp.zeros(0)).shape == (0,)
    assert plant.innovation(x, -x)[0] == pytest.approx(4.0 - 2 * np.pi)
    assert plant.steps is None


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"positions": []}, r"positions: found \[\]"),
        ({"positions": ["a", "a"]}, "positions: .*differ"),
        ({"f": lambda x, u, d: x}, r"f: .*function of \(x, u, d, position\)"),
        ({"h": lambda x, u, d, j: x if j else -x}, "h: found an if, .*jnp.where"),
        pytest.param(
            {"f": lambda x, u, d, j: jnp.where(j == 1, jnp.sqrt(-1.0 - x**2), x)},
            r"f: found a value that is NaN at every point tried in position 'open'",
            marks=pytest.mark.slow,
        ),
        ({"jump": lambda x, j, asked: x}, "jump: .*returns"),
        ({"jump": lambda x, j, asked: (x, x)}, "jump: found .*a whole one"),
        ({"jump": lambda x, j, asked: (x[:0], j)}, "jump: found .*1 numbers"),
        ({"jump": lambda x, j, asked: (x, asked if x[0] > 0 else j)}, "jump: found an if"),
    ],
)
def test_what_cannot_be_is_told(changes, told):
    with pytest.raises(InvalidValue, match=told):
        staircase(**changes)
