"""Data between the layers: what an estimator is given, what it says, what a detector says.

Time convention, kept everywhere: row k holds the input ``u`` applied over k-1..k and the
measurement ``y`` at k; predict with ``u``, then correct with ``y``.
"""

import functools
from enum import IntEnum, IntFlag
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

if TYPE_CHECKING:
    Array = jax.Array
else:
    # within the core a JAX array; at the boundary (logs, live samples) NumPy serves as well
    Array = jax.Array | np.ndarray


class Status(IntFlag):
    """What happened at a step. The core reports by these bits; it never raises on data."""

    OK = 0
    MISSING = 1
    BAD_INPUT = 2
    UNOBSERVABLE = 4
    AMBIGUOUS = 8
    INFEASIBLE = 16
    HIDDEN_INPUT = 32
    NOT_READY = 64
    NOT_CONVERGED = 128
    DIVERGED = 256

    @property
    def words(self) -> str:
        """The names of the bits that are set, joined by ``+``; ``OK`` if none."""
        return "+".join(str(bit.name) for bit in type(self) if bit and bit in self) or "OK"


class Reason(IntEnum):
    """Why a detector raised its alarm, as a code."""

    NONE = 0
    ATTACK = 1
    RESIDUAL = 2
    ATTACK_WINDOW = 3
    RESIDUAL_WINDOW = 4
    ATTACK_SUM = 5
    RESIDUAL_SUM = 6
    ATTACK_SEQUENCE = 7
    RESIDUAL_SEQUENCE = 8
    ATTACK_CHANNEL = 9
    RESIDUAL_CHANNEL = 10
    IMPOSSIBLE = 11
    ATTACK_HELD_SUM = 12
    FORGED = 13

    @property
    def words(self) -> str:
        """The code in words, as a report prints it."""
        return _REASON_WORDS[self]


_REASON_WORDS = {
    Reason.NONE: "",
    Reason.ATTACK: "attack estimate differs from zero",
    Reason.RESIDUAL: "measurements contradict the model",
    Reason.ATTACK_WINDOW: "attack estimate differs from zero over the window",
    Reason.RESIDUAL_WINDOW: "measurements contradict the model over the window",
    Reason.ATTACK_SUM: "attack estimates have added up",
    Reason.RESIDUAL_SUM: "residuals have added up",
    Reason.ATTACK_SEQUENCE: "attack is likelier than no attack (Wald's test)",
    Reason.RESIDUAL_SEQUENCE: "shifted measurements are likelier than sound ones (Wald's test)",
    Reason.ATTACK_CHANNEL: "attack on",
    Reason.RESIDUAL_CHANNEL: "measurement contradicts the model at",
    Reason.IMPOSSIBLE: "no attack within the limits explains what is measured",
    Reason.ATTACK_HELD_SUM: "projected attack estimates have added up",
    Reason.FORGED: "a message that had to be authenticated was not",
}


@functools.lru_cache(maxsize=16)
def _same(shape: tuple[int, ...], value: bool) -> np.ndarray:
    """A constant array, shared by all samples and so read-only."""
    array = np.full(shape, value)
    array.flags.writeable = False
    return array


class Observation(eqx.Module):
    """What an estimator is given at step k.

    ``u`` is the commanded input over k-1..k, ``y`` the measurement at k, ``seen`` False where
    the sample did not arrive, ``trusted`` True where it was authenticated at k and so cannot
    have been attacked. A NaN in ``y`` is a fault, never a gap; `screen` turns both into an
    unused entry (``y`` 0, ``seen`` False) and says in ``status`` which it was.
    """

    u: Float[Array, "*t nu"]
    y: Float[Array, "*t ny"]
    seen: Bool[Array, "*t ny"]
    trusted: Bool[Array, "*t ny"]
    status: Int[Array, "*t"]

    @classmethod
    def of(cls, u, y, seen=None, trusted=None) -> "Observation":
        """A sample (or, with a leading time axis, a log) as NumPy arrays, ready for `push`.

        Left out: ``seen`` means that all has arrived, ``trusted`` that nothing is authenticated.
        """
        y = np.asarray(y, float)
        seen = _same(y.shape, True) if seen is None else np.asarray(seen, bool)
        trusted = _same(y.shape, False) if trusted is None else np.asarray(trusted, bool)
        status = np.zeros(y.shape[:-1], np.int32)
        fields = {"u": np.asarray(u, float), "y": y, "seen": seen, "trusted": trusted}
        record = object.__new__(cls)  # the constructor's checks cost more than a filter's step
        object.__setattr__(record, "__dict__", fields | {"status": status})
        return record


def screen(observation: Observation, u_before: Float[Array, " nu"]) -> Observation:
    """Mark gaps and faults of one sample, so that nothing after it meets a NaN.

    An entry of ``u`` that is not finite holds its value in ``u_before``; an entry of ``y``
    that is not finite is not used. Every estimator, simulated, replayed or live, is given
    screened observations.
    """
    usable = observation.seen & jnp.isfinite(observation.y)
    fault = jnp.any(observation.seen & ~usable) | jnp.any(~jnp.isfinite(observation.u))
    gap = jnp.any(~observation.seen)
    status = (
        observation.status
        | jnp.where(fault, int(Status.BAD_INPUT), 0)
        | jnp.where(gap, int(Status.MISSING), 0)
    )
    return Observation(
        u=jnp.where(jnp.isfinite(observation.u), observation.u, u_before),
        y=jnp.where(usable, observation.y, 0.0),
        seen=usable,
        trusted=observation.trusted & usable,
        status=status.astype(jnp.int32),
    )


