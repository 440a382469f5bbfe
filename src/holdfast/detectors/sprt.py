"""Wald's sequential probability ratio test with reset."""

from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from holdfast.detectors.settings import by_dof, checked, no_channels, positive, tested
from holdfast.detectors.wald import boundary
from holdfast.numerics.chi_square import BesselTable, bessel_table, dof_grid, log_ratio
from holdfast.numerics.linalg import mahalanobis
from holdfast.parts import Detector, InvalidValue, Plant
from holdfast.records import Estimate, Reason, Verdict

LARGEST_SHIFT = 30.0


class Sprt(Detector):
    """L_k = L_{k-1} + log f_shift(s_k) / f_0(s_k); alarm and reset above h, reset under -|h|.

    s_k = v_k' S_k^+ v_k; f_0 is the chi-square density with the degrees of freedom of the
    row, f_shift the non-central one of a shift of ``shift`` standard deviations
    (non-centrality shift^2). h = table[dof] + offset; with both boundaries reset, the level
    is the rate of alarms per row in the long run. A row in which nothing was seen changes
    nothing and has no threshold.

    The calibrated h is exact for independent rows at constant degrees of freedom
    (`holdfast.detectors.wald`); a negative one says that the shift is so large that a single
    row decides. "paper" is Wald's log((1 - level) / level), the level being the error
    probability of one decision, not a rate.

    Source: Wald, Sequential Analysis (1947), Chapter 3; INTEGRITY (46)-(48) for the statistic,
    which without reset has no false-alarm level (see the errata).
    """

    needs: ClassVar[str] = "white"

    level: Float[Array, ""]
    shift: Float[Array, ""]
    ratio: BesselTable
    table: Float[Array, " m"]
    offset: Float[Array, ""]
    on: str = eqx.field(static=True)
    rule: str = eqx.field(static=True)

    def init(self) -> Float[Array, ""]:
        """No evidence either way."""
        return jnp.asarray(0.0, float)

    def step(self, state: Float[Array, ""], estimate: Estimate) -> tuple[Float[Array, ""], Verdict]:
        """The verdict on the rows since the last decision."""
        newest, dof = mahalanobis(*tested(estimate, self.on))
        total = state + log_ratio(self.ratio, newest, dof, self.shift)
        threshold = self.table[dof] + self.offset
        alarm = total > threshold
        decided = (dof > 0) & (alarm | (total < -jnp.abs(threshold)))
        statistic = jnp.where(dof > 0, total, 0.0)
        code = Reason.ATTACK_SEQUENCE if self.on == "attack" else Reason.RESIDUAL_SEQUENCE
        reason = jnp.where(alarm, int(code), 0).astype(jnp.int32)
        return jnp.where(decided, 0.0, total), Verdict(
            statistic, threshold, alarm, reason, no_channels()
        )


def build(
    plant: Plant,
    *,
    level: float = 0.01,
    on: Literal["attack", "residual"] = "residual",
    threshold: Literal["calibrated", "paper"] | float = "calibrated",
    shift: float = 1.0,
) -> Sprt:
    """Wald's test for a shift of ``shift`` standard deviations (Mahalanobis distance).

    A number as threshold is h. Raises `InvalidValue` for a setting out of range.
    """
    s = checked(plant, level, on, threshold)
    if positive("shift", shift) > LARGEST_SHIFT:
        raise InvalidValue("shift", shift, f"at most {LARGEST_SHIFT:g} standard deviations")
    if s.rule == "calibrated":
        grid = dof_grid(s.most)
        exact = [boundary(s.level, float(shift), int(dof)) for dof in grid]
        table = np.interp(np.arange(1, s.most + 1), grid, exact)
    else:
        wald = np.log((1.0 - s.level) / s.level)
        table = np.full(s.most, wald if s.rule == "paper" else s.number)
    return Sprt(
        jnp.asarray(s.level, float),
        jnp.asarray(shift, float),
        bessel_table(s.most),
        by_dof(table),
        jnp.asarray(0.0, float),
        s.on,
        s.rule,
    )
