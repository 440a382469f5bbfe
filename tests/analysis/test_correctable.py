"""What decoders correct: against zero patterns by brute force, linear programmes and decoding."""

import itertools

import jax
import numpy as np
import pytest
from scipy.linalg import block_diag, null_space
from scipy.optimize import linprog

from analysis.models import model
from holdfast.analysis import correctable as module
from holdfast.analysis import windows
from holdfast.analysis.correctable import correctable
from holdfast.analysis.supports import cancellations, fewest_samples, sharper, theorem_1
from holdfast.numerics.l1_regression import l1_regression
from holdfast.numerics.ratio_bounds import bounded, largest
from holdfast.numerics.rays import worst
from holdfast.numerics.zero_patterns import counted

ROTATION = np.array([[0.0, -1.0], [1.0, 0.0]])
SIGNS = np.array([[1.0, 1.0], [1.0, -1.0], [1.0, 1.0], [1.0, -1.0]])


def of(A, C):
    A = np.asarray(A, float)
    return model(A, np.zeros((len(A), 0)), np.asarray(C, float))


def window_of(A, C, T):
    """Phi, (T p x n)."""
    return np.vstack(
        [np.asarray(C, float) @ np.linalg.matrix_power(np.asarray(A, float), t) for t in range(T)]
    )


def integers(seed):
    """A small system with many coincidences, observable in its window; None if it is not."""
    rng = np.random.default_rng(seed)
    n, p, T = int(rng.integers(1, 4)), int(rng.integers(3, 6)), int(rng.integers(1, 4))
    A = rng.integers(-1, 2, (n, n)).astype(float)
    C = rng.integers(-2, 3, (p, n)).astype(float)
    return (A, C, T) if np.linalg.matrix_rank(window_of(A, C, T)) == n else None


def patterns(Phi, T):
    """s_t of a generic z in the kernel of each set of rows: all there are (k x T)."""
    rng, n = np.random.default_rng(0), Phi.shape[1]
    found = set()
    for k in range(n):
        for rows in itertools.combinations(range(len(Phi)), k):
            space = null_space(Phi[list(rows)], rcond=1e-9) if rows else np.eye(n)
            seen = np.abs(Phi @ space @ rng.normal(size=space.shape[1])) > 1e-7
            found.add(tuple(seen.reshape(T, -1).sum(1).tolist()))
    return np.array(sorted(found))


def by_patterns(Phi, T, most):
    """l0, any and the cospark, from their conditions."""
    s = patterns(Phi, T)
    good = [np.all(s.sum(1) > 2 * np.minimum(q, s).sum(1)) for q in range(1, most + 1)]
    some = [np.all(s.max(1) > 2 * q) for q in range(1, most + 1)]
    return int(np.cumprod(good).sum()), int(np.cumprod(some).sum()), int(s.sum(1).min())


def worst_ratio(Phi, T, q):
    """The worst l1 ratio, a linear programme for every attacked set and all signs; and its z."""
    n, p = Phi.shape[1], len(Phi) // T
    best = (-1.0, None, None)
    for sets in itertools.product(itertools.combinations(range(p), q), repeat=T):
        attacked = np.zeros((T, p), bool)
        for t, chosen in enumerate(sets):
            attacked[t, list(chosen)] = True
        own, rest = Phi[attacked.ravel()], Phi[~attacked.ravel()]
        slack = np.eye(len(rest))
        A_ub = np.vstack([np.hstack([rest, -slack]), np.hstack([-rest, -slack])])
        A_ub = np.vstack([A_ub, np.append(np.zeros(n), np.ones(len(rest)))])
        b_ub = np.append(np.zeros(2 * len(rest)), 1.0)
        for signs in itertools.product([1.0, -1.0], repeat=len(own) - 1):
            c = np.append(-np.append(1.0, signs) @ own, np.zeros(len(rest)))
            done = linprog(c, A_ub, b_ub, bounds=[(None, None)] * n + [(0, None)] * len(rest))
            if done.status == 3:
                return np.inf, None, attacked.ravel()
            if -done.fun > best[0]:
                best = (-done.fun, done.x[:n], attacked.ravel())
    return best


