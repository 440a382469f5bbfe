"""A z-test on every physical channel, with one false-alarm budget for all."""

from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import ndtri

from holdfast.detectors.settings import by_dof, checked, no_channels, tested, verdict
from holdfast.numerics.naming import sidak, z_values
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
        z, used = z_values(v, jnp.diagonal(cov))
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
    if s.rule == "calibrated":
        table = sidak(s.level, s.most)
    else:
        table = np.full(s.most, s.number if s.rule == "given" else -ndtri(s.level / 2.0))
    one = jnp.asarray(1.0, float)
    return PerChannel(jnp.asarray(s.level, float), by_dof(table), one, s.on, s.rule)
