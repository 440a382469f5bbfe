"""Best linear unbiased updates when part of what is estimated has no prior at all.

A vector is described by  z = estimate + N delta + e,  e ~ (0, P),  delta free: the columns of
N span what nothing is known about (an attack before any sensor has felt it). A measurement
y = M z + v, v ~ (0, R), first *splits*: rotated by an orthogonal U, some rows of U W y
(W R W' = I) determine directions of delta, one each, and the rest are blind to it. Blind rows
correct e as in a Kalman filter; the others then solve for delta. This is the output
decomposition of Yong, Zhu and Frazzoli and of NISE (z1, z2 against z3), done for whatever was
seen, so that missing samples need no case of their own.

Rows are absorbed one at a time with unit noise: scalar divisions by numbers >= 1 instead of
inverses of innovation covariances, and Joseph's form, so that a prior of 1e8 next to a noise
of 1e-8 loses nothing.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.linalg import (
    RANK_TOLERANCE,
    dot,
    lower_factor,
    repeat,
    solve_lower,
    symmetric,
)


class Split(NamedTuple):
    """Which rotated measurement rows determine which free directions.

    ``rotation`` (p x p) orthogonal; ``map`` = rotation @ T (p x q), upper triangular in the
    order of the pivots; ``pivot`` (p x q) one-hot rows, zero where the row is blind.
    """

    rotation: Float[Array, "p p"]
    map: Float[Array, "p q"]
    pivot: Float[Array, "p q"]


class Update(NamedTuple):
    """z_new = z + gain (W r) with covariance ``cov``.

    ``blind`` maps the whitened innovation W r onto its part that no delta explains.
    """

    gain: Float[Array, "m p"]
    cov: Float[Array, "m m"]
    blind: Float[Array, "p p"]


def whitener(
    R: Float[Array, "p p"], seen: Bool[Array, " p"]
) -> tuple[Float[Array, "p p"], Float[Array, "p p"]]:
    """W with W R W' = I on the rows seen and zero elsewhere, and its inverse there."""
    both = seen[:, None] & seen[None, :]
    lower, kept = lower_factor(jnp.where(both, R, jnp.eye(len(seen))))
    mask = jnp.diag(seen.astype(float))
    return dot(solve_lower(lower, kept, jnp.eye(len(seen))), mask), dot(mask, lower)


def split(T: Float[Array, "p q"], bound: Float[Array, "p q"]) -> Split:
    """Column-pivoted Householder triangularisation of T, rank decided structurally.

    ``bound`` holds |W| |M| |N|, the size each entry of T = W M N would have without
    cancellation: a column is zero where it is below `RANK_TOLERANCE` of that.
    """
    p, q = T.shape
    if q == 0:
        return Split(jnp.eye(p), T, T)
    rows, columns = jnp.arange(p), jnp.arange(q)
    size = jnp.sum(bound * bound, 0)
    scale = jnp.where(size > 0, 1.0 / jnp.where(size > 0, size, 1.0), 0.0)

    def reflect(i, carry):
        rotation, mapped, pivot = carry
        below = jnp.where((rows >= i)[:, None], mapped, 0.0)
        norms = jnp.sum(below * below, 0) * scale * (1.0 - jnp.sum(pivot, 0))
        ok = jnp.max(norms) > RANK_TOLERANCE**2
        best = columns == _first_largest(norms)
        chosen = jnp.where(best, 1.0, 0.0)
        x = jnp.sum(below * chosen, 1)
        length = jnp.sqrt(jnp.sum(x * x))
        head = jnp.sum(jnp.where(rows == i, x, 0.0))
        v = x + jnp.where(rows == i, jnp.where(head >= 0, length, -length), 0.0)
        norm = jnp.sum(v * v)
        beta = jnp.where(ok & (norm > 0), 2.0 / jnp.where(norm > 0, norm, 1.0), 0.0)
        mapped = mapped - (beta * v)[:, None] * dot(v, mapped)
        rotation = rotation - (beta * v)[:, None] * dot(v, rotation)
        consumed = ok & (rows > i)[:, None] & best
        added = jnp.where(ok & (rows == i)[:, None], chosen, 0.0)
        return rotation, jnp.where(consumed, 0.0, mapped), pivot + added

    start = (jnp.eye(p), T, jnp.zeros((p, q)))
    rotation, mapped, pivot = jax.lax.fori_loop(0, min(p, q), reflect, start)
    noise = RANK_TOLERANCE * jnp.sqrt(size)
    return Split(rotation, jnp.where(jnp.abs(mapped) > noise, mapped, 0.0), pivot)


def _correct(
    joint: Float[Array, "m j"],
    along: Float[Array, " j"],
    h: Float[Array, " m"],
    k: Float[Array, " m"],
    unit: Float[Array, " p"],
) -> Float[Array, "m j"]:
    """[P, K] after the unit-noise row h with any gain k, in Joseph's form; along = h [P, K].

    P <- (I - k h) P (I - k h)' + k k',  K <- (I - k h) K + k e'.
    """
    m = h.shape[0]
    joint = joint - k[:, None] * along
    twice = (k - dot(joint[:, :m], h))[:, None] * k
    return joint + jnp.concatenate([twice, k[:, None] * unit], 1)


def absorb_known(
    P: Float[Array, "m m"], M: Float[Array, "p m"]
) -> tuple[Float[Array, "m p"], Float[Array, "m m"]]:
    """Kalman gain and covariance after whitened rows M, where everything has a prior."""
    p, m = M.shape
    rows = jnp.arange(p)

    def row(i, joint):
        along = dot(M[i], joint)
        gain = along[:m] / (dot(along[:m], M[i]) + 1.0)
        return _correct(joint, along, M[i], gain, jnp.where(rows == i, 1.0, 0.0))

    joint = repeat(p, row, jnp.concatenate([P, jnp.zeros((m, p))], 1))
    return joint[:, m:], symmetric(joint[:, :m])


