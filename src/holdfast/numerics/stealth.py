"""What a detector lets an attacker do: bounds of the shifts of the innovation, step by step."""

from typing import NamedTuple

import numpy as np
from scipy.sparse import block_array, csr_array, diags_array, eye_array, kron
from scipy.special import chdtrc, chdtri

from holdfast.numerics.chi_square import weighted_quantile
from holdfast.numerics.noncentral import alpha_chi2, alphas, largest_shift

DETECTORS = ("chi_square", "windowed", "sprt")


class Limits(NamedTuple):
    """sum_i w_ji z_i' Q^-1 z_i <= b_j: w (m x t (1 + f)), b (m,).

    Over the residuals of t steps, then over the f that are ahead of each of them.
    """

    w: csr_array
    b: np.ndarray


class Stealth(NamedTuple):
    """What the attacker must not do: raise the probability of an alarm by more than ``epsilon``.

    ``dof``: outputs; ``weights`` (length,): of a windowed test, oldest first.

    Source: INTEGRITY (16), Theorem 1, (47).
    """

    detector: str
    epsilon: float
    level: float
    dof: int
    weights: tuple[float, ...] = (1.0,) * 10

    @property
    def threshold(self) -> float:
        """h, the chi-square quantile of one step at the level."""
        return float(chdtri(self.dof, self.level))

    def alpha(self, ends: np.ndarray) -> np.ndarray:
        """The bound of the square root of the sum of squares that ends at each step of ``ends``.

        ``sprt``: of all steps up to it; ``windowed``: of the window that ends there (with
        unequal weights a bound that holds for any window); ``chi_square``: of the step alone.
        """
        ends = np.asarray(ends)
        p, h = self.dof, self.threshold
        if self.detector == "sprt":
            return alphas(self.epsilon, ends * p, 2.0 * h + ends * p)
        if self.detector == "chi_square":
            return np.full(len(ends), alpha_chi2(self.epsilon, p, h))
        return np.full(len(ends), self._window_alpha())

    @property
    def _used(self) -> np.ndarray:
        return np.array([w for w in self.weights if w > 0])

    @property
    def window_threshold(self) -> float:
        """The quantile of a full window's weighted sum at the level."""
        c = self._used
        return weighted_quantile(self.level, c, np.full(len(c), self.dof))

    def _window_alpha(self) -> float:
        """With c the smallest weight, c times a chi-square is below the sum: whatever keeps the
        sum's alarms rare keeps its tail small. Exact for equal weights.
        """
        c, dof = self._used, len(self._used) * self.dof
        if np.ptp(c) == 0:
            return alpha_chi2(self.epsilon, dof, float(chdtri(dof, self.level)))
        limit = self.window_threshold / np.min(c)
        return alpha_chi2(self.level + self.epsilon - float(chdtrc(dof, limit)), dof, limit)

    def limits(self, last: int, first: int = 0, blocks: int = 0, tight: bool = False) -> Limits:
        """What holds of the residuals of first + 1 .. last, and of ``blocks`` ahead of each.

        A window or sum that began before is cut: what is left of it is bounded all the same.
        ``tight``: of the sums, the one that ends at every step and not only at the last.
        """
        steps = last - first
        ends = np.arange(first + 1, last + 1)
        summed = self._rows(steps, 0)
        if self.detector == "sprt" and not tight:
            summed, ends = csr_array(np.ones((1, steps))), ends[-1:]
        rows, b = [[summed, *[None] * (blocks > 0)]], [self.alpha(ends) ** 2]
        for j in range(blocks):
            # what is ahead of a step comes instead of its residual, and so do those behind it
            ahead = np.zeros((1, blocks))
            ahead[0, : j + 1] = self._counted(j - np.arange(j + 1))
            rows.append([self._rows(steps, j, 1), kron(eye_array(steps), ahead)])
            b.append(self.alpha(np.arange(first + 1, last + 1) + j) ** 2)
        if self.detector == "windowed" and np.ptp(self._used) > 0:
            ages = np.minimum(np.arange(steps)[::-1], len(self.weights) - 1)
            rows.append([eye_array(steps), *[None] * (blocks > 0)])
            b.append(np.array(self._alone())[ages] ** 2)
        return Limits(csr_array(block_array(rows)), np.concatenate(b))

    def _rows(self, steps: int, later: int, youngest: int = 0) -> csr_array:
        """Row i sums what is ``youngest`` or older at step i and counts ``later`` steps on."""
        ages = np.arange(youngest, steps)
        ages = ages[self._counted(ages + later)]
        if self.detector != "sprt":
            ages = ages[ages < len(self.weights)]
        shape = (steps, steps)
        if not len(ages):
            return csr_array(shape)
        return csr_array(diags_array([1.0] * len(ages), offsets=(-ages).tolist(), shape=shape))

    def _counted(self, age: np.ndarray) -> np.ndarray:
        """Whether a residual of this age counts in the sum that is tested."""
        if self.detector == "sprt":
            return age >= 0
        if self.detector == "chi_square":
            return age == 0
        c = np.array(self.weights)
        inside = (age >= 0) & (age < len(c))
        return inside & (c[::-1][np.where(inside, age, 0)] > 0)

    def _alone(self) -> list[float]:
        """What a residual may be if it is the only one, by the oldest age it has been tested at."""
        c, limit = self._used, self.window_threshold
        dof, least, found = np.full(len(c), self.dof), np.inf, []
        at = len(c)
        for weight in self.weights[::-1]:
            if weight > 0:
                at -= 1
                least = min(least, largest_shift(self.epsilon, c, dof, limit, at))
            found.append(least)
        return found
