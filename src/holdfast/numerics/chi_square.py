"""Sums of weighted chi-squares: tails, quantiles, and a quantile cheap enough for every step.

The tails are computed once, when a detector is built, with NumPy on the host; `SumQuantile`
and `log_ratio` are what runs at every step, under `jax.jit`.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.special import chdtri, hyp0f1, ndtri

from holdfast.numerics.roots import bracketed_root

NODES = 120
SLOPE = 0.7
SKEWNESSES = 129
BESSEL_STEP = 0.1
BESSEL_END = 60.0


def weighted_tail(x: float, weights: np.ndarray, dof: np.ndarray) -> float:
    """P(sum_i weights_i chi2_{dof_i} > x), independent terms, weights > 0.

    Relative accuracy as `weighted_tails`.
    """
    return weighted_tails(x, weights, dof, np.zeros(len(weights)))[0]


def weighted_tails(
    x: float, weights: np.ndarray, dof: np.ndarray, noncentrality: np.ndarray
) -> tuple[float, float]:
    """P(Q > x) and P(Q <= x), Q = sum_i weights_i chi'2_{dof_i}(noncentrality_i), weights > 0.

    Independent terms. Also the smaller of the two is good to 1e-12 relative up to some hundred
    degrees of freedom (and as much non-centrality), to 1e-10 up to a million: rounding alone.
    """
    if x <= 0:
        return 1.0, 0.0
    w, nu, shift2 = (np.asarray(a, float) for a in (weights, dof, noncentrality))
    part = _contour(x, w, nu, shift2)
    return (part, 1.0 - part) if x > w @ (nu + shift2) else (1.0 + part, -part)


def weighted_rise(
    x: float, weights: np.ndarray, dof: np.ndarray, noncentrality: np.ndarray
) -> float:
    """What ``noncentrality`` adds to P(Q > x), to 1e-9 of itself however little it is.

    Q and arguments as in `weighted_tails`. Where two tails would cancel, the difference is
    taken of their transforms instead.
    """
    if x <= 0:
        return 0.0
    w, nu, shift2 = (np.asarray(a, float) for a in (weights, dof, noncentrality))
    before, below = weighted_tails(x, w, nu, np.zeros(len(w)))
    after, still_below = weighted_tails(x, w, nu, shift2)
    if after > 1.1 * before:
        return after - before
    if still_below < 0.9 * below:
        return below - still_below
    return _contour(x, w, nu, np.zeros(len(w)), shift2)


def _contour(
    x: float,
    w: np.ndarray,
    nu: np.ndarray,
    shift2: np.ndarray,
    added: np.ndarray | None = None,
) -> float:
    """The inverse Laplace transform of E exp(s Q) / s, Q = sum_i w_i chi'2_{nu_i}(shift2_i).

    The transform is exp(sum_i shift2_i w_i s / (1 - 2 w_i s) - nu_i/2 log(1 - 2 w_i s)) / s.
    The path is a hyperbola through the saddle point: there it bends as steepest descent does,
    and far out it keeps to a slope at which every term decays, which on Helstrom's parabola a
    heavy term can spoil for a light one. Imhof's integral is the same along the imaginary
    axis, where it oscillates. Right of the pole at 0 (x above the mean) this is the upper
    tail, left of it minus the lower one. With ``added`` it is what this much more
    non-centrality adds to the upper tail, and there is no pole.
    """
    saddle, across, bend = _saddle(x, w, nu, shift2)

    def along(u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        up = across * np.sinh(u)
        root = np.hypot(1.0, 2.0 * bend * up / SLOPE)
        s = saddle + 2.0 * bend * up**2 / (1.0 + root) + 1j * up
        ws = np.multiply.outer(s, w)
        per_shift = ws / (1.0 - 2.0 * ws)
        exponent = per_shift @ shift2 - 0.5 * np.log1p(-2.0 * ws) @ nu - s * x
        return exponent, per_shift, s, across * np.cosh(u) * (2.0 * bend * up / root + 1j)

    steps = np.linspace(0.0, 15.0, 76)
    heights = np.real(along(steps)[0])
    reach = steps[np.argmax(np.append(heights[:-1] < heights[0] - 40.0, True))]
    exponent, per_shift, s, ds = along(reach / NODES * np.arange(NODES + 1))
    terms = np.exp(exponent - heights[0]) / s * ds
    terms[0] *= 0.5
    if added is not None:
        terms = terms * np.expm1(per_shift @ added)
    return float(reach / NODES / np.pi * np.exp(heights[0]) * np.sum(terms.imag))


def _saddle(
    x: float, w: np.ndarray, nu: np.ndarray, shift2: np.ndarray
) -> tuple[float, float, float]:
    """The saddle point of `_contour` on the real axis, and the scale and bend of its path."""
    edge = 1.0 / (2.0 * np.max(w))

    def slope(s: float) -> float:
        spread = w / (1.0 - 2.0 * w * s)
        return float(spread @ nu + (spread**2 / w) @ shift2 - x - 1.0 / s)

    # left of ``low`` no term's share of the slope outweighs its share here
    low = -(0.5 * np.sum(nu) + 0.125 * np.sum(shift2) + 2.0) / x
    upper = x > w @ (nu + shift2)
    bracket = (edge * 1e-15, edge * (1 - 1e-15)) if upper else (low, -edge * 1e-15)
    saddle = bracketed_root(slope, bracket, xtol=1e-14 * edge)
    spread = w / (1.0 - 2.0 * w * saddle)
    k2 = float(2.0 * (spread**2 @ nu + 2.0 * (spread**3 / w) @ shift2) + saddle**-2)
    k3 = float(8.0 * (spread**3 @ nu + 3.0 * (spread**4 / w) @ shift2))
    # the pole alone would bend the path to the left, where single terms hardly decay
    return saddle, k2**-0.5, k3 / (6.0 * k2)


def weighted_quantile(level: float, weights: np.ndarray, dof: np.ndarray) -> float:
    """The x with P(sum_i weights_i chi2_{dof_i} > x) = level."""
    w, nu = np.asarray(weights, float), np.asarray(dof, float)
    # the largest term alone is below the sum, the sum with all weights largest above it
    low = np.max(w) * chdtri(nu[np.argmax(w)], level)
    high = np.max(w) * chdtri(np.sum(nu), level)
    if high <= low * (1 + 1e-12):
        return float(high)

    def excess(x: float) -> float:
        return float(np.log(max(weighted_tail(x, w, nu), 1e-300) / level))

    # either end may be the quantile itself, where the tail's rounding decides the sign
    bracket = (low * (1 - 1e-6), high * (1 + 1e-6))
    return bracketed_root(excess, bracket, rtol=1e-12)


class SumQuantile(eqx.Module):
    """The upper ``level`` quantile of sum_i w_i chi2_{nu_i} when w and nu change every step.

    Pearson's three-moment approximation: with c_j = sum_i w_i^j nu_i and h = c_2^3 / c_3^2
    the sum is distributed as c_1 + sqrt(c_2 / h) (chi2_h - h). That is exact for equal
    weights, whatever the degrees of freedom; for the pattern of weights given to
    `sum_quantile` at constant degrees of freedom ``correction`` makes it exact too. In
    between (start, missing samples with unequal weights) it is approximate.

    ``standard``: quantile of (chi2_h - h) / sqrt(2 h) over 1 / sqrt(h), from 0 to 1;
    ``correction`` over ``dof``: exact over approximate quantile at constant degrees of freedom.

    Source: Imhof, Biometrika 48 (1961), Section 4.
    """

    standard: Float[Array, " g"]
    dof: Float[Array, " q"]
    correction: Float[Array, " q"]

    def at(
        self,
        c0: Float[Array, ""],
        c1: Float[Array, ""],
        c2: Float[Array, ""],
        c3: Float[Array, ""],
    ) -> Float[Array, ""]:
        """The quantile; ``c0`` sums the weights of terms with any dof. All moments > 0."""
        skewness = jnp.clip(c3 / (c2 * jnp.sqrt(c2)), 0.0, 1.0) * (SKEWNESSES - 1)
        i = jnp.minimum(skewness.astype(jnp.int32), SKEWNESSES - 2)
        share = skewness - i.astype(float)
        standard = (1.0 - share) * self.standard[i] + share * self.standard[i + 1]
        correction = jnp.interp(c1 / c0, self.dof, self.correction)
        return correction * (c1 + jnp.sqrt(2.0 * c2) * standard)


def sum_quantile(level: float, weights: np.ndarray, most: int) -> SumQuantile:
    """A `SumQuantile` exact for ``weights`` at any constant dof from 1 to ``most``.

    Beyond eight, the correction is computed at a geometric grid of dofs and interpolated: it
    is smooth and tends to 1.
    """
    w = np.asarray(weights, float)
    w = w[w > 0] / np.max(w)
    t = np.linspace(0.0, 1.0, SKEWNESSES)[1:]
    standard = np.concatenate(
        [[-ndtri(level)], (chdtri(t**-2, level) - t**-2) / np.sqrt(2.0 * t**-2)]
    )
    dof = dof_grid(most)
    plain = SumQuantile(jnp.asarray(standard), jnp.asarray(dof), jnp.ones(len(dof)))
    if np.ptp(w) == 0:
        return plain
    exact = [weighted_quantile(level, w, np.full(len(w), nu)) for nu in dof]
    powers = np.array([np.sum(w**j) for j in (1, 1, 2, 3)])
    close = [float(plain.at(*map(jnp.asarray, powers * [1.0, nu, nu, nu]))) for nu in dof]
    return SumQuantile(plain.standard, plain.dof, jnp.asarray(np.divide(exact, close)))


def dof_grid(most: int) -> np.ndarray:
    """1 to 8, then about twelve steps to ``most``: where quantities smooth in dof are tabled."""
    top = max(most, 1)
    every = np.arange(1, min(top, 8) + 1)
    if top > 8:
        every = np.concatenate([every, np.rint(np.geomspace(9, top, 12))])
    return np.unique(every).astype(float)


class BesselTable(eqx.Module):
    """g(x) = log 0F1(; dof/2; x^2/4) and its slope on a grid of x, one row per dof.

    Row 0 is zero: no degree of freedom carries no information.
    """

    value: Float[Array, "m g"]
    slope: Float[Array, "m g"]


def bessel_table(most: int) -> BesselTable:
    """The table for 0 to ``most`` degrees of freedom."""
    x = np.arange(0.0, BESSEL_END + BESSEL_STEP / 2, BESSEL_STEP)
    b = np.arange(1, most + 1)[:, None] / 2.0
    value, above = hyp0f1(b, x**2 / 4), hyp0f1(b + 1.0, x**2 / 4)
    nothing = np.zeros((1, len(x)))
    return BesselTable(
        jnp.asarray(np.concatenate([nothing, np.log(value)])),
        jnp.asarray(np.concatenate([nothing, x / 2 * above / (b * value)])),
    )


def log_ratio(
    table: BesselTable,
    statistic: Float[Array, ""],
    dof: Int[Array, ""],
    shift: Float[Array, ""],
) -> Float[Array, ""]:
    """Log of the density of a non-central chi-square over that of the central one.

    log 0F1(; dof/2; shift^2 s / 4) - shift^2 / 2, the non-centrality being shift^2: cubic
    Hermite interpolation (error under 1e-6), and beyond the table Debye's asymptotic form of
    the Bessel function I_{dof/2-1}, joined to it. 0 for no degrees of freedom.
    """
    x = shift * jnp.sqrt(statistic)
    inside = jnp.minimum(x, BESSEL_END)
    i = jnp.minimum((inside / BESSEL_STEP).astype(jnp.int32), table.value.shape[1] - 2)
    t = inside / BESSEL_STEP - i.astype(float)
    left, right = table.value[dof, i], table.value[dof, i + 1]
    rise_left, rise_right = (BESSEL_STEP * table.slope[dof, j] for j in (i, i + 1))
    value = (
        left
        + t * rise_left
        + t * t * (3.0 * (right - left) - 2.0 * rise_left - rise_right)
        + t * t * t * (2.0 * (left - right) + rise_left + rise_right)
    )
    order = dof.astype(float) / 2.0 - 1.0
    beyond = value + _debye(order, jnp.maximum(x, BESSEL_END)) - _debye(order, BESSEL_END)
    found = jnp.where(x > BESSEL_END, beyond, value) - 0.5 * shift * shift
    return jnp.where(dof > 0, found, 0.0)


def _debye(order, x):
    """Log (x^-order I_order(x)) to leading order in large x or order, up to a constant."""
    root = jnp.sqrt(order * order + x * x)
    return root - order * jnp.log(order + root) - 0.5 * jnp.log(root)
