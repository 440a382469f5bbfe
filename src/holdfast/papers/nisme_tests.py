"""NISME's mode probabilities and tests judged: line 15 of Algorithm 1, Algorithms 2 and 4."""

import numpy as np
from numpy.random import default_rng
from scipy.special import chdtrc, chdtri, ndtr, ndtri

from holdfast.papers.nisme_filter import some
from holdfast.papers.nisme_systems import EPSILON, Data, System, gap, nise
from holdfast.papers.rows import Row, claim

UNITS = (1e-3, 1.0, 1e3)
"""Units of the outputs, in which they are that many times as large."""
SENSOR_SD = 1.27e-4
"""Of the sensor-attack estimate on the 68-bus network (erratum 11)."""


def log_normal(v: np.ndarray, cov: np.ndarray) -> float:
    """The log of N(v; 0, cov)."""
    size = np.linalg.slogdet(2.0 * np.pi * cov)[1]
    return float(-0.5 * (size + v @ np.linalg.solve(cov, v)))


def modes(s: System) -> list[System]:
    """No attack, and each channel alone."""
    nd = s.G.shape[1]
    return [s._replace(G=s.G[:, [*on]], H=s.H[:, [*on]]) for on in ([], *([i] for i in range(nd)))]


def rescaled(s: System, data: Data, unit: float) -> tuple[System, Data]:
    """The outputs in another unit."""
    one = s._replace(C=unit * s.C, D=unit * s.D, H=unit * s.H, R=unit**2 * s.R)
    return one, data._replace(y=unit * data.y)


def printed(s: System, data: Data) -> float:
    """The log of line 15."""
    a = nise(s, data)
    T3 = a.split.T[2]
    nu = T3 @ (data.y[-1] - s.C[-1] @ a.predicted - s.D @ data.u[-1])
    return log_normal(nu, T3 @ (s.C[-1] @ a.P_pred @ s.C[-1].T + s.R) @ T3.T)


def _innovation(s: System, data: Data) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """y_k less its mean before d_(2,k-1) and d_(1,k), its covariance, and what those two add."""
    before = nise(s, data._replace(u=data.u[:-1], y=data.y[:-1]))
    C, now = s.C[-1], nise(s, data).split
    M1, T1 = np.linalg.inv(now.H1), before.split.T[0]
    G1, G2 = s.G @ now.V1, s.G @ now.V2 @ now.Vbar
    x = s.F @ before.x + EPSILON * (s.B @ data.u[-2] + G1 @ before.d1)
    move = s.F - EPSILON * G1 @ M1 @ T1 @ s.C[-2]
    E = move @ before.P @ move.T
    E = E + EPSILON**2 * (s.Q + G1 @ M1 @ T1 @ s.R @ T1.T @ M1.T @ G1.T)
    added = np.hstack([EPSILON * C @ G2, s.H @ now.V1])
    return data.y[-1] - C @ x - s.D @ data.u[-1], C @ E @ C.T + s.R, added


def evidence(s: System, data: Data, prior: float = 1.0) -> float:
    """The log of N(nu; 0, S + F D F'), d ~ N(0, D) with D = ``prior`` I."""
    nu, S, F = _innovation(s, data)
    return log_normal(nu, S + prior * F @ F.T)


def in_parts(s: System, data: Data, prior: float = 1.0) -> float:
    """The log of line 15, of the Jacobian and of the density of d^ under its prior (erratum 5)."""
    nu, S, F = _innovation(s, data)
    told = F.T @ np.linalg.solve(S, F)
    cov = np.linalg.inv(told)
    d = cov @ F.T @ np.linalg.solve(S, nu)
    now = nise(s, data).split
    sizes = np.concatenate([np.diag(now.H1), EPSILON * np.diag(now.Sbar)])
    value = printed(s, data) - float(np.sum(np.log(sizes)))
    return value + log_normal(d, prior * np.eye(len(d)) + cov)


