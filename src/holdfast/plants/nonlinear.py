"""Nonlinear plants in discrete time, and continuous ones sampled by Runge-Kutta."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from holdfast.parts import InvalidValue, Plant
from holdfast.plants.build import covariance
from holdfast.plants.constraints import Constraints
from holdfast.plants.constraints import constraints as checked_constraints

Function = Callable[[Any, Any, Any], Any]


class NonlinearPlant(Plant):
    """x_k = f(x_{k-1}, u_k, d_{k-1}) + w,  y_k = h(x_k, u_k, d_k) + v.

    f and h are functions in `jax.numpy`; w ~ (0, Q), v ~ (0, R), both full. `nonlinear_plant`
    makes one and checks it.
    """

    Q: Float[Array, "n n"]
    R: Float[Array, "ny ny"]
    constraints: Constraints
    f: Function = eqx.field(static=True)
    h: Function = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    attacks: tuple[str, ...] = eqx.field(static=True)

    @property
    def steps(self) -> int | None:
        """How many steps limits that move in time cover; None if none does."""
        return min(self.constraints.lengths, default=None)

    def transition(self, k, x, u, d) -> Float[Array, " n"]:
        """f(x, u, d)."""
        return self.f(x, u, d)

    def output(self, k, x, u, d) -> Float[Array, " ny"]:
        """h(x, u, d)."""
        return self.h(x, u, d)

    def confined(self, k, u, x) -> Float[Array, " n"]:
        """The state within its limits and nearest to x."""
        return self.constraints.state.nearest(k, u, x)

    def saturated(self, k, u, d) -> Float[Array, " nd"]:
        """The attack within its limits and nearest to d."""
        return self.constraints.attack.nearest(k, u, d)

    def noise(self, k, x, u) -> tuple[Float[Array, "n n"], Float[Array, "ny ny"]]:
        """Q and R."""
        return self.Q, self.R


def nonlinear_plant(
    f: Function,
    h: Function,
    *,
    Q: Any,
    R: Any,
    dt: float,
    states: Sequence[str],
    outputs: Sequence[str],
    inputs: Sequence[str] = (),
    attacks: Sequence[str] = (),
    constraints: dict[str, dict[str, Any]] | None = None,
) -> NonlinearPlant:
    """A nonlinear plant; f and h are traced once, so that a wrong shape is told here.

    ``constraints``: {"state" | "attack": {"matrix", "bound", "bound_u"}}.

    Raises `InvalidValue` naming the function or matrix, what was found and expected.
    """
    Q, R = covariance("Q", Q), covariance("R", R)
    x, u, d = (jax.ShapeDtypeStruct((len(names),), float) for names in (states, inputs, attacks))
    for name, function, size in (("f", f, len(states)), ("h", h, len(outputs))):
        try:
            shape = jax.eval_shape(function, x, u, d).shape
        except Exception as error:
            first = str(error).splitlines()[0]
            raise InvalidValue(name, first, "a function of (x, u, d) in jax.numpy") from error
        if shape != (size,):
            raise InvalidValue(name, f"shape {shape}", f"shape ({size},)")
    for name, matrix, size in (("Q", Q, len(states)), ("R", R, len(outputs))):
        if matrix.shape != (size, size):
            raise InvalidValue(name, f"shape {matrix.shape}", f"{size} x {size}")
    return NonlinearPlant(
        Q=jnp.asarray(Q),
        R=jnp.asarray(R),
        constraints=checked_constraints(constraints or {}, len(states), len(inputs), len(attacks)),
        f=f,
        h=h,
        dt=float(dt),
        states=tuple(states),
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        attacks=tuple(attacks),
    )


def sampled(rate: Function, dt: float, substeps: int = 1) -> Function:
    """F for `nonlinear_plant` from x' = rate(x, u, d): fourth-order Runge-Kutta, u, d held."""
    step = dt / substeps

    def f(x, u, d):
        def advance(_, x):
            k1 = rate(x, u, d)
            k2 = rate(x + 0.5 * step * k1, u, d)
            k3 = rate(x + 0.5 * step * k2, u, d)
            k4 = rate(x + step * k3, u, d)
            return x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

        return jax.lax.fori_loop(0, substeps, advance, x)

    return f
