"""CARE against plain Algorithm 1, enumeration and batch least squares; sets that are empty."""

import numpy as np
import pytest
from scipy.optimize import minimize

import care_oracle
import oracles
import systems
from holdfast.estimators import care, unknown_input
from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.records import Status
from systems import estimates

STEPS = 30


def box(n: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    return np.vstack([np.eye(n), -np.eye(n)]), np.full(2 * n, size)


def limited(system: systems.System, state=None, attack=None):
    """The plant of a random system, inputs left out, under polytopes (rows, bound)."""
    A, _, C, _, G, H, Q, R = systems.matrices(system.plant)
    sets = {
        name: {"matrix": limits[0], "bound": limits[1]}
        for name, limits in (("state", state), ("attack", attack))
        if limits is not None
    }
    return linear_plant(A=A, C=C, G=G, H=H, Q=Q, R=R, constraints=sets)


def log(seed: int, plant, steps: int = STEPS):
    rng = np.random.default_rng(seed)
    ny = len(plant.outputs)
    return np.zeros((steps, 0)), 2.0 * rng.normal(size=(steps, ny)), np.ones((steps, ny), bool)


@pytest.mark.parametrize("shape", [(4, 4, 2, 0), (3, 3, 3, 0)])
def test_feedback_is_algorithm_1(shape):
    """The paper's recursion, corrected by the errata, in plain NumPy. 1e-9: inverses there."""
    active = 0
    for seed in range(3):
        system = systems.random_system(seed, *shape)
        state, attack = box(shape[0], 1.0), box(shape[2], 0.8)
        plant = limited(system, state, attack)
        u, y, seen = log(seed, plant)
        got = estimates(care.build(plant, system.x0, system.P0), u, y, seen)
        A, _, C, _, G, _, Q, R = systems.matrices(plant)
        truth = care_oracle.care(
            [A] * STEPS, [G] * STEPS, C, Q, R, system.x0, system.P0, y, state, attack
        )
        for name in truth._fields:
            want = getattr(truth, name)
            scale = max(1.0, np.abs(want).max())
            np.testing.assert_allclose(getattr(got, name), want, atol=1e-9 * scale, err_msg=name)
        active += np.sum(np.abs(got.x) > 1 - 1e-9)
        assert np.all(got.status == 0)
    assert active > 50


def test_a_face_has_no_variance_left():
    """Rank n less the active rows, exactly: sd 0 on a face of the box, not 1e-9."""
    system = systems.random_system(1, 4, 4, 2, 0)
    plant = limited(system, box(4, 0.5), box(2, 0.5))
    got = estimates(care.build(plant, system.x0, system.P0), *log(1, plant))
    on_face = np.abs(np.abs(got.x) - 0.5) < 1e-12
    assert on_face.any()
    assert not on_face.all()
    np.testing.assert_array_equal(np.diagonal(got.x_cov, axis1=1, axis2=2) == 0, on_face)


@pytest.mark.parametrize("shape", [(4, 4, 2, 1), (4, 4, 2, 2)])
def test_output_is_the_projection_of_the_free_estimate(shape):
    """Attacks into the outputs too. The filter runs on unprojected; points by enumeration."""
    system = systems.random_system(2, *shape)
    state, attack = box(4, 1.0), box(2, 0.8)
    plant = limited(system, state, attack)
    u, y, seen = log(2, plant)
    got = estimates(care.build(plant, system.x0, system.P0, project="output"), u, y, seen)
    free = estimates(unknown_input.build(plant, system.x0, system.P0), u, y, seen)
    np.testing.assert_array_equal(got.d_free, free.d)
    np.testing.assert_array_equal(got.d_free_cov, free.d_cov)
    np.testing.assert_array_equal(got.residual, free.residual)
    # row 1 is left out where the attack before it leaves the state undetermined
    for k in range(3, STEPS):
        for value, cov, found, found_cov, limits in (
            (free.x[k], free.x_cov[k], got.x[k], got.x_cov[k], state),
            (free.d[k], free.d_cov[k], got.d[k], got.d_cov[k], attack),
        ):
            point, spread = care_oracle.project(value, cov, *limits)
            np.testing.assert_allclose(found, point, atol=1e-10)
            np.testing.assert_allclose(found_cov, spread, atol=1e-10 * np.abs(cov).max())


def test_feedback_carries_what_is_correlated_with_the_state():
    """H != 0: x_1 and d_1 are correlated, so a face that holds x_1 moves d_1 as well.

    Truth: batch least squares with the active faces of row 1 as measurements of deviation
    1e-7, which leaves 1e-6.
    """
    rows, bound = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]]), np.array([-0.5, -0.5])
    for seed in range(20):
        system = systems.random_system(seed, 4, 4, 2, 2)
        plant = limited(system, (rows, bound))
        u, y, seen = log(seed, plant, 2)
        got = estimates(care.build(plant, system.x0, system.P0), u, y, seen)
        active = np.abs(rows @ got.x[0] - bound) < 1e-9
        if not active.any():
            continue
        A, B, C, _, G, H, Q, R = systems.matrices(plant)
        count = active.sum()
        C_more = np.vstack([C, rows[active]])
        H_more = np.vstack([H, np.zeros((count, 2))])
        R_more = np.zeros((4 + count, 4 + count))
        R_more[:4, :4], R_more[4:, 4:] = R, 1e-14 * np.eye(count)
        y_more = np.hstack([y, np.tile(bound[active], (2, 1))])
        seen_more = np.hstack([seen, [[True] * count, [False] * count]])
        m = (A, B, C_more, np.zeros((4 + count, 0)), G, H_more, Q, R_more)
        truth = oracles.batch_estimate(m, system.x0, system.P0, u, y_more, seen_more)
        free = care_oracle.project(
            truth.value[:4].astype(float), truth.cov[:4, :4].astype(float), rows, bound
        )
        np.testing.assert_allclose(got.x[1], free[0], atol=1e-6)
        np.testing.assert_allclose(got.d_free[1], truth.value[6:8].astype(float), atol=1e-6)
        return
    raise AssertionError("no seed met a face")


