"""False-alarm rates on white residuals, where they should be exact, samples missing or not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.detectors import chi_square, cusum, per_channel, sprt, windowed
from streams import judge_white, plant_of

LEVEL = 0.01
BURN_IN = 50
DETECTORS = {
    "chi_square": (chi_square, {}),
    "windowed": (windowed, {"length": 10}),
    "weighted": (windowed, {"length": 5, "weights": [0.1, 0.2, 0.5, 1.0, 2.0]}),
    "cusum": (cusum, {}),
    "cusum, long memory": (cusum, {"forgetting": 0.9}),
    "sprt": (sprt, {}),
    "per_channel": (per_channel, {}),
}
EXACT_WITH_GAPS = ("chi_square", "windowed", "per_channel")


def built():
    return tuple(
        module.build(plant_of(3), level=LEVEL, **own) for module, own in DETECTORS.values()
    )


def rates(runs, steps, missing, seed):
    """Alarms per row with anything to test, and the standard error between runs, by name."""
    judged = judge_white(built(), jax.random.key(seed), runs, steps, jnp.asarray(missing), 3)
    alarm, threshold = (np.asarray(array)[:, BURN_IN:] for array in judged)
    each = alarm.sum(1) / np.isfinite(threshold).sum(1)
    errors = each.std(0, ddof=1) / np.sqrt(runs)
    return {n: (each.mean(0)[i], errors[i]) for i, n in enumerate(DETECTORS)}


@pytest.fixture(
    scope="module", params=[(400, 500), pytest.param((1000, 1000), marks=pytest.mark.slow)]
)
def whole(request):
    return rates(*request.param, 0.0, seed=0)


@pytest.fixture(
    scope="module", params=[(400, 500), pytest.param((1000, 1000), marks=pytest.mark.slow)]
)
def with_gaps(request):
    return rates(*request.param, 0.4, seed=1)


@pytest.mark.parametrize("name", DETECTORS)
def test_the_rate_is_the_level(name, whole):
    found, error = whole[name]
    assert error < 0.06 * LEVEL
    assert found == pytest.approx(LEVEL, abs=3 * error)


@pytest.mark.parametrize("name", EXACT_WITH_GAPS)
def test_the_rate_stays_exact_when_samples_are_missing(name, with_gaps):
    found, error = with_gaps[name]
    assert found == pytest.approx(LEVEL, abs=3 * error)


@pytest.mark.parametrize("name", [n for n in DETECTORS if n not in EXACT_WITH_GAPS])
def test_the_rate_stays_near_when_samples_are_missing(name, with_gaps):
    """Approximate, as stated: within 10 % of the level with 40 % of the samples missing."""
    found, error = with_gaps[name]
    assert abs(found - LEVEL) < 0.1 * LEVEL + 3 * error


def test_the_papers_cusum_is_not_a_test_of_its_level():
    detector = cusum.build(plant_of(2), level=LEVEL, threshold="paper")
    alarm, _ = judge_white((detector,), jax.random.key(3), 1000, 600, jnp.asarray(0.0), 2)
    each = np.asarray(alarm)[:, BURN_IN:, 0].mean(1)
    error = each.std(ddof=1) / np.sqrt(len(each))
    assert error < 0.03 * 0.00536
    assert each.mean() == pytest.approx(0.00536, abs=3 * error)
