"""Continuous plants sampled by a solver that chooses its own steps (the extra ``solver``)."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from holdfast.parts import InvalidValue


def adaptive(
    rate: Callable[..., Any], dt: float, rtol: float = 1e-8, atol: float = 1e-10
) -> Callable[..., Any]:
    """F of a plant from x' = rate(x, u, d, ..): Runge-Kutta of order 5 with error control.

    The arguments besides x are held over a sample of ``dt`` seconds; every step keeps its error
    under atol + rtol |x|. Derivatives are those of the steps taken, forward mode only. A rate
    that is too stiff for it gives NaN after 4096 steps: an estimate of it is DIVERGED.

    Raises `InvalidValue` where diffrax is not installed.

    Source: Tsitouras, *Runge-Kutta pairs of order 5(4) satisfying only the first column
    simplifying assumption*, 2011.
    """
    try:
        import diffrax
    except ImportError as error:
        raise InvalidValue(
            "adaptive", "no diffrax", "the extra: pip install 'holdfast[solver]'"
        ) from error

    def f(x, *held):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, x, held: rate(x, *held)),
            diffrax.Tsit5(),
            t0=0.0,
            t1=dt,
            dt0=None,
            y0=x,
            args=held,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=atol),
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )
        arrived = solution.result == diffrax.RESULTS.successful
        return jnp.where(arrived, jnp.asarray(solution.ys)[0], jnp.nan)

    return f
