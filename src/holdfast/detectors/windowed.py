"""The chi-square test over a sliding window, with weights."""

from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from holdfast.detectors.settings import checked, chi_square_table, tested, verdict
from holdfast.numerics.chi_square import SumQuantile, sum_quantile
from holdfast.numerics.linalg import mahalanobis
from holdfast.parts import Detector, InvalidValue, Plant
from holdfast.records import Estimate, Reason, Verdict


class Windowed(Detector):
    """g_k = sum_{i=k-T+1}^{k} c_{i-k+T} v_i' S_i^+ v_i > threshold.

    T is ``length``; the last weight multiplies the newest row. Rows before the first count as
    rows in which nothing was seen.

    The calibrated threshold is the quantile of the weighted sum of chi-squares with the
    degrees of freedom that the rows of the window had: exact for equal weights whatever was
    missing, for unequal ones where all rows had the same number, three moments in between.
    The paper's bounds the sum by c_max times a chi-square (its Lemma 1): never more alarms
    than the level, fewer for unequal weights. Both suppose rows that are independent.

    Source: INTEGRITY (6), (7); threshold "paper": (23)-(26).
    """

    needs: ClassVar[str] = "white"

    level: Float[Array, ""]
    weights: Float[Array, " length"]
    quantile: SumQuantile
    table: Float[Array, " m"]
    number: Float[Array, ""]
    factor: Float[Array, ""]
    on: str = eqx.field(static=True)
    rule: str = eqx.field(static=True)

    def init(self) -> Float[Array, "length 2"]:
        """The statistics and degrees of freedom of the last rows: none yet."""
        return jnp.zeros((self.weights.shape[0], 2))

    def step(
        self, state: Float[Array, "length 2"], estimate: Estimate
    ) -> tuple[Float[Array, "length 2"], Verdict]:
        """The verdict on the window that ends at one row."""
        newest, dof = mahalanobis(*tested(estimate, self.on))
        state = jnp.concatenate([state[1:], jnp.stack([newest, dof.astype(float)])[None]])
        c, dofs = self.weights, state[:, 1]
        something = jnp.sum(dofs) > 0
        statistic = jnp.sum(c * state[:, 0])
        if self.rule == "given":
            limit = self.number
        elif self.rule == "paper":
            limit = jnp.max(c) * self.table[jnp.sum(dofs).astype(jnp.int32)]
        else:
            some = jnp.where(something, dofs, 1.0)
            limit = self.quantile.at(
                jnp.sum(jnp.where(some > 0, c, 0.0)),
                *(jnp.sum(c**power * some) for power in (1, 2, 3)),
            )
        threshold = jnp.where(something, self.factor * limit, jnp.inf)
        codes = Reason.ATTACK_WINDOW, Reason.RESIDUAL_WINDOW
        return state, verdict(statistic, threshold, self.on, codes)


def build(
    plant: Plant,
    *,
    level: float = 0.01,
    on: Literal["attack", "residual"] = "residual",
    threshold: Literal["calibrated", "paper"] | float = "calibrated",
    length: int = 10,
    weights: list[float] | None = None,
) -> Windowed:
    """A test over the last ``length`` rows; ``weights`` oldest first, all 1 if left out.

    Raises `InvalidValue` for a setting out of range.
    """
    s = checked(plant, level, on, threshold)
    if length != int(length) or length < 1:
        raise InvalidValue("length", length, "a whole number of rows, at least 1")
    c = np.ones(int(length)) if weights is None else np.asarray(weights, float)
    if c.shape != (length,):
        raise InvalidValue("weights", f"{c.size} numbers", f"{length}, one per row of the window")
    if not (np.all(np.isfinite(c)) and np.all(c >= 0) and c[-1] > 0):
        raise InvalidValue("weights", c.tolist(), "numbers >= 0, the last (newest row) above 0")
    most = s.most * int(length) if s.rule == "paper" else 0
    shape = c if s.rule == "calibrated" else np.ones(1)
    return Windowed(
        jnp.asarray(s.level, float),
        jnp.asarray(c),
        sum_quantile(s.level, shape, s.most),
        jnp.asarray(chi_square_table(s.level, most)),
        jnp.asarray(s.number, float),
        jnp.asarray(1.0, float),
        s.on,
        s.rule,
    )
