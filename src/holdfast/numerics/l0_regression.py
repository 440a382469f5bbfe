"""The fewest units of rows without which y = Phi x has a solution: exact l0 regression.

    minimise over x   number of units with a row  |y_j - Phi_j x| > t_j

where a unit is a set of rows that are attacked or clean together. The size of an attack does not
matter; the price is a search, by branch and bound over sets of units. Where the rows that are left
contradict each other, `holdfast.numerics.circuits` finds a few that do, of whose units one has to
go: the one most to blame goes, or else it is fixed as clean. Contradictions that have no free unit
in common cost one unit each, and their number is the lower bound. So what the search proves is
proved by contradictions, not by bad fits.

Source: Fawzi, Tabuada and Diggavi, Secure estimation and control for cyber-physical systems under
adversarial attacks, IEEE TAC 59(6), 2014, section III (the l0 decoder); Shoukry et al., Secure
state estimation for cyber-physical systems under sensor attacks, ACM TCPS 2(1), 2018 (certificates
of conflict).
"""

from collections.abc import Sequence
from functools import cache, partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from holdfast.numerics.circuits import (
    CONFLICT,
    CONSISTENT,
    UNDECIDED,
    Disjoint,
    disjoint,
    shortest_fit,
)
from holdfast.numerics.l0_strips import FIXED, Problem, prepared

GOOD = 10.0
"""How much rather rows that fit the best x so far are looked at."""
ALIKE = 1e-11
"""Of the terms of Phi_j x: what rounding makes of two states that are one."""

_THROWN, _CLEAN = 1, 2
"""What is decided of a unit; 0: nothing."""


class L0Fit(eqx.Module):
    """What `l0_regression` found.

    ``x``: the first minimiser; ``count`` of units thrown out for it and the rows ``thrown``;
    ``rank`` of the others: under n they do not determine the state, and x is the shortest.
    ``lower``: proven lower bound of the count. ``states``: different minimisers, of which the
    first ``found`` are valid: two or more make x ambiguous. ``complete``: nothing was left out,
    so that there are no others unless all places are taken. ``nodes`` examined. ``feasible``:
    the trusted rows agree; if not, x is their least-squares fit, found is 0, and everything that
    is not trusted counts as thrown out.
    """

    x: Float[Array, " n"]
    count: Int[Array, ""]
    thrown: Bool[Array, " m"]
    states: Float[Array, "k n"]
    found: Int[Array, ""]
    lower: Int[Array, ""]
    rank: Int[Array, ""]
    nodes: Int[Array, ""]
    feasible: Bool[Array, ""]
    complete: Bool[Array, ""]


class _Best(NamedTuple):
    """The minimisers so far, of the ``least`` count.

    ``at``: what the first one does to every row; ``blame``: how far from it the units are.
    """

    least: Int[Array, ""]
    thrown: Bool[Array, " m"]
    rank: Int[Array, ""]
    states: Float[Array, "k n"]
    found: Int[Array, ""]
    at: Float[Array, " m"]
    blame: Float[Array, " U"]


class _Search(NamedTuple):
    """``stack`` of what is open: what is decided of every unit, and the ``bound`` of each.

    ``lost``: the least bound of the nodes on which the numerics gave up.
    """

    stack: Int[Array, "D U"]
    bound: Int[Array, " D"]
    top: Int[Array, ""]
    best: _Best
    lost: Int[Array, ""]
    nodes: Int[Array, ""]
    feasible: Bool[Array, ""]


def l0_regression(
    Phi: Float[Array, "m n"],
    y: Float[Array, " m"],
    units: Sequence[int] | np.ndarray,
    tolerance: Float[Array, " m"],
    used: Bool[Array, " m"],
    trusted: Bool[Array, " m"],
    *,
    states: int = 4,
    nodes: int = 10_000,
    start: Float[Array, " n"] | None = None,
) -> L0Fit:
    """The x that contradicts the fewest units, all of them up to ``states``, and the proof.

    Row j fits x where |y_j - Phi_j x| <= t_j, its ``tolerance``, but not under 1e-12 of what
    samples are. What is minimised is the number of units to throw out for the strips of all other
    rows to have a point in common. ``x`` is the least-squares fit of these rows, weighted by
    1 / t_j: with noise it may itself leave a strip that another x does not. All strips are
    decided to 1e-9 of the widths that a contradiction adds up, and a direction of which a row,
    scaled to one, holds less than 1e-10 counts as not seen.

    ``units`` names the unit of each row. A row not ``used`` is absent; a ``trusted`` one belongs
    to no unit and is never thrown out. A sample that is not finite fits no x. Two states differ
    where some used row tells them apart by more than 2 t_j, so that no sample fits both.
    ``start``: an x that may be good. At most ``nodes`` sets are examined: ``lower`` < ``count``
    says that they were too few to prove the count, and not ``complete`` that other states may
    have been missed.

    Raises ValueError where ``units`` are not as many as the rows.

    Source: see the module.
    """
    names, unit = np.unique(np.asarray(units, int), return_inverse=True)
    if len(unit) != len(y):
        raise ValueError(f"{len(unit)} units for {len(y)} rows")
    setting = _Setting(len(names), tuple(unit.tolist()), max(states, 1), max(nodes, 1))
    guess = jnp.full(Phi.shape[1], jnp.nan) if start is None else start
    return L0Fit(*_solver(setting)(Phi, y, tolerance, used, trusted, guess))


