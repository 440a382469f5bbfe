"""A drone over a plane under a GPS spoof, small enough for tests, rich enough for a report."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from holdfast.detectors import chi_square, per_channel
from holdfast.estimators import kalman, unknown_input
from holdfast.loop import Monitor, Scenario, replay, simulate
from holdfast.parts import Attack
from holdfast.plants.build import linear_plant
from holdfast.records import Estimate, Injection, Observation, Trace, Verdict

DT = 0.1
START, STOP = 30.0, 50.0


class Spoof(Attack):
    """``slope`` (t - start) on the first sensor, up to ``most``."""

    slope: Float[Array, ""]
    most: Float[Array, ""]

    def init(self, key, known):
        return ()

    def step(self, state, known):
        t = known.k.astype(float) * DT
        active = (t >= START - 1e-9) & (t < STOP - 1e-9)
        size = jnp.where(active, jnp.minimum(self.slope * (t - START + DT), self.most), 0.0)
        return state, Injection(
            jnp.zeros_like(known.u), jnp.zeros_like(known.y).at[0].set(size), jnp.zeros(2)
        )


def drone():
    block = np.array([[1.0, DT], [0.0, 1.0]])
    push = np.array([[DT**2 / 2], [DT]])
    zero = np.zeros_like(push)
    two, turn = np.eye(2), [0, 2, 1, 3]  # outputs: positions first, then velocities
    return linear_plant(
        A=np.kron(two, block), B=np.block([[push, zero], [zero, push]]),
        C=np.eye(4)[turn], H=np.eye(4)[:, :2], G=np.zeros((4, 2)),
        Q=np.kron(two, 0.04 * push @ push.T + 1e-9 * np.eye(2)),
        R=np.diag([0.8**2, 0.8**2, 0.05**2, 0.05**2]),
        dt=DT, states=["north", "v_north", "east", "v_east"],
        inputs=["a_north", "a_east"],
        outputs=["gps_north", "gps_east", "doppler_north", "doppler_east"],
        attacks=["spoof_north", "spoof_east"],
    )  # fmt: skip


UNITS = {
    "north": "m", "east": "m", "v_north": "m/s", "v_east": "m/s", "a_north": "m/s²",
    "a_east": "m/s²", "gps_north": "m", "gps_east": "m", "doppler_north": "m/s",
    "doppler_east": "m/s", "spoof_north": "m", "spoof_east": "m",
}  # fmt: skip

PRIOR = (np.array([0.0, 4.0, 0.0, 3.0]), np.diag([1e-4, 1e-4, 1e-4, 1e-4]))


def monitor(plant, on="attack"):
    """With attack channels estimated and named, or with residuals alone."""
    if on == "attack":
        detector = per_channel.build(plant, on="attack", level=1e-4)
        return Monitor(unknown_input.build(plant, *PRIOR), detector)
    return Monitor(kalman.build(plant, *PRIOR), chi_square.build(plant, level=1e-4))


def blank(plant, steps, attacks):
    """A trace of zeros; ``attacks``: as many entries in the attack estimate."""
    n, nu, ny, m = len(plant.states), len(plant.inputs), len(plant.outputs), attacks
    z = lambda *shape: jnp.zeros((steps, *shape))  # noqa: E731
    code = jnp.zeros(steps, jnp.int32)
    return Trace(
        Observation.of(z(nu), z(ny)),
        Estimate(
            z(n), z(n, n), z(m), z(m, m), z(m), z(m, m), z(0, m), z(0), z(ny), z(ny, ny), code
        ),
        Verdict(z(), z() + 1.0, z() > 0, code, z(0) > 0),
        z(n),
        Injection(z(nu), z(ny), z(len(plant.attacks))),
    )


def run(plant, watch, *, slope=1.5, steps=600, seed=0):
    """One simulated flight, the rows of every tenth of a second."""
    scenario = Scenario(
        plant, jnp.asarray(PRIOR[0]), watch, None,
        (Spoof(jnp.asarray(slope), jnp.asarray(12.0)),),
    )  # fmt: skip
    return simulate(scenario, jax.random.key(seed), steps)


def replayed(plant, watch, trace, *, missing=(), faulty=()):
    """The same log with samples (row, output) taken away or made NaN, without truth."""
    y, seen = np.array(trace.observation.y), np.array(trace.observation.seen)
    for row, output in missing:
        seen[row, output] = False
    for row, output in faulty:
        y[row, output] = np.nan
    return replay(watch, Observation.of(trace.observation.u, y, seen))


def time_of(trace):
    return DT * np.arange(1, trace.verdict.alarm.shape[-1] + 1)
