"""Small problems side by side: one problem for each entry of the last axis of every array.

Under plain `jax.vmap` the batch is the first axis, and XLA's CPU backend goes through it entry
by entry. Written for whole vectors and folded term by term over the short axes, an active-set
loop is several times faster. Functions here take arrays with or without that last axis.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

BLOCK = 64
"""Problems of a batch that are worked on side by side: they fit the cache, and the loop ends
with the slowest of 64 and not of all."""
UNROLLED = 32
"""Terms up to which a sum is written out; beyond it compilation would take too long."""


def in_lanes(alone: Callable[..., tuple], lanes: Callable[..., tuple]) -> Callable[..., tuple]:
    """``alone(*arrays)``; under `jax.vmap` ``lanes`` on blocks of the batch, batch axis last."""

    def block(given):
        found = lanes(*(jnp.moveaxis(a, 0, -1) for a in given))
        return tuple(jnp.moveaxis(a, -1, 0) for a in found)

    function = jax.custom_batching.custom_vmap(alone)

    @function.def_vmap
    def _(axis_size, in_batched, *given):
        """A batch as blocks, the last one filled up with problems met before."""
        given = tuple(
            a if of_a else jnp.broadcast_to(a, (axis_size, *a.shape))
            for a, of_a in zip(given, in_batched, strict=True)
        )
        if axis_size <= BLOCK:
            found = block(given)
        else:
            fill = -axis_size % BLOCK
            blocks = tuple(
                jnp.concatenate([a, a[:fill]]).reshape(-1, BLOCK, *a.shape[1:]) for a in given
            )
            found = jax.lax.map(block, blocks)
            found = tuple(a.reshape(-1, *a.shape[2:])[:axis_size] for a in found)
        return found, (True,) * len(found)

    return function


def _folded(operation: Callable[[Any, Any], Any], plain: Callable[..., Any], terms):
    """Over the first axis, term by term: a reduction would go entry by entry."""
    if len(terms) > UNROLLED:
        return plain(jnp.asarray(terms), axis=0)
    return functools.reduce(operation, [terms[i] for i in range(len(terms))])


def total(terms):
    """The sum over the first axis."""
    return _folded(operator.add, jnp.sum, terms)


def largest(terms):
    """The largest over the first axis."""
    return _folded(jnp.maximum, jnp.max, terms)


def any_of(terms):
    """Whether one of the first axis is true."""
    return _folded(operator.or_, jnp.any, terms)


def dot_rows(a, b):
    """Sums over the second axis of a * b."""
    if a.shape[1] > UNROLLED:
        return jnp.sum(a * b, 1)
    return total([a[:, i] * b[:, i] for i in range(a.shape[1])])


def pick(table, one_hot):
    """The row of ``table`` that is marked; both have lanes, or ``table`` a last axis of one."""
    between = (1,) * (table.ndim - one_hot.ndim)
    marked = one_hot.reshape(one_hot.shape[0], *between, *one_hot.shape[1:])
    if len(table) > UNROLLED:
        return jnp.sum(jnp.where(marked, table, 0.0), 0)
    return total([jnp.where(marked[i], table[i], 0.0) for i in range(len(table))])


def first(values, wanted):
    """One-hot: the first entry that equals ``wanted``."""
    if len(values) > UNROLLED:
        index = jnp.arange(len(values)).reshape(-1, *(1,) * (values.ndim - 1))
        return index == jnp.argmax(values == wanted, 0)
    found, before = [], jnp.zeros_like(wanted, bool)
    for i in range(len(values)):
        here = values[i] == wanted
        found.append(here & ~before)
        before = before | here
    return jnp.stack(found)
