"""`nisme`: evidence, Bayes' rule and names, against filters and chains written out in NumPy."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import binom

import banks
import oracles
import systems
from holdfast.attacks import bias
from holdfast.detectors import chi_square
from holdfast.estimators import nisme
from holdfast.estimators.hypotheses import modes_of
from holdfast.loop import Monitor, Scenario, replay, simulate
from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.library import swing
from holdfast.records import Observation, Status
from holdfast.shell.live import Live

SD = np.array([0.5, 2.0, 3.0])
LEAST = 1e-290
"""A floor that nothing reaches."""


def rows_of(seed: int, steps: int = 40):
    plant = banks.plant_of(seed, 3, 4)
    u, y, _ = systems.random_log(seed, plant, steps)
    return plant, u, y


def likelihoods(plant, u, y, modes=banks.MODES):
    """Of every row (first axis) and mode, by Algorithm 1: records of `oracles.Nise`."""
    n = len(plant.states)
    variance = SD**2
    each = [
        oracles.algorithm_1(banks.linear(plant, m), np.ones(n), np.eye(n), variance, u, y)
        for m in modes
    ]
    return lambda name: np.array([[getattr(row, name) for row in rows] for rows in each]).T


def build(plant, **settings):
    n = len(plant.states)
    given = dict(modes=banks.MODES, floor=LEAST, attack_prior_sd=list(SD))
    return nisme.build(plant, np.ones(n), np.eye(n), **(given | settings))


def probabilities(estimator, u, y):
    return np.asarray(banks.ran(estimator, banks.log(u, y))[1].p)


def bayes(log_likelihood, floor, transition=None):
    """Algorithm 2, lines 7 and 10, in probabilities; before it a step of the chain."""
    p, found = np.full(log_likelihood.shape[1], 1.0 / log_likelihood.shape[1]), []
    for row in log_likelihood:
        p = p if transition is None else transition.T @ p
        p = p * np.exp(row - row.max())
        p = np.maximum(p / p.sum(), floor)
        p = p / p.sum()
        found.append(p)
    return np.array(found)


def test_the_evidence_is_that_of_a_kalman_filter_with_the_prior():
    """Of N(0, S + F D F') and of the three factors of the errata; and Algorithm 2 with a floor.

    log p adds the rows up: 1e-8 over all of them, from a mean and covariance that agree with
    Algorithm 1's to rounding.
    """
    plant, u, y = rows_of(0)
    found = likelihoods(plant, u, y)
    got = banks.ran(build(plant), banks.log(u, y))[0].log_p
    for name in ("kalman", "errata"):
        total = np.cumsum(found(name), 0)
        wanted = total - logsumexp(total, axis=1, keepdims=True)
        assert np.min(wanted) > math.log(LEAST)
        np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-8)
    p = probabilities(build(plant, floor=0.02), u, y)
    np.testing.assert_allclose(p, bayes(found("kalman"), 0.02), rtol=0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, 11])
@pytest.mark.parametrize(
    ("likelihood", "name"), [("evidence", "kalman"), ("evidence", "errata"), ("paper", "paper")]
)
def test_likelihoods_of_small_and_large_banks(n, likelihood, name):
    """The paper's is (15) with its normaliser, over z_3 of (6) to (8)."""
    tolerance = 1e-8 if n <= 10 else 1e-5  # Z is kept short above
    for seed in range(1, 6):
        plant = banks.plant_of(seed, n, 5)
        u, y, _ = systems.random_log(seed, plant, 25)
        total = np.cumsum(likelihoods(plant, u, y)(name), 0)
        got = banks.ran(build(plant, likelihood=likelihood), banks.log(u, y))[0].log_p
        wanted = total - logsumexp(total, axis=1, keepdims=True)
        clear = wanted.min(1) > math.log(LEAST)
        np.testing.assert_allclose(got[clear], wanted[clear], rtol=0, atol=tolerance)


@pytest.mark.slow
def test_quadratic_is_the_paper_s_without_the_normaliser():
    plant, u, y = rows_of(0)
    paper = likelihoods(plant, u, y)("paper")
    got = np.asarray(banks.ran(build(plant, likelihood="quadratic"), banks.log(u, y))[0].log_p)
    # constant once the covariances are: the differences of what is left do not move any more
    normaliser = np.diff(np.diff(got[:, :1] - got[:, 1:], axis=0), axis=0)
    plain = np.diff(paper[1:, :1] - paper[1:, 1:], axis=0)
    np.testing.assert_allclose(normaliser[-5:], plain[-5:], rtol=0, atol=1e-6)


def rescaled(plant, y, outputs, attacks):
    """The same plant and rows with outputs and attacks in other units."""
    A, B, C, D, G, H, Q, R = systems.matrices(plant)
    column = outputs[:, None]
    other = systems.quiet_plant(
        A=A, B=B, C=column * C, D=column * D, G=G / attacks, H=column * H / attacks, Q=Q,
        R=column * R * outputs, attacks=banks.NAMES,
    )  # fmt: skip
    return other, y * outputs, list(SD * attacks)


OUTPUTS, ATTACKS = np.array([1e-3, 1.0, 50.0, 7e4]), np.array([1e4, 1e-3, 3.0])


@pytest.mark.parametrize("shown", ["outputs", "attacks"])
def test_units_do_not_matter(shown):
    plant, u, y = rows_of(1)
    truth = probabilities(build(plant, floor=1e-4), u, y)
    scales = (OUTPUTS, np.ones(3)) if shown == "outputs" else (np.ones(4), ATTACKS)
    other, scaled, sd = rescaled(plant, y, *scales)
    got = probabilities(build(other, attack_prior_sd=sd, floor=1e-4), u, scaled)
    np.testing.assert_allclose(got, truth, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_units_decide_in_the_paper_s_comparison():
    """Errata 5: densities over spaces of different dimension."""
    plant, u, y = rows_of(1)
    # who drops most directions wins where numbers are large, who drops none where they are small
    for factor, winner in ((1e-3, 0), (1e3, 3)):
        other, scaled, sd = rescaled(plant, y, np.full(4, factor), np.ones(3))
        settings = dict(likelihood="paper", attack_prior_sd=sd, floor=1e-4)
        got = probabilities(build(other, **settings), u, scaled)
        assert np.all(got[-10:, winner] > 0.99)


def scalar():
    return linear_plant(A=[[0.9]], C=[[1]], H=[[1]], Q=[[0.3]], R=[[0.5]])


def scalar_likelihoods(y, prior):
    """Rows of log N(y_k; ..) for no attack (a Kalman filter) and for a free one (a predictor)."""
    found, means, variances = [], np.zeros(2), np.ones(2)
    for sample in y:
        means, variances = 0.9 * means, 0.81 * variances + 0.3
        spread = variances + 0.5 + np.array([0.0, prior**2])
        found.append(-0.5 * ((sample - means) ** 2 / spread + np.log(2 * np.pi * spread)))
        gain = np.array([variances[0] / spread[0], 0.0])
        means, variances = means + gain * (sample - means), variances * (1 - gain)
    return np.array(found)


def test_with_a_chain_it_is_the_forward_algorithm():
    """P(mode_k, y_1..k) of the hidden Markov model, the floor far below."""
    rng = np.random.default_rng(0)
    y = np.concatenate([rng.normal(size=20), 4 + rng.normal(size=20), rng.normal(size=20)])
    chain = np.array([[0.95, 0.05], [0.3, 0.7]])
    built = nisme.build(
        scalar(), [0], [[1]], modes=[[], ["d1"]], attack_prior_sd=3.0, transition=chain.tolist(),
        floor=1e-200,
    )  # fmt: skip
    got = probabilities(built, np.zeros((60, 0)), y[:, None])
    rows = scalar_likelihoods(y, 3.0)
    np.testing.assert_allclose(got, bayes(rows, 0.0, chain), rtol=0, atol=1e-12)
    # and in one sum over all ways through the modes
    forward = np.full(2, 0.5)
    for row in rows[:12]:
        forward = np.exp(row) * (chain.T @ forward)
    np.testing.assert_allclose(got[11], forward / forward.sum(), rtol=0, atol=1e-12)


def test_a_probability_of_change_is_a_chain():
    plant = scalar()
    built = nisme.build(plant, [0], [[1]], modes=[[], ["d1"]], transition=0.1)
    np.testing.assert_allclose(built.transition, [[0.9, 0.1], [0.1, 0.9]], rtol=0, atol=1e-15)
    plant, _, _ = rows_of(0)
    chain = np.asarray(build(plant, transition=0.3).transition)
    np.testing.assert_allclose(chain, 0.6 * np.eye(4) + 0.1, rtol=0, atol=1e-15)
    alone = nisme.build(plant, np.ones(3), np.eye(3), modes=[[]], transition=0.3)
    np.testing.assert_allclose(alone.transition, [[0.7]])


WRONG = [
    ({"modes": []}, "modes: found an empty list"),
    ({"modes": [["push"], ["pull"]]}, "modes: found 'pull', expected one of push, spoof, both"),
    ({"modes": [["push", "push"]]}, "modes: found .*expected names that differ"),
    ({"modes": [["push"], ["push"]]}, "modes: found 'push', expected names that differ"),
    ({"modes": [["push", "both"], ["both", "push"]]}, "'both.push', expected modes that differ"),
    ({"modes": ["push"]}, "modes: found 'push', expected a list of attack names"),
    ({"modes": [{"attack": []}]}, "the key 'attack', expected one of name, attacks, switch"),
    ({"modes": [{"switch": "open"}]}, "modes: found 'open', expected one of normal"),
    ({"modes": [{"name": 3}]}, "modes: found 3, expected a name in quotes"),
    ({"bank": [["pull"]]}, "bank: found 'pull'"),
    ({"floor": 0.0}, "floor: found 0.0, expected a number above 0 and under 1/4"),
    ({"floor": 0.25}, "floor: found 0.25"),
    ({"floor": math.nan}, "floor: found nan"),
    ({"freeze": 1.0}, "freeze: found 1.0"),
    ({"freeze": -1e-3}, "freeze: found -0.001"),
    ({"attack_prior_sd": [1.0, 2.0]}, "attack_prior_sd: found 2 numbers, expected one, or 3"),
    ({"attack_prior_sd": 0.0}, "attack_prior_sd: found 0.0, expected numbers above 0"),
    ({"attack_prior_sd": math.inf}, "attack_prior_sd: found inf"),
    ({"transition": 1.0}, "transition: found 1.0, expected a probability"),
    ({"transition": [[1.0]]}, r"transition: found shape \(1, 1\), expected 4 x 4"),
    ({"transition": [[0.5] * 4] * 4}, "transition: found other rows"),
    ({"bank": [["push"]], "level": 1.0}, "level: found 1.0, expected a probability"),
]


@pytest.mark.parametrize(("settings", "message"), WRONG)
def test_a_setting_that_cannot_be_is_told(settings, message):
    with pytest.raises(InvalidValue, match=message):
        build(rows_of(0)[0], **settings)


def test_the_modes_that_words_stand_for():
    with pytest.raises(InvalidValue, match='modes: found \'each\', expected "single", "all"'):
        modes_of(rows_of(0)[0], "each")
    grid = swing.network(
        lines=[[1, 2], [2, 3]], generators=[1], attacks=["actuator:1"], switches=[["1-2"]]
    )
    push, line = grid.attacks[0], grid.positions[1]
    n = len(grid.states)

    def modes(**given):
        return nisme.build(grid, np.zeros(n), np.eye(n), floor=1e-6, **given).modes

    assert modes() == ("none", push, line)
    assert modes(modes="all") == ("none", push, line, f"{push}+{line}")
    tables = [{"name": "quiet"}, {"attacks": [push], "switch": line}, []]
    with pytest.raises(InvalidValue, match="modes: found 'none', expected modes that differ"):
        modes(modes=tables)
    assert modes(modes=tables[:2]) == ("quiet", f"{push}+{line}")
    with pytest.raises(InvalidValue, match=f"bank: found the switch position '{line}'"):
        modes(modes=[[]], bank=[{"switch": line}])


def reduced(level: float = 0.1):
    """Five outputs, three of which may be falsified, and a bank of the filter that frees all."""
    rng = np.random.default_rng(3)
    A, C = np.diag([0.9, 0.6]), rng.normal(size=(5, 2))
    H = np.vstack([np.eye(3), np.zeros((2, 3))])
    plant = linear_plant(A=A, C=C, H=H, Q=0.1 * np.eye(2), R=np.eye(5))
    names = list(plant.attacks)
    built = nisme.build(plant, [0, 0], np.eye(2), modes="all", bank=[names], level=level)
    return plant, built


@eqx.filter_jit
def named_last(scenario, keys):
    return jax.vmap(lambda key: simulate(scenario, key, 8).estimate.mode[-1])(keys)


def last_modes(plant, built, attack):
    """The mode named at the last row of 2000 independent runs under a constant attack."""
    monitor = Monitor(built, chi_square.build(plant, on="residual"))
    attacks = tuple(
        bias.build(plant, value=float(value), channel=f"channel:{name}")
        for name, value in zip(plant.attacks, attack, strict=True)
    )
    scenario = Scenario(plant, jnp.zeros(2), monitor, attacks=attacks)
    return np.asarray(named_last(scenario, jax.random.split(jax.random.key(1), RUNS)))


RUNS = 2000


@pytest.mark.slow
def test_a_reduced_bank_keeps_to_its_false_alarm_budget():
    """Any name at all in 2000 attack-free runs: at most 10 % (a test that errs once in 1e6), and
    not far less, the three estimates being little correlated.
    """
    plant, built = reduced()
    named = last_modes(plant, built, np.zeros(3))
    alarms = int(np.sum(named != built.named.index("none")))
    assert alarms <= binom.ppf(1 - 1e-6, RUNS, 0.1)
    assert alarms >= binom.ppf(1e-6, RUNS, 0.07)


@pytest.mark.slow
def test_a_reduced_bank_names_who_is_really_attacked():
    """Ten standard deviations: missed never, another named besides within the budget."""
    plant, built = reduced(0.01)
    for attacked in ([0], [0, 2], [1, 2], [0, 1, 2]):
        attack = np.zeros(3)
        attack[attacked] = 15.0
        named = last_modes(plant, built, attack)
        wanted = built.named.index("+".join(plant.attacks[i] for i in attacked))
        wrong = int(np.sum(named != wanted))
        assert wrong <= binom.ppf(1 - 1e-6, RUNS, 0.01)


@pytest.mark.slow
def test_one_program_for_all_plants_of_a_shape_and_for_64_runs_at_once():
    traced = []

    @eqx.filter_jit
    def every(scenario, keys):
        traced.append(1)
        return jax.vmap(lambda key: simulate(scenario, key, 30))(keys)

    for seed in range(3):
        plant = banks.plant_of(seed, 3, 4)
        monitor = Monitor(build(plant), chi_square.build(plant, on="residual"))
        scenario = Scenario(plant, jnp.ones(3), monitor)
        keys = jax.random.split(jax.random.key(seed), 64)
        trace = every(scenario, keys)
        assert trace.estimate.x.dtype == trace.estimate.p.dtype == jnp.float64
        for run in (0, 63):
            one = simulate(scenario, keys[run], 30)
            for name in ("x", "x_cov", "d", "p", "residual"):
                ours, alone = getattr(trace.estimate, name)[run], getattr(one.estimate, name)
                np.testing.assert_allclose(ours, alone, rtol=1e-10, atol=1e-10)
    assert len(traced) == 1


@pytest.mark.slow
@pytest.mark.parametrize("freeze", [0.0, 1e-3])
def test_a_simulation_its_replay_and_live_are_the_same(freeze):
    plant = banks.plant_of(4, 3, 4)
    built = build(plant, freeze=freeze, floor=1e-4, transition=0.01)
    monitor = Monitor(built, chi_square.build(plant, on="residual"))
    trace = simulate(Scenario(plant, jnp.ones(3), monitor), jax.random.key(0), 40)
    again = replay(monitor, trace.observation)
    live = Live(monitor)
    rows = [
        live.push(jax.tree.map(lambda leaf, i=i: np.asarray(leaf[i]), trace.observation))[0]
        for i in range(40)
    ]
    assert trace.modes == again.modes == built.modes
    for name in ("x", "x_cov", "d", "d_cov", "residual", "p", "status", "mode"):
        truth = np.asarray(getattr(trace.estimate, name))
        stepped = np.stack([np.asarray(getattr(row, name)) for row in rows])
        np.testing.assert_allclose(getattr(again.estimate, name), truth, rtol=0, atol=1e-12)
        np.testing.assert_allclose(stepped, truth, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_sample_that_is_no_number_is_one_that_is_missing():
    plant = banks.plant_of(5, 3, 4)
    u, y, _ = systems.random_log(5, plant, 20)
    monitor = Monitor(build(plant), chi_square.build(plant, on="residual"))
    broken, seen = y.copy(), np.ones(y.shape, bool)
    broken[7, 2], broken[9, 0] = math.nan, math.inf
    seen[7, 2] = seen[9, 0] = False
    got = replay(monitor, Observation.of(u, broken)).estimate
    truth = replay(monitor, banks.log(u, y, seen)).estimate
    np.testing.assert_array_equal(got.x, truth.x)
    np.testing.assert_array_equal(got.p, truth.p)
    assert np.all(np.isfinite(got.p))
    told = np.flatnonzero(np.asarray(got.status) & int(Status.BAD_INPUT))
    np.testing.assert_array_equal(told, [7, 9])
