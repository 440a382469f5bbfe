"""Gaussians restricted to polytopes, beside adaptive and tensor quadrature and rejection."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from scipy.integrate import quad
from scipy.special import log_ndtr, ndtr
from scipy.stats import multivariate_normal

from holdfast.numerics.truncated import NARROWEST, Slabs, find_slabs, restricted

INF = np.inf
MEAN_OFF, SD_OFF = 0.065 + 0.02, 0.10 + 0.02
"""What `propagate` states, and three standard errors of 20 000 draws."""


def box_rows(g):
    """w_1 <= b_1, -w_1 <= b_2, w_2 <= b_3, ..."""
    return np.kron(np.eye(g), [[1.0], [-1.0]])


def box_bound(low, high):
    return np.stack([high, -np.asarray(low)], 1).ravel()


@pytest.fixture(scope="module")
def boxes():
    """Batched over covariance and bounds: one compilation per dimension."""

    def of(g):
        rows = jnp.asarray(box_rows(g))
        slabs = find_slabs(box_rows(g))
        one = lambda V, b: restricted(jnp.zeros(g), V, rows, b, slabs)  # noqa: E731
        # a loop, not a batch: pieces that are empty are then skipped
        return jax.jit(lambda V, b: jax.lax.map(lambda a: one(*a), (V, b)))

    return {g: of(g) for g in (1, 2, 3, 4)}


def scaled_interval(low, high):
    """Mean, variance and log probability of a unit normal in [low, high], adaptively.

    In e = distance from the point nearest to 0, in units of the decay there or of the width,
    whichever is less: no tail appears and every integral is of order 1.
    """
    q = np.clip(0.0, low, high)
    unit = min(1.0 / max(1.0, abs(q)), high - low)
    ends = np.clip([(low - q) / unit, (high - q) / unit], -60.0, 60.0)

    def moment(f):
        inner = lambda e: f(e) * np.exp(-(q * unit + 0.5 * unit * unit * e) * e)  # noqa: E731
        points = [p for p in (-8.0, -1.0, 0.0, 1.0, 8.0) if ends[0] < p < ends[1]]
        return quad(inner, *ends, points=points or None, epsabs=1e-13, epsrel=1e-12, limit=400)[0]

    mass = moment(lambda e: 1.0)
    shift = moment(lambda e: e) / mass
    variance = moment(lambda e: (e - shift) ** 2) / mass
    log_mass = np.log(mass * unit) - 0.5 * q * q - 0.5 * np.log(2 * np.pi)
    return q + unit * shift, unit * unit * variance, log_mass


INTERVALS = [
    (-1.0, 2.0), (0.0, INF), (-INF, -3.0), (-5.0, INF), (30.0, INF), (300.0, INF),
    (-INF, -800.0), (300.0, 300.001), (12.0, 12.5), (-1e-6, 1e-6), (2.0, 2.0 + 1e-9),
    (-40.0, 0.3), (-0.2, 500.0), (-8.0, 8.0),
]  # fmt: skip


def test_one_slab_against_adaptive_quadrature(boxes):
    """Offset from the nearer bound and variance to 1e-10, 800 standard deviations out."""
    low, high = np.array(INTERVALS).T
    bound = jnp.asarray(box_bound(low, high).reshape(-1, 2))
    found = boxes[1](jnp.ones((len(low), 1, 1)), bound)
    for i, (a, b) in enumerate(INTERVALS):
        mean, variance, log_probability = scaled_interval(a, b)
        # bounds are known to their last digit: 1e-16 of 800 in units of a spread of 1/800
        assert found.mean[i, 0] == pytest.approx(mean, abs=1e-10 * np.sqrt(variance), rel=4e-16)
        assert found.cov[i, 0, 0] == pytest.approx(variance, rel=1e-10)
        assert found.log_probability[i] == pytest.approx(log_probability, rel=1e-12, abs=1e-12)


def test_a_half_line_has_the_probability_of_its_tail(boxes):
    far = np.array([-3.0, 0.0, 5.0, 40.0, 300.0])
    bound = jnp.asarray(np.stack([np.full(5, INF), -far], 1))
    found = boxes[1](jnp.ones((5, 1, 1)), bound).log_probability
    # 1e-14 of a probability, which near 1 is all of its logarithm
    np.testing.assert_allclose(found, log_ndtr(-far), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("g", [2, 3])
def test_independent_slabs_are_products(boxes, g):
    """To 3e-9 in three dimensions and 1e-10 in two: what `restricted` states."""
    rng = np.random.default_rng(g)
    low = rng.normal(size=(12, g)) * np.array([1.0, 4.0, 20.0])[:g]
    high = low + 10 ** rng.uniform(-3, 2, size=(12, g))
    high[::3, 0] = INF
    bound = jnp.asarray(np.stack([box_bound(*ends) for ends in zip(low, high, strict=True)]))
    found = boxes[g](jnp.asarray(np.tile(np.eye(g), (12, 1, 1))), bound)
    tolerance = 1e-10 if g == 2 else 3e-9
    for i in range(12):
        truth = np.array([scaled_interval(*ends) for ends in zip(low[i], high[i], strict=True)])
        sd = np.sqrt(truth[:, 1])
        off = (np.asarray(found.mean[i]) - truth[:, 0]) / sd
        # rounding of the bounds, 20 standard deviations out, in units of a narrow slab
        np.testing.assert_allclose(off, 0.0, atol=tolerance + 1e-14 / np.min(sd))
        scaled = np.asarray(found.cov[i]) / np.outer(sd, sd)
        np.testing.assert_allclose(scaled, np.eye(g), atol=tolerance + 1e-14 / np.min(sd))
        assert found.log_probability[i] == pytest.approx(truth[:, 2].sum(), abs=tolerance * 10)


def panels(low, high, count):
    """Composite Gauss-Legendre: ``count`` panels of 16 nodes."""
    nodes, weights = leggauss(16)
    ends = np.linspace(low, high, count + 1)
    half = np.diff(ends)[:, None] / 2
    return (ends[:-1, None] + half * (1 + nodes)).ravel(), (half * weights).ravel()


def partial_moments(low, high):
    """Integrals of 1, x, x^2 against the unit normal density."""
    density = [np.exp(-0.5 * e * e) / np.sqrt(2 * np.pi) for e in (low, high)]
    ends = [np.where(np.isfinite(e), e, 0.0) * p for e, p in zip((low, high), density, strict=True)]
    # tails, not their complements: 1 - ndtr(9) has no digits
    flip = low > 0
    m0 = ndtr(np.where(flip, -low, high)) - ndtr(np.where(flip, -high, low))
    return m0, density[0] - density[1], m0 + ends[0] - ends[1]


def moments_on_grid(V, low, high, count):
    """Tensor quadrature in w itself, narrowed to 30 deviations; the last of them analytic."""
    g = len(V) - 1
    a, b = np.maximum(low, -25.0)[:g], np.minimum(high, 25.0)[:g]
    slope = np.linalg.solve(V[:g, :g], V[:g, g])
    rest = np.sqrt(V[g, g] - slope @ V[:g, g])
    for _ in range(3):
        grids = [panels(*ends, count) for ends in zip(a, b, strict=True)]
        points = np.stack(np.meshgrid(*(x for x, _ in grids), indexing="ij"), -1).reshape(-1, g)
        weight = np.prod(np.stack(np.meshgrid(*(w for _, w in grids), indexing="ij"), -1), -1)
        square = np.sum(points * np.linalg.solve(V[:g, :g], points.T).T, 1)
        weight = weight.ravel() * np.exp(-0.5 * square)
        centre = points @ slope
        m0, m1, m2 = partial_moments((low[g] - centre) / rest, (high[g] - centre) / rest)
        m0, m1, m2 = weight * m0, weight * m1 * rest, weight * m2 * rest * rest
        mass = np.sum(m0)
        mean = np.append(points.T @ m0, centre @ m0 + np.sum(m1)) / mass
        e, c = points - mean[:g], centre - mean[g]
        cross = e.T @ (c * m0 + m1)
        last = np.sum(c * c * m0 + 2 * c * m1 + m2)
        cov = np.block([[(e.T * m0) @ e, cross[:, None]], [cross[None], np.array([[last]])]]) / mass
        sd = np.sqrt(np.diag(cov))[:g]
        a, b = np.maximum(a, mean[:g] - 30 * sd), np.minimum(b, mean[:g] + 30 * sd)
    norm = np.sqrt(np.linalg.det(2 * np.pi * V[:g, :g]))
    return mean, cov, np.log(mass / norm)


def random_boxes(g, correlations, seed):
    """Equally correlated slabs of either sign, 0.1 to 5 deviations wide, near where z is."""
    rng = np.random.default_rng(seed)
    for i, rho in enumerate(correlations):
        sign = rng.choice([-1.0, 1.0], g)
        V = ((1 - rho) * np.eye(g) + rho) * np.outer(sign, sign)
        width = rng.uniform(0.1, 5.0, g)
        low = np.linalg.cholesky(V) @ rng.normal(size=g) * 1.5 - width * rng.uniform(size=g)
        high = low + width
        if i % 3 == 0:
            high[1] = INF
        yield V, low, high


@pytest.mark.parametrize(
    ("g", "correlations", "count", "tolerance"),
    [
        (2, [0.0, 0.3, 0.7, 0.9, 0.97, 0.99, 0.999, 0.9999] * 3, 200, 1e-10),
        (3, [0.0, 0.4, 0.8, 0.9, 0.95, 0.99] * 2, 30, 3e-9),
    ],
)
def test_correlated_slabs_against_tensor_quadrature(boxes, g, correlations, count, tolerance):
    """The accuracy that `restricted` states, in deviations of what is found."""
    cases = list(random_boxes(g, correlations, seed=g))
    V = jnp.asarray(np.stack([case[0] for case in cases]))
    bound = jnp.asarray(np.stack([box_bound(*case[1:]) for case in cases]))
    found = boxes[g](V, bound)
    for i, case in enumerate(cases):
        mean, cov, log_probability = moments_on_grid(*case, count)
        sd = np.sqrt(np.diag(cov))
        np.testing.assert_allclose((found.mean[i] - mean) / sd, 0.0, atol=tolerance)
        np.testing.assert_allclose((found.cov[i] - cov) / np.outer(sd, sd), 0.0, atol=tolerance)
        assert found.log_probability[i] == pytest.approx(log_probability, abs=tolerance)


@pytest.mark.parametrize("g", [2, 3])
def test_the_probability_is_genzs(boxes, g):
    cases = list(random_boxes(g, [0.2, 0.6, 0.9], seed=7))
    V = np.stack([case[0] for case in cases])
    bound = np.stack([box_bound(*case[1:]) for case in cases])
    found = boxes[g](jnp.asarray(V), jnp.asarray(bound)).log_probability
    for i, (V, low, high) in enumerate(cases):
        normal = multivariate_normal(np.zeros(g), V, abseps=1e-9, releps=1e-9, maxpts=10**7)
        truth = normal.cdf(high, lower_limit=low)
        # the error asked of scipy's routine, which randomises in three dimensions
        assert np.exp(found[i]) == pytest.approx(truth, abs=1e-6)


@pytest.mark.parametrize("rho", [1.0, 1 - 1e-15, 1 - 1e-12, 1 - 1e-9, 1 - 1e-6])
def test_nearly_equal_slabs_become_their_intersection(boxes, rho):
    """w_i = w_j to sqrt(2 (1 - rho)): that far off, plus what sharp edges cost in three."""
    near = 10 * np.sqrt(2 * (1 - rho))
    for g, allowed in ((2, near + 1e-7), (3, near + 1e-6)):
        V = np.full((g, g), rho) + (1 - rho) * np.eye(g)
        low, high = np.array([-2.0, -0.5, -1.0])[:g], np.array([0.8, 2.0, 3.0])[:g]
        found = boxes[g](jnp.asarray(V)[None], jnp.asarray(box_bound(low, high))[None])
        mean, variance, log_probability = scaled_interval(-0.5, 0.8)
        np.testing.assert_allclose(found.mean[0], mean, atol=allowed)
        np.testing.assert_allclose(found.cov[0], variance, atol=allowed)
        assert found.log_probability[0] == pytest.approx(log_probability, abs=allowed)


def test_a_narrow_slab_beside_a_wide_one_keeps_its_digits(boxes):
    """Variance of a slab 1e-6 wide: width^2 / 12, not the difference of two variances of 1."""
    V = jnp.asarray([[1.0, 0.7], [0.7, 1.0]])[None]
    for low, high in (((0.3, -1.0), (0.3 + 1e-6, 4.0)), ((-1.0, 0.3), (4.0, 0.3 + 1e-6))):
        i = int(np.argmin(np.subtract(high, low)))
        cov = boxes[2](V, jnp.asarray(box_bound(low, high))[None]).cov[0]
        # a flat density to 1e-6; bounds rounded at 1e-16 of 1e-6
        assert cov[i, i] == pytest.approx(1e-12 / 12, rel=1e-6)


def rejected(rng, mean, cov, rows, bound, count):
    z = mean + rng.normal(size=(count, len(mean))) @ np.linalg.cholesky(cov).T
    return z[np.all(z @ rows.T <= bound, 1)]


def random_polytope(rng, n, m):
    root = rng.normal(size=(n, n))
    cov, mean, rows = root @ root.T + 0.05 * np.eye(n), rng.normal(size=n), rng.normal(size=(m, n))
    sd = np.sqrt(np.einsum("ij,jk,ik->i", rows, cov, rows))
    inside = mean + np.linalg.cholesky(cov) @ rng.normal(size=n)
    return mean, cov, rows, rows @ inside + sd * rng.exponential(size=m)


def test_a_triangle_in_the_plane_against_rejection():
    """Three slabs whose normals are dependent, so that w is singular: quadrature all the same."""
    rng = np.random.default_rng(3)
    find = jax.jit(restricted, static_argnums=4)
    for _ in range(6):
        mean, cov, rows, bound = random_polytope(rng, 2, 3)
        found = find(*map(jnp.asarray, (mean, cov, rows, bound)), find_slabs(rows))
        z = rejected(rng, mean, cov, rows, bound, 10**6)
        sd, error = z.std(0), 1 / np.sqrt(len(z))
        # 4.5 standard errors over 36 comparisons; a covariance's own error is below sqrt(2)
        np.testing.assert_allclose((found.mean - z.mean(0)) / sd, 0.0, atol=4.5 * error)
        off = (np.asarray(found.cov) - np.cov(z.T)) / np.outer(sd, sd)
        np.testing.assert_allclose(off, 0.0, atol=4.5 * np.sqrt(2) * error)


def test_more_slabs_by_expectation_propagation_against_rejection():
    """Six rows in four dimensions: inside the worst of the 500 that `restricted` states."""
    rng = np.random.default_rng(4)
    find = jax.jit(restricted, static_argnums=4)
    tried = 0
    while tried < 12:
        mean, cov, rows, bound = random_polytope(rng, 4, 6)
        z = rejected(rng, mean, cov, rows, bound, 300_000)
        if len(z) < 20_000:  # too few for a standard error of 0.7 %
            continue
        slabs = Slabs(tuple(range(6)), tuple(range(6)))  # one compilation for all
        found = find(*map(jnp.asarray, (mean, cov, rows, bound)), slabs)
        sd = z.std(0)
        assert np.max(np.abs(np.asarray(found.mean) - z.mean(0)) / sd) < MEAN_OFF
        assert np.max(np.abs(np.sqrt(np.diagonal(found.cov)) / sd - 1)) < SD_OFF
        tried += 1


def test_independent_slabs_are_exact_for_expectation_propagation(boxes):
    """Four independent slabs: the sites are then the slabs' own moments."""
    low, high = np.array([-1.0, 0.5, 2.0, -INF]), np.array([1.0, 0.7, INF, -3.0])
    found = boxes[4](jnp.eye(4)[None], jnp.asarray(box_bound(low, high))[None])
    truth = np.array([scaled_interval(*ends) for ends in zip(low, high, strict=True)])
    # sites settle to 1e-9
    np.testing.assert_allclose(found.mean[0], truth[:, 0], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(found.cov[0], np.diag(truth[:, 1]), rtol=1e-8, atol=1e-12)
    assert found.log_probability[0] == pytest.approx(truth[:, 2].sum(), rel=1e-8)


def systems(m, n, count=200, seed=0):
    rng = np.random.default_rng(seed)
    parts = zip(*(random_polytope(rng, n, m) for _ in range(count)), strict=True)
    return [jnp.asarray(np.stack(part)) for part in parts]


@pytest.mark.parametrize(("m", "n"), [(1, 3), (2, 3), (5, 3)])
def test_what_holds_for_every_set(m, n):
    """200 random polytopes: scale, coordinates, inside, and no variance gained."""
    slabs = Slabs(tuple(range(m)), tuple(range(m)))
    find = jax.jit(jax.vmap(lambda *args: restricted(*args, slabs)))
    mean, cov, rows, bound = systems(m, n)
    found = find(mean, cov, rows, bound)
    # expectation propagation settles to 1e-9, and its error need not keep the order exactly
    tolerance = 1e-9 if m < 4 else 1e-6
    rng = np.random.default_rng(1)
    factor = jnp.asarray(10 ** rng.uniform(-4, 4, size=bound.shape))
    again = find(mean, cov, factor[:, :, None] * rows, factor * bound)
    np.testing.assert_allclose(again.mean, found.mean, atol=tolerance)
    np.testing.assert_allclose(again.cov, found.cov, atol=tolerance)

    T = np.eye(n) + 0.4 * rng.normal(size=(200, n, n))
    moved = find(
        jnp.asarray(np.einsum("bij,bj->bi", T, mean)),
        jnp.asarray(T @ np.asarray(cov) @ np.swapaxes(T, 1, 2)),
        jnp.asarray(np.asarray(rows) @ np.linalg.inv(T)),
        bound,
    )
    # T is ill conditioned at times: 1e4 units of rounding
    tolerance *= 10
    np.testing.assert_allclose(moved.mean, np.einsum("bij,bj->bi", T, found.mean), atol=tolerance)
    turned = T @ np.asarray(found.cov) @ np.swapaxes(T, 1, 2)
    np.testing.assert_allclose(moved.cov, turned, atol=tolerance)

    slack = bound - jnp.einsum("bij,bj->bi", rows, found.mean)
    if m < 4:
        assert np.min(slack) > 0
    gained = np.linalg.eigvalsh(np.asarray(found.cov - cov))
    assert np.max(gained) < 1e-12 * np.max(np.abs(cov))


@pytest.mark.parametrize("g", [1, 2, 3, 4])
def test_a_set_that_contains_everything_changes_nothing(boxes, g):
    root = np.random.default_rng(g).normal(size=(g, g))
    cov = root @ root.T
    bound = 10.0 * np.sqrt(np.repeat(np.diag(cov), 2))
    bound[0] = INF
    found = boxes[g](jnp.asarray(cov)[None], jnp.asarray(bound)[None])
    np.testing.assert_array_equal(found.mean[0], np.zeros(g))
    np.testing.assert_array_equal(found.cov[0], cov)
    assert found.log_probability[0] == 0.0


@pytest.mark.parametrize("g", [1, 2, 3, 4])
def test_nothing_becomes_nan_or_infinite(boxes, g):
    ones, m = np.ones((g, g)), 2 * g
    covs = [np.eye(g), ones + np.eye(g), ones, 0 * ones, 1e-300 * np.eye(g), 1e200 * np.eye(g)]
    bounds = [
        np.full(m, INF), np.full(m, -INF), np.full(m, np.nan), np.full(m, -3.0), np.zeros(m),
        np.tile([2.0, -2.0], g), np.tile([2.0, -2.0 + 1e-12], g), np.tile([INF, -300.0], g),
        np.tile([1e9 + 1, -1e9], g), np.tile([1e300, 1e300], g), np.tile([INF, -1e300], g),
        np.resize([2.0, -1.5, -1.0, 2.0], m),
    ]  # fmt: skip
    pairs = [(V, b) for V in covs for b in bounds]
    V, b = (jnp.asarray(np.stack(part)) for part in zip(*pairs, strict=True))
    for part in boxes[g](V, b):
        assert np.all(np.isfinite(part))


def test_a_slab_without_width_pins_its_direction(boxes):
    """w_1 = 2 exactly: the other follows the conditional normal, truncated in its own slab."""
    V = jnp.asarray([[1.0, 0.6], [0.6, 1.0]])
    found = boxes[2](V[None], jnp.asarray(box_bound([2.0, -1.0], [2.0, 1.0]))[None])
    low, high = (-1.0 - 1.2) / 0.8, (1.0 - 1.2) / 0.8
    mean, variance, _ = scaled_interval(low, high)
    # the slab counts as NARROWEST wide
    np.testing.assert_allclose(found.mean[0], [2.0, 1.2 + 0.8 * mean], atol=NARROWEST)
    np.testing.assert_allclose(found.cov[0, 1, 1], 0.64 * variance, atol=NARROWEST)
    np.testing.assert_allclose(found.cov[0, 0, 0], 0.0, atol=NARROWEST**2)


def test_a_direction_without_variance_tells_nothing():
    """z_2 is known to be 5, outside its slab: z_1 is restricted as if that slab were not there."""
    rows = box_rows(2)
    cov = jnp.asarray([[4.0, 0.0], [0.0, 0.0]])
    bound = jnp.asarray([1.0, 1.0, 1.0, 1.0])
    found = restricted(jnp.asarray([0.5, 5.0]), cov, jnp.asarray(rows), bound, find_slabs(rows))
    mean, variance, log_probability = scaled_interval(-0.75, 0.25)
    # what two slabs keep
    np.testing.assert_allclose(found.mean, [0.5 + 2 * mean, 5.0], rtol=1e-10)
    np.testing.assert_allclose(found.cov, [[4 * variance, 0], [0, 0]], rtol=1e-10)
    assert found.log_probability == pytest.approx(log_probability, abs=1e-10)


def test_slabs_are_found_whatever_the_units():
    rows = np.array([[1e-9, 2.0], [0, 0], [-3e-9, -6.0], [0, 1.0], [2e-9, 4.0], [1e-9, 2.001]])
    slabs = find_slabs(rows)
    assert slabs == Slabs((0, -1, 0, 1, 0, 2), (0, 3, 5))
    assert hash(slabs) == hash(find_slabs(5.0 * rows))
    assert find_slabs(np.zeros((2, 3))) == Slabs((-1, -1), ())
