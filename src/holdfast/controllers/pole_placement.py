"""Linear state feedback that gives the closed loop stated poles."""

import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np

from holdfast.controllers.feedback import Feedback, held, steered
from holdfast.numerics.subspaces import TOLERANCE, complement, modes, scaled, silent
from holdfast.parts import InvalidValue, Plant

PLACED = 1e-4
"""How far a pole of the closed loop may be from the one asked for. Poles of a plant with few
inputs are sensitive: rounding alone moves some by more than this, and then says so."""


def build(
    plant: Plant,
    *,
    poles: list[float | list[float]],
    reference: list[float] | None = None,
) -> Feedback:
    """The feedback u = -K (x_hat - reference) with eig(A - B K) = ``poles``.

    ``poles``: n numbers inside the unit circle, one per state, each real or [re, im] with its
    conjugate also listed; ``reference`` the state to hold (n; default the origin), which has to
    be an equilibrium of the plant without input for the error to vanish. Where several inputs
    leave a choice, the eigenvectors are as nearly orthogonal as they can be made.

    Raises `InvalidValue` for a plant that is not linear and constant or has a mode that no
    input reaches; for another number of poles than states, a pole on or outside the unit
    circle or without its conjugate, one listed more often than B has independent columns, and
    poles that no gain places within 1e-4 in float64.

    Source: `scipy.signal.place_poles`: Tits and Yang (1996), IEEE TAC 41.
    """
    _, A, B = steered(plant)
    found = held(reference, len(A))
    K = placed(A, B, _numbers(poles, len(A)))
    return Feedback(jnp.asarray(K), jnp.asarray(found), jnp.zeros(len(K)))


def placed(A: np.ndarray, B: np.ndarray, poles: np.ndarray) -> np.ndarray:
    """K (nu x n) with eig(A - B K) = ``poles`` (n,), complex ones in conjugate pairs.

    Raises `InvalidValue` as `build` does for (A, B) and for poles too often or not placed.
    """
    stuck = unreached(A, B)
    if stuck:
        raise InvalidValue(
            "plant.B", f"no input that reaches the mode {stuck[0]:.4g}", "a controllable pair"
        )
    _, sizes, right = np.linalg.svd(B, full_matrices=False)
    rank = int(np.sum(sizes > TOLERANCE * sizes[0]))
    values, counts = np.unique(poles, return_counts=True)
    if np.max(counts) > rank:
        often = values[np.argmax(counts)]
        raise InvalidValue(
            "poles",
            f"{_text(often)} {np.max(counts)} times",
            f"each pole at most {rank} times, the rank of B",
        )
    from scipy.signal import place_poles  # takes longer to import than JAX

    # the solver takes the columns of B to be independent
    used = right[:rank].T
    try:
        with warnings.catch_warnings():
            # that its last digits did not settle: what matters is where the poles are
            warnings.simplefilter("ignore", UserWarning)
            solved: Any = place_poles(A, B @ used, poles)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise InvalidValue("poles", f"no gain ({error})", "poles that a gain can place") from None
    K = used @ solved.gain_matrix
    far = distance(np.linalg.eigvals(A - B @ K), poles)
    if not far <= PLACED:
        raise InvalidValue(
            "poles", f"a gain that misses them by {far:.2g}", f"poles placed within {PLACED:g}"
        )
    return K


def distance(found: np.ndarray, asked: np.ndarray) -> float:
    """The largest distance between two sets of poles (n,), paired so that their sum is least."""
    from scipy.optimize import linear_sum_assignment  # takes as long to import as JAX

    apart = np.abs(found[:, None] - asked)
    return float(np.max(apart[linear_sum_assignment(apart)]))


def unreached(A: np.ndarray, B: np.ndarray) -> list[complex]:
    """The modes of A (n x n) that no feedback through B (n x nu) can move.

    Ranks as in `holdfast.numerics.subspaces`: they do not depend on the units of the states.
    """
    n, nu = B.shape
    s = scaled(A.T, np.zeros((n, 0)), B.T, np.zeros((nu, 0)))
    basis = complement(silent(s)[-1])
    return [z for z, _ in modes(basis.T @ s.A @ basis)]


def _numbers(poles: list[float | list[float]], n: int) -> np.ndarray:
    """The poles as numbers: real where all are."""
    if len(poles) != n:
        raise InvalidValue("poles", f"{len(poles)} poles", f"{n}, one per state")
    found = np.zeros(n, complex)
    for i, pole in enumerate(poles):
        pair = list(pole) if isinstance(pole, list | tuple) else [pole, 0.0]
        if len(pair) != 2:
            raise InvalidValue(f"poles[{i + 1}]", pole, "a number, or [re, im]")
        found[i] = complex(*pair)
        if not abs(found[i]) < 1.0:
            raise InvalidValue(f"poles[{i + 1}]", pole, "a pole inside the unit circle")
    for pole in found:
        if np.sum(found == pole) != np.sum(found == pole.conjugate()):
            raise InvalidValue(
                "poles", f"{_text(pole)} without its conjugate", "complex poles in conjugate pairs"
            )
    return found if np.any(np.imag(found)) else np.real(found)


def _text(pole: complex) -> str:
    return f"{pole.real:.4g}" if pole.imag == 0 else f"{pole:.4g}"
