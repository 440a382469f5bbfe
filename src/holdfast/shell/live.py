"""The same step as `replay` and `simulate`, sample by sample, as fast as Python allows."""

import ctypes
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from holdfast.loop import Monitor, monitor_step
from holdfast.records import Estimate, Observation, Verdict, screen
from holdfast.shell import runtime

T = TypeVar("T")


class _Slot(NamedTuple):
    """Where one array of a record lies in a flat vector of floats."""

    start: int
    stop: int
    shape: tuple[int, ...]
    dtype: Any


class Live:
    """Holds a monitor's state; `push` takes one observation and returns what it says.

    The step is compiled once with the monitor baked in. State and outcome stay in one flat
    array that is donated to every call, because handing over many small arrays costs more
    than the filter. One stream per object; not thread-safe.
    """

    def __init__(self, monitor: Monitor):
        # compiled code kept on disk; calls that return when the step is done, where JAX has
        # not computed anything yet (handing over to another thread costs as much again)
        runtime.configure()
        plant = monitor.estimator.plant
        self.monitor = monitor
        self._nu, self._ny = len(plant.inputs), len(plant.outputs)
        state = (monitor.init(), jnp.zeros(self._nu))
        self._sample = np.ones(self._nu + 3 * self._ny + 1)
        outcome = jax.eval_shape(self._outcome, state, self._sample)[1]
        outcome_slots, _ = _layout(outcome, 0)
        self._size = outcome_slots[-1].stop
        slots, tree = _layout(state, self._size)

        def step(flat, sample):
            # XLA's CPU backend compiles a small loop as one kernel, and runs straight code
            # operation by operation, at several times the cost: hence a loop of one turn,
            # whose length the compiler cannot know.
            def turn(carry):
                flat, sample = carry
                after, outcome = self._outcome(_unpack(flat, slots, tree), sample)
                return jnp.concatenate([_pack(outcome), _pack(after)]), sample.at[-1].add(-1.0)

            return jax.lax.while_loop(lambda carry: carry[1][-1] > 0, turn, (flat, sample))[0]

        self._step = jax.jit(step, donate_argnums=0)
        self._start = np.concatenate([np.zeros(self._size), np.asarray(_pack(state))])
        split = len(jax.tree.leaves(outcome[0]))
        self._estimate = _reader(outcome[0], outcome_slots[:split])
        self._verdict = _reader(outcome[1], outcome_slots[split:])
        self.reset()
        self.push(Observation.of(np.zeros(self._nu), np.zeros(self._ny)))  # compiles
        self.reset()

    def reset(self) -> None:
        """Back to before the first row."""
        self.restore(self._start[self._size :])
        self._seen = self._trusted = None
        self._views: dict[int, np.ndarray] = {}

    def snapshot(self) -> np.ndarray:
        """The state after the last row, as numbers; `restore` goes back to it."""
        return np.asarray(self._flat)[self._size :].copy()

    def restore(self, snapshot: np.ndarray) -> None:
        """Go back to a snapshot of a `Live` of the same monitor. Raises `ValueError` else."""
        wanted = (len(self._start) - self._size,)
        if snapshot.shape != wanted:
            raise ValueError(f"snapshot: found shape {snapshot.shape}, expected {wanted}")
        self._flat = jnp.array(np.concatenate([self._start[: self._size], snapshot]))

    def push(self, observation: Observation) -> tuple[Estimate, Verdict]:
        """One sample: estimate and verdict, as NumPy arrays.

        ``observation`` may hold NumPy arrays (faster) or JAX arrays; NaN, infinity and samples
        that did not arrive are dealt with as in a log.
        """
        nu, ny, sample = self._nu, self._ny, self._sample
        sample[:nu] = observation.u
        sample[nu : nu + ny] = observation.y
        # the defaults of Observation.of are the same read-only arrays every time
        if observation.seen is not self._seen:
            sample[nu + ny : nu + 2 * ny] = observation.seen
            self._seen = _if_constant(observation.seen)
        if observation.trusted is not self._trusted:
            sample[nu + 2 * ny : -1] = observation.trusted
            self._trusted = _if_constant(observation.trusted)
        self._flat = self._step(self._flat, sample)
        values = self._outcome_of(self._flat)
        return self._estimate(values), self._verdict(values)

    def _outcome_of(self, flat: jax.Array) -> np.ndarray:
        """A copy of the outcome, read at the array's address: 3 us less than `np.asarray`.

        They are copied before the next call, to which the array is donated.
        """
        flat.block_until_ready()
        address = flat.unsafe_buffer_pointer()
        view = self._views.get(address)
        if view is None:
            raw = (ctypes.c_double * self._size).from_address(address)
            view = self._views[address] = np.frombuffer(memoryview(raw))
        return view.copy()

    def _outcome(self, state, sample):
        nu, ny = self._nu, self._ny
        inner, u_before = state
        observation = Observation(
            u=sample[:nu],
            y=sample[nu : nu + ny],
            seen=sample[nu + ny : nu + 2 * ny] != 0,
            trusted=sample[nu + 2 * ny : -1] != 0,
            status=jnp.asarray(0, jnp.int32),
        )
        clean = screen(observation, u_before)
        inner, outcome = monitor_step(self.monitor, inner, clean)
        return (inner, clean.u), outcome


def _if_constant(flags: Any) -> np.ndarray | None:
    """The array, if nobody can change it until it is seen again."""
    return flags if isinstance(flags, np.ndarray) and not flags.flags.writeable else None


def _layout(tree: Any, start: int) -> tuple[list[_Slot], Any]:
    leaves, structure = jax.tree.flatten(tree)
    slots = []
    for leaf in leaves:
        stop = start + math.prod(leaf.shape)
        slots.append(_Slot(start, stop, tuple(leaf.shape), np.dtype(leaf.dtype)))
        start = stop
    return slots, structure


def _pack(tree: Any) -> jax.Array:
    """Every leaf as floats in one vector; counters and flags are exact in float64."""
    return jnp.concatenate([jnp.ravel(leaf).astype(float) for leaf in jax.tree.leaves(tree)])


def _unpack(flat: jax.Array, slots: list[_Slot], tree: Any) -> Any:
    leaves = [flat[s.start : s.stop].reshape(s.shape).astype(s.dtype) for s in slots]
    return jax.tree.unflatten(tree, leaves)


def _reader(record: T, slots: list[_Slot]) -> Callable[[np.ndarray], T]:
    """What makes such a record of the flat result: views of it, counters and flags converted.

    Built without the constructor's checks, which would cost more than the filter.
    """
    kind = type(record)
    every = list(kind.__dataclass_fields__)  # type: ignore[attr-defined]
    names = [name for name in every if getattr(record, name) is not None]
    always: dict[str, Any] = {}
    vectors, matrices, scalars = [], [], []
    for name, (start, stop, shape, dtype) in zip(names, slots, strict=True):
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
