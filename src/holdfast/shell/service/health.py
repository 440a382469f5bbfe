"""The life cycle of every sensor: healthy, suspected, isolated, on probation, healthy again.

The statistic of a sensor is the mean of its last ``window`` squared innovations, each over its
variance: about 1 while it is sound. The threshold is the chi-square quantile for that many.

    healthy    -> suspected   statistic over the threshold, or the detector points at it
    suspected  -> healthy     neither, for ``window`` samples
    suspected  -> isolated    still so after ``confirm`` samples: no longer part of the estimate
    isolated   -> probation   statistic under the threshold: it is watched all the time
    probation  -> healthy     still under it after ``probation`` samples
    probation  -> isolated    over it again

One at a time: a lie that has moved the estimate makes honest sensors look wrong, so that nothing
else is isolated while a sensor is being dealt with (`holdfast.shell.service.isolation` finds out
which of the suspects it is). An authenticated sample is part of the estimate whatever its sensor's
state.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

HEALTHY, SUSPECTED, ISOLATED, PROBATION = "healthy", "suspected", "isolated", "probation"


class Change(NamedTuple):
    """A sensor's new state, and why."""

    sensor: int
    state: str
    reason: str
    statistic: float


class Rules(NamedTuple):
    """The settings of the life cycle; lengths in samples of the sensor itself."""

    level: float
    window: int
    confirm: int
    probation: int

    @property
    def threshold(self) -> float:
        """What the mean of ``window`` squared innovations exceeds with probability ``level``."""
        return float(chdtri(self.window, self.level)) / self.window


class Health:
    """The states of all sensors, and the windows behind them."""

    def __init__(self, rules: Rules, sensors: int):
        self.rules = rules
        self.threshold = rules.threshold
        self.states = [HEALTHY] * sensors
        self._past = np.ones((sensors, rules.window))
        self._at = np.zeros(sensors, int)
        self._since = np.zeros(sensors, int)
        """Samples since the state began, or for a suspect since it last looked wrong."""
        self._wrong = np.zeros(sensors, int)
        self._troubled = False

    @property
    def admitted(self) -> np.ndarray:
        """Which sensors are part of the estimate."""
        return np.array([state in (HEALTHY, SUSPECTED) for state in self.states])

    @property
    def statistics(self) -> np.ndarray:
        """The statistic of each sensor."""
        return self._past.mean(1)

    def take(self, squares: np.ndarray, pointed: np.ndarray) -> list[Change]:
        """One row: squared innovations over their variance (NaN: none), sensors pointed at.

        The sensors that are to be isolated are told as `ISOLATED` changes but not yet made so:
        `isolate` does that, once it is known which of them it is.
        """
        came = np.flatnonzero(squares == squares)
        self._past[came, self._at[came]] = squares[came]
        self._at[came] = (self._at[came] + 1) % self.rules.window
        self._since[came] += 1
        over = self._past.sum(1) > self.threshold * self.rules.window
        if not (self._troubled or over.any() or pointed.any()):
            return []
        changes = []
        for i, is_over in zip(came.tolist(), over[came].tolist(), strict=True):
            statistic = float(self._past[i].mean())
            change = self._judged(i, is_over, statistic, bool(pointed[i]))
            if change is not None:
                changes.append(Change(i, *change, statistic))
        self._troubled = any(state != HEALTHY for state in self.states)
        return changes

    def _judged(
        self, i: int, over: bool, statistic: float, pointed: bool
    ) -> tuple[str, str] | None:
        state, rules = self.states[i], self.rules
        wrong = over or (pointed and state in (HEALTHY, SUSPECTED))
        reason = (
            f"squared innovations are {statistic:.3g} times what they should be"
            if over else "the detector points at it"
        )  # fmt: skip
        if wrong:
            self._since[i] = 0
        if state == HEALTHY and wrong:
            self._wrong[i] = 0
            return self._become(i, SUSPECTED, reason)
        if state == SUSPECTED:
            self._wrong[i] += wrong
            if self._wrong[i] >= rules.confirm and wrong:
                return ISOLATED, reason
            if self._since[i] >= rules.window:
                return self._become(i, HEALTHY, f"nothing wrong for {rules.window} samples")
        if state == ISOLATED and not over and self._since[i] >= rules.window:
            return self._become(i, PROBATION, "agrees with the estimate again")
        if state == PROBATION and over:
            return self._become(i, ISOLATED, reason)
        if state == PROBATION and self._since[i] >= rules.probation:
            return self._become(i, HEALTHY, f"agreed for {rules.probation} samples")
        return None

    def _become(self, i: int, state: str, reason: str) -> tuple[str, str]:
        self.states[i] = state
        self._since[i] = 0
        return state, reason

    def isolate(self, i: int) -> None:
        """Leave this sensor out, and give the others a new hearing: theirs was under its lie."""
        self._become(i, ISOLATED, "")
        self._troubled = True
        for other, state in enumerate(self.states):
            if state == SUSPECTED:
                self._become(other, HEALTHY, "")
            if self.states[other] == HEALTHY:
                self._past[other] = 1.0
                self._wrong[other] = 0

    def admit(self, admitted: np.ndarray) -> list[Change]:
        """Make exactly these sensors part of the estimate, with a new hearing."""
        changes = []
        for i, wanted in enumerate(admitted):
            if bool(wanted) != (self.states[i] in (HEALTHY, SUSPECTED)):
                state = HEALTHY if wanted else ISOLATED
                reason = "most sensors agree without it" if not wanted else (
                    "agrees with the sensors that most agree with"
                )  # fmt: skip
                self._become(i, state, reason)
                self._past[i] = 1.0
                changes.append(Change(i, state, reason, 1.0))
        self._troubled = True
        return changes

    def held(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {
            "states": list(self.states),
            "past": self._past.tolist(),
            "at": self._at.tolist(),
            "since": self._since.tolist(),
            "wrong": self._wrong.tolist(),
        }

    def restore(self, held: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.states = [str(state) for state in held["states"]]
        self._past = np.array(held["past"], float).reshape(self._past.shape)
        self._at, self._since, self._wrong = (
            np.array(held[name], int) for name in ("at", "since", "wrong")
        )
        self._troubled = True