class _Setting(NamedTuple):
    units: int
    unit: tuple[int, ...]
    states: int
    nodes: int


@cache
def _solver(setting: _Setting):
    solve = jax.custom_batching.custom_vmap(partial(_alone, setting))
    solve.def_vmap(partial(_in_turn, setting))
    return jax.jit(solve)


def _in_turn(setting: _Setting, axis_size, in_batched, *given):
    """One after the other: problems side by side would all take as many nodes as the worst."""

    def one(batched):
        rest = iter(batched)
        every = (next(rest) if of else a for a, of in zip(given, in_batched, strict=True))
        return _alone(setting, *every)

    batched = tuple(a for a, of in zip(given, in_batched, strict=True) if of)
    found = jax.lax.map(one, batched)
    return found, (True,) * len(found)


def _alone(setting: _Setting, Phi, y, tolerance, used, trusted, start):
    unit = jnp.asarray(setting.unit)
    problem = prepared(Phi, y, unit, setting.units, tolerance, used, trusted)
    last = jax.lax.while_loop(
        lambda s: (s.top > 0) & (s.nodes < setting.nodes),
        lambda s: _visit(setting, problem, s),
        _started(setting, problem, start),
    )
    best = last.best
    left = jnp.where(jnp.arange(len(last.bound)) < last.top, last.bound, setting.units + 1)
    rest = jnp.minimum(jnp.min(left), last.lost)
    return (
        best.states[0],
        best.least,
        best.thrown,
        best.states,
        jnp.where(last.feasible, best.found, 0),
        jnp.minimum(best.least, rest),
        best.rank,
        last.nodes,
        last.feasible,
        rest >= _limit(setting, best),
    )


def _limit(setting: _Setting, best: _Best):
    """The bound from which a node holds nothing new."""
    return best.least + jnp.where(best.found >= setting.states, 0, 1)


def _blame(setting: _Setting, problem: Problem, at):
    """How far each unit is from ``at``, at worst, in half widths of its strips."""
    strips = problem.strips
    off = jnp.abs(strips.centre - at) / jnp.maximum(strips.half, jnp.finfo(at.dtype).tiny)
    off = jnp.where(problem.used & ~problem.trusted, off, 0.0)
    return jnp.zeros(setting.units).at[strips.unit].max(off)


def _started(setting: _Setting, problem: Problem, start) -> _Search:
    """On the stack nothing is decided, and above it the units that the better guess throws out.

    Where both contradict trusted rows these are all: if that does not help, nothing does.
    """
    strips, used, trusted = problem.strips, problem.used, problem.trusted
    robust = jnp.zeros_like(strips.centre)
    given = strips.centre + (problem.Phi @ start - problem.y) / problem.scale
    given = jnp.where(jnp.all(jnp.isfinite(start)), given, robust)
    free = jnp.zeros(setting.units, bool).at[strips.unit].max(used & ~trusted)

    def judged(at):
        blame = _blame(setting, problem, at)
        off = jnp.any(trusted & ~(jnp.abs(strips.centre - at) <= strips.half))
        out = free & ((blame > 1.0) | off)
        return jnp.sum(jnp.where(out, 1, 0)), out, at, blame

    pairs = zip(judged(robust), judged(given), strict=True)
    counts, *others = (jnp.stack(pair) for pair in pairs)
    out, at, blame = (pair[jnp.argmin(counts)] for pair in others)
    size = setting.units + 2
    nobody = _Best(
        jnp.asarray(setting.units + 1),
        used & ~trusted,
        jnp.asarray(0),
        jnp.zeros((setting.states, len(start))),
        jnp.asarray(0),
        at,
        blame,
    )
    return _Search(
        jnp.zeros((size, setting.units), jnp.int8).at[1].set(jnp.where(out, 1, 0).astype(jnp.int8)),
        jnp.zeros(size, int),
        jnp.asarray(2),
        nobody,
        jnp.asarray(setting.units + 1),
        jnp.asarray(0),
        jnp.asarray(True),
    )