def absorb(
    P: Float[Array, "m m"], M: Float[Array, "p m"], free: Float[Array, "m q"], parts: Split
) -> Update:
    """The best linear unbiased update by whitened rows M, given their split.

    Rotated rows are taken last to first: the blind ones with the Kalman gain, each other with
    its free column over its pivot, the only gain that leaves nothing of that column.
    """
    p, m = M.shape
    rotated = dot(parts.rotation, M)
    rows = jnp.arange(p)
    used = jnp.sum(parts.pivot, 1) > 0
    heads = jnp.where(used, jnp.sum(parts.pivot * parts.map, 1), 1.0)
    columns = dot(free, parts.pivot.T) / heads

    def row(step, carry):
        joint, solved = carry
        i = p - 1 - step
        h, unit = rotated[i], jnp.where(rows == i, 1.0, 0.0)
        along = dot(h, joint)
        kalman = along[:m] / (dot(along[:m], h) + 1.0)
        k = jnp.where(used[i], columns[:, i], kalman)
        weight = (unit - along[m:]) / heads[i]
        return _correct(joint, along, h, k, unit), solved + parts.pivot[i][:, None] * weight

    start = (jnp.concatenate([P, jnp.zeros((m, p))], 1), jnp.zeros((free.shape[1], p)))
    joint, solved = repeat(p, row, start)
    blind = parts.rotation - dot(dot(parts.map, solved), parts.rotation)
    return Update(dot(joint[:, m:], parts.rotation), symmetric(joint[:, :m]), blind)


def leftover(free: Float[Array, "m q"], parts: Split) -> Float[Array, "m q"]:
    """What stays free after an update: N minus its determined columns, their place set to 0.

    Determined directions follow the free ones, R1 delta_1 = -T2 delta_2, by back
    substitution. Entries that only rounding keeps from zero are set to zero.
    """
    p, q = parts.map.shape
    open_columns = 1.0 - jnp.sum(parts.pivot, 0)

    def row(step, follow):
        i = p - 1 - step
        pivot = parts.pivot[i]
        head = jnp.where(jnp.sum(pivot) > 0, jnp.sum(pivot * parts.map[i]), 1.0)
        through = parts.map[i] * (1.0 - pivot)
        rest = parts.map[i] * open_columns - dot(through, follow)
        size = jnp.abs(parts.map[i]) + dot(jnp.abs(through), jnp.abs(follow))
        rest = jnp.where(jnp.abs(rest) > RANK_TOLERANCE * size, rest, 0.0)
        return follow + pivot[:, None] * rest / head

    follow = jax.lax.fori_loop(0, p, row, jnp.zeros((q, q)))
    size = jnp.abs(free) + dot(jnp.abs(free), jnp.abs(follow))
    left = (free - dot(free, follow)) * open_columns
    return jnp.where(jnp.abs(left) > RANK_TOLERANCE * size, left, 0.0)


def echelon(N: Float[Array, "m q"]) -> Float[Array, "m m"]:
    """A basis of the span of N, at most m columns, reduced so that its zeros are exact.

    Complete pivoting on entries relative to their size without cancellation.
    """
    m, q = N.shape
    rows, columns = jnp.arange(m), jnp.arange(q)

    def pivot(r, carry):
        work, size, basis, open_rows, open_columns = carry
        relative = jnp.where(
            open_rows[:, None] & open_columns & (size > 0),
            jnp.abs(work) / jnp.where(size > 0, size, 1.0),
            0.0,
        )
        ok = jnp.max(relative) > RANK_TOLERANCE
        place = _first_largest(relative.ravel())
        here, there = rows == place // q, columns == place % q
        pivot_row = jnp.sum(jnp.where(here[:, None], work, 0.0), 0)
        pivot_column = jnp.sum(jnp.where(there, work, 0.0), 1)
        head = jnp.where(ok, jnp.sum(jnp.where(there, pivot_row, 0.0)), 1.0)
        bound = jnp.sum(jnp.where(there, size, 0.0), 1)
        real = jnp.abs(pivot_column) > RANK_TOLERANCE * bound
        column = jnp.where(here, 1.0, jnp.where(real, pivot_column / head, 0.0))
        others = jnp.where(there, 0.0, pivot_row)
        cleared = jnp.where(here[:, None], 0.0, work - column[:, None] * others)
        grown = size + jnp.abs(column)[:, None] * jnp.abs(others)
        # earlier basis columns lose their entry on the new pivot row: reduced form
        reduced = basis - column[:, None] * jnp.sum(jnp.where(here[:, None], basis, 0.0), 0)
        basis = jnp.where(rows == r, column[:, None], reduced)
        return (
            jnp.where(ok, cleared, work),
            jnp.where(ok, grown, size),
            jnp.where(ok, basis, carry[2]),
            open_rows & ~(ok & here),
            open_columns & ~(ok & there),
        )

    start = (N, jnp.abs(N), jnp.zeros((m, m)), jnp.ones(m, bool), jnp.ones(q, bool))
    return jax.lax.fori_loop(0, min(m, q), pivot, start)[2]


def _first_largest(values: Float[Array, " m"]) -> Int[Array, ""]:
    """Argmax as two plain reductions, which XLA's CPU backend compiles into a loop's kernel."""
    index = jnp.arange(values.shape[0])
    return jnp.min(jnp.where(values == jnp.max(values), index, values.shape[0]))


def undetermined(N: Float[Array, "m q"]) -> Bool[Array, " m"]:
    """Which entries of z the data leave free."""
    return jnp.any(N != 0, 1)
