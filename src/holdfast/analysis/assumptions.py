"""Which of the conditions under which NISE's errors are known to stay bounded a plant meets.

Derivatives are tried at the estimate and at points around it: what holds there may fail further
away, what fails there fails. The paper's Assumption 5.3 is taken as it is meant, with *some*
constant: a remainder under *any* multiple of |dx|^2 near every point is that of a linear function.

Source: NISME, Assumptions 4.1 and 5.1 to 5.4, Lemma 5.1.
"""

from collections.abc import Iterable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cholesky, solve_triangular

from holdfast.analysis.admissible import samples, units
from holdfast.analysis.boundedness import bounds
from holdfast.analysis.model import Model
from holdfast.analysis.nise_pair import nise_pair
from holdfast.numerics.gramian import uniformly_observable
from holdfast.numerics.subspaces import TOLERANCE
from holdfast.parts import Plant
from holdfast.plants.local import motion, sensing

POINTS = 8
"""Points tried besides the estimate."""
SAME = 1e-5
"""Relative change from point to point that is none: sampling alone makes G move with the state,
by the cube of the step."""
HALVINGS = 7
GROWN = 4.0
"""Growth of a remainder over |dx|^2, while dx is halved, from which on it is not quadratic."""


class Assumption(NamedTuple):
    """``holds``: at the points tried; None where nothing can be said."""

    name: str
    holds: bool | None
    sentence: str


ATTACKER = Assumption("Assumption 5.1", None, "the slope of the attack is the attacker's choice")


def on_assumptions(
    plant: Plant, x0: np.ndarray, P0: np.ndarray, sets: Iterable[tuple[int, ...]]
) -> list[str]:
    """A sentence for each that a mode does not meet, of the largest of the ``sets`` of channels."""
    known, said = set(sets), []
    for channels in sorted(s for s in known if not any(set(s) < set(t) for t in known)):
        names = "+".join(plant.attacks[i] for i in channels) or "no channel"
        for one in assumptions(plant, x0, P0, channels):
            if one.holds is False:
                said.append(
                    f"With {names} attacked, {one.name} of NISE is not met: {one.sentence}."
                )
    return said


class _Local(NamedTuple):
    """The matrices at each point (first axis), and remainders by point and size of the step."""

    A: np.ndarray
    G: np.ndarray
    C: np.ndarray
    H: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    left: np.ndarray
    rounding: np.ndarray


class _Decomposed(NamedTuple):
    """(8) at every point, in the outputs whose noise has unit covariance at the first."""

    C1: np.ndarray
    C2: np.ndarray
    G1: np.ndarray
    G2: np.ndarray
    sensed: np.ndarray
    effect: np.ndarray
    beside: np.ndarray


def assumptions(
    plant: Plant, x0: np.ndarray, P0: np.ndarray, channels: tuple[int, ...]
) -> list[Assumption]:
    """Assumptions 4.1 and 5.1 to 5.4 near ``x0`` (n,), with these attack channels free.

    Points are drawn from N(x0, P0), but at least 1 % of the state away; without known input.
    """
    x0, P0 = np.asarray(x0, float), np.asarray(P0, float)
    local = _tried(plant, x0, P0, channels)
    if not all(np.all(np.isfinite(m)) for m in local):
        broken = "a derivative of f or h is not finite at a point tried"
        first, *rest = (
            Assumption(f"Assumption {name}", False, broken) for name in ("4.1", "5.2", "5.3", "5.4")
        )
        return [first, ATTACKER, *rest]
    parts = _decomposed(local)
    return [
        _linear_where_needed(local, parts),
        ATTACKER,
        _bounded(local, parts),
        _quadratic(local),
        _covariance(local, P0, tuple(plant.attacks[i] for i in channels)),
    ]


