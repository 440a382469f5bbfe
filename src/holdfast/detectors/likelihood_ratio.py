"""Tests that use what physics allows: no attack, or one within its limits, or none at all."""

from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import chdtrc

from holdfast.detectors.settings import (
    by_dof,
    checked,
    chi_square_table,
    no_channels,
    tested,
    verdict,
)
from holdfast.numerics.limits import Limited
from holdfast.numerics.linalg import dot, lower_factor, mahalanobis
from holdfast.numerics.projection import project
from holdfast.numerics.roots import bracketed_root
from holdfast.parts import Detector, InvalidValue, Plant
from holdfast.records import Estimate, Reason, Verdict


class LikelihoodRatio(Detector):
    """Likelihood-ratio tests of the unprojected attack estimate d^u ~ N(d, P) under its limits.

    With |v|^2 = v' P^{-1} v and D the set of attacks that the limits of the row allow:

    "attack"    |d^u|^2 - min_{d in D} |d^u - d|^2: no attack, against one that is possible.
                Chi-bar-square distributed where D is a cone; below the chi-square test's
                statistic wherever 0 is in D, so that its quantile holds the level and the
                calibrated threshold is lower. Negative only where even 0 is impossible.
    "possible"  min_{d in D} |d^u - d|^2: some attack within the limits, against none. The
                threshold holds the level whatever the attack in D. With r the rank of the
                limits in P it is the quantile of chi2_r (for d in D the statistic is at most
                |d^u - d|^2 there; a set as small as a point attains it), and where the limits
                are one-sided, r independent rows, that of chi2_{r-1} and chi2_r in equal parts:
                D then contains a half-line from every point, and the distance to a half-line
                is distributed so.

    Where the limits contradict each other "attack" is the chi-square test and "possible" tests
    nothing. On the residual, which has no limits, both are the chi-square test.

    Source: errata 6 of CARE; Perlman, Ann. Math. Statist. 40 (1969), for one-sided limits.
    """

    needs: ClassVar[str] = "simulation"

    level: Float[Array, ""]
    table: Float[Array, " m"]
    one_sided: Float[Array, " m"]
    factor: Float[Array, ""]
    on: str = eqx.field(static=True)
    rule: str = eqx.field(static=True)
    test: str = eqx.field(static=True)

    def init(self) -> Bool[Array, " 0"]:
        """Nothing to remember."""
        return no_channels()

    def step(
        self, state: Bool[Array, " 0"], estimate: Estimate
    ) -> tuple[Bool[Array, " 0"], Verdict]:
        """The verdict on one row."""
        value, cov = tested(estimate, self.on)
        length, dof = mahalanobis(value, cov)
        codes = Reason.ATTACK, Reason.RESIDUAL
        if self.on == "residual":
            threshold = self.factor * self.table[dof]
            return state, verdict(length, threshold, self.on, codes)
        free = Limited.of(value, cov, estimate.d_rows, estimate.d_bound)
        nearest = project(free.value, free.cov, free.rows, free.bound)
        pull = dot(nearest.multipliers, free.rows)
        distance = dot(pull, dot(free.cov, pull))
        if self.test == "attack":
            threshold = self.factor * self.table[dof]
            return state, verdict(length - distance, threshold, self.on, codes)
        rank, count = _directions(free)
        limit = jnp.where(rank == count, self.one_sided[rank], self.table[rank])
        threshold = jnp.where(nearest.feasible, self.factor * limit, jnp.inf)
        return state, verdict(distance, threshold, self.on, (Reason.IMPOSSIBLE, Reason.RESIDUAL))


def _directions(free: Limited):
    """In how many directions the limits act, and how many limits there are."""
    rows = jnp.where(jnp.isfinite(free.bound)[:, None], free.rows, 0.0)
    spread = dot(dot(rows, free.cov), rows.T)
    _, independent = lower_factor(spread)
    return jnp.sum(independent), jnp.sum(jnp.diagonal(spread) > 0)


def build(
    plant: Plant,
    *,
    level: float = 0.01,
    on: Literal["attack", "residual"] = "attack",
    threshold: Literal["calibrated", "paper"] | float = "calibrated",
    test: Literal["attack", "possible"] = "attack",
) -> LikelihoodRatio:
    """A likelihood-ratio test under the plant's limits; ``test`` says which.

    "paper" takes the chi-square quantile for ``test`` "attack" (the paper has no such test),
    which is too high. A number holds whatever was seen.

    Raises `InvalidValue` for a setting out of range.
    """
    s = checked(plant, level, on, threshold)
    if test not in ("attack", "possible"):
        raise InvalidValue("test", repr(test), "'attack' or 'possible'")
    table = chi_square_table(s.level, s.most)[1:]
    one_sided = np.array([_half_and_half(s.level, r) for r in range(1, s.most + 1)])
    if s.rule == "given":
        table[:] = one_sided[:] = s.number
    one = jnp.asarray(1.0, float)
    level_ = jnp.asarray(s.level, float)
    return LikelihoodRatio(level_, by_dof(table), by_dof(one_sided), one, s.on, s.rule, test)


def _half_and_half(level: float, rank: int) -> float:
    """The t with P(chi2_{rank-1} > t) / 2 + P(chi2_rank > t) / 2 = level; chi2_0 is 0."""

    def excess(t: float) -> float:
        below = chdtrc(rank - 1, t) if rank > 1 else 0.0
        return float(0.5 * (below + chdtrc(rank, t)) - level)

    if excess(0.0) <= 0:
        return 0.0
    return bracketed_root(excess, (0.0, 1e4), xtol=1e-13)
