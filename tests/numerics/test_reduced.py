"""The coordinates of a regression against NumPy's factorisations."""

import jax
import numpy as np
import pytest

from holdfast.numerics.reduced import orthonormal, reduced

SHAPE = (12, 5)
CLOSE = 1e-12
"""Rounding, times conditions of 1e3 at most in what follows."""
SOLVE = jax.jit(reduced)
TAKE = jax.jit(orthonormal)


def rows_of(kind, seed):
    rng = np.random.default_rng(seed)
    Phi = rng.normal(size=SHAPE)
    if kind == "rank":
        Phi = Phi[:, :3] @ rng.normal(size=(3, 5))
    elif kind == "zero columns":
        Phi[:, [1, 3]] = 0.0
    elif kind == "few rows":
        Phi[3:] = 0.0
    elif kind == "nothing":
        Phi[:] = 0.0
    elif kind == "alike":
        Phi[:, 2] = -3.0 * Phi[:, 0]
    return Phi


KINDS = ("dense", "rank", "zero columns", "few rows", "nothing", "alike")


def projector(basis):
    """On the span of the columns."""
    left, values, _ = np.linalg.svd(basis)
    left = left[:, : np.sum(values > 1e-9 * max(values[0], 1.0))]
    return left @ left.T


@pytest.mark.parametrize("kind", KINDS)
def test_orthonormal(kind):
    for seed in range(5):
        rows = rows_of(kind, seed)
        # columns are expected to be about one long
        size = np.linalg.norm(rows, axis=0)
        rows = rows / np.where(size > 0, size, 1.0)
        found = jax.tree.map(np.asarray, TAKE(rows))
        rank = np.linalg.matrix_rank(rows, tol=1e-9)
        assert found.rank == rank
        expected = np.diag(1.0 * (np.arange(5) < rank))
        np.testing.assert_allclose(found.columns.T @ found.columns, expected, atol=1e-14)
        np.testing.assert_allclose(rows @ found.by, found.columns, atol=CLOSE)
        np.testing.assert_allclose(projector(found.columns), projector(rows), atol=CLOSE)
        np.testing.assert_allclose(rows @ found.rest, 0.0, atol=CLOSE)
        unseen = np.eye(5) - projector(rows.T)
        np.testing.assert_allclose(projector(found.rest), unseen, atol=CLOSE)
        assert np.sum(np.any(found.rest != 0, 0)) == 5 - rank


@pytest.mark.parametrize("units", [np.ones(5), 10.0 ** np.array([-3, 0, 2, -2, 3])],
                         ids=["plain", "units"])  # fmt: skip
@pytest.mark.parametrize("kind", KINDS)
def test_without_exact_rows(kind, units):
    """target = columns z is y = Phi x: the same span, the same least squares, x of least norm."""
    for seed in range(5):
        rng = np.random.default_rng(seed + 50)
        Phi, y, weight = rows_of(kind, seed) * units, rng.normal(size=12), rng.uniform(0, 2, 12)
        weight[:2] = 0.0
        found = jax.tree.map(np.asarray, SOLVE(Phi, y, weight, np.zeros(12, bool)))
        rows = Phi * weight[:, None]
        rank = np.linalg.matrix_rank(rows / units, tol=1e-9)
        assert found.free == found.rank == rank
        np.testing.assert_array_equal(found.target, y * weight)
        np.testing.assert_allclose(rows @ found.back, found.columns, atol=CLOSE)
        assert not found.start.any()
        assert not found.lead.any()
        z = found.columns.T @ found.target
        x = np.asarray(jax.jit(type(found).state)(found, z))
        np.testing.assert_allclose(rows @ x, projector(rows / units) @ (y * weight), atol=1e-11)
        np.testing.assert_allclose(rows / units @ (units[:, None] * found.hidden), 0.0,
                                   atol=1e-11 * units.max())  # fmt: skip
        filled = np.sum(np.any(found.hidden != 0, 0))
        assert filled == 5 - rank
        expected = np.diag(1.0 * (np.arange(5) < filled))
        np.testing.assert_allclose(found.hidden.T @ found.hidden, expected, atol=1e-13)
        if np.all(units == 1):
            smallest = np.linalg.pinv(rows, rcond=1e-9) @ (y * weight)
            np.testing.assert_allclose(x, smallest, atol=CLOSE)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 3, 8])
def test_exact_rows_come_first(kind, count):
    """start is their weighted least squares, of any z; columns are the others' on what is left."""
    for seed in range(5):
        rng = np.random.default_rng(seed + 70)
        Phi, y, weight = rows_of(kind, seed), rng.normal(size=12), rng.uniform(0.5, 2, 12)
        exact = np.isin(np.arange(12), rng.choice(12, count, replace=False))
        found = jax.tree.map(np.asarray, SOLVE(Phi, y, weight, exact))
        rows, goal = Phi * weight[:, None], y * weight
        first, rest = rows * exact[:, None], rows * ~exact[:, None]
        fit = projector(first) @ (goal * exact)
        for z in (np.zeros(5), rng.normal(size=5)):
            x = np.asarray(jax.jit(type(found).state)(found, z))
            np.testing.assert_allclose(first @ x, fit, atol=1e-11)
            # what the others miss, with and without the reduction
            z = np.where(np.arange(5) < found.free, z, 0.0)
            left = found.target - found.columns @ z
            np.testing.assert_allclose(left, (goal - rows @ x) * ~exact, atol=1e-11)
        np.testing.assert_allclose(found.start, found.lead @ y, atol=CLOSE)
        assert not np.any(found.lead[:, ~exact])
        loose = np.eye(5) - projector(first.T)
        np.testing.assert_allclose(projector(found.columns), projector(rest @ loose), atol=1e-11)
        unseen = np.eye(5) - projector(rows.T)
        np.testing.assert_allclose(found.hidden @ found.hidden.T, unseen, atol=1e-11)
        assert found.rank == round(5 - np.trace(unseen))
        assert found.free == found.rank - np.linalg.matrix_rank(first, tol=1e-9)


def test_exact_rows_that_are_not_there():
    """A flag without a row, or none at all: as if nothing were exact."""
    Phi, y = rows_of("dense", 0), np.arange(12.0)
    weight = np.where(np.arange(12) < 2, 0.0, 1.0)
    plain = SOLVE(Phi, y, weight, np.zeros(12, bool))
    flagged = SOLVE(Phi, y, weight, np.arange(12) < 2)
    for a, b in ((plain, flagged), (plain, jax.jit(reduced)(Phi * weight[:, None], y * weight))):
        fit = [np.asarray(r.state(r.columns.T @ r.target)) for r in (a, b)]
        np.testing.assert_allclose(fit[0], fit[1], atol=CLOSE)
        assert a.rank == b.rank == 5
