"""Linear plants: constant, per step, or scheduled on a state or an input.

x_k = A x_{k-1} + B u_k + G d_{k-1} + w,   y_k = C x_k + D u_k + H d_k + v,
w ~ (0, Q), v ~ (0, R), uncorrelated with each other, Q and R full.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from holdfast.numerics.blue import whitener
from holdfast.numerics.linalg import dot
from holdfast.numerics.sampling import sample
from holdfast.parts import Plant
from holdfast.plants.constraints import Constraints


class Table(eqx.Module):
    """A matrix as a function of the scheduling value: linear between grid points.

    ``grid`` (g,) increasing; ``values`` (g, rows, columns). Constant outside the grid.
    """

    grid: Float[Array, " g"]
    values: Float[Array, "g r c"]

    def at(self, value: Float[Array, ""]) -> Float[Array, "r c"]:
        """The matrix at this scheduling value."""
        i = jnp.clip(jnp.searchsorted(self.grid, value) - 1, 0, self.grid.shape[0] - 2)
        low, high = self.grid[i], self.grid[i + 1]
        share = jnp.clip((value - low) / (high - low), 0.0, 1.0)
        return (1.0 - share) * self.values[i] + share * self.values[i + 1]


Matrix = Float[Array, "_ _"] | Float[Array, "_ _ _"] | Table
"""Constant, per step (time first; row k of a log uses entry k-1), or scheduled."""


class Matrices(NamedTuple):
    """The plant at one step."""

    A: Float[Array, "n n"]
    B: Float[Array, "n nu"]
    C: Float[Array, "ny n"]
    D: Float[Array, "ny nu"]
    G: Float[Array, "n nd"]
    H: Float[Array, "ny nd"]
    Q: Float[Array, "n n"]
    R: Float[Array, "ny ny"]


class Sampling(NamedTuple):
    """How a scheduled continuous plant is discretised, at every step."""

    method: str
    noise: str


class LinearPlant(Plant):
    """A linear plant in discrete time; `build` makes one from arrays and checks it.

    ``white`` holds W with W R W' = I, and its inverse, where R is constant: computed once.
    ``schedule`` names what the scheduled matrices depend on: ("state", i) takes entry i of
    the state (an estimator's own, at the row before), ("input", i) entry i of the row's u.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    G: Matrix
    H: Matrix
    Q: Matrix
    R: Matrix
    constraints: Constraints
    white: tuple[Float[Array, "ny ny"], Float[Array, "ny ny"]] | None
    dt: float = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    attacks: tuple[str, ...] = eqx.field(static=True)
    schedule: tuple[str, int] | None = eqx.field(static=True, default=None)
    sampling: Sampling | None = eqx.field(static=True, default=None)

    @property
    def constant(self) -> bool:
        """Whether every matrix is the same at every step."""
        return all(not isinstance(m, Table) and m.ndim == 2 for m in self._sources)

    @property
    def steps(self) -> int | None:
        """How many steps the per-step matrices and limits cover; None if there are none."""
        lengths = [m.shape[0] for m in self._sources if not isinstance(m, Table) and m.ndim == 3]
        return min(lengths + self.constraints.lengths, default=None)

    @property
    def _sources(self) -> tuple[Matrix, ...]:
        return (self.A, self.B, self.C, self.D, self.G, self.H, self.Q, self.R)

    def at(self, k, x, u) -> Matrices:
        """The matrices of step k; ``x`` is the state at k-1, ``u`` the input of row k."""
        value = jnp.asarray(0.0)
        if self.schedule is not None:
            kind, index = self.schedule
            value = x[index] if kind == "state" else u[index]
        found = Matrices(*(_resolve(m, k, value) for m in self._sources))
        if self.sampling is None:
            return found
        nu = found.B.shape[1]
        A, columns, Q = sample(
            found.A, jnp.concatenate([found.B, found.G], 1), found.Q, self.dt, *self.sampling
        )
        return found._replace(A=A, B=columns[:, :nu], G=columns[:, nu:], Q=Q)

    def whiten(self, R, seen) -> tuple[Float[Array, "ny ny"], Float[Array, "ny ny"]]:
        """W with W R W' = I on the rows seen and zero elsewhere, and its inverse there."""
        if self.white is None:
            return whitener(R, seen)
        return jax.lax.cond(jnp.all(seen), lambda: self.white, lambda: whitener(R, seen))

    def transition(self, k, x, u, d) -> Float[Array, " n"]:
        """A x + B u + G d."""
        m = self.at(k, x, u)
        return dot(m.A, x) + dot(m.B, u) + dot(m.G, d)

    def output(self, k, x, u, d) -> Float[Array, " ny"]:
        """C x + D u + H d. Scheduled C, D, H take the scheduling value from x itself."""
        m = self.at(k, x, u)
        return dot(m.C, x) + dot(m.D, u) + dot(m.H, d)

    def confined(self, k, u, x) -> Float[Array, " n"]:
        """The state within its limits and nearest to x."""
        return self.constraints.state.nearest(k, u, x)

    def saturated(self, k, u, d) -> Float[Array, " nd"]:
        """The attack within its limits and nearest to d."""
        return self.constraints.attack.nearest(k, u, d)

    def noise(self, k, x, u) -> tuple[Float[Array, "n n"], Float[Array, "ny ny"]]:
        """Q and R."""
        m = self.at(k, x, u)
        return m.Q, m.R


def _resolve(source: Matrix, k, value) -> Array:
    if isinstance(source, Table):
        return source.at(value)
    if source.ndim == 2:
        return source
    return jax.lax.dynamic_index_in_dim(source, k - 1, keepdims=False)
