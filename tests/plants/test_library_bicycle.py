import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from holdfast.estimators import unknown_input
from holdfast.parts import InvalidValue
from holdfast.plants.library.bicycle import along, build
from holdfast.plants.linear import LinearPlant
from holdfast.plants.nonlinear import NonlinearPlant
from holdfast.records import Status
from holdfast.shell.files import read_scenario
from holdfast.shell.template import scenario_text
from systems import estimates

FRONT, REAR = 1.2, 1.7


def slip(delta, front=FRONT, rear=REAR):
    return np.arctan(rear / (front + rear) * np.tan(delta))


def exact(x, u, d, dt):
    """The paper's equations by scipy's eighth-order integrator."""

    def rate(_, z):
        beta = slip(u[0] + d[0])
        return [
            z[3] * np.cos(z[2] + beta),
            z[3] * np.sin(z[2] + beta),
            z[3] / REAR * np.sin(beta),
            u[1] + d[1],
        ]

    return solve_ivp(rate, (0, dt), x, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


def test_a_step_of_the_nonlinear_model_is_the_integral_of_its_equations():
    plant = build(front=FRONT, rear=REAR)
    step = jax.jit(jax.vmap(lambda x, u, d: plant.transition(1, x, u, d)))
    rng = np.random.default_rng(0)
    x = np.array([20.0, 5.0, 1.0, 22.0]) * rng.uniform([0, 0, -3, 0], 1.0, size=(40, 4))
    u, d = rng.uniform(-0.5, 0.5, size=(2, 40, 2)) * np.array([1.0, 3.5])
    found = step(*map(jnp.asarray, (x, u, d)))
    truth = np.stack([exact(*case, 0.01) for case in zip(x, u, d, strict=True)])
    # one Runge-Kutta step over an angle w dt < 0.12 is off by v dt (w dt)^4 / 120 < 4e-7 m
    np.testing.assert_allclose(found, truth, rtol=0, atol=4e-7)
    gentle = np.abs(u + d)[:, 0] < 0.15
    # and over w dt < 0.015 by less than 1e-10
    assert np.sum(gentle) > 3
    np.testing.assert_allclose(found[gentle], truth[gentle], rtol=0, atol=1e-10)
    np.testing.assert_array_equal(plant.output(1, *map(jnp.asarray, (x[0], u[0], d[0]))), x[0])


@pytest.mark.parametrize("speed", [-3.0, 0.0, 18.8])
def test_the_linear_model_is_the_tangent_at_heading_and_steering_zero(speed):
    """To first order in dt, as the paper's Euler step: the rest falls as (v dt / l_r)^2."""
    dt = 1e-6
    curved = build(front=FRONT, rear=REAR, dt=dt)
    straight = along([speed], front=FRONT, rear=REAR, dt=dt)
    x = jnp.asarray([4.0, 2.0, 0.0, speed])
    A = jax.jacfwd(lambda x: curved.transition(1, x, jnp.zeros(2), jnp.zeros(2)))(x)
    G = jax.jacfwd(lambda d: curved.transition(1, x, jnp.zeros(2), d))(jnp.zeros(2))
    found = straight.at(1, x, jnp.zeros(2))
    second_order = (18.8 * dt / REAR) ** 2
    np.testing.assert_allclose(found.A, A, rtol=0, atol=second_order)
    # the linear model is driven by the slip angle, d beta / d delta = l_r / (l_f + l_r)
    ratio = np.array([REAR / (FRONT + REAR), 1.0])
    np.testing.assert_allclose(found.G * ratio, G, rtol=0, atol=second_order)
    np.testing.assert_array_equal(found.B, found.G)


def test_the_papers_matrices():
    found = along([18.8]).at(1, jnp.zeros(4), jnp.zeros(2))
    A = [[1, 0, 0, 0.01], [0, 1, 0.188, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    G = [[0, 0], [0.188, 0], [0.188 / 1.5, 0], [0, 0.01]]
    np.testing.assert_allclose(found.A, A, rtol=1e-15)
    np.testing.assert_allclose(found.G, G, rtol=1e-15)
    np.testing.assert_allclose(found.Q, np.diag([0.1, 0.1, 0.001, 0.0001]))
    np.testing.assert_allclose(found.R, np.diag([0.01, 0.01, 0.001, 0.00001]))


def test_the_schedule_gives_the_matrices_of_any_speed():
    speeds = np.array([-40.0, -0.1, 0.0, 1e-3, 7.0, 18.8, 22.0, 99.0])
    scheduled = build(model="linear", front=FRONT, rear=REAR)
    steps = along(speeds, front=FRONT, rear=REAR)
    assert steps.steps == len(speeds)
    for k, speed in enumerate(speeds, 1):
        x = jnp.asarray([1.0, 2.0, 0.3, speed])
        one, other = scheduled.at(k, x, jnp.zeros(2)), steps.at(k, x, jnp.zeros(2))
        for a, b in zip(one, other, strict=True):
            # interpolated between -100 and 100 m/s: rounding of 1 = 100 dt
            np.testing.assert_allclose(a, b, rtol=0, atol=2e-16)
    stopped = scheduled.at(1, jnp.zeros(4), jnp.zeros(2))
    np.testing.assert_array_equal(stopped.G[:, 0], np.zeros(4))


@pytest.mark.parametrize("kind", ["linear", "nonlinear"])
def test_limits_are_on_command_plus_attack(kind):
    """An attack beyond its limit in delta is beyond the linear model's limit in beta."""
    plant = build(model=kind, front=FRONT, rear=REAR, steering=0.6, acceleration=2.0)
    mapped = slip if kind == "linear" else float
    for command in (-0.5, 0.0, 0.3):
        for accel in (-1.0, 0.0, 1.5):
            u = np.array([mapped(command), accel])
            rows, bound = plant.constraints.attack.at(1, jnp.asarray(u))
            for total, allowed in ((0.599, True), (0.601, False), (-0.599, True), (-0.601, False)):
                d = np.array([mapped(total) - u[0], 1.99 - accel])
                assert np.all(np.asarray(rows) @ d <= np.asarray(bound)) == allowed
            d = np.array([0.0, -2.01 - accel])
            assert not np.all(np.asarray(rows) @ d <= np.asarray(bound))


def test_the_papers_limits_on_the_state():
    rows, bound = build().constraints.state.at(1, jnp.zeros(2))
    inside = [[0, 0, 9, 0], [20, 5, -9, 22], [3, 4, 0, 1]]
    outside = [[-0.1, 1, 0, 1], [20.1, 1, 0, 1], [1, 5.1, 0, 1], [1, -0.1, 0, 1], [1, 1, 0, 22.1],
               [1, 1, 0, -0.1]]  # fmt: skip
    for x in inside:
        assert np.all(np.asarray(rows) @ np.array(x, float) <= bound)
    for x in outside:
        assert not np.all(np.asarray(rows) @ np.array(x) <= bound)


def test_limits_may_be_left_out():
    """No steering limit: beta stays under the 90 degrees that no steering exceeds."""
    plant = build(model="linear", length=np.inf, steering=np.inf, acceleration=np.inf)
    attack = plant.constraints.attack.at(1, jnp.zeros(2))[1]
    np.testing.assert_allclose(attack, [np.pi / 2, np.pi / 2, np.inf, np.inf], rtol=1e-15)
    assert plant.constraints.state.at(1, jnp.zeros(2))[1][0] == np.inf


def test_a_standing_car_hides_its_steering():
    """At v = 0 exactly, and only there, the slip attack is undetermined; nothing divides by v."""
    speeds = np.array([2.0, 1.0, 0.0, -1.0, 0.0, 0.0, 1.0, 3.0])
    plant = along(speeds)
    rng = np.random.default_rng(2)
    y = rng.normal(size=(8, 4)) * 0.1
    u, seen = np.zeros((8, 2)), np.ones((8, 4), bool)
    got = estimates(unknown_input.build(plant, np.zeros(4), np.eye(4)), u, y, seen)
    hidden = np.isinf(got.d_cov[:, 0, 0])
    np.testing.assert_array_equal(hidden, speeds == 0.0)
    words = [Status(int(s)).words for s in got.status]
    assert [("UNOBSERVABLE" in word) for word in words] == hidden.tolist()
    assert np.all(got.d[hidden, 0] == 0)
    assert np.all(np.isfinite(got.x))
    assert np.all(np.isfinite(got.x_cov))
    # the acceleration is seen at any speed
    assert np.all(np.isfinite(got.d_cov[:, 1, 1]))


SCENARIO = """
[plant]
kind = "bicycle"
model = "{model}"
dt = 0.02
front = 1.2
rear = 1.7
steering = 0.5
sensor_variance = [0.02, 0.02, 0.001, 1e-4]

[estimator]
kind = "unknown_input"
x0 = [0.0, 2.0, 0.0, 10.0]
P0 = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]

[detector]
kind = "chi_square"
threshold = "paper"
"""


KINDS = {"linear": LinearPlant, "nonlinear": NonlinearPlant}


@pytest.mark.parametrize("model", KINDS)
def test_a_scenario_gives_the_plant_of_its_keys(tmp_path, model):
    file = tmp_path / "scenario.toml"
    file.write_text(SCENARIO.format(model=model))
    found = read_scenario(file).scenario.plant
    noise = [0.02, 0.02, 0.001, 1e-4]
    truth = build(model=model, dt=0.02, front=1.2, rear=1.7, steering=0.5, sensor_variance=noise)
    assert isinstance(found, KINDS[model])
    assert found.attacks == truth.attacks
    assert found.dt == 0.02
    x, u, d = jnp.asarray([1.0, 2.0, 0.1, 8.0]), jnp.asarray([0.1, 1.0]), jnp.asarray([0.2, -1.0])
    moved = found.transition(1, x, u, d)
    np.testing.assert_array_equal(moved, truth.transition(1, x, u, d))
    limits = (plant.constraints.attack.at(1, u)[1] for plant in (found, truth))
    np.testing.assert_array_equal(*limits)
    np.testing.assert_array_equal(found.noise(1, x, u)[1], np.diag(noise))


def test_the_template_is_the_papers_vehicle(tmp_path):
    file = tmp_path / "scenario.toml"
    file.write_text(scenario_text("bicycle"))
    found, truth = read_scenario(file).scenario.plant, build()
    x, u = jnp.asarray([1.0, 2.0, 0.1, 8.0]), jnp.asarray([0.1, 1.0])
    np.testing.assert_array_equal(found.transition(1, x, u, u), truth.transition(1, x, u, u))
    for one, other in zip(found.noise(1, x, u), truth.noise(1, x, u), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("dt", 0.0),
        ("front", -1.0),
        ("rear", np.inf),
        ("steering", 0.0),
        ("acceleration", -3.5),
        ("length", np.nan),
        ("top_speed", 0.0),
    ],
)
@pytest.mark.parametrize("kind", ["linear", "nonlinear"])
def test_a_setting_without_meaning_is_refused_by_its_name(kind, key, value):
    with pytest.raises(InvalidValue, match=key):
        build(model=kind, **{key: value})


@pytest.mark.parametrize("noise", [[0.1, 0.1, 0.1], [0.1, 0.1, 0.1, -1.0]])
def test_four_variances_are_needed(noise):
    with pytest.raises(InvalidValue):
        build(process_variance=noise)
