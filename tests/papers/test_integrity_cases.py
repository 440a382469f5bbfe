"""INTEGRITY's case studies against dense computations; every verdict turned by other inputs."""

import equinox as eqx
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from holdfast.papers import integrity_circle as circle
from holdfast.papers import integrity_dcacc as dcacc
from holdfast.papers import integrity_figures as studies
from holdfast.papers import integrity_vehicle as vehicle
from holdfast.plants.library import dcacc as dcacc_plant
from holdfast.plants.library import vehicle_tracking
from holdfast.reach.forever import Highest
from holdfast.records import Enforcement
from holdfast.report.paper_figures import png

pytestmark = pytest.mark.slow

OPPOSITE = {
    "holds": "fails", "fails": "holds", "reproduced": "not reproduced",
    "not reproduced": "reproduced",
}  # fmt: skip


def steady(plant):
    """The filter (2) to (4) by running its Riccati recursion."""
    A, C, Q, R = (np.asarray(m) for m in (plant.A, plant.C, plant.Q, plant.R))
    ahead = Q
    for _ in range(3_000):
        spread = C @ ahead @ C.T + R
        K = np.linalg.solve(spread, C @ ahead).T
        ahead = A @ (ahead - K @ C @ ahead) @ A.T + Q
    return A, C, K, spread


def bound(k, p, beta):
    """The alpha of (47), by the distribution itself."""
    limit = 2 * chi2.isf(beta, p) + k * p
    allowed = chi2.sf(limit, k * p) + vehicle.EPSILON
    return np.sqrt(brentq(lambda c: ncx2.sf(limit, k * p, c) - allowed, 1e-9, 1e3, xtol=1e-14))


def dense(plant, enforced, k, t, beta):
    """Y_k of (59) with the constraint at t, by (44), (45) and Theta_t of (49), all written out."""
    A, C, K, Q = steady(plant)
    n, p = K.shape
    F = A - K @ C @ A
    kept = [i * p + j for i in range(t) for j in range(p) if i + 1 not in enforced]

    def M(steps):
        rows = [np.linalg.matrix_power(F, steps - 1 - i) @ K for i in range(steps)]
        return np.hstack([*rows, np.zeros((n, p * (t - steps)))])

    theta = 0
    for i in range(1, t + 1):
        N = -C @ A @ M(i - 1)
        N[:, (i - 1) * p : i * p] += np.eye(p)
        theta = theta + N[:, kept].T @ np.linalg.solve(Q, N[:, kept])
    Mk = M(k)[:, kept]
    return bound(t, p, beta) ** 2 * Mk @ np.linalg.solve(theta, Mk.T)


@pytest.fixture(scope="module")
def tracking():
    run = vehicle.drive(vehicle.Amount(steps=20, blocks=12, ever=(), ratios=(0.02, 0.0266)))
    return run._replace(ever=((3, 0.617), (4, 0.705)))


@pytest.fixture(scope="module")
def following():
    plant = dcacc_plant.build()
    held, spaced, free = (
        dcacc.reach(dcacc.asked(plant, "sprt", policy), steps)
        for policy, steps in ((dcacc.policy(), 200), (dcacc.SPACED, 220), (None, 700))
    )
    return dcacc.Run(plant, held, spaced, free, Highest(0.536, 69), ((0.01, 914.5),))


@pytest.fixture(scope="module")
def little():
    """One second on the circle, two seeds, a quarter of it attacked: (plan, errors) by case."""
    first, steps = 31, 25
    found = {}
    never = Enforcement.of([1] * 4, 0, 1)
    for name, policy in (("free", None), ("held", Enforcement.of([10] * 4, 1, 10))):
        attack = circle.planned(first * 0.01, (first + steps) * 0.01, None, policy)
        for case, plan in (("calm", 0.0 * attack.attack.plan), ("hit", attack.attack.plan)):
            given = eqx.tree_at(lambda w: w.attack.plan, attack, plan)
            x, said, _ = circle.simulated(
                given, policy or never, circle.watched(circle.PLANT), 2, 100
            )
            found[name, case] = np.asarray(plan), x - said
    return first, found


@pytest.fixture(scope="module")
def turning():
    return circle.drive(circle.Amount(seeds=2, seconds=12.0))


