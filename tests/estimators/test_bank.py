"""Filters that share what they can, against one NISE per mode; where the two part company."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp

import banks
import oracles
import systems
from holdfast.detectors import chi_square
from holdfast.estimators import nise, nisme
from holdfast.loop import Monitor, replay
from holdfast.plants.build import linear_plant
from holdfast.plants.linear import Table
from holdfast.plants.switched import switched_plant
from holdfast.records import Observation, Status


def squares(estimate, row):
    """Statistic and degrees of freedom of the residual of a row, noise variances being near 1."""
    values, vectors = np.linalg.eigh(estimate.residual_cov[row])
    kept = values > 1e-9 * max(1.0, values[-1])
    found = vectors[:, kept].T @ estimate.residual[row]
    return found @ (found / values[kept]), float(kept.sum())


def check_nise(plant, modes, observations, x0, P0, tolerance=1e-9):
    """State and covariance of every filter at every row, and the record of the mode believed.

    Both recursions are exact; 1e-9 is a thousand times what rounding leaves of the worst.
    """
    n = len(plant.states)
    built = nisme.build(plant, x0, P0, modes=modes, floor=0.1, attack_prior_sd=[0.5, 2.0, 3.0])
    state, got = jax.tree.map(np.asarray, banks.ran(built, observations))
    believed = set()
    for number, mode in enumerate(modes):
        one = nise.build(plant, x0, P0, mode=mode)
        truth = jax.tree.map(np.asarray, banks.ran(one, observations)[1])
        s, j = np.asarray(built.places[number])
        Z = state.kept.Z[:, s, j, :n]
        cov = state.kept.P[:, s] + Z @ np.swapaxes(Z, 1, 2)
        rows = np.flatnonzero(got.mode == number)
        believed |= {number} if len(rows) else set()
        pairs = [(state.means.x[:, s, j], truth.x), (cov, truth.x_cov)]
        for name in ("x", "x_cov", "d", "d_cov"):
            pairs.append((getattr(got, name)[rows], getattr(truth, name)[rows]))
        for ours, theirs in pairs:
            finite = np.isfinite(theirs)
            np.testing.assert_array_equal(np.isfinite(ours), finite)
            size = max(1.0, np.max(np.abs(theirs[finite]), initial=0.0))
            np.testing.assert_allclose(ours[finite], theirs[finite], rtol=0, atol=tolerance * size)
        # residuals blind to the attack in other coordinates: the same chi-square
        for row in rows[np.all(observations.seen[rows], 1)]:
            ours, theirs = (squares(e, row) for e in (got, truth))
            assert ours == pytest.approx(theirs, rel=1e-6, abs=1e-9)
        np.testing.assert_array_equal(got.status[rows], truth.status[rows])
    return believed


def test_every_filter_is_the_nise_of_its_mode():
    plant = banks.plant_of(0, 3, 4)
    believed = check_nise(plant, banks.MODES, banks.observed(0, plant, 40), np.ones(3), np.eye(3))
    assert len(believed) > 1


@pytest.mark.slow
@pytest.mark.parametrize(("n", "ny"), [(3, 4), (11, 5), (10, 5)])
def test_filters_of_small_and_large_plants_are_the_nise_of_their_modes(n, ny):
    """Up to n = 10 every mode for itself; above, one factorisation for all and Z kept short,
    which may cost a part of 1e-6 in the covariance before a row says so (`nisme.LOST`).
    """
    for seed in range(1, 6):
        plant = banks.plant_of(seed, n, ny)
        tolerance = 1e-9 if n <= 10 else 1e-6
        observations = banks.observed(seed, plant, 60)
        check_nise(plant, banks.MODES, observations, np.ones(n), np.eye(n), tolerance)


@pytest.mark.slow
def test_matrices_that_move_with_time_or_a_schedule():
    rng = np.random.default_rng(3)
    still, moving = banks.plant_of(3, 3, 4), {}
    for name in "ACGHQR":
        m = np.asarray(getattr(still, name))
        moving[name] = m * (1 + 0.1 * rng.random(40))[:, None, None]
    plant = banks.plant_of(3, 3, 4, **moving)
    check_nise(plant, banks.MODES, banks.observed(3, plant, 40), np.ones(3), np.eye(3))
    grid = jnp.array([-3.0, 3.0])
    tables = {
        name: Table(grid, jnp.stack([np.asarray(getattr(still, name)) * f for f in (1.0, 1.2)]))
        for name in "ACGH"
    }
    plant = banks.plant_of(3, 3, 4, **tables, inputs=["u1"], scheduling="u1")
    check_nise(plant, banks.MODES, banks.observed(4, plant, 40), np.ones(3), np.eye(3))


@pytest.mark.slow
def test_switch_positions_are_plants_of_their_own():
    """The filters of a position are those of the plant that is always in it, and so is their
    evidence, whose common part is not common to all positions.
    """
    base = banks.plant_of(6, 3, 4)
    A, B, C, D, G, H, Q, R = map(jnp.asarray, systems.matrices(base))
    factor = jnp.array([1.0, 0.5])
    plant = switched_plant(
        lambda x, u, d, j: factor[j] * (A @ x) + B @ u + G @ d,
        lambda x, u, d, j: C @ x / factor[j] + D @ u + H @ d,
        positions=["closed", "open"], Q=Q, R=R, dt=1.0, states=base.states, inputs=base.inputs,
        outputs=base.outputs, attacks=banks.NAMES,
    )  # fmt: skip
    tables = [{"attacks": m, "switch": p} for p in ("closed", "open") for m in banks.MODES[:3]]
    u, y, _ = systems.random_log(6, base, 30)
    built = nisme.build(plant, np.ones(3), np.eye(3), modes=tables, floor=1e-290)
    state = jax.tree.map(np.asarray, banks.ran(built, banks.log(u, y)))[0]
    evidence = []
    for number, entry in enumerate(tables):
        f = float(factor[plant.positions.index(entry["switch"])])
        alone = banks.plant_of(6, 3, 4, A=f * np.asarray(A), C=np.asarray(C) / f)
        model = banks.linear(alone, entry["attacks"])
        rows = oracles.algorithm_1(model, np.ones(3), np.eye(3), np.ones(3), u, y)
        s, j = np.asarray(built.places[number])
        truth = np.array([row.x for row in rows])
        size = max(1.0, np.max(np.abs(truth)))
        np.testing.assert_allclose(state.means.x[:, s, j], truth, rtol=0, atol=1e-9 * size)
        evidence.append([row.kalman for row in rows])
    total = np.cumsum(np.array(evidence).T, 0)
    wanted = total - logsumexp(total, axis=1, keepdims=True)
    clear = wanted.min(1) > -600  # above the floor
    assert clear[:5].all()
    np.testing.assert_allclose(state.log_p[clear], wanted[clear], rtol=0, atol=1e-8)


@pytest.mark.slow
def test_an_authenticated_output_clears_only_who_alone_could_falsify_it():
    """A trusted sample that two channels could have falsified arrives as it was sent; that one of
    them is 0 does not follow, and the other output still shows it.
    """
    plant = linear_plant(
        A=[[0.9]], C=[[1], [1], [1]], H=[[1, 1], [0, 1], [0, 0]], Q=[[0.1]], R=np.eye(3)
    )
    y = np.zeros((10, 3))
    y[:, 1] = 50.0
    trusted = np.zeros(y.shape, bool)
    trusted[:, 0] = True
    observations = banks.log(np.zeros((10, 0)), y, None, trusted)
    wanted = {("d1",): (0.0, 0.0), ("d2",): (0.0, 0.0), ("d1", "d2"): (np.inf, 1.5)}
    for mode, (first, second) in wanted.items():
        got = banks.ran(nisme.build(plant, [0], [[1]], modes=[list(mode)]), observations)[1]
        spread = np.diag(got.d_cov[-1])
        assert spread[0] == first
        assert spread[1] <= second
    assert got.d[-1, 1] == pytest.approx(50.0, abs=1e-9)
    assert got.x[-1, 0] == pytest.approx(0.0, abs=1e-9)


def errors(estimator, A, C, G, H, Q, R, P0, steps):
    """How far x is off at the last row, for a unit of everything that can happen: noises (their
    square is the covariance of the error), and every attack at every row.
    """
    n, (ny, nd) = len(A), H.shape
    none, whole = jnp.zeros((steps, 0)), jnp.ones((steps, ny), bool)
    fine = jnp.zeros(steps, jnp.int32)
    sizes = [n, *steps * [n, ny], *(steps + 1) * [nd]]
    roots = [P0, *steps * [Q, R]]
    noise, total = sum(sizes[: 1 + 2 * steps]), sum(sizes)
    parts = np.split(np.eye(total), np.cumsum(sizes)[:-1])
    happened = [np.linalg.cholesky(c) @ p for c, p in zip(roots, parts, strict=False)]
    happened += parts[1 + 2 * steps :]
    x, d, y = happened[0], happened[1 + 2 * steps :], []
    for k in range(steps):
        x = A @ x + G @ d[k] + happened[1 + 2 * k]
        y.append(C @ x + H @ d[k + 1] + happened[2 + 2 * k])

    @jax.jit
    @jax.vmap
    def last(y):
        return banks.ran(estimator, Observation(none, y, whole, ~whole, fine))[1].x[-1]

    off = np.asarray(last(jnp.moveaxis(jnp.asarray(y), 2, 0))).T - x
    return off[:, :noise], off[:, noise:]


@pytest.mark.slow
@pytest.mark.parametrize("case", ["outputs", "states", "both"])
def test_attacks_that_cannot_be_told_apart_do_not_bend_the_state(case):
    """Two channels with one effect: which of them it is stays open, what it does does not.

    The state is unbiased whatever the attack, and its covariance the true one. It is the best
    one, NISE's, unless the two also move the state differently: what NISE then knows of their
    sum from the row before, a bank does not use.
    """
    rng = np.random.default_rng(1)
    A, C = np.diag([0.9, 0.5, -0.4]) + 0.1 * rng.normal(size=(3, 3)), rng.normal(size=(4, 3))
    g, h, free = rng.normal(size=(3, 1)), rng.normal(size=(4, 1)), rng.normal(size=(3, 2))
    alike = np.array([[1.0, -2.0]])
    G, H = {
        "outputs": (0 * free, h * alike), "states": (g * alike, 0 * h * alike),
        "both": (free, h * alike),
    }[case]  # fmt: skip
    Q, R, P0 = (systems.covariance(rng, m) for m in (3, 4, 3))
    plant = linear_plant(A=A, C=C, G=G, H=H, Q=Q, R=R)
    built = nisme.build(plant, np.zeros(3), P0, modes=[["d1", "d2"]], attack_prior_sd=0.1)
    noise, attacked = errors(built, A, C, G, H, Q, R, P0, 4)
    # next to an effect of one unit, a hundred times the variance the mode's prior would have
    np.testing.assert_allclose(attacked, 0, rtol=0, atol=1e-11)
    nothing = banks.log(np.zeros((4, 0)), np.zeros((4, 4)))
    got = banks.ran(built, nothing)[1]
    np.testing.assert_allclose(got.x_cov[-1], noise @ noise.T, rtol=1e-9, atol=1e-9)
    best = banks.ran(nise.build(plant, np.zeros(3), P0), nothing)[1]
    assert bool(got.status[-1] & int(Status.UNOBSERVABLE)) == (case != "both")
    ratio = float(jnp.trace(got.x_cov[-1]) / jnp.trace(best.x_cov[-1]))
    assert ratio > 1.01 if case == "both" else ratio == pytest.approx(1, abs=1e-9)


@pytest.mark.slow
def test_an_attack_that_its_row_cannot_see_has_its_prior():
    """C G = 0: NISE leaves the speed open; a filter of the bank takes the attack for N(0, sd^2),
    row by row, says so, and agrees with NISE about what is seen.
    """
    plant = linear_plant(
        A=[[1, 0.1], [0, 1]], C=[[1, 0]], G=[[0], [0.1]], Q=1e-3 * np.eye(2), R=[[0.01]]
    )
    rng = np.random.default_rng(2)
    observations = banks.log(np.zeros((20, 0)), rng.normal(size=(20, 1)))
    for sd in (1.0, 1e4):
        built = nisme.build(plant, [0, 0], np.eye(2), modes=[["d1"]], attack_prior_sd=sd)
        got = jax.tree.map(np.asarray, banks.ran(built, observations)[1])
        assert {Status(int(s)).words for s in got.status} == {"UNOBSERVABLE+HIDDEN_INPUT"}
        assert np.all(np.isinf(got.d_cov[:, 0, 0]))
        # at least what the last push adds, which no sample has felt yet
        assert np.all(got.x_cov[:, 1, 1] > 0.01 * sd**2)
    truth = banks.ran(nise.build(plant, [0, 0], np.eye(2)), observations)[1]
    # what a prior of 10 per cm beside a noise of 0.1 still adds to a push that is free
    np.testing.assert_allclose(got.x[:, 0], truth.x[:, 0], rtol=0, atol=1e-5)


HARD = {
    "plain": {}, "P0 = 0": {"P0": 0.0}, "P0 = 1e8": {"P0": 1e8}, "P0 = 1e12": {"P0": 1e12},
    "R = 1e-16": {"R": 1e-16}, "Q = 0": {"Q": 0.0}, "Q = P0 = 0": {"Q": 0.0, "P0": 0.0},
    "sd = 1e-12": {"sd": 1e-12}, "sd = 1e12": {"sd": 1e12}, "attack 1e9": {"y": 1e9},
    "y = 1e100": {"y": 1e100}, "nothing arrives": {"seen": 0.0}, "half arrives": {"seen": 0.5},
    "low floor": {"floor": 5e-324}, "high floor": {"floor": 0.2499}, "unstable": {"A": 2.0},
    "blind": {"C": 0.0}, "alike": {"alike": 1.0},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("freeze", [0.0, 1e-3])
@pytest.mark.parametrize("likelihood", ["evidence", "paper", "quadratic"])
def test_hard_cases_stay_finite(likelihood, freeze):
    """Probabilities that add up to 1, no NaN, no negative variance, never DIVERGED."""
    for name, case in HARD.items():
        base = banks.plant_of(9, 3, 4)
        factors = {key: case.get(key, 1.0) for key in "ACQR"}
        given = {key: np.asarray(getattr(base, key)) * f for key, f in factors.items()}
        if "R" in case:
            given["R"] = case["R"] * np.eye(4)
        if "alike" in case:
            given["H"] = np.asarray(base.H)[:, [0, 1, 1]]
        plant = banks.plant_of(9, 3, 4, **given)
        u, y, _ = systems.random_log(9, plant, 40)
        seen = np.random.default_rng(9).random(y.shape) < case.get("seen", 1.0)
        built = nisme.build(
            plant, np.zeros(3), case.get("P0", 1.0) * np.eye(3), modes=banks.MODES, freeze=freeze,
            likelihood=likelihood, floor=case.get("floor", 1e-4),
            attack_prior_sd=case.get("sd", 1.0),
        )  # fmt: skip
        monitor = Monitor(built, chi_square.build(plant, on="residual"))
        y = case.get("y", 1.0) * y
        got = jax.tree.map(np.asarray, replay(monitor, banks.log(u, y, seen)).estimate)
        for part in ("x", "d", "residual", "residual_cov", "p"):
            assert np.all(np.isfinite(getattr(got, part))), (name, part)
        assert not np.any(np.isnan(got.x_cov) | np.isnan(got.d_cov)), name
        for cov in (got.x_cov, got.d_cov):
            assert np.all(np.diagonal(cov, axis1=1, axis2=2) >= 0), name
        np.testing.assert_allclose(got.p.sum(1), 1.0, rtol=0, atol=1e-12, err_msg=name)
        assert not np.any(got.status & int(Status.DIVERGED)), name


@pytest.mark.slow
@pytest.mark.parametrize(("n", "ny"), [(3, 4), (11, 5)])
def test_noise_that_rounding_hides_leaves_no_nan(n, ny):
    """P up to 1e36 times the noise: digits are lost, not the filter."""
    for seed, R, P0, Q, C in itertools.product(
        (1, 2), (1e-16, 1e-6), (1.0, 1e12), (1.0, 0.0), (1.0, 1e4)
    ):
        base = banks.plant_of(seed, n, ny)
        plant = banks.plant_of(
            seed, n, ny, R=R * np.eye(ny), Q=Q * np.asarray(base.Q), C=C * np.asarray(base.C)
        )
        u, y, _ = systems.random_log(seed, plant, 40)
        built = nisme.build(plant, np.zeros(n), P0 * np.eye(n), modes=banks.MODES)
        got = jax.tree.map(np.asarray, banks.ran(built, banks.log(u, y))[1])
        for part in ("x", "d", "residual", "residual_cov", "p"):
            assert np.all(np.isfinite(getattr(got, part))), (part, seed, R, P0, Q, C)


@pytest.mark.slow
def test_a_plant_without_attack_channels_has_one_mode():
    """The bank is then a Kalman filter, whose innovation has the evidence."""
    plant = banks.plant_of(2, 3, 4, G=None, H=None, attacks=())
    observations = banks.observed(2, plant, 20)
    for modes in ("single", "all", [[]]):
        built = nisme.build(plant, np.zeros(3), np.eye(3), modes=modes)
        assert built.modes == ("none",)
        got = banks.ran(built, observations)[1]
        truth = banks.ran(nise.build(plant, np.zeros(3), np.eye(3)), observations)[1]
        np.testing.assert_allclose(got.x, truth.x, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(got.p, np.ones((20, 1)))


@pytest.mark.whole
@pytest.mark.slow
def test_forty_modes_of_a_sensor_alone():
    """One output, six channels, 40 modes: most cannot be told apart, all keep their share."""
    rng = np.random.default_rng(4)
    G, H = rng.normal(size=(2, 6)), rng.normal(size=(1, 6))
    plant = linear_plant(
        A=np.diag([0.9, 0.5]), C=[[1, 1]], G=G, H=H, Q=np.eye(2), R=[[1]], attacks=list("abcdef")
    )
    modes = [[c for i, c in enumerate("abcdef") if number >> i & 1] for number in range(40)]
    built = nisme.build(plant, np.zeros(2), np.eye(2), modes=modes, floor=0.01)
    got = banks.ran(built, banks.log(np.zeros((60, 0)), rng.normal(size=(60, 1))))[1]
    assert np.all(np.isfinite(got.p) & (got.p >= 0.01 / 1.4))
    np.testing.assert_allclose(got.p.sum(1), 1.0, rtol=0, atol=1e-12)
    assert np.all(np.isfinite(got.x))
