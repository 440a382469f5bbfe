"""What every part with a state owes, and how a broken contract is said."""

import copy
from dataclasses import fields
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

EXACT = 1e-12
"""How far the same arithmetic may differ between one program and another."""

REARRANGED = 1e-8
"""How far other arithmetic for the same quantity may: 1e-16 times a condition of 1e8."""


def require(part: Any, holds: bool, contract: str) -> None:
    """Say which contract the part has broken, unless it holds."""
    assert holds, f"{type(part).__name__}: {contract}"


def check_part(part: Any, kind: type) -> None:
    """Frozen, final: settings that cannot be set, one level of inheritance."""
    require(part, isinstance(part, kind), f"is not a {kind.__name__}")
    bases = type(part).__bases__
    require(part, bases == (kind,), f"derives from {bases}, not from {kind.__name__} alone")
    name = fields(part)[0].name if fields(part) else "anything"
    try:
        setattr(part, name, getattr(part, name, None))
    except AttributeError:
        return
    require(part, False, f"is not frozen: {name} can be set")


def row_of(rows: Any, k: int) -> Any:
    """Row k of records with time along the leading axis."""
    return jax.tree.map(lambda leaf: leaf[k], rows)


@eqx.filter_jit
def scan(part: Any, state: Any, rows: Any) -> Any:
    """What the part says of all rows, in one program."""
    return jax.lax.scan(lambda state, row: part.step(state, row), state, rows)[1]


def stepped(part: Any, state: Any, rows: Any) -> Any:
    """Row by row through a step compiled afresh."""
    step = eqx.filter_jit(lambda part, state, row: part.step(state, row))
    found = []
    for k in range(len(jax.tree.leaves(rows)[0])):
        state, out = step(part, state, row_of(rows, k))
        found.append(out)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)


def check_machine(part: Any, state: Any, rows: Any) -> None:
    """What every part with a state owes: one meaning, whoever drives it."""
    settings = copy.deepcopy(part)
    after = jax.eval_shape(part.step, state, row_of(rows, 0))[0]
    shapes = jax.tree.map(lambda leaf: (jnp.shape(leaf), jnp.result_type(leaf)), (state, after))
    require(part, shapes[0] == shapes[1], f"step turns a state {shapes[0]} into {shapes[1]}")
    scanned = scan(part, state, rows)
    check_same(part, "single steps differ from a scan", stepped(part, state, rows), scanned)
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf[::-1]]), rows)
    batched = eqx.filter_vmap(scan, in_axes=(None, None, 0))(part, state, both)
    alone = [scan(part, state, row_of(both, i)) for i in range(2)]
    members = jax.tree.map(lambda *leaves: jnp.stack(leaves), *alone)
    check_same(part, "a batch is not as its members", batched, members, REARRANGED)
    contract = "stepping has changed the settings"
    require(part, jax.tree.structure(settings) == jax.tree.structure(part), contract)
    check_same(part, contract, part, settings, 0.0)


def check_same(
    part: Any, contract: str, found: Any, expected: Any, tolerance: float = EXACT
) -> None:
    """Leaf by leaf, relative to the largest entry of the leaf where that is over 1."""
    pairs = zip(jax.tree_util.tree_leaves_with_path(found), jax.tree.leaves(expected), strict=True)
    for (path, leaf), other in pairs:
        a, b = np.asarray(leaf, float), np.asarray(other, float)
        usual = np.isfinite(b)
        size = max(1.0, np.max(np.abs(b[usual]), initial=0.0))
        gap = np.max(np.abs(np.where(usual, a - np.where(usual, b, 0.0), 0.0)), initial=0.0)
        same = np.array_equal(a[~usual], b[~usual], equal_nan=True) and gap <= tolerance * size
        where = jax.tree_util.keystr(path).lstrip(".")
        require(part, bool(same), f"{contract} in {where}, by {gap:.3g} of {size:.3g}")


def check_no_nan(part: Any, record: Any, where: str) -> None:
    """No NaN anywhere in a record."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(record):
        name = jax.tree_util.keystr(path).lstrip(".")
        require(part, not np.any(np.isnan(np.asarray(leaf))), f"NaN in {name} {where}".strip())