class Enforcement(eqx.Module):
    """Which outputs are authenticated when: at the steps k >= first with (k - first) mod every
    < duration, for each output its own; never where ``duration`` is 0.
    """

    every: Int[Array, " ny"]
    duration: Int[Array, " ny"]
    first: Int[Array, " ny"]

    @classmethod
    def of(cls, every, duration, first) -> "Enforcement":
        """From one whole number per output each, or one for all of a list's length."""
        found = np.broadcast_arrays(*(np.asarray(v, np.int32) for v in (every, duration, first)))
        rows: list[Any] = [np.array(v) for v in found]
        return cls(*rows)

    def at(self, k: Int[Array, "*t"]) -> Bool[Array, "*t ny"]:
        """Whether each output is authenticated at step ``k`` (or at each of several)."""
        since = jnp.asarray(k, jnp.int32)[..., None] - self.first
        return (since >= 0) & (jnp.mod(since, jnp.maximum(self.every, 1)) < self.duration)

    @property
    def share(self) -> np.ndarray:
        """The share of each output's messages that is authenticated in the long run."""
        every = np.maximum(np.asarray(self.every), 1)
        return np.minimum(np.asarray(self.duration) / every, 1.0)


class Estimate(eqx.Module):
    """What every estimator says at step k.

    ``x``, ``x_cov``: state at k and its error covariance. ``d``, ``d_cov``: attack, one entry
    per attack channel of the plant; ``d_free``, ``d_free_cov``: the same before any
    projection, which is what a sound test needs. ``d_rows``, ``d_bound``: the attack's
    constraint set ``d_rows d <= d_bound`` at this step. ``residual``, ``residual_cov``: the
    innovation; an unknown-input filter's is blind to the attack by construction. ``a``: what
    each sensor's sample is off by, 0 where it is believed; ``p``: the probability of each of
    the modes that are weighed, and ``mode``: the one believed, by its number in
    ``Trace.named``; each from estimators that say so.

    Conventions of the covariances: a diagonal of ``inf`` marks a quantity that the data do
    not determine (its covariances are 0, and an attack's value too), a diagonal of 0 in
    ``residual_cov`` an output that carried no information at this step.
    """

    x: Float[Array, "*t n"]
    x_cov: Float[Array, "*t n n"]
    d: Float[Array, "*t nd"]
    d_cov: Float[Array, "*t nd nd"]
    d_free: Float[Array, "*t nd"]
    d_free_cov: Float[Array, "*t nd nd"]
    d_rows: Float[Array, "*t m nd"]
    d_bound: Float[Array, "*t m"]
    residual: Float[Array, "*t ny"]
    residual_cov: Float[Array, "*t ny ny"]
    status: Int[Array, "*t"]
    a: Float[Array, "*t ny"] | None = None
    p: Float[Array, "*t modes"] | None = None
    mode: Int[Array, "*t"] | None = None

    @classmethod
    def without_attack(cls, x, x_cov, residual, residual_cov, status, a=None) -> "Estimate":
        """The record of an estimator that estimates no attack on the plant's channels."""
        none = jnp.zeros((0,))
        square = jnp.zeros((0, 0))
        return cls(
            x, x_cov, none, square, none, square, square, none, residual, residual_cov,
            jnp.asarray(status, jnp.int32), a,
        )  # fmt: skip


class Verdict(eqx.Module):
    """What a detector says at step k.

    A ``threshold`` of ``inf`` means that there was nothing to test at this step.
    ``channel_alarms`` has one entry per channel where the detector localises, none elsewhere.
    """

    statistic: Float[Array, "*t"]
    threshold: Float[Array, "*t"]
    alarm: Bool[Array, "*t"]
    reason: Int[Array, "*t"]
    channel_alarms: Bool[Array, "*t m"]


class Held(eqx.Module):
    """A part of an estimator's state that it keeps finite itself, replaced seldom and large.

    `holdfast.loop.monitor_step` looks through everything else at every step.
    """

    value: Any


class Knowledge(eqx.Module):
    """What an attacker knows at step k: the step, the command and the sample before attack."""

    k: Int[Array, ""]
    u: Float[Array, " nu"]
    y: Float[Array, " ny"]


class Injection(eqx.Module):
    """What an attacker adds at step k: to the actuators, the sensors, the attack channels.

    ``switch``: the position of the plant's switches, by number; None where nobody throws one.
    """

    u: Float[Array, "*t nu"]
    y: Float[Array, "*t ny"]
    d: Float[Array, "*t nd"]
    switch: Int[Array, "*t"] | None = None


class Trace(eqx.Module):
    """A whole run, time along the leading axis; ``x`` and ``injection`` only if simulated.

    ``delay``: rows by which the attack estimate lags what it would otherwise be of. ``modes``,
    ``named``: the names that go with ``estimate.p`` and ``estimate.mode``.
    """

    observation: Observation
    estimate: Estimate
    verdict: Verdict
    x: Float[Array, "*t n"] | None = None
    injection: Injection | None = None
    delay: int = eqx.field(static=True, default=0)
    modes: tuple[str, ...] = eqx.field(static=True, default=())
    named: tuple[str, ...] = eqx.field(static=True, default=())
