"""`l1_decoder` against windows written out as one regression, exact recovery, and what errs.

One shape (two states, six sensors, four rows of 24) serves nearly all: plants are traced, so that
every norm is compiled once.
"""

import csv
import io
import sys
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from decoding import ROWS, SIZES, A, B, C, D, Log, T, followed, hopping, log, plant, window
from holdfast.estimators import l1_decoder
from holdfast.estimators.decoder_keys import check_decoder
from holdfast.numerics.group_regression import group_regression
from holdfast.numerics.l0_regression import l0_regression
from holdfast.numerics.l1_regression import l1_regression
from holdfast.parts import InvalidValue
from holdfast.plants.linear import Table
from holdfast.records import Status
from holdfast.shell import cli
from systems import quiet_plant

PLANT = plant()
EXACT = 1e-9
"""Of noise-free states: rounding of samples of 10 times conditions of 100."""
FULL = slice(T - 1, None)
"""The rows from which the window is full."""
P = 6


def has(status, bit):
    return (np.asarray(status) & int(bit)) > 0


def build(of=PLANT, **settings):
    return l1_decoder.build(of, np.zeros(len(of.states)), np.eye(len(of.states)),
                            **({"window": T} | settings))  # fmt: skip


def exactly(got, of: Log, rows=FULL):
    np.testing.assert_allclose(got.x[rows], of.x[rows], rtol=0, atol=EXACT)


@cache
def numerics(norm):
    """The regression itself, on what a test writes out."""
    if norm == "l1":
        return jax.jit(l1_regression)
    sensors = tuple(range(P)) * T
    if norm in ("l1l2", "l1linf"):
        return jax.jit(
            lambda *given: group_regression(given[0], given[1], sensors, norm, *given[2:])
        )
    units = sensors if norm == "fixed" else tuple(range(P * T))
    return jax.jit(lambda *given: l0_regression(given[0], given[1], units, *given[2:], nodes=2000))


def decoded(of, given: Log, k, seen=None, trusted=None, norm="l1", weight=None):
    """The state at row k by the regression written out."""
    at = window(of, given, k)
    rows = slice(k - T, k)
    seen = np.ones(P * T, bool) if seen is None else seen[rows].reshape(-1)
    exact = np.zeros(P * T, bool) if trusted is None else trusted[rows].reshape(-1)
    weight = np.ones(P * T) if weight is None else weight
    found = numerics(norm)(at.Phi, np.where(seen, at.y, 0.0), weight * seen, exact & seen)
    return at.last @ np.asarray(found.x) + at.moved


# ---- without noise


@pytest.mark.parametrize("size", [1e-3, 5.0, 1e6])
def test_hopping_attacks_are_found_exactly(size):
    """The ratio of the largest sample of each row to the others is 1/2 at most, so one attacked
    sample a row is corrected, by as much as it is off. Known inputs (B and D) are removed."""
    rng = np.random.default_rng(1)
    of = log(PLANT, hopping(rng, size=size))
    state, got = followed(build(), of)
    np.testing.assert_allclose(got.x[FULL], of.x[FULL], rtol=0, atol=EXACT * max(1.0, 1e-3 * size))
    np.testing.assert_allclose(got.a[FULL], of.a[FULL], rtol=0, atol=EXACT * max(1.0, size))
    assert np.all(got.a[FULL][of.a[FULL] == 0] == 0)
    assert not np.any(got.status[FULL])
    # the whole window, oldest row first
    np.testing.assert_allclose(state.attack[-1], of.a[-T:], atol=EXACT * max(1.0, size))
    np.testing.assert_array_equal(state.attacked[-1], of.a[-T:] != 0)
    assert np.all(state.found[FULL] == 1)


def test_the_ratio_of_this_plant():
    """By brute force over directions: what the test above says."""
    Phi = window(PLANT, log(PLANT), T).Phi.reshape(T, P, 2)
    angle = np.linspace(0, np.pi, 2001)
    size = np.abs(Phi @ np.stack([np.cos(angle), np.sin(angle)]))
    most = size.max(1).sum(0)
    assert np.max(most / (size.sum((0, 1)) - most)) <= 0.5 + 1e-9


