"""The settings that serve an objective best, searched by differential evolution.

With the same noise for every candidate the objective is a plain function of the settings.
Source of the method: Storn and Price (1997), as `scipy.optimize.differential_evolution`.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import differential_evolution

POPULATION = 6
"""Candidates of a generation for each setting, and at least 8 of them in all."""


class Span(NamedTuple):
    """Where a setting may lie; ``whole``: a whole number, ``log``: searched on a log scale."""

    low: float
    high: float
    whole: bool
    log: bool

    def value(self, place: float) -> float | int:
        """The setting at a place from 0 to 1."""
        if self.log:
            found = self.low * (self.high / self.low) ** place
        else:
            found = self.low + (self.high - self.low) * place
        found = min(max(found, self.low), self.high)
        return round(found) if self.whole else float(found)


class Judged(NamedTuple):
    """What candidate settings are worth: the ``objective`` to be small, and by how much they
    break their ``limits`` (0 where they keep them all).
    """

    objective: float
    broken: float


class Trial(NamedTuple):
    """A candidate and what it was worth."""

    settings: tuple[float | int, ...]
    judged: Judged


def order(trial: Trial) -> tuple[float, float]:
    """Kept limits come first, then the objective; NaN last."""
    objective, broken = trial.judged
    return (
        np.inf if np.isnan(broken) else broken,
        np.inf if np.isnan(objective) else objective,
    )


def tuned(
    spans: Sequence[Span],
    judge: Callable[[tuple[float | int, ...]], Judged],
    *,
    evaluations: int,
    seed: int = 0,
    first: Sequence[float | int] | None = None,
    told: Callable[[Trial], None] = lambda trial: None,
) -> list[Trial]:
    """All candidates tried, the best first.

    ``judge`` is asked at most ``evaluations`` times, once per candidate; ``first``: settings to
    begin with, such as those in use. ``told`` of each trial as it is made.
    """
    known: dict[tuple[float | int, ...], Trial] = {}

    def ask(settings: tuple[float | int, ...]) -> Trial:
        if settings not in known:
            if len(known) >= evaluations:
                raise _Spent
            known[settings] = Trial(settings, judge(settings))
            told(known[settings])
        return known[settings]

    def cost(places) -> float:
        settings = tuple(span.value(p) for span, p in zip(spans, places, strict=True))
        broken, objective = order(ask(settings))
        # a broken limit weighs more than any objective, which is squeezed between 0 and 1
        return 2.0 + broken if broken > 0 else 0.5 + np.arctan(objective) / np.pi

    try:
        if first is not None:
            ask(tuple(first))
        differential_evolution(
            cost,
            [(0.0, 1.0)] * len(spans),
            popsize=max(POPULATION, -(-8 // len(spans))),
            maxiter=evaluations,
            init="sobol",
            tol=1e-3,
            rng=seed,
            polish=False,
        )
    except _Spent:
        pass
    return sorted(known.values(), key=order)


class _Spent(Exception):
    """All evaluations that were allowed have been made."""
