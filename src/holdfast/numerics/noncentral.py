"""Non-central chi-squares: alarm probabilities under a shift, and the shift that a rise allows.

Everything rests on the rate at which the tail rises with the non-centrality l,

    d/dl P(chi'2_nu(l) > x) = density of chi'2_{nu+2}(l) at x,

which is positive: its integral from 0 is what an attack adds to an alarm probability, with no
difference of two nearly equal probabilities. NumPy on the host, when things are built.
"""

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike
from scipy.special import chdtr, chdtrc, gammaln, ive, ndtri

from holdfast.numerics.chi_square import weighted_rise, weighted_tails
from holdfast.numerics.roots import bracketed_root

NODES = 40
ROWS = 512
KNOTS = 200
NATS = 40.0
LARGE_ORDER = 40.0


def _debye_polynomials(most: int) -> list[np.ndarray]:
    """p_k in t^2 of Debye's u_k(t) = t^k p_k(t^2), by their recursion (DLMF 10.41.9)."""
    t, u, found = Polynomial([0.0, 1.0]), Polynomial([1.0]), []
    for k in range(most):
        found.append(u.coef[k::2])
        u = 0.5 * t**2 * (1 - t**2) * u.deriv() + ((1 - 5 * t**2) * u).integ() / 8
    return found


DEBYE = _debye_polynomials(11)
POINTS, WEIGHTS = np.polynomial.legendre.leggauss(NODES)


def _deviance(t: np.ndarray) -> np.ndarray:
    """The deviance t - log(1 + t), also near 0, where its two parts cancel."""
    r = t / (2.0 + t)
    near = np.abs(r) < 0.05
    s = np.where(near, r * r, 0.0)
    series = 1 / 3 + s * (1 / 5 + s * (1 / 7 + s * (1 / 9 + s * (1 / 11 + s * (1 / 13 + s / 15)))))
    close = t * r - 2.0 * r * s * series
    return close if np.all(near) else np.where(near, close, t - np.log1p(t))


