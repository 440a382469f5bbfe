"""An analysis in sentences: what is missing, and what would help."""

import numpy as np

from holdfast.analysis.attackable_advice import on_attackable
from holdfast.analysis.attacks import Channel
from holdfast.analysis.decoding_advice import on_decoding
from holdfast.analysis.fusion import CERTAIN, Fusion
from holdfast.analysis.whole import Analysis
from holdfast.analysis.wording import between, combination, either, joined, listed, steps
from holdfast.analysis.zeros import Zero


def advice(
    found: Analysis,
    delay: int | None,
    fusion: bool = False,
    decoding: bool = False,
    stealth: bool = False,
) -> list[str]:
    """The sentences, most basic first; ``delay`` is the estimator's, None where it has none.

    ``fusion``: whether to say what the fusion of local estimates withstands; ``decoding``:
    what the decoders of a window correct; ``stealth``: how far a stealthy attacker of sensors
    moves the Kalman filter.
    """
    said = [f"This holds for {found.model.note}."] if found.model.note else []
    said += _on_state(found)
    for channel in found.attacks.channels:
        said += _on_channel(channel)
    said += _on_what_hides(found)
    said += _on_delay(found, delay)
    said += _on_bounds(found)
    said += _on_window(found)
    if fusion:
        said += _on_fusion(found.fusion)
    if decoding:
        said += on_decoding(found.decoding, found.model.states)
    if stealth:
        said += on_attackable(found.attackable, found.model.states)
    return said


def _on_state(found: Analysis) -> list[str]:
    said = []
    if not found.observability.observable:
        hidden = [combination(v, found.model.states) for v in found.observability.hidden.T]
        text = f"The outputs do not determine the state: {listed(hidden)} reaches none of them"
        sensors = found.observability.sensors
        said.append(f"{text}; measure {either(sensors)} and they do." if sensors else f"{text}.")
    if found.steady.reason is not None:
        said.append(f"There is no steady-state Kalman filter: {found.steady.reason}.")
    return said


def _on_channel(channel: Channel) -> list[str]:
    name, delay = channel.name, channel.delay
    if delay == 0:
        return []
    best = [s.state for s in channel.sensors if s.delay == channel.sensors[0].delay]
    if delay is None:
        text, link = f"{name} is never identified: {channel.reason}", ";"
    else:
        text = f"{name} reaches the outputs only after {steps(delay)}: set delay = {delay}"
        link = ", or"
    if not best:
        return [f"{text}."]
    soonest = channel.sensors[0].delay
    when = f"after {steps(soonest)}" if soonest else "at once"
    return [f"{text}{link} measure {either(best)} and it is identified {when}."]


def _on_what_hides(found: Analysis) -> list[str]:
    attacks, names = found.attacks, found.model.attacks
    said = [
        f"An attack along {combination(v, names)}, followed up by the others, moves no "
        "output at all, at any size and for ever."
        for v in attacks.transfer.lost.T
    ]
    unstable = [zero for zero in attacks.transfer.zeros if zero.unstable]
    # a pair of conjugate zeros is one way to hide
    for zero in (zero for zero in unstable if zero.z.imag >= 0):
        said += _on_zero(zero, found)
    if attacks.shields and any(np.any(zero.attack) for zero in unstable):
        said.append(f"Measure {either(attacks.shields)} and nothing that lasts can hide like that.")
    return said


def _on_zero(zero: Zero, found: Analysis) -> list[str]:
    z = f"{zero.z.real:.4g}" if zero.z.imag == 0 else f"{zero.z:.4g}"
    used = np.max(np.abs(zero.attack), axis=0, initial=0.0) > 0
    states = [combination(v, found.model.states) for v in zero.state[:, ~used].T]
    channels = [combination(v, found.model.attacks) for v in zero.attack[:, used].T]
    said = []
    if states:
        said.append(f"Without any attack, {joined(states, 'or')} can move by the mode {z} unseen.")
    if channels:
        said.append(
            f"An attack on {joined(channels, 'or')} that goes like ({z})^k hides behind an "
            "initial state that is not known exactly (invariant zero): it is identified "
            "without bias, but its error does not fade."
        )
    return said


