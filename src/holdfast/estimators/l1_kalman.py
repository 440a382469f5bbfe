"""A Kalman filter on samples that a decoder has cleaned.

e = what the decoder says the row's samples are off by, where that is over a threshold; the filter
takes y - e (the paper's), or leaves these samples out, or takes them with e^2 more variance.

With no threshold y - e is C x of the decoder: the filter then filters the decoder's own answer
once more. A threshold of some standard deviations of v leaves honest samples as they are.

Source: DECODER, Algorithm 1 and (14).
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from holdfast.estimators.decoder_keys import SUSPECTS, Norm, Positions, Suspects, Weights
from holdfast.estimators.kalman import KalmanState, correct
from holdfast.estimators.l1_decoder import DecoderState, L1Decoder
from holdfast.estimators.l1_decoder import build as decoder
from holdfast.numerics.blue import whitener
from holdfast.numerics.linalg import dot, sandwich
from holdfast.parts import Estimator, InvalidValue, step_zero
from holdfast.plants.linear import LinearPlant
from holdfast.records import Estimate, Observation, Status


class L1KalmanState(eqx.Module):
    """The filter's state, and the decoder's (`holdfast.estimators.l1_decoder.DecoderState`)."""

    filter: KalmanState
    decoder: DecoderState


class L1Kalman(Estimator):
    """The filter of the module.

    x and its covariance are the filter's; ``residual``: the innovation of the samples as they
    came, so that a detector sees the attack; ``a``: e. Until the window is full e = 0, and the
    row is NOT_READY: nothing protects it. The covariance does not know of attacks that the
    decoder has missed; with ``suspects`` "subtract" it takes y - e for as good as y.
    """

    plant: LinearPlant
    decoder: L1Decoder
    x0: Float[Array, " n"]
    P0: Float[Array, "n n"]
    suspects: Suspects = eqx.field(static=True)

    def init(self) -> tuple[L1KalmanState, Estimate]:
        """The estimate one sample before the first row."""
        p = len(self.plant.outputs)
        nothing = jnp.zeros(p), jnp.zeros((p, p)), 0
        first = Estimate.without_attack(self.x0, self.P0, *nothing, a=jnp.zeros(p))
        inside = KalmanState(step_zero(), self.x0, self.P0)
        return L1KalmanState(inside, self.decoder.init()[0]), first

    def step(
        self, state: L1KalmanState, observation: Observation
    ) -> tuple[L1KalmanState, Estimate]:
        """One row: decoded, cleaned, filtered."""
        k, u = state.filter.k + 1, observation.u
        # scheduled plants: both go by the filter's state
        decoding = eqx.tree_at(lambda s: s.x, state.decoder, state.filter.x)
        decoding, said = self.decoder.step(decoding, observation)
        m = self.plant.at(k, state.filter.x, u)
        x = dot(m.A, state.filter.x) + dot(m.B, u)
        P = sandwich(m.A, state.filter.P) + m.Q
        m = self.plant.at(k, x, u)
        expected = dot(m.C, x) + dot(m.D, u)
        e = jnp.zeros_like(observation.y) if said.a is None else said.a
        seen, y, R = observation.seen, observation.y, m.R
        if self.suspects == "gate":
            seen = seen & (e == 0)
        elif self.suspects == "subtract":
            y = y - e
        else:
            R = R + jnp.diag(e * e)
        cleaned = Observation(u, y, seen, observation.trusted, observation.status)
        W = self._whiten(R, seen, e)
        after, estimate = correct(KalmanState(k, x, P), m.C, R, W, y - expected, cleaned)
        came = observation.seen[:, None] & observation.seen
        passed = int(Status.NOT_READY | Status.NOT_CONVERGED | Status.AMBIGUOUS)
        return L1KalmanState(after, decoding), Estimate.without_attack(
            estimate.x,
            estimate.x_cov,
            jnp.where(observation.seen, observation.y - expected, 0.0),
            jnp.where(came, sandwich(m.C, P) + m.R, 0.0),
            observation.status | (said.status & passed),
            a=e,
        )

    def _whiten(self, R, seen, e) -> Float[Array, "ny ny"]:
        if self.suspects != "inflate":
            return self.plant.whiten(R, seen)[0]
        return jax.lax.cond(
            jnp.any(e != 0), lambda: whitener(R, seen)[0], lambda: self.plant.whiten(R, seen)[0]
        )


def build(
    plant: LinearPlant,
    x0,
    P0,
    *,
    window: int | None = None,
    weights: Weights = "none",
    threshold: float = 0.0,
    norm: Norm = "l1",
    positions: Positions | None = None,
    trusted: Sequence[str] = (),
    nodes: int = 2000,
    suspects: Suspects = "subtract",
) -> L1Kalman:
    """The filter from ``x0``, ``P0`` before the first row, its samples cleaned by a decoder.

    ``suspects``: what becomes of samples that are off by more than ``threshold`` standard
    deviations of v: "subtract" what they are off by (the paper's), "gate" them, or "inflate"
    their variance. ``threshold`` 0 is the paper's raw form; 5 is a sound one. The other keys are
    those of `l1_decoder`.

    Raises `InvalidValue` for what cannot be, naming the key.
    """
    if suspects not in SUSPECTS:
        raise InvalidValue("suspects", repr(suspects), " or ".join(map(repr, SUSPECTS)))
    found = decoder(
        plant, x0, P0, window=window, weights=weights, threshold=threshold, norm=norm,
        positions=positions, trusted=trusted, nodes=nodes,
    )  # fmt: skip
    return L1Kalman(plant, found, found.x0, found.P0, suspects)