def flat(bound, *, rows=((1.0,), (-1.0,)), side="attack", **settings):
    """One state, one attack, limits on one of them."""
    plant = linear_plant(
        A=[[0.9]], C=[[1], [1]], G=[[1]], Q=[[0.1]], R=np.eye(2),
        constraints={side: {"matrix": np.array(rows), "bound": np.asarray(bound, float)}},
    )  # fmt: skip
    rng = np.random.default_rng(7)
    y = rng.normal(size=(6, 2))
    arguments = np.zeros((6, 0)), y, np.ones((6, 2), bool)
    free = estimates(unknown_input.build(plant, [0], [[1]]), *arguments)
    return estimates(care.build(plant, [0], [[1]], **settings), *arguments), free


def words(got) -> list[str]:
    return [Status(int(s)).words for s in got.status]


@pytest.mark.parametrize(
    ("project", "side"), [("feedback", "state"), ("output", "attack"), ("moments", "state")]
)
def test_limits_that_contradict_each_other_leave_the_free_estimate(project, side):
    """Bounds that move: rows 3 and 4 ask for z <= -1 and z >= 1."""
    bound = np.full((6, 2), 50.0)
    bound[2:4] = -1.0
    got, free = flat(bound, side=side, project=project)
    assert words(got) == ["OK", "OK", "INFEASIBLE", "INFEASIBLE", "OK", "OK"]
    for name in ("x", "x_cov", "d", "d_cov"):
        np.testing.assert_allclose(getattr(got, name), getattr(free, name), atol=1e-12)


def test_the_nearest_to_contradictory_limits_shares_the_violation():
    """z <= -1 and z >= 3: the middle, 1, violates both by as much; z <= -inf helps nobody."""
    got, _ = flat([-1.0, -3.0], side="state", fallback="nearest")
    assert set(words(got)) == {"INFEASIBLE"}
    np.testing.assert_allclose(got.x[:, 0], 1.0, atol=1e-6)


def test_an_equality_is_two_opposite_rows():
    got, _ = flat([0.25, -0.25], side="state")
    assert set(words(got)) == {"OK"}
    np.testing.assert_allclose(got.x[:, 0], 0.25, rtol=1e-12)
    np.testing.assert_array_equal(got.x_cov, 0.0)


def test_no_bound_and_no_row():
    """+inf is no bound; a row of zeros either always holds or never."""
    got, free = flat([np.inf, np.inf])
    np.testing.assert_array_equal(got.d, free.d)
    got, free = flat([1.0, 0.5], rows=((0.0,), (0.0,)))
    np.testing.assert_array_equal(got.d, free.d)
    assert set(words(got)) == {"OK"}
    got, free = flat([1.0, -0.5], rows=((0.0,), (0.0,)))
    np.testing.assert_array_equal(got.d, free.d)
    assert set(words(got)) == {"INFEASIBLE"}


