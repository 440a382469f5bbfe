"""The filter of authenticated samples, and how it joins the fusion.

Rounding: recursions of 40 to 200 steps on errors of size 1, 1e-12; what is joined is made 1e-8
more uncertain than it is (`witness.JITTER`).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.estimators import decomposition, kalman, secure_fusion
from holdfast.estimators.witness import JITTER
from holdfast.records import Status
from secured import complex_plant, estimates, followed, log, paper_plant
from systems import quiet_plant

PLANT = paper_plant()
SOME = ["y2", "y4"]
STEPS = 80


def built(members, plant=PLANT, P0=None, **keys):
    return secure_fusion.build(plant, P0=P0, authenticated=members, **({"gamma": 2.0} | keys))


def now_and_then(share, steps=STEPS, m=5, seed=1):
    return np.random.default_rng(seed).random((steps, m)) < share


def joint(watch, state, k):
    """[[W, X], [X', P]] of a row."""
    X, P = state.witness.X[k], state.witness.P[k]
    return np.block([[np.asarray(watch.W), X], [X.T, P]])


def recursion(watch, plant, P0, used):
    """The joint covariance of G x - zeta and U' x - s as one matrix, s corrected by ``used``."""
    A, C, Q, R = (np.asarray(getattr(plant, name)) for name in "ACQR")
    U, S, b, G = (np.asarray(getattr(watch, name)) for name in ("U", "S", "b", "G"))
    m, N, q = len(C), len(G), U.shape[1]
    A_s = np.linalg.lstsq(U, A.T @ U, rcond=None)[0].T  # U' A = A_s U'
    np.testing.assert_allclose(U.T @ A, A_s @ U.T, atol=1e-12)
    whole = np.zeros((N + q, N + q))
    whole[:N, :N], whole[N:, N:] = watch.W, U.T @ P0 @ U
    move = np.zeros_like(whole)
    move[:N, :N], move[N:, N:] = np.kron(np.eye(m), S), A_s
    for now in used:
        P = A_s @ whole[N:, N:] @ A_s.T + U.T @ Q @ U
        H, Rs = (C @ U)[now], R[np.ix_(now, now)]
        gain = np.zeros((q, m))
        gain[:, now] = np.linalg.solve(H @ P @ H.T + Rs, H @ P).T
        correct = np.eye(N + q)
        correct[N:, N:] -= gain @ C @ U
        from_w = correct @ np.vstack([G, U.T])
        from_w[:N] -= np.kron(C, b[:, None])
        from_v = np.vstack([np.kron(np.eye(m), b[:, None]), gain])
        whole = correct @ move @ whole @ move.T @ correct.T
        whole = whole + from_w @ Q @ from_w.T + from_v @ R @ from_v.T
    return whole


@pytest.mark.parametrize(("plant", "members"), [
    (PLANT, SOME), pytest.param(complex_plant(), ["y1", "y3"], marks=pytest.mark.slow),
], ids=["paper", "complex"])  # fmt: skip
def test_the_joint_covariance(plant, members):
    """Against the recursion of the whole matrix; F [G; U'] = I, F W F' = P and Z' W Z = I."""
    m = len(plant.outputs)
    P0 = np.diag([3.0, 2.0, 1.0])
    one = built(members, plant, P0)
    of = log(plant, np.zeros(m), STEPS)
    trusted = now_and_then(0.3, m=m)
    state, _ = followed(one, *of.all_seen, trusted)
    used = trusted & np.isin(plant.outputs, members)
    watch, k = one.witness, 40
    whole = recursion(watch, plant, P0, used[: k + 1])
    found = joint(watch, state, k)
    np.testing.assert_allclose(found, whole, atol=1e-11 * np.max(np.abs(whole)))

    F, Z, P = watch.joined(jax.tree.map(lambda a: jnp.asarray(a[k]), state.witness))
    G = np.vstack([watch.G, np.asarray(watch.U).T])
    np.testing.assert_allclose(F @ G, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(F @ whole @ F.T, P, atol=10 * JITTER)
    # 1e-8 of s's variance is 2e-5 of what is left of it where the local estimates know better
    np.testing.assert_allclose(Z.T @ whole @ Z, np.eye(Z.shape[1]), atol=1e-4)
    np.testing.assert_allclose(Z.T @ G, 0.0, atol=1e-8)
    # no better than the Kalman filter, which is best on the same samples
    assert np.trace(P) >= np.trace(np.asarray(one.fusion.P)) * (1 - 1e-7)


@pytest.mark.slow
def test_the_joint_covariance_is_that_of_the_errors():
    """2000 periods of ten rows with the same flags, after which nothing is remembered. An entry
    of a sample covariance is known to sqrt(2 / 2000) = 3 % of the product of the scales; 5 of
    these, there being hundreds of entries.
    """
    periods, length = 2000, 10
    trusted = np.tile(now_and_then(0.4, length), (periods, 1))
    one, of = built(SOME, gamma=1e6), log(PLANT, np.zeros(5), periods * length)
    state, _ = followed(one, *of.all_seen, trusted)
    last = slice(length - 1, None, length)
    G, U = np.asarray(one.witness.G), np.asarray(one.witness.U)
    errors = np.hstack([(of.x @ G.T - state.zeta)[last], (of.x @ U - state.witness.s)[last]])
    errors, whole = errors[10:], joint(one.witness, state, -1)
    scale = np.sqrt(np.diagonal(whole))
    found = errors.T @ errors / len(errors) / np.outer(scale, scale)
    correlation = whole / np.outer(scale, scale)
    np.testing.assert_allclose(found, correlation, atol=5 * np.sqrt(2 / len(errors)))
    # X is not small: one that is left out would be seen
    assert np.max(np.abs(correlation[: len(G), len(G) :])) > 0.5
    assert np.all(np.abs(errors.mean(0)) < 5 * scale / np.sqrt(len(errors)))


@pytest.mark.parametrize("members", [
    ["y2", "y3", "y5"], pytest.param(["y1"], marks=pytest.mark.slow),
])  # fmt: skip
def test_always_authenticated_is_the_kalman_filter_of_those(members):
    """The time-varying one, gaps included; y1 alone sees one state of three."""
    keep = [PLANT.outputs.index(name) for name in members]
    P0 = np.diag([3.0, 2.0, 1.0])
    one = built(members, P0=P0)
    of = log(PLANT, np.zeros(5), STEPS)
    seen = np.random.default_rng(2).random(of.y.shape) < 0.8
    state, _ = followed(one, of.u, of.y, seen, np.ones(seen.shape, bool))
    C, R = np.asarray(PLANT.C)[keep], np.asarray(PLANT.R)[np.ix_(keep, keep)]
    fewer = quiet_plant(A=PLANT.A, B=PLANT.B, C=C, Q=PLANT.Q, R=R)
    truth = estimates(kalman.build(fewer, np.zeros(3), P0), of.u, of.y[:, keep], seen[:, keep])
    U = np.asarray(one.witness.U)
    assert U.shape[1] == (1 if members == ["y1"] else 3)
    np.testing.assert_allclose(state.witness.s, truth.x @ U, atol=1e-10)
    P = np.einsum("iq,kij,jr->kqr", U, truth.x_cov, U)
    np.testing.assert_allclose(state.witness.P, P, atol=1e-10)


def test_everything_authenticated():
    """Joint covariances are then singular: the filter says what the local estimates say."""
    of = log(PLANT, np.zeros(5), STEPS)
    got = estimates(built(PLANT.outputs), *of.all_seen, np.ones((STEPS, 5), bool))
    truth = estimates(decomposition.build(PLANT), *of.all_seen)
    assert np.all(got.status == 0)
    np.testing.assert_allclose(got.x[20:], truth.x[20:], atol=1e-3)
    np.testing.assert_allclose(got.x_cov[20:], truth.x_cov[20:], atol=1e-6)


def test_flags_of_others_change_nothing():
    of = log(PLANT, np.zeros(5), STEPS)
    one, trusted = built(SOME), now_and_then(0.3)
    others = trusted | ~np.isin(PLANT.outputs, SOME)
    first, second = (followed(one, *of.all_seen, flags) for flags in (trusted, others))
    for a, b in zip(first[1].x, second[1].x, strict=True):
        np.testing.assert_array_equal(a, b)
    # and without members nobody's do
    plain = built([])
    assert plain.witness is None
    with_flags = estimates(plain, *of.all_seen, others)
    np.testing.assert_array_equal(with_flags.x, estimates(plain, *of.all_seen).x)


def lie(size, trusted):
    """y2 lies unless its sample is authenticated."""
    a = np.zeros(trusted.shape)
    a[:, 1] = np.where(trusted[:, 1], 0.0, size)
    return log(PLANT, a, len(trusted))


def test_a_lie_until_the_sample_is_authenticated():
    """y2 lies by 1e6 whenever it can, more than the fusion withstands. All samples are
    authenticated one time in five: the error is that of a filter with so few, of a mode that
    doubles every row, while the local estimates are wrong throughout."""
    trusted = now_and_then(0.2, 200)
    found = {}
    for size in (1e3, 1e6):
        of = lie(size, trusted)
        state, got = followed(built(PLANT.outputs), *of.all_seen, trusted)
        found[size] = np.max(np.abs(got.x - of.x)[50:])
        assert not np.any(got.status & int(Status.NOT_CONVERGED))
        zeta = state.zeta.reshape(200, 5, -1)[50:, 1]
        assert np.min(np.max(np.abs(zeta), 1)) > 0.1 * size
        without = estimates(built([]), *of.all_seen, trusted)
        assert np.max(np.abs(without.x - of.x)[50:]) > 0.1 * size
    print(f"largest error under a lie of 1e3 and of 1e6: {found[1e3]:.3g}, {found[1e6]:.3g}")
    assert found[1e6] < 200
    assert found[1e6] < 1.1 * found[1e3]


def test_one_good_sample_does_not_clean_a_local_estimate():
    """What the filter is for: fed with the authenticated sample, the local estimate of y2 is
    still wrong by 0.28^k of the lie k rows later."""
    a = np.zeros((60, 5))
    a[:40, 1] = 1e6
    of = log(PLANT, a, 60)
    state, _ = followed(built(SOME), *of.all_seen)
    off = np.max(np.abs(state.zeta.reshape(60, 5, -1)[:, 1]), 1)
    assert off[40] > 1e4
    assert off[45] > 100


def test_nobody_vouches_for_an_unstable_mode():
    """The mode doubles every row and no sample is authenticated any more: 2^3000 would be
    infinite. The filter starts again about the secure estimate and has no say: 1e-8 of it."""
    steps = 3000
    trusted = now_and_then(0.5, steps)
    trusted[20:] = False
    of = log(PLANT, np.zeros(5), steps)
    one = built(SOME)
    state, got = followed(one, *of.all_seen, trusted)
    for name in ("x", "x_cov", "residual", "residual_cov", "a"):
        assert np.all(np.isfinite(getattr(got, name))), name
    assert np.all(got.status == 0)
    variance = np.diagonal(state.witness.P, axis1=1, axis2=2)
    # the next step after the limit is 4 times as large at most
    assert np.all(variance <= 5 * np.diagonal(one.witness.vague))
    plain = estimates(built([]), *of.all_seen)
    assert np.max(np.abs(got.x - plain.x)[60:]) < 1e-2
    # and is of use again once a sample comes
    trusted[-100:] = True
    again, _ = followed(one, *of.all_seen, trusted)
    assert np.max(np.abs(again.witness.P[-1])) < 1e2


def test_the_estimate_is_unbiased():
    """4000 rows with samples authenticated now and then; 4 standard errors, of means of 100."""
    steps = 4000
    of = log(PLANT, np.zeros(5), steps)
    got = estimates(built(SOME), *of.all_seen, now_and_then(0.3, steps))
    error = (got.x - of.x)[100:].reshape(-1, 100, 3).mean(1)
    assert np.all(np.abs(error.mean(0)) < 4 * error.std(0) / np.sqrt(len(error)))
    assert np.mean((got.x - of.x) ** 2) * 3 < 1.1 * np.trace(np.asarray(built([]).P0))
