"""State and sensor attacks from a window of samples, whatever the attacks' size.

    minimise over x   |W (Y - Phi x)|        Y: the last T rows, known inputs removed

for attacks that hop between sensors in the l1 norm, for attacked sensors that stay the same in a
norm per sensor, or by the exact search for the fewest attacked samples or sensors. What is left
of a sample is its attack, and what the last row's state is follows from the window's first.

Source: DECODER (6), (10), (12) (its decoders 1 and 2 are one: Lemma 2); Fawzi, Tabuada and
Diggavi (IEEE TAC 2014) for the norms per sensor.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from holdfast.estimators.decoder_keys import (
    Norm,
    Positions,
    Weights,
    check_decoder,
    honest,
)
from holdfast.estimators.decoder_window import DecoderWindow, Problem, Rows, decoder_window
from holdfast.numerics.group_regression import group_of_reduced
from holdfast.numerics.l0_regression import l0_regression
from holdfast.numerics.l1_regression import l1_of_reduced
from holdfast.numerics.linalg import dot
from holdfast.numerics.reduced import Reduced, reduced
from holdfast.numerics.spread import errors, influence, of_signs, signs
from holdfast.parts import Estimator, InvalidValue
from holdfast.plants.linear import LinearPlant
from holdfast.records import Estimate, Observation, Status

FAR = 5.0
"""Standard deviations from which a sample is taken as attacked, for the covariance."""
ROUNDING = 1e-9
"""Size, relative to the window's largest sample, under which an attack is rounding."""
CLOSED = 1e-7
"""Relative gap from which a decoder has not converged."""
HIDDEN = 1e-9
"""Share of an unseen direction that reaches the last state, under which it has died out."""
LISTED = 4
"""States that are listed where several explain the samples equally well."""


class DecoderState(eqx.Module):
    """``rows``: the window. What the last decoding says: the ``attack`` on every sample of the
    window (T x p, oldest row first), which samples are ``attacked``; ``states`` (k x n): the
    current states that explain the samples equally well, the first ``found`` of them, and the
    ``count`` of attacked samples or sensors they need (norm "l0" alone); ``gap``: how far from
    optimal the decoding may be, relative to what is minimised.
    """

    rows: Rows
    x: Float[Array, " n"]
    attack: Float[Array, "T p"]
    attacked: Bool[Array, "T p"]
    states: Float[Array, "k n"]
    found: Int[Array, ""]
    count: Int[Array, ""]
    gap: Float[Array, ""]


class Decoded(eqx.Module):
    """``first`` (n,): the state at the window's first row; ``lead``, ``gain``, ``pulled``: how
    noise and attacks move it (`holdfast.numerics.spread`); ``known``: whether that is known.
    """

    first: Float[Array, " n"]
    firsts: Float[Array, "k n"]
    found: Int[Array, ""]
    count: Int[Array, ""]
    gap: Float[Array, ""]
    rows: Reduced
    lead: Float[Array, "n m"]
    gain: Float[Array, "n m"]
    pulled: Float[Array, " n"]
    known: Bool[Array, ""]
    status: Int[Array, ""]


