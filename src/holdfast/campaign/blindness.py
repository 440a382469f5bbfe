"""What a monitor cannot see: the smallest constant attack it finds, channel by channel.

Found by simulation with the same noise for every size, confirmed with fresh noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from holdfast.attacks.bias import Bias
from holdfast.attacks.channels import Channels, resolve
from holdfast.attacks.window import Window
from holdfast.campaign.attack_free import horizon, over_runs, start_state
from holdfast.loop import Monitor, Scenario, simulate
from holdfast.parts import Controller, InvalidValue

TARGETS = (0.5, 0.95)
SETTLE = 50
"""Attack-free rows before the attack starts, so that the estimator has settled."""
LARGEST = 30.0
HALVINGS = 14
"""Sizes from 2^-30 to 2^30 in the channel's own unit, halved 14 times: known to 0.3 %."""


@dataclass(frozen=True)
class Found:
    """The smallest constant attack found with probability ``target``, and how that held.

    ``size`` is None where there is none: alarms without attack reach the target by
    themselves, or no size up to 1e9 does. ``probability`` +- ``standard_error`` is what
    fresh noise gave at ``size``.
    """

    target: float
    size: float | None
    probability: float | None
    standard_error: float | None


@dataclass(frozen=True)
class Blindness:
    """What the monitor finds on one channel within ``steps`` rows of an attack's start.

    ``false_alarm`` +- ``false_alarm_error`` is the probability of an alarm in as many rows
    without attack.
    """

    channel: str
    steps: int
    found: tuple[Found, ...]
    false_alarm: float
    false_alarm_error: float
    runs: int
    seed: int
    sentence: str


def blindness(
    monitor: Monitor,
    *,
    steps: int = 50,
    runs: int = 1000,
    seed: int = 0,
    channels: Sequence[str] | None = None,
    controller: Controller | None = None,
) -> list[Blindness]:
    """The smallest constant attacks found with 50 % and 95 % probability within ``steps``.

    ``channels``: "sensor:NAME", "actuator:NAME" or "channel:NAME"; every sensor and attack
    channel if left out. The attack starts after 50 rows without. Calibrate the monitor first.

    Raises `InvalidValue` where an unstable plant cannot be simulated for so long.
    """
    plant = monitor.estimator.plant
    if steps < 1 or runs < 2:
        raise InvalidValue("steps, runs", f"{steps}, {runs}", "at least 1 and 2")
    most = horizon(plant, controller)
    if most is not None and steps > most:
        raise InvalidValue(
            "steps", steps, f"at most {most}: the plant's matrices end, or its state runs away"
        )
    settle = SETTLE if most is None else min(SETTLE, most - steps)
    if channels is None:
        channels = [f"channel:{name}" for name in plant.attacks]
        channels += [f"sensor:{name}" for name in plant.outputs]
    masks = [resolve(plant, name, None) for name in channels]
    if not masks:
        return []
    # one lane per channel and target
    lanes = jax.tree.map(lambda *m: jnp.stack(m), *[mask for mask in masks for _ in TARGETS])
    wanted = np.tile(TARGETS, len(masks))
    search, fresh, idle = (
        jax.random.split(key, runs) for key in jax.random.split(jax.random.key(seed), 3)
    )

    def share(keys: Key[Array, " runs"], sizes: np.ndarray) -> np.ndarray:
        traced = jnp.asarray(sizes)
        hits = over_runs(
            lambda some: _alarmed(monitor, controller, lanes, traced, some, settle, steps), keys
        )
        return np.mean(hits, 0)

    low, high = np.full(len(wanted), -LARGEST), np.full(len(wanted), LARGEST)
    visible = share(search, 2.0**high) >= wanted
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        enough = share(search, 2.0**middle) >= wanted
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    sizes = 2.0**high
    confirmed = share(fresh, sizes)
    without = float(share(idle, np.zeros(len(wanted)))[0])
    results = []
    for i, name in enumerate(channels):
        found = tuple(
            _found(wanted[j], sizes[j], confirmed[j], bool(visible[j]), without, runs)
            for j in range(i * len(TARGETS), (i + 1) * len(TARGETS))
        )
        error = float(np.sqrt(without * (1.0 - without) / runs))
        sentence = _sentence(name, found, without, steps)
        results.append(Blindness(name, steps, found, without, error, runs, seed, sentence))
    return results


@eqx.filter_jit
def _alarmed(
    monitor: Monitor,
    controller: Controller | None,
    lanes: Channels,
    sizes: Float[Array, " m"],
    keys: Key[Array, " runs"],
    settle: int,
    steps: int,
) -> Array:
    """Whether an alarm came within ``steps`` rows of the start: (run, lane)."""
    plant = monitor.estimator.plant
    first, last = (jnp.asarray(k, jnp.int32) for k in (settle + 1, settle + steps + 1))

    def lane(attacked):
        channels, size = attacked
        attack = Window(Bias(channels, size), first, last)

        def run(key):
            start_key, run_key = jax.random.split(key)
            x0 = start_state(monitor.estimator, start_key)
            scenario = Scenario(plant, x0, monitor, controller, (attack,))
            trace = simulate(scenario, run_key, settle + steps)
            return jnp.any(trace.verdict.alarm[settle:])

        return jax.vmap(run)(keys)

    # lane by lane: runs and lanes side by side would not fit the cache
    return jax.lax.map(lane, (lanes, sizes)).T


def _found(
    target: float, size: float, share: float, visible: bool, without: float, runs: int
) -> Found:
    if without >= target or not visible:
        return Found(float(target), None, None, None)
    error = np.sqrt(share * (1.0 - share) / runs)
    return Found(float(target), float(size), float(share), float(error))


def _sentence(channel: str, found: tuple[Found, ...], without: float, steps: int) -> str:
    even, best = found
    kind, name = channel.split(":", 1)
    what = f"a shift of {name}" if kind == "sensor" else f"a constant {name}"
    within = f"{best.target:.0%} within {steps} steps".replace("%", " %")
    if best.size is not None:
        half = f"; {even.target:.0%} at {even.size:.3g}".replace("%", " %") if even.size else ""
        return f"This gate cannot see {what} under {best.size:.3g} ({within}{half})."
    if without >= best.target:
        return (
            f"Nothing can be said of {what}: without any attack an alarm comes within {steps} "
            f"steps with probability {without:.2g}."
        )
    return f"This gate cannot see {what} of any size ({within})."