def test_without_inputs_it_is_the_same():
    """The same attacks on a plant that nobody drives, from the state that inputs lead to."""
    rng = np.random.default_rng(2)
    a = hopping(rng)
    driven = log(PLANT, a)
    left = log(PLANT, a, u=np.zeros((ROWS, 1)))
    of_driven, of_left = (followed(build(), of)[0] for of in (driven, left))
    np.testing.assert_allclose(of_driven.attack[FULL], of_left.attack[FULL], atol=EXACT)
    np.testing.assert_array_equal(of_driven.attacked[FULL], of_left.attacked[FULL])


def test_under_feedback():
    """u = -K x: with A and the known u, and with A - B K and none (errata 5)."""
    K = np.array([[4.0, 3.0]])
    rng = np.random.default_rng(3)
    of = log(PLANT, hopping(rng), u=lambda x: -K @ x)
    exactly(followed(build(), of)[1], of)
    # D u is -D K x of the row before: the outputs of the closed loop without D
    closed = plant(A=A - B @ K, B=np.zeros((2, 1)), D=np.zeros((6, 1)))
    exactly(followed(build(closed), of._replace(y=of.y - of.u @ D.T))[1], of)
    # with A and no u it is wrong
    wrong = followed(build(), of._replace(u=0.0 * of.u))[1]
    assert np.max(np.abs(wrong.x - of.x)[T:8]) > 1e-2


# ---- until the window is full


def test_not_ready_until_the_window_is_full():
    """x is then x0 moved on by the inputs, its variance unknown."""
    of = log(PLANT)
    got = followed(build(), of)[1]
    np.testing.assert_array_equal(has(got.status, Status.NOT_READY), np.arange(ROWS) < T - 1)
    x = np.zeros(2)
    for k in range(T - 1):
        x = A @ x + B @ of.u[k]
        np.testing.assert_allclose(got.x[k], x, atol=1e-15)
        np.testing.assert_array_equal(got.x_cov[k], np.diag([np.inf, np.inf]))
        assert not got.a[k].any()
        assert not got.residual[k].any()
    assert np.all(np.isfinite(got.x_cov[FULL]))


# ---- with noise, each row by the regression itself


def uneven():
    """Noise, attacks, gaps, faults."""
    rng = np.random.default_rng(4)
    of = log(PLANT, hopping(rng), noise=1.0, seed=4)
    seen = rng.random((ROWS, P)) > 0.25
    y = np.where(rng.random((ROWS, P)) < 0.05, np.nan, of.y)
    return of, of._replace(y=y), seen, seen & np.isfinite(y)


def test_samples_that_did_not_arrive():
    """Dropped: as the smaller regression has it. NaN is as if nothing had arrived."""
    clean, of, seen, used = uneven()
    got = followed(build(), of, seen)[1]
    for k in range(T, ROWS + 1):
        expected = decoded(PLANT, clean, k, used)
        np.testing.assert_allclose(got.x[k - 1], expected, atol=EXACT)
        assert not got.residual[k - 1][~used[k - 1]].any()
        assert not got.a[k - 1][~used[k - 1]].any()
        assert not got.residual_cov[k - 1][~used[k - 1]].any()
    np.testing.assert_array_equal(has(got.status, Status.MISSING), np.any(~seen, 1))
    bad = np.any(seen & np.isnan(of.y), 1)
    np.testing.assert_array_equal(has(got.status, Status.BAD_INPUT), bad)


def test_a_gap_of_all_sensors():
    """Rows 9 to 14 bring nothing: the window runs dry, says so, and fills again; in between x is
    of least norm as a first state, moved on."""
    rng = np.random.default_rng(5)
    of = log(PLANT, hopping(rng))
    seen = np.ones((ROWS, P), bool)
    seen[8:14] = False
    got = followed(build(), of, seen)[1]
    lost = has(got.status, Status.UNOBSERVABLE)
    np.testing.assert_array_equal(lost[FULL], np.isin(np.arange(1, ROWS + 1), (12, 13, 14))[FULL])
    known = np.flatnonzero(~lost)[T - 1 :]
    # of row 11 and of row 15 the window has one row with samples: six, of which one is attacked
    exactly(got, of, known)
    assert np.all(np.isinf(np.diagonal(got.x_cov[lost], axis1=1, axis2=2)))
    for k in (12, 13, 14):
        np.testing.assert_allclose(got.x[k - 1], window(PLANT, of, k).moved, atol=EXACT)


# ---- what is authenticated


