"""How many attacked sensors per step the l0 and the l1 decoder are certain to correct.

The window is y_t = C A^t x + e_t, t = 0 .. T - 1, where up to q sensors of each step are attacked,
others at every step ("hopping"), by anything; s_t = |supp(C A^t z)| for a state z other than 0.

The l0 decoder takes the x that leaves the fewest samples unexplained. An attack e makes it prefer
x + z, or not tell it from x, if e - Phi z has no more entries than e; the best that e can do is to
be Phi z on its support, an entry where z is not seen being wasted. The largest supports have
min(q, s_t) entries of those that see z. Thus q is corrected if and only if for all z

    sum_t s_t  >  2 sum_t min(q, s_t).

Some decoder corrects q if and only if no x + z explains what x does by another attack: if for all z
some step has s_t > 2 q. The paper's |supp(Phi z)| > 2 q T is enough for both, needed for neither.
The l1 decoder is certain to correct q if and only if for all z

    sum_t (the q largest |C_i A^t z|)  <  sum of all others,

which does not imply the condition of l0, nor follow from it.

Source: DECODER, Propositions 1 to 4 and Section III-E, put right.
"""

from typing import NamedTuple

import numpy as np

from holdfast.analysis.fusion import CERTAIN, LARGEST
from holdfast.analysis.model import Model
from holdfast.analysis.supports import hidden, observable_without, sparse_observable, supports
from holdfast.analysis.windows import (
    Bound,
    Smallest,
    bounds,
    first_windows,
    observability_matrix,
    parts,
    smallest,
)
from holdfast.numerics.ratio_bounds import Component, Ratios
from holdfast.numerics.rays import components, worst
from holdfast.numerics.zero_patterns import Counts, counted, effort, nothing

LARGEST_WINDOW = 5_000
"""Sensors times states times steps up to which a window is looked at."""
LIMIT = 1e7
"""Rays times rows that one window is worth: half a second."""


class Judged(NamedTuple):
    """Of one set of states that share no sample with the others: counts, and the worst ratio of
    the 1, 2, .. largest samples of each step to the others.
    """

    counts: Counts
    lower: np.ndarray
    upper: np.ndarray


