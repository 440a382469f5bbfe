"""Filters that differ from one another in a few unknown inputs, as corrections of one filter.

A filter that knows of no attack has P after the row, gain K, and whitened innovations e = T nu
(`holdfast.numerics.innovations`). One that leaves r directions of attack wholly free has, at
every row, the covariance P + Z Z' with a Z of few columns, and its innovation is

    nu = C e + Y_z z + F delta + v,        z ~ (0, I) what its state is uncertain beyond P,

delta the attack of this row, without prior. With X the columns that the same z and delta add
to the state, everything follows from P's own U and T and small matrices: let B = T [Y_z, F],

    I + B_z'B_z = L L',   R = L^-1 B_z'B_f,   D = [B_z L^-T, B_f - B_z L^-T R],
    Sigma = D_f'D_f + |L^-T R|^2   (the information about delta: F' S^-1 F, S this filter's),
    delta^ = Sigma^-1 D_f'e,     x^ = x^_0 + U e + X_z D_z'e + X_f delta^,
    Z+ = [X_z, X_f Sigma^-1/2],  X <- X - U T Y, mixed like D.

No inverse of the large S beyond the one that all share; nothing is subtracted from P.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from holdfast.numerics.linalg import (
    dot,
    lower_factor,
    lower_inverse,
    one_at_a_time,
    repeat,
    symmetric,
)
from holdfast.numerics.square_root import triangle

INSEPARABLE = 1e-5
"""Share of a column's effect that must be its own: its square is far above rounding. Below it
directions of attack count as indistinguishable at this row."""


class Deviation(NamedTuple):
    """What a filter does beyond the common one, whatever is measured at the row.

    ``scores`` D (p x c): D'e; ``moves`` X (n x c); ``root`` of Sigma (r x r), with unit
    information added about a ``dependent`` direction: one whose effect is none, or that of a
    combination of directions before it, which stay free. ``unknown``: those, and all in such a
    combination. ``prior``: of Sigma + I, the attack being N(0, I) beforehand. ``log_det``:
    log |I + B_z'B_z|; ``log_free``: log of |Sigma| / |F'F| over what is not dependent.
    """

    scores: Float[Array, "p c"]
    moves: Float[Array, "n c"]
    root: Float[Array, "r r"]
    prior: Float[Array, "r r"]
    dependent: Bool[Array, " r"]
    unknown: Bool[Array, " r"]
    log_det: Float[Array, ""]
    log_free: Float[Array, ""]


def deviation(
    white: Float[Array, "p p"],
    common: Float[Array, "n p"],
    X: Float[Array, "n c"],
    Y: Float[Array, "p c"],
    r: int,
) -> Deviation:
    """The deviation whose last ``r`` columns are attacks and whose others are uncertainty.

    ``white``, ``common``: T and U of the filter that all share.
    X, Y: what each column adds to the predicted state and to the measurement (zero rows where
    nothing was seen).
    """
    z = X.shape[1] - r
    B = dot(white, Y)
    X = X - dot(common, B)
    uncertain, attacked = B[:, :z], B[:, z:]
    lower = _beyond_identity(_gram(uncertain, uncertain))
    inverse = lower_inverse(lower)
    R = dot(inverse, _gram(uncertain, attacked))
    D_z, X_z = dot(uncertain, inverse.T), dot(X[:, :z], inverse.T)
    D_f, X_f = attacked - dot(D_z, R), X[:, z:] - dot(X_z, R)
    rest = dot(inverse.T, R)
    Sigma = symmetric(_gram(D_f, D_f) + _gram(rest, rest))
    dependent, unknown = inseparable(Sigma, jnp.sum(attacked * attacked, 0))
    # unit information, or as much as the factor of a number 1e10 times larger can hold
    added = jnp.maximum(1.0, 1e-8 * jnp.diagonal(Sigma))
    root = lower_factor(Sigma + jnp.diag(jnp.where(dependent, added, 0.0)))[0]
    F = jnp.where(dependent, 0.0, Y[:, z:])
    size = lower_factor(_gram(F, F) + jnp.diag(jnp.where(dependent, 1.0, 0.0)))[0]
    known = jnp.where(dependent, 1.0, jnp.diagonal(root) / jnp.diagonal(size))
    return Deviation(
        jnp.concatenate([D_z, D_f], 1),
        jnp.concatenate([X_z, X_f], 1),
        root,
        _beyond_identity(Sigma),
        dependent,
        unknown,
        2.0 * jnp.sum(jnp.log(jnp.diagonal(lower))),
        2.0 * jnp.sum(jnp.log(known)),
    )


def _beyond_identity(p: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """L with L L' = I + P. No pivot is under 1, however small beside its row: a relative test, as
    in `lower_factor`, would give up what is known where P is 1e10 and more in one direction.
    """
    rows, whole = jnp.arange(p.shape[0]), p + jnp.eye(p.shape[0])

    def column(j, lower):
        rest = whole[:, j] - dot(lower, lower[j])
        root = jnp.sqrt(jnp.maximum(rest[j], 1.0))
        entries = jnp.where(rows > j, rest / root, jnp.where(rows == j, root, 0.0))
        return lower.at[:, j].set(entries)

    return repeat(p.shape[0], column, jnp.zeros_like(p))


def inseparable(
    Sigma: Float[Array, "r r"], size: Float[Array, " r"]
) -> tuple[Bool[Array, " r"], Bool[Array, " r"]]:
    """Which directions depend on those before them, and which are in such a combination too:
    the information matrix does not tell them, or not from one another.

    ``size``: the information each would have if all else were known.
    """
    unit = jnp.where(size > 0, 1.0 / jnp.sqrt(jnp.where(size > 0, size, 1.0)), 0.0)
    scaled = unit[:, None] * Sigma * unit[None, :]
    # a column without any effect is a combination of none of the others
    lower, independent = lower_factor(scaled)
    weak = jnp.diagonal(lower) < INSEPARABLE
    kept = independent & ~weak & (size > 0)
    lower = jnp.where(kept, lower, 0.0)
    inverse = lower_inverse(lower + jnp.diag(jnp.where(kept, 0.0, 1.0)))
    partners = jnp.where(kept[:, None], 0.0, dot(lower, inverse))
    return ~kept, ~kept | jnp.any(jnp.abs(partners) > INSEPARABLE, 0)


def after(
    moves: Float[Array, "n c"], root: Float[Array, "r r"], carried: Bool[Array, " r"], q: int
) -> Float[Array, "m c"]:
    """The factor of what is uncertain after the row, of the state and of the ``q`` last attacks.

    Those of them that are ``carried`` have been found and go on into the next row's motion.
    """
    r = root.shape[0]
    spread = lower_inverse(root).T
    z = moves.shape[1] - r
    state = jnp.concatenate([moves[:, :z], dot(moves[:, z:], spread)], 1)
    attacks = jnp.where(carried[:, None], spread, 0.0)[r - q :]
    return jnp.concatenate([state, jnp.pad(attacks, ((0, 0), (z, 0)))])


def shortened(Z: Float[Array, "m c"], columns: int) -> tuple[Float[Array, "m q"], Float[Array, ""]]:
    """Z with ``columns`` columns and the same Z Z', and the share of its trace that is lost.

    Exact where ``columns`` >= m; else the largest principal parts of Z Z' are kept.
    """
    m, c = Z.shape
    if columns >= c:
        return jnp.pad(Z, ((0, 0), (0, columns - c))), jnp.asarray(0.0)
    if columns >= m:
        return jnp.pad(_triangle(Z.T).T, ((0, 0), (0, columns - m))), jnp.asarray(0.0)
    values, turned = _principal(Z)
    total = jnp.sum(values)
    lost = jnp.sum(jnp.maximum(values[: c - columns], 0.0))
    return turned[:, c - columns :], lost / jnp.where(total > 0, total, 1.0)


_triangle = one_at_a_time(triangle)


@one_at_a_time
def _principal(Z):
    values, vectors = jnp.linalg.eigh(_gram(Z, Z))
    return values, Z @ vectors


def _gram(a, b):
    return dot(a.T, b)
