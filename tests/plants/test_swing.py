import csv
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from holdfast.parts import InvalidValue, Plant
from holdfast.plants.library import swing
from holdfast.shell.files import read_scenario

SMALL = {
    "lines": [[7, 3], [3, 12, 0.8], [12, 7], [12, 20, 2.5], [20, 3]],
    "generators": [3, 20],
    "demand": [0.3, -0.2, 0.1, 0.4],
    "damping": 1.3,
    "attacks": ["actuator:12", "sensor:P_elec:3", "sensor:f:20"],
    "switches": [["3-12"], ["7-12"], ["20-3"]],
}
"""Four buses, 3, 7, 12, 20 in the order of their numbers."""

step = jax.jit(lambda plant, x, u, d: plant.transition(1, x, u, d))
structured = jax.jit(lambda plant, x, u, d: plant.jacobian(1, x, u, d))
tangents = jax.jit(
    lambda plant, x, u, d: jax.jacfwd(lambda x, d: plant.transition(1, x, u, d), (0, 1))(x, d)
)

couplings = jax.jit(lambda plant, x: (plant.flow(x[: len(plant.buses)]), plant.stiffness(x)))


def rate_of_1(x, power, attack, opened, settings=SMALL):
    """(1) bus by bus, from the lines as they are given."""
    buses = sorted({int(bus) for line in settings["lines"] for bus in line[:2]})
    n = len(buses)
    theta, f = dict(zip(buses, x[:n], strict=True)), dict(zip(buses, x[n:], strict=True))
    out = []
    for i, bus in enumerate(buses):
        out_flow = 0.0
        for line in settings["lines"]:
            if bus in line[:2] and set(line[:2]) not in opened:
                other = line[1] if line[0] == bus else line[0]
                out_flow += (line[2] if len(line) == 3 else 1.5) * np.sin(theta[bus] - theta[other])
        generator = bus in settings["generators"]
        P_M = power[i] if generator else 0.0
        P_L = settings["demand"][i] - (0.0 if generator else power[i])
        wanted = settings["damping"] * f[bus] + out_flow - (P_M + attack.get(bus, 0.0)) + P_L
        out.append(-wanted / (10.0 if generator else 100.0))
    return np.concatenate([x[n:], out])


def test_positions_are_all_combinations():
    assert swing.build().positions == ("normal", "56-57", "59-60", "56-57+59-60")
    plant = swing.network(**SMALL)
    assert plant.positions[:5] == ("normal", "3-12", "7-12", "20-3", "3-12+7-12")
    assert plant.positions[5:] == ("3-12+20-3", "7-12+20-3", "3-12+7-12+20-3")
    together = swing.network(**SMALL | {"switches": [["3-12", "7-12"], ["20-3"]]})
    assert together.positions == ("normal", "3-12+7-12", "20-3", "3-12+7-12+20-3")
    np.testing.assert_array_equal(together.closed[1], [1, 0, 0, 1, 1])


def test_a_sample_is_the_integral_of_the_papers_equation_to_fourth_order():
    rng = np.random.default_rng(3)
    x, u, d = rng.normal(size=8), rng.normal(size=4), np.array([0.7, 9.0, 9.0])

    def errors(position, opened):
        truth = solve_ivp(
            lambda _, z: rate_of_1(z, u, {12: 0.7}, opened), (0, 2.0), x,
            method="DOP853", rtol=1e-13, atol=1e-13,
        ).y[:, -1]  # fmt: skip
        found = []
        for substeps in (8, 16, 32):
            plant = swing.network(**SMALL, dt=2.0, substeps=substeps)
            plant = plant.at_position(jnp.asarray(position, jnp.int32))
            after = step(plant, *map(jnp.asarray, (x, u, d)))
            found.append(np.linalg.norm(after - truth))
        return found

    # halving the step divides the error by 16, to leading order
    for position, opened in ((0, []), (5, [{3, 12}, {20, 3}])):
        coarse, middle, fine = errors(position, opened)
        assert fine < 1e-6
        assert coarse / middle == pytest.approx(16.0, rel=0.15)
        assert middle / fine == pytest.approx(16.0, rel=0.07)


def test_outputs_are_those_of_2_with_a_known_demand():
    plant = swing.network(**SMALL)
    assert plant.outputs[:4] == ("P_elec:3", "theta:3", "f:3", "P_elec:7")
    rng = np.random.default_rng(4)
    theta, f, u, d = (rng.normal(size=size) for size in (4, 4, 4, 3))
    y = plant.output(1, *map(jnp.asarray, (np.concatenate([theta, f]), u, d)))
    # P_L: demand at the generators 3 and 20, and less the input at the loads 7 and 12
    P_L = np.array([0.3, -0.2 - u[1], 0.1 - u[2], 0.4])
    expected = np.stack([P_L + 1.3 * f, theta, f], 1).ravel()
    expected[0] += d[1]
    expected[11] += d[2]
    np.testing.assert_allclose(y, expected, rtol=1e-14, atol=1e-15)


