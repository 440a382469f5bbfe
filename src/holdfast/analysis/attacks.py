"""Which attacks the outputs identify, after how many steps, and which sensor would help."""

from typing import NamedTuple

import numpy as np

from holdfast.analysis.model import Model
from holdfast.analysis.zeros import Transfer, transfer
from holdfast.numerics.subspaces import TOLERANCE, kernel, left_free, scaled, silent, span


class Sensor(NamedTuple):
    """One more sensor that measures ``state`` alone, and the delay that it brings."""

    state: str
    delay: int


class Channel(NamedTuple):
    """One attack channel.

    ``direct``: its axis lies in the row space of H, so it is given at k - delay, any other
    channel at k - 1 - delay. ``delay``: the smallest with which the samples up to k
    determine it; None if none does, and ``reason`` says why. ``sensors``: states that,
    measured, make it earlier (or possible), soonest first.
    """

    name: str
    direct: bool
    delay: int | None
    reason: str | None
    sensors: tuple[Sensor, ...]


class Identifiability(NamedTuple):
    """``delay``: the smallest with which every channel that can be is identified.

    ``shields``: states that, measured, leave no unstable zero, where there is one.
    """

    channels: tuple[Channel, ...]
    delay: int
    transfer: Transfer
    shields: tuple[str, ...]


def identifiability(model: Model) -> Identifiability:
    """For every channel the smallest delay at which it is determined, every attack free.

    x_0 is known and d has no prior. What the samples up to k leave free of (x_k, d_k) is
    carried as `holdfast.estimators.unknown_input` carries it; of that, what L more samples
    do not reveal stays free with delay L. More than n delays never help.

    Source: Sain and Massey (1969), inverses with delay, with the past attacks free as well.
    """
    found = transfer(model)
    delays, direct = _delays(model, known_start=False)
    late = any(delay != 0 for delay in delays)
    n = len(model.states)
    measured = [model.measuring(i) for i in range(n)]
    helped = [_delays(more, known_start=False)[0] for more in measured] if late else []
    from_known = _delays(model, known_start=True)[0] if None in delays else delays
    channels = []
    for i, name in enumerate(model.attacks):
        delay = delays[i]
        reason = None if delay is not None else _reason(model, found, from_known[i])
        sensors = _sensors(model.states, delay, [delays[i] for delays in helped])
        channels.append(Channel(name, direct[i], delay, reason, sensors))
    shields: tuple[str, ...] = ()
    if any(zero.unstable for zero in found.zeros):
        kept = [not any(zero.unstable for zero in transfer(more).zeros) for more in measured]
        shields = tuple(name for name, safe in zip(model.states, kept, strict=True) if safe)
    needed = max((delay for delay in delays if delay is not None), default=0)
    return Identifiability(tuple(channels), needed, found, shields)


def undetermined_steps(models: list[Model]) -> dict[str, int]:
    """At how many steps each channel is not determined by its own row (delay 0).

    For plants whose matrices change from step to step; the first row, whose attack came
    before it, counts like any other.
    """
    names = models[0].attacks if models else ()
    counts = dict.fromkeys(names, 0)
    if not names:
        return counts
    typical = [np.mean([np.abs(model[i]) for model in models], 0) for i in range(4)]
    units = scaled(*typical)
    n, nd = models[0].G.shape
    free = np.vstack([np.zeros((n, nd)), np.eye(nd)])
    for model in models:
        A = model.A * units.x / units.x[:, None]
        G = model.G * units.d / units.x[:, None]
        sense = np.hstack(
            [model.C * units.x / units.y[:, None], model.H * units.d / units.y[:, None]]
        )
        z = np.vstack([A @ free[:n] + G @ free[n:], np.zeros((nd, free.shape[1])), free[n:]])
        z = np.hstack([z, np.vstack([np.zeros((n, nd)), np.eye(nd), np.zeros((nd, nd))])])
        left = z @ kernel(sense @ z[: n + nd])
        direct = _direct(model.H)
        for i, name in enumerate(names):
            row = n + i if direct[i] else n + nd + i
            counts[name] += bool(np.linalg.norm(left[row]) > TOLERANCE)
        free = span(left[: n + nd])
    return counts


def _delays(model: Model, *, known_start: bool) -> tuple[list[int | None], list[bool]]:
    """The smallest delay of every channel, and which are direct."""
    s = scaled(model.A, model.G, model.C, model.H)
    n, nd = s.G.shape
    told, move = silent(s), np.hstack([s.A, s.G])
    # the attack before the first row is as free as any other
    late = left_free(s, np.zeros((n, 0)) if known_start else span(s.G, s.size))
    direct = _direct(s.H)
    found: list[int | None] = [None] * nd
    for delay in range(len(told)):
        later = [told[min(delay + (not d), len(told) - 1)] for d in direct]
        for i in range(nd):
            if found[i] is None and not any(_free(F, move, later[i], n + i, s.size) for F in late):
                found[i] = delay
    return found, direct


def _free(F: np.ndarray, move: np.ndarray, told: np.ndarray, row: int, size: float) -> bool:
    """Whether entry ``row`` of (x_k, d_k) is free still, once later samples have told."""
    left = F @ kernel(told.T @ move @ F, size)
    return bool(np.linalg.norm(left[row]) > TOLERANCE)


def _direct(H: np.ndarray) -> list[bool]:
    """Which channels' axes lie in the row space of H."""
    norms = np.linalg.norm(H, axis=0)
    unseen = kernel(H / np.where(norms > 0, norms, 1.0))
    return [bool(np.linalg.norm(row) <= TOLERANCE) for row in unseen]


def _sensors(states: tuple[str, ...], delay: int | None, helped: list[int | None]):
    better = [
        Sensor(name, new)
        for name, new in zip(states, helped, strict=False)
        if new is not None and (delay is None or new < delay)
    ]
    return tuple(sorted(better, key=lambda sensor: sensor.delay))


def _reason(model: Model, found: Transfer, from_known: int | None) -> str:
    if from_known is not None:
        return (
            "nothing tells what the attack before the first row did to the state, and the "
            "outputs left over do not find out"
        )
    count = len(model.attacks)
    ways = f"{found.rank} independent way{'s' if found.rank != 1 else ''}"
    sensors = f"{len(model.outputs)} output{'s' * (len(model.outputs) != 1)}"
    return f"{count} attack channel{'s' * (count != 1)} reach {sensors} in only {ways}"
