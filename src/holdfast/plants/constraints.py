"""What physics allows: polytopes for the state and for the attack, which may move in time."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from holdfast.numerics.linalg import dot
from holdfast.numerics.projection import project
from holdfast.parts import InvalidValue, Plant


class Polytope(eqx.Module):
    """``matrix z <= bound + bound_u u``; each constant, or per step with time first.

    Row k of a log uses entry k-1. A bound of +inf is no bound at that step.
    """

    matrix: Float[Array, "*t m n"]
    bound: Float[Array, "*s m"]
    bound_u: Float[Array, "*r m nu"]

    def at(self, k, u) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """Rows and bounds at step k, ``u`` being the input of row k."""
        bound = _entry(self.bound, k, 1) + dot(_entry(self.bound_u, k, 2), u)
        return _entry(self.matrix, k, 2), bound

    def nearest(self, k, u, z) -> Float[Array, " n"]:
        """The point of the set at step k that is nearest to z; z itself where it is empty."""
        rows, bound = self.at(k, u)
        return project(z, jnp.eye(rows.shape[1]), rows, bound).point

    @property
    def lengths(self) -> list[int]:
        """How many steps each array that varies covers."""
        sizes = ((self.matrix, 2), (self.bound, 1), (self.bound_u, 2))
        return [array.shape[0] for array, size in sizes if array.ndim > size]


class Constraints(eqx.Module):
    """The polytopes that the state and the attack cannot leave."""

    state: Polytope
    attack: Polytope

    @property
    def lengths(self) -> list[int]:
        """How many steps each array that varies covers."""
        return self.state.lengths + self.attack.lengths


def _entry(array, k, size: int):
    if array.ndim == size:
        return array
    return jax.lax.dynamic_index_in_dim(array, jnp.maximum(k - 1, 0), keepdims=False)


def limits_of(plant: Plant) -> Constraints:
    """The plant's constraints; none where it states none."""
    found = getattr(plant, "constraints", None)
    sizes = (len(plant.states), len(plant.inputs), len(plant.attacks))
    return constraints({}, *sizes) if found is None else found


def constraints(sets: dict[str, dict[str, Any]], n: int, nu: int, nd: int) -> Constraints:
    """Checked `Constraints` from {"state" | "attack": {"matrix", "bound", "bound_u"}}.

    Raises `InvalidValue` naming the key, what was found and what was expected.
    """
    for key in sets:
        if key not in ("state", "attack"):
            raise InvalidValue("constraints", repr(key), "'state' or 'attack'")
    parts = []
    for key, columns in (("state", n), ("attack", nd)):
        given = sets.get(key, {"matrix": np.zeros((0, columns)), "bound": []})
        where = f"constraints.{key}"
        matrix = _numbers(f"{where}.matrix", given["matrix"])
        rows = matrix.shape[-2] if matrix.ndim > 1 else 0
        bound = _numbers(f"{where}.bound", given["bound"], infinite=True)
        by_u = given.get("bound_u")
        bound_u = np.zeros((rows, nu)) if by_u is None else _numbers(f"{where}.bound_u", by_u)
        for name, array, shape in (
            ("matrix", matrix, (rows, columns)),
            ("bound", bound, (rows,)),
            ("bound_u", bound_u, (rows, nu)),
        ):
            if array.shape[-len(shape) :] != shape or array.ndim > len(shape) + 1:
                expected = f"shape {shape}, or per step with time first"
                raise InvalidValue(f"{where}.{name}", array.shape, expected)
        parts.append(Polytope(jnp.asarray(matrix), jnp.asarray(bound), jnp.asarray(bound_u)))
    found = Constraints(*parts)
    if len(set(found.lengths)) > 1:
        raise InvalidValue(
            "constraints", f"per-step lengths {found.lengths}", "one number of steps"
        )
    return found


def _numbers(key: str, value: Any, *, infinite: bool = False) -> np.ndarray:
    """An array of numbers; +inf only where it says that there is no bound."""
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        raise InvalidValue(key, "rows of unequal length or text", "numbers") from None
    if np.any(np.isnan(array)) or (not infinite and not np.all(np.isfinite(array))):
        raise InvalidValue(key, "NaN or infinity", "finite numbers")
    if np.any(np.isneginf(array)):
        raise InvalidValue(key, "-inf", "numbers, or inf for no bound")
    return array
