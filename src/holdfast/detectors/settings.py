"""What the detectors share: the quantity they test, and their checked settings."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import chdtri

from holdfast.parts import InvalidValue, Plant
from holdfast.records import Estimate, Reason, Verdict


class Settings(NamedTuple):
    """The settings every detector has.

    ``rule`` is "paper", "calibrated" or "given" (a number, in ``number``); ``most`` the
    largest number of degrees of freedom that a step can have.
    """

    level: float
    on: str
    rule: str
    number: float
    most: int


def checked(plant: Plant, level: float, on: str, threshold: str | float) -> Settings:
    """The common settings; raises `InvalidValue` for one that no detector can accept."""
    if not 0.0 < level < 1.0:
        raise InvalidValue("level", level, "a probability between 0 and 1")
    if on not in ("attack", "residual"):
        raise InvalidValue("on", repr(on), '"attack" or "residual"')
    most = len(plant.attacks) if on == "attack" else len(plant.outputs)
    if isinstance(threshold, str):
        if threshold not in ("calibrated", "paper"):
            raise InvalidValue("threshold", repr(threshold), '"calibrated", "paper" or a number')
        return Settings(float(level), on, threshold, float("nan"), most)
    positive("threshold", threshold)
    return Settings(float(level), on, "given", float(threshold), most)


def positive(key: str, value: Any) -> float:
    """``value`` if it is a finite number above 0; raises `InvalidValue` otherwise."""
    if not (np.isfinite(value) and value > 0):
        raise InvalidValue(key, value, "a number above 0")
    return float(value)


def tested(estimate: Estimate, on: str) -> tuple[Float[Array, " m"], Float[Array, "m m"]]:
    """The quantity that must be zero without attack, and its covariance.

    The attack estimate is taken before any projection: projected, it makes the test weaker
    (errata of CARE, Theorem 9).
    """
    if on == "attack":
        return jnp.asarray(estimate.d_free), jnp.asarray(estimate.d_free_cov)
    return jnp.asarray(estimate.residual), jnp.asarray(estimate.residual_cov)


def no_channels() -> Array:
    """The channel alarms of a detector that does not localise."""
    return jnp.zeros((0,), bool)


def verdict(
    statistic: Float[Array, ""],
    threshold: Float[Array, ""],
    on: str,
    codes: tuple[Reason, Reason],
    channels: Array | None = None,
) -> Verdict:
    """An alarm where the statistic exceeds the threshold, for the reason that goes with ``on``.

    ``codes``: the reason on the attack estimate, and on the residual.
    """
    alarm = statistic > threshold
    code = codes[0] if on == "attack" else codes[1]
    reason = jnp.where(alarm, int(code), 0).astype(jnp.int32)
    return Verdict(
        statistic, threshold, alarm, reason, no_channels() if channels is None else channels
    )


def chi_square_table(level: float, most: int) -> np.ndarray:
    """The upper ``level`` quantile of chi-square for 0 to ``most`` dof; 0 at 0."""
    return np.concatenate([[0.0], chdtri(np.arange(1, most + 1), level)])


def by_dof(values: np.ndarray) -> Float[Array, " m"]:
    """A table of thresholds for 1, 2, ... degrees of freedom, with inf for none at all."""
    return jnp.asarray(np.concatenate([[np.inf], values]))
