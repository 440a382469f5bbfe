"""How often a stream may speak, and how soon it is called again."""

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.shell.service.limits import Backoff, RateLimit


def test_a_burst_and_then_the_rate():
    limit, now = RateLimit(10), time.monotonic()
    assert [limit.allow(now) for _ in range(12)] == [True] * 10 + [False] * 2
    assert not limit.allow(now + 0.05)
    assert limit.allow(now + 0.11)
    assert not limit.allow(now + 0.12)
    # a long silence saves up one second and no more
    assert sum(limit.allow(now + 1000) for _ in range(30)) == 10


@given(st.lists(st.floats(0, 0.5), max_size=60), st.integers(1, 50))
def test_never_more_than_the_burst_and_the_rate(gaps, rate):
    now = start = time.monotonic()
    limit, let_in = RateLimit(rate), 0
    for gap in gaps:
        now += gap
        let_in += limit.allow(now)
        assert let_in <= rate + rate * (now - start) + 1e-6


def test_pauses_grow_up_to_the_longest():
    backoff = Backoff(0.1, 1.0)
    pauses = [backoff.pause() for _ in range(6)]
    for pause, longest in zip(pauses, (0.1, 0.2, 0.4, 0.8, 1.0, 1.0), strict=True):
        assert longest / 2 <= pause <= longest


def test_only_a_success_that_lasts_makes_them_short_again(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    backoff = Backoff(0.1, 1.0)
    for _ in range(5):
        backoff.pause()
    backoff.succeeded()
    now[0] += 0.9
    assert backoff.pause() >= 0.5
    backoff.succeeded()
    now[0] += 0.9
    backoff.succeeded()
    now[0] += 0.2
    assert backoff.pause() <= 0.1


def test_a_crowd_disperses():
    assert len({Backoff().pause() for _ in range(20)}) == 20
    assert Backoff(2.0).pause() == pytest.approx(1.5, abs=0.5)
