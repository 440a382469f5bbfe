"""The penalty of a secure fusion: its groups, its columns, and gamma by a stated rule.

A benign bank has zeta = G x - e with e ~ N(0, W), and so c = -Z' zeta ~ N(0, I) independent of the
Kalman error: what gamma costs without attack needs no simulation over time. A constant attack a on
sensor i ends in e_i = (I - S)^-1 b a, a shift of c.

Source: DECOMPOSE (31), Theorem 3, Remarks 3 and 4.
"""

from collections.abc import Sequence
from functools import partial
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from holdfast.numerics.group_lasso import group_lasso
from holdfast.numerics.lasso import Solution, Warm, cold, lasso
from holdfast.numerics.local import Local, Residuals

Rule = Literal["coincide", "loss", "worst_case"]
RULES = get_args(Rule)
DRAWS = 4000
"""Draws of the exact Gaussian: a share of 0.95 is then known to 0.0035, a loss of 1 % to 3 % of
itself."""
DEAR_DRAWS = 400
"""The same where a bank has more than `MANY` penalty variables, or cones."""
MANY = 60
PARALLEL = 1e3
"""Condition of the penalty's coordinates up to which the active-set method keeps its digits."""
HALVINGS = 18
GRID = 13
FEWER = 8
"""How many times fewer draws a search over attacks has at each point."""


class Penalty(NamedTuple):
    """gamma sum_g weight_g |f_g| over the columns of sensors that may lie.

    ``group`` (M,) numbers the group of each column, ``weight`` (g,) without gamma; ``change``
    (M x N) takes a bank's own coordinates to the penalty's, ``back`` (N x M) the other way, zero
    for sensors that cannot lie. ``plain``: every column is a group of its own, and they are far
    enough from parallel for the faster method.
    """

    group: np.ndarray
    weight: np.ndarray
    change: np.ndarray
    back: np.ndarray
    plain: bool


def penalty(local: Local, norm: Literal["modulus", "group"], honest: Sequence[int]) -> Penalty:
    """The penalty of (31) in the paper's coordinates, or the 2-norm of each sensor's part.

    "group" is posed in the bank's own basis, which is well-conditioned for every plant.
    ``honest``: sensors that are always authenticated and so carry no variable.
    """
    m, d = local.sensors, len(local.b)
    lying = [i for i in range(m) if i not in set(honest)]
    if norm == "group":
        rows, group, weight = np.eye(d), np.zeros(d, int), np.ones(1)
    else:
        rows, group, weight = local.coordinates
    pick = np.eye(m)[lying]
    return Penalty(
        np.concatenate([group + i * len(weight) for i in range(len(lying))] or [group[:0]]),
        np.tile(weight, len(lying)),
        np.kron(pick, rows),
        np.kron(pick.T, np.linalg.inv(rows)),
        len(weight) == len(group) and bool(np.linalg.cond(rows) <= PARALLEL),
    )


def solve(
    Z: Float[Array, "M r"],
    w: Float[Array, " g"],
    c: Float[Array, " r"],
    group: np.ndarray,
    warm: Warm | Float[Array, " M"],
) -> tuple[Solution, Warm | Float[Array, " M"]]:
    """The minimiser by the method for its groups, and where to start next time.

    0 where nothing is penalised, or where one sensor alone leaves nothing over.
    """
    if 0 in Z.shape:
        return Solution(jnp.zeros(len(Z)), c, jnp.zeros(()), jnp.asarray(0)), warm
    if isinstance(warm, Warm):
        return lasso(Z, w, c, warm)
    solution = group_lasso(Z, w, c, group, warm)
    return solution, solution.f


def begin(Z: Float[Array, "M r"], plain: bool) -> Warm | Float[Array, " M"]:
    """Where `solve` starts the first time."""
    return cold(Z) if plain and 0 not in Z.shape else jnp.zeros(Z.shape[0])


class Chosen(NamedTuple):
    """``gamma``, and what it costs: the share of rows that coincide with Kalman and the relative
    loss of mean squared error, both without attack; ``worst`` over the attacks looked at, as a
    multiple of Kalman's without attack.
    """

    gamma: float
    coincide: float
    loss: float
    worst: float | None


