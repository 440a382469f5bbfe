"""Roots of a function of one variable between two signs."""

from collections.abc import Callable
from typing import Any


def bracketed_root(
    function: Callable[[float], Any], bracket: tuple[float, float], *,
    xtol: float | None = None, rtol: float | None = None,
) -> float:  # fmt: skip
    """Where ``function`` is zero in the bracket, at whose ends its signs differ (Brent's method).

    Tolerances are absolute and relative; left out, near rounding. Raises `ValueError` for equal
    signs.
    """
    # imported when used: with what it brings it takes as long to import as JAX
    from scipy.optimize import root_scalar

    return float(root_scalar(function, bracket=bracket, xtol=xtol, rtol=rtol).root)
