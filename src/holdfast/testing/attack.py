"""The contract of an attack."""

import jax
import jax.numpy as jnp

from holdfast.parts import Attack, Plant
from holdfast.records import Injection, Knowledge
from holdfast.testing.common import (
    check_machine,
    check_no_nan,
    check_part,
    check_same,
    require,
    row_of,
    scan,
)


def check_attack(attack: Attack, plant: Plant, *, steps: int = 40, seed: int = 0) -> None:
    """Check an attack on ``plant``.

    Single steps, a scan and a batch (over samples, over keys) give the same numbers; the
    injection has the plant's shapes and no NaN; randomness comes from the key alone; the part
    is frozen and final and stepping does not change it.

    Raises `AssertionError` naming the contract that is broken.
    """
    check_part(attack, Attack)
    nu, ny, nd = len(plant.inputs), len(plant.outputs), len(plant.attacks)
    command, measure, key = jax.random.split(jax.random.key(seed), 3)
    u = jax.random.normal(command, (steps, nu))
    y = jax.random.normal(measure, (steps, ny))
    rows = jax.vmap(Knowledge)(jnp.arange(steps, dtype=jnp.int32), u, y)
    state = attack.init(key, row_of(rows, 0))
    injected = jax.eval_shape(attack.step, state, row_of(rows, 0))[1]
    require(attack, isinstance(injected, Injection), "step does not return an Injection")
    for name, size in {"u": nu, "y": ny, "d": nd}.items():
        found = getattr(injected, name).shape
        require(attack, found == (size,), f"injection.{name} has shape {found}, not ({size},)")
    check_machine(attack, state, rows)
    check_no_nan(attack, scan(attack, state, rows), "")

    def of_key(key):
        return scan(attack, attack.init(key, row_of(rows, 0)), rows)

    keys = jax.random.split(key, 3)
    alone = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(of_key, keys))
    check_same(attack, "a batch over keys is not as its members", jax.vmap(of_key)(keys), alone)
