"""The only place where time passes: one step, one run, one simulation.

`monitor_step` joins estimate and detect. `replay` scans it over a log, `simulate` over a
plant under attack, `holdfast.shell.live.Live` calls it sample by sample; all three give the
same numbers.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from holdfast.parts import Attack, Controller, Detector, Estimator, Plant
from holdfast.records import (
    Enforcement,
    Estimate,
    Held,
    Injection,
    Knowledge,
    Observation,
    Status,
    Trace,
    Verdict,
    screen,
)


class Monitor(eqx.Module):
    """What watches a plant: an estimator and the detector that judges its estimates."""

    estimator: Estimator
    detector: Detector

    def init(self) -> Any:
        """The state before the first row."""
        return self.estimator.init()[0], self.detector.init()


class Scenario(eqx.Module):
    """A plant that starts at ``x0``, whoever steers it, attacks it and watches it.

    ``enforcement``: which outputs are authenticated when; None for never.
    """

    plant: Plant
    x0: Float[Array, " n"]
    monitor: Monitor
    controller: Controller | None = None
    attacks: tuple[Attack, ...] = ()
    enforcement: Enforcement | None = None


def monitor_step(
    monitor: Monitor, state: Any, observation: Observation
) -> tuple[Any, tuple[Estimate, Verdict]]:
    """One row: estimate, then judge. The observation has been screened.

    An estimator whose numbers leave the finite range keeps its last finite ones and says
    DIVERGED, so that a stream goes on and no NaN leaves the core.
    """
    before, judged = state
    after, estimate = monitor.estimator.step(before, observation)
    watched = eqx.filter(after, _watched, is_leaf=_is_held)
    leaves = jax.tree.leaves(watched)
    ok = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))
    # leaf by leaf, so that a covariance shared over a batch stays shared
    after = jax.tree.map(_finite_or, after, before, is_leaf=_is_held)
    n = estimate.x.shape[0]
    unknown = jnp.diag(jnp.full(n, jnp.inf))
    estimate = eqx.tree_at(
        lambda e: (e.x, e.x_cov, e.d, e.d_free, e.residual, e.residual_cov, e.status),
        estimate,
        (
            _finite_or_zero(estimate.x),
            jnp.where(jnp.any(jnp.isnan(estimate.x_cov)), unknown, estimate.x_cov),
            _finite_or_zero(estimate.d),
            _finite_or_zero(estimate.d_free),
            _finite_or_zero(estimate.residual),
            _finite_or_zero(estimate.residual_cov),
            estimate.status | jnp.where(ok, 0, int(Status.DIVERGED)),
        ),
    )
    if estimate.a is not None:
        estimate = eqx.tree_at(lambda e: e.a, estimate, replace_fn=_finite_or_zero)
    if estimate.p is not None:
        estimate = eqx.tree_at(lambda e: e.p, estimate, replace_fn=_finite_or_zero)
    judged, verdict = monitor.detector.step(judged, estimate)
    return (after, judged), (estimate, verdict)


def _is_held(leaf):
    return isinstance(leaf, Held)


def _watched(leaf):
    return not _is_held(leaf) and eqx.is_inexact_array(leaf)


def _finite_or(new, old):
    if not _watched(new):
        return new
    return jnp.where(jnp.all(jnp.isfinite(new)), new, old)


def _finite_or_zero(values):
    return jnp.where(jnp.isfinite(values), values, 0.0)


@eqx.filter_jit
def replay(monitor: Monitor, observations: Observation) -> Trace:
    """Estimates and verdicts over a recorded log (time along the leading axis)."""

    def row(carry, observation):
        state, u_before = carry
        clean = screen(observation, u_before)
        state, outcome = monitor_step(monitor, state, clean)
        return (state, clean.u), (clean, *outcome)

    start = (monitor.init(), jnp.zeros(observations.u.shape[-1]))
    _, rows = jax.lax.scan(row, start, observations)
    return Trace(*rows, **_told(monitor))


@eqx.filter_jit
def simulate(scenario: Scenario, key: PRNGKeyArray, steps: int) -> Trace:
    """Plant, attack, controller and monitor together for ``steps`` samples.

    At row k: the plant moves under u_k with the attack injected at k-1, the attacker sees the
    clean sample of k and injects into it, the monitor sees the result. ``Trace.injection`` of
    row k is what was injected at k, ``Trace.x`` the true state at k. Where the plant has
    limits the state stops at them, and an attack that asks for more than they allow saturates.
    Where an attacker throws a switch at k-1, the state moves to k, and where he does at k, y_k
    is measured, with the plant in that position; a jump of the state comes before y_k.

    An output that is authenticated at k (``Scenario.enforcement``) arrives as the sensor sent it:
    C x + D u + H 0 + v. Neither an injection into it nor an attack channel that falsifies it
    through H gets there, as every estimator takes it of a trusted sample, and the trace holds 0
    for them: for ``injection.y``, and for a channel that reaches nothing else at k. What an
    attack does to actuators and to the state is physics, which no signature stops: u (its D
    part included) and G d act as ever. The attacker is not told.
    """
    plant, monitor = scenario.plant, scenario.monitor
    attack_key, run_key = jax.random.split(key)
    zero_u, zero_d = jnp.zeros(len(plant.inputs)), jnp.zeros(len(plant.attacks))
    known = Knowledge(
        jnp.asarray(0, jnp.int32), zero_u, plant.output(0, scenario.x0, zero_u, zero_d)
    )
    attack_states = tuple(
        attack.init(k, known)
        for attack, k in zip(
            scenario.attacks, jax.random.split(attack_key, len(scenario.attacks) + 1), strict=False
        )
    )
    attack_states, injected = _inject(scenario.attacks, attack_states, known, zero_d)
    estimator_state, estimate = monitor.estimator.init()
    state = (estimator_state, monitor.detector.init())

    def command(estimate):
        return zero_u if scenario.controller is None else scenario.controller.command(estimate)

    def row(carry, inputs):
        x, position, state, attack_states, injected, u = carry
        k, key = inputs
        move_key, measure_key = jax.random.split(key)
        plant = scenario.plant.at_position(position)
        x = plant.advance(move_key, k, x, u + injected.u, injected.d)
        clean = plant.measure(measure_key, k, x, u, zero_d)
        attack_states, injected = _inject(
            scenario.attacks, attack_states, Knowledge(k, u, clean), zero_d
        )
        x, position, injected = _switched(plant, x, position, injected)
        plant = scenario.plant.at_position(position)
        y = plant.measure(measure_key, k, x, u + injected.u, injected.d)
        everything = jnp.ones(y.shape, bool)
        trusted = ~everything
        if scenario.enforcement is not None:
            trusted = scenario.enforcement.at(k)
            sent = plant.measure(measure_key, k, x, u + injected.u, zero_d)
            y = jnp.where(trusted, sent, y)
            injected = _let_through(plant, k, x, u, injected, trusted)
        y = y + injected.y
        observation = Observation(u, y, everything, trusted, jnp.asarray(0, jnp.int32))
        state, (estimate, verdict) = monitor_step(monitor, state, observation)
        u = command(estimate)
        injected = _saturated(plant, k + 1, u, injected)
        rows = Trace(observation, estimate, verdict, x, injected, **_told(monitor))
        return (x, position, state, attack_states, injected, u), rows

    u = command(estimate)
    x, position, injected = _switched(plant, scenario.x0, jnp.asarray(0, jnp.int32), injected)
    carry = (x, position, state, attack_states, _saturated(plant, 1, u, injected), u)
    inputs = (jnp.arange(1, steps + 1, dtype=jnp.int32), jax.random.split(run_key, steps))
    return jax.lax.scan(row, carry, inputs)[1]


def _saturated(plant: Plant, k, u, injected: Injection) -> Injection:
    """What of an injection the limits of the plant let through over the interval up to k."""
    return eqx.tree_at(lambda i: i.d, injected, plant.saturated(k, u, injected.d))


def _let_through(plant: Plant, k, x, u, injected: Injection, trusted) -> Injection:
    """What of an injection at k is left where the ``trusted`` outputs arrive as they were sent."""
    through_y = jnp.where(trusted, 0.0, injected.y)
    d = injected.d
    if d.shape[0]:
        falsified = jax.jacfwd(lambda e: plant.output(k, x, u, e))(d) != 0
        moved = jax.jacfwd(lambda e: plant.transition(k + 1, x, u, e))(d) != 0
        stopped = jnp.any(falsified & trusted[:, None], 0)
        felt = jnp.any(falsified & ~trusted[:, None], 0) | jnp.any(moved, 0)
        d = jnp.where(stopped & ~felt, 0.0, d)
    return Injection(injected.u, through_y, d, injected.switch)


def _switched(plant: Plant, x, position, injected: Injection):
    """State and position after whoever throws a switch, the position noted in the injection."""
    if len(plant.positions) == 1:
        return x, position, injected
    asked = position * 0 if injected.switch is None else injected.switch
    x, position = plant.jumped(x, position, asked)
    return (
        x,
        position,
        eqx.tree_at(lambda i: i.switch, injected, position, is_leaf=lambda leaf: leaf is None),
    )


def _told(monitor: Monitor) -> dict[str, Any]:
    """What goes with a trace: rows by which the attack estimate lags, and the names of modes."""
    settings = ("delay", "modes", "named")
    found = {name: getattr(monitor.estimator, name, None) for name in settings}
    return {name: value for name, value in found.items() if value is not None}


def _inject(
    attacks: tuple[Attack, ...], states: tuple, known: Knowledge, zero_d: Array
) -> tuple[tuple, Injection]:
    u, y, d, switch = jnp.zeros_like(known.u), jnp.zeros_like(known.y), zero_d, None
    after = []
    for attack, state in zip(attacks, states, strict=True):
        state, injection = attack.step(state, known)
        after.append(state)
        u, y, d = u + injection.u, y + injection.y, d + injection.d
        if injection.switch is not None:  # the last one to throw it has it
            before = injection.switch * 0 if switch is None else switch
            switch = jnp.where(injection.switch != 0, injection.switch, before)
    return tuple(after), Injection(u, y, d, switch)
