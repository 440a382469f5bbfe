"""DECODER's statements on isometry and on the design of a decoder (Sections II-B and IV)."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.random import default_rng

from holdfast.papers.decoder_coding import (
    EXACT,
    KINDS,
    SENSORS,
    Curve,
    N,
    chance,
    decoded,
    limit,
    limit_ideal,
    systems,
)
from holdfast.papers.decoder_counting import ZERO
from holdfast.papers.rows import Row, claim, claim_over_seeds
from holdfast.plants.library import random_systems
from holdfast.plants.library.random_systems import Systems

P = 10
CODED = 20
"""Matrices whose isometry is computed."""


class Isometry(NamedTuple):
    """``Phi`` and the restricted isometry constants of Q2' of orders 1, 2, 3 (matrices x 3)."""

    Phi: np.ndarray
    delta: np.ndarray

    @property
    def met(self) -> np.ndarray:
        """delta_1 + delta_2 + delta_3 < 1."""
        return np.sum(self.delta, 1) < 1.0


def isometry(kind: str, count: int = CODED) -> Isometry:
    """Of systems of Fig. 1, exactly: by all sets of columns."""
    Phi = systems(default_rng(9), kind, count, P)
    return Isometry(Phi, np.array([_constants(one) for one in Phi]))


def _constants(Phi: np.ndarray) -> list[float]:
    """Q2' is scaled so that the constant of order 3 is as small as it can be."""
    Q1 = np.linalg.qr(Phi)[0]
    gram, ends = np.eye(len(Phi)) - Q1 @ Q1.T, []
    for s in (1, 2, 3):
        sets = np.array(list(itertools.combinations(range(len(Phi)), s)))
        values = np.linalg.eigvalsh(gram[sets[:, :, None], sets[:, None, :]])
        ends.append((float(np.min(values)), float(np.max(values))))
    scale = 2.0 / sum(ends[-1])
    return [max(1.0 - scale * low, scale * high - 1.0) for low, high in ends]


def one_attack(found: Isometry) -> Row:
    """Every single attacked sample of every matrix with an isometry of order 1."""
    Phi = found.Phi[found.met][:2]
    rows, wrong = P * N, 0
    for one in Phi:
        E = 3.0 * np.eye(rows)
        off = decoded(np.broadcast_to(one, (rows, *one.shape)), one @ np.ones(N) + E)[1] - E
        wrong += int(np.sum(np.linalg.norm(off, axis=1) > 3.0 * EXACT))
    return claim(
        "Section II-B, l0 and l1", "are one where the isometry is good: matrices with d_1 + d_2 + "
        "d_3 < 1, single attacks decoded by (12), wrong", ["-", "-", 0],
        [int(np.sum(found.met)), len(Phi) * rows, wrong], wrong == 0 and len(Phi) > 0,
        "Candes and Tao's condition for one attack. [25] to [28] (2002 to 2004), which the paper "
        "names, are about coherence: the isometry is from [2] (2005).",
    )  # fmt: skip


def random_matrices(found: dict[str, Isometry]) -> Row:
    """How many matrices of each kind have it."""
    share = [float(np.mean(found[kind].met)) for kind in KINDS]
    return claim(
        "Section IV, isometry", "random coding matrices have it, Phi of a plant cannot be so "
        "chosen: share with d_1 + d_2 + d_3 < 1, ideal, designed, poor", "ideal most", share,
        share[0] == max(share) > max(share[1:]),
        "Order 1 alone, 80 x 8, 20 of each: the designed plants of Fig. 1 have not even that, and "
        "decode. It is enough, not needed.",
    )  # fmt: skip


def constants(found: dict[str, Isometry]) -> Row:
    """Which way they go."""
    mean = [float(np.mean(found[kind].delta[:, 1])) for kind in KINDS]
    return claim(
        "Section IV-B, restricted isometry constants", "\"larger constants correspond to better "
        "RIP\": those of order 2, ideal, designed, poor, from best to worst", "fall", mean,
        mean[0] > mean[1] > mean[2], "Smaller ones are better.",
    )  # fmt: skip


def condition_5(count: int = 200, *, poor: Callable[..., Systems] = random_systems.poor) -> Row:
    """The least |supp(C v)| of the designed and of the poorly designed systems."""
    least = []
    for build in (random_systems.designed, poor):
        found = build(default_rng(10), count, N, P)
        seen = np.abs(found.C @ np.linalg.eig(found.A)[1])
        counted = np.sum(seen > ZERO * np.max(seen, 1, keepdims=True), 1)
        least.append(int(np.min(counted)))
    return claim(
        "Section IV-A, condition 5", "|supp(C v)| tells designed feedback from poor: its least on "
        "the designed and on the poor systems of Fig. 1", "larger, smaller", least,
        least[0] > least[1],
        "Every sensor sees every mode of a plant without zeros in it, whatever the feedback; what "
        "differs is how well. The l1 decoder's certainty is a matter of sizes.",
    )  # fmt: skip


