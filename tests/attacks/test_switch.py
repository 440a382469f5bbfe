import jax
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.attacks import switch
from holdfast.loop import simulate
from holdfast.parts import InvalidValue
from holdfast.plants.library import swing
from holdfast.records import Knowledge
from holdfast.shell.files import read_scenario

GRID = """\
[plant]
kind = "swing"
lines = [[1, 2, 0.5], [2, 3], [3, 1]]
generators = [1]
switches = [["1-2"], ["2-3"]]
process_sd = 1e-9
x0 = [0.5, -0.2, 0.1, 0, 0, 0]

[estimator]
kind = "extended"
x0 = [0.5, -0.2, 0.1, 0, 0, 0]
P0 = [[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0],
      [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 1]]

[controller]
kind = "linearising"

[[attack]]
kind = "switch"
to = "1-2"
start = 0.05
stop = 0.12

[[attack]]
kind = "switch"
to = "1-2+2-3"
start = 0.08
stop = 0.10
"""


def test_it_holds_the_position_and_adds_nothing():
    plant = swing.network(
        lines=[[1, 2], [2, 3]], generators=[1], dt=0.1, attacks=["actuator:1"],
        switches=[["1-2"], ["2-3"]],
    )  # fmt: skip
    attack = switch.build(plant, to="2-3", start=0.3, stop=0.5)
    step = jax.jit(lambda attack, known: attack.step((), known))
    for k, position in ((2, 0), (3, 2), (4, 2), (5, 0)):
        known = Knowledge(jnp.asarray(k, jnp.int32), jnp.ones(3), jnp.ones(9))
        _, injection = step(attack, known)
        assert int(injection.switch) == position
        for part, size in ((injection.u, 3), (injection.y, 9), (injection.d, 1)):
            np.testing.assert_array_equal(part, np.zeros(size))


def test_a_position_that_the_plant_lacks_is_told():
    plant = swing.network(lines=[[1, 2]], generators=[1], switches=[["1-2"]])
    with pytest.raises(InvalidValue, match="to: found '2-1', expected one of normal, 1-2"):
        switch.build(plant, to="2-1")


@pytest.mark.slow
def test_lines_open_and_close_through_a_scenario(tmp_path):
    path = tmp_path / "grid.toml"
    path.write_text(GRID)
    scenario = read_scenario(path).scenario
    trace = simulate(scenario, jax.random.key(0), 15)
    position = np.asarray(trace.injection.switch)
    # rows 5 to 11, and within them 8 and 9 at the later attack's position
    expected = [0, 0, 0, 0, 1, 1, 1, 3, 3, 1, 1, 0, 0, 0, 0]
    np.testing.assert_array_equal(position, expected)
    before = np.concatenate([[0], position[:-1]]).astype(np.int32)
    x = jnp.concatenate([scenario.x0[None], trace.x[:-1]])

    @jax.jit
    @jax.vmap
    def moved(x, u, j):
        return scenario.plant.at_position(j).transition(1, x, u, jnp.zeros(0))

    # noise of 1e-9 held over 0.01 s; a line moves f by 0.5 sin(0.7) / 100 * 0.01 > 3e-5
    found = moved(x, trace.observation.u, jnp.asarray(before))
    np.testing.assert_allclose(trace.x, found, rtol=0, atol=1e-10)
    closed = moved(x, trace.observation.u, jnp.zeros(15, jnp.int32))
    apart = np.max(np.abs(np.asarray(trace.x - closed)), axis=1)
    assert np.all(apart[before > 0] > 1e-5)