def line_15(
    corrected: bool = False,
    units: tuple[float, ...] = UNITS,
    count: int = 10,
    by_unit: float = 0.0,
) -> Row:
    """Whether the likeliest of the modes changes when y is given in another unit.

    ``by_unit``: the power of the unit with which the attack's prior grows, wrongly.
    """
    changed = 0
    for s, data in some(count, attack=0.0, size=(3, 5, 3, 1)):
        winners = set()
        for unit in units:
            of = [rescaled(mode, data, unit) for mode in modes(s)]
            prior = unit**by_unit
            scores = [evidence(*one, prior) if corrected else printed(*one) for one in of]
            winners.add(int(np.argmax(scores)))
        changed += len(winners) > 1
    nats = -0.5 * np.log(2.0 * np.pi * np.e * SENSOR_SD**2)
    says = ", evidence" if corrected else ""
    return claim(
        f"Algorithm 1, line 15{says}", f"the likeliest mode{' by evidence' if corrected else ''} "
        f"does not depend on the unit of the outputs: changes on {count} systems", 0, changed,
        changed == 0,
        "" if corrected else "Densities over spaces of different dimension: each dimension that "
        f"a mode drops costs it {nats:.1f} nats a step where the sd is {SENSOR_SD:g}.",
    )  # fmt: skip


def line_15_density(size: tuple[int, int, int, int] = (3, 5, 3, 1), attacked: bool = True) -> Row:
    """The log of line 15 against log P(y_k | mode, y_0 .. y_(k-1)), Section 8.2."""
    off = 0.0
    for s, data in some(size=size):
        one = s if attacked else modes(s)[0]
        off = max(off, abs(printed(one, data) - evidence(one, data)))
    return claim(
        "Section 8.2, N_k^j", "line 15 is P(y_k | j true): largest difference in nats from the "
        "density of y_k, d ~ N(0, I)", 0.0, off, off < 1e-8,
        "It is where the mode has no attack.",
    )  # fmt: skip


def line_15_parts(off: float = 0.0) -> Row:
    """Erratum 5's three terms against the density of y_k."""
    worst = 0.0
    for s, data in some(size=(4, 6, 4, 2)):
        worst = max(worst, gap(np.array([in_parts(s, data) + off]), np.array([evidence(s, data)])))
    return claim(
        "Section 8.2, N_k^j, with a prior", "log N - log |Sigma| - log |eps Sigmabar| + "
        "log N(d^; 0, D + P^d) is log P(y_k | j), d ~ N(0, D): distance", 0.0, worst, worst < 1e-8,
    )  # fmt: skip


def floor(
    corrected: bool = False, delta: float = 0.033, count: int = 4, floored: bool = True
) -> Row:
    """The least probability after lines 7 and 10, one mode certain."""
    mu = np.maximum(np.eye(count)[0], delta if floored else 0.0)
    least = float(np.min(mu / np.sum(mu)))
    bound = delta / (1.0 + (count - 1) * delta) if corrected else delta
    says = "delta / (1 + (|M| - 1) delta)" if corrected else "delta"
    return claim(
        f"Algorithm 2, line 10, {says}", f"no probability is under {says}: the least of "
        f"{count} modes, delta = {delta:g}", bound, least, least >= bound - 1e-12,
        "" if corrected else "Normalised after the floor.",
    )  # fmt: skip


def empty(corrected: bool = False, sensors: int = 0, statistic: float = 0.0) -> Row:
    """Line 14 in a mode of actuators alone (d_1 empty), its d_2 estimated as exactly 0."""
    statistics, dofs = (0.0, statistic), (sensors, 3)
    limits = [float(chdtri(dof, 0.25)) if dof else 0.0 for dof in dofs]
    pairs = list(zip(statistics, limits, strict=True))
    passes = all(a <= b if corrected else a < b for a, b in pairs)
    sign = "<=" if corrected else "<"
    return claim(
        f"Algorithm 2, line 14, {sign}", f"a mode of actuators alone, d^_2 = 0, is taken as free "
        f"of attack by {sign}: statistic and limit of d_1", [0.0, "> 0"], list(pairs[0]), passes,
        "" if corrected else "An empty d_1 gives 0 < 0: mode 2 can never be found free of attack.",
    )  # fmt: skip


