"""Several rows of a linear plant as one regression on the state at the first of them.

    y_i = C_i A_i .. A_1 x_0 + forced_i + noise_i,      i = 0 .. T-1

A_i leads from row i-1 to row i (A_0 is not used). All functions take matrices per row.

Source: DECODER (6), with known inputs and with process noise.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from holdfast.numerics.linalg import dot, symmetric
from holdfast.numerics.reduced import orthonormal


class Stacked(NamedTuple):
    """``rows`` (T x p x n): of the outputs; ``last`` (n x n): the state at the last row."""

    rows: Float[Array, "T p n"]
    last: Float[Array, "n n"]


def stacked(A: Float[Array, "T n n"], C: Float[Array, "T p n"]) -> Stacked:
    """The outputs of every row, and the last state, as functions of the first state."""

    def on(through, matrices):
        step, output = matrices
        through = dot(step, through)
        return through, dot(output, through)

    first = jnp.eye(A.shape[-1])
    last, rows = jax.lax.scan(on, first, (A[1:], C[1:]))
    return Stacked(jnp.concatenate([C[:1], rows]), last)


def forced(
    A: Float[Array, "T n n"],
    C: Float[Array, "T p n"],
    push: Float[Array, "T n"],
    direct: Float[Array, "T p"],
) -> tuple[Float[Array, "T p"], Float[Array, " n"]]:
    """What the inputs alone add to every output and to the last state.

    ``push``: B_i u_i, which moves the state into row i (that of row 0 is not used); ``direct``:
    D_i u_i.
    """

    def on(x, row):
        step, output, pushed = row
        x = dot(step, x) + pushed
        return x, dot(output, x)

    x, outputs = jax.lax.scan(on, jnp.zeros(A.shape[-1]), (A[1:], C[1:], push[1:]))
    return jnp.concatenate([jnp.zeros_like(direct[:1]), outputs]) + direct, x


class StackedNoise(NamedTuple):
    """Of the rows about the first state that leads to the last one as well as a state can.

    With M = ``Stacked.last``, that first state is x_0 + M^+ w_last, w_last being what the process
    noise has added to the last state: old rows are the ones that the noise makes uncertain, and
    the last state is M times it, but for ``extra``. ``cov`` (T p x T p) of the rows, ``extra``
    (n x n) of the last state (zero if M is invertible), ``cross`` (T p x n) between them.
    """

    cov: Float[Array, "m m"]
    extra: Float[Array, "n n"]
    cross: Float[Array, "m n"]


def stacked_noise(
    A: Float[Array, "T n n"],
    C: Float[Array, "T p n"],
    Q: Float[Array, "T n n"],
    R: Float[Array, "T p p"],
) -> StackedNoise:
    """The covariance of the noise of all rows; Q_i is that of the step into row i."""
    T, p, n = C.shape
    rows, last = stacked(A, C)
    parts = orthonormal(last)
    # any M^+ with M M^+ the projector on M's range
    inverse, outside = parts.by @ parts.columns.T, jnp.eye(n) - parts.columns @ parts.columns.T

    def of_step(step):
        """The noise of the step into row ``step``: in every row, and in the last state."""

        def on(through, row):
            i, matrix, output = row
            through = jnp.where(i == step, jnp.eye(n), dot(matrix, through))
            return through, dot(output, through)

        end, outputs = jax.lax.scan(on, jnp.zeros((n, n)), (jnp.arange(T), A, C))
        return outputs - rows @ (inverse @ end), outside @ end

    into_rows, into_last = jax.vmap(of_step)(jnp.arange(1, T))
    into_rows = into_rows.reshape(T - 1, T * p, n)
    weighted = into_rows @ Q[1:]
    own = jax.scipy.linalg.block_diag(*R) if T else jnp.zeros((0, 0))
    return StackedNoise(
        symmetric(jnp.einsum("tin,tjn->ij", weighted, into_rows) + own),
        symmetric(jnp.einsum("tin,tnk,tjk->ij", into_last, Q[1:], into_last)),
        jnp.einsum("tin,tjn->ij", weighted, into_last),
    )