def _visit(setting: _Setting, problem: Problem, search: _Search) -> _Search:
    """The node on top of the stack."""
    search = search._replace(top=search.top - 1)
    bound = search.bound[search.top]
    return jax.lax.cond(
        bound < _limit(setting, search.best),
        lambda: _examined(setting, problem, search),
        lambda: search,
    )


def _examined(setting: _Setting, problem: Problem, search: _Search) -> _Search:
    decided, best, strips = search.stack[search.top], search.best, problem.strips
    out = decided == _THROWN
    thrown = out[strips.unit] & problem.used & ~problem.trusted
    count = jnp.sum(jnp.where(out, 1, 0))
    fixed = problem.trusted | (decided == _CLEAN)[strips.unit]
    weight = problem.weight * jnp.where(fixed, FIXED, 1.0)
    weight = weight * jnp.where((best.blame <= 1.0)[strips.unit], GOOD, 1.0)
    there = problem.used & ~thrown
    enough = _limit(setting, best) - count
    found = disjoint(strips, there, fixed, weight, best.at, setting.units, enough)
    bound = jnp.maximum(search.bound[search.top], count + found.more)
    given_up = found.status == UNDECIDED
    # nothing is left to throw out
    futile = (found.more > setting.units) & ~jnp.any(there & ~problem.trusted)
    search = search._replace(
        nodes=search.nodes + 1,
        lost=jnp.where(given_up, jnp.minimum(search.lost, bound), search.lost),
        feasible=search.feasible & ~futile,
        top=jnp.where(futile, 0, search.top),
    )
    return jax.lax.cond(
        (found.status == CONSISTENT) | futile,
        lambda: search._replace(best=_leaf(setting, problem, best, thrown, count)),
        lambda: jax.lax.cond(
            (found.status == CONFLICT) & (bound < _limit(setting, best)),
            lambda: _branched(search, decided, bound, found),
            lambda: search,
        ),
    )


def _branched(search: _Search, decided, bound, found: Disjoint) -> _Search:
    """Either the unit most to blame goes (examined first) or it is clean."""
    forced = jnp.any(found.forced)
    index = jnp.arange(len(decided))
    chosen = index == jnp.argmax(jnp.where(found.circuit, search.best.blame, -1.0))
    kind = decided.dtype
    go = jnp.where(jnp.where(forced, found.forced, chosen), _THROWN, decided).astype(kind)
    stay = jnp.where(chosen, _CLEAN, decided).astype(kind)
    last = search.top + jnp.where(forced, 0, 1)
    stack = search.stack.at[search.top].set(stay).at[last].set(go)
    bounds = search.bound.at[search.top].set(bound).at[last].set(bound)
    return search._replace(stack=stack, bound=bounds, top=last + 1)


def _leaf(setting: _Setting, problem: Problem, best: _Best, thrown, count) -> _Best:
    """A set without which the rest has a solution: a better one, or one more."""
    scaled = problem.Phi / problem.scale[:, None], problem.y / problem.scale
    x, rank = shortest_fit(problem.strips, *scaled, problem.used & ~thrown)
    better = count < best.least
    places = jnp.arange(setting.states)
    size = jnp.maximum(jnp.abs(x), jnp.abs(best.states)) @ jnp.abs(problem.Phi).T
    apart = jnp.abs((x - best.states) @ problem.Phi.T) > 2.0 * problem.half + ALIKE * size
    known = jnp.any((places < best.found) & ~jnp.any(apart & problem.used, 1))
    new = (count == best.least) & ~known & (best.found < setting.states)
    place = jnp.where(better, 0, best.found)
    listed = jnp.where((better | new) & (places == place), 1.0, 0.0)[:, None]
    states = jnp.where(listed > 0, x, jnp.where(better, 0.0, best.states))
    at = problem.strips.centre + (problem.Phi @ x - problem.y) / problem.scale
    return _Best(
        jnp.minimum(count, best.least),
        jnp.where(better, thrown, best.thrown),
        jnp.where(better, rank, best.rank),
        states,
        jnp.where(better, 1, best.found + jnp.where(new, 1, 0)),
        jnp.where(better, at, best.at),
        jnp.where(better, _blame(setting, problem, at), best.blame),
    )
