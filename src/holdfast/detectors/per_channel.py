"""A z-test on every physical channel, with one false-alarm budget for all."""

from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import ndtri

from holdfast.detectors.settings import by_dof, checked, no_channels, tested, verdict
from holdfast.parts import Detector, Plant
from holdfast.records import Estimate, Reason, Verdict


class PerChannel(Detector):
    """|v_i| / sd(v_i) > factor * table[number of channels that can be tested], for each i.

    The channels are the plant's attack channels, or its outputs with ``on`` "residual"; one
    that was not determined or not seen is not tested. The statistic is the largest ratio.

    ``level`` is the probability of any alarm in a step. The table holds Sidak's two-sided
    quantiles, which are exact for independent channels and never give more than the level
    for correlated ones; simulated calibration finds the factor that uses it up.

    Source: NISME, Section 6 (z-tests), with the level made a budget; "paper" spends the
    whole level on every channel.
    """

    needs: ClassVar[str] = "independent"

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
        """The verdict on one row, channel by channel."""
        v, cov = tested(estimate, self.on)
        variance = jnp.diagonal(cov)
        used = (variance > 0) & jnp.isfinite(variance)
        z = jnp.where(used, jnp.abs(v) / jnp.sqrt(jnp.where(used, variance, 1.0)), 0.0)
        statistic = jnp.max(z, initial=0.0)
        threshold = self.factor * self.table[jnp.sum(used)]
        codes = Reason.ATTACK_CHANNEL, Reason.RESIDUAL_CHANNEL
        return state, verdict(statistic, threshold, self.on, codes, z > threshold)


def build(
    plant: Plant,
    *,
    level: float = 0.01,
    on: Literal["attack", "residual"] = "residual",
    threshold: Literal["calibrated", "paper"] | float = "calibrated",
) -> PerChannel:
    """z-tests on all channels with false-alarm probability ``level`` per step together.

    A number is a limit on |z|. Raises `InvalidValue` for a setting out of range.
    """
    s = checked(plant, level, on, threshold)
    tests = np.arange(1, s.most + 1)
    each = np.full(s.most, s.level)
    if s.rule == "calibrated":
        each = -np.expm1(np.log1p(-s.level) / tests)
    table = -ndtri(each / 2.0) if s.rule != "given" else np.full(s.most, s.number)
    one = jnp.asarray(1.0, float)
    return PerChannel(jnp.asarray(s.level, float), by_dof(table), one, s.on, s.rule)