def _log_rate(shift: np.ndarray, a: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Log of d/du P(chi'2_{2a}(2u) > 2y) at u = shift^2 / 2, by rows; 2a >= 1, y > 0.

    The rate is (y/u)^{a/2} e^{-y-u} I_a(2 sqrt(uy)): logs of size a whose sum is of size 1, so
    large orders need a form in which nothing cancels.
    """
    large = a.reshape(-1) >= LARGE_ORDER
    if np.all(large):
        return _large_order(0.5 * shift * shift, a, y)
    found = np.empty(np.shape(shift))
    for rows, form in ((large, _large_order), (~large, _small_order)):
        if np.any(rows):
            found[rows] = form(0.5 * shift[rows] ** 2, a[rows], y[rows])
    return found


def _small_order(u: np.ndarray, a: np.ndarray, y: np.ndarray) -> np.ndarray:
    """`_log_rate` by the Bessel function itself, good to 2e-14, or its series near 0."""
    w = u * y
    series = np.ones_like(w)
    for k in range(5, 0, -1):
        series = 1.0 + series * w / (k * (a + k))
    near = a * np.log(y) - y - u - gammaln(a + 1.0) + np.log(series)
    # the sixth term is below 1e-13, and I_a has not yet underflown
    far = w > 0.02
    w = np.where(far, w, 1.0)
    bessel = a * (np.log(y) - 0.5 * np.log(w)) + np.log(ive(a, 2.0 * np.sqrt(w)))
    return np.where(far, bessel - (np.sqrt(y) - np.sqrt(u)) ** 2, near)


def _large_order(u: np.ndarray, a: np.ndarray, y: np.ndarray) -> np.ndarray:
    """`_log_rate` by Debye's uniform expansion, its exponent gathered in two deviances."""
    ratio = 4.0 * (u / a) * (y / a)
    w = np.sqrt(1.0 + ratio)
    half = 0.5 * ratio / (1.0 + w)
    exponent = u * (y - a - a * half) / (a * (1.0 + half)) + a * _deviance(half)
    t, total = 1.0 / w, np.zeros_like(w)
    t2, ta = t * t, t / a
    terms = int(np.ceil(37.0 / np.log(2.0 * np.min(a)))) + 1
    for p in DEBYE[:terms][::-1]:
        value = np.full_like(w, p[-1])
        for c in p[-2::-1]:
            value = value * t2 + c
        total = total * ta + value
    start = -a * _deviance((y - a) / a) - 0.5 * np.log(2.0 * np.pi * a)
    return start + exponent + np.log(total * np.sqrt(t))


def _cut(
    inner: np.ndarray, outer: np.ndarray, floor: np.ndarray, a: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """``outer``, moved towards ``inner`` to where the log rate is ``floor`` if it is below."""
    outer = outer.copy()
    (low,) = np.nonzero(_log_rate(outer, a, y) < floor)
    if low.size:
        out, near, far = outer[low], inner[low], outer[low]
        for _ in range(40):
            out = 0.5 * (near + far)
            below = _log_rate(out, a[low], y[low]) < floor[low]
            near, far = np.where(below, near, out), np.where(below, out, far)
        outer[low] = far
    return outer


def _log_excess(shift: np.ndarray, dof: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log of the excess at l = shift^2 > 0, and its slope over log shift; rows of one length.

    Gauss-Legendre over the shift, where the rate is a piece of a bell at least 1 wide, cut
    where it is NATS below its top. Rows in order of dof are fastest.
    """
    value, slope = np.empty(len(shift)), np.empty(len(shift))
    for i in range(0, len(shift), ROWS):
        part = slice(i, i + ROWS)
        v, a, y = shift[part], 0.5 * dof[part], 0.5 * x[part]
        # the bell's top, but for terms of relative order 1/a
        top = np.minimum(v, np.sqrt(2.0 * np.maximum(y - a, 0.0)))
        floor = _log_rate(top, a, y) - NATS
        low, high = (_cut(top, end, floor, a, y) for end in (np.zeros_like(v), v))
        half = 0.5 * (high - low)
        at = np.empty((len(v), NODES + 1))
        at[:, :-1] = 0.5 * (high + low)[:, None] + half[:, None] * POINTS
        at[:, -1] = v
        rate = _log_rate(at, a[:, None], y[:, None])
        peak = np.max(rate, axis=1)
        rate = at * np.exp(rate - peak[:, None])
        total = half * (rate[:, :-1] @ WEIGHTS)
        value[part] = np.log(total) + peak
        slope[part] = v * rate[:, -1] / total
    return value, slope


def excess(noncentrality: float, dof: float, threshold: float) -> float:
    """What a non-centrality l adds to a chi-square tail.

    P(chi'2_dof(l) > threshold) - P(chi2_dof > threshold): the integral over the non-centrality
    of the density of chi'2_{dof+2} at the threshold, all positive, to 1e-12 relative.
    ValueError unless l >= 0, dof >= 1, threshold > 0.
    """
    if not 0 <= noncentrality < np.inf:
        raise ValueError(f"a non-centrality is finite and at least 0, not {noncentrality}")
    shift, nu, x = (np.array([v], float) for v in (np.sqrt(noncentrality), dof, threshold))
    _check(nu, x)
    return float(np.exp(_log_excess(shift, nu, x)[0][0])) if noncentrality > 0 else 0.0


def tail(noncentrality: float, dof: float, threshold: float) -> float:
    """P(chi'2_dof(l) > threshold), l the non-centrality: to 1e-12 relative, also near 1e-300.

    Arguments and errors as `excess`.
    """
    return excess(noncentrality, dof, threshold) + float(chdtrc(dof, threshold))


def _check(dof: np.ndarray, threshold: np.ndarray) -> None:
    few = ~((dof >= 1) & (dof < np.inf))
    if np.any(few):
        raise ValueError(f"degrees of freedom are finite and at least 1, not {dof[few][0]}")
    bad = ~((threshold > 0) & (threshold < np.inf))
    if np.any(bad):
        raise ValueError(f"a threshold is positive and finite, not {threshold[bad][0]}")


def _check_rise(epsilon: float, room: float) -> None:
    if not 0 < epsilon < room:
        most = f"less than what it leaves, {room:.6g}"
        raise ValueError(f"an alarm probability rises by more than 0 and {most}, not by {epsilon}")


def _solve(
    epsilon: float, dof: np.ndarray, x: np.ndarray, start: np.ndarray | None = None
) -> np.ndarray:
    """Rows of shifts at which the excess is epsilon: Newton in logarithms, safeguarded."""
    z = -ndtri(chdtr(dof, x) - epsilon)
    # no farther than for the direction of the shift alone: that is one normal variable
    low, high = np.zeros(len(x)), (np.sqrt(x) + z) * (1 + 1e-9) + 1e-9
    if start is None:
        # the normal approximation where it gives a shift, else the slope at 0
        rise = x - dof + 2 * z * (z + np.sqrt(np.maximum(z * z + 0.5 * dof + x - dof, 0.0)))
        flat = -_log_rate(np.zeros(len(x)), 0.5 * dof, 0.5 * x)
        small = 2.0 * epsilon * np.exp(np.minimum(flat, 600.0))
        start = np.sqrt(np.where(rise > 0, np.minimum(rise, small), small))
    v = np.minimum(start, high)
    todo = np.arange(len(x))
    for _ in range(100):
        now = v[todo]
        value, slope = _log_excess(now, dof[todo], x[todo])
        gap = value - np.log(epsilon)
        high[todo] = np.where(gap > 0, now, high[todo])
        low[todo] = np.where(gap > 0, low[todo], now)
        step = -gap / np.maximum(slope, 1e-300)
        new = now * np.exp(np.clip(step, -5.0, 5.0))
        inside = (new >= low[todo]) & (new <= high[todo])
        v[todo] = np.where(inside, new, 0.5 * (low[todo] + high[todo]))
        # Newton squares the error: 1e-6 before the step is 1e-12 after it
        todo = todo[~(inside & (np.abs(step) < 1e-6)) & (high[todo] > low[todo] * (1 + 1e-15))]
        if not todo.size:
            break
    return v


def alpha_chi2(epsilon: float, dof: float, threshold: float) -> float:
    """The largest shift that raises a chi-square test's alarm probability by epsilon at most.

    The alpha with P(chi'2_dof(alpha^2) > threshold) = P(chi2_dof > threshold) + epsilon, to
    1e-10 relative. ValueError unless dof >= 1, threshold > 0 and
    0 < epsilon < P(chi2_dof <= threshold); close to that bound alpha is ill-conditioned.

    Source: Jovanov and Pajic, Relaxing Integrity Requirements, Theorem 1.
    """
    return float(alphas(epsilon, np.array([dof]), np.array([threshold]))[0])


def alphas(epsilon: float, dofs: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """`alpha_chi2` of every pair of ``dofs`` and ``thresholds``, two arrays of one length.

    Long sequences are solved at a few hundred of their dofs first. What is interpolated
    between them only starts Newton's iteration: every value is solved to 1e-10.
    """
    dof, x = np.asarray(dofs, float), np.asarray(thresholds, float)
    if dof.ndim != 1 or dof.shape != x.shape:
        raise ValueError(f"two vectors of one length are needed, not {dof.shape} and {x.shape}")
    if not dof.size:
        return np.zeros(0)
    _check(dof, x)
    _check_rise(epsilon, float(np.min(chdtr(dof, x))))
    order = np.argsort(dof, kind="stable")
    dof, x = dof[order], x[order]
    start = None
    if len(x) > 2 * KNOTS:
        spread = np.geomspace(dof[0], dof[-1], KNOTS)
        at = np.unique(np.minimum(np.searchsorted(dof, spread), len(x) - 1))
        at = at[np.unique(dof[at], return_index=True)[1]]
        if len(at) > 3:
            few = np.log(_solve(epsilon, dof[at], x[at]))
            from scipy.interpolate import CubicSpline  # takes long to import

            start = np.exp(CubicSpline(np.log(dof[at]), few)(np.log(dof)))
    found = np.empty(len(x))
    found[order] = _solve(epsilon, dof, x, start)
    return found


def weighted_noncentral_tail(
    x: float, weights: ArrayLike, dof: ArrayLike, noncentrality: ArrayLike
) -> float:
    """P(sum_i weights_i chi'2_{dof_i}(noncentrality_i) > x), independent terms.

    Three vectors of one length, or scalars. Terms without weight do not count; ValueError
    for weights or non-centralities below 0. As accurate as `chi_square.weighted_tails`: 1e-12
    relative up to some hundred degrees of freedom, 1e-10 up to a million.
    """
    w, nu, shift2 = _terms(weights, dof, noncentrality)
    return weighted_tails(x, w, nu, shift2)[0] if w.size else float(x < 0)


def _terms(*arrays: ArrayLike) -> list[np.ndarray]:
    w, nu, shift2 = np.broadcast_arrays(*(np.atleast_1d(np.asarray(a, float)) for a in arrays))
    if not (np.all(w >= 0) and np.all(shift2 >= 0)):
        raise ValueError(f"weights and non-centralities are at least 0, not {w} and {shift2}")
    return [a[w > 0] for a in (w, nu, shift2)]


def largest_shift(
    epsilon: float, weights: ArrayLike, dof: ArrayLike, threshold: float, at: int
) -> float:
    """The shift of one term alone that raises a weighted test's alarm probability by epsilon.

    The sqrt(l) with P(sum_i weights_i chi'2_{dof_i}(l [i = at]) > threshold) epsilon above
    its value at l = 0: what one sample of a weighted window can take. To 1e-9 relative, and
    infinite where the term has no weight. ValueError unless threshold > 0 and
    0 < epsilon < P(no alarm without a shift).
    """
    one = np.zeros(np.size(weights))
    one[at] = 1.0
    w, nu, one = _terms(weights, dof, one)
    _check(np.ones(1), np.array([threshold], float))
    room = weighted_tails(threshold, w, nu, 0.0 * w)[1] if w.size else 1.0
    _check_rise(epsilon, room)
    if not np.any(one):
        return float("inf")

    def gap(log_shift: float) -> float:
        rise = weighted_rise(threshold, w, nu, one * np.exp(2.0 * log_shift))
        return float(np.log(max(rise, 1e-300) / epsilon))

    # as in `_solve`: the shifted term is at least the square of one normal variable
    z = -ndtri(room - epsilon)
    high = float(np.log(np.sqrt(threshold / (w @ one)) + z + 1e-6))
    low = high - 5.0
    while gap(low) > 0:
        low -= 5.0
    return float(np.exp(bracketed_root(gap, (low, high), xtol=1e-13)))