class L1Decoder(Estimator):
    """The decoder of the module over a sliding window.

    x: the state at the row; NOT_READY, and x0 moved on by the inputs, until the window is full.
    ``a``: what the last row's samples are off by, where that is over ``threshold`` standard
    deviations. The covariance of x is first-order in the noise (`holdfast.numerics.spread`); for
    the norm "l1linf" none is known (``inf``). UNOBSERVABLE where what arrived does not determine
    the state (then the smallest); AMBIGUOUS where the exact search finds several states;
    NOT_CONVERGED where the answer may not be optimal.
    """

    plant: LinearPlant
    window: DecoderWindow
    x0: Float[Array, " n"]
    P0: Float[Array, "n n"]
    threshold: Float[Array, ""]
    norm: Norm = eqx.field(static=True)
    weights: Weights = eqx.field(static=True)
    positions: Positions = eqx.field(static=True)
    nodes: int = eqx.field(static=True)

    def init(self) -> tuple[DecoderState, Estimate]:
        """The estimate one sample before the first row."""
        T, p, n = self.window.length, len(self.plant.outputs), len(self.plant.states)
        state = DecoderState(
            self.window.init(), self.x0, jnp.zeros((T, p)), jnp.zeros((T, p), bool),
            jnp.zeros((LISTED, n)), _integer(0), _integer(0), jnp.zeros(()),
        )  # fmt: skip
        nothing = jnp.zeros(p), jnp.zeros((p, p)), 0
        return state, Estimate.without_attack(self.x0, self.P0, *nothing, a=jnp.zeros(p))

    def step(self, state: DecoderState, observation: Observation) -> tuple[DecoderState, Estimate]:
        """One row: the window moved on, and decoded once it is full."""
        rows, m = self.window.add(state.rows, state.x, observation)
        moved = dot(m.A, state.x) + rows.push[-1]
        return jax.lax.cond(
            self.window.ready(rows),
            lambda: self._decode(rows, observation),
            lambda: self._wait(state, rows, moved, observation),
        )

    def _wait(self, state: DecoderState, rows: Rows, x, observation: Observation):
        p, n = len(self.plant.outputs), len(x)
        status = observation.status | int(Status.NOT_READY)
        unknown = jnp.diag(jnp.full(n, jnp.inf))
        after = DecoderState(
            rows, x, state.attack, state.attacked, state.states, state.found, state.count, state.gap
        )
        nothing = jnp.zeros(p), jnp.zeros((p, p))
        return after, Estimate.without_attack(x, unknown, *nothing, status, a=jnp.zeros(p))

    def _decode(self, rows: Rows, observation: Observation):
        T, p = rows.y.shape
        problem = self.window.problem(rows)
        laid = problem.laid
        sd = jnp.sqrt(self._variance(rows)).reshape(-1)
        found = self._solve(problem, sd)
        residual = jnp.where(problem.seen, problem.target - laid.Phi @ found.first, 0.0)
        # an authenticated sample is not attacked: what is left of it is noise
        attack = jnp.where(problem.trusted, 0.0, residual)
        least = ROUNDING * jnp.max(jnp.abs(problem.target), initial=0.0)
        attacked = jnp.abs(attack) > jnp.maximum(self.threshold * sd, least)
        x = laid.last @ found.first + problem.forced
        lost, status = self._lost(laid.last, found.rows)
        status = observation.status | found.status | status
        x_cov, residual_cov = self._errors(problem, found, lost)
        seen = problem.seen[-p:]
        kept = jnp.where(attacked, attack, 0.0).reshape(T, p)
        states = found.firsts @ laid.last.T + problem.forced
        state = DecoderState(
            rows, x, attack.reshape(T, p), attacked.reshape(T, p),
            states, found.found, found.count, found.gap,
        )  # fmt: skip
        estimate = Estimate.without_attack(
            x, x_cov, residual[-p:],
            jnp.where(seen[:, None] & seen, residual_cov, 0.0),
            status.astype(jnp.int32), a=kept[-1],
        )  # fmt: skip
        return state, estimate

    def _variance(self, rows: Rows) -> Float[Array, "T p"]:
        if rows.matrices is None:
            diagonal = jnp.diagonal(jnp.asarray(self.plant.R))
            return jnp.broadcast_to(diagonal, rows.y.shape)
        return jnp.diagonal(rows.matrices.R, axis1=1, axis2=2)

    def _solve(self, problem: Problem, sd) -> Decoded:
        seen = jnp.where(problem.seen, 1.0, 0.0)
        if self.weights == "noise":
            noise = problem.laid.law.sd
            weight = jnp.where(noise > 0, seen / jnp.where(noise > 0, noise, 1.0), 0.0)
        else:
            weight = seen
        if self.norm == "l0":
            return self._fewest(problem, sd, weight)
        Phi, target, exact = problem.laid.Phi, problem.target, problem.trusted & problem.seen
        rows = reduced(Phi, target, weight, exact)
        if self.norm == "l1":
            found = l1_of_reduced(rows, Phi, target, weight, exact)
        else:
            found = group_of_reduced(rows, Phi, target, self._sensors(), self.norm, weight, exact)
        relative = found.gap / jnp.where(found.objective > 0, found.objective, 1.0)
        # noise-free samples leave nothing but rounding to minimise
        size = ROUNDING * jnp.sum(weight * jnp.abs(target))
        fine = (relative <= CLOSED) | (found.gap <= size)
        status = jnp.where(fine, 0, int(Status.NOT_CONVERGED))
        moved = self._moved(problem, rows, weight, found.residual)
        firsts = jnp.zeros((LISTED, Phi.shape[1])).at[0].set(found.x)
        none, one = jnp.asarray(0, jnp.int32), jnp.asarray(1, jnp.int32)
        return Decoded(found.x, firsts, one, none, relative, rows, *moved, status)

    def _sensors(self) -> tuple[int, ...]:
        return tuple(range(len(self.plant.outputs))) * self.window.length

    def _moved(self, problem: Problem, rows: Reduced, weight, residual):
        """How noise and attacks move the first state: lead, gain, pulled, whether it is known."""
        loose = problem.seen & ~problem.trusted
        if self.norm == "l1":
            sd = problem.laid.law.sd
            far = loose & (jnp.abs(residual) > FAR * sd)
            gain, known = of_signs(rows, weight, sd, far)
            pulled = gain @ jnp.where(far, jnp.sign(residual), 0.0)
            return rows.lead, jnp.where(far, 0.0, gain), pulled, known
        lead, pulled, known = _per_group(problem, rows, weight, residual, self.window.length)
        return lead, jnp.zeros_like(lead), pulled, known & (self.norm == "l1l2")

    def _fewest(self, problem: Problem, sd, weight) -> Decoded:
        Phi, target = problem.laid.Phi, problem.target
        units = range(len(Phi)) if self.positions == "hopping" else self._sensors()
        found = l0_regression(
            Phi, target, tuple(units), self.threshold * sd, problem.seen, problem.trusted,
            states=LISTED, nodes=self.nodes,
        )  # fmt: skip
        several = jnp.where(found.found > 1, int(Status.AMBIGUOUS), 0)
        proved = found.feasible & found.complete & (found.lower == found.count)
        status = several | jnp.where(proved, 0, int(Status.NOT_CONVERGED))
        kept = problem.seen & ~found.thrown
        rows = reduced(Phi, target, weight, kept)
        zero = jnp.zeros_like(rows.lead)
        gap = (found.count - found.lower) / jnp.maximum(found.count, 1)
        return Decoded(
            found.x, found.states, _integer(found.found), _integer(found.count), gap, rows,
            rows.lead, zero, jnp.zeros(Phi.shape[1]), found.feasible, status,
        )  # fmt: skip

    def _lost(self, last, rows: Reduced):
        """Which states at the last row are not determined, and the status for it."""
        reach = jnp.abs(last @ rows.hidden)
        most = jnp.abs(last) @ jnp.abs(rows.hidden)
        lost = jnp.any(reach > HIDDEN * most, 1)
        return lost, jnp.where(jnp.any(lost), int(Status.UNOBSERVABLE), 0)

    def _errors(self, problem: Problem, found: Decoded, lost):
        laid, p = problem.laid, len(self.plant.outputs)
        loose = problem.trusted & problem.seen

        def after_exact():
            own = jnp.eye(len(laid.Phi)) - laid.Phi @ found.lead
            return signs(own @ laid.noise.cov @ own.T)

        law = laid.law
        if self.norm == "l1":
            law = jax.lax.cond(jnp.any(loose), after_exact, lambda: laid.law)
        said = errors(laid.Phi, laid.last, laid.noise, law, found.lead, found.gain, found.pulled, p)
        lost = lost | ~found.known
        x_cov = jnp.where(lost[:, None] | lost, 0.0, said.x)
        x_cov = x_cov + jnp.diag(jnp.where(lost, jnp.inf, 0.0))
        return x_cov, jnp.where(jnp.any(lost), 0.0, said.residual)


