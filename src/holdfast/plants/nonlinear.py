"""Nonlinear plants in discrete time, and continuous ones sampled by Runge-Kutta."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from holdfast.parts import InvalidValue, Plant
from holdfast.plants.angles import shorter_way
from holdfast.plants.build import covariance
from holdfast.plants.checking import Arguments, check_functions
from holdfast.plants.constraints import Constraints
from holdfast.plants.constraints import constraints as checked_constraints

Function = Callable[..., Any]
"""Of x, u, d; of a switched plant also of the position."""


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
    angles: tuple[str, ...] = eqx.field(static=True)
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

    def innovation(self, y, expected) -> Float[Array, " ny"]:
        """How far y is from what was expected, angles the shorter way round."""
        return shorter_way(y - expected, self.outputs, self.angles)

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
    angles: Sequence[str] = (),
    constraints: dict[str, dict[str, Any]] | None = None,
) -> NonlinearPlant:
    """A nonlinear plant; f and h are traced and tried at a few points, so that a wrong shape
    or a derivative that is NaN is told here (`holdfast.plants.checking`).

    ``angles``: outputs (rad) whose innovation goes the shorter way round. ``constraints``:
    {"state" | "attack": {"matrix", "bound", "bound_u"}}.

    Raises `InvalidValue` naming the function or matrix, what was found and expected.
    """
    arguments = Arguments(states, inputs, attacks)
    settings = checked_settings(arguments, outputs, Q, R, dt, angles, constraints)
    check_functions({"f": (f, len(states)), "h": (h, len(outputs))}, arguments)
    return NonlinearPlant(**settings, f=f, h=h)


def checked_settings(
    arguments: Arguments,
    outputs: Sequence[str],
    Q: Any,
    R: Any,
    dt: float,
    angles: Sequence[str],
    constraints: dict[str, dict[str, Any]] | None,
) -> dict[str, Any]:
    """What plants made of functions have in common, checked. Raises `InvalidValue`."""
    states, inputs, attacks, _ = arguments
    if not (np.isfinite(dt) and dt > 0):
        raise InvalidValue("dt", dt, "a positive number of seconds")
    names = {"states": states, "inputs": inputs, "outputs": outputs, "attacks": attacks}
    for key, given in names.items():
        if len(set(given)) != len(given):
            raise InvalidValue(key, list(given), "names that differ")
    for name in angles:
        if name not in outputs:
            raise InvalidValue("angles", repr(name), f"one of {', '.join(outputs)}")
    Q, R = covariance("Q", Q), covariance("R", R)
    for key, matrix, size in (("Q", Q, len(states)), ("R", R, len(outputs))):
        if matrix.shape != (size, size):
            raise InvalidValue(key, f"shape {matrix.shape}", f"{size} x {size}")
    return {
        "Q": jnp.asarray(Q),
        "R": jnp.asarray(R),
        "constraints": checked_constraints(
            constraints or {}, len(states), len(inputs), len(attacks)
        ),
        "angles": tuple(angles),
        "dt": float(dt),
        **{key: tuple(given) for key, given in names.items()},
    }


def sampled(rate: Function, dt: float, substeps: int = 1) -> Function:
    """F of a plant from x' = rate(x, u, d, ..): fourth-order Runge-Kutta, all but x held."""
    step = dt / substeps

    def f(x, *held):
        def advance(_, x):
            k1 = rate(x, *held)
            k2 = rate(x + 0.5 * step * k1, *held)
            k3 = rate(x + 0.5 * step * k2, *held)
            k4 = rate(x + step * k3, *held)
            return x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

        return jax.lax.fori_loop(0, substeps, advance, x)

    return f