def decoded(Phi, y):
    """Least absolute errors."""
    N, n = Phi.shape
    A_ub = np.vstack([np.hstack([Phi, -np.eye(N)]), np.hstack([-Phi, -np.eye(N)])])
    c = np.append(np.zeros(n), np.ones(N))
    return linprog(c, A_ub, np.append(y, -y), bounds=[(None, None)] * n + [(0, None)] * N).x[:n]


def test_the_conditions_are_those_of_the_decoders():
    """From the definition: every attacked set against every zero pattern's samples themselves."""
    for A, C, T in filter(None, map(integers, range(40))):
        Phi, p = window_of(A, C, T), len(C)
        if p**T > 150:
            continue
        rng, n, fails = np.random.default_rng(0), len(A), False
        choices = list(itertools.product(range(p), repeat=T))
        for k in range(n):
            for rows in itertools.combinations(range(p * T), k):
                space = null_space(Phi[list(rows)], rcond=1e-9) if rows else np.eye(n)
                Y = (Phi @ space @ rng.normal(size=space.shape[1])).reshape(T, p)
                Y[np.abs(Y) < 1e-7] = 0.0
                for chosen in choices:
                    e = np.zeros((T, p))
                    e[range(T), chosen] = Y[range(T), chosen]
                    # another state leaves no more samples unexplained than the true one
                    fails |= np.count_nonzero(e - Y) <= np.count_nonzero(e)
        found = correctable(of(A, C), T)
        assert (found.l0.exact == 0) == fails