def _tried(plant: Plant, x0: np.ndarray, P0: np.ndarray, channels: tuple[int, ...]) -> _Local:
    n, nd = len(plant.states), len(plant.attacks)
    spread = np.maximum(np.sqrt(np.diagonal(P0)), 0.01 * np.maximum(np.abs(x0), 1.0))
    attacked = np.isin(np.arange(nd), list(channels))
    keys = jax.random.split(jax.random.key(0))
    at, step = (
        np.asarray(jax.random.normal(key, (POINTS + 1, n + nd))) * np.append(spread, attacked)
        for key in keys
    )
    at[0] = 0.0
    drawn = at[:, :n] + x0, at[:, n:], step[:, :n], step[:, n:]
    found = _everywhere(plant, *(jnp.asarray(m) for m in drawn))
    A, G, C, H, Q, R, left, rounding = (np.asarray(m) for m in found)
    kept = list(channels)
    return _Local(A, G[..., kept], C, H[..., kept], Q, R, left, rounding)


@eqx.filter_jit
def _everywhere(plant: Plant, x, d, dx, dd):
    """The matrices at every point, and what is left of f and h over the squared step."""
    u, k = jnp.zeros(len(plant.inputs)), jnp.asarray(1, jnp.int32)

    def at(point):
        x, d, dx, dd = point
        moved, sensed = motion(plant, k, x, u, d), sensing(plant, k, x, u, d)
        f0, h0 = plant.transition(k, x, u, d), plant.output(k, x, u, d)
        slope = jnp.concatenate([moved.A @ dx + moved.G @ dd, sensed.C @ dx + sensed.H @ dd])

        def beyond(t):
            there = x + t * dx, u, d + t * dd
            f, h = plant.transition(k, *there), plant.output(k, *there)
            step = jnp.concatenate([f - f0, plant.innovation(h, h0)])
            return jnp.max(jnp.abs(step - t * slope)) / t**2

        sizes = 0.5 ** jnp.arange(HALVINGS, dtype=float)
        left = jax.lax.map(beyond, sizes)
        largest = jnp.maximum(jnp.max(jnp.abs(f0)), jnp.max(jnp.abs(h0)))
        largest = jnp.maximum(largest, jnp.max(jnp.abs(slope)))
        rounding = 1e-13 * largest / sizes**2
        arrays = moved.A, moved.G, sensed.C, sensed.H, moved.Q, sensed.R
        return *arrays, left, rounding

    return jax.lax.map(at, (x, d, dx, dd))


def _decomposed(local: _Local) -> _Decomposed:
    W = np.eye(len(local.R[0]))
    if _positive(local.R[:1]):
        W = solve_triangular(cholesky(local.R[0], lower=True), W, lower=True)
    C, H = W @ local.C, W @ local.H
    U, values, Vt = np.linalg.svd(H[0])
    r = int(np.sum(values > TOLERANCE * np.max(values, initial=0.0)))
    V1, V2, rest = Vt[:r].T, Vt[r:].T, U[:, r:].T
    G2 = local.G @ V2
    effect = rest @ C @ G2
    Ubar, values, _ = np.linalg.svd(effect[0])
    q = int(np.sum(values > TOLERANCE * max(np.max(values, initial=0.0), 1e-300)))
    first, beside = Ubar[:, :q].T, Ubar[:, q:].T
    return _Decomposed(
        U[:, :r].T @ C, first @ rest @ C, local.G @ V1, G2, H, effect, beside @ effect
    )


def _linear_where_needed(local: _Local, parts: _Decomposed) -> Assumption:
    name = "Assumption 4.1"
    size = np.max(np.abs(parts.effect), initial=0.0)
    reasons = {
        "how the attacks enter the outputs (H) depends on where the plant is": _changes(local.H),
        "what is attacked only through the state moves it differently from state to state (G_2)":
            _changes(parts.G2),
        "the outputs that show it are not linear in the state (z_2)": _changes(parts.C2)
            or bool(np.max(np.abs(parts.beside), initial=0.0) > SAME * size),
    }  # fmt: skip
    found = [reason for reason, broken in reasons.items() if broken]
    if found:
        return Assumption(name, False, found[0])
    return Assumption(name, True, "G_2 and C_2 are the same at all points tried")


