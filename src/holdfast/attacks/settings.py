"""Checked numbers for the attacks' settings, as arrays, so that a new value recompiles nothing."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from holdfast.parts import InvalidValue, Plant

ROUNDING = 1e-9
"""Steps by which start / dt may miss a whole number: 0.3 / 0.1 is the third sample."""

NEVER = 2**31 - 1
"""The largest step number."""


def number(key: str, value: float, least: float = -math.inf) -> Float[Array, ""]:
    """``value``, finite and not under ``least``."""
    if not (math.isfinite(value) and value >= least):
        expected = "a finite number" if least == -math.inf else f"a finite number >= {least:g}"
        raise InvalidValue(key, value, expected)
    return jnp.asarray(value, float)


def first_step(plant: Plant, seconds: float) -> int:
    """The first sample k with k dt >= ``seconds``; the largest there is for infinity."""
    steps = seconds / plant.dt
    return math.ceil(steps - ROUNDING) if abs(steps) < NEVER else int(math.copysign(NEVER, steps))


def sample_count(plant: Plant, key: str, seconds: float) -> int:
    """How many samples ``seconds`` are, to the nearest; at least one."""
    number(key, seconds)
    count = round(seconds / plant.dt)
    if count < 1:
        raise InvalidValue(key, seconds, f"at least one sample ({plant.dt:g} s)")
    return count
