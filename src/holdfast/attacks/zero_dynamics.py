"""An attack along an invariant zero: it moves the state and, but for its beginning, no output."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from holdfast.attacks.channels import resolve
from holdfast.attacks.effect import effect
from holdfast.attacks.settings import first_step, number
from holdfast.attacks.window import Window, windowed
from holdfast.numerics.zeros import driven, transfer
from holdfast.parts import Attack, InvalidValue, Plant
from holdfast.records import Injection, Knowledge

LARGEST = 1e100
"""Factor at which the attack of an unstable zero stops growing: numbers stay finite."""


class ZeroDynamics(Attack):
    """size Re(z^j g), j = k - first, z = ``modulus`` e^(i ``angle``), g = ``real`` + i ``imag``."""

    size: Float[Array, ""]
    modulus: Float[Array, ""]
    angle: Float[Array, ""]
    real: Float[Array, " nz"]
    imag: Float[Array, " nz"]
    first: Int[Array, ""]

    def init(self, key: PRNGKeyArray, known: Knowledge) -> tuple:
        """Nothing to remember."""
        return ()

    def step(self, state: tuple, known: Knowledge) -> tuple[tuple, Injection]:
        """The signal of this step; that of the start before it."""
        j = jnp.maximum(known.k - self.first, 0).astype(float)
        grown = jnp.minimum(jnp.power(self.modulus, j), LARGEST)
        turned = jnp.cos(self.angle * j) * self.real - jnp.sin(self.angle * j) * self.imag
        added = self.size * grown * turned
        nu, ny = known.u.shape[0], known.y.shape[0]
        return state, Injection(added[:nu], added[nu : nu + ny], added[nu + ny :])


def build(
    plant: Plant,
    *,
    size: float,
    channel: str | None = None,
    channels: list[str] | None = None,
    start: float = 0.0,
    stop: float = math.inf,
) -> Window:
    """a_k = size Re(z^j g) on the channels hit, j = k - k_0 steps after ``start``, up to ``stop``.

    z is the invariant zero of largest modulus from the channels hit (actuators, attack channels
    and sensors alike) to the outputs that an attack has to keep up, g its attack and x_0 its state:

        (A - zI) x_0 + [B, G, 0] g = 0,   C x_0 + [D, H, I] g = 0   (columns of the channels hit)

    g is scaled so that its largest entry is 1: ``size`` is the largest entry injected at the
    start, in the units of that channel.

    Were the state off by size Re(x_0) at the start, no output would move. It is not, so state and
    outputs move by

        size Re(z^j x_0) - A^j size Re(x_0)   and   -C A^j size Re(x_0):

    the samples are those of a plant without attack whose state at the start differs by
    -size Re(x_0), which an estimator forgets as it forgets its own start, while the truth is off
    by size Re(z^j x_0). With |z| > 1 a small ``size`` shows little and grows without limit (it
    stops at 1e100 times ``size``); with |z| < 1 the attack fades. Once it stops, what it has
    done to the state shows.

    Raises `InvalidValue` for a plant that is not linear and constant, channels from which
    nothing can hide, an unknown channel, or a setting out of range.

    Source: Teixeira, Pérez, Sandberg and Johansson, Attack models and scenarios for networked
    control systems (2012): reference [35] of INTEGRITY.
    """
    matrices = effect(plant, "zero_dynamics")
    hit = np.asarray(resolve(plant, channel, channels).hit)
    entering = matrices.A, matrices.G[:, hit], matrices.C, matrices.H[:, hit]
    found = driven(*entering)
    if found is None:
        raise InvalidValue("channel" if channels is None else "channels", *_without_zero(entering))
    z, _, attack = found
    g = np.zeros(len(hit), complex)
    g[hit] = attack / attack[np.argmax(np.abs(attack))]
    signal = ZeroDynamics(
        size=number("size", size),
        modulus=jnp.asarray(abs(z)),
        angle=jnp.asarray(np.angle(z)),
        real=jnp.asarray(np.real(g)),
        imag=jnp.asarray(np.imag(g)),
        first=jnp.asarray(first_step(plant, start), jnp.int32),
    )
    return windowed(plant, signal, start, stop)


def _without_zero(entering: tuple[np.ndarray, ...]) -> tuple[str, str]:
    """Why there is no zero to go along, and what to do about it."""
    if transfer(*entering).lost.shape[1]:
        return (
            "channels without an invariant zero, so many that a push hides whatever its signal",
            "fewer channels to hit, or covert in the place of zero_dynamics",
        )
    return (
        "channels without an invariant zero: the outputs show whatever is done to them",
        "more channels to hit, sensors among them (covert hides any push)",
    )