def _integer(value) -> Int[Array, ""]:
    return jnp.asarray(value, jnp.int32)


def _per_group(problem: Problem, rows: Reduced, weight, residual, length: int):
    """Of a sum of 2-norms: it is least squares with every group divided by its own norm."""
    p = len(residual) // length
    loose = problem.seen & ~problem.trusted
    size = jnp.where(loose, weight * residual, 0.0).reshape(length, p)
    usual = jnp.where(loose, weight * problem.laid.law.sd, 0.0).reshape(length, p)
    norm, noise = (jnp.sqrt(jnp.sum(part * part, 0)) for part in (size, usual))
    far = jnp.tile(norm > FAR * noise, length)
    norm = jnp.tile(jnp.maximum(norm, 0.1 * noise), length)
    share = jnp.where(norm > 0, 1.0 / jnp.where(norm > 0, norm, 1.0), 0.0)
    found, known = influence(rows, jnp.where(far, 0.0, share))
    gain = found * (share * weight)
    pulled = gain @ jnp.where(far & loose, residual, 0.0)
    gain = jnp.where(far, 0.0, gain)
    return rows.lead + gain - gain @ (problem.laid.Phi @ rows.lead), pulled, known


def build(
    plant: LinearPlant,
    x0=None,
    P0=None,
    *,
    window: int | None = None,
    weights: Weights = "none",
    threshold: float = 0.0,
    norm: Norm = "l1",
    positions: Positions | None = None,
    trusted: Sequence[str] = (),
    nodes: int = 2000,
) -> L1Decoder:
    """The decoder over the last ``window`` rows (as many as there are states, unless told).

    ``x0``, ``P0`` (zero and the identity, unless told) are what is said before the first row.
    ``norm``: "l1", for attacks that hop between sensors; "l1l2" and "l1linf", a norm per sensor
    over the window, for attacked sensors that stay the same; "l0", the exact search for the
    fewest attacked samples (``positions`` "hopping", the default) or sensors ("fixed"), of at
    most ``nodes`` branches a row. ``weights``: "none", or "noise": one over the standard
    deviation that Q and R give a sample as a statement on the current state. ``threshold``: in
    standard deviations of v; what a sample is off by less is no attack (and, for "l0", no
    contradiction: with 0 it is any difference above rounding). ``trusted``: outputs that are
    always authenticated, beside what the log says; they are met first.

    Raises `InvalidValue` for what cannot be, naming the key.
    """
    check_decoder(plant, window, weights, threshold, norm, positions, nodes)
    n = len(plant.states)
    rows = decoder_window(plant, n if window is None else window, honest(plant, trusted))
    if rows.laid is not None and not np.all(np.isfinite(np.asarray(rows.laid.noise.cov))):
        raise InvalidValue("window", window, "a window in which A's powers stay finite")
    x0 = jnp.zeros(n) if x0 is None else jnp.asarray(x0, float)
    P0 = jnp.eye(n) if P0 is None else jnp.asarray(P0, float)
    return L1Decoder(
        plant, rows, x0, P0, jnp.asarray(threshold, float), norm, weights,
        positions or "hopping", int(nodes),
    )  # fmt: skip