@pytest.mark.parametrize(
    ("every", "k", "t"),
    [(None, 4, 4), (None, 12, 12), (20, 19, 20), (20, 33, 40), (30, 29, 30), (35, 35, 35)],
)
def test_the_vehicle_by_the_dense_matrix(tracking, every, k, t):
    enforced = set() if every is None else set(range(every, t + 1, every))
    Y = dense(vehicle_tracking.build(), enforced, k, t, vehicle.BETA)
    found = tracking.summed[every]
    assert found.horizon[k - 1] == t
    np.testing.assert_allclose(found.shape[k - 1], Y, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(found.norm[k - 1], np.sqrt(np.linalg.eigvalsh(Y)[-1]), rtol=1e-8)


@pytest.mark.parametrize(
    ("name", "enforced", "k", "t"),
    [
        ("free", set(), 11, 11), ("free", set(), 22, 22),
        ("held", {20, 21}, 11, 21), ("spaced", {21, 22}, 11, 22), ("spaced", {21, 22}, 22, 22),
        ("held", {20, 21, 40, 41}, 39, 41),
    ],
)  # fmt: skip
def test_the_cruise_control_by_the_dense_matrix(following, name, enforced, k, t):
    Y = dense(dcacc_plant.build(), enforced, k, t, dcacc.BETA)
    found = getattr(following, name)
    assert found.horizon[k - 1] == t
    scale = np.sqrt(np.diag(Y))
    np.testing.assert_allclose(found.shape[k - 1] / np.outer(scale, scale),
                               Y / np.outer(scale, scale), atol=1e-7)  # fmt: skip


def test_the_first_step_against_a_test_of_every_step(tracking):
    """|e_1| = |K z| with |z| in the norm of Q^-1 at most alpha."""
    _, _, K, Q = steady(vehicle_tracking.build())
    h = chi2.isf(vehicle.BETA, 2)
    over = vehicle.BETA + vehicle.EPSILON
    alpha = np.sqrt(brentq(lambda c: ncx2.sf(h, 2, c) - over, 1e-9, 10, xtol=1e-14))
    wanted = alpha * np.linalg.norm(K @ np.linalg.cholesky(Q), 2)
    np.testing.assert_allclose(tracking.single[None].norm[0], wanted, rtol=1e-6)


def test_errors_go_with_the_root_of_the_noise():
    """What `ratio_of` and the notes on dCACC rest on."""
    one, four = (
        vehicle.reach(vehicle.asked(plant, "sprt", 20), 60).norm
        for plant in (vehicle_tracking.build(process_noise=q, sensor_noise=r)
                      for q, r in ((0.3, 10.0), (1.2, 40.0)))
    )  # fmt: skip
    np.testing.assert_allclose(four, 2.0 * one, rtol=1e-9)
    ratio, least, most = vehicle.ratio_of(0.0266)
    assert least < 10.144 < most
    inside = vehicle_tracking.build(process_noise=ratio * 0.5 * (least + most),
                                    sensor_noise=0.5 * (least + most))  # fmt: skip
    free = vehicle.reach(vehicle.asked(inside, "sprt"), 4).norm
    assert free[2] <= vehicle.LIMIT < free[3]


@pytest.mark.slow
def test_the_noise_at_the_limit():
    sensor = 0.01
    process = dcacc.at_limit(dcacc_plant.build(), sensor)
    plant = dcacc_plant.build(process_noise=process, sensor_noise=(sensor, sensor))
    top = np.max(dcacc.reach(dcacc.asked(plant, "sprt", dcacc.policy()), 60).norm)
    assert 0.99 * dcacc.LIMIT < top <= dcacc.LIMIT


def test_the_circle_is_kept_without_noise():
    """Both equations of (62) with an acceleration that turns along, and the speed asked for."""
    course = circle.circle(400)
    A, B = (np.asarray(m) for m in (circle.PLANT.A, circle.PLANT.B))
    pushed = course[1:] - course[:-1] @ A.T
    u, left, *_ = np.linalg.lstsq(B, pushed.T, rcond=None)
    assert np.max(left) < 1e-20
    np.testing.assert_allclose(np.linalg.norm(u, axis=0), 3.14**2 / 100, rtol=1e-3)
    np.testing.assert_allclose(np.hypot(course[:, 0], course[:, 2]), 100.0)
    np.testing.assert_allclose(np.hypot(course[:, 1], course[:, 3]), 3.14, rtol=1e-6)


def test_with_the_same_noise_the_errors_differ_by_what_is_predicted(little):
    """(10) and (11) step by step from what was planned; each seed, and so their mean."""
    first, found = little
    A, C, K, _ = steady(circle.PLANT)
    for name in ("free", "held"):
        plan, hit = found[name, "hit"]
        gap = hit - found[name, "calm"][1]
        assert not np.any(gap[:, : first - 1])
        e = np.zeros(4)
        for k in range(first, gap.shape[1] + 1):
            a = plan[k - first] if k < first + len(plan) else np.zeros(4)
            e = (A - K @ C @ A) @ e - K @ a
            np.testing.assert_allclose(gap[:, k - 1], np.tile(e, (2, 1)), atol=1e-9)
            np.testing.assert_allclose(np.mean(gap[:, k - 1], 0), e, atol=1e-9)
        assert np.max(np.abs(gap)) > 0.5
    assert not np.any(found["held", "hit"][0][10 - first % 10 :: 10])


@pytest.mark.slow
def test_the_course_of_figure_6_is_what_is_predicted(turning):
    calm = turning.error[circle.CASES[0]]
    for case in circle.CASES[1:]:
        found, wanted = turning.error[case] - calm, turning.shift[case]
        scale = np.max(np.abs(wanted))
        np.testing.assert_allclose(found, np.broadcast_to(wanted, found.shape), atol=1e-9 * scale)
        assert not np.any(wanted[: turning.first - 1])


@pytest.mark.slow
def test_both_attacks_are_stealthy_and_nearly_all_they_can_be(turning):
    for case in circle.CASES[1:]:
        assert np.max(turning.size[case]) <= 1 + 1e-9
    last = turning.size[circle.CASES[2]][-2 * circle.EVERY :]
    assert np.min(last) > 0.9
    enforced = np.arange(circle.EVERY, len(turning.shift[circle.CASES[2]]) + 1, circle.EVERY)
    # where the samples are authenticated the error only follows the filter: e = (A - K C A) e
    A, C, K, _ = steady(circle.PLANT)
    e = turning.shift[circle.CASES[2]]
    np.testing.assert_allclose(e[enforced - 1], e[enforced - 2] @ (A - K @ C @ A).T, atol=1e-9)


def by_id(rows):
    return {row.id: row for row in rows}


def test_the_vehicles_rows(tracking):
    found = (
        vehicle.limit(), vehicle.noise(tracking), vehicle.figure_4(tracking),
        vehicle.figure_4_per_step(tracking), vehicle.figure_5(tracking),
        vehicle.figure_5_later(tracking), vehicle.figure_5_per_step(tracking),
        vehicle.for_ever(tracking), vehicle.algorithm_1(tracking), vehicle.share(),
    )  # fmt: skip
    rows = by_id(found)
    assert {id: row.verdict for id, row in rows.items()} == {id: VEHICLE[id] for id in rows}
    assert VEHICLE.keys() - rows.keys() == {"Section VI-A"}
    assert rows["Fig. 4"].ours == 4
    assert rows["Fig. 4, per step"].ours == 8
    np.testing.assert_allclose(rows["Fig. 5"].ours, [0.609, 0.683, 0.716], atol=6e-4)
    np.testing.assert_allclose(rows["Fig. 5, later blocks"].ours[1], 0.816, atol=6e-4)
    assert rows["Fig. 5, for ever"].ours == 3


def test_the_cruise_controls_rows(following):
    found = (
        dcacc.limit(), dcacc.noise(following), dcacc.figure_7(following),
        dcacc.figure_7_later(following), dcacc.figure_7_per_step(following),
        dcacc.figure_7_without(following), dcacc.figure_8(following),
        dcacc.figure_8_contained(following), dcacc.share(), dcacc.algorithm_1(following),
        dcacc.structure(following.plant),
    )  # fmt: skip
    rows = by_id(found)
    assert {id: row.verdict for id, row in rows.items()} == {id: DCACC[id] for id in rows}
    assert DCACC.keys() - rows.keys() == {"Section VI-B, attackable"}
    assert rows["Section VI-B"].ours == [2, 2, 2]
    assert round(rows["Section VI-B, threshold"].ours, 3) == 3.351


def scaled(run, field, by):
    """A run of the vehicle with other errors."""
    kept = {L: one._replace(norm=one.norm * by) for L, one in getattr(run, field).items()}
    return run._replace(**{field: kept})


def still(found):
    """The same set at every step: the last, which has no direction without extent."""
    return found._replace(shape=np.broadcast_to(found.shape[-1], found.shape.shape))


def test_other_numbers_turn_the_vehicles_verdicts(tracking):
    small, large = (scaled(scaled(tracking, "summed", by), "single", by) for by in (0.3, 5.0))
    soon = tracking.single[None]._replace(norm=np.array([0.1, 0.2, 0.3, 0.8]))
    fixed = tracking._replace(summed={L: still(one) for L, one in tracking.summed.items()})
    for turned in (
        vehicle.figure_4(large),
        vehicle.figure_4_per_step(tracking._replace(single={None: soon})),
        vehicle.figure_5(small),
        vehicle.figure_5_later(small),
        vehicle.figure_5_per_step(small),
        vehicle.for_ever(tracking._replace(ever=((29, 0.5), (30, 0.6), (31, 0.8)))),
        vehicle.algorithm_1(fixed),
    ):
        assert turned.verdict == OPPOSITE[VEHICLE[turned.id]], turned.id


def test_other_numbers_turn_the_cruise_controls_verdicts(following):
    run = following
    larger = run.held._replace(norm=run.held.norm * 1e3)
    for turned in (
        dcacc.figure_7(run._replace(held=larger)),
        dcacc.figure_7_later(run._replace(held=larger)),
        dcacc.figure_7_per_step(run._replace(ever=None)),
        dcacc.figure_7_without(run._replace(free=run.held)),
        dcacc.figure_8(run._replace(free=still(run.free))),
        dcacc.figure_8_contained(run._replace(free=run.free._replace(shape=run.free.shape / 99))),
        dcacc.algorithm_1(run._replace(held=still(run.held))),
    ):
        assert turned.verdict == OPPOSITE[DCACC[turned.id]], turned.id


@pytest.mark.slow
def test_other_numbers_turn_the_circles_verdicts(turning):
    _, free, held = circle.CASES
    off = turning._replace(deviation={**turning.deviation, held: 9 * turning.deviation[held]})
    near = turning._replace(shift={**turning.shift, held: 0.1 * turning.shift[held]})
    loud = turning._replace(alarm={**turning.alarm, free: ~turning.alarm[free]})
    for function, other in (
        (circle.figure_6, off), (circle.under_limit, near), (circle.paired, near),
        (circle.alarms, loud),
    ):  # fmt: skip
        row = function(turning)
        assert row.verdict == CIRCLE[row.id]
        assert function(other).verdict == OPPOSITE[row.verdict]


def test_the_figures_show_what_the_run_says(tracking, following, little):
    first, found = little
    cases = dict.fromkeys(circle.CASES, found["held", "hit"][1])
    nothing = dict.fromkeys(circle.CASES, np.zeros(1))
    turned = circle.Run(cases, cases, nothing, nothing, nothing, first)
    drawn = studies.figures(studies.Run(tracking, turned, following))
    assert list(drawn) == [f"integrity-figure-{i}" for i in range(4, 9)]
    assert all(len(png(figure)) > 10_000 for figure in drawn.values())
    lines = {line.get_label(): line.get_ydata()
             for line in drawn["integrity-figure-5"].axes[0].get_lines()}  # fmt: skip
    np.testing.assert_array_equal(lines["L = 30"][:90], tracking.summed[30].norm[:90])
    assert np.all(lines["threshold"] == vehicle.LIMIT)
    assert drawn["integrity-figure-6"].axes[0].get_aspect() == 1.0


def test_an_ellipse_is_the_border_of_the_projection(following):
    shape = following.free.shape[21]
    border = studies.ellipse(shape[np.ix_([0, 1], [0, 1])])
    direction = np.array([0.3, -1.0])
    reached = np.max(border @ direction)
    wide = np.array([*direction, 0.0])
    np.testing.assert_allclose(reached, np.sqrt(wide @ shape @ wide), rtol=1e-3)


VEHICLE = {
    "Section VI-A": "holds", "Section VI-A, threshold": "holds", "Section VI-A, noise": "unstated",
    "Fig. 4": "holds", "Fig. 4, per step": "fails", "Fig. 5": "holds",
    "Fig. 5, later blocks": "fails", "Fig. 5, per step": "fails", "Fig. 5, for ever": "fails",
    "Section V-B, termination, vehicle": "fails", "Section VI-A, share": "holds",
}  # fmt: skip
CIRCLE = {
    "Fig. 6": "reproduced", "Fig. 6, largest expected error": "fails",
    "Fig. 6, expected error": "holds", "Fig. 6, alarms": "holds",
}  # fmt: skip
DCACC = {
    "Section VI-B": "holds", "Section VI-B, attackable": "holds",
    "Section VI-B, threshold": "holds", "Section VI-B, noise": "unstated", "Fig. 7": "holds",
    "Fig. 7, later blocks": "holds", "Fig. 7, for ever": "holds",
    "Fig. 7, without enforcement": "holds", "Fig. 8": "holds", "Fig. 8, contained": "holds",
    "Section VI-B, share": "holds", "Section V-B, termination, dCACC": "fails",
}  # fmt: skip
REST = {
    "Fig. 1": "proof read only", "Fig. 2": "proof read only", "Fig. 3": "proof read only",
    "Section VI, third study": "unstated",
}  # fmt: skip


@pytest.mark.whole
@pytest.mark.slow
def test_the_whole_of_it():
    rows = by_id(studies.rows())
    assert {id: row.verdict for id, row in rows.items()} == VEHICLE | CIRCLE | DCACC | REST
    seconds, calm, held = rows["Fig. 6"].ours
    assert 3 < seconds < 6
    assert calm < held < 1.25 * calm
    assert 1.9 < rows["Fig. 6, largest expected error"].ours < 2.6