@pytest.mark.slow
@pytest.mark.parametrize(("project", "delay"), [("feedback", 0), ("output", 1), ("moments", 1)])
def test_limits_of_what_is_undetermined_do_not_act(project, delay):
    """A cart seen by its position: the push and the speed are undetermined in their own row."""
    plant = linear_plant(
        A=[[1, 0.1], [0, 1]], C=[[1, 0]], G=[[0], [0.1]], Q=1e-3 * np.eye(2), R=[[0.01]],
        constraints={
            "state": {"matrix": [[1, 0], [0, 1]], "bound": [0.0, 0.0]},
            "attack": {"matrix": [[1], [-1]], "bound": [0.5, 0.5]},
        },
    )  # fmt: skip
    rng = np.random.default_rng(0)
    given = np.zeros((10, 0)), 1.0 + rng.normal(size=(10, 1)), np.ones((10, 1), bool)
    estimator = care.build(plant, [0, 0], np.eye(2), project=project, delay=delay)
    got = estimates(estimator, *given)
    assert np.all(np.isfinite(got.x))
    assert np.all(np.isinf(got.x_cov[1:, 1, 1]))
    assert np.all(got.x[:, 0] <= 1e-9)
    assert np.all(np.isinf(got.d_cov[1:]) == (delay == 0))
    assert np.all(np.abs(got.d) <= 0.5 + 1e-9)
    if delay:
        assert np.any(np.abs(got.d_free) > 0.6)


def test_a_delayed_attack_is_held_to_the_limits_of_its_own_time():
    """The bound moves; row k gives the attack of k-2 and lays the limit of row k-1 on it."""
    bound = np.linspace(0.1, 2.0, 12)[:, None]
    plant = linear_plant(
        A=[[1, 0.1], [0, 1]], C=[[1, 0]], G=[[0], [0.1]], Q=1e-3 * np.eye(2), R=[[0.01]],
        constraints={"attack": {"matrix": [[1]], "bound": bound}},
    )  # fmt: skip
    y = 0.5 * (0.1 * np.arange(12)[:, None]) ** 2 * 50.0  # an acceleration of 50
    estimator = care.build(plant, [0, 0], 1e-6 * np.eye(2), delay=1)
    got = estimates(estimator, np.zeros((12, 0)), y, np.ones((12, 1), bool))
    assert np.all(got.d_free[3:, 0] > 5.0)
    np.testing.assert_allclose(got.d[3:, 0], bound[2:-1, 0], rtol=1e-12)


def test_projection_is_what_a_general_solver_finds():
    """A polytope that is no box, by SLSQP (accurate to about 1e-6)."""
    rng = np.random.default_rng(4)
    rows, bound = rng.normal(size=(5, 3)), rng.uniform(0.05, 0.3, 5)
    system = systems.random_system(6, 3, 3, 1, 0)
    plant = limited(system, (rows, bound))
    u, y, seen = log(6, plant, 12)
    got = estimates(care.build(plant, system.x0, system.P0, project="output"), u, y, seen)
    free = estimates(unknown_input.build(plant, system.x0, system.P0), u, y, seen)
    for k in range(12):
        weight = np.linalg.inv(free.x_cov[k])
        found = minimize(
            lambda z, w=weight, c=free.x[k]: (z - c) @ w @ (z - c),
            np.zeros(3),
            jac=lambda z, w=weight, c=free.x[k]: 2 * w @ (z - c),
            constraints={"type": "ineq", "fun": lambda z: bound - rows @ z, "jac": lambda z: -rows},
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 200},
        )
        np.testing.assert_allclose(got.x[k], found.x, atol=1e-5)


def test_settings_are_checked():
    system = systems.random_system(0, 3, 3, 1, 0)
    with pytest.raises(InvalidValue, match="delay"):
        care.build(system.plant, system.x0, system.P0, delay=-1)
    rows = np.tile(np.eye(3), (5, 1, 1))
    plant = limited(system, (rows, np.ones(3)))
    with pytest.raises(InvalidValue, match="moments"):
        care.build(plant, system.x0, system.P0, project="moments")
    with pytest.raises(InvalidValue, match="NaN"):
        limited(system, (np.eye(3), np.array([1.0, np.nan, 1.0])))
