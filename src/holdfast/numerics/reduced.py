"""A linear regression in coordinates in which it is well posed.

The rows of y = Phi x, weighted, some of them to be met first, become target = columns z with
orthonormal columns (zero beyond the rank), and x = start + back z. What no row sees stays at its
smallest norm, so that a regression in z is the one in x whatever the rank and the units are.

Written without LAPACK: under `jax.vmap` two of its calls at a time, as XLA schedules them on the
CPU, can wait for each other for ever.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

RANK = 1e-10
"""Length left of a column of length one under which a direction is unseen: rounding leaves about
1e-15, an observable direction of a plant well more than this."""


class Reduced(NamedTuple):
    """target (m,) = columns (m x n) z, x = start + back z, over the rows that are not exact.

    ``lead`` (n x m) is what the exact rows make of y: start = lead y. ``free``: how many
    coordinates z has, the first ones; ``rank``: of all rows together.
    ``hidden`` (n x n): an orthonormal basis (columns, then zeros) of what no row sees.
    """

    columns: Float[Array, "m n"]
    target: Float[Array, " m"]
    start: Float[Array, " n"]
    lead: Float[Array, "n m"]
    back: Float[Array, "n n"]
    free: Int[Array, ""]
    rank: Int[Array, ""]
    hidden: Float[Array, "n n"]

    def state(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        """The x of smallest norm that has these coordinates."""
        x = self.start + self.back @ z
        return x - self.hidden @ (self.hidden.T @ x)


def reduced(
    Phi: Float[Array, "m n"],
    y: Float[Array, " m"],
    weight: Float[Array, " m"] | None = None,
    exact: Bool[Array, " m"] | None = None,
) -> Reduced:
    """The regression y = Phi x in coordinates of its own.

    ``weight`` (m,) multiplies the rows, 0 leaves one out; ``exact`` (m,) rows are met first, as
    nearly as possible (weighted least squares, exactly where they can be), and the others decide
    about the freedom that is left.
    """
    rows = Phi if weight is None else Phi * weight[:, None]
    goal = y if weight is None else y * weight
    size = jnp.sqrt(jnp.sum(rows * rows, 0))
    size = jnp.where(size > 0, size, 1.0)
    rows = rows / size
    n = len(size)
    free = _Freedom(rows, goal, jnp.zeros(n), jnp.zeros(rows.shape[::-1]), jnp.eye(n), _none())
    if exact is not None:
        free = jax.lax.cond(jnp.any(exact), lambda: _after_exact(rows, goal, exact), lambda: free)
    found = orthonormal(free.rows)
    rank = free.rank + found.rank

    def unseen():
        # directions that are not there have a column of zeros and would be called unseen
        some = free.directions @ found.rest / size[:, None]
        length = jnp.sqrt(jnp.sum(some * some, 0))
        return orthonormal(some / jnp.where(length > 0, length, 1.0)).columns

    hidden = jax.lax.cond(rank < n, unseen, lambda: jnp.zeros((n, n)))
    lead = free.lead / size[:, None]
    return Reduced(
        found.columns,
        free.goal,
        free.start / size,
        lead if weight is None else lead * weight,
        free.directions @ found.by / size[:, None],
        found.rank,
        rank,
        hidden,
    )


class _Freedom(NamedTuple):
    """goal = rows s, x = start + directions s: what the exact rows leave, ``rank`` being theirs."""

    rows: Float[Array, "m n"]
    goal: Float[Array, " m"]
    start: Float[Array, " n"]
    lead: Float[Array, "n m"]
    directions: Float[Array, "n n"]
    rank: Int[Array, ""]


def _none() -> Int[Array, ""]:
    return jnp.zeros((), int)


def _after_exact(rows, goal, exact) -> _Freedom:
    first = orthonormal(jnp.where(exact[:, None], rows, 0.0))
    lead = first.by @ first.columns.T
    start = lead @ jnp.where(exact, goal, 0.0)
    loose = jnp.where(exact[:, None], 0.0, rows)
    # as they come from pivots they are as good as orthogonal
    length = jnp.sqrt(jnp.sum(first.rest * first.rest, 0))
    directions = first.rest / jnp.where(length > 0, length, 1.0)
    rest = jnp.where(exact, 0.0, goal - loose @ start)
    return _Freedom(loose @ directions, rest, start, lead, directions, first.rank)


class Orthonormal(NamedTuple):
    """columns = rows by, orthonormal, zero beyond the rank; rows rest = 0, ``rest`` (n x n)
    spanning all that has it (n - rank columns, the others zero).
    """

    columns: Float[Array, "m n"]
    by: Float[Array, "n n"]
    rest: Float[Array, "n n"]
    rank: Int[Array, ""]


def orthonormal(rows: Float[Array, "m n"]) -> Orthonormal:
    """Gram-Schmidt with the longest column that is left next, twice; columns of length about 1."""
    m, n = rows.shape
    index = jnp.arange(n)

    def taken(i, carry):
        left, change, columns, by, rank = carry
        length = jnp.sum(left * left, 0)
        mine = (index == jnp.argmax(length)).astype(float)
        size = jnp.sqrt(length @ mine)
        there = size > RANK
        size = jnp.where(there, size, 1.0)
        column, step = left @ mine / size, change @ mine / size
        again = columns.T @ column
        column, step = column - columns @ again, step - by @ again
        size = jnp.sqrt(column @ column)
        size = jnp.where(there, size, 1.0)
        column, step = jnp.where(there, column / size, 0.0), jnp.where(there, step / size, 0.0)
        share = column @ left
        left, change = left - column[:, None] * share, change - step[:, None] * share
        keep = jnp.where(there, 1.0 - mine, 1.0)
        here = (index == i).astype(float)
        return (
            left * keep,
            change * keep,
            columns + column[:, None] * here,
            by + step[:, None] * here,
            rank + jnp.where(there, 1, 0).astype(rank.dtype),
        )

    start = rows, jnp.eye(n), jnp.zeros((m, n)), jnp.zeros((n, n)), _none()
    _, rest, columns, by, rank = jax.lax.fori_loop(0, n, taken, start)
    return Orthonormal(columns, by, rest, rank)
