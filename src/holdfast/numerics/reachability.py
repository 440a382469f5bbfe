"""What an attacker can do to an estimate while a quadratic form of the residuals stays bounded.

The shift e of the error of a steady-state filter obeys e_i = A e_{i-1} - K z_i with the shift of
the innovation z_i = C A e_{i-1} + a_i, where a_i is free on the outputs that the attacker can alter
at step i and zero on the others. The cost of a move is weight_i z_i' Q^-1 z_i.

Everything is O(steps n^3) and in square-root form: with unstable A the reachable set spans tens of
orders of magnitude, and a covariance that has lost half its digits is wrong, not imprecise.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.linalg import cho_solve, solve_triangular

from holdfast.numerics.linalg import solve_lower
from holdfast.numerics.square_root import (
    backward_step,
    forward_step,
    informed,
    times,
    triangle,
)


class Moves(NamedTuple):
    """A step, for each of m sets of outputs that the attacker can alter:

        e_i = F e_{i-1} + B v,   z_i' Q^-1 z_i = |G e_{i-1}|^2 + |v|^2,
        a_i = back e_{i-1} + push v,

    v whitened and as free as the attacker is; rows and columns that are not there are zero.

    ``ahead`` (f x p x n): whitened residuals that e_{i-1} must be ready to show whatever the
    attacker does, if there are any. They have costs of their own.
    """

    F: Float[Array, "m n n"] | np.ndarray
    B: Float[Array, "m n p"] | np.ndarray
    G: Float[Array, "m p n"] | np.ndarray
    back: Float[Array, "m p n"] | np.ndarray
    push: Float[Array, "m p p"] | np.ndarray
    ahead: Float[Array, "f p n"] | np.ndarray


def moves(A, C, K, Q, alterable, blocks: int = 0) -> Moves:
    """The step for every row of ``alterable`` (m x p, bool); Q (p x p) is the innovation's.

    ``blocks`` steps in a row may turn out to be authenticated at any time: their residuals
    C A (A - K C A)^j e are in ``ahead``.

    With U the outputs that are out of reach and E the others, the cheapest residual of the latter
    is what the honest ones predict, Q_EU Q_UU^-1 r_U with r = C A e; what is added to it costs by
    Q_EE - Q_EU Q_UU^-1 Q_UE.
    """
    told = C @ A
    n, p = len(A), len(C)
    found = [
        np.zeros((len(alterable), *shape)) for shape in ((n, n), (n, p), (p, n), (p, n), (p, p))
    ]
    for row, hit in enumerate(np.asarray(alterable, bool)):
        out, inside = np.flatnonzero(~hit), np.flatnonzero(hit)
        keep = np.zeros((p, p))
        keep[out, out] = 1.0
        spread = Q[np.ix_(inside, inside)]
        if len(out):
            lower = np.linalg.cholesky(Q[np.ix_(out, out)])
            cross = Q[np.ix_(out, inside)]
            keep[np.ix_(inside, out)] = cho_solve((lower, True), cross).T
            half = solve_triangular(lower, cross, lower=True)
            spread = spread - half.T @ half
            found[2][row, : len(out)] = solve_triangular(lower, told[out], lower=True)
        push = np.zeros((p, p))
        push[np.ix_(inside, np.arange(len(inside)))] = np.linalg.cholesky(spread)
        found[0][row] = A - K @ keep @ told
        found[1][row] = -K @ push
        found[3][row] = keep @ told - told
        found[4][row] = push
    whole = np.linalg.cholesky(Q)
    ahead, move = np.zeros((blocks, p, n)), np.eye(n)
    for j in range(blocks):
        ahead[j] = solve_triangular(whole, told @ move, lower=True)
        move = (A - K @ told) @ move
    return Moves(found[0], found[1], found[2], found[3], found[4], ahead)


def patterns(alterable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct rows of ``alterable`` (T x p), and which of them each step has (T,)."""
    rows, index = np.unique(np.asarray(alterable, bool), axis=0, return_inverse=True)
    return rows, index.reshape(-1).astype(np.int32)


def _step(m: Moves, index, weight):
    """F, B and all that is told of e, of a step whose costs are multiplied by ``weight``."""
    root = jnp.sqrt(weight)
    n = m.F.shape[-1]
    ready = (m.ahead * root[1:, None, None]).reshape(-1, n)
    return m.F[index], m.B[index] / root[0], jnp.concatenate([m.G[index] * root[0], ready])


