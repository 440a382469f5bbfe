"""The last rows of a log as one regression: what a decoder solves at every step."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.linalg import dot
from holdfast.numerics.spread import Signs, signs
from holdfast.numerics.stacked import (
    StackedNoise,
    forced,
    stacked,
    stacked_noise,
)
from holdfast.parts import step_zero
from holdfast.plants.linear import LinearPlant, Matrices, Matrix, Table
from holdfast.records import Observation


class Laid(NamedTuple):
    """Of T rows: y = Phi x_first + forced + noise, x_last = last x_first + forced.

    ``Phi`` (T p x n); ``law``: of the signs of the noise.
    """

    Phi: Float[Array, "m n"]
    last: Float[Array, "n n"]
    noise: StackedNoise
    law: Signs


class Matched(NamedTuple):
    """The plant's matrices at every row of the window, oldest first."""

    A: Float[Array, "T n n"]
    C: Float[Array, "T p n"]
    Q: Float[Array, "T n n"]
    R: Float[Array, "T p p"]


class Rows(eqx.Module):
    """The last T rows, oldest first. ``push``: B u, ``direct``: D u; ``matrices`` if they vary."""

    k: Int[Array, ""]
    y: Float[Array, "T p"]
    seen: Bool[Array, "T p"]
    trusted: Bool[Array, "T p"]
    push: Float[Array, "T n"]
    direct: Float[Array, "T p"]
    matrices: Matched | None


class Problem(NamedTuple):
    """``target`` (T p,): what the samples say without the known inputs; ``forced`` (n,): what the
    inputs have added to the last state; ``matrices``: of the last row.
    """

    laid: Laid
    target: Float[Array, " m"]
    seen: Bool[Array, " m"]
    trusted: Bool[Array, " m"]
    forced: Float[Array, " n"]


class DecoderWindow(eqx.Module):
    """A window of ``length`` rows over a plant; a constant plant is laid out once."""

    plant: LinearPlant
    honest: Bool[Array, " p"]
    laid: Laid | None
    length: int = eqx.field(static=True)

    def init(self) -> Rows:
        """No rows yet."""
        T, p, n = self.length, len(self.plant.outputs), len(self.plant.states)
        nobody = jnp.zeros((T, p), bool)
        matrices = None
        if self.laid is None:
            shapes = ((T, n, n), (T, p, n), (T, n, n), (T, p, p))
            matrices = Matched(*(jnp.zeros(shape) for shape in shapes))
        empty = jnp.zeros((T, p))
        return Rows(step_zero(), empty, nobody, nobody, jnp.zeros((T, n)), empty, matrices)

    def add(
        self, rows: Rows, x: Float[Array, " n"], observation: Observation
    ) -> tuple[Rows, Matrices]:
        """One row more, the oldest gone; ``x``: the estimate before (for scheduled plants)."""
        k, u = rows.k + 1, observation.u
        m = self.plant.at(k, x, u)
        push = dot(m.B, u)
        if self.plant.schedule is not None:
            m = m._replace(**_sensing(self.plant.at(k, dot(m.A, x) + push, u)))
        matrices = None
        if rows.matrices is not None:
            matrices = Matched(*map(_shifted, rows.matrices, (m.A, m.C, m.Q, m.R)))
        return Rows(
            k,
            _shifted(rows.y, observation.y),
            _shifted(rows.seen, observation.seen),
            _shifted(rows.trusted, observation.trusted | (self.honest & observation.seen)),
            _shifted(rows.push, push),
            _shifted(rows.direct, dot(m.D, u)),
            matrices,
        ), m

    def problem(self, rows: Rows) -> Problem:
        """The regression that the rows make."""
        if self.laid is not None or rows.matrices is None:
            assert self.laid is not None
            laid, T = self.laid, self.length
            A, C = (_repeated(m, T) for m in (self.plant.A, self.plant.C))
        else:
            laid, A, C = laid_out(rows.matrices), rows.matrices.A, rows.matrices.C
        moved, at_last = forced(A, C, rows.push, rows.direct)
        return Problem(
            laid,
            jnp.where(rows.seen, rows.y - moved, 0.0).reshape(-1),
            rows.seen.reshape(-1),
            rows.trusted.reshape(-1),
            at_last,
        )

    def ready(self, rows: Rows) -> Bool[Array, ""]:
        """Whether the window is full."""
        return rows.k >= self.length


def laid_out(matrices: Matched) -> Laid:
    """The regression of a window of these matrices."""
    found = stacked(matrices.A, matrices.C)
    noise = stacked_noise(*matrices)
    Phi = found.rows.reshape(-1, found.last.shape[0])
    return Laid(Phi, found.last, noise, signs(noise.cov))


def decoder_window(plant: LinearPlant, length: int, honest) -> DecoderWindow:
    """A window of ``length`` rows; ``honest`` (p,): outputs that are always authenticated."""
    laid = None
    if plant.constant:
        each = (plant.A, plant.C, plant.Q, plant.R)
        stack = Matched(*(_repeated(m, length) for m in each))
        laid = jax.jit(laid_out)(stack)
    return DecoderWindow(plant, jnp.asarray(honest), laid, length)


def _repeated(matrix: Matrix, length: int) -> Array:
    """One for every row; of a constant plant."""
    assert not isinstance(matrix, Table)
    return jnp.broadcast_to(matrix, (length, *matrix.shape))


def _shifted(rows: Array, new: Array) -> Array:
    return jnp.concatenate([rows[1:], new[None]])


def _sensing(m: Matrices) -> dict[str, Array]:
    """What is scheduled at the state of the row itself."""
    return {"C": m.C, "D": m.D, "R": m.R}