def _on_delay(found: Analysis, delay: int | None) -> list[str]:
    needed = found.attacks.delay
    if delay is None or delay >= needed:
        return []
    return [f"The estimator's delay is {delay}: set it to {needed}."]


def _on_bounds(found: Analysis) -> list[str]:
    if not found.bounds:
        return []
    last = found.bounds[-1]
    possible = [channel.name for channel in found.attacks.channels if channel.delay is not None]
    grown = [name for name in possible if last.attack[name] is False]
    unsure = [name for name in possible if last.attack[name] is None]
    said = []
    if grown:
        said.append(
            f"With delay = {last.delay} the variance of the estimate of {listed(grown)} grows "
            f"without limit: it still did after {last.steps} steps."
        )
    if unsure:
        said.append(
            f"With delay = {last.delay} the variance of the estimate of {listed(unsure)} had "
            f"not settled after {last.steps} steps."
        )
    return said


def _on_window(found: Analysis) -> list[str]:
    window = found.window
    if window is None:
        return []
    rows = f"the first {window.rows} determine" if window.rows else "all together do not determine"
    said = [f"Of the {steps(window.steps)} looked at, {rows} the state."]
    for name, count in window.undetermined.items():
        if count:
            said.append(f"{name} is not determined by its own row at {count} of {window.steps}.")
    return said


def _on_fusion(found: Fusion) -> list[str]:
    if found.reason is not None:
        return [f"What the LASSO fusion withstands cannot be said: {found.reason}."]
    said = _on_liars(found)
    if found.withstood:
        who = "one sensor" if found.withstood == 1 else f"{found.withstood} sensors at once"
        at = found.withstood - 1
        worst = between(float(found.lower_sets[at]), float(found.upper_sets[at]))
        said.append(
            f"The LASSO fusion withstands any {who} of the {len(found.sensors)}: the worst "
            f"ratio is {worst}, under 1."
        )
    else:
        said += _on_remedies(found)
    if found.ill_conditioned:
        said.append(
            "The coordinates in which the LASSO fusion counts are ill-conditioned here "
            f'({found.condition:.1g}): norm = "group" does not need them.'
        )
    return said


def _on_liars(found: Fusion) -> list[str]:
    lower, upper = found.lower.tolist(), found.upper.tolist()
    order = sorted(range(len(upper)), key=lambda i: -upper[i])
    shown = {i: f'"{found.sensors[i]}" (ratio {between(lower[i], upper[i])})' for i in order}
    heavy = [shown[i] for i in order if lower[i] >= CERTAIN]
    unsure = [shown[i] for i in order if lower[i] < CERTAIN <= upper[i]]
    said = []
    if heavy:
        said.append(
            f"Under the LASSO fusion this plant cannot afford a lie of {joined(heavy, 'or')}: "
            "from a ratio of 1 a sensor can outweigh all others and be believed, however far "
            "it lies."
        )
    if unsure:
        said.append(f"Whether the LASSO fusion bounds a lie of {listed(unsure)} is not known.")
    return said


def _on_remedies(found: Fusion) -> list[str]:
    said = []
    for remedies, text in (
        (found.authenticate, "Authenticate {} and the LASSO fusion withstands any other sensor"),
        (found.add, "Measure {} as well and the LASSO fusion withstands any one sensor"),
    ):
        names = [f'"{r.name}" (ratio {between(r.lower, r.upper)})' for r in remedies if r.enough]
        if names:
            said.append(f"{text.format(joined(names, 'or'))}.")
    if not said and found.untried:
        said.append("What would mend that was too dear to try.")
    elif not said:
        said.append("No single sensor, authenticated or added, mends that.")
    return said
