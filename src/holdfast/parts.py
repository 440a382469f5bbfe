"""The abstract parts. A part is a frozen `equinox.Module`: settings plus pure functions.

A class is abstract (here) or final (everywhere else), with nothing between.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from holdfast.numerics.linalg import dot, psd_factor
from holdfast.records import Estimate, Injection, Knowledge, Observation, Verdict


class InvalidValue(ValueError):
    """A setting that a part cannot accept: which one, what was found, what was expected."""

    def __init__(self, key: str, found: Any, expected: str):
        super().__init__(f"{key}: found {found}, expected {expected}")
        self.key, self.found, self.expected = key, found, expected


class Plant(eqx.Module):
    """x_k = f(k, x_{k-1}, u_k, d_{k-1}) + w,  y_k = h(k, x_k, u_k, d_k) + v.

    The step number k is an argument because plants may vary in time.
    """

    dt: eqx.AbstractVar[float]
    states: eqx.AbstractVar[tuple[str, ...]]
    inputs: eqx.AbstractVar[tuple[str, ...]]
    outputs: eqx.AbstractVar[tuple[str, ...]]
    attacks: eqx.AbstractVar[tuple[str, ...]]

    @abstractmethod
    def transition(self, k, x, u, d) -> Float[Array, " n"]:
        """The state at k without process noise, from the state at k-1."""

    @abstractmethod
    def output(self, k, x, u, d) -> Float[Array, " ny"]:
        """The measurement at k without noise."""

    def jacobian(self, k, x, u, d) -> tuple[Float[Array, "n n"], Float[Array, "n nd"]]:
        """The derivatives of `transition` by x and d; a plant that knows its zeros does better."""
        return jax.jacfwd(lambda x, d: self.transition(k, x, u, d), argnums=(0, 1))(x, d)

    @abstractmethod
    def noise(self, k, x, u) -> tuple[Float[Array, "n n"], Float[Array, "ny ny"]]:
        """The covariances of process and measurement noise at k."""

    def advance(self, key: PRNGKeyArray, k, x, u, d) -> Float[Array, " n"]:
        """The state at k, process noise included; it stops at the limits of physics."""
        Q, _ = self.noise(k, x, u)
        noise = dot(psd_factor(Q), jax.random.normal(key, (len(self.states),)))
        return self.confined(k, u, self.transition(k, x, u, d) + noise)

    def confined(self, k, u, x) -> Float[Array, " n"]:
        """The state that is possible at k and nearest to x; any is where there are no limits."""
        return x

    def saturated(self, k, u, d) -> Float[Array, " nd"]:
        """The attack over the interval that ends at k that is possible and nearest to d."""
        return d

    @property
    def positions(self) -> tuple[str, ...]:
        """The names of the positions that the plant's switches can be in; the first is normal."""
        return ("normal",)

    def at_position(self, position: Int[Array, ""]) -> "Plant":
        """The plant with its switches in one of the `positions`, by number."""
        return self

    def jumped(
        self, x: Float[Array, " n"], position: Int[Array, ""], asked: Int[Array, ""]
    ) -> tuple[Float[Array, " n"], Int[Array, ""]]:
        """State and position just after a sample at which the switches are asked to be at
        ``asked``: (x, j)+ = Omega(x, j) where the state lies in a jump set.
        """
        return x, asked

    def innovation(
        self, y: Float[Array, " ny"], expected: Float[Array, " ny"]
    ) -> Float[Array, " ny"]:
        """How far y is from what was expected; angles go the shorter way round."""
        return y - expected

    def measure(self, key: PRNGKeyArray, k, x, u, d) -> Float[Array, " ny"]:
        """The measurement at k, noise included."""
        _, R = self.noise(k, x, u)
        return self.output(k, x, u, d) + dot(
            psd_factor(R), jax.random.normal(key, (len(self.outputs),))
        )


class Controller(eqx.Module):
    """u_{k+1} = command(estimate at k)."""

    @abstractmethod
    def command(self, estimate: Estimate) -> Float[Array, " nu"]:
        """The input to apply over the next sample."""


class Attack(eqx.Module):
    """A falsification of sensors, actuators or attack channels, one injection per sample."""

    @abstractmethod
    def init(self, key: PRNGKeyArray, known: Knowledge) -> Any:
        """The attacker's state before the first sample; ``known`` gives the shapes."""

    @abstractmethod
    def step(self, state: Any, known: Knowledge) -> tuple[Any, Injection]:
        """What is injected into the sample that ``known`` describes."""


class Estimator(eqx.Module):
    """State and attack from observations."""

    plant: eqx.AbstractVar[Plant]

    @abstractmethod
    def init(self) -> tuple[Any, Estimate]:
        """The state before the first row, and what it says."""

    @abstractmethod
    def step(self, state: Any, observation: Observation) -> tuple[Any, Estimate]:
        """One row: predict with its input, correct with its (screened) measurement."""


class Detector(eqx.Module):
    """A verdict from the record of every step."""

    @abstractmethod
    def init(self) -> Any:
        """The state before the first row."""

    @abstractmethod
    def step(self, state: Any, estimate: Estimate) -> tuple[Any, Verdict]:
        """The verdict on one row."""


def no_attack(plant: Plant) -> Float[Array, " nd"]:
    """The value of the attack channels when nobody attacks."""
    return jnp.zeros(len(plant.attacks))


def step_zero() -> Int[Array, ""]:
    """The number of the step before the first row."""
    return jnp.asarray(0, jnp.int32)
