"""Moments of a standard Gaussian vector restricted to a box, in one to three dimensions.

All by Gauss-Legendre quadrature over the part of the box where the density is within
e^-DEPTH of its largest value: the density is log-concave, so that part is an interval in
every direction, and the rule's nodes are never spent where nothing is. No difference of tails
is formed, so a box far out, very narrow or very wide costs no digits.

In two dimensions correlation is no difficulty: in coordinates (t, s) of independent unit
normals, with s along the bisector of the two (sign-matched) normals, the box is a
parallelogram whose edges have a slope of at most 1 against the t axis. Between the corners
everything is smooth on the scale of a standard deviation, whatever the correlation, 1 included.
In three dimensions the least correlated of them is integrated last, outside the other two.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from holdfast.numerics.linalg import dot

DEPTH = 36.0
NODES = 36
"""Per smooth piece. A whole Gaussian cut where its density is e^-36 of its peak: 1e-14."""
LINE_DEPTH = 40.0
LINE_NODES = 40
"""In one dimension, where they cost little: 3e-16."""
SPACE_DEPTH = 32.0
SPACE_NODES = 32
"""In three dimensions, per piece and dimension."""
ZOOMS, GRID = 9, 17
HALVINGS = 24
SMALLEST = 1e-8
"""Sine of half the angle between two normals under which rounding decides the angle."""
STEEPEST = 1e-3
"""Standard deviation that one slab leaves to another under which offsets count from there."""
TINIEST = 1e-300

LOG_ROOT_2PI = 0.5 * float(np.log(2.0 * np.pi))
Scalar = Float[Array, ""]


class BoxMoments(NamedTuple):
    """Moments of v, offsets that stand for w; u = lift v are independent unit normals.

    ``axes``: u = axes w. A narrow slab's w is itself an entry of v (up to a factor), so that
    its small variance is not the difference of larger ones.
    """

    axes: Float[Array, "g g"]
    lift: Float[Array, "g g"]
    mean: Float[Array, " g"]
    cov: Float[Array, "g g"]
    log_probability: Scalar


def interval(mean: Scalar, sd: Scalar, low: Scalar, high: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Mean, variance and log probability of N(mean, sd^2) restricted to [low, high].

    Offsets are taken from the point of the interval nearest to the mean, q:
    density ~ exp(-(p + e/2) e), p = (q - mean) / sd, so that an interval hundreds of standard
    deviations out keeps its digits. ``low`` <= ``high``, either may be infinite; sd > 0.
    """
    nearest = jnp.clip(mean, low, high)
    p = (nearest - mean) / sd
    reach = 2.0 * LINE_DEPTH / (jnp.abs(p) + jnp.sqrt(p * p + 2.0 * LINE_DEPTH))
    start = jnp.maximum((low - nearest) / sd, -reach)
    half = 0.5 * (jnp.minimum((high - nearest) / sd, reach) - start)
    nodes, weights = _rule(LINE_NODES)
    offset = start + half * (1.0 + nodes)
    density = weights * jnp.exp(-(p + 0.5 * offset) * offset)
    mass = jnp.sum(density)
    first = jnp.sum(density * offset) / mass
    second = jnp.sum(density * jnp.square(offset - first)) / mass
    log_mass = jnp.log(jnp.maximum(mass * half, TINIEST))
    return nearest + sd * first, sd * sd * second, log_mass - 0.5 * p * p - LOG_ROOT_2PI


def rectangle(
    V: Float[Array, "2 2"], low: Float[Array, " 2"], high: Float[Array, " 2"]
) -> BoxMoments:
    """Of w ~ N(0, V), unit variances, restricted to low <= w <= high, finite."""
    order = jnp.where(high[0] - low[0] > high[1] - low[1], jnp.eye(2)[::-1], jnp.eye(2))
    half, sign = _angle(V[0, 1])
    low, high = _flip(dot(order, low), dot(order, high), sign)
    size, t, w = _nearest(low, high, half)
    sums = _parallelogram(low, high, half, jnp.zeros(()), jnp.stack([size, t, w]), DEPTH, NODES)
    lift = jnp.stack([jnp.asarray([1.0, 0.0]), jnp.stack([-half[1], jnp.ones(())]) / half[0]])
    axes = dot(_bisector(half, sign), order)
    return _moments(axes, lift, jnp.stack([t, w]), size, sums[0], sums[1:3], sums[3:])


