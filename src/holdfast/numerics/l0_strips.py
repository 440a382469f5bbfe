"""What an exact l0 regression searches: its rows as strips about a good x, in a good basis.

No proof rests on what is chosen here; it makes the circuits of `holdfast.numerics.circuits` short
and rounding small.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.circuits import Strips, spanning
from holdfast.numerics.linalg import repeat

EXACT = 1e-12
"""Least tolerance: of the sample's size or, if it is larger, of what the median sample says of a
row of this length."""
ABSOLUTE, REWEIGHTED = 12, 6
"""Rounds of the first guess: towards least absolute errors, then towards few."""
FIXED = 1e3
"""How much rather rows that are known to be clean are looked at."""
WIDE = 30.0
"""Times the median width at which a strip is looked at last."""


class Problem(NamedTuple):
    """The rows as given, and divided by ``scale`` as strips in another basis, about a good x.

    ``weight``: which rows to look at first.
    """

    Phi: Float[Array, "m n"]
    y: Float[Array, " m"]
    half: Float[Array, " m"]
    scale: Float[Array, " m"]
    strips: Strips
    used: Bool[Array, " m"]
    trusted: Bool[Array, " m"]
    weight: Float[Array, " m"]


def prepared(
    Phi: Float[Array, "m n"],
    y: Float[Array, " m"],
    unit: Int[Array, " m"],
    units: int,
    tolerance: Float[Array, " m"],
    used: Bool[Array, " m"],
    trusted: Bool[Array, " m"],
) -> Problem:
    """In terms of the rows' own best basis, about a robust fit: what is clean is then small."""
    sound = used & jnp.isfinite(y)
    seen = jnp.where(sound[:, None], Phi, 0.0)
    # nothing fits 0 x = 1
    y = jnp.where(sound, y, jnp.where(used, 1.0, 0.0))
    tolerance, trusted = jnp.where(sound, tolerance, 0.0), trusted & used
    column = jnp.max(jnp.abs(seen), 0)
    rows, size = _unit(seen / jnp.where(column > 0, column, 1.0))
    rows, again = _unit(spanning(rows, jnp.where(used, 1.0, 0.0)).table)
    scale = size * again
    typical = _median(jnp.abs(y / scale)) * jnp.sqrt(jnp.sum(rows * rows, 1)) * scale
    half = jnp.maximum(tolerance, EXACT * jnp.maximum(jnp.abs(y), typical))
    strips = Strips(rows, y / scale, half / scale, unit)
    middle = rows @ _robust(strips, units, used, trusted)
    strips = strips._replace(centre=jnp.where(used, strips.centre - middle, 0.0))
    width = _median(strips.half)
    weight = jnp.where(strips.half > WIDE * width, 1.0 / WIDE, 1.0)
    return Problem(seen, y, half, scale, strips, used, trusted, weight)


def _unit(rows):
    size = jnp.sqrt(jnp.sum(rows * rows, 1))
    size = jnp.where(size > 0, size, 1.0)
    return rows / size[:, None], size


def _median(a):
    """Of what is not zero."""
    some = jnp.sum(jnp.where(a > 0, 1, 0))
    return jnp.where(some > 0, jnp.sort(a)[len(a) - 1 - some // 2], 0.0)


def _robust(strips: Strips, units: int, used, trusted):
    """Reweighted least squares: a guess, on which no proof rests."""
    rows, y = strips.rows, strips.centre
    n = rows.shape[1]
    typical = _median(jnp.abs(y)) + jnp.finfo(y.dtype).tiny ** 0.25
    floor = jnp.maximum(strips.half, 1e-9 * typical)

    def closer(i, s):
        missed = jnp.where(used, jnp.square(y - rows @ s), 0.0)
        if units < len(y):
            missed = jnp.zeros(units).at[strips.unit].add(missed)[strips.unit]
        # a single sample out of all proportion must not have a say in the first round
        inverse = 1.0 / (missed + jnp.square(jnp.where(i == 0, typical, floor)))
        weight = jnp.where(i < ABSOLUTE, jnp.sqrt(inverse), inverse)
        weight = jnp.where(used, weight * jnp.where(trusted, FIXED, 1.0), 0.0)
        heavy = (weight / jnp.max(weight))[:, None] * rows
        normal = heavy.T @ rows
        ridge = 1e-13 * (1e-3 + jnp.trace(normal))
        return s + jnp.linalg.solve(normal + ridge * jnp.eye(n), heavy.T @ (y - rows @ s))

    s = repeat(ABSOLUTE + REWEIGHTED, closer, jnp.zeros(n))
    # samples about it must still be the samples
    return jnp.where(jnp.all(jnp.abs(rows @ s) < 1e14 * strips.half), s, 0.0)