def test_trusted_samples_are_met_first():
    """By the log's flag, wherever they are; they are never called attacked."""
    rng = np.random.default_rng(6)
    of = log(PLANT, hopping(rng), noise=1.0, seed=6)
    seen, trusted = rng.random((ROWS, P)) > 0.1, rng.random((ROWS, P)) < 0.06
    state, got = followed(build(), of, seen, trusted)
    for k in range(T, ROWS + 1):
        expected = decoded(PLANT, of, k, seen, trusted)
        np.testing.assert_allclose(got.x[k - 1], expected, atol=EXACT)
    assert not np.any(got.a[trusted])
    assert not np.any(state.attack[-1][trusted[-T:]])


def test_one_trusted_sensor_by_its_name():
    """As if the log flagged all its samples; both sensors of a state are then outvoted."""
    rng = np.random.default_rng(7)
    a = np.zeros((ROWS, P))
    a[:, 2] = a[:, 4] = 10.0 + rng.normal(size=ROWS)  # two of three sensors of the first state
    of = log(PLANT, a)
    plain = followed(build(), of)[1]
    assert np.max(np.abs(plain.x - of.x)[FULL]) > 5.0
    by_name = followed(build(trusted=["y1"]), of)[1]
    exactly(by_name, of)
    flags = np.broadcast_to(np.arange(P) == 0, (ROWS, P))
    by_flag = followed(build(), of, None, flags)[1]
    np.testing.assert_allclose(by_name.x, by_flag.x, atol=1e-12)
    np.testing.assert_allclose(by_name.x_cov, by_flag.x_cov, atol=1e-12)


# ---- what the window does not show


def test_an_unseen_direction():
    """No sensor sees the second state, which drives nothing: the smallest first state, inf."""
    blind = plant(A=np.diag([0.9, 0.8]), C=C * np.array([1.0, 0.0]))
    of = log(blind, u=np.zeros((ROWS, 1)))
    got = followed(build(blind), of)[1]
    assert np.all(has(got.status, Status.UNOBSERVABLE)[FULL])
    np.testing.assert_allclose(got.x[FULL, 0], of.x[FULL, 0], atol=EXACT)
    np.testing.assert_allclose(got.x[FULL, 1], 0.0, atol=EXACT)
    spread = np.diagonal(got.x_cov[FULL], axis1=1, axis2=2)
    assert np.all(np.isinf(spread[:, 1]))
    assert np.all(np.isfinite(spread[:, 0]))


def test_a_direction_that_dies_out_is_no_loss():
    """Singular A: what no row sees of the first state does not reach the last."""
    dying = plant(A=np.array([[0.9, 0.0], [0.5, 0.0]]), C=C * np.array([1.0, 0.0]))
    assert np.linalg.matrix_rank(window(dying, log(dying), T).Phi) == 1
    rng = np.random.default_rng(8)
    a = hopping(rng)
    a[:, 1::2] = 0.0  # these sensors see nothing, and tell what is added to them
    of = log(dying, a)
    got = followed(build(dying), of)[1]
    exactly(got, of)
    assert not np.any(got.status[FULL])
    assert np.all(np.isfinite(got.x_cov[FULL]))


# ---- per-step plants, scheduled plants


def varying(rng):
    """Every matrix another in every row."""
    turn = [A + 0.1 * rng.normal(size=(2, 2)) for _ in range(ROWS)]
    more = [C + 0.05 * rng.normal(size=(P, 2)) for _ in range(ROWS)]
    return plant(
        A=np.array(turn), C=np.array(more), B=np.array([k * B / ROWS for k in range(ROWS)]),
        R=np.array([SIZES["R"] * (1 + k) for k in range(ROWS)]),
    )  # fmt: skip


def test_per_step_plants():
    """Exact under hopping attacks; a constant plant written per step is the constant one."""
    rng = np.random.default_rng(9)
    of_plant = varying(rng)
    of = log(of_plant, hopping(rng))
    exactly(followed(build(of_plant), of)[1], of)
    each = {name: np.broadcast_to(m, (ROWS, *m.shape)) for name, m in
            (("A", A), ("B", B), ("C", C), ("R", SIZES["R"]))}  # fmt: skip
    _, of, seen, _ = uneven()
    constant, stepped = (followed(build(p), of, seen)[1] for p in (PLANT, plant(**each)))
    for name in ("x", "x_cov", "residual", "residual_cov", "a"):
        a, b = getattr(constant, name), getattr(stepped, name)
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(constant.status, stepped.status)


