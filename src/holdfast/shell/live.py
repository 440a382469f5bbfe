"""The same step as `replay` and `simulate`, sample by sample, as fast as Python allows."""

import ctypes
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from holdfast.loop import Monitor
from holdfast.records import Estimate, Observation, Verdict
from holdfast.shell import runtime
from holdfast.shell.flat import FlatMonitor


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
        flat = FlatMonitor(monitor)
        self._sample = np.ones(flat.sample_size + 1)
        size = self._size = flat.outcome_size

        def step(both, sample):
            # XLA's CPU backend compiles a small loop as one kernel, and runs straight code
            # operation by operation, at several times the cost: hence a loop of one turn,
            # whose length the compiler cannot know.
            def turn(carry):
                both, sample = carry
                after, outcome = flat.step(both[size:], sample[:-1])
                return jnp.concatenate([outcome, after]), sample.at[-1].add(-1.0)

            return jax.lax.while_loop(lambda carry: carry[1][-1] > 0, turn, (both, sample))[0]

        self._step = jax.jit(step, donate_argnums=0)
        self._start = np.concatenate([np.zeros(size), flat.start])
        self._estimate, self._verdict = flat.estimate, flat.verdict
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


def _if_constant(flags: Any) -> np.ndarray | None:
    """The array, if nobody can change it until it is seen again."""
    return flags if isinstance(flags, np.ndarray) and not flags.flags.writeable else None
