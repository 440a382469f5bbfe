"""The estimator with its sensors' life cycle: which samples are fused, and what to take back.

A lie is seen some rows after it began, and by then it is part of the estimate. So the last rows
are kept with the states before them: whom to isolate is found out by going back and leaving out
one sensor after the other, and the estimate goes on as if that sensor had not been fused since.

Sensors that agree with each other can be shut out by one that lied first. So as long as somebody
is isolated, a trial is made every ``retry`` rows: a second copy of the state fuses those who are
isolated instead of those who are not. If it ends in agreement with more sensors than the
estimate, it takes its place; if not, the next trial comes after twice as long.
"""

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from holdfast.records import Estimate, Observation, Verdict
from holdfast.shell.live import Live
from holdfast.shell.service.health import ISOLATED, Change, Health, Rules
from holdfast.shell.service.watching import Watch, fused_squares

KEPT_BYTES = 16 * 2**20
"""Memory for the states of the last rows; where they are larger, fewer are kept."""
CANDIDATES = 8
"""Sensors tried at most, the most suspicious first."""
TRIAL_WINDOWS = 5
"""Windows that a trial lasts."""
LONGEST_WAIT = 64
"""Times ``retry`` that two trials are apart at most."""

Outcome = tuple[Estimate, Verdict]


class _Past(NamedTuple):
    """A row that can be gone back to: the state before it, and what was seen in it."""

    state: np.ndarray
    observation: Observation


