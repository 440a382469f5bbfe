"""The search for settings, on functions whose best is known."""

import numpy as np
import pytest

from holdfast.campaign.tune import Judged, Span, Trial, order, tuned

PLAIN = Span(0.0, 10.0, whole=False, log=False)
LOG = Span(1e-3, 1e3, whole=False, log=True)
WHOLE = Span(1, 20, whole=True, log=False)


def test_a_bowl_in_three_scales():
    def judge(settings):
        a, b, c = settings
        return Judged((a - 3) ** 2 + np.log10(b / 20) ** 2 + (c - 7) ** 2, 0.0)

    best = tuned([PLAIN, LOG, WHOLE], judge, evaluations=1500)[0]
    assert best.judged.objective < 0.02
    assert best.settings[2] == 7
    assert isinstance(best.settings[2], int)


def test_limits_come_before_the_objective():
    """The least of x over x >= 4."""
    best = tuned([PLAIN], lambda s: Judged(s[0], max(0.0, 4 - s[0])), evaluations=150)[0]
    assert best.judged.broken == 0
    assert best.settings[0] == pytest.approx(4, abs=0.05)


def test_no_more_evaluations_than_allowed_and_none_twice():
    asked = []

    def judge(settings):
        asked.append(settings)
        return Judged(float(settings[0]), 0.0)

    trials = tuned([WHOLE], judge, evaluations=12, first=[9])
    assert asked[0] == (9,)
    assert len(asked) == len(set(asked)) <= 12
    assert trials[0].settings == min(asked)


def test_the_same_seed_finds_the_same():
    def search(seed):
        return tuned([LOG], lambda s: Judged(abs(s[0] - 2), 0.0), evaluations=40, seed=seed)

    assert search(1) == search(1)


def test_no_number_comes_last():
    trials = [Trial((i,), Judged(*j)) for i, j in enumerate([(np.nan, 0), (9, 0), (1, 0.5)])]
    assert [t.settings[0] for t in sorted(trials, key=order)] == [1, 0, 2]
