"""A monitor's step on flat vectors of floats.

Handing over many small arrays costs more than a filter, so the live step keeps state and outcome
in one vector; for a fleet such vectors are the rows of a matrix.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from holdfast.loop import Monitor, monitor_step
from holdfast.records import Array, Estimate, Observation, Verdict, screen

T = TypeVar("T")


class Slot(NamedTuple):
    """Where one array of a record lies in a flat vector of floats."""

    start: int
    stop: int
    shape: tuple[int, ...]
    dtype: Any


class FlatMonitor:
    """A monitor as a function of vectors.

    ``start``: the state before the first row. ``outcome_size``: numbers of what a row gives.
    A sample is u, y, seen and trusted one after the other. ``estimate``, ``verdict``: what
    makes the records of an outcome, without the constructors' checks.
    """

    def __init__(self, monitor: Monitor):
        plant = monitor.estimator.plant
        self.monitor = monitor
        self._nu, self._ny = len(plant.inputs), len(plant.outputs)
        state = (monitor.init(), jnp.zeros(self._nu))
        self._slots, self._tree = _layout(state)
        # by NumPy: JAX would compile a program for every shape
        self.start = np.concatenate(
            [np.ravel(leaf).astype(float) for leaf in jax.tree.leaves(state)]
        )
        outcome = jax.eval_shape(self._outcome, state, np.zeros(self.sample_size))[1]
        slots, _ = _layout(outcome)
        self.outcome_size = slots[-1].stop
        split = len(jax.tree.leaves(outcome[0]))
        named = [*_named(outcome[0]), *_named(outcome[1])]
        self._fields = dict(zip(named, slots, strict=True))
        self.estimate: Callable[[np.ndarray], Estimate] = _reader(outcome[0], slots[:split])
        self.verdict: Callable[[np.ndarray], Verdict] = _reader(outcome[1], slots[split:])

    def field(self, outcomes: np.ndarray, name: str) -> np.ndarray:
        """A field of estimate or verdict, of any number of outcomes."""
        start, stop, shape, dtype = self._fields[name]
        found = outcomes[..., start:stop].reshape(*outcomes.shape[:-1], *shape)
        return found.astype(dtype, copy=False)

    @property
    def sample_size(self) -> int:
        """Numbers of a sample."""
        return self._nu + 3 * self._ny

    def step(
        self, state: Float[Array, " s"], sample: Float[Array, " m"]
    ) -> tuple[Float[Array, " s"], Float[Array, " r"]]:
        """One row: the state after it, and its outcome."""
        after, outcome = self._outcome(_unpack(state, self._slots, self._tree), sample)
        return _pack(after), _pack(outcome)

    def _outcome(self, state, sample):
        nu, ny = self._nu, self._ny
        inner, u_before = state
        observation = Observation(
            u=sample[:nu],
            y=sample[nu : nu + ny],
            seen=sample[nu + ny : nu + 2 * ny] != 0,
            trusted=sample[nu + 2 * ny :] != 0,
            status=jnp.asarray(0, jnp.int32),
        )
        clean = screen(observation, u_before)
        inner, outcome = monitor_step(self.monitor, inner, clean)
        return (inner, clean.u), outcome


def _layout(tree: Any) -> tuple[list[Slot], Any]:
    leaves, structure = jax.tree.flatten(tree)
    slots, start = [], 0
    for leaf in leaves:
        stop = start + math.prod(leaf.shape)
        slots.append(Slot(start, stop, tuple(leaf.shape), np.dtype(leaf.dtype)))
        start = stop
    return slots, structure


def _pack(tree: Any) -> jax.Array:
    """Every leaf as floats in one vector; counters and flags are exact in float64."""
    return jnp.concatenate([jnp.ravel(leaf).astype(float) for leaf in jax.tree.leaves(tree)])


def _unpack(flat: jax.Array, slots: list[Slot], tree: Any) -> Any:
    leaves = [flat[s.start : s.stop].reshape(s.shape).astype(s.dtype) for s in slots]
    return jax.tree.unflatten(tree, leaves)


def _named(record: Any) -> list[str]:
    """The fields of a record that there are, in the order of its leaves."""
    every = record.__dataclass_fields__
    return [name for name in every if getattr(record, name) is not None]


def _reader(record: T, slots: list[Slot]) -> Callable[[np.ndarray], T]:
    """What makes such a record of the flat result: views of it, counters and flags converted.

    Built without the constructor's checks, which would cost more than the filter.
    """
    kind = type(record)
    every = list(kind.__dataclass_fields__)  # type: ignore[attr-defined]
    always: dict[str, Any] = {}
    vectors, matrices, scalars = [], [], []
    for name, (start, stop, shape, dtype) in zip(_named(record), slots, strict=True):
        if start == stop:
            always[name] = np.zeros(shape, dtype)
        elif not shape:
            scalars.append((name, start, dtype.type))
        elif len(shape) == 1:
            vectors.append((name, slice(start, stop), dtype))
        else:
            matrices.append((name, slice(start, stop), shape))

    def read(values: np.ndarray) -> T:
        fields = dict.fromkeys(every)
        fields.update(always)
        for name, part, dtype in vectors:
            fields[name] = values[part].astype(dtype, copy=False)
        for name, part, shape in matrices:
            fields[name] = values[part].reshape(shape)
        for name, at, convert in scalars:
            fields[name] = values[at] if convert is np.float64 else convert(values[at])
        record = object.__new__(kind)
        object.__setattr__(record, "__dict__", fields)
        return record

    return read
