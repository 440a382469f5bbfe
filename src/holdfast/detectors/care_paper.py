"""The detector of the CARE paper, to the letter: a cumulative test on the projected estimate.

**It detects less than the same test without the projection; use `likelihood_ratio` or `cusum`.**
Theorem 9 of the paper says the opposite by inverting a singular matrix. Where 0 is within the
limits the projected estimate is never the longer one, measured by the covariance before the
projection; with the pseudo-inverse of the singular covariance single rows can be longer, but
far more are shorter. `holdfast papers care` prints the false-negative rates of every
reading of the statistic on the paper's own example.
"""

import dataclasses
from typing import Literal

from holdfast.detectors import cusum
from holdfast.parts import Plant


def build(
    plant: Plant,
    *,
    level: float = 0.01,
    on: Literal["attack", "residual"] = "attack",
    threshold: Literal["calibrated", "paper"] | float = "calibrated",
    forgetting: float = 0.15,
) -> cusum.Cusum:
    """S_k = phi S_{k-1} + d' (P^d)^+ d of the projected d, with P^d of (22).

    P^d is singular, of rank (determined channels) - (active limits): that is its number of
    degrees of freedom, and the pseudo-inverse stands for the inverse. "paper" is the threshold
    (56), chi2_df(level) / (1 - phi) at constant df; ``forgetting`` is phi, 0 < phi < 1. On the
    residual, which is not projected, it is `cusum`.

    Raises `InvalidValue` for a setting out of range.

    Source: CARE (55), (56), errata 6 and 8.
    """
    found = cusum.build(plant, level=level, on=on, threshold=threshold, forgetting=forgetting)
    return dataclasses.replace(found, projected=on == "attack")
