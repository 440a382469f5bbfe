"""What the service says when its estimator cannot: by a stated rule, and never the last value.

An estimator has failed when it diverged, did not converge, or no longer determines a state, for
``after`` rows in a row. Then

    kalman       a Kalman filter of the same samples, which has run beside it all the time
    prediction   the same filter, given no measurement from then on
    none         what the estimator says, and that it is degraded

until it has been sound for as many rows. An operator can reset it at any time.
"""

from typing import Any, Literal

import numpy as np

from holdfast.records import Estimate, Observation, Status, Verdict
from holdfast.shell.live import Live

Rule = Literal["kalman", "prediction", "none"]
NORMAL = "normal"
FAILED = int(Status.DIVERGED | Status.NOT_CONVERGED)


def failed(estimate: Estimate) -> str:
    """Why an estimate is not to be relied on, in words; "" where it is."""
    fields = vars(estimate)  # looking up a record's attributes one by one is slow
    status = int(fields["status"])
    if status & FAILED:
        return Status(status & FAILED).words
    if status & int(Status.NOT_READY):
        return ""
    known = np.isfinite(fields["x_cov"].diagonal()).all()
    return "" if known else "the samples do not determine the state"


class Fallback:
    """Which estimate counts, row by row."""

    def __init__(self, rule: Rule, after: int, beside: Live | None):
        self.rule, self.after, self._beside = rule, after, beside
        self.degraded = False
        self.reason = ""
        self._run = 0
        """Rows in a row that speak against the present mode."""

    @property
    def mode(self) -> str:
        """The mode in words."""
        if not self.degraded:
            return NORMAL
        return "degraded" if self.rule == "none" else f"degraded: {self.rule}"

    def choose(
        self, estimate: Estimate, verdict: Verdict, observation: Observation
    ) -> tuple[Estimate, Verdict]:
        """What to tell of this row; changes `degraded` by the rule."""
        why = failed(estimate)
        self._run = self._run + 1 if bool(why) != self.degraded else 0
        if self._run >= self.after:
            self.degraded, self._run = bool(why), 0
            self.reason = why or f"sound for {self.after} rows"
        if self._beside is None:
            return estimate, verdict
        if self.degraded and self.rule == "prediction":
            nothing = np.zeros(np.shape(observation.y), bool)
            observation = Observation.of(observation.u, observation.y, nothing)
        stand_in = self._beside.push(observation)
        return stand_in if self.degraded else (estimate, verdict)

    def reset(self) -> None:
        """Begin anew, as an operator asks for."""
        self.degraded, self.reason, self._run = False, "reset", 0
        if self._beside is not None:
            self._beside.reset()

    def held(self) -> tuple[dict[str, Any], np.ndarray]:
        """What a checkpoint keeps: settings of the moment, and the state of the filter beside."""
        state = np.zeros(0) if self._beside is None else self._beside.snapshot()
        return {"degraded": self.degraded, "reason": self.reason, "run": self._run}, state

    def restore(self, held: dict[str, Any], state: np.ndarray) -> None:
        """Go on from a checkpoint."""
        self.degraded, self.reason = bool(held["degraded"]), str(held["reason"])
        self._run = int(held["run"])
        if self._beside is not None:
            self._beside.restore(state)