def _still(m: Moves) -> Moves:
    """The same with one more set, of a step at which nothing happens."""
    n, p = m.F.shape[1], m.B.shape[2]
    more = (np.eye(n), np.zeros((n, p)), np.zeros((p, n)), np.zeros((p, n)), np.zeros((p, p)))
    rows = [np.concatenate([x, y[None]]) for x, y in zip(m[:5], more, strict=True)]
    return Moves(rows[0], rows[1], rows[2], rows[3], rows[4], m.ahead)


def _length(t: int) -> int:
    """The next of 32, 128, 512, 1024, 2048, ..."""
    return next((size for size in (32, 128) if t <= size), max(512, 1 << (t - 1).bit_length()))


def _padded(m: Moves, index, *rows):
    """The moves, and everything of length t filled up with still steps to a length that many
    share: a program for every length would be compiled for every length.
    """
    t = len(index)
    more = _length(t) - t
    index = np.concatenate([index, np.full(more, m.F.shape[0])]).astype(np.int32)
    filled = []
    for row in rows:
        tail = np.zeros((more, *row.shape[1:]), row.dtype)
        if row.ndim == 2:
            # a step divides by its weight; nothing is ahead of a still one
            tail[:, 0] = 1.0
        filled.append(np.concatenate([row, tail]))
    return _still(m), index, *filled


def forward(m: Moves, index, weights, start) -> np.ndarray:
    """Factors (t x n x n) of W_1 .. W_t: the e_i that cost at most 1 so far are those with
    e' W_i^+ e <= 1.

    ``index`` (t,): the set of each step. ``weights`` (t x (1 + f)): of each step's residual and,
    behind it, of what is ``ahead``. ``start`` (n x n): a factor of W_0, zero where the attack
    starts from nothing.
    """
    return np.asarray(_forward(*_padded(m, index, weights), start))[: len(index)]


def backward(m: Moves, index, weights, ends) -> np.ndarray:
    """Factors (t x n x n) of S_1 .. S_t: from e at step i on, a cost of e' S_i e is to come, up to
    the next step where ``ends`` (t,) is not 0 (S is zero there and at t).
    """
    ends = np.array(ends, np.int32)
    ends[-1] = 1
    return np.asarray(_backward(*_padded(m, index, weights, ends)))[: len(index)]


@jax.jit
def _forward(
    m: Moves, index: Int[Array, " t"], weights: Float[Array, "t c"], start: Float[Array, "n n"]
) -> Float[Array, "t n n"]:
    def one(L, at):
        L = forward_step(*_step(m, *at), L)
        return L, L

    return jax.lax.scan(one, start, (index, weights))[1]


@jax.jit
def _backward(
    m: Moves, index: Int[Array, " t"], weights: Float[Array, "t c"], ends: Int[Array, " t"]
) -> Float[Array, "t n n"]:

    def one(T, at):
        *step, end = at
        T = jnp.where(end != 0, 0.0, T)
        return backward_step(*_step(m, *step), T), T

    start = jnp.zeros(m.F.shape[1:])
    return jax.lax.scan(one, start, (index, weights, ends), reverse=True)[1]


