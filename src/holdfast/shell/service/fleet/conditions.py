"""A condition of every plant of a fleet, with a begin and an end."""

import numpy as np


class Conditions:
    """For which plants a condition holds: it begins when it is first met, and ends ``hold`` rows
    after it was last met, so that one that flickers is one event and not hundreds.
    """

    def __init__(self, most: int, hold: int):
        self._hold = hold
        self.open = np.zeros(most, bool)
        self.last = np.zeros(most, int)

    def take(
        self, places: np.ndarray, frames: np.ndarray, met: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """A row of these plants: of which of them the condition begins, and of which it ends."""
        before = self.open[places]
        self.last[places[met]] = frames[met]
        ends = before & ~met & (frames - self.last[places] >= self._hold)
        self.open[places] = (before | met) & ~ends
        return met & ~before, ends

    def forget(self, places: np.ndarray) -> None:
        """These places belong to others now."""
        self.open[places] = False
