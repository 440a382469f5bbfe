"""Plants with switches: f or h depend on a position, and the state may jump where it changes."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from holdfast.parts import InvalidValue, Plant
from holdfast.plants.angles import shorter_way
from holdfast.plants.checking import Arguments, check_functions, untraceable
from holdfast.plants.constraints import Constraints
from holdfast.plants.nonlinear import checked_settings

Function = Callable[[Any, Any, Any, Any], Any]
Jump = Callable[[Any, Any, Any], Any]


class SwitchedPlant(Plant):
    """x_k = f(x_{k-1}, u_k, d_{k-1}, j) + w,  y_k = h(x_k, u_k, d_k, j) + v, j the position.

    (x, j)+ = jump(x, j, asked) just before the measurement of every sample, ``asked`` being
    where the switches are asked to be. `switched_plant` makes one and checks it.

    Source: NISME (3), (4).
    """

    Q: Float[Array, "n n"]
    R: Float[Array, "ny ny"]
    constraints: Constraints
    position: Int[Array, ""]
    f: Function = eqx.field(static=True)
    h: Function = eqx.field(static=True)
    jump: Jump | None = eqx.field(static=True)
    switched: tuple[str, ...] = eqx.field(static=True)
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

    @property
    def positions(self) -> tuple[str, ...]:
        """The names of the positions; the first is normal."""
        return self.switched

    def at_position(self, position: Int[Array, ""]) -> "SwitchedPlant":
        """The plant with its switches in one of the `positions`, by number."""
        return dataclasses.replace(self, position=position)

    def jumped(self, x, position, asked) -> tuple[Float[Array, " n"], Int[Array, ""]]:
        """Where ``jump`` leads; x and the position asked for where there is none."""
        if self.jump is None:
            return x, asked
        x, after = self.jump(x, position, asked)
        return x, jnp.asarray(after, position.dtype)

    def transition(self, k, x, u, d) -> Float[Array, " n"]:
        """The function f at the position."""
        return self.f(x, u, d, self.position)

    def output(self, k, x, u, d) -> Float[Array, " ny"]:
        """The function h at the position."""
        return self.h(x, u, d, self.position)

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


def switched_plant(
    f: Function,
    h: Function,
    *,
    positions: Sequence[str],
    Q: Any,
    R: Any,
    dt: float,
    states: Sequence[str],
    outputs: Sequence[str],
    inputs: Sequence[str] = (),
    attacks: Sequence[str] = (),
    jump: Jump | None = None,
    angles: Sequence[str] = (),
    constraints: dict[str, dict[str, Any]] | None = None,
) -> SwitchedPlant:
    """A plant whose f and h are functions of (x, u, d, position) in `jax.numpy`.

    ``positions``: names, the first being normal; the functions get the number, traced, so that
    they choose by ``table[position]``, `jnp.where` or `jax.lax.switch`. ``jump(x, position,
    asked)`` returns the state and the position just after a sample (default: x, asked).
    ``angles``: outputs (rad) whose innovation goes the shorter way round. ``constraints``:
    {"state" | "attack": {"matrix", "bound", "bound_u"}}. A continuous f: `sampled`, `adaptive`.

    Raises `InvalidValue` as `nonlinear_plant`, and for positions that are not names.
    """
    if not positions or len(set(positions)) != len(positions):
        raise InvalidValue("positions", list(positions), "one or more names that differ")
    arguments = Arguments(states, inputs, attacks, positions)
    settings = checked_settings(arguments, outputs, Q, R, dt, angles, constraints)
    check_functions({"f": (f, len(states)), "h": (h, len(outputs))}, arguments)
    if jump is not None:
        _check_jump(jump, len(states))
    return SwitchedPlant(
        **settings,
        position=jnp.asarray(0, jnp.int32),
        f=f,
        h=h,
        jump=jump,
        switched=tuple(positions),
    )


def _check_jump(jump: Jump, n: int) -> None:
    x, number = jax.ShapeDtypeStruct((n,), float), jax.ShapeDtypeStruct((), jnp.int32)
    written = f"a function that returns (x, position): {n} numbers and a whole one"
    try:
        found = jax.eval_shape(jump, x, number, number)
        after, position = found
        fits = after.shape == (n,) and position.shape == ()
        fits &= after.dtype == x.dtype and jnp.issubdtype(position.dtype, jnp.integer)
    except Exception as error:
        raise InvalidValue("jump", *untraceable(error, written)) from error
    if not fits:
        raise InvalidValue("jump", f"{after} and {position}", written)
