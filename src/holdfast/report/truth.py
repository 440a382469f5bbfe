"""What the attack estimate of a simulated run should have been."""

from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from holdfast.records import Trace


@runtime_checkable
class Named(Protocol):
    """What a report needs of a plant: `holdfast.parts.Plant` has it all."""

    @property
    def dt(self) -> float:
        """Seconds between rows."""
        ...

    @property
    def states(self) -> tuple[str, ...]:
        """One name per state."""
        ...

    @property
    def inputs(self) -> tuple[str, ...]:
        """One name per input."""
        ...

    @property
    def outputs(self) -> tuple[str, ...]:
        """One name per output."""
        ...

    @property
    def attacks(self) -> tuple[str, ...]:
        """One name per attack channel."""
        ...

    @property
    def positions(self) -> tuple[str, ...]:
        """One name per position of the switches."""
        ...

    def transition(self, k, x, u, d) -> Any:
        """The state at k without noise."""

    def output(self, k, x, u, d) -> Any:
        """The measurement at k without noise."""


@runtime_checkable
class Modes(Protocol):
    """What the modes of ``Trace.named`` are: where the switches stand, by number, and which of
    the attack channels are attacked (modes x attacks).
    """

    @property
    def position(self) -> Any:
        """One number per mode."""
        ...

    @property
    def active(self) -> Any:
        """One row per mode."""
        ...


def true_mode(trace: Trace, truth: np.ndarray | None, modes: Modes) -> np.ndarray | None:
    """The number of the mode that was true, row by row; -1 for none of them.

    Attacked are the channels whose `true_attack` is not 0. Where an injection equals no values
    of the channels, or a switch was thrown at the row or just before it, no mode is true.
    None unless simulated.
    """
    if trace.injection is None:
        return None
    injection = jax.tree.map(np.asarray, trace.injection)
    if truth is None:  # no channel to say it with
        elsewhere = np.any(injection.y != 0, -1) | np.any(injection.u != 0, -1)
        attacked = np.zeros((*elsewhere.shape, 0), bool)
    else:
        elsewhere, attacked = np.any(np.isnan(truth), -1), truth != 0
    position = np.zeros(elsewhere.shape, int) if injection.switch is None else injection.switch
    before = np.concatenate([position[..., :1], position[..., :-1]], -1)
    fits = np.all(attacked[..., None, :] == np.asarray(modes.active), -1)
    fits &= position[..., None] == np.asarray(modes.position)
    fits &= ~(elsewhere | (position != before))[..., None]
    return np.where(np.any(fits, -1), np.argmax(fits, -1), -1).astype(np.int32)


def true_attack(trace: Trace, plant: Named) -> np.ndarray | None:
    """What the attack estimate should have been, row by row; None unless simulated.

    The injection at k into sensors (y), actuators (u) and channels (d) equals the channel
    values e with H e = H d + y and G e = G d + B u, where such e exist; NaN elsewhere. In row
    k a channel whose axis lies in the row space of H is given at k, every other at k-1.
    """
    if trace.injection is None or trace.x is None or not trace.estimate.d.shape[-1]:
        return None
    lead = trace.x.shape[:-1]
    flat = [np.asarray(a).reshape(-1, a.shape[-1]) for a in (
        trace.x, trace.observation.u, trace.injection.u, trace.injection.y, trace.injection.d
    )]  # fmt: skip
    rows = np.tile(np.arange(1, lead[-1] + 1, dtype=np.int32), len(flat[0]) // lead[-1])
    found, at_output = _rows_as_channels(plant, rows, *flat)
    found = np.asarray(found).reshape(*lead, -1)
    before = np.concatenate([np.zeros_like(found[..., :1, :]), found[..., :-1, :]], axis=-2)
    truth = np.where(np.asarray(at_output).reshape(found.shape), found, before)
    if trace.delay == 0:
        return truth
    early = np.full_like(truth[..., : trace.delay, :], np.nan)
    return np.concatenate([early, truth[..., : -trace.delay, :]], axis=-2)


@eqx.filter_jit
def _rows_as_channels(plant: Named, *rows):
    # row by row: batches of LAPACK calls can lock one another out
    return jax.lax.map(lambda row: _as_channels(plant, *row), rows)


def _as_channels(plant: Named, k, x, u, extra_u, extra_y, d):
    none = jnp.zeros_like(d)
    H = jax.jacfwd(lambda e: plant.output(k, x, u, e))(none)
    G = jax.jacfwd(lambda e: plant.transition(k, x, u, e))(none)
    B = jax.jacfwd(lambda e: plant.transition(k, x, e, none))(u)
    D = jax.jacfwd(lambda e: plant.output(k, x, e, none))(u)
    effect = jnp.concatenate([extra_y + D @ extra_u, B @ extra_u])
    map_ = jnp.concatenate([H, G])
    pseudo = jnp.linalg.pinv(map_)
    extra = pseudo @ effect
    exact = jnp.linalg.norm(map_ @ extra - effect) <= 1e-9 * (1e-300 + jnp.linalg.norm(effect))
    projector = jnp.linalg.pinv(H) @ H
    at_output = jnp.linalg.norm(projector - jnp.eye(len(d)), axis=0) < 1e-9
    return jnp.where(exact, d + extra, jnp.nan), at_output
