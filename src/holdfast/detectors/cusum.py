"""The chi-square test in a cumulative form with forgetting."""

import math
from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from holdfast.detectors.settings import checked, chi_square_table, tested, verdict
from holdfast.numerics.chi_square import SumQuantile, sum_quantile
from holdfast.numerics.limits import pseudo_distance
from holdfast.numerics.linalg import mahalanobis
from holdfast.parts import Detector, InvalidValue, Plant
from holdfast.records import Estimate, Reason, Verdict

FORGOTTEN = 1e-12
"""Weighted degrees of freedom under which nothing is left to test: a gap so long that what
came before has decayed to rounding."""


class CusumState(eqx.Module):
    """The sum, and the sums with the same forgetting that its threshold needs.

    ``moments``: sum_i w_i [dof_i > 0], then sum_i w_i^j dof_i for j = 1, 2, 3 with
    w_i = phi^(k-i); ``paper``: sum_i w_i h(dof_i).
    """

    sum: Float[Array, ""]
    moments: Float[Array, " 4"]
    paper: Float[Array, ""]


class Cusum(Detector):
    """S_k = phi S_{k-1} + v_k' S_k^+ v_k > threshold,  S_0 = 0.

    The paper's threshold, chi2_df(level) / (1 - phi), follows what was seen by
    T_k = phi T_{k-1} + chi2_{dof_k}(level). It is not a test of that level: for phi = 0.15,
    level 0.01 and two degrees of freedom its false-alarm rate is 0.00536.

    The calibrated threshold is the quantile of sum_i phi^i chi2_{dof_{k-i}}: exact in the
    long run at constant degrees of freedom, three moments at the start and where samples are
    missing. It supposes rows that are independent.

    ``projected``: v is the attack estimate after its projection, S its covariance then; see
    `holdfast.detectors.care_paper`.

    Source: CARE (55), (56).
    """

    needs: ClassVar[str] = "white"

    level: Float[Array, ""]
    forgetting: Float[Array, ""]
    quantile: SumQuantile
    table: Float[Array, " m"]
    number: Float[Array, ""]
    factor: Float[Array, ""]
    on: str = eqx.field(static=True)
    rule: str = eqx.field(static=True)
    projected: bool = eqx.field(static=True, default=False)

    def init(self) -> CusumState:
        """Nothing summed yet."""
        return CusumState(
            jnp.asarray(0.0, float), jnp.zeros(4), self.table[-1] / (1.0 - self.forgetting)
        )

    def step(self, state: CusumState, estimate: Estimate) -> tuple[CusumState, Verdict]:
        """The verdict on the sum up to one row."""
        if self.projected:
            held = jnp.asarray(estimate.d), jnp.asarray(estimate.d_cov)
            newest, dof = pseudo_distance(*held, jnp.asarray(estimate.d_free_cov))
        else:
            newest, dof = mahalanobis(*tested(estimate, self.on))
        phi, nu = self.forgetting, dof.astype(float)
        decay = jnp.stack([phi, phi, phi * phi, phi * phi * phi])
        state = CusumState(
            phi * state.sum + newest,
            decay * state.moments + jnp.stack([jnp.sign(nu), nu, nu, nu]),
            phi * state.paper + self.table[dof],
        )
        something = state.moments[1] > FORGOTTEN
        if self.rule == "given":
            limit = self.number
        elif self.rule == "paper":
            limit = state.paper
        else:
            limit = self.quantile.at(*jnp.where(something, state.moments, 1.0))
        statistic = jnp.where(something, state.sum, 0.0)
        threshold = jnp.where(something, self.factor * limit, jnp.inf)
        of_attack = Reason.ATTACK_HELD_SUM if self.projected else Reason.ATTACK_SUM
        codes = of_attack, Reason.RESIDUAL_SUM
        return state, verdict(statistic, threshold, self.on, codes)


def build(
    plant: Plant,
    *,
    level: float = 0.01,
    on: Literal["attack", "residual"] = "residual",
    threshold: Literal["calibrated", "paper"] | float = "calibrated",
    forgetting: float = 0.15,
) -> Cusum:
    """A cumulative test; ``forgetting`` is the paper's phi, 0 < phi < 1, large = long memory.

    Raises `InvalidValue` for a setting out of range.
    """
    s = checked(plant, level, on, threshold)
    if not 0.0 < forgetting <= 0.999:
        raise InvalidValue("forgetting", forgetting, "a number above 0 and at most 0.999")
    # what is cut off has a weight of 1e-6: 1e-12 of the variance
    terms = math.ceil(math.log(1e-6) / math.log(forgetting)) + 1
    weights = forgetting ** np.arange(terms) if s.rule == "calibrated" else np.ones(1)
    return Cusum(
        jnp.asarray(s.level, float),
        jnp.asarray(forgetting, float),
        sum_quantile(s.level, weights, s.most),
        jnp.asarray(chi_square_table(s.level, s.most)),
        jnp.asarray(s.number, float),
        jnp.asarray(1.0, float),
        s.on,
        s.rule,
    )
