"""Whether a filter can take a set of channels as attacked together, and if not, why.

A mode assumes that the attack d is free on a set of channels and zero elsewhere. It is
*admissible* if l + 1 samples determine the state at the last of them, whatever it was at the first
and whatever the attack did: if the kernel of the batch problem (x_c and d_c, .., d_{c+l} free) has
x_{c+l} = 0; and if G d = 0, H d = 0 for d = 0 alone, so that two such states determine the attack
between them. Then the filter of the mode forgets its start, and the covariances of its estimates
are bounded. More channels mean more unknowns and the same data: every subset of an admissible set
is admissible, which is what the search rests on.

The paper asks that (C_3, Abar) be uniformly observable. That implies the above, and asks for more:
the state at the *first* sample, without the rows z_2 of that sample. Of x_{k+1} = a x_k + d_k,
y = x + v there is no row z_3 at all, so the paper refuses the attack on d; yet y_k gives x_k to
within v. With (C_3, Abar) over l + 1 samples, O its unobservable states,

    the paper's     O = 0
    ours            Abar^l x = 0 for all x of O that the rows z_2 of the first sample do not see

and no hidden input in either. Nor is the paper's monotone, where a channel enters both the state
and an output (tests/analysis/test_modes.py has the counterexamples).

Source: NISME, Section 6.1 and Lemma 5.1.
"""

import numpy as np

from holdfast.analysis.model import Model
from holdfast.numerics.subspaces import (
    TOLERANCE,
    Scaled,
    complement,
    kernel,
    left_free,
    next_free,
    scaled,
    silent,
    span,
)

DEPENDENT = "some of these channels together do nothing, or the same as the others"
HIDDEN = "an attack on them moves the state unseen by the next sample"
UNOBSERVED = "the samples then do not determine the state"


def units(models: list[Model]) -> list[Scaled]:
    """C and H of each sample with A and G of the step that follows, in common units.

    Of the last sample of a window the step that follows is not known, and not used.
    """
    typical = [np.mean([np.abs(model[i]) for model in models], 0) for i in range(4)]
    unit = scaled(*(models[0][:4] if len(models) == 1 else typical))
    following = [*models[1:], models[-1]]
    return [
        unit._replace(
            A=after.A * unit.x / unit.x[:, None],
            G=after.G * unit.d / unit.x[:, None],
            C=model.C * unit.x / unit.y[:, None],
            H=model.H * unit.d / unit.y[:, None],
        )
        for model, after in zip(models, following, strict=True)
    ]


def only(steps: list[Scaled], channels: tuple[int, ...]) -> list[Scaled]:
    """The same with these channels alone."""
    kept = list(channels)
    return [s._replace(G=s.G[:, kept], H=s.H[:, kept], d=s.d[kept]) for s in steps]


def samples(steps: list[Scaled]) -> int | None:
    """How many samples determine the state at the last; None: none do, or not the attack."""
    if _dependent(steps):
        return None
    n = len(steps[0].A)
    constant = len(steps) == 1
    free = [np.eye(n) for _ in steps]
    for count in range(n + 1 if constant else len(steps) - 1):
        pairs = [next_free(s, X) for s, X in zip(steps[count:] or steps, free, strict=False)]
        if not any(_large(left[:n]) for left, _ in pairs):
            return count + 1
        moved = [X for _, X in pairs]
        if constant and count and moved[0].shape == free[0].shape:
            return None  # what is free only shrinks: now it has settled
        free = moved if constant else moved[:-1]
    return None


def _dependent(steps: list[Scaled]) -> bool:
    moves = steps if len(steps) == 1 else steps[:-1]
    return any(kernel(np.vstack([s.G, s.H])).shape[1] > 0 for s in moves)


def reason(steps: list[Scaled]) -> str:
    """Why these channels are refused: the plainest of the three that is true."""
    if _dependent(steps):
        return DEPENDENT
    n = len(steps[0].A)
    for s, after in zip(steps, steps[1:] or steps, strict=False):
        moved = span(s.G @ kernel(s.H), s.size)
        if _large(next_free(after, moved)[0][:n]):
            return HIDDEN
    return UNOBSERVED


def silent_for_ever(steps: list[Scaled]) -> bool:
    """Whether the samples leave (x_k, d_k) free long after the first and long before the last.

    Of a window: at its middle, so a short one may say so where a longer one would not.
    """
    n = len(steps[0].A)
    if len(steps) == 1:
        s, told = steps[0], silent(steps[0])[-1]
        late = left_free(s, np.eye(n))
    else:
        middle = (len(steps) - 1) // 2
        X = np.eye(n)
        for s in steps[:middle]:
            X = next_free(s, X)[1]
        s, told = steps[middle], np.zeros((n, 0))
        late = [next_free(s, X)[0]]
        for after in reversed(steps[middle + 1 :]):
            move, sense = np.hstack([after.A, after.G]), np.hstack([after.C, after.H])
            told = complement(kernel(np.vstack([sense, told.T @ move]), after.size)[:n])
    move = np.hstack([s.A, s.G])
    return any(_large(F @ kernel(told.T @ move @ F, s.size)) for F in late)


def _large(m: np.ndarray) -> bool:
    return bool(np.any(np.linalg.norm(m, axis=1) > TOLERANCE))