def cuboid(V: Float[Array, "3 3"], low: Float[Array, " 3"], high: Float[Array, " 3"]) -> BoxMoments:
    """Of w ~ N(0, V), unit variances, restricted to low <= w <= high, finite."""
    order = _outer_last(V, high - low)
    V, low, high = dot(dot(order, V), order.T), dot(order, low), dot(order, high)
    slope = V[:2, 2]
    own = jnp.sqrt(jnp.maximum(1.0 - slope * slope, SMALLEST**2))
    half, sign = _angle((V[0, 1] - slope[0] * slope[1]) / (own[0] * own[1]))

    def slice_at(outer):
        return _flip((low[:2] - slope * outer) / own, (high[:2] - slope * outer) / own, sign)

    def cost(outer):
        return outer * outer + _nearest(*slice_at(outer), half)[0]

    radius = jnp.sqrt(cost(jnp.clip(0.0, low[2], high[2])) + 2.0 * SPACE_DEPTH)
    ends = jnp.maximum(low[2], -radius), jnp.minimum(high[2], radius)
    start, peak, end = _span(cost, *ends, 2.0 * SPACE_DEPTH)
    inner_size, t, w = _nearest(*slice_at(peak), half)
    size = peak * peak + inner_size
    # where an edge of the box meets the conditional mean, the inner integral turns within
    # own / slope: nodes are densest at the ends of a piece
    steep = jnp.where(jnp.abs(slope) > SMALLEST, slope, SMALLEST)
    turns = jnp.concatenate([low[:2] / steep, high[:2] / steep])
    breaks = jnp.sort(jnp.clip(jnp.concatenate([jnp.stack([start, end]), turns]), start, end))
    # w_1 itself, not what w_3 leaves of it, unless w_3 leaves nothing
    drift = jnp.where(own[0] > STEEPEST, slope[0] / own[0], 0.0)

    def at(outer):
        centre = jnp.stack([size, t, w - drift * (outer - peak)])
        return _parallelogram(*slice_at(outer), half, outer, centre, SPACE_DEPTH, SPACE_NODES)

    def piece(i, sums):
        def add():
            outer, weights = _nodes(breaks[i], breaks[i + 1], SPACE_NODES)
            inner, e = weights[:, None] * jax.vmap(at)(outer), outer - peak
            products = [jnp.sum(inner, 0), dot(e, inner[:, :3]), jnp.sum(e * e * inner[:, 0])[None]]
            return sums + jnp.concatenate(products)

        return jax.lax.cond(breaks[i + 1] > breaks[i], add, lambda: sums)

    sums = jax.lax.fori_loop(0, breaks.shape[0] - 1, piece, jnp.zeros(10))
    first, second = sums[np.array([1, 2, 6])], sums[np.array([3, 4, 5, 7, 8, 9])]
    rows = _bisector(half, sign) / own
    last = jnp.asarray([[0.0, 0.0, 1.0]])
    axes = jnp.concatenate([jnp.concatenate([rows, -dot(rows, slope)[:, None]], 1), last])
    bend = jnp.stack([-half[1], jnp.ones(()), -drift]) / half[0]
    lift = jnp.stack([jnp.asarray([1.0, 0.0, 0.0]), bend, last[0]])
    centre = jnp.stack([t, w + drift * peak, peak])
    return _moments(dot(axes, order), lift, centre, size, sums[0], first, second)


def _moments(axes, lift, centre, size, mass, first, second) -> BoxMoments:
    """From the sums about ``centre``; ``second`` holds the lower triangle, row by row."""
    g = len(centre)
    scale = jnp.where(mass > 0, 1.0 / jnp.where(mass > 0, mass, 1.0), 0.0)
    rows, columns = np.tril_indices(g)
    place = np.zeros((g, g), int)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    shift = first * scale
    cov = second[place] * scale - shift[:, None] * shift[None, :]
    log_mass = jnp.log(jnp.maximum(mass, TINIEST))
    return BoxMoments(axes, lift, centre + shift, cov, log_mass - 0.5 * size - g * LOG_ROOT_2PI)


def _parallelogram(low, high, half, outer, centre, depth, count) -> Float[Array, " 6"]:
    """Sums over the box of exp(-(t^2 + s^2 + outer^2 - |peak|^2) / 2) times 1, t, w, tt, tw, ww,

    w being the first of the pair. ``centre``: |peak|^2 and where t and w count from.
    """
    peak, t0, w0 = centre
    cosine, sine = half
    radius = jnp.sqrt(jnp.maximum(peak + 2.0 * depth - outer * outer, 0.0))
    twice = 2.0 * sine
    start = jnp.maximum((low[0] - high[1]) / twice, -radius)
    end = jnp.minimum((high[0] - low[1]) / twice, radius)
    # the shadow on the t axis of the disc's part beyond each edge: cosine s + lean t >= bound
    bounds = jnp.concatenate([low, -high])
    lean = sine * jnp.asarray([1.0, -1.0, -1.0, 1.0])
    chord = cosine * jnp.sqrt(jnp.maximum((radius - bounds) * (radius + bounds), 0.0))
    right = jnp.where(lean * radius >= bounds, radius, lean * bounds + chord)
    left = jnp.where(-lean * radius >= bounds, -radius, lean * bounds - chord)
    start, end = jnp.maximum(start, jnp.max(left)), jnp.minimum(end, jnp.min(right))
    end = jnp.maximum(start, end)
    corners = jnp.clip(jnp.stack([low[0] - low[1], high[0] - high[1]]) / twice, start, end)
    breaks = jnp.stack([start, jnp.min(corners), jnp.max(corners), end])
    t, weights = jax.vmap(lambda a, b: _nodes(a, b, count))(breaks[:-1], breaks[1:])
    t, weights = t.ravel(), weights.ravel()

    ceiling = jnp.sqrt(jnp.maximum((radius - t) * (radius + t), 0.0))
    tilt = sine * t
    under = jnp.maximum(jnp.maximum(low[0] - tilt, low[1] + tilt) / cosine, -ceiling)
    over = jnp.minimum(jnp.minimum(high[0] - tilt, high[1] + tilt) / cosine, ceiling)
    width = 0.5 * jnp.maximum(over - under, 0.0)
    middle = under + width
    nodes, inner = _rule(count)
    s = middle[:, None] + width[:, None] * nodes
    # at most 0 but for rounding, which is large where the box is 1e8 deviations out
    exponent = jnp.minimum(0.5 * ((peak - outer * outer - t * t)[:, None] - s * s), 1.0)
    powers = jnp.stack([inner, inner * nodes, inner * nodes * nodes], 1)
    b0, b1, b2 = (weights * width) * (jnp.exp(exponent) @ powers).T
    t, w, width = t - t0, cosine * middle + tilt - w0, cosine * width
    c1 = w * b0 + width * b1
    c2 = w * w * b0 + 2.0 * w * width * b1 + width * width * b2
    return jnp.sum(jnp.stack([b0, t * b0, c1, t * t * b0, t * c1, c2]), 1)


