"""The monitor's step for any number of plants at once."""

import copy
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from holdfast.shell.flat import FlatMonitor

BLOCK = 512
"""Plants stepped at once: more no longer fit the cache, and fewer cost more calls."""


class Stepping:
    """The states of ``most`` plants, each a row of a matrix that stays where the steps are.

    Compiled once, for blocks of a fixed size: how many plants a message has changes nothing.
    """

    def __init__(self, flat: FlatMonitor, most: int):
        self.flat, self._most = flat, most

        def block(states, places, samples):
            # the last block's empty rows lie beyond the end: read as the last, written nowhere
            before = states.at[places].get(mode="clip")
            after, outcome = jax.vmap(flat.step)(before, samples)
            return states.at[places].set(after, mode="drop"), outcome

        def put(states, places, rows):
            return states.at[places].set(rows, mode="drop")

        self._block = jax.jit(block, donate_argnums=0)
        self._put = jax.jit(put, donate_argnums=0)
        self._states = jnp.asarray(np.tile(flat.start, (most, 1)))
        # compiles, so that no message has to wait for it
        nobody = np.full(BLOCK, most)
        self._states, _ = self._block(self._states, nobody, np.zeros((BLOCK, flat.sample_size)))
        self._states = self._put(self._states, nobody, np.zeros((BLOCK, len(flat.start))))

    def beside(self) -> "Stepping":
        """As many plants more, before their first row, by the same compiled step."""
        found = copy.copy(self)
        found._states = jnp.asarray(np.tile(self.flat.start, (self._most, 1)))
        return found

    def step(self, places: np.ndarray, samples: np.ndarray) -> np.ndarray:
        """One row of the plants at these places, no two the same: their outcomes.

        ``samples``: plant by u, y, seen and trusted one after the other.
        """
        found = [np.zeros((0, self.flat.outcome_size))]
        for at, given, count in self._blocks(places, samples):
            self._states, outcome = self._block(self._states, at, given)
            found.append(np.asarray(outcome)[:count])
        return np.concatenate(found)

    def begin(self, places: np.ndarray) -> None:
        """These plants are before their first row."""
        self.restore(places, np.tile(self.flat.start, (len(places), 1)))

    def held(self, places: np.ndarray) -> np.ndarray:
        """The states of these plants, as numbers."""
        return np.asarray(self._states)[places]

    def restore(self, places: np.ndarray, states: np.ndarray) -> None:
        """Put states back. Raises `ValueError` for those of another monitor."""
        wanted = (len(places), len(self.flat.start))
        if states.shape != wanted:
            raise ValueError(f"states: found shape {states.shape}, expected {wanted}")
        for at, given, _ in self._blocks(places, states):
            self._states = self._put(self._states, at, given)

    def _blocks(
        self, places: np.ndarray, rows: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray, int]]:
        """Blocks of one size, the last filled up with rows for nobody, and how many are not."""
        for first in range(0, len(places), BLOCK):
            at, given = places[first : first + BLOCK], rows[first : first + BLOCK]
            count = len(at)
            if count < BLOCK:
                at = np.concatenate([at, np.full(BLOCK - count, self._most)])
                given = np.concatenate([given, np.zeros((BLOCK - count, given.shape[1]))])
            yield at, given, count
