"""The filters' interaction against a textbook's recursion and against enumerated moments."""

import jax.numpy as jnp
import numpy as np
import pytest

import banks
import systems
from holdfast.estimators import nisme
from holdfast.estimators.bank import Covariances, Means
from holdfast.estimators.mixing import mixed
from holdfast.parts import InvalidValue
from holdfast.plants.switched import switched_plant

POSITIONS = ("a", "b", "c")


def textbook(A, C, Q, R, T, x0, P0, y, seen):
    """The interacting multiple model filter, in numpy and plain matrices."""
    count = len(A)
    x, P, p = np.tile(x0, (count, 1)), np.tile(P0, (count, 1, 1)), np.full(count, 1 / count)
    rows = []
    for row, there in zip(y, seen, strict=True):
        ahead = p @ T
        starts, likelihood = [], np.zeros(count)
        for j in range(count):
            w = T[:, j] * p / ahead[j]
            middle = w @ x
            starts.append((middle, sum(
                w[i] * (P[i] + np.outer(x[i] - middle, x[i] - middle)) for i in range(count)
            )))  # fmt: skip
        for j, (at, cov) in enumerate(starts):
            H, noise = C[j][there], R[np.ix_(there, there)]
            at, cov = A[j] @ at, A[j] @ cov @ A[j].T + Q
            S = H @ cov @ H.T + noise
            gain, nu = cov @ H.T @ np.linalg.inv(S), row[there] - H @ at
            x[j], P[j] = at + gain @ nu, cov - gain @ S @ gain.T
            size = np.linalg.slogdet(2 * np.pi * S)[1]
            likelihood[j] = -0.5 * (nu @ np.linalg.solve(S, nu) + size)
        p = ahead * np.exp(likelihood - likelihood.max())
        p /= p.sum()
        best = np.argmax(p)
        rows.append((x[best].copy(), P[best].copy(), p))
    return [np.stack(each) for each in zip(*rows, strict=True)]


def chain(rng, count):
    T = rng.uniform(0.02, 0.1, (count, count)) + np.eye(count)
    return T / T.sum(1, keepdims=True)


def test_positions_are_weighed_as_by_the_textbook():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(3, 2, 2))
    A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)), 1)[:, None, None]
    C = rng.normal(size=(3, 2, 2))
    Q, R, T = systems.covariance(rng, 2), systems.covariance(rng, 2), chain(rng, 3)
    tables = jnp.asarray(A), jnp.asarray(C)
    plant = switched_plant(
        lambda x, u, d, position: tables[0][position] @ x,
        lambda x, u, d, position: tables[1][position] @ x,
        positions=POSITIONS, Q=Q, R=R, dt=1.0, states=("x", "z"), outputs=("y1", "y2"),
    )  # fmt: skip
    y, seen = 3 * rng.normal(size=(60, 2)), np.ones((60, 2), bool)
    seen[::7, 0] = False
    x0, P0 = np.array([1.0, -1.0]), np.eye(2)
    built = nisme.build(
        plant, x0, P0, modes=[{"switch": name} for name in POSITIONS], floor=1e-200,
        transition=T.tolist(), mixing=True,
    )  # fmt: skip
    log = banks.log(np.zeros((60, 0)), y, seen, np.zeros(y.shape, bool))
    got = banks.ran(built, log)[1]
    assert len(set(np.asarray(got.mode).tolist())) == 3
    for ours, truth in zip(
        (got.x, got.x_cov, got.p), textbook(A, C, Q, R, T, x0, P0, y, seen), strict=True
    ):
        # both are exact; rounding leaves 1e-14 of numbers around 1
        np.testing.assert_allclose(ours, truth, rtol=1e-10, atol=1e-11)


def test_moments_are_those_of_the_mixture():
    """Of state and attack together, where an attack found at a row moves the state next."""
    rng = np.random.default_rng(1)
    count, n = 4, 2
    T, p = chain(rng, count), rng.dirichlet(np.ones(count))
    means = Means(
        jnp.asarray(rng.normal(size=(count, 1, n))), jnp.asarray(rng.normal(size=(count, 1, 1)))
    )
    P = np.stack([systems.covariance(rng, n) for _ in range(count)])
    Z = rng.normal(size=(count, 1, n + 1, n + 1))
    cov = Covariances(jnp.zeros((count, 1, 0), bool), jnp.asarray(P), jnp.asarray(Z))
    got, left = mixed(means, cov, jnp.log(jnp.asarray(p)), jnp.asarray(T))
    whole = Z[:, 0] @ np.swapaxes(Z[:, 0], 1, 2)
    whole[:, :n, :n] += P
    x = np.asarray(means.x[:, 0])
    for j in range(count):
        w = T[:, j] * p / (T[:, j] @ p)
        middle = w @ x
        moments = np.zeros((n + 1, n + 1))
        for i in range(count):
            own = whole[i].copy()
            if i != j:
                own[n, :n] = own[:n, n] = 0
                own[n, n] = whole[j][n, n]
            away = np.r_[x[i] - middle, 0]
            moments += w[i] * (own + np.outer(away, away))
        columns = np.asarray(left.Z[j, 0])
        ours = columns @ columns.T
        ours[:n, :n] += np.asarray(left.P[j])
        np.testing.assert_allclose(got.x[j, 0], middle, rtol=1e-12)
        np.testing.assert_allclose(ours, moments, rtol=1e-12)
        np.testing.assert_array_equal(got.d[j], means.d[j])


def test_what_cannot_be_mixed_is_refused():
    def built(n=1, **keys):
        plant = systems.quiet_plant(
            A=0.5 * np.eye(n), C=np.eye(n), G=np.zeros((n, 1)), H=np.ones((n, 1)),
            Q=np.eye(n), R=np.eye(n), attacks=["spoof"],
        )  # fmt: skip
        return nisme.build(plant, np.zeros(n), np.eye(n), mixing=True, **keys)

    for keys, words in [
        (dict(), "without transition"),
        (dict(transition=0.01, freeze=1e-6), "freeze"),
        (dict(transition=0.01, n=20), "large plant"),
    ]:
        with pytest.raises(InvalidValue, match=words):
            built(**keys)