@pytest.mark.parametrize("by", ["u1", pytest.param("x2", marks=pytest.mark.slow)])
def test_scheduled_plants(by):
    """On the input; and on the decoder's own state, which is the true one after x0 as well."""
    grid = jnp.asarray([-4.0, 0.0, 4.0])
    rng = np.random.default_rng(10)
    tables = {
        "A": Table(grid, jnp.asarray([A - 0.1, A, A + 0.1])),
        "C": Table(grid, jnp.asarray([C, C + 0.05, C + 0.1])),
    }
    of_plant = plant(**tables, scheduling=by)
    of = log(of_plant, hopping(rng), x0=(0.0, 0.0))
    exactly(followed(build(of_plant), of)[1], of)


# ---- weights and norms


def test_weights_after_the_noise():
    """1 / sd of every sample as a statement on the last state, written out densely."""
    noisy = plant(Q=np.array([[0.02, 0.01], [0.01, 0.05]]))
    of = log(noisy, hopping(np.random.default_rng(11)), noise=1.0, seed=11)
    got = followed(build(noisy, weights="noise"), of)[1]
    M = np.linalg.matrix_power(A, T - 1)
    into = np.zeros((T * P, 2 * (T - 1)))
    for j in range(1, T):  # the step into row j
        at_last = np.linalg.matrix_power(A, T - 1 - j)
        for i in range(T):
            through = np.linalg.matrix_power(A, i - j) if i >= j else np.zeros((2, 2))
            back = np.linalg.matrix_power(A, i) @ np.linalg.solve(M, at_last)
            into[i * P : (i + 1) * P, 2 * j - 2 : 2 * j] = C @ (through - back)
    cov = into @ np.kron(np.eye(T - 1), noisy.Q) @ into.T + np.kron(np.eye(T), noisy.R)
    weight = 1 / np.sqrt(np.diagonal(cov))
    for k in range(T, ROWS + 1):
        expected = decoded(noisy, of, k, weight=weight)
        np.testing.assert_allclose(got.x[k - 1], expected, atol=EXACT)
    plain = followed(build(noisy), of)[1]
    assert np.max(np.abs(got.x - plain.x)[FULL]) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("norm", ["l1l2", "l1linf"])
def test_norms_per_sensor(norm):
    """One sensor attacked all the time, with gaps: the regression of the numerics; and without
    noise exact, where the sum of absolute values is as well, whatever the attack."""
    rng = np.random.default_rng(12)
    a = np.zeros((ROWS, P))
    a[:, 3] = 20.0 * rng.normal(size=ROWS)
    of, seen = log(PLANT, a, noise=1.0, seed=12), rng.random((ROWS, P)) > 0.1
    trusted = rng.random((ROWS, P)) < 0.03
    got = followed(build(norm=norm, threshold=5.0), of, seen, trusted)[1]
    for k in range(T, ROWS + 1):
        expected = decoded(PLANT, of, k, seen, trusted, norm=norm)
        np.testing.assert_allclose(got.x[k - 1], expected, atol=1e-8)
    assert not np.any(got.status[FULL] & ~int(Status.MISSING))
    spread = np.diagonal(got.x_cov[FULL], axis1=1, axis2=2)
    assert np.all(np.isfinite(spread)) if norm == "l1l2" else np.all(np.isinf(spread))
    clean = log(PLANT, a)
    exactly(followed(build(norm=norm, threshold=5.0), clean)[1], clean)


@pytest.mark.parametrize("positions", ["hopping", pytest.param("fixed", marks=pytest.mark.slow)])
def test_the_fewest(positions):
    """Exact search: the numerics' own answer, count and threshold; without noise the truth."""
    rng = np.random.default_rng(13)
    a = np.zeros((ROWS, P))
    if positions == "fixed":
        a[:, 4] = 3.0 + rng.normal(size=ROWS)
    else:
        a = hopping(rng, size=3.0)
    of, trusted = log(PLANT, a, noise=1.0, seed=13), rng.random((ROWS, P)) < 0.03
    trusted &= a == 0
    built = build(norm="l0", positions=positions, threshold=5.0)
    state, got = followed(built, of, None, trusted)
    half = np.tile(5.0 * np.sqrt(np.diagonal(SIZES["R"])), T)
    for k in range(T, ROWS + 1):
        at, flags = window(PLANT, of, k), trusted[k - T : k].reshape(-1)
        norm = "fixed" if positions == "fixed" else "hopping"
        truth = numerics(norm)(at.Phi, at.y, half, np.ones(P * T, bool), flags)
        np.testing.assert_allclose(got.x[k - 1], at.last @ truth.x + at.moved, atol=1e-8)
        assert state.count[k - 1] == truth.count
    assert not np.any(got.status[FULL])
    # without noise, and without a tolerance for it
    clean = log(PLANT, a)
    state, got = followed(build(norm="l0", positions=positions), clean)
    exactly(got, clean)
    assert np.all(state.count[FULL] == (1 if positions == "fixed" else T))