def poles(found: Curve, far: np.ndarray) -> Row:
    """Success at S = 32 with poles .5 to .95, and with poles .1 to .9."""
    near = found.at("designed", 32)
    return claim_over_seeds(
        "Section IV-A, poles", "nearer to the origin and more spread out is better: success at p = "
        "10, S = 32 with poles .5 to .95, with .1 to .9", "rises", np.stack([near, far], 1),
        far.mean() > near.mean() + 3.0 * chance(np.stack([near, far])),
        "Later samples of a fast mode are as good as zero. The optimal poles, which decode worst, "
        "are nearer still (largest modulus .36 in the median).",
    )  # fmt: skip


def window_of_n(found: dict[int, Curve], least: float = 0.8) -> Row:
    """Success just below T q_max with T = n."""
    shown = np.stack([found[p].at("designed", limit(p) - 1) for p in SENSORS], 1)
    return claim_over_seeds(
        "Section IV-B, T = n", "is often enough: success of the designed feedback at S = T q_max - "
        "1, p = 8, 10, 12", f"> {least:g}", shown, bool(np.all(shown.mean(0) > least)),
        "Attacked at random. Not for every attack: Section IV-B, relaxing T.",
    )  # fmt: skip


def window_for_certain(count: int = 500, sensors: tuple[int, ...] = SENSORS) -> Row:
    """A state that is missed by the sensors of one state at n - 1 steps: too few see it for l0?"""
    share = []
    for p in sensors:
        C = random_systems.designed(default_rng(11), count, N, p).C
        same = np.max(np.sum(C != 0, 1), 1)
        # z misses that state at n - 1 steps, hence so many samples
        seen = p * N - (N - 1) * same
        share.append(float(np.mean(seen <= 2 * limit(p))))
    return claim(
        "Section IV-B, relaxing T", "T = n is enough for q_max: share of the designed systems in "
        "which some attack beats l0 itself, p = 8, 10, 12", 0.0, share, max(share) == 0.0,
        "A state measured by m sensors can be 0 at n - 1 steps: at most pn - (n - 1) m samples see "
        "it, to be over 2 n q_max, although pT - n >= 2 q_max T as (9) asks. Attacks at random "
        "never find that.",
    )  # fmt: skip


def lines(found: dict[int, Curve], p: int = 10) -> Row:
    """Success beyond the lines that Fig. 1 draws, at the first S after each."""
    curve, shown = found[p], []
    for kind, at in (("designed", limit(p)), ("ideal", limit_ideal(p))):
        S = min(int(S) for S in curve.S if at < S)
        shown.append(curve.at(kind, S))
    both = np.stack(shown, 1)
    return claim_over_seeds(
        "Section IV-B, fundamental limits", "they are those of the l1 decoder: success at p = 10 "
        "beyond them, designed feedback at S = 34, ideal coding at S = 40", 0.0, both,
        float(both.mean(0).max()) < 0.05,
        "They limit what l0 is certain of against every attack. l1 is certain of less "
        "(Proposition 4, decoder (12)), and attacks at random are corrected beyond.",
    )  # fmt: skip


def imu_and_gps(dt: float = 0.1, coupled: bool = False) -> Row:
    """The largest q for which the state is determined without any 2 q sensors."""
    A = np.block([[np.eye(3), dt * np.eye(3)], [np.zeros((3, 3)), np.eye(3)]])
    gps, imu = np.eye(6)[:3], np.eye(6)[3:]
    if coupled:
        V = default_rng(12).standard_normal((6, 6))
        A = V @ np.diag(np.linspace(0.4, 0.9, 6)) @ np.linalg.inv(V)
    q = [_without(A, C) for C in (gps, np.vstack([imu, gps]))]
    return claim(
        "Section IV-B, IMU and GPS", "C = [C_IMU; C_GPS] lets more attacks be corrected than GPS "
        "alone: q of GPS, of both", "larger", q, q[1] > q[0],
        "A position is seen by its own sensor alone: double integrators, with feedback along each "
        "axis too. Feedback that couples the axes gives q = 1 and 2. Fixed sensors, T = n: more "
        "is not possible with changing ones.",
    )  # fmt: skip


def _without(A: np.ndarray, C: np.ndarray) -> int:
    """By ranks."""
    n, p = len(A), len(C)
    rows = np.stack([C @ np.linalg.matrix_power(A, t) for t in range(n)])
    for q in range(1, p):
        for lost in itertools.combinations(range(p), min(2 * q, p)):
            left = np.delete(rows, lost, axis=1).reshape(-1, n)
            if not left.size or np.linalg.matrix_rank(left, tol=1e-9) < n:
                return q - 1
    return p - 1