def _bounded(local: _Local, parts: _Decomposed) -> Assumption:
    name = "Assumption 5.2"
    for matrix, what in (("Q", "process"), ("R", "measurement")):
        if not _positive(getattr(local, matrix)):
            return Assumption(name, False, f"the {what} noise has no lower bound: {matrix} is "
                              "singular")  # fmt: skip
    for effect in (parts.sensed, parts.effect):
        least = TOLERANCE * np.max(np.abs(effect), initial=0.0)
        if len({int(np.linalg.matrix_rank(m, least)) for m in effect if m.size}) > 1:
            return Assumption(name, False, "at some points an attack reaches no output")
    sizes = {"A": local.A, "C": local.C, "G": local.G}
    shown = ", ".join(f"|{k}| <= {np.max(_norms(m)):.3g}" for k, m in sizes.items() if m.size)
    return Assumption(name, True, f"at all points tried {shown}, Q and R positive definite")


def _quadratic(local: _Local) -> Assumption:
    name = "Assumption 5.3"
    left = np.maximum(local.left - local.rounding, 0.0)
    if not np.any(left > 0):
        return Assumption(name, True, "f and h are linear")
    early, late = np.max(left[:, :2], 1), np.max(left[:, 2:], 1)
    if np.any(late > GROWN * np.maximum(early, local.rounding[:, -1])):
        return Assumption(name, False, "what the linearisation leaves is not of second order")
    return Assumption(
        name, True, "what the linearisation leaves is of second order (not of higher: as printed, "
        "with any constant, this asks for a linear plant)",
    )  # fmt: skip


def _covariance(local: _Local, P0: np.ndarray, names: tuple[str, ...]) -> Assumption:
    """P bounded from above; from below it is where Q and R are, from the first sample on."""
    n, ny = len(local.A[0]), len(local.C[0])
    states, outputs = (tuple(f"{k}{i}" for i in range(m)) for k, m in (("x", n), ("y", ny)))
    A, G, C, H, Q, R = (m[0] for m in local[:6])
    model = Model(A, G, C, H, Q, R, states, outputs, names, "")
    above = _above(model, P0)
    if above.holds and not _positive(local.Q):
        return above._replace(
            holds=None, sentence=f"{above.sentence}; from below it need not be: Q is singular"
        )
    return above


def _above(model: Model, P0: np.ndarray) -> Assumption:
    name, every = "Assumption 5.4", tuple(range(len(model.attacks)))
    if _positive(model.R[None]):
        pair = nise_pair([model], every)
        if not pair.hidden and uniformly_observable(pair.A, pair.C).observable:
            return Assumption(name, True, "(C_3, Abar) is observable: Lemma 5.1")
    count = samples(units([model]))
    if count is not None:
        rows = "1 sample determines" if count == 1 else f"{count} samples determine"
        return Assumption(name, True, f"{rows} the state whatever the attack, though (C_3, Abar) "
                          "is not observable")  # fmt: skip
    settled = bounds(model, P0, 0)
    found = {**settled.state, **settled.attack}
    if False in found.values():
        return Assumption(name, False, "a variance grows without limit, or the outputs do not "
                          "determine state and attack")  # fmt: skip
    if None in found.values():
        return Assumption(name, None, f"the covariance had not settled after {settled.steps} steps")
    return Assumption(name, True, "the covariance settles, though (C_3, Abar) is not observable")


def _changes(matrices: np.ndarray) -> bool:
    """Whether one of them differs from the first."""
    size = np.max(np.abs(matrices), initial=0.0)
    return bool(np.max(np.abs(matrices - matrices[:1]), initial=0.0) > SAME * size)


def _positive(matrices: np.ndarray) -> bool:
    """Whether all are positive definite, each in units in which its diagonal is one."""
    for m in matrices:
        root = np.sqrt(np.diagonal(m))
        if not np.all(root > 0):
            return False
        if np.linalg.eigvalsh(m / np.outer(root, root))[0] <= 1e-12:
            return False
    return True


def _norms(matrices: np.ndarray) -> np.ndarray:
    return np.linalg.norm(matrices, 2, axis=(1, 2))