def joined(L: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Factors of (W^-1 + S)^-1 for stacks (t x n x n) of factors of W and S."""
    t, n = L.shape[:2]
    more = np.zeros((_length(t) - t, n, n))
    return np.asarray(_joined(*(np.concatenate([x, more]) for x in (L, T))))[:t]


@jax.jit
def _joined(L: Float[Array, "t n n"], T: Float[Array, "t n n"]) -> Float[Array, "t n n"]:
    return jax.lax.scan(lambda _, at: (None, informed(*at)), None, (L, T))[1]


class Path(NamedTuple):
    """An attack from step 1 to t: the shifts of the error, what is added to each output, and the
    squares of each step's residual and of what is ahead of it, t x (1 + f); ``first``: the first
    error in units of its ellipsoid.
    """

    e: np.ndarray
    a: np.ndarray
    cost: np.ndarray
    first: np.ndarray


def _climb(m: Moves, index, weights, before, last, costate):
    """The cheapest way to e_last: costates going back (Bryson and Frazier), with the factors
    ``before`` of W_0 .. W_{t-1}. Steps after ``last`` are left at zero.
    """

    def one(costate, at):
        i, index, weight, L = at
        F, B, G = _step(m, index, weight)
        active = i < last
        moved = jnp.where(active, F.T @ costate, 0.0)
        push = jnp.where(active, B.T @ costate, 0.0)
        inside = informed(L, G)
        e = inside @ (inside.T @ moved)  # 0 with them where not active
        costate = jnp.where(active, moved - G.T @ (G @ e), costate)
        return costate, (e, push / jnp.sqrt(weight[0]))

    rows = (jnp.arange(len(index)), index, weights, before)
    return jax.lax.scan(one, costate, rows, reverse=True)


def _walk(m: Moves, index, weights, after, planned, start):
    """Along the ``planned`` errors and moves, and the cheapest way on where these are 0, with the
    factors ``after`` of S_1 .. S_t. What rounding left of the plan is corrected as cheaply.
    """

    def one(e, at):
        index, weight, T, to, v = at
        F, B, _ = _step(m, index, weight)
        reach, n = times(T, B), T.shape[0]
        lower = triangle(jnp.concatenate([reach.T, jnp.eye(n)])).T
        # -B' S (I + B B' S)^-1 F e by the factor of I + T B B' T'
        half = solve_lower(lower, jnp.ones(n, bool), T @ (F @ (e - to)))
        whole = jax.scipy.linalg.solve_triangular(lower.T, half)
        v = v - reach.T @ whole / jnp.sqrt(weight[0])
        return F @ e + B @ v * jnp.sqrt(weight[0]), (e, v)

    return jax.lax.scan(one, start, (index, weights, after, *planned))[1]


@jax.jit
def _attack(m: Moves, index, weights, last, k, functional, start):
    """The longest axis of functional e_k, and the cheapest attack to its end; nothing behind the
    step ``last`` costs.
    """
    ends = (jnp.arange(len(index)) == last - 1).astype(jnp.int32)
    L = jnp.concatenate([start[None], _forward(m, index, weights, start)])
    T = _backward(m, index, weights, ends)
    half = informed(L[k], T[k - 1])
    seen = functional @ half
    sizes, axes = jnp.linalg.eigh(seen @ seen.T)
    goal = functional.T @ axes[:, -1]
    top = half @ (half.T @ goal)
    # the costate before the cost to come: W costate = Y goal
    costate = goal - T[k - 1].T @ (T[k - 1] @ top)
    left, planned = _climb(m, index, weights, L[:-1], k, costate)
    first = start.T @ left
    return jnp.sqrt(sizes[-1]), first, _walk(m, index, weights, T, planned, start @ first)


def longest(m: Moves, index, weights, k: int, functional, start) -> tuple[float, Path]:
    """The largest |functional e_k| over the attacks that cost at most 1 over t steps, and one that
    reaches it: functional e_k = its square times a unit vector along its axis, for that cost.

    ``functional`` (q x n); ``start``: as in `forward`. The cost of the path is its size squared.
    """
    size, first, on = _attack(*_padded(m, index, weights), len(index), k, functional, start)
    e, v = (np.asarray(x)[: len(index)] for x in on)
    return float(size), travelled(m, index, e, v, np.asarray(first))


def cheapest(m: Moves, index, weights, k: int, goal, start) -> Path:
    """Of all attacks over t steps with e_k = Y goal the one of least total weighted cost.

    ``goal`` (n,) is a direction of interest: Y goal is where the ellipsoid of Y (the e_k that cost
    at most 1 from the start to t) reaches furthest along it. ``start``: as in `forward`.
    """
    return longest(m, index, weights, k, np.asarray(goal)[None], start)[1]


def travelled(m: Moves, index, before: np.ndarray, v: np.ndarray, first: np.ndarray) -> Path:
    """The path whose errors before each step are ``before`` (t x n) and moves ``v`` (t x p)."""

    def of(matrices, vectors):
        return np.einsum("tij,tj->ti", np.asarray(matrices)[index], vectors)

    own = np.sum(of(m.G, before) ** 2, 1) + np.sum(v**2, 1)
    ahead = np.sum(np.einsum("fpn,tn->tfp", m.ahead, before) ** 2, 2)
    cost = np.column_stack([own, ahead])
    return Path(of(m.F, before) + of(m.B, v), of(m.back, before) + of(m.push, v), cost, first)
