"""How many lying sensors the LASSO fusion of local estimates withstands, and which ones."""

from typing import NamedTuple

import numpy as np

from holdfast.analysis.model import Model
from holdfast.analysis.supports import sparse_observable
from holdfast.numerics.local import Local, Unfit, decompose
from holdfast.numerics.ratio_bounds import Component
from holdfast.numerics.rays import MOST, affordable, components, worst
from holdfast.numerics.steady_state import SteadyState, steady_state

CERTAIN = 1.0 - 1e-9
"""A ratio from which on nothing is certain."""
LARGEST = 1000
"""Sensors times states up to which a plant is looked at."""
DEAREST = 30_000
"""The same for sensors times states squared: some five seconds."""
ILL = 1e6
"""Condition of the paper's coordinates from which they are called ill-conditioned."""


class Remedy(NamedTuple):
    """A sensor authenticated, or a state measured as well, and the ratio left for p = 1."""

    name: str
    lower: float
    upper: float

    @property
    def enough(self) -> bool:
        """Whether one lying sensor is then withstood."""
        return self.upper < CERTAIN


class Fusion(NamedTuple):
    """The worst ratios sum over I of |G_i u|_1 / sum over the others, in the paper's coordinates.

    ``lower``, ``upper`` (m,): of each sensor alone; ``lower_sets``, ``upper_sets``: of the
    worst 1, 2, .. sensors, up to (m - 1) / 2. Equal bounds are exact. ``sparse_observable``:
    the largest p such that no 2 p sensors are needed to observe the state (None: too dear to
    find out). ``authenticate``, ``add``: best first; ``untried`` of them were too dear.
    ``condition``: of the paper's coordinates. ``reason``: why there is nothing of all this.
    """

    reason: str | None
    sensors: tuple[str, ...] = ()
    lower: np.ndarray = np.zeros(0)
    upper: np.ndarray = np.zeros(0)
    lower_sets: np.ndarray = np.zeros(0)
    upper_sets: np.ndarray = np.zeros(0)
    sparse_observable: int | None = None
    authenticate: tuple[Remedy, ...] = ()
    add: tuple[Remedy, ...] = ()
    untried: int = 0
    condition: float | None = None
    derogatory: bool | None = None

    @property
    def bounded(self) -> tuple[bool, ...]:
        """Of each sensor: whether what it does by lying alone is certain to stay bounded."""
        return tuple(bool(upper < CERTAIN) for upper in self.upper)

    @property
    def withstood(self) -> int | None:
        """How many sensors may lie, whichever they are."""
        if self.reason is not None:
            return None
        return int(np.sum(np.cumprod(self.upper_sets < CERTAIN)))

    @property
    def ill_conditioned(self) -> bool:
        """Whether rounding in the paper's coordinates may matter."""
        return self.condition is not None and self.condition > ILL


def fusion(model: Model, steady: SteadyState) -> Fusion:
    """Whether a lie of p sensors moves the secure estimate by a bounded amount.

    It does, whichever p sensors lie, if for all of them and all u other than 0

        sum over I of |G_i u|_1  <  sum over the others of |G_i u|_1;

    where some u has >, a lie of these sensors that looks like a state far along u is believed.

    Source: DECOMPOSE, Theorem 4.
    """
    m, n = model.C.shape
    if m == 1:
        return Fusion("there is one sensor, and no other to compare it with")
    if m * n > LARGEST or m * n**2 > DEAREST:
        return Fusion(f"{m} sensors and {n} states are too many to look at")
    try:
        local = _local(model, steady)
    except Unfit as reason:
        return Fusion(str(reason))
    most = max(1, (m - 1) // 2)
    ratios = worst(components(*_paper(local)), m, most)
    known = sparse_observable(model)
    fails = np.arange(1, most + 1) > (most if known is None else known)
    lower_sets = np.where(fails, np.maximum(ratios.lower_sets, 1.0), ratios.lower_sets)
    limit = MOST / (m + n)
    authenticated, added = _authenticated(model, local, limit), _added(model, local, limit)
    return Fusion(
        None,
        model.outputs,
        ratios.lower,
        ratios.upper,
        lower_sets,
        np.maximum(ratios.upper_sets, lower_sets),
        known,
        _ranked(authenticated),
        _ranked(added),
        (authenticated + added).count(None),
        local.coordinates.condition,
        local.derogatory,
    )


def _local(model: Model, steady: SteadyState) -> Local:
    if steady.K is None:
        raise Unfit(f"there is no steady-state Kalman filter: {steady.reason}")
    return decompose(model.A, model.C, model.Q, model.R, steady.K)


def _paper(local: Local) -> tuple[np.ndarray, np.ndarray]:
    """G (m x d x n), weighted such that the norm is a sum over groups, and the groups."""
    group = local.coordinates.group
    return local.paper_G() * local.coordinates.weight[group][:, None], group


def _authenticated(model: Model, local: Local, limit: float) -> list[Remedy | None]:
    """Each sensor trusted alone: its local estimate is exact, so only u with G_i u = 0 count."""
    own = local.G.reshape(local.sensors, len(local.b), -1)
    return [
        _remedy(name, components(*_paper(local), (i,), own[i]), local.sensors, limit)
        for i, name in enumerate(model.outputs)
    ]


def _added(model: Model, local: Local, limit: float) -> list[Remedy | None]:
    """Each state measured as well, as noisily as the sensors are in the middle."""
    if not affordable(components(*_paper(local)), limit):
        return [None] * len(model.states)
    found: list[Remedy | None] = []
    for i, name in enumerate(model.states):
        more = model.measuring(i)
        more.R[-1, -1] = np.median(np.diagonal(model.R))
        try:
            known = _local(more, steady_state(more.A, more.C, more.Q, more.R))
        except Unfit:
            continue
        found.append(_remedy(name, components(*_paper(known)), known.sensors, limit))
    return found


def _remedy(name: str, found: list[Component], sensors: int, limit: float) -> Remedy | None:
    """None where it is too dear to say."""
    if not affordable(found, limit):
        return None
    ratios = worst(found, sensors, 1, limit)
    return Remedy(name, float(ratios.lower_sets[0]), float(ratios.upper_sets[0]))


def _ranked(remedies: list[Remedy | None]) -> tuple[Remedy, ...]:
    tried = [remedy for remedy in remedies if remedy is not None]
    return tuple(sorted(tried, key=lambda remedy: (remedy.upper, remedy.lower)))