def test_near_the_operating_point_it_is_the_linear_theory():
    """Perturbations of theta and f grow and decay with the network's Laplacian: expm(J dt)."""
    plant = swing.network(**SMALL)
    point = swing.operating_point(plant)
    np.testing.assert_allclose(point[:4], 0.3 * np.sin([3, 7, 12, 20]), rtol=1e-14)
    u, none = plant.flow(point[:4]) + plant.demand, jnp.zeros(3)
    np.testing.assert_allclose(step(plant, point, u, none), point, rtol=0, atol=1e-15)
    laplacian = np.zeros((4, 4))
    place = {3: 0, 7: 1, 12: 2, 20: 3}
    for line in SMALL["lines"]:
        i, j = place[line[0]], place[line[1]]
        t = (line[2] if len(line) == 3 else 1.5) * np.cos(point[i] - point[j])
        laplacian[[i, j], [i, j]] += t
        laplacian[[i, j], [j, i]] -= t
    m = np.array([10.0, 100.0, 100.0, 10.0])
    J = np.block([[np.zeros((4, 4)), np.eye(4)], [-laplacian / m[:, None], np.diag(-1.3 / m)]])
    A, G = structured(plant, point, u, none)
    # Runge-Kutta's own error: (|J| dt)^5 / 120 < 1e-12
    np.testing.assert_allclose(A, expm(J * 0.01), rtol=0, atol=1e-12)
    B = np.zeros((8, 1))
    B[6] = 1 / 100.0
    held = np.block([[J, B], [np.zeros((1, 9))]])
    np.testing.assert_allclose(G[:, :1], expm(held * 0.01)[:8, 8:], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(G[:, 1:], 0.0)


def test_structured_derivatives_are_the_tangents():
    """Of one step, and of three after one another."""
    plant = swing.network(**SMALL, dt=0.5, substeps=3)
    plant = plant.at_position(jnp.asarray(4, jnp.int32))
    rng = np.random.default_rng(1)
    x, u, d = (jnp.asarray(rng.normal(size=size)) for size in (8, 4, 3))
    for found, expected in zip(structured(plant, x, u, d), tangents(plant, x, u, d), strict=True):
        # sums of products of numbers near 1, in another order
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def test_parallel_lines_add_and_open_together():
    settings = {"generators": [1], "switches": [["2-1"]]}
    double = swing.network(lines=[[1, 2, 0.4], [2, 1, 0.5], [2, 3]], **settings)
    single = swing.network(lines=[[1, 2, 0.9], [2, 3]], **settings)
    x = jnp.asarray(np.random.default_rng(5).normal(size=6))
    for j in (0, 1):
        both = [plant.at_position(jnp.asarray(j, jnp.int32)) for plant in (double, single)]
        for one, other in zip(*(couplings(p, x) for p in both), strict=True):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-15)


def test_noise_is_the_papers_and_drawn_as_the_base_class_draws_it():
    plant = swing.network(**SMALL)
    Q, R = plant.noise(1, jnp.zeros(8), jnp.zeros(4))
    # w of covariance 0.01^2 held over 0.01 s; v of covariance 0.01^4
    np.testing.assert_allclose(Q, 1e-8 * np.eye(8), rtol=1e-14)
    np.testing.assert_allclose(R, 1e-8 * np.eye(12), rtol=1e-14)

    @jax.jit
    def both(plant, x, u, d):
        return [
            [
                getattr(kind, name)(plant, jax.random.key(1), 1, x, u, d)
                for kind in (type(plant), Plant)
            ]
            for name in ("advance", "measure")
        ]

    for found, expected in both(plant, jnp.ones(8), jnp.ones(4), jnp.ones(3)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)


def test_positions_can_be_batched():
    plant = swing.network(**SMALL)
    rng = np.random.default_rng(6)
    x, u, d = (jnp.asarray(rng.normal(size=size)) for size in ((8, 8), 4, 3))
    numbers = jnp.arange(8, dtype=jnp.int32)
    moved = jax.jit(jax.vmap(lambda x, j: plant.at_position(j).transition(1, x, u, d)))(x, numbers)
    for j in (0, 3, 7):
        one = step(plant.at_position(numbers[j]), x[j], u, d)
        np.testing.assert_allclose(moved[j], one, rtol=0, atol=1e-15)


