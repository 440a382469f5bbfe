"""Scores of one simulated run as a few numbers, compiled with the simulation itself.

Sums and counts rather than rates, so that those of many runs add up exactly. Rows are benign
before the attack begins, or all of them where there is none, and attacked from the first row
with an injection to the last; what comes after is neither.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from holdfast.controllers.feedback import Feedback
from holdfast.loop import Scenario
from holdfast.numerics.linalg import mahalanobis
from holdfast.parts import Plant
from holdfast.plants.linear import LinearPlant
from holdfast.records import Injection, Status, Trace

BINS = 302
"""Bins of statistic / threshold: 300 from 1e-3 to 1e3, 50 in a decade, and what is outside."""
COUNTED = ("UNOBSERVABLE", "NOT_CONVERGED", "DIVERGED")
"""Statuses whose share of rows is a score."""


class AsChannels(NamedTuple):
    """Which values of the attack channels equal an injection: d + of_y y + of_u u.

    ``fits`` maps [y + D u, B u] to what no such value explains, ``spans`` back. ``at_output``:
    channels that a row gives at once. For a linear plant with constant matrices.
    """

    of_effect: Float[Array, "nd ny+n"]
    effect_of_u: Float[Array, "ny+n nu"]
    rest: Float[Array, "ny+n ny+n"]
    at_output: Bool[Array, " nd"]


def as_channels(plant: Plant) -> AsChannels | None:
    """The map of a plant; None where it is not the same at every row."""
    if not isinstance(plant, LinearPlant) or not plant.constant or not plant.attacks:
        return None
    n, nu = len(plant.states), len(plant.inputs)
    m = plant.at(1, jnp.zeros(n), jnp.zeros(nu))
    G, H, B, D = (np.asarray(v) for v in (m.G, m.H, m.B, m.D))
    both = np.vstack([H, G])
    pseudo = np.linalg.pinv(both)
    projector = np.linalg.pinv(H) @ H
    at_output = np.linalg.norm(projector - np.eye(H.shape[1]), axis=0) < 1e-9
    rest = both @ pseudo - np.eye(len(both))
    pseudo, effect, rest, at = map(jnp.asarray, (pseudo, np.vstack([D, B]), rest, at_output))
    return AsChannels(pseudo, effect, rest, at)


def true_attack(maps: AsChannels | None, injection: Injection, delay: int) -> Float[Array, "t nd"]:
    """What the attack estimate should have been at every row of a run; NaN where that is
    nothing that the channels can say, or, for a plant whose matrices move, where sensors or
    actuators were hit by name.
    """
    ny, n_u = injection.y.shape[1], injection.u.shape[1]
    elsewhere = jnp.any(injection.y != 0, 1) | jnp.any(injection.u != 0, 1)
    if maps is None:
        d = jnp.where(elsewhere[:, None], jnp.nan, injection.d)
        return _later(d, delay)
    n = maps.rest.shape[0] - ny
    effect = injection.u @ maps.effect_of_u.T if n_u else jnp.zeros((len(injection.d), ny + n))
    effect = effect.at[:, :ny].add(injection.y)
    size = jnp.linalg.norm(effect, axis=1)
    exact = jnp.linalg.norm(effect @ maps.rest.T, axis=1) <= 1e-9 * (1e-300 + size)
    found = jnp.where(exact[:, None], injection.d + effect @ maps.of_effect.T, jnp.nan)
    before = jnp.concatenate([jnp.zeros_like(found[:1]), found[:-1]])
    return _later(jnp.where(maps.at_output, found, before), delay)


def _later(values: Float[Array, "t nd"], rows: int) -> Float[Array, "t nd"]:
    if rows == 0:
        return values
    early = jnp.full_like(values[:rows], jnp.nan)
    return jnp.concatenate([early, values[:-rows]])


class Rows(NamedTuple):
    """Which rows of a run are benign, attacked, and tested by the detector.

    A row in which a bank believes in no attack has passed its test, as calibration counts it.
    """

    benign: Bool[Array, " t"]
    attacked: Bool[Array, " t"]
    tested: Bool[Array, " t"]


def rows_of(trace: Trace) -> Rows:
    """The rows of a simulated run."""
    injection = trace.injection
    assert injection is not None
    hit = jnp.any(injection.u != 0, 1) | jnp.any(injection.y != 0, 1)
    hit = hit | jnp.any(injection.d != 0, 1)
    if injection.switch is not None:
        hit = hit | (injection.switch != 0)
    began = jnp.cumsum(hit.astype(jnp.int32)) > 0
    to_come = jnp.cumsum(hit[::-1].astype(jnp.int32))[::-1] > 0
    tested = jnp.isfinite(trace.verdict.threshold) | (trace.estimate.mode is not None)
    return Rows(~began, began & to_come, tested)


def run_scores(scenario: Scenario, trace: Trace, maps: AsChannels | None) -> dict[str, Any]:
    """Every score of a run by name, as described in `holdfast.campaign.aggregate`."""
    plant, estimate, verdict = scenario.plant, trace.estimate, trace.verdict
    assert trace.x is not None
    assert trace.injection is not None
    rows = rows_of(trace)
    alarm = verdict.alarm
    first = jnp.argmax(rows.attacked)
    caught = alarm & rows.attacked
    delay = jnp.where(
        jnp.any(caught), (jnp.argmax(caught) - first).astype(float) * plant.dt, jnp.inf
    )
    error = estimate.x - trace.x
    found = {
        "detection_delay": jnp.where(jnp.any(rows.attacked), delay, jnp.nan),
        "false_alarms": _count(alarm & rows.benign & rows.tested),
        "benign_rows": _count(rows.benign & rows.tested),
        "missed": _count(rows.attacked & ~(alarm & rows.tested)),
        "attacked_rows": _count(rows.attacked),
        "rows": jnp.asarray(float(len(alarm))),
    }
    found |= _errors("state", error, estimate.x_cov)
    found |= _squares("nees", error, estimate.x_cov, rows.benign)
    found |= _squares("nis", estimate.residual, estimate.residual_cov, rows.benign)
    truth = true_attack(maps, trace.injection, trace.delay)
    if estimate.d.shape[1]:
        found |= _errors("attack", estimate.d - truth, estimate.d_cov)
    found |= _localised(scenario, trace, truth, rows)
    found |= _modes(scenario, trace, truth)
    found |= _control(scenario, trace)
    for name in COUNTED:
        found[name.lower()] = _count((estimate.status & int(Status[name])) != 0)
    return found


def _count(mask: Bool[Array, "..."]) -> Float[Array, ""]:
    return jnp.sum(mask.astype(float))


def _errors(kind: str, error: Float[Array, "t m"], cov) -> dict[str, Array]:
    """Root mean square and largest error of every channel where it is determined."""
    used = jnp.isfinite(jnp.diagonal(cov, axis1=1, axis2=2)) & jnp.isfinite(error)
    sizes = jnp.where(used, jnp.abs(error), 0.0)
    count = jnp.sum(used.astype(float), 0)
    known = count > 0
    mean = jnp.sum(sizes * sizes, 0) / jnp.where(known, count, 1.0)
    return {
        f"{kind}_rmse": jnp.where(known, jnp.sqrt(mean), jnp.nan),
        f"{kind}_worst": jnp.where(known, jnp.max(sizes, 0), jnp.nan),
    }


def _squares(name: str, values, covs, used: Bool[Array, " t"]) -> dict[str, Array]:
    """Normalised squares over the benign rows, and their degrees of freedom."""
    squares, degrees = jax.vmap(mahalanobis)(values, covs)
    return {
        name: jnp.sum(jnp.where(used, squares, 0.0)),
        f"{name}_degrees": jnp.sum(jnp.where(used, degrees, 0).astype(float)),
    }


def _localised(scenario: Scenario, trace: Trace, truth, rows: Rows) -> dict[str, Array]:
    """Channels that the detector named in attacked rows, those of them hit, and all hit."""
    flags = trace.verdict.channel_alarms
    if not flags.shape[1]:
        return {}
    on = getattr(scenario.monitor.detector, "on", "residual")
    hit = (truth != 0) & jnp.isfinite(truth) if on == "attack" else _falsified(scenario, trace)
    if hit.shape != flags.shape:
        return {}
    named, hit = flags & rows.attacked[:, None], hit & rows.attacked[:, None]
    return {"named": _count(named), "named_hit": _count(named & hit), "hit": _count(hit)}


def _falsified(scenario: Scenario, trace: Trace) -> Bool[Array, "t ny"]:
    """Outputs that an injection changed."""
    injection, plant = trace.injection, scenario.plant
    assert injection is not None
    steps = jnp.arange(1, len(injection.y) + 1, dtype=jnp.int32)

    def changed(k, x, u, i: Injection):
        none = jnp.zeros_like(i.d)
        sent = plant.output(k, x, u, none)
        return plant.output(k, x, u + i.u, i.d) + i.y - sent != 0

    return jax.vmap(changed)(steps, trace.x, trace.observation.u, injection)


def _modes(scenario: Scenario, trace: Trace, truth) -> dict[str, Array]:
    """Rows with a mode that is true, and those in which it was believed."""
    estimator, believed = scenario.monitor.estimator, trace.estimate.mode
    sets = getattr(estimator, "hypotheses", None) or getattr(estimator, "sets", None)
    if believed is None or sets is None:
        return {}
    injection = trace.injection
    assert injection is not None
    none = jnp.zeros(len(truth), jnp.int32)
    position = none if injection.switch is None else injection.switch
    before = jnp.concatenate([position[:1], position[:-1]])
    fits = jnp.all((truth != 0)[:, None] == sets.active, -1)
    fits = fits & (position[:, None] == sets.position) & (position == before)[:, None]
    fits = fits & jnp.all(jnp.isfinite(truth), 1)[:, None]
    known = jnp.any(fits, 1)
    right = known & (jnp.argmax(fits, 1).astype(jnp.int32) == believed)
    return {"mode_right": _count(right), "mode_rows": _count(known)}


def _control(scenario: Scenario, trace: Trace) -> dict[str, Array]:
    """The cost of the control, where the controller has weights (LQR): over the rows, the mean of

        (x_k - r)' Qx (x_k - r) + (u_k - s)' Ru (u_k - s)

    in the units of the weights, with the true state x_k, the reference r, the input s that holds
    it, and u_k as commanded for k-1..k: ``trace.observation.u``, to which
    `holdfast.loop.simulate` adds ``injection.u`` only inside the plant. What an attacker does to
    the actuators is no effort of the controller; it costs by what it does to the state. Infinite
    where the state has left the finite numbers.
    """
    controller = scenario.controller
    if not isinstance(controller, Feedback) or controller.weights is None:
        return {}
    assert trace.x is not None
    off, u = trace.x - controller.reference, trace.observation.u - controller.steady
    Qx, Ru = controller.weights
    cost = jnp.mean(jnp.sum(off @ Qx * off, 1) + jnp.sum(u @ Ru * u, 1))
    return {"control_cost": jnp.where(jnp.isnan(cost), jnp.inf, cost)}


def margins(trace: Trace) -> tuple[Int[Array, " bins"], Int[Array, " bins"]]:
    """How often statistic / threshold lies in each bin, in benign and in attacked rows."""
    rows, verdict = rows_of(trace), trace.verdict
    known = jnp.isfinite(verdict.statistic) & (verdict.threshold > 0)
    ratio = jnp.where(known, verdict.statistic / jnp.where(known, verdict.threshold, 1.0), 0.0)
    tested = rows.tested & (known | ~jnp.isfinite(verdict.threshold))
    place = jnp.floor(50.0 * (jnp.log10(jnp.maximum(ratio, 1e-300)) + 3.0)) + 1.0
    place = jnp.clip(place, 0, BINS - 1).astype(jnp.int32)
    empty = jnp.zeros(BINS, jnp.int32)
    benign, attacked = (
        empty.at[place].add((tested & some).astype(jnp.int32))
        for some in (rows.benign, rows.attacked)
    )
    return benign, attacked


def bin_edges() -> np.ndarray:
    """Lower edges of the bins, as multiples of the threshold."""
    return np.concatenate([[0.0], 10.0 ** (np.arange(BINS - 1) / 50.0 - 3.0)])
