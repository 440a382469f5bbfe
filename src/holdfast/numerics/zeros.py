"""Invariant zeros of a plant from its attacks to its outputs: what can hide, and how.

Plain arrays: A (n x n), G (n x nd), C (ny x n), H (ny x nd), constant.
"""

from typing import NamedTuple

import numpy as np

from holdfast.numerics.steady_state import UNSTABLE
from holdfast.numerics.subspaces import (
    TOLERANCE,
    Scaled,
    complement,
    kernel,
    legible,
    modes,
    reached,
    scaled,
    silent,
    span,
)


class Zero(NamedTuple):
    """With x_0 = ``state`` c and d_k = z^k ``attack`` c, any c, no output moves.

    ``state`` (n x r) and ``attack`` (nd x r) are in the plant's units. r counts the ways to
    hide at this z, ``multiplicity`` how often z occurs. The columns are such that the attack
    (the state, where the attack is zero: a mode that the outputs do not see) is the identity
    on r channels.
    """

    z: complex
    multiplicity: int
    state: np.ndarray
    attack: np.ndarray

    @property
    def unstable(self) -> bool:
        """|z| >= 1 - 1e-7: what hides does not fade."""
        return abs(self.z) >= UNSTABLE


class Transfer(NamedTuple):
    """``rank`` of C (zI - A)^-1 G + H at a generic z; ``lost`` (nd x r): attack directions
    that can be taken at any time, of any size and for ever, with no output moving.
    """

    rank: int
    lost: np.ndarray
    zeros: tuple[Zero, ...]


def transfer(A: np.ndarray, G: np.ndarray, C: np.ndarray, H: np.ndarray) -> Transfer:
    """Normal rank and finite invariant zeros of [A - zI, G; C, H].

    The states that an attack can hold unseen, V*, less those that it can also reach unseen,
    R* = V* and S*: the zeros are the modes of the plant there, where the attack that keeps it
    unseen leaves no choice. No square pencil is needed, nor generalised eigenvalues at
    infinity.

    Source: Basile and Marro (1992), chapter 4 (invariant zeros).
    """
    s = scaled(A, G, C, H)
    nd = s.G.shape[1]
    told, start = silent(s)[-1], reached(s)
    lost = kernel(np.vstack([s.H, told.T @ s.G]), s.size)
    both = start @ kernel(told.T @ start)
    held = complement(told)
    held = np.hstack([both, span(held - both @ (both.T @ held))])
    move, attack = _kept_unseen(s, held)
    split = both.shape[1]
    zeros = []
    for z, multiplicity in modes(move[split:, split:]):
        at = z.real if z.imag == 0 else z
        rest = _null(move[split:, split:] - at * np.eye(len(move) - split))
        # what R* does beside it is the attacker's choice: this one returns to itself
        loop = move[:split, :split] - at * np.eye(split)
        follow = np.linalg.lstsq(loop, -move[:split, split:] @ rest, rcond=None)[0]
        inside = np.vstack([follow, rest])
        state, used = s.x[:, None] * (held @ inside), s.d[:, None] * (attack @ inside)
        zeros.append(Zero(z, multiplicity, *_together(state, used)))
    return Transfer(nd - lost.shape[1], legible(s.d[:, None] * lost), tuple(zeros))


def driven(
    A: np.ndarray, G: np.ndarray, C: np.ndarray, H: np.ndarray
) -> tuple[complex, np.ndarray, np.ndarray] | None:
    """The zero of largest modulus that an attack has to keep up, with one state and attack.

    z, x (n,) and d (nd,), complex, with (A - zI) x + G d = 0, C x + H d = 0 and d not zero: a
    mode that no output sees hides without help, and so moves nothing. None where there is no
    such zero. Of several ways to hide at this z the first that `transfer` lists.
    """
    s = scaled(A, G, C, H)
    for zero in transfer(A, G, C, H).zeros:
        states, attacks = (
            np.max(np.abs(m), axis=0, initial=0.0)
            for m in (zero.state / s.x[:, None], zero.attack / s.d[:, None])
        )
        for i in np.flatnonzero(attacks > TOLERANCE * states):
            return zero.z, zero.state[:, i], zero.attack[:, i]
    return None


def _kept_unseen(s: Scaled, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """X, U with A V + G U = V X and C V + H U = 0: how a state of V* is kept there."""
    r = held.shape[1]
    left = np.block([[held, -s.G], [np.zeros((len(s.C), r)), -s.H]])
    found = np.linalg.lstsq(left, np.vstack([s.A @ held, s.C @ held]), rcond=TOLERANCE)[0]
    return found[:r], found[r:]


def _null(m: np.ndarray) -> np.ndarray:
    """The kernel of a matrix known to be singular: at least one vector."""
    found = kernel(m)
    return found if found.shape[1] else np.linalg.svd(m)[2][-1:].conj().T


def _together(state: np.ndarray, attack: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both by the same change of columns, legible in the attack or, failing it, the state."""
    both = np.vstack([attack, state])
    rows, r = len(attack), both.shape[1]
    if np.linalg.matrix_rank(attack, tol=TOLERANCE * np.linalg.norm(both)) == r:
        lead = attack
    else:
        lead = both
    change = np.linalg.lstsq(lead, legible(lead), rcond=None)[0]
    both = both @ change
    return both[rows:], both[:rows]