class Estimation:
    """One stream: the monitor, the health of its sensors, and the rows to go back to."""

    def __init__(
        self, live: Live, watch: Watch, rules: Rules, active: bool, retry: int, history: int,
        pointed: Callable[[Verdict], np.ndarray],
    ):  # fmt: skip
        sensors = len(live.monitor.estimator.plant.outputs)
        self.health = Health(rules, sensors)
        self.rows = 0
        self._live, self._watch, self._active, self._retry = live, watch, active, retry
        self._pointed = pointed
        wanted = max(history, rules.window + rules.confirm if active else 0)
        fits = KEPT_BYTES // live.snapshot().nbytes
        self._past: deque[_Past] = deque(maxlen=max(min(wanted, fits), 1))
        self._trial: _Trial | None = None
        self._waited, self._wait = 0, retry

    def step(self, observation: Observation) -> tuple[Outcome, list[Change]]:
        """One row: what the monitor says of it, and which sensors' states changed."""
        self.rows += 1
        self._past.append(_Past(self._live.snapshot(), observation))
        outcome, squares = self._fused(observation, self.health.admitted, self.rows)
        if not self._active:
            return outcome, []
        found = self.health.take(squares, self._pointed(outcome[1]))
        changes = [change for change in found if change.state != ISOLATED or self._is_out(change)]
        accused = [change for change in found if change not in changes]
        if accused:
            culprit, outcome = self._isolate(accused)
            changes.append(culprit)
        elif (trial := self._tried(observation)) is not None:
            changes.extend(trial)
        return outcome, changes

    def revise(self, back: int, observation: Observation) -> Outcome | None:
        """Put a row's late samples in and work on the rows since again; None if it is too old.

        ``back``: 0 for the last row. The sensors' states stay as they were judged.
        """
        if back >= len(self._past):
            return None
        rows = [*self._past][len(self._past) - 1 - back :]
        rows[0] = rows[0]._replace(observation=observation)
        return self._again(rows, self.health.admitted)[0]

    def seen(self, back: int) -> Observation | None:
        """What was seen in an earlier row, 0 for the last; None if it is too old."""
        return None if back >= len(self._past) else self._past[-1 - back].observation

    def reset(self) -> None:
        """The estimator before the first row, every sensor healthy."""
        self._live.reset()
        self.health = Health(self.health.rules, len(self.health.states))
        self.rows = 0
        self._past.clear()
        self._trial, self._waited, self._wait = None, 0, self._retry

    def _is_out(self, change: Change) -> bool:
        return self.health.states[change.sensor] == ISOLATED

    def _fused(
        self, observation: Observation, admitted: np.ndarray, row: int
    ) -> tuple[Outcome, np.ndarray]:
        """Push what is admitted or authenticated; the squared innovations of all that came."""
        came = np.asarray(observation.seen)
        fused = came & (admitted | np.asarray(observation.trusted))
        if (fused == came).all():
            outcome = self._live.push(observation)
            return outcome, fused_squares(outcome[0])
        outcome = self._live.push(
            Observation.of(observation.u, observation.y, fused, observation.trusted)
        )
        squares = fused_squares(outcome[0])
        left_out = came & ~fused & np.isfinite(np.asarray(observation.y))
        if left_out.any():
            squares[left_out] = self._watch(row, outcome[0], observation)[left_out]
        return outcome, squares

    def _again(
        self, rows: list[_Past], admitted: np.ndarray
    ) -> tuple[Outcome, np.ndarray, list[_Past]]:
        """Work on the last rows again; the outcome, every row's squares, the rows as they are now.

        The kept rows are replaced by the new ones.
        """
        self._live.restore(rows[0].state)
        outcome, squares, new = None, [], []
        first = self.rows - len(rows)
        for i, (_, observation) in enumerate(rows, 1):
            new.append(_Past(self._live.snapshot(), observation))
            outcome, found = self._fused(observation, admitted, first + i)
            squares.append(found)
        assert outcome is not None
        for _ in range(len(rows)):
            self._past.pop()
        self._past.extend(new)
        return outcome, np.array(squares), new

    def _isolate(self, accused: list[Change]) -> tuple[Change, Outcome]:
        """Leave out the sensor without which the others agree best, from before it was noticed."""
        rows = [*self._past]
        admitted = self.health.admitted
        statistics = self.health.statistics
        suspects = sorted(np.flatnonzero(admitted), key=lambda i: -statistics[i])[:CANDIDATES]
        worst: dict[int, float] = {}
        for i in suspects:
            rest = admitted.copy()
            rest[i] = False
            _, squares, _ = self._again(rows, rest)
            recent = squares[-self.health.rules.window :, rest]
            came = ~np.isnan(recent)
            mean = np.where(came, recent, 0.0).sum(0) / np.maximum(came.sum(0), 1)
            worst[int(i)] = float(mean.max(initial=0.0))
        explaining = [i for i in worst if worst[i] <= self.health.threshold]
        culprit = explaining[0] if explaining else min(worst, key=lambda i: worst[i])
        self.health.isolate(culprit)
        outcome, _, _ = self._again(rows, self.health.admitted)
        self._trial, self._waited = None, 0
        named = next((change for change in accused if change.sensor == culprit), accused[0])
        reason = named.reason if named.sensor == culprit else "the others agree without it"
        return Change(culprit, ISOLATED, reason, float(statistics[culprit])), outcome

    def _tried(self, observation: Observation) -> list[Change] | None:
        """Go on with the trial, or begin one when it is time; what it changed at its end."""
        if not any(state == ISOLATED for state in self.health.states):
            self._trial, self._waited, self._wait = None, 0, self._retry
            return None
        self._waited += 1
        window = self.health.rules.window
        if self._trial is None:
            if self._waited >= self._wait:
                others = np.array([state == ISOLATED for state in self.health.states])
                self._trial = _Trial(self._live.snapshot(), others, window)
            return None
        trial, state = self._trial, self._live.snapshot()
        self._live.restore(trial.state)
        _, squares = self._fused(observation, trial.admitted, self.rows)
        trial.take(self._live.snapshot(), squares)
        self._live.restore(state)
        if trial.rows < TRIAL_WINDOWS * window:
            return None
        self._trial, self._waited = None, 0
        self._wait = min(2 * self._wait, LONGEST_WAIT * self._retry)
        agree = trial.means <= self.health.threshold
        if agree.sum() <= (self.health.statistics <= self.health.threshold).sum():
            return None
        self._live.restore(trial.state)
        self._past.clear()
        return self.health.admit(agree)

    def held(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """What a checkpoint keeps: words and numbers, and arrays."""
        trial = self._trial
        words = {
            "rows": self.rows,
            "health": self.health.held(),
            "waited": self._waited,
            "wait": self._wait,
            "trial": None if trial is None else trial.rows,
        }
        rows = [past.observation for past in self._past]
        arrays = {
            "state": self._live.snapshot(),
            "past_states": np.array([past.state for past in self._past]),
            **{
                f"past_{name}": np.array([getattr(row, name) for row in rows])
                for name in ("u", "y", "seen", "trusted")
            },
        }
        if trial is not None:
            arrays |= {"trial_state": trial.state, "trial_admitted": trial.admitted,
                       "trial_past": trial.past}  # fmt: skip
        return words, arrays

    def restore(self, words: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        """Go on from a checkpoint."""
        self._live.restore(arrays["state"])
        self.rows = int(words["rows"])
        self.health.restore(words["health"])
        self._waited, self._wait = int(words["waited"]), int(words["wait"])
        self._past.clear()
        parts = [arrays[f"past_{name}"] for name in ("states", "u", "y", "seen", "trusted")]
        for state, *seen in zip(*parts, strict=True):
            self._past.append(_Past(state, Observation.of(*seen)))
        self._trial = None
        if words["trial"] is not None:
            window = self.health.rules.window
            trial = _Trial(arrays["trial_state"], arrays["trial_admitted"], window)
            trial.rows, trial.past = int(words["trial"]), arrays["trial_past"]
            self._trial = trial


class _Trial:
    """A second state that fuses other sensors, and how well all sensors agree with it."""

    def __init__(self, state: np.ndarray, admitted: np.ndarray, window: int):
        self.state, self.admitted = state, admitted
        self.past = np.full((window, len(admitted)), np.inf)
        self.rows = 0

    def take(self, state: np.ndarray, squares: np.ndarray) -> None:
        """Another row of the trial."""
        self.state = state
        # a sensor that is silent agrees with nobody
        self.past[self.rows % len(self.past)] = np.where(np.isnan(squares), np.inf, squares)
        self.rows += 1

    @property
    def means(self) -> np.ndarray:
        """The mean of the last squared innovations of each sensor."""
        return self.past.mean(0)