def test_ambiguous():
    """Two pairs of sensors, each of which agrees on a state: both are listed, as states at the
    row."""
    pair = plant(C=np.vstack([np.eye(2)] * 2 + [np.zeros((2, 2))]), D=np.zeros((P, 1)))
    of, other = log(pair), log(pair, x0=(4.0, 1.0))
    y = np.where(np.isin(np.arange(P), (2, 3)), other.y, of.y)
    state, got = followed(build(pair, norm="l0", positions="hopping"), of._replace(y=y))
    assert np.all(has(got.status, Status.AMBIGUOUS)[FULL])
    assert np.all(state.found[FULL] >= 2)
    for k in range(T - 1, ROWS):
        listed = state.states[k][: state.found[k]]
        for x in (of.x[k], other.x[k]):
            assert np.min(np.max(np.abs(listed - x), 1)) < EXACT


# ---- who shouts is believed


SHOUTED = {"A": [[1.0]], "C": [[100.0], [1.0], [1.0]], "Q": [[1e-6]], "R": np.eye(3) * 1e-4}


@pytest.mark.slow
def test_the_condition_for_l0_does_not_guarantee_l1():
    """Errata 1: C = (100, 1, 1)', x = 1, sensor 1 attacked by -100 in every row: l0 is certain
    to correct one sensor, and gives 1; l1 gives 0."""
    shouted = quiet_plant(**SHOUTED)
    y = np.tile([0.0, 1.0, 1.0], (6, 1))
    of = Log(np.zeros((6, 0)), y, np.ones((6, 1)), y - [100.0, 1.0, 1.0])
    for norm, x in (("l1", 0.0), ("l0", 1.0)):
        got = followed(build(shouted, norm=norm, window=3), of)[1]
        np.testing.assert_allclose(got.x[2:, 0], x, atol=1e-10)
        # l1 accuses the two honest ones
        accused = [0.0, 1.0, 1.0] if norm == "l1" else [-100.0, 0.0, 0.0]
        np.testing.assert_allclose(got.a[2:], np.tile(accused, (4, 1)), atol=1e-10)
        assert not np.any(got.status[2:])


SCENARIO = """
[plant]
kind = "linear"
dt = 0.1
A = [[1.0]]
C = [[100.0], [1.0], [1.0]]
Q = [[1e-6]]
R = [[1e-4, 0, 0], [0, 1e-4, 0], [0, 0, 1e-4]]
outputs = ["loud", "b", "c"]

[estimator]
kind = "l1_decoder"
window = 3
norm = "NORM"

[detector]
kind = "chi_square"
level = 0.01
threshold = "paper"
"""


