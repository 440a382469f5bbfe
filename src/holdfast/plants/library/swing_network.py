"""A power network of generator and load buses: the swing equation on any topology.

    theta_i' = f_i + w1_i,
    f_i'     = -(D_i f_i + sum over lines t_il sin(theta_i - theta_l)
                 - (P_M,i + d_a,i) + P_L,i) / m_i + w2_i,

theta (rad), f (rad/s), powers per unit. An input "power:BUS" is P_M at a generator bus; at a
load bus, where P_M = 0, it is what the demand is lowered by: P_L = demand - u there, and
P_L = demand at a generator bus. Measured at every bus: P_elec = P_L + D f, which is a second
copy of f because P_L is known, theta, and f.

Source: NISME (1), (2), Section 7; errata 10, 11.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from holdfast.numerics.linalg import repeat
from holdfast.parts import Plant
from holdfast.plants.nonlinear import sampled

MEASURED = ("P_elec", "theta", "f")
"""What is measured at each bus, in this order."""


class SwingNetwork(Plant):
    """The swing equation sampled by Runge-Kutta, inputs, attack and noise held over a sample.

    n buses, l lines. ``ends``: where each line begins and ends, by place in ``buses``;
    ``incidence``: +1 where it begins and -1 where it ends. ``closed``: 1
    for each line that is closed in a position of the switches, else 0; ``position``: the
    position now. ``load``: 1 at a load bus, else 0. ``actuators``, ``sensors``: which input and
    output each attack channel adds to; an actuator's acts on the dynamics alone. ``switched``:
    the names of the positions. ``deviation``:
    of w over a sample (the state's) and of v.
    """

    ends: Int[Array, "2 l"]
    incidence: Float[Array, "n l"]
    strength: Float[Array, " l"]
    closed: Float[Array, "positions l"]
    position: Int[Array, ""]
    inertia: Float[Array, " n"]
    damping: Float[Array, " n"]
    demand: Float[Array, " n"]
    load: Float[Array, " n"]
    actuators: Float[Array, "n nd"]
    sensors: Float[Array, "ny nd"]
    deviation: tuple[Float[Array, " nx"], Float[Array, " ny"]]
    buses: tuple[int, ...] = eqx.field(static=True)
    switched: tuple[str, ...] = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    attacks: tuple[str, ...] = eqx.field(static=True)

    @property
    def positions(self) -> tuple[str, ...]:
        """The names of the positions; "normal" is the first."""
        return self.switched

    def at_position(self, position: Int[Array, ""]) -> "SwingNetwork":
        """The network with its switches in one of the `positions`, by number."""
        return dataclasses.replace(self, position=position)

    @property
    def coupling(self) -> Float[Array, " l"]:
        """The strength of every line, 0 where it is open."""
        return self.strength * self.closed[self.position]

    def flow(self, theta: Float[Array, " n"]) -> Float[Array, " n"]:
        """The power that leaves each bus over its lines."""
        return self.incidence @ (self.coupling * jnp.sin(theta @ self.incidence))

    def stiffness(self, x) -> Float[Array, "n n"]:
        """What the rate of f falls by with theta: the Laplacian over the inertia."""
        first, last = self.ends
        t = self.coupling * jnp.cos(x[first] - x[last])
        # entry by entry: six times faster than two products with the incidence matrix
        rows = jnp.concatenate([first, last, first, last])
        columns = jnp.concatenate([first, last, last, first])
        values = jnp.concatenate([t, t, -t, -t]) / self.inertia[rows]
        return jnp.zeros((len(self.buses), len(self.buses))).at[rows, columns].add(values)

    def rate(self, x, u, d) -> Float[Array, " nx"]:
        """The time derivative of the state without noise."""
        theta, f = jnp.split(x, 2)
        surplus = u - self.demand + self.actuators @ d
        return jnp.concatenate([f, (surplus - self.damping * f - self.flow(theta)) / self.inertia])

    def transition(self, k, x, u, d) -> Float[Array, " nx"]:
        """The state a sample later."""
        return sampled(self.rate, self.dt, self.substeps)(x, u, d)

    def output(self, k, x, u, d) -> Float[Array, " ny"]:
        """P_elec, theta and f of the first bus, of the second, and so on."""
        theta, f = jnp.split(x, 2)
        power = self.demand - self.load * u + self.damping * f
        return jnp.stack([power, theta, f], 1).reshape(-1) + self.sensors @ d

    def noise(self, k, x, u) -> tuple[Float[Array, "nx nx"], Float[Array, "ny ny"]]:
        """dt^2 times the covariance of w, and that of v."""
        of_w, of_v = self.deviation
        return jnp.diag(of_w**2), jnp.diag(of_v**2)

    def advance(self, key: PRNGKeyArray, k, x, u, d) -> Float[Array, " nx"]:
        """The state at k, noise included: a diagonal covariance needs no factorisation."""
        deviation, _ = self.deviation
        return self.transition(k, x, u, d) + deviation * jax.random.normal(key, deviation.shape)

    def measure(self, key: PRNGKeyArray, k, x, u, d) -> Float[Array, " ny"]:
        """The measurement at k, noise included."""
        _, deviation = self.deviation
        return self.output(k, x, u, d) + deviation * jax.random.normal(key, deviation.shape)

    def jacobian(self, k, x, u, d) -> tuple[Float[Array, "nx nx"], Float[Array, "nx nd"]]:
        """The derivatives of `transition` by x and d, from the structure of the network."""

        def further(_, carry):
            x, A, G = carry
            x, A_step, G_step = self._step(x, u, d)
            return x, A_step @ A, A_step @ G + G_step

        _, A, G = repeat(self.substeps - 1, further, self._step(x, u, d))
        return A, G

    def _step(self, x, u, d):
        """One step of Runge-Kutta and its derivatives by x and d.

        Runge-Kutta commutes with differentiation, so its stages are those of the variational
        equation T' = F, F' = [0, 0, B] - S T - c F, started at [T; F] = [[I, 0, 0], [0, I, 0]]
        (the rows of theta and f; columns for theta, f and d): S = L / m with the Laplacian L of
        the couplings t cos(theta_i - theta_l), c = D / m, B = the actuators / m. S is all that
        a stage has to multiply by, and in the first two T still consists of identities.
        """
        h, n = self.dt / self.substeps, len(self.buses)
        half, nd = 0.5 * h, len(self.attacks)
        k1 = self.rate(x, u, d)
        k2 = self.rate(x + half * k1, u, d)
        k3 = self.rate(x + half * k2, u, d)
        k4 = self.rate(x + h * k3, u, d)
        c = (self.damping / self.inertia)[:, None]
        nothing, none = jnp.zeros((n, n)), jnp.zeros((n, nd))
        T = jnp.concatenate([jnp.eye(n), nothing, none], 1)
        F = jnp.concatenate([nothing, jnp.eye(n), none], 1)
        forced = jnp.concatenate([nothing, nothing, self.actuators / self.inertia[:, None]], 1)
        S = self.stiffness(x)
        V1 = forced - jnp.concatenate([S, nothing, none], 1) - c * F
        F2 = F + half * V1
        S = self.stiffness(x + half * k1)
        V2 = forced - jnp.concatenate([S, half * S, none], 1) - c * F2
        F3 = F + half * V2
        V3 = forced - self.stiffness(x + half * k2) @ (T + half * F2) - c * F3
        F4 = F + h * V3
        V4 = forced - self.stiffness(x + h * k3) @ (T + h * F3) - c * F4
        moved = jnp.concatenate(
            [
                T + h / 6.0 * (F + 2.0 * F2 + 2.0 * F3 + F4),
                F + h / 6.0 * (V1 + 2.0 * V2 + 2.0 * V3 + V4),
            ]
        )
        after = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return after, moved[:, : 2 * n], moved[:, 2 * n :]
