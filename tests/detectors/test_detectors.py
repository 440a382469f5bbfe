import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, ncx2, norm

from holdfast.detectors import chi_square, cusum, per_channel, sprt, windowed
from holdfast.numerics.chi_square import weighted_quantile
from holdfast.parts import InvalidValue
from holdfast.records import Reason
from streams import judge, plant_of, records

ALL = [
    (chi_square, {}),
    (windowed, {"length": 4}),
    (cusum, {}),
    (sprt, {}),
    (per_channel, {}),
]


def stream(seed, steps=60, m=3):
    """Correlated values with gaps: values, covariances, statistic and dof of every row."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(m, m))
    S = root @ root.T + 0.3 * np.eye(m)
    values = rng.normal(size=(steps, m)) @ np.linalg.cholesky(S).T
    seen = rng.random((steps, m)) > 0.3
    seen[0] = False
    covs = np.where(seen[:, :, None] & seen[:, None, :], S, 0.0)
    values = np.where(seen, values, 0.0)
    statistic = [
        v[s] @ np.linalg.solve(S[np.ix_(s, s)], v[s]) for v, s in zip(values, seen, strict=True)
    ]
    return values, covs, np.array(statistic), seen.sum(1)


def test_chi_square_follows_what_was_seen():
    values, covs, statistic, dof = stream(0)
    verdict = judge(chi_square.build(plant_of(3), level=0.05), records(values, covs))
    np.testing.assert_allclose(verdict.statistic, statistic, rtol=1e-9, atol=1e-12)
    some = dof > 0
    np.testing.assert_allclose(verdict.threshold[some], chi2.isf(0.05, dof[some]), rtol=1e-12)
    assert np.all(np.isinf(verdict.threshold[~some]))
    np.testing.assert_array_equal(verdict.alarm, statistic > np.asarray(verdict.threshold))
    assert set(np.asarray(verdict.reason)[np.asarray(verdict.alarm)]) <= {Reason.RESIDUAL}


@pytest.mark.parametrize("weights", [None, [0.5, 0.0, 1.0, 2.0]])
def test_windowed_sums_the_last_rows(weights):
    values, covs, statistic, dof = stream(1)
    detector = windowed.build(plant_of(3), length=4, weights=weights)
    verdict = judge(detector, records(values, covs))
    c = np.ones(4) if weights is None else np.array(weights)
    past = np.concatenate([np.zeros(3), statistic])
    g = [past[k : k + 4] @ c for k in range(len(statistic))]
    np.testing.assert_allclose(verdict.statistic, g, rtol=1e-9, atol=1e-12)
    if weights is None:
        dofs = np.convolve(np.concatenate([np.zeros(3), dof]), np.ones(4), "valid")
        some = dofs > 0
        np.testing.assert_allclose(verdict.threshold[some], chi2.isf(0.01, dofs[some]), rtol=2e-5)


def test_windowed_takes_the_papers_bound():
    values, covs, _, dof = stream(2)
    detector = windowed.build(plant_of(3), length=2, weights=[3.0, 1.0], threshold="paper")
    verdict = judge(detector, records(values, covs))
    dofs = dof + np.concatenate([[0], dof[:-1]])
    some = dofs > 0
    np.testing.assert_allclose(verdict.threshold[some], 3.0 * chi2.isf(0.01, dofs[some]))


def test_cusum_is_the_papers_recursion():
    values, covs, statistic, dof = stream(3)
    verdict = judge(cusum.build(plant_of(3), threshold="paper"), records(values, covs))
    S, T = 0.0, chi2.isf(0.01, 3) / 0.85
    for k, (s, nu) in enumerate(zip(statistic, dof, strict=True)):
        S, T = 0.15 * S + s, 0.15 * T + (chi2.isf(0.01, nu) if nu else 0.0)
        if k:  # nothing was seen in the first row
            assert float(verdict.statistic[k]) == pytest.approx(S, rel=1e-9)
            assert float(verdict.threshold[k]) == pytest.approx(T, rel=1e-9)
    assert np.isinf(verdict.threshold[0])
    full = records(np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1)))
    constant = judge(cusum.build(plant_of(3), threshold="paper"), full).threshold
    np.testing.assert_allclose(constant, chi2.isf(0.01, 3) / 0.85)


def test_cusum_calibrated_tends_to_the_quantile_of_its_law():
    full = records(np.zeros((60, 2)), np.tile(np.eye(2), (60, 1, 1)))
    verdict = judge(cusum.build(plant_of(2), forgetting=0.6), full)
    truth = weighted_quantile(0.01, 0.6 ** np.arange(40), np.full(40, 2))
    assert float(verdict.threshold[-1]) == pytest.approx(truth, rel=1e-6)


def test_cusum_forgets_over_a_long_gap():
    covs = np.zeros((80, 2, 2))
    covs[0] = np.eye(2)
    values = np.zeros((80, 2))
    values[0] = 5.0
    verdict = judge(cusum.build(plant_of(2)), records(values, covs))
    assert bool(verdict.alarm[0])
    assert not bool(verdict.alarm[-1])
    assert np.isinf(verdict.threshold[-1])
    assert float(verdict.statistic[-1]) == 0.0


def test_sprt_resets_at_both_boundaries():
    values, covs, statistic, dof = stream(4, steps=300)
    detector = sprt.build(plant_of(3), threshold=1.2, shift=1.5)
    verdict = judge(detector, records(values, covs))
    total, resets = 0.0, [0, 0]
    for k, (s, nu) in enumerate(zip(statistic, dof, strict=True)):
        if nu == 0:
            assert np.isinf(verdict.threshold[k])
            assert float(verdict.statistic[k]) == 0.0
            continue
        total += ncx2.logpdf(s, nu, 1.5**2) - chi2.logpdf(s, nu)
        assert float(verdict.statistic[k]) == pytest.approx(total, abs=1e-5)
        assert bool(verdict.alarm[k]) == (total > 1.2)
        if abs(total) > 1.2:
            resets[int(total > 0)] += 1
            total = 0.0
    assert min(resets) > 3


def test_sprt_takes_walds_boundaries():
    assert float(sprt.build(plant_of(2), threshold="paper").table[2]) == pytest.approx(np.log(99))


@pytest.mark.parametrize("on", ["attack", "residual"])
def test_per_channel_names_the_channels(on):
    values = [[0.0, 5.0, -0.1], [0.0, 0.0, 0.0], [9.0, 9.0, 9.0]]
    covs = np.tile(np.diag([1.0, 1.0, 4.0]), (3, 1, 1))
    covs[1] = 0.0
    covs[2, 0, 0], covs[2, 1, 1] = np.inf, 0.0
    detector = per_channel.build(plant_of(3, 3), level=0.06, on=on)
    verdict = judge(detector, records(values, covs, on))
    each = [1 - 0.94 ** (1 / 3), None, 0.06]
    assert np.asarray(verdict.channel_alarms).tolist() == [
        [False, True, False],
        [False, False, False],
        [False, False, True],
    ]
    np.testing.assert_allclose(verdict.statistic, [5.0, 0.0, 4.5])
    assert np.isinf(verdict.threshold[1])
    for k in (0, 2):
        assert float(verdict.threshold[k]) == pytest.approx(norm.isf(each[k] / 2))
    code = Reason.ATTACK_CHANNEL if on == "attack" else Reason.RESIDUAL_CHANNEL
    assert np.asarray(verdict.reason).tolist() == [code, 0, code]


@pytest.mark.parametrize(("module", "own"), ALL)
def test_nothing_to_test_gives_no_alarm(module, own):
    verdict = judge(
        module.build(plant_of(2), **own), records(np.zeros((3, 2)), np.zeros((3, 2, 2)))
    )
    assert np.all(np.isinf(verdict.threshold))
    assert not np.any(verdict.alarm)
    assert not np.any(verdict.statistic)


@pytest.mark.parametrize(("module", "own"), ALL)
def test_an_estimator_without_attack_estimate_gives_no_alarm(module, own):
    verdict = judge(
        module.build(plant_of(2, 2), on="attack", **own),
        records(np.ones((3, 0)), np.ones((3, 0, 0))),
    )
    assert np.all(np.isinf(verdict.threshold))
    assert not np.any(verdict.alarm)


@pytest.mark.parametrize(("module", "own"), ALL)
def test_a_large_deviation_alarms_at_once_with_its_reason(module, own):
    values = np.full((2, 2), 30.0)
    for on, nd in (("attack", 2), ("residual", 0)):
        detector = module.build(plant_of(2, nd), on=on, **own)
        verdict = judge(detector, records(values, np.tile(np.eye(2), (2, 1, 1)), on))
        assert bool(verdict.alarm[0])
        words = Reason(int(verdict.reason[0])).words
        assert ("attack" in words) == (on == "attack")


@pytest.mark.parametrize(("module", "own"), ALL)
def test_a_number_is_the_threshold_whatever_was_seen(module, own):
    values, covs, _, dof = stream(5)
    verdict = judge(module.build(plant_of(3), threshold=3.5, **own), records(values, covs))
    finite = np.isfinite(verdict.threshold)
    assert np.all(np.asarray(verdict.threshold)[finite] == 3.5)
    assert np.all(finite[dof > 0])


@pytest.mark.parametrize(("module", "own"), ALL)
def test_a_new_level_does_not_compile_again(module, own):
    traced = []

    def step(detector, state, estimate):
        traced.append(1)
        return detector.step(state, estimate)

    compiled = jax.jit(step)
    estimate = jax.tree.map(lambda a: a[0], records(np.ones((1, 2)), np.eye(2)[None]))
    for level in (0.01, 0.02):
        detector = module.build(plant_of(2), level=level, **own)
        compiled(detector, detector.init(), estimate)
    assert len(traced) == 1


@pytest.mark.parametrize(
    ("module", "own", "key"),
    [
        (chi_square, {"level": 0.0}, "level"),
        (chi_square, {"level": 1.0}, "level"),
        (chi_square, {"threshold": -1.0}, "threshold"),
        (windowed, {"length": 0}, "length"),
        (windowed, {"length": 2, "weights": [1.0]}, "weights"),
        (windowed, {"length": 2, "weights": [1.0, 0.0]}, "weights"),
        (cusum, {"forgetting": 1.0}, "forgetting"),
        (sprt, {"shift": 0.0}, "shift"),
        (sprt, {"shift": 100.0}, "shift"),
        (sprt, {"shift": 0.01, "level": 1e-6}, "shift"),
    ],
)
def test_a_setting_out_of_range_is_named(module, own, key):
    with pytest.raises(InvalidValue) as error:
        module.build(plant_of(2), **own)
    assert error.value.key == key


def test_a_projected_estimate_is_not_what_is_tested():
    estimate = records(np.ones((1, 2)), np.eye(2)[None], "attack")
    estimate = jax.tree.map(lambda a: a, estimate)
    object.__setattr__(estimate, "d", jnp.zeros((1, 2)))
    verdict = judge(chi_square.build(plant_of(2, 2), on="attack"), estimate)
    assert float(verdict.statistic[0]) == pytest.approx(2.0)