class _Benign(NamedTuple):
    """Draws of c without attack (k x r), and how the fusion's error follows from f."""

    c: np.ndarray
    fused: Residuals
    penalty: Penalty
    trace: float

    def error(self, gamma: float, shift: np.ndarray | None = None) -> float:
        """Mean squared error with a ``shift`` (N,) of the local errors:
        tr P + E |F (shift - f)|^2.
        """
        none = np.zeros(len(self.fused.Z))
        shift = none if shift is None else shift
        Z = self.penalty.back.T @ self.fused.Z
        w = jnp.asarray(gamma * self.penalty.weight)
        c = jnp.asarray(self.c + shift @ self.fused.Z)
        group = tuple(self.penalty.group.tolist())
        f = _minimisers(jnp.asarray(Z), w, c, group, self.penalty.plain)
        left = (shift - np.asarray(f) @ self.penalty.back.T) @ self.fused.F.T
        return self.trace + float(np.mean(np.sum(left**2, 1)))

    def needed(self) -> np.ndarray:
        """The gamma from which each draw coincides with Kalman: max_g |(Z c)_g| / weight_g."""
        pulls = self.c @ self.fused.Z.T @ self.penalty.back
        squares = np.zeros((len(self.penalty.weight), len(self.c)))
        np.add.at(squares, self.penalty.group, pulls.T**2)
        return np.max(np.sqrt(squares) / self.penalty.weight[:, None], axis=0, initial=0.0)


def choose(
    local: Local,
    fused: Residuals,
    found: Penalty,
    rule: Rule,
    share: float,
    sizes: np.ndarray,
    seed: int,
) -> Chosen:
    """Gamma by a rule.

    "coincide": the smallest with which a share ``share`` of benign rows equals Kalman (32), (33).
    "loss": the smallest whose benign mean squared error is at most 1 + ``share`` of Kalman's.
    "worst_case": the least worst mean squared error over no attack and a constant one of
    ``sizes`` (m,) on each sensor in turn.
    """
    benign = _benign(local, fused, found, seed)
    if rule == "coincide":
        return _told(benign, float(np.quantile(benign.needed(), share)))
    if rule == "loss":
        return _told(benign, _by_loss(benign, share))
    shifts = constant_attacks(local, sizes)
    gamma = _by_worst_case(benign._replace(c=benign.c[::FEWER]), shifts)
    return _told(benign, gamma)._replace(worst=_worst(benign, shifts, gamma) / benign.trace)


def costs(local: Local, fused: Residuals, found: Penalty, gamma: float, seed: int) -> Chosen:
    """What a given gamma costs without attack."""
    return _told(_benign(local, fused, found, seed), gamma)


def constant_attacks(local: Local, sizes: np.ndarray) -> list[np.ndarray]:
    """Where a constant attack of each size on its sensor drives the local errors (N,)."""
    settled = np.linalg.solve(np.eye(len(local.b)) - local.S, local.b)
    return [np.kron(row, settled) for row in -np.diag(sizes)]


def _benign(local: Local, fused: Residuals, found: Penalty, seed: int) -> _Benign:
    dear = len(found.group) > MANY or not found.plain
    count = DEAR_DRAWS if dear else DRAWS
    c = np.asarray(jax.random.normal(jax.random.key(seed), (count, fused.Z.shape[1])))
    trace = float(np.trace(fused.F @ local.W @ fused.F.T))
    return _Benign(c, fused, found, trace)


@partial(jax.jit, static_argnames=("group", "plain"))
def _minimisers(Z, w, c, group: tuple[int, ...], plain: bool) -> Array:
    """The minimiser for each row of ``c``."""

    def one(c):
        return solve(Z, w, c, np.array(group, int), begin(Z, plain))[0].f

    return jax.lax.map(one, c)


def _told(benign: _Benign, gamma: float) -> Chosen:
    coincide = float(np.mean(benign.needed() <= gamma))
    return Chosen(gamma, coincide, benign.error(gamma) / benign.trace - 1.0, None)


def _by_loss(benign: _Benign, share: float) -> float:
    """The loss falls with gamma: halve in its logarithm."""
    high = float(np.max(benign.needed()))
    low = 1e-4 * high
    for _ in range(HALVINGS):
        middle = np.sqrt(low * high)
        if benign.error(middle) > (1.0 + share) * benign.trace:
            low = middle
        else:
            high = middle
    return float(high)


def _worst(benign: _Benign, shifts: list[np.ndarray], gamma: float) -> float:
    return max(benign.error(gamma, shift) for shift in (None, *shifts))


def _by_worst_case(benign: _Benign, shifts: list[np.ndarray]) -> float:
    """The best of a logarithmic grid, and of a finer one about it."""
    high = float(np.max(benign.needed()))
    if high == 0:
        return high
    coarse = np.geomspace(1e-4 * high, high, GRID)
    best = int(np.argmin([_worst(benign, shifts, gamma) for gamma in coarse]))
    fine = np.geomspace(coarse[max(best - 1, 0)], coarse[min(best + 1, GRID - 1)], GRID)
    return float(fine[int(np.argmin([_worst(benign, shifts, gamma) for gamma in fine]))])
