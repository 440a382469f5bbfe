"""What to add or to authenticate in order that a decoder corrects attacks at every step."""

import itertools
from typing import Literal, NamedTuple

import numpy as np

from holdfast.analysis.correctable import (
    Correctable,
    Judged,
    affordable,
    certain,
    correctable,
    judge,
    together,
)
from holdfast.analysis.model import Model
from holdfast.analysis.supports import hidden
from holdfast.analysis.windows import observability_matrix, parts, passed
from holdfast.numerics.ratio_bounds import gathered
from holdfast.numerics.subspaces import legible, scaled, span
from holdfast.numerics.zero_patterns import ZERO

DEAREST = 2e6
"""Rays times rows of a plant up to which a remedy is tried."""
MOST = 3
"""Remedies that are put together."""

Way = Literal["authenticate", "measure"]
Decoder = Literal["l0", "l1"]
WAYS: tuple[Way, ...] = ("authenticate", "measure")
DECODERS: tuple[Decoder, ...] = ("l0", "l1")


class Remedy(NamedTuple):
    """A sensor authenticated, or a state measured as well: what l0 and l1 then correct.

    None: too dear to find out.
    """

    name: str
    l0: int | None
    l1: int | None


class Plan(NamedTuple):
    """Sensors to authenticate, or states to measure as well, one after the other.

    ``enough``: whether ``decoder`` is then certain to correct as many attacks per step as was
    wished. ``untried``: how many steps of the search were too dear.
    """

    decoder: Decoder
    way: Way
    names: tuple[str, ...]
    enough: bool
    untried: int = 0


class Exposed(NamedTuple):
    """A direction of the state (n,) that no more than two sensors see in the window."""

    sensors: tuple[str, ...]
    direction: np.ndarray


def exposed(model: Model, window: int, trusted: tuple[int, ...] = ()) -> tuple[Exposed, ...]:
    """What one sensor alone sees, and what two do beyond that; ``trusted`` ones do not count.

    An attack on the one makes any value of it fit, and of two that disagree nobody knows which
    one lies: no decoder corrects even one attack that stays where it is. None of this, in
    numbers, is |union over t of supp(C A^t z)| > 2.

    Source: DECODER, Proposition 1.
    """
    p = len(model.C)
    unit = scaled(model.A, np.zeros((len(model.A), 0)), model.C, np.zeros((p, 0))).x[:, None]
    known: dict[tuple[int, ...], np.ndarray] = {(): _without(model, (), window)}
    found = []
    for few in (1, 2):
        for those in itertools.combinations([i for i in range(p) if i not in trusted], few):
            known[those] = _without(model, those, window)
            less = [known[fewer] for fewer in itertools.combinations(those, few - 1)]
            left = legible(_beyond(known[those], np.hstack(less)) * unit)
            names = tuple(model.outputs[i] for i in those)
            found += [Exposed(names, v) for v in left.T]
    return tuple(found)


def _without(model: Model, those: tuple[int, ...], window: int) -> np.ndarray:
    return hidden(model, tuple(i for i in range(len(model.C)) if i not in those), window)


