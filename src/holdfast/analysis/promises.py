"""What an estimator promises under an attack on given channels, however large: in numbers.

The root mean square error of each state at every row, from the plant and the channels alone:

* a filter of a linear plant whose attack estimate has every channel hit: just what its own
  covariance says, whatever the attack (`decoupled`);
* the l1 decoder and the LASSO fusion: a bound. Let h = M z, z the error of the estimate, M the
  regression's matrix (in the weights of its norm), S the rows that may be false, e the noise, c
  what the penalised problem loses to the norm alone (0 for the decoder, gamma / 2 times the
  largest s' W s over |s| <= 1 for the fusion). The minimiser is no worse than the truth, so

      sum over the rest of |h|  -  sum over S of |h|   <=   2 sum over the rest of |e|  +  c

  whatever stands in S, and with the worst ratio kappa < 1 of the two sums

      |z_i|  <=  m_i (2 sum over the rest of |e| + c) / (1 - kappa),

  m_i the largest z_i where the rest's sum of |M z| is 1 (a linear program).

Source: DECODER Section III-E, DECOMPOSE Theorem 4, made quantitative (derivation above).
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog

from holdfast.analysis.correctable import correctable
from holdfast.analysis.fusion import CERTAIN
from holdfast.analysis.model import Model
from holdfast.estimators.decoder_window import Laid
from holdfast.numerics.local import Local
from holdfast.numerics.rays import components, worst


class Hit(NamedTuple):
    """Channels that an attack may use: masks of inputs, outputs and attack channels.

    ``at_once``: outputs hit in one row, where others are hit at every step; None where all of
    them may be.
    """

    inputs: np.ndarray
    outputs: np.ndarray
    attacks: np.ndarray
    at_once: int | None = None

    @property
    def sensors_only(self) -> bool:
        """Whether nothing but outputs is hit."""
        return not (self.inputs.any() or self.attacks.any())


def decoupled(model: Model, B: np.ndarray, D: np.ndarray, hit: Hit, active: np.ndarray) -> bool:
    """Whether the channels ``active`` (nd,) can say all that the channels hit can do.

    B (n x nu) and D (m x nu) are those of the inputs. An input acts on the state and on the
    output of its own row, an attack channel on the output of its row and on the next state:
    where both are different the two are not the same signal.
    """
    m, n = model.C.shape
    ours = np.vstack([model.H, model.G])[:, active]
    straight = np.vstack([np.eye(m), np.zeros((n, m))])[:, hit.outputs]
    through = np.vstack([np.zeros_like(D), B])[:, hit.inputs]
    if np.any(D[:, hit.inputs]):
        return False
    theirs = np.hstack([straight, through, np.vstack([model.H, model.G])[:, hit.attacks]])
    if not theirs.size:
        return True
    if not ours.size:
        return not np.any(theirs)
    left = theirs - ours @ np.linalg.lstsq(ours, theirs, rcond=None)[0]
    return bool(np.max(np.abs(left)) <= 1e-9 * np.max(np.abs(theirs)))


def of_decoder(model: Model, laid: Laid, weighted: bool, hit: Hit) -> np.ndarray:
    """The bound (n,) of the l1 decoder with the window ``laid`` out; inf where there is none."""
    Phi, last = np.asarray(laid.Phi), np.asarray(laid.last)
    weight = np.ones(len(Phi))
    if weighted:
        sd = np.asarray(laid.law.sd)
        weight = np.where(sd > 0, 1.0 / np.where(sd > 0, sd, 1.0), 0.0)
    m = len(model.C)
    window = len(Phi) // m
    noise = weight[:, None] * np.asarray(laid.noise.cov) * weight
    extra = np.sqrt(np.diagonal(np.asarray(laid.noise.extra)))
    M = weight[:, None] * Phi
    if not hit.sensors_only:
        return np.full(len(last), np.inf)
    if hit.at_once is None:
        rows = np.tile(hit.outputs, window)
        bound = _bound(M, noise, last, rows, _ratio(M, rows), 0.0)
    else:
        found = correctable(model, window, weight=weight.reshape(window, m) if weighted else None)
        few = hit.at_once <= len(found.upper)
        ratio = float(found.upper[hit.at_once - 1]) if few else np.inf
        # which rows are false is not known: all may be, and (1 + kappa) counts those that are
        nobody = np.zeros(len(M), bool)
        bound = (1.0 + ratio) * _bound(M, noise, last, nobody, ratio, 0.0)
    return bound + extra


def of_fusion(local: Local, gamma: float, hit: Hit) -> np.ndarray:
    """The bound (n,) of the LASSO fusion with the penalty ``gamma``; inf where there is none.

    In the paper's coordinates, a complex one being a pair of rows of which the modulus counts.
    """
    n, d = local.G.shape[1], len(local.b)
    if not hit.sensors_only or hit.at_once is not None:
        return np.full(n, np.inf)
    place = np.unique(local.coordinates.group, return_inverse=True)[1]
    turn = local.coordinates.weight[place][:, None] * local.coordinates.rows
    turn = np.kron(np.eye(local.sensors), turn)
    M, W = turn @ local.G, turn @ local.W @ turn.T
    group = np.concatenate([place + i * (place.max() + 1) for i in range(local.sensors)])
    rows = np.repeat(hit.outputs, d)
    # gamma |r| - (what the penalised problem costs at r) is at most gamma^2 s' W s / 2, |s| <= 1
    member = group == np.unique(group)[:, None]
    sizes = [[np.linalg.norm(W[np.ix_(a, b)], 2) for b in member] for a in member]
    lost = 0.5 * gamma * float(np.sum(sizes))
    return _bound(M, W, np.eye(n), rows, _ratio(M, rows, group), lost, group)


def _ratio(M: np.ndarray, rows: np.ndarray, group: np.ndarray | None = None) -> float:
    """kappa: the worst sum of |M z| over ``rows``, relative to that of all others.

    ``group``: rows with the same number are a pair of which the 2-norm counts.
    """
    inside, outside = M[rows], M[~rows]
    if not len(inside):
        return 0.0
    number = np.arange(len(M)) if group is None else group
    parts = np.zeros((2, len(M), M.shape[1]))
    parts[0, rows], parts[1, ~rows] = inside, outside
    return float(worst(components(parts, number), 2, 1).upper[0])


def _bound(
    M: np.ndarray, noise: np.ndarray, of: np.ndarray, rows: np.ndarray, ratio: float, lost: float,
    group: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """m_i (2 |rest of e| + lost) / (1 - kappa) in the root mean square, for ``of`` (k x n) z."""
    if not ratio < CERTAIN:
        return np.full(len(of), np.inf)
    rest = ~rows
    M, noise = M[rest], noise[np.ix_(rest, rest)]
    # |(a, b)| is at least (|a| + |b|) / sqrt 2, and at most |a| + |b|
    if group is not None:
        M = M / np.sqrt(np.bincount(group)[group[rest]])[:, None]
    size = 2.0 * _size_of_sum(noise) + lost
    return np.array([_largest(M, row) for row in of]) * size / (1.0 - ratio)


def _size_of_sum(cov: np.ndarray) -> float:
    """The root mean square of sum |e_j|, e ~ N(0, cov).

    E |e_i e_j| = 2 / pi (sqrt(1 - r^2) + r asin r) sd_i sd_j for a correlation r.
    """
    sd = np.sqrt(np.diagonal(cov))
    both = np.outer(sd, sd)
    r = np.clip(np.divide(cov, both, out=np.zeros_like(cov), where=both > 0), -1.0, 1.0)
    return float(np.sqrt(np.sum(2.0 / np.pi * (np.sqrt(1.0 - r**2) + r * np.arcsin(r)) * both)))


def _largest(M: np.ndarray, row: np.ndarray) -> float:
    """Max row z over |M z|_1 <= 1, by its dual: min max |y| over M' y = row; inf if unbounded."""
    m = len(M)
    if not m:
        return np.inf if np.any(row) else 0.0
    below = np.hstack([np.vstack([np.eye(m), -np.eye(m)]), -np.ones((2 * m, 1))])
    found = linprog(
        np.append(np.zeros(m), 1.0), A_ub=below, b_ub=np.zeros(2 * m),
        A_eq=np.hstack([M.T, np.zeros((M.shape[1], 1))]), b_eq=row, bounds=[(None, None)] * (m + 1),
    )  # fmt: skip
    return float(found.fun) if found.status == 0 else np.inf