def _nearest(low, high, half):
    """Squared distance of the parallelogram from the origin, and its nearest point (t, w1)."""
    cosine, sine = half
    correlation = (cosine - sine) * (cosine + sine)
    fixed = jnp.concatenate([low, high])
    swap = [1, 0, 1, 0]
    follow = jnp.clip(correlation * fixed, low[jnp.array(swap)], high[jnp.array(swap)])
    first = jnp.asarray([True, False, True, False])
    t = jnp.where(first, fixed - follow, follow - fixed) / (2.0 * sine)
    s = (fixed + follow) / (2.0 * cosine)
    size = t * t + s * s
    best = jnp.argmin(size)
    outside = jnp.any((low > 0) | (high < 0))
    point = (size, t, jnp.where(first, fixed, follow))
    return tuple(jnp.where(outside, v[best], 0.0) for v in point)


def _span(cost: Callable[[Scalar], Scalar], start: Scalar, end: Scalar, height: float):
    """Where the convex ``cost`` is least in [start, end], and how far it stays within height."""
    share = jnp.linspace(0.0, 1.0, GRID)

    def zoom(_, ends):
        points = ends[0] + (ends[1] - ends[0]) * share
        i = jnp.argmin(jax.vmap(cost)(points))
        return points[jnp.maximum(i - 1, 0)], points[jnp.minimum(i + 1, GRID - 1)]

    low, high = jax.lax.fori_loop(0, ZOOMS, zoom, (start, end))
    peak = 0.5 * (low + high)
    level = cost(peak) + height

    def halve(_, bracket):
        inner, outer = bracket
        middle = 0.5 * (inner + outer)
        within = jax.vmap(cost)(middle) <= level
        return jnp.where(within, middle, inner), jnp.where(within, outer, middle)

    bracket = (jnp.stack([peak, peak]), jnp.stack([start, end]))
    ends = jax.lax.fori_loop(0, HALVINGS, halve, bracket)[1]
    return ends[0], peak, ends[1]


def _outer_last(V: Float[Array, "3 3"], width: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """The permutation that puts the two most correlated of three first, the narrower ahead."""
    sizes = jnp.abs(jnp.stack([V[1, 2], V[0, 2], V[0, 1]]))
    pair = jnp.arange(3) != jnp.argmax(sizes)
    return jnp.eye(3)[jnp.argsort(jnp.where(pair, width, jnp.inf))]


def _angle(correlation):
    """Cosine and sine of half the angle of two normals, turned to less than 90 degrees."""
    size = jnp.minimum(jnp.abs(correlation), 1.0)
    sine = jnp.maximum(jnp.sqrt(0.5 * (1.0 - size)), SMALLEST)
    return jnp.stack([jnp.sqrt(0.5 * (1.0 + size)), sine]), jnp.where(correlation < 0, -1.0, 1.0)


def _flip(low, high, sign):
    """The box in (w1, sign w2)."""
    turned = sign < 0
    first, second = jnp.where(turned, -high[1], low[1]), jnp.where(turned, -low[1], high[1])
    return jnp.stack([low[0], first]), jnp.stack([high[0], second])


def _bisector(half, sign) -> Float[Array, "2 2"]:
    """(t, s) from (w1, w2): t = (w1 - sign w2) / (2 sine), s = (w1 + sign w2) / (2 cosine)."""
    rows = jnp.stack([jnp.ones(2), jnp.stack([-sign, sign])], 1)
    return 0.5 * rows / half[::-1, None]


def _rule(count: int):
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return jnp.asarray(nodes), jnp.asarray(weights)


def _nodes(start: Scalar, end: Scalar, count: int):
    nodes, weights = _rule(count)
    half = 0.5 * (end - start)
    return start + half * (1.0 + nodes), half * weights