def test_the_topology_is_that_of_the_68_bus_system(shared_data):
    with (shared_data / "ieee68" / "lines.csv").open() as file:
        branches = [(int(row["from"]), int(row["to"])) for row in csv.DictReader(file)]
    plant = swing.build()
    first, last = np.asarray(plant.buses)[np.asarray(plant.ends)]
    assert list(zip(first.tolist(), last.tolist(), strict=True)) == branches
    assert plant.buses == tuple(range(1, 69))
    np.testing.assert_array_equal(plant.load, np.arange(68) >= 16)
    np.testing.assert_array_equal(plant.inertia, np.where(np.arange(68) < 16, 10.0, 100.0))
    open_lines = [np.asarray(branches)[np.asarray(row) == 0].tolist() for row in plant.closed]
    assert open_lines == [[], [[56, 57]], [[59, 60]], [[56, 57], [59, 60]]]
    hit = [plant.outputs[i] for i in np.argmax(plant.sensors, 0)[:3]]
    assert hit == ["P_elec:26", "P_elec:53", "P_elec:54"]
    np.testing.assert_array_equal(np.argmax(plant.actuators, 0)[3:], [13, 14, 15])


@pytest.mark.parametrize(
    ("changes", "key", "found"),
    [
        ({"lines": []}, "lines", "empty"),
        ({"lines": [[1, 2], [3]]}, "lines[2]", "1 numbers"),
        ({"lines": [[1, 1]]}, "lines[1]", "[1, 1]"),
        ({"lines": [[1, 2.5]]}, "lines[1]", "2.5"),
        ({"lines": [[1, float("inf")]]}, "lines[1]", "inf"),
        ({"lines": [[1, 2, 0.0]]}, "lines[1]", "t = 0"),
        ({"generators": [3, 5]}, "generators[2]", "5"),
        ({"demand": [1.0]}, "demand", "(1,)"),
        ({"damping": -1.0}, "damping", "-1"),
        ({"substeps": 0}, "substeps", "0"),
        ({"attacks": ["actuator:3", "actuator:5"]}, "attacks[2]", "actuator:5"),
        ({"attacks": ["sensor:volt:3"]}, "attacks[1]", "sensor:volt:3"),
        ({"attacks": ["actuator:3", "actuator:3"]}, "attacks", "actuator:3"),
        ({"switches": [["3-12"], ["7-20"]]}, "switches[2]", "7-20"),
        ({"switches": [["3-12"], ["12-3"]]}, "switches", "12-3"),
        ({"switches": [[]]}, "switches", "[]"),
    ],
)
def test_what_cannot_be_is_named(changes, key, found):
    with pytest.raises(InvalidValue) as refused:
        swing.network(**SMALL | changes)
    assert refused.value.key == key
    assert found in str(refused.value.found)


def test_a_scenario_reads_lines_from_a_file(tmp_path):
    (tmp_path / "lines.csv").write_text("1,2\n2,3\n3,1\n")
    (tmp_path / "grid.toml").write_text(
        '[plant]\nkind = "swing"\nlines = { file = "lines.csv" }\ngenerators = [1]\n'
        'switches = [["2-3"]]\n[estimator]\nkind = "extended"\nx0 = [0, 0, 0, 0, 0, 0]\n'
        f"P0 = {np.eye(6).tolist()}\n"
        '[controller]\nkind = "linearising"\ngains = [1.0, 3.0]\n'
        '[[attack]]\nkind = "switch"\nto = "2-3"\nstart = 0.5\nstop = 1.0\n'
    )
    plant = read_scenario(tmp_path / "grid.toml").scenario.plant
    assert plant.buses == (1, 2, 3)
    np.testing.assert_array_equal(plant.closed, [[1, 1, 1], [1, 0, 1]])


@pytest.mark.slow
def test_structure_makes_the_derivatives_of_68_buses_faster():
    plant = swing.build().at_position(jnp.asarray(3, jnp.int32))
    rng = np.random.default_rng(7)
    x = swing.operating_point(plant) + jnp.asarray(0.1 * rng.normal(size=136))
    u, d = (jnp.asarray(rng.normal(size=size)) for size in (68, 6))
    for found, expected in zip(structured(plant, x, u, d), tangents(plant, x, u, d), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)

    def best(function):
        seconds = []
        for _ in range(50):
            start = time.perf_counter()
            jax.block_until_ready(function(plant, x, u, d))
            seconds.append(time.perf_counter() - start)
        return min(seconds)

    # 0.2 ms against 0.8 ms on one core of a server
    assert best(structured) < 0.7 * best(tangents)
