"""The monitor's step for any number of plants at once."""

import jax
import jax.numpy as jnp
import numpy as np

from holdfast.loop import Monitor
from holdfast.shell.flat import FlatMonitor

BLOCK = 512
"""Plants stepped at once: more no longer fit the cache, and fewer cost more calls."""


class Stepping:
    """The states of ``most`` plants, each a row of a matrix that stays where the steps are.

    Compiled once, for blocks of a fixed size: how many plants a message has changes nothing.
    """

    def __init__(self, monitor: Monitor, most: int):
        self.flat = FlatMonitor(monitor)
        self._most = most
        flat = self.flat

        def block(states, places, samples):
            # the last block's empty rows lie beyond the end: read as the last, written nowhere
            before = states.at[places].get(mode="clip")
            after, outcome = jax.vmap(flat.step)(before, samples)
            return states.at[places].set(after, mode="drop"), outcome

        self._block = jax.jit(block, donate_argnums=0)
        self._states = jnp.asarray(np.tile(flat.start, (most, 1)))
        nobody = np.full(BLOCK, most)
        self._states, _ = self._block(
            self._states, nobody, np.zeros((BLOCK, flat.sample_size))
        )  # compiles

    def step(self, places: np.ndarray, samples: np.ndarray) -> np.ndarray:
        """One row of the plants at these places, no two the same: their outcomes.

        ``samples``: plant by u, y, seen and trusted one after the other.
        """
        found = []
        for first in range(0, len(places), BLOCK):
            at, given = places[first : first + BLOCK], samples[first : first + BLOCK]
            count = len(at)
            if count < BLOCK:
                at = np.concatenate([at, np.full(BLOCK - count, self._most)])
                given = np.concatenate([given, np.zeros((BLOCK - count, given.shape[1]))])
            self._states, outcome = self._block(self._states, at, given)
            found.append(np.asarray(outcome)[:count])
        return np.concatenate(found) if found else np.zeros((0, self.flat.outcome_size))

    def begin(self, places: np.ndarray) -> None:
        """These plants are before their first row."""
        if len(places):
            self._states = self._states.at[places].set(self.flat.start)

    def held(self, places: np.ndarray) -> np.ndarray:
        """The states of these plants, as numbers."""
        return np.asarray(self._states)[places]

    def restore(self, places: np.ndarray, states: np.ndarray) -> None:
        """Put states back. Raises `ValueError` for those of another monitor."""
        wanted = (len(places), len(self.flat.start))
        if states.shape != wanted:
            raise ValueError(f"states: found shape {states.shape}, expected {wanted}")
        self._states = self._states.at[places].set(states)