def levels(
    algorithm: str, level: float, dof: int | None, value: float, confidence: bool = False
) -> Row:
    """A paper's quantile beside that of the level as it is called."""
    tail = 1.0 - level if confidence else level
    found = float(-ndtri(tail / 2.0) if dof is None else chdtri(dof, tail))
    called = "confidence" if confidence else "significance"
    test = "two-sided z" if dof is None else f"chi-square, {dof} degrees of freedom"
    return claim(
        f"{algorithm}, {called} level", f"the limit of the {test} at {called} level {level:g}",
        value, found, abs(found - value) < 0.005,
    )  # fmt: skip


def afterthought(limit: float = 4.11, dof: int = 3, wanted: float = 0.9) -> Row:
    """How often line 14 passes where nobody attacks: the mode believed has three channels."""
    passes = float(1.0 - chdtrc(dof, limit))
    return claim(
        "Algorithm 2, line 14, no attack", "where the mode believed is right but for d = 0, the "
        f"attack-free mode is found: share of steps, limit {limit:g}", f">= {wanted}", passes,
        passes >= wanted,
        "The attack-free hypothesis as a mode of the bank needs no test.",
    )  # fmt: skip


def six_tests(limit: float = 1.28, count: int = 6, wanted: float = 0.9) -> Row:
    """The probability that no z-test of six alarms where nobody attacks."""
    each = float(2.0 * ndtr(limit) - 1.0)
    return claim(
        "Algorithm 4, six tests", f"with z = {limit:g} the attack-free mode is found where nobody "
        "attacks, as Fig. 6 shows after 30 s: share of steps", f">= {wanted}", each**count,
        each**count >= wanted,
        "Six independent tests of a fifth each. The level must be a budget over all channels.",
    )  # fmt: skip


def named(corrected: bool = False, turned: float = np.pi / 4, attacked: float = 10.0) -> Row:
    """Algorithm 4 with two singular vectors of H = I, which any rotation of them is as well.

    The first sensor is ``attacked`` by so many standard deviations, the second is not.
    """
    c, s = np.cos(turned), np.sin(turned)
    found, estimate, H = [], np.array([attacked, 0.3]), np.eye(2)
    for V1 in (np.eye(2), np.array([[c, -s], [s, c]])):
        assert np.allclose(H, (H @ V1) @ np.eye(2) @ V1.T)
        d1 = V1.T @ estimate
        tested = V1 @ d1 if corrected else d1
        found.append([int(i) + 1 for i in np.flatnonzero(np.abs(tested) > 2.58)])
    says = "V_1 d_1 + V_2 d_2" if corrected else "d_1(l_1)"
    return claim(
        f"Algorithm 4, {says}", f"tests on {says} name the same sensors whichever singular vectors "
        "of H = I are taken: sensor 1 attacked, two choices", [[1], [1]], found,
        found == [[1], [1]],
        "" if corrected else "H has ones and zeros: its singular values repeat, and the basis of "
        "d_1 is arbitrary.",
    )  # fmt: skip


def chi_square_of_d(count: int = 20_000, factor: float = 1.0) -> Row:
    """The statistics of line 14 under H_0: their mean over their number of degrees of freedom."""
    s, data = some(1, size=(4, 6, 4, 2))[0]
    a, rng = nise(s, data), default_rng(3)
    draws = rng.multivariate_normal(np.zeros(len(a.P2)), factor * a.P2, count)
    mean = float(np.mean(np.einsum("ki,ij,kj->k", draws, np.linalg.inv(a.P2), draws)))
    spread = len(a.P2) * float(np.sqrt(2.0 / (len(a.P2) * count)))
    return claim(
        "Algorithm 2, line 14", "d^' (P^d)^-1 d^ is chi-square with |d| degrees of freedom where "
        "nobody attacks: mean of its draws", len(a.P2), mean, abs(mean - len(a.P2)) < 4 * spread,
    )  # fmt: skip