class Correctable(NamedTuple):
    """What the decoders of a window of ``window`` steps are certain to correct.

    ``l0``, ``l1``: attacked sensors per step, at hopping positions, for which each decoder
    gives the state, looked for up to ``most`` = (p - 1) / 2; ``any``: for which some decoder
    does. ``lower``, ``upper`` (most,): the worst l1 ratio for 1, 2, .. samples of each step,
    certain under 1. ``cospark``: the least number of samples of the window that see a state;
    ``relaxed``: attacked samples of the whole window, wherever they are, that l0 corrects.
    ``fixed_l0``, ``fixed_l1``, ``fixed``: the same where the attacked sensors stay the same
    and a decoder weighs them as wholes. ``supports``: |supp(C v)| of each eigenvalue.
    ``smallest``: windows for q = 1, 2, ... ``observed``: whether the window determines the
    state at all. ``reason``: why there is nothing of all this.
    """

    reason: str | None
    window: int
    most: int = 0
    observed: bool = False
    l0: Bound = Bound(0, 0)
    l1: Bound = Bound(0, 0)
    any: Bound = Bound(0, 0)
    lower: np.ndarray = np.zeros(0)
    upper: np.ndarray = np.zeros(0)
    cospark: Bound = Bound(0, 0)
    fixed_l0: int | None = None
    fixed_l1: Bound = Bound(0, 0)
    fixed: Ratios | None = None
    supports: tuple[int, ...] | None = None
    smallest: tuple[Smallest, ...] = ()

    @property
    def relaxed(self) -> Bound:
        """Attacked samples of the whole window: ceil(cospark / 2) - 1."""
        return Bound(*(max(0, (count - 1) // 2) for count in self.cospark))


def correctable(
    model: Model, window: int, trusted: tuple[int, ...] = (), weight: np.ndarray | None = None
) -> Correctable:
    """What the decoders of ``window`` steps of ``model`` are certain to correct.

    ``trusted`` sensors are authenticated: their samples are exact, so that only the z that they
    do not see can be mistaken. ``weight`` (p,) or (window x p): of the samples in the l1 sums;
    none: 1.

    Source: DECODER, Propositions 1 to 4 and Section III-E, put right.
    """
    p, n = model.C.shape
    if p * n > LARGEST or p * n * window > LARGEST_WINDOW:
        return Correctable(
            f"{p} sensors, {n} states and {window} steps are too many to look at", window
        )
    most = max(1, (p - 1) // 2)
    seen = supports(model, trusted)
    along = None if seen is None else tuple(m.number for m in seen for _ in range(m.multiplicity))
    if hidden(model, tuple(range(p)), window).shape[1]:
        never = np.full(most, np.inf)
        return Correctable(None, window, most, lower=never, upper=never, fixed_l0=0, supports=along)
    found, lower, upper = together(
        judge(parts(model, window, trusted, weight), window, most, LIMIT), most
    )
    # what holds of the eigenvectors holds in any window
    lasting = sparse_observable(model, trusted)
    limit = most if lasting is None else min(most, lasting)
    tried = first_windows(model, window, trusted, limit)
    l0, some, cospark = bounds(model, found, window, limit, tried, trusted)
    lower, upper = _not_under(lower, upper, some.upper)
    l1 = certain(lower, upper)
    fixed, fixed_l0 = (
        _fixed(model, window, trusted, weight, most),
        observable_without(model, window, trusted),
    )
    fixed_sets = _not_under(*fixed[2:], most if fixed_l0 is None else fixed_l0)
    return Correctable(
        reason=None,
        window=window,
        most=most,
        observed=True,
        l0=l0,
        l1=l1,
        any=Bound(max(some.lower, l1.lower), some.upper),
        lower=lower,
        upper=upper,
        cospark=cospark,
        fixed_l0=None if fixed_l0 is None else min(fixed_l0, most),
        fixed_l1=certain(*fixed_sets),
        fixed=Ratios(*fixed[:2], *fixed_sets),
        supports=along,
        smallest=smallest(model, limit, tried, trusted),
    )


def judge(
    found: list[Component],
    window: int,
    most: int,
    limit: float,
    known: dict[object, Judged] | None = None,
) -> list[Judged]:
    """Each of the `parts`, exactly where ``limit`` allows as many rays times rows as it takes.

    ``known``: what was found before, under a key that two plants share where they agree.
    """
    known, judged = {} if known is None else known, []
    for part in found:
        key = (part.parts.tobytes(), part.block.tobytes(), part.blocks, window, most)
        if key not in known:
            each = limit / len(found)
            counts = counted(part, window, most, each)
            few = min(most, part.blocks // window)
            ratios = worst([part], part.blocks, few, each, window)
            # as many as there are sensors leave nothing of the others
            lower, upper = (np.append(ratio, np.full(most - few, np.inf)) for ratio in ratios[2:])
            known[key] = Judged(counts, lower, upper)
        judged.append(known[key])
    return judged


def affordable(found: list[Component], limit: float) -> bool:
    """Whether `judge` is exact within ``limit``."""
    return all(effort(part) <= limit / len(found) for part in found)


def together(judged: list[Judged], most: int) -> Judged:
    """The whole plant's: the counts and the ratios of the worst part."""
    counts, lower, upper = nothing(most), np.zeros(most), np.zeros(most)
    for part in judged:
        counts = counts.worse(part.counts)
        lower, upper = np.maximum(lower, part.lower), np.maximum(upper, part.upper)
    return Judged(counts, lower, upper)


def _fixed(
    model: Model, window: int, trusted: tuple[int, ...], weight: np.ndarray | None, most: int
) -> Ratios:
    """Worst l1 ratios where sensors are attacked over the whole window, as wholes."""
    Phi = np.swapaxes(observability_matrix(model, window, weight), 0, 1)
    return worst(components(Phi, np.arange(window), trusted), len(Phi), most, LIMIT)


def _not_under(lower: np.ndarray, upper: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of ratios of which only the first ``most`` can be under 1."""
    lower = np.where(np.arange(1, len(lower) + 1) > most, np.maximum(lower, 1.0), lower)
    return lower, np.maximum(upper, lower)


def certain(lower: np.ndarray, upper: np.ndarray) -> Bound:
    """For how many attacks per step the ratio, between these bounds, is under 1."""
    return Bound(*(int(np.sum(np.cumprod(ratio < CERTAIN))) for ratio in (upper, lower)))