def test_counts_are_those_of_brute_force():
    looked = 0
    for A, C, T in filter(None, map(integers, range(120))):
        found = correctable(of(A, C), T)
        l0, some, cospark = by_patterns(window_of(A, C, T), T, found.most)
        assert (found.l0.exact, found.any.exact, found.cospark.exact) == (l0, some, cospark)
        assert found.relaxed.exact == -(-cospark // 2) - 1
        # what the paper asks for is enough, whoever the q of each step are
        assert all(found.l0.exact >= q for q in range(found.most + 1) if cospark > 2 * q * T)
        looked += 1
    assert looked > 60


def test_ratios_are_those_of_linear_programmes():
    looked = 0
    for A, C, T in filter(None, map(integers, range(200, 260))):
        if len(C) ** T * 2**T > 220:
            continue
        found = correctable(of(A, C), T)
        ratio, z, attacked = worst_ratio(window_of(A, C, T), T, 1)
        np.testing.assert_array_equal(found.lower, found.upper)
        if found.any.exact:
            np.testing.assert_allclose(found.lower[0], ratio, rtol=1e-7)
        else:
            assert found.lower[0] >= 1.0
        looked += 1
        if z is None or abs(ratio - 1.0) < 1e-6:
            continue
        # the attack that the ratio is about
        Phi = window_of(A, C, T)
        wrong = np.abs(decoded(Phi, Phi @ z * attacked)).max() > 1e-6 * np.abs(z).max()
        assert wrong == (found.l1.exact == 0)
    assert looked > 20


@pytest.mark.parametrize(("seed", "n", "p", "T"), [(0, 2, 4, 3), (1, 3, 5, 4), (2, 2, 5, 2)])
def test_what_is_certain_is_decoded(seed, n, p, T):
    """Random attacks, large and small, at other sensors at every step, by the product's decoder."""
    rng = np.random.default_rng(seed)
    A, C = rng.normal(size=(n, n)), rng.choice([-1.0, 1.0], (p, n)) * rng.uniform(1, 1.5, (p, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    found, Phi = correctable(of(A, C), T), window_of(A, C, T)
    q = found.l1.exact
    assert q is not None
    assert q > 0
    solve = jax.jit(l1_regression)
    for _ in range(60):
        x, e = rng.normal(size=n), np.zeros((T, p))
        for t in range(T):
            e[t, rng.permutation(p)[:q]] = 10.0 ** rng.uniform(-3, 6) * rng.normal(size=q)
        # samples of 1e6 are held to 1e-10, and states are at most some ten times less exact
        np.testing.assert_allclose(solve(Phi, Phi @ x + e.ravel()).x, x, atol=1e-9)


def test_errata_1():
    """The l0 condition holds and l1 is wrong: y = (0, 1, 1), x = 1."""
    A, C = [[1.0]], [[100.0], [1.0], [1.0]]
    for T in (1, 4):
        found = correctable(of(A, C), T)
        assert (found.l0.exact, found.l1.exact, found.fixed_l0, found.fixed_l1.exact) == (
            1,
            0,
            1,
            0,
        )
        assert found.upper[0] == pytest.approx(50.0)
        y = window_of(A, C, T)[:, 0] - 100.0 * (np.arange(3 * T) % 3 == 0)
        assert decoded(window_of(A, C, T), y) == pytest.approx(0.0, abs=1e-9)
    # weighted by the noise that goes with such a sensor, the three are alike
    even = correctable(of(A, C), 1, weight=np.array([0.01, 1.0, 1.0]))
    assert (even.l1.exact, even.upper[0]) == (1, pytest.approx(0.5))


def test_the_paper_s_sum_is_not_needed():
    """A = 0: nothing is seen at the second step, and nothing can be attacked there."""
    found = correctable(of([[0.0]], np.ones((3, 1))), 2)
    assert (found.cospark.exact, found.l0.exact, found.l1.exact) == (3, 1, 1)


def test_l1_corrects_what_l0_does_not():
    """z = (1, 1) is seen by one sensor at t = 0 and three at t = 1: 2 samples against 2."""
    A, C = np.diag([0.5, 1.0]), np.array([[1.0, -1.0], [1.0, -1.0], [1.0, -0.9]])
    found = correctable(of(A, C), 2)
    assert (found.l0.exact, found.l1.exact, found.any.exact) == (0, 1, 1)
    z = np.array([1.0, 1.0])
    e = np.array([0.0, 0.0, 0.1, -0.5, 0.0, 0.0])
    rest = e - window_of(A, C, 2) @ z
    assert np.count_nonzero(np.abs(rest) > 1e-12) == np.count_nonzero(e) == 2
    np.testing.assert_allclose(decoded(window_of(A, C, 2), e), 0.0, atol=1e-9)


@pytest.mark.parametrize("A", [ROTATION, np.diag([1.0, -1.0])], ids=["complex", "negative"])
def test_errata_2(A):
    """All four sensors see each eigenvector, and yet z = e_1 or (1, 1) is seen by two a step."""
    for T in range(2, 13):
        found = correctable(of(A, SIGNS), T)
        assert found.supports == (4, 4)
        assert (found.l0.exact, found.any.exact, found.l1.exact) == (0, 0, 0)
        assert (found.fixed_l0, found.smallest) == (1, (windows.Smallest(None, None, None),))


def test_theorem_1_must_be_36():
    """n = 8, p = 10, q = 4, every sensor sees every mode: the bound 35 is strict."""
    rng = np.random.default_rng(0)
    V = rng.normal(size=(8, 8))
    whole = of(V @ np.diag(np.linspace(0.5, 0.95, 8)) @ np.linalg.inv(V), rng.normal(size=(10, 8)))
    assert [theorem_1(whole, q) for q in (1, 2, 3, 4, 5)] == [9, 12, 18, 36, None]
    assert sharper(whole, 4) == 36
    cancelled = cancellations(whole)
    assert [fewest_samples(cancelled, T) > 8 * T for T in (35, 36)] == [False, True]


def test_windows_in_order_where_the_theorem_applies():
    """Exact <= sharper <= Theorem 1; the exact one is the first that brute force finds."""
    looked = sharp = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        n, p = int(rng.integers(2, 4)), int(rng.integers(3, 6))
        V = rng.integers(-2, 3, (n, n)) + 3.0 * np.eye(n)
        A = V @ np.diag(rng.permutation([0.9, 0.6, 0.3])[:n]) @ np.linalg.inv(V)
        C = rng.integers(-1, 2, (p, n)).astype(float)
        for q, found in enumerate(correctable(of(A, C), n).smallest, 1):
            if found.theorem_1 is None or found.sharper is None:
                continue
            assert found.exact is not None
            assert found.exact <= found.sharper <= found.theorem_1
            first = next(T for T in range(1, 40) if by_patterns(window_of(A, C, T), T, q)[0] == q)
            assert found.exact == first
            looked += 1
            sharp += found.sharper < found.theorem_1
    assert looked > 5
    assert sharp > 0


def test_decoupled_plants_are_the_whole():
    """Two or three plants under one roof, with sensors of their own, in any order."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        T = 2 + seed % 2
        A = block_diag(rng.integers(-1, 2, (2, 2)), rng.normal(size=(1, 1)))
        C = block_diag(rng.integers(-2, 3, (4, 2)), rng.integers(1, 4, (3, 1))).astype(float)
        order = rng.permutation(3)
        A, C = A[np.ix_(order, order)], C[:, order]
        if np.linalg.matrix_rank(window_of(A, C, T)) < 3:
            continue
        both, Phi = of(A, C), window_of(A, C, T)
        found = correctable(both, T)
        assert (found.l0.exact, found.any.exact, found.cospark.exact) == by_patterns(Phi, T, 3)
        assert len(windows.parts(both, T)) > 1
        # the same rows, every state in every one of them: rays of the whole
        mixed = Phi @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
        (part,) = module.components(mixed[:, None], np.zeros(1, int))
        whole = worst([part], part.blocks, 3, steps=T)
        some = found.any.exact or 0
        np.testing.assert_allclose(found.lower[:some], whole.lower_sets[:some], rtol=1e-9)


def test_order_of_the_decoders():
    """Neither l0 nor l1 corrects what no decoder can; sensors that stay are easier."""
    for A, C, T in filter(None, map(integers, range(300, 400))):
        found = correctable(of(A, C), T)
        assert found.l0.upper <= found.any.upper
        assert found.l1.upper <= found.any.upper
        assert found.fixed_l0 is not None
        assert found.any.upper <= found.fixed_l0
        assert found.fixed_l1.upper <= found.fixed_l0
        # wherever the attacked samples are, l0 does whatever l1 does
        for part in windows.parts(of(A, C), T):
            anywhere = worst([part], part.blocks, part.blocks).upper_sets
            l1 = np.sum(np.cumprod(anywhere < module.CERTAIN))
            assert l1 <= (counted(part, T, 1, 1e8).fewest - 1) // 2


def test_fixed_sensors_are_those_that_can_go():
    """Against the rank of what is left, windows shorter than n among them."""
    looked = 0
    for A, C, T in filter(None, map(integers, range(400, 460))):
        p, found = len(C), correctable(of(A, C), T)
        Phi = window_of(A, C, T).reshape(T, p, -1)
        truth = 0
        for q in range(1, found.most + 1):
            sets = itertools.combinations(range(p), p - 2 * q)
            ranks = [np.linalg.matrix_rank(Phi[:, list(kept)].reshape(-1, len(A))) for kept in sets]
            if min(ranks) < len(A):
                break
            truth = q
        assert found.fixed_l0 == truth
        looked += len(A) > T
    assert looked > 5


def test_trusted_sensors_leave_what_they_do_not_see():
    looked = 0
    for A, C, T in filter(None, map(integers, range(500, 560))):
        Phi, p = window_of(A, C, T), len(C)
        space = null_space(Phi[::p], rcond=1e-9)
        found = correctable(of(A, C), T, trusted=(0,))
        if not space.shape[1]:
            assert found.l0.exact == found.l1.exact == found.most
            continue
        rest = np.delete(Phi, np.arange(T) * p, axis=0) @ space
        l0, some, cospark = by_patterns(rest, T, found.most)
        assert (found.l0.exact, found.any.exact, found.cospark.exact) == (l0, some, cospark)
        looked += 1
    assert looked > 5


def test_intervals_contain_the_truth(monkeypatch):
    """The same plants with next to nothing to spend."""
    for seed in range(8):
        rng = np.random.default_rng(seed)
        n, p = (3, 5) if seed < 4 else (4, 4)
        A, C = rng.normal(size=(n, n)), rng.normal(size=(p, n))
        A = A * 0.9 / np.abs(np.linalg.eigvals(A)).max()
        T = 6
        monkeypatch.undo()
        exact = correctable(of(A, C), T)
        monkeypatch.setattr(module, "LIMIT", 300.0)
        monkeypatch.setattr(windows, "SEARCHED", 5_000.0)
        found = correctable(of(A, C), T)
        for name in ("l0", "l1", "any", "cospark", "relaxed"):
            lower, upper = getattr(found, name)
            assert lower <= getattr(exact, name).exact <= upper
        assert np.all(found.lower <= exact.lower * (1 + 1e-9))
        assert np.all(exact.lower <= found.upper * (1 + 1e-9))
        assert found.cospark.exact is None
        assert np.all(found.lower >= 0.8 * exact.lower)
        # shorter windows, of which this one consists, say it all
        assert found.l0.lower >= exact.l0.lower - 1


def test_certificates_by_steps():
    """Bounds of sets that take some of each step, against all rays."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        (part,) = windows.parts(of(rng.normal(size=(3, 3)) / 2, rng.normal(size=(7, 3))), 4)
        exact, interval = worst([part], 28, 3, steps=4), bounded(part, 3, 1e8, 4)
        np.testing.assert_array_equal(exact.lower_sets, exact.upper_sets)
        assert np.all(interval.lower_sets <= exact.lower_sets * (1 + 1e-12))
        assert np.all(interval.lower_sets >= 0.98 * exact.lower_sets)
        assert np.all(interval.upper_sets >= exact.lower_sets * (1 - 1e-12))
        assert interval.upper_sets[0] <= 2.0 * exact.lower_sets[0]
        g = part.sums(rng.normal(size=(50_000, 3)))
        assert np.all(largest(g, 3, 4).max(0) <= exact.upper_sets * (1 + 1e-9))


def test_counts_in_whole_numbers():
    """Cross products of integer rows, of 9 steps that span eight powers of ten: no rounding."""
    A = np.array([[10, 1, 0], [0, 9, 2], [0, 0, 1]])
    T, p, most = 9, 5, 2
    for seed in range(6):
        rng = np.random.default_rng(seed)
        C = rng.integers(-1, 2, (p, 3))
        rows = [C.astype(object)]
        for _ in range(T - 1):
            rows.append(rows[-1] @ A.astype(object))
        rows = list(np.concatenate(rows))
        # a row of its own for a set of fewer than two
        many = [*rows, *rng.integers(-(10**6), 10**6, (2, 3)).astype(object)]
        found = set()
        for a, b in itertools.combinations(many, 2):
            z = np.array(
                [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
            )
            if np.any(z != 0):
                seen = np.array([row @ z != 0 for row in rows])
                found.add(tuple(seen.reshape(T, p).sum(1).tolist()))
        s = np.array(sorted(found))
        if s.sum(1).min() == 0:
            continue
        whole = counted_of(A / 10.0, C, T, most)
        share = [(np.minimum(q, s).sum(1) / s.sum(1)).max() for q in range(1, most + 1)]
        np.testing.assert_array_equal(whole.share, share)
        assert (whole.fewest, whole.tallest) == (s.sum(1).min(), s.max(1).min())


def counted_of(A, C, T, most):
    judged = module.judge(windows.parts(of(A, C), T), T, most, 1e8)
    return module.together(judged, most).counts


def test_where_there_is_nothing_to_say():
    unseen = correctable(of(np.diag([0.5, 0.4]), [[1.0, 0.0]] * 3), 4)
    assert (unseen.observed, unseen.l0.exact, unseen.l1.exact, unseen.reason) == (False, 0, 0, None)
    short = correctable(of([[1.0, 1.0], [0.0, 1.0]], [[1.0, 0.0]] * 3), 1)
    assert (short.observed, short.any.exact) == (False, 0)
    assert "too many" in correctable(of(0.5 * np.eye(40), np.ones((26, 40))), 2).reason
    assert "too many" in correctable(of(0.5 * np.eye(4), np.ones((5, 4))), 2000).reason
