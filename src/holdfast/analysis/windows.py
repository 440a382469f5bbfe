"""The counts of a window of samples, and the smallest window that corrects an attack.

The condition for the l0 decoder is that of `holdfast.analysis.correctable`.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from holdfast.analysis.model import Model
from holdfast.analysis.supports import cancellations, fewest_samples, hidden, sharper, theorem_1
from holdfast.estimators.decoder_window import Matched, laid_out
from holdfast.numerics.ratio_bounds import Component
from holdfast.numerics.rays import components
from holdfast.numerics.subspaces import TOLERANCE, modes
from holdfast.numerics.zero_patterns import Counts, counted, effort, nothing

SEARCHED = 1e7
"""Rays times rows that all the windows are worth which are tried for the smallest one."""
LONGEST = 3
"""Multiple of the number of states (or of the window in use) up to which windows are tried."""


class Bound(NamedTuple):
    """A whole number between two bounds; equal ones are exact."""

    lower: int
    upper: int

    @property
    def exact(self) -> int | None:
        """The number, None where it is not known."""
        return self.lower if self.lower == self.upper else None


class Smallest(NamedTuple):
    """For q attacked samples per step: the smallest window of Theorem 1, that of cancellations
    counted sensor by sensor, and the first that l0 can do with; None where there is none or it
    was too dear to find.
    """

    theorem_1: int | None
    sharper: int | None
    exact: int | None


def observability_matrix(model: Model, window: int, weight: np.ndarray | None = None) -> np.ndarray:
    """Phi = [C; C A; ..] as (window x p x n), times ``weight`` (p,) or (window x p)."""
    rows = [model.C]
    for _ in range(window - 1):
        rows.append(rows[-1] @ model.A)
    Phi = np.stack(rows)
    return Phi if weight is None else Phi * weight[..., None]


def noise_weights(model: Model, window: int) -> np.ndarray:
    """1 / sd of each sample (window x p), given the state, as a decoder weighs by noise.

    1 where there is no noise.
    """
    stack = [jnp.broadcast_to(m, (window, *m.shape)) for m in (model.A, model.C, model.Q, model.R)]
    sd = np.asarray(laid_out(Matched(*stack)).law.sd).reshape(window, -1)
    return 1.0 / np.where(sd > 0.0, sd, 1.0)


def parts(
    model: Model, window: int, trusted: tuple[int, ...] = (), weight: np.ndarray | None = None
) -> list[Component]:
    """The sets of states that share no sample, of the z that ``trusted`` sensors do not see.

    The blocks are the samples: ``window`` runs of the sensors that see the set.
    """
    p, n = model.C.shape
    Phi = observability_matrix(model, window, weight)
    samples = tuple(t * p + i for t in range(window) for i in trusted)
    found = []
    for part in components(Phi.reshape(-1, 1, n), np.zeros(1, int), samples):
        step, sensor = divmod(part.block, p)
        own, place = np.unique(sensor, return_inverse=True)
        found.append(Component(part.parts, step * len(own) + place, window * len(own)))
    return found


def first_windows(
    model: Model, window: int, trusted: tuple[int, ...], limit: int
) -> dict[int, Counts]:
    """The exact counts of windows 1, 2, .. until ``limit`` attacks per step are corrected."""
    p, n = model.C.shape
    found, left = {}, SEARCHED
    for T in range(1, LONGEST * max(n, window) + 1):
        if hidden(model, tuple(range(p)), T).shape[1]:
            continue
        found_parts = parts(model, T, trusted)
        left -= sum(effort(part) for part in found_parts)
        if left < 0.0:
            break
        found[T] = nothing(max(1, limit))
        for part in found_parts:
            found[T] = found[T].worse(counted(part, T, max(1, limit), SEARCHED))
        if passed(found[T].share) >= limit:
            break
    return found


def passed(share: np.ndarray) -> int:
    """For how many attacks per step l0 is right: the share of `Counts` is under a half."""
    return int(np.sum(np.cumprod(share < 0.5)))


def bounds(
    model: Model,
    counts: Counts,
    window: int,
    limit: int,
    tried: dict[int, Counts],
    trusted: tuple[int, ...],
) -> tuple[Bound, Bound, Bound]:
    """l0, any, and the cospark; bounds where not all z were looked at."""
    most = len(counts.share)
    l0 = min(limit, passed(counts.share))
    some = limit if np.isinf(counts.tallest) else min(limit, max(0, int(counts.tallest - 1) // 2))
    size = window * len(model.C) + 1
    cospark = size if np.isinf(counts.fewest) else int(counts.fewest)
    if counts.exact:
        return Bound(l0, l0), Bound(some, some), Bound(cospark, cospark)
    q, fewest = _from_pieces(model, window, tried, most)
    cancelled = None if trusted else cancellations(model)
    if cancelled is not None:
        fewest = max(fewest, fewest_samples(cancelled, window))
    q = min(l0, max(q, min(most, max(0, (fewest - 1) // (2 * window)))))
    return Bound(q, l0), Bound(q, some), Bound(fewest, cospark)


def _from_pieces(model: Model, window: int, tried: dict[int, Counts], most: int) -> tuple[int, int]:
    """What is certain of l0 and of the cospark from shorter windows.

    The count of a window is the sum of those of its pieces: of the first, of T steps, at z, of
    the next at A^T z. Where that is 0, so are all later counts; thus pieces that each correct
    q do so together, and the cosparks of pieces add up if A is regular.
    """
    regular = all(abs(z) > TOLERANCE for z, _ in modes(model.A))
    q, fewest = [most] + [0] * window, [0] * (window + 1)
    for T in range(1, window + 1):
        for first, counts in tried.items():
            if first > T or np.isinf(counts.fewest):
                continue
            q[T] = max(q[T], min(passed(counts.share), q[T - first]))
            fewest[T] = max(fewest[T], int(counts.fewest) + regular * fewest[T - first])
    return q[window], fewest[window]


def smallest(
    model: Model, limit: int, tried: dict[int, Counts], trusted: tuple[int, ...]
) -> tuple[Smallest, ...]:
    """For q = 1 .. ``limit``."""
    found = []
    for q in range(1, limit + 1):
        first = [T for T, counts in tried.items() if passed(counts.share) >= q]
        by_counting = (None, None) if trusted else (theorem_1(model, q), sharper(model, q))
        found.append(Smallest(*by_counting, min(first, default=None)))
    return tuple(found)
