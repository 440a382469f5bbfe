"""The chi-square test of every step on its own."""

from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from holdfast.detectors.settings import (
    by_dof,
    checked,
    chi_square_table,
    no_channels,
    tested,
    verdict,
)
from holdfast.numerics.linalg import mahalanobis
from holdfast.parts import Detector, Plant
from holdfast.records import Estimate, Reason, Verdict


class ChiSquare(Detector):
    """v' S^+ v > factor * table[degrees of freedom].

    v is the attack estimate or the residual, S its covariance; the degrees of freedom follow
    what was seen. ``table[0]`` is inf: nothing to test.

    Source: INTEGRITY (6) with window 1; CARE (55) with phi = 0.
    """

    needs: ClassVar[str] = "gaussian"
    """What the estimates must be for the level to be exact without simulation."""

    level: Float[Array, ""]
    table: Float[Array, " m"]
    factor: Float[Array, ""]
    on: str = eqx.field(static=True)
    rule: str = eqx.field(static=True)

    def init(self) -> Bool[Array, " 0"]:
        """Nothing to remember."""
        return no_channels()

    def step(
        self, state: Bool[Array, " 0"], estimate: Estimate
    ) -> tuple[Bool[Array, " 0"], Verdict]:
        """The verdict on one row."""
        statistic, dof = mahalanobis(*tested(estimate, self.on))
        threshold = self.factor * self.table[dof]
        codes = Reason.ATTACK, Reason.RESIDUAL
        return state, verdict(statistic, threshold, self.on, codes)


def build(
    plant: Plant,
    *,
    level: float = 0.01,
    on: Literal["attack", "residual"] = "residual",
    threshold: Literal["calibrated", "paper"] | float = "calibrated",
) -> ChiSquare:
    """A chi-square test whose false-alarm probability per step is ``level``.

    The paper's threshold is the chi-square quantile, and exact where the estimates are
    Gaussian with the covariance stated; a number holds whatever was seen.

    Raises `InvalidValue` for a setting out of range.
    """
    s = checked(plant, level, on, threshold)
    table = chi_square_table(s.level, s.most)[1:]
    if s.rule == "given":
        table[:] = s.number
    one = jnp.asarray(1.0, float)
    return ChiSquare(jnp.asarray(s.level, float), by_dof(table), one, s.on, s.rule)