@pytest.mark.slow
def test_the_same_on_the_command_line(tmp_path, monkeypatch, capsys):
    """`holdfast replay` on the written log: x empty until the window is full, then 0, or 1."""
    log_file = tmp_path / "log.csv"
    rows = "".join(f"{k / 10:.1f},0.0,1.0,1.0\n" for k in range(1, 7))
    log_file.write_text("time,y:loud,y:b,y:c\n" + rows)
    for norm, x in (("l1", 0.0), ("l0", 1.0)):
        scenario = tmp_path / f"{norm}.toml"
        scenario.write_text(SCENARIO.replace("NORM", norm))
        monkeypatch.setattr(sys, "argv", ["holdfast", "replay", str(scenario), str(log_file)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        assert not ended.value.code, err
        found = list(csv.DictReader(io.StringIO(out)))
        assert [row["x:x1"] for row in found[:2]] == ["", ""]
        assert all(row["status"] == "NOT_READY" for row in found[:2])
        assert all(row["status"] == "OK" for row in found[2:])
        np.testing.assert_allclose([float(row["x:x1"]) for row in found[2:]], x, atol=1e-10)


# ---- thresholds


def test_attacks_under_the_threshold_are_noise():
    """`a` is what is left over five standard deviations of v, sensor by sensor, else 0."""
    rng = np.random.default_rng(14)
    of = log(PLANT, hopping(rng), noise=1.0, seed=14)
    none, five = (followed(build(threshold=level), of) for level in (0.0, 5.0))
    sd = np.sqrt(np.diagonal(SIZES["R"]))
    np.testing.assert_allclose(none[1].x, five[1].x, atol=1e-12)
    left = none[0].attack[FULL][:, -1]
    np.testing.assert_allclose(
        five[1].a[FULL], np.where(np.abs(left) > 5 * sd, left, 0.0), atol=1e-12
    )
    np.testing.assert_allclose(none[1].a[FULL], np.where(np.abs(left) > 1e-8, left, 0.0), atol=1e-9)
    np.testing.assert_array_equal(five[0].attacked, np.abs(five[0].attack) > 5 * sd)
    big = np.abs(of.a[FULL]) > 1.5  # well over five deviations of 0.14
    assert np.all(five[1].a[FULL][big] != 0)


# ---- the covariance


@pytest.mark.slow
@pytest.mark.parametrize("weights", ["none", "noise"])
def test_without_attack_the_covariance_is_honest(weights):
    """e' P^-1 e over 4000 rows of the whole window of 15 rows: 2 to the accuracy of the first
    order, some 10 % at 90 samples."""
    noisy = plant(Q=np.diag([1e-5, 1e-4]))
    of = log(noisy, noise=1.0, rows=4000, seed=15)
    got = followed(build(noisy, weights=weights, window=15), of)[1]
    rows = slice(15, None, 5)
    e, cov = (got.x - of.x)[rows], got.x_cov[rows]
    nees = np.einsum("ki,ki->k", e, np.linalg.solve(cov, e[..., None])[..., 0])
    print(f"{weights}: {nees.mean():.3f} of 2")
    assert abs(nees.mean() / 2 - 1) < 0.2
    honest = got.residual[rows] ** 2 / np.diagonal(got.residual_cov[rows], axis1=1, axis2=2)
    print(f"residuals {honest.mean():.3f} of 1")
    assert abs(honest.mean() - 1) < 0.1


# ---- keys


@pytest.mark.parametrize(("key", "value"), [
    ("window", 0), ("threshold", -1.0), ("threshold", np.nan), ("positions", "fixed"),
    ("trusted", ["gps"]), ("nodes", 0),
])  # fmt: skip
def test_keys_that_cannot_be(key, value):
    with pytest.raises(InvalidValue) as caught:
        build(**{key: value})
    assert caught.value.key == key


@pytest.mark.parametrize(
    ("key", "value"), [("weights", "equal"), ("norm", "l2"), ("positions", "everywhere")]
)
def test_words_that_cannot_be(key, value):
    """The run-time types of the tests would refuse them before the builder does."""
    keys = {"window": T, "weights": "none", "threshold": 0.0, "norm": "l0", "positions": None,
            "nodes": 1}  # fmt: skip
    with pytest.raises(InvalidValue) as caught:
        check_decoder(PLANT, **(keys | {key: value}))
    assert caught.value.key == key


def test_a_plant_that_is_not_linear():
    with pytest.raises(InvalidValue, match="plant: found int, expected a linear plant"):
        check_decoder(1, T, "none", 0.0, "l1", None, 1)


def test_a_window_in_which_powers_overflow():
    with pytest.raises(InvalidValue, match="window"):
        build(plant(A=1e200 * A), window=4)


def test_the_default_window_is_as_long_as_there_are_states():
    assert l1_decoder.build(PLANT).window.length == 2


def by_highs(Phi, y):
    m, n = Phi.shape
    rows = np.block([[Phi, -np.eye(m)], [-Phi, -np.eye(m)]])
    cost = np.r_[np.zeros(n), np.ones(m)]
    return linprog(cost, rows, np.r_[y, -y], bounds=[(None, None)] * n + [(0, None)] * m).fun


def test_no_state_has_a_smaller_sum():
    """HiGHS on the window written out, to its 1e-7."""
    of = log(PLANT, hopping(np.random.default_rng(16)), noise=1.0, seed=16)
    state, _ = followed(build(), of)
    for k in range(T, ROWS + 1, 4):
        at = window(PLANT, of, k)
        assert np.sum(np.abs(state.attack[k - 1])) <= by_highs(at.Phi, at.y) * (1 + 1e-7)