def _beyond(space: np.ndarray, known: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what is in ``space`` (n x r) and orthogonal to ``known``."""
    within = span(known)
    return span(space - within @ (within.T @ space))


def singles(
    model: Model,
    window: int,
    way: Way,
    trusted: tuple[int, ...] = (),
    weight: np.ndarray | None = None,
    known: dict | None = None,
) -> tuple[Remedy, ...]:
    """Each sensor authenticated alone, or each state measured as well alone.

    Attacks per step are looked for up to (p - 1) / 2, as in `correctable`.
    """
    most, known = max(1, (len(model.C) - 1) // 2), {} if known is None else known
    now, found = _Setting(model, trusted, weight), []
    if way == "measure" and not now.affordable(window):
        return tuple(Remedy(name, None, None) for name in model.states)
    for i, name in enumerate(_names(model, way)):
        after = now.with_(way, i)
        judged = after.judged(window, most, known)
        if judged is None:
            found.append(Remedy(name, None, None))
        elif after.blind(window):
            found.append(Remedy(name, 0, 0))
        else:
            whole = together(judged, most)
            l0 = passed(whole.counts.share)
            found.append(Remedy(name, l0, certain(whole.lower, whole.upper).lower))
    return tuple(found)


def remedies(
    model: Model,
    window: int,
    q: int = 1,
    decoder: Decoder = "l1",
    way: Way = "measure",
    most: int = MOST,
    trusted: tuple[int, ...] = (),
    weight: np.ndarray | None = None,
    known: dict | None = None,
) -> Plan:
    """What to authenticate or to measure so that ``decoder`` corrects q attacks per step.

    Greedy: of all states or sensors the one that leaves the least wrong, up to ``most`` in
    turn, and in the end without those that are not needed after all; a state may be measured
    several times. "Wrong" are the parts of the plant where q attacks are not corrected, each by
    how much. ``trusted``, ``weight``: as in `correctable`; a new sensor has the median weight of
    its step. ``known``: of earlier calls for the same ``window``, to save time.
    """
    known = {} if known is None else known
    looked, names = max(q, (len(model.C) - 1) // 2), _names(model, way)
    start, chosen, untried = _Setting(model, trusted, weight), [], 0

    def wrong(those: list[int]) -> tuple[float, float]:
        nonlocal untried
        after = start
        for i in those:
            after = after.with_(way, i)
        found = after.wrong(window, q, decoder, looked, known)
        untried += found[0] == np.inf
        return found

    left = wrong([])
    if way == "measure" and left[0] == np.inf:
        return Plan(decoder, way, (), False, untried)
    while left[0] > 0.0 and len(chosen) < most:
        options = [wrong([*chosen, i]) for i in range(len(names))]
        best = min(range(len(names)), key=options.__getitem__)
        if options[best] >= left:
            break
        left = options[best]
        chosen.append(best)
    for i in list(chosen) if left[0] == 0.0 else ():
        fewer = chosen.copy()
        fewer.remove(i)
        chosen = fewer if wrong(fewer)[0] == 0.0 else chosen
    return Plan(decoder, way, tuple(names[i] for i in chosen), left[0] == 0.0, untried)


class _Setting(NamedTuple):
    """A plant with some sensors trusted."""

    model: Model
    trusted: tuple[int, ...]
    weight: np.ndarray | None

    def with_(self, way: Way, i: int) -> "_Setting":
        if way == "authenticate":
            return self._replace(trusted=tuple(sorted({*self.trusted, i})))
        weight = self.weight
        if weight is not None:
            weight = np.append(weight, np.median(weight, -1, keepdims=True), -1)
        return self._replace(model=self.model.measuring(i), weight=weight)

    def blind(self, window: int) -> int:
        """How many directions of the state the window does not show."""
        return hidden(self.model, tuple(range(len(self.model.C))), window).shape[1]

    def judged(self, window: int, most: int, known: dict) -> list[Judged] | None:
        found = parts(self.model, window, self.trusted, self.weight)
        return judge(found, window, most, DEAREST, known) if affordable(found, DEAREST) else None

    def affordable(self, window: int) -> bool:
        return affordable(parts(self.model, window, self.trusted, self.weight), DEAREST)

    def wrong(
        self, window: int, q: int, decoder: Decoder, most: int, known: dict
    ) -> tuple[float, float]:
        """(0, 0) where q attacks per step are corrected; infinite if too dear.

        First the shares of the attacked that are too large, added up over the parts; then, as
        the worst direction of a part may stay while others are mended, those of the states.
        """
        judged = self.judged(window, most, known)
        if judged is None:
            return np.inf, np.inf
        left = 2.0 * self.blind(window)
        for part in judged:
            if decoder == "l0" and passed(part.counts.share) < q:
                left += float(np.sum(part.counts.share[:q]))
            if decoder == "l1" and certain(part.lower, part.upper).lower < q:
                left += float(np.sum(_share(part.upper[:q])))
        # what rounding does is no progress
        return (round(left, 9), round(self._exposure(window, q, decoder), 9)) if left else (0, 0)

    def _exposure(self, window: int, q: int, decoder: Decoder) -> float:
        """The shares of up to q samples per step in what is seen of each state alone."""
        seen = np.abs(observability_matrix(self.model, window, self.weight))
        free = seen[:, [i for i in range(seen.shape[1]) if i not in self.trusted]]
        free = np.where(np.any(seen[:, list(self.trusted)] > 0.0, axis=(0, 1)), 0.0, free)
        if decoder == "l0":
            free = (free > ZERO * np.max(seen, axis=(0, 1))).astype(float)
        sums = gathered(np.moveaxis(free, 2, 0).reshape(free.shape[2], -1), window)
        ends = np.where(sums[:, -1:] > 0.0, sums[:, -1:], 1.0)
        return float(np.sum(sums[:, :q] / ends))


def _share(ratio: np.ndarray) -> np.ndarray:
    finite = np.where(np.isinf(ratio), 0.0, ratio)
    return np.where(np.isinf(ratio), 1.0, finite / (1.0 + finite))


def _names(model: Model, way: Way) -> tuple[str, ...]:
    return model.outputs if way == "authenticate" else model.states


class Decoding(NamedTuple):
    """What decoders of a window correct on a plant, what they never can, and what would help.

    ``trusted``, ``measured``: each sensor authenticated, each state measured as well.
    ``plans``: for one attack per step, where it is not corrected as it is.
    """

    correctable: Correctable
    exposed: tuple[Exposed, ...] = ()
    trusted: tuple[Remedy, ...] = ()
    measured: tuple[Remedy, ...] = ()
    plans: tuple[Plan, ...] = ()


def decoding(
    model: Model, window: int, trusted: tuple[int, ...] = (), weight: np.ndarray | None = None
) -> Decoding:
    """All of it, for one window; ``trusted`` sensors and ``weight`` as in `correctable`."""
    found = correctable(model, window, trusted, weight)
    if found.reason is not None:
        return Decoding(found)
    known: dict[object, Judged] = {}
    # trust does not show what no sample does
    ways = WAYS if found.observed else ("measure",)
    plans = tuple(
        remedies(model, window, 1, decoder, way, MOST, trusted, weight, known)
        for decoder in DECODERS
        if getattr(found, decoder).lower == 0
        for way in ways
    )
    return Decoding(
        found,
        exposed(model, window, trusted),
        singles(model, window, "authenticate", trusted, weight, known),
        singles(model, window, "measure", trusted, weight, known),
        plans,
    )
