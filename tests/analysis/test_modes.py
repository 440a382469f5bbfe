"""Mode reduction against the batch problem in exact arithmetic, set by set."""

import itertools

import numpy as np
import pytest

from analysis.batch import PRIME, reduced
from analysis.models import model, plant
from holdfast.analysis.admissible import DEPENDENT, HIDDEN, UNOBSERVED, only, samples, units
from holdfast.analysis.mode_advice import on_modes
from holdfast.analysis.modes import borders, reduce
from holdfast.analysis.nise_pair import nise_pair, paper_admissible
from holdfast.numerics.gramian import uniformly_observable
from holdfast.plants.library import swing
from systems import quiet_plant, random_system


def rank(matrix):
    return len(reduced(matrix)[1])


def batch(A, G, C, H):
    """All samples and states of a window as integer maps of (x_c, d_c, .., d_{c+l}).

    Lists of one matrix a sample; A[i], G[i] lead from sample i to i + 1.
    """
    (n, nd), T = G[0].shape, len(C)
    state = np.hstack([np.eye(n, dtype=np.int64), np.zeros((n, nd * T), np.int64)])
    states, seen = [state], []
    for i in range(T):
        row = C[i] @ state
        row[:, n + nd * i : n + nd * (i + 1)] += H[i]
        seen.append(row % PRIME)
        state = A[i] @ state
        state[:, n + nd * i : n + nd * (i + 1)] += G[i]
        state %= PRIME
        states.append(state)
    return np.vstack(seen), states


def told(seen, wanted):
    """Whether the rows ``seen`` determine ``wanted``: a rank that does not grow."""
    return rank(np.vstack([seen, wanted])) == rank(seen)


def batch_admissible(A, G, C, H):
    """A constant plant: the last state of n + 1 samples, and of n + 2 the attack before it."""
    n, nd = G.shape
    T = n + 2
    seen, states = batch([A] * T, [G] * T, [C] * T, [H] * T)
    d_before = np.zeros((nd, seen.shape[1]), np.int64)
    d_before[:, n + nd * (T - 2) : n + nd * (T - 1)] = np.eye(nd, dtype=np.int64)
    return told(seen, states[T - 1]) and told(seen, d_before)


def integer_plant(seed):
    """Small integers and many zeros: every way to be refused comes up."""
    rng = np.random.default_rng(seed)
    n, ny, nd = (int(rng.integers(2, 5)) for _ in range(3))
    draw = lambda *shape, keep: rng.integers(-2, 3, shape) * (rng.random(shape) < keep)  # noqa: E731
    A, C = draw(n, n, keep=0.6), draw(ny, n, keep=0.6)
    G, H = draw(n, nd, keep=0.4), draw(ny, nd, keep=0.3)
    return A, G, C, H


def subsets(count):
    return [s for r in range(count + 1) for s in itertools.combinations(range(count), r)]


@pytest.mark.parametrize("block", range(4))
def test_the_sets_that_are_kept_and_refused(block):
    reasons = set()
    for seed in range(15 * block, 15 * block + 15):
        A, G, C, H = integer_plant(seed)
        good = {
            s for s in subsets(G.shape[1]) if batch_admissible(A, G[:, list(s)], C, H[:, list(s)])
        }
        (found,) = reduce(plant(A, G, C, H), np.zeros(len(A))).positions
        maximal = {s for s in good if not any(set(s) < set(t) for t in good)}
        bad = set(subsets(G.shape[1])) - good
        minimal = {s for s in bad if not any(set(t) < set(s) for t in bad)}
        assert {k.channels for k in found.kept} == maximal
        assert {r.channels for r in found.refused} == minimal
        reasons |= {r.reason for r in found.refused}
    assert reasons == {DEPENDENT, HIDDEN, UNOBSERVED}


def test_why_a_set_is_refused():
    """Each reason against its own ranks, at the same step."""
    for seed in range(30):
        A, G, C, H = integer_plant(seed)
        (found,) = reduce(plant(A, G, C, H), np.zeros(len(A))).positions
        for refused in found.refused:
            g, h = G[:, list(refused.channels)], H[:, list(refused.channels)]
            dependent = rank(np.vstack([g, h])) < g.shape[1]
            # d_{k-1} and d_k free, x_{k-1} known: does y_k, with y_{k-1}, determine x_k?
            nothing = np.zeros_like(h)
            seen = np.vstack([np.hstack([h, nothing]), np.hstack([C @ g, h])])
            hidden = not told(seen, np.hstack([g, np.zeros_like(g)]))
            wanted = DEPENDENT if dependent else HIDDEN if hidden else UNOBSERVED
            assert refused.reason == wanted


def long_window(A, G, C, H, first, second):
    """Whether some attack on ``first`` looks for ever like one on ``second``: by ranks.

    Of a long window: does the attack at its middle stay free, on a channel of only one of them?
    """
    union = sorted({*first, *second})
    n, nd = len(A), len(union)
    T = 4 * n + 1
    g, h = G[:, union], H[:, union]
    seen, _ = batch([A] * T, [g] * T, [C] * T, [h] * T)
    apart = [i for i, c in enumerate(union) if (c in first) != (c in second)]
    # a recursion of order n that is zero for n steps is zero always
    for k in range(n, 3 * n):
        wanted = np.zeros((len(apart), seen.shape[1]), np.int64)
        wanted[np.arange(len(apart)), [n + nd * k + i for i in apart]] = 1
        if not told(seen, wanted):
            return True
    return False


def test_which_sets_are_confused():
    answers = []
    for seed in range(40):
        A, G, C, H = integer_plant(seed)
        (found,) = reduce(plant(A, G, C, H), np.zeros(len(A))).positions
        for i, j in itertools.combinations(range(len(found.kept)), 2):
            pair = [found.kept[k].channels for k in (i, j)]
            answers.append((i, j) in found.confusable)
            assert answers[-1] == long_window(A, G, C, H, *pair)
            union = {*pair[0], *pair[1]}
            why = {r.reason for r in found.refused if {*r.channels} <= union}
            # only what comes a sample late may still tell them apart
            assert answers[-1] or why == {HIDDEN}
    assert {True, False} == set(answers)


def test_most_refusals_of_a_union_confuse():
    """But for what only comes late, the two sets of a pair cannot be told apart."""
    # rank(C G) = 1: the second sample tells who it was
    A = np.array([[0, 0, 0], [0, 0, 0], [0, 1, 0]])
    G = np.array([[1, 0], [0, 1], [0, 0]])
    C = np.array([[1, 1, 0], [0, 0, 1]])
    (found,) = reduce(plant(A, G, C), np.zeros(3)).positions
    assert [r.reason for r in found.refused] == [HIDDEN]
    assert (len(found.kept), found.confusable) == (2, ())
    (found,) = reduce(plant(0 * A, G, C), np.zeros(3)).positions
    assert found.confusable == ((0, 1),)


def varying(seed, T):
    rng = np.random.default_rng(seed)
    n, ny, nd = 2, int(rng.integers(1, 3)), 2
    draw = lambda *shape, keep: rng.integers(-2, 3, shape) * (rng.random(shape) < keep)  # noqa: E731
    return (
        draw(T, n, n, keep=0.8), draw(T, n, nd, keep=0.7),
        draw(T, ny, n, keep=0.9), draw(T, ny, nd, keep=0.5),
    )  # fmt: skip


def batch_samples(A, G, C, H, channels):
    """The smallest l + 1 of which all windows determine the last state; as `samples` has it."""
    T, kept = len(C), list(channels)
    moves, G, H = [*A[1:], A[-1]], [*G[1:], G[-1]], list(H)
    G, H = [g[:, kept] for g in G], [h[:, kept] for h in H]
    if any(rank(np.vstack([g, h])) < len(kept) for g, h in zip(G[:-1], H[:-1], strict=True)):
        return None
    for count in range(1, T):
        windows = [slice(k, k + count) for k in range(T - count + 1)]
        found = [batch(moves[w], G[w], list(C)[w], H[w]) for w in windows]
        if all(told(seen, states[count - 1]) for seen, states in found):
            return count
    return None


def free_in_the_middle(A, G, C, H, channels):
    """Whether all samples of the window leave state or attack at its middle free."""
    kept, n, middle = list(channels), A.shape[1], (len(C) - 1) // 2
    moves, G, H = [*A[1:], A[-1]], [*G[1:], G[-1]], list(H)
    seen, states = batch(moves, [g[:, kept] for g in G], list(C), [h[:, kept] for h in H])
    attack = np.zeros((len(kept), seen.shape[1]), np.int64)
    attack[:, n + len(kept) * middle :][:, : len(kept)] = np.eye(len(kept), dtype=np.int64)
    return not told(seen, np.vstack([states[middle], attack]))


def test_matrices_per_step_and_windows():
    counts = []
    for seed in range(25):
        A, G, C, H = varying(seed, 7)
        moving = plant(A, G, C, H, Q=np.eye(2), R=np.eye(C.shape[1]))
        found = reduce(moving, np.zeros(2), window=5, first=2)
        assert (found.steps, found.note) == (5, "steps 2 to 6")
        cut = [m[1:6] for m in (A, G, C, H)]
        need = {s: batch_samples(*cut, s) for s in subsets(2)}
        good = {s for s, count in need.items() if count is not None}
        (position,) = found.positions
        maximal = {s for s in good if not any(set(s) < set(t) for t in good)}
        assert {k.channels: k.samples for k in position.kept} == {s: need[s] for s in maximal}
        counts += [need[s] for s in maximal]
        pairs = itertools.combinations(range(len(maximal)), 2)
        sets = [k.channels for k in position.kept]
        alike = [(i, j) for i, j in pairs if free_in_the_middle(*cut, sets[i] + sets[j])]
        assert list(position.confusable) == alike
    assert {2, 3, 4} <= set(counts)
    assert reduce(moving, np.zeros(2), window=2).reason == "a window of 2 steps, under three"


def test_admissible_sets_shrink_and_the_search_is_short():
    """A subset of an admissible set is admissible; 2^12 sets take few looks."""
    for seed in range(20):
        A, G, C, H = integer_plant(seed)
        steps = units([model(A, G, C, H)])
        ok = {s: samples(only(steps, s)) is not None for s in subsets(G.shape[1])}
        assert all(ok[t] for s in ok if ok[s] for t in ok if set(t) < set(s))
    asked = []
    for forbidden, looks in (([], 1), ([0b11], 20), ([0b11, 0b111000000000], 60)):
        asked.clear()

        def admissible(mask, forbidden=forbidden):
            asked.append(mask)
            return not any(mask & f == f for f in forbidden)

        maximal, minimal = borders(12, admissible)
        assert sorted(minimal) == sorted(forbidden)
        assert len(maximal) == max(1, 2 * (len(forbidden) > 0) * (3 if len(forbidden) > 1 else 1))
        assert len(set(asked)) <= looks
    assert borders(0, lambda mask: False) == ([], [0])


def hard_pair(A, G, C, H, R):
    """(8) and (11) as printed with the errata, with the transformations (6) and (7) and this R."""
    U, values, Vt = np.linalg.svd(H)
    r = int(np.sum(values > 1e-9))
    U1, U2, V1, V2 = U[:, :r], U[:, r:], Vt[:r].T, Vt[r:].T
    T1 = U1.T - U1.T @ R @ U2 @ np.linalg.solve(U2.T @ R @ U2, U2.T)
    T2, Rbar = U2.T, U2.T @ R @ U2
    W, values2, Wt = np.linalg.svd(T2 @ C @ G @ V2)
    q = int(np.sum(values2 > 1e-9))
    W1, W2 = W[:, :q], W[:, q:]
    Tbar1 = W1.T - W1.T @ Rbar @ W2 @ np.linalg.solve(W2.T @ Rbar @ W2, W2.T)
    C1, C2, C3 = T1 @ C, Tbar1 @ T2 @ C, W2.T @ T2 @ C
    M1, G2 = np.diag(1 / values[:r]), G @ V2 @ Wt[:q].T
    M2 = np.linalg.inv(C2 @ G2)
    n = len(A)
    return C3, (np.eye(n) - G2 @ M2 @ C2) @ (A - G @ V1 @ M1 @ C1)


@pytest.mark.parametrize("seed", range(3))
def test_the_paper_s_pair(seed):
    """Whitened outputs give the same rows, and the same eigenvalues that they leave unseen."""
    system = random_system(seed, 4, 3, 2, 1)
    p = system.plant
    A, G, C, H, R = (np.asarray(m) for m in (p.A, p.G, p.C, p.H, p.R))
    pair = nise_pair([model(A, G, C, H, R=R)], (0, 1))
    C3, Abar = hard_pair(A, G, C, H, R)
    assert not pair.hidden
    # the same row space; 1e-9: rounding over the smallest kept singular value, 0.05
    joint = np.vstack([pair.C, C3])
    assert np.linalg.svd(joint, compute_uv=False)[len(C3)] < 1e-9
    ours, theirs = (uniformly_observable(*x) for x in ((pair.A, pair.C), (Abar, C3)))
    assert ours.observable == theirs.observable
    # with the rows of one sample as output, Abar moves only by what they annul after a step
    L = np.linalg.lstsq(np.vstack([pair.C, _z2(A, G, C, H)]).T, (pair.A - Abar).T, rcond=None)
    assert np.allclose(np.vstack([pair.C, _z2(A, G, C, H)]).T @ L[0], (pair.A - Abar).T, atol=1e-9)


def _z2(A, G, C, H):
    """The rows of y that are free of the attack at the same sample."""
    U, values, _ = np.linalg.svd(H)
    return U[:, int(np.sum(values > 1e-9)) :].T @ C


def test_where_the_paper_s_criterion_differs():
    """It is sufficient; it asks for the state at the start, without z_2 of the first sample."""
    both = []
    for seed in range(30):
        A, G, C, H = integer_plant(seed)
        m = model(A, G, C, H)
        n = len(A)
        for s in subsets(G.shape[1]):
            ours, paper = batch_admissible(A, G[:, list(s)], C, H[:, list(s)]), None
            pair = nise_pair([m], s)
            if rank(np.vstack([G, H])[:, list(s)]) < len(s):
                continue
            paper = paper_admissible([m], s)
            both.append((ours, paper))
            if pair.hidden:
                assert not ours
                continue
            rows = [pair.C]
            for _ in range(n - 1):
                rows.append(rows[-1] @ pair.A)
            first = _z2(A, G[:, list(s)], C, H[:, list(s)])
            unseen = _null(np.vstack([*rows, first]))
            after = np.linalg.matrix_power(pair.A, n) @ unseen
            assert ours == (np.max(np.abs(after), initial=0.0) < 1e-6)
    assert set(both) == {(True, True), (True, False), (False, False)}


def _null(m):
    _, values, Vt = np.linalg.svd(m)
    return Vt[int(np.sum(values > 1e-8)) :].T


def test_the_smallest_plant_on_which_they_differ():
    """y_k = x_k + v gives x_k within v, however x came about: no z_3 is needed."""
    scalar = plant([[0.9]], [[1.0]], [[1.0]])
    (found,) = reduce(scalar, np.zeros(1)).positions
    assert [k.channels for k in found.kept] == [(0,)]
    assert found.kept[0].samples == 1
    assert not found.kept[0].uniform.observable
    assert not paper_admissible([model([[0.9]], [[1.0]], [[1.0]])], (0,))


def test_the_paper_s_criterion_is_not_monotone():
    """With d1 alone it refuses, with d1 and d2 it does not: d2 takes z_1 of the first sample in."""
    G, H = np.eye(2), np.array([[0.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    m = model(np.eye(2), G, np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]]), H)
    assert not paper_admissible([m], (0,))
    assert paper_admissible([m], (0, 1))


def test_along_a_trajectory_and_at_a_point():
    """A linear plant is the same everywhere; with states a step it is looked at step by step."""
    A, G, C, H = integer_plant(3)
    constant = plant(A, G, C, H)
    (at_rest,) = reduce(constant, np.zeros(len(A))).positions
    found = reduce(constant, np.ones((2 * len(A) + 4, len(A))))
    assert found.steps == 2 * len(A) + 4
    kept = [{k.channels for k in p.kept} for p in (at_rest, *found.positions)]
    assert kept[0] == kept[1]


def test_too_many_channels():
    """The number is told, and nothing is searched."""
    wide = plant(0.5 * np.eye(2), np.ones((2, 13)), np.eye(2))
    found = reduce(wide, np.zeros(2), most=12)
    assert (found.all, found.positions, found.kept) == (2**13, (), 0)
    assert "13 attack channels, over 12" in found.reason
    assert on_modes(found) == [
        "How far the bank of modes can be reduced cannot be said: 13 attack channels, over 12."
    ]


CART = quiet_plant(
    A=[[1.0, 0.1], [0.0, 1.0]], C=[[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]],
    G=[[0.0, 0.0, 0.005], [0.0, 0.0, 0.1]], H=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]],
    Q=1e-4 * np.eye(2), R=np.eye(3), attacks=("gps", "beacon", "push"),
)  # fmt: skip


def test_sentences():
    """Two sensors of one position: with both attacked, nothing tells the position."""
    assert on_modes(reduce(CART, np.zeros(2))) == [
        "Of 8 modes, 2 are enough: gps+push and beacon+push.",
        "No mode can have gps+beacon attacked: the samples then do not determine the state.",
        "An attack in gps+push can look for ever like one in beacon+push.",
        "Which channels of a mode are attacked is then told by z-tests on its estimates, not by "
        "how probable the mode is.",
    ]


def test_the_68_bus_network():
    """Four positions of two lines, six channels: 256 modes, of which 4 are enough."""
    network = swing.build()
    found = reduce(network, np.asarray(swing.operating_point(network)))
    assert (found.all, found.kept) == (256, 4)
    for position in found.positions:
        assert [k.channels for k in position.kept] == [tuple(range(6))]
        assert (position.refused, position.confusable) == ((), ())
        # every bus has its angle and its frequency measured: the paper's criterion holds too
        assert position.kept[0].uniform.steps == 1


def test_rounding_of_the_decompositions_is_no_coupling():
    # in exact numbers C_3 = (0, -2, 0) sees the second state alone; the bases leave 1e-16 beside it
    A = [[1, 2, 0], [0, -2, 0], [-1, 0, 2]]
    C = [[-1, 0, 0], [0, -2, 0], [2, 0, -1], [0, 0, -1]]
    G = [[2, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    H = [[0, 2, -1, 0], [0, 0, 0, 0], [1, 0, 0, 0], [0, -1, 1, 0]]
    m = model(*(np.array(each, float) for each in (A, G, C, H)))
    pair = nise_pair([m], (0, 1, 2))
    np.testing.assert_array_equal(np.abs(pair.C) > 0, [[False, True, False]])
    assert not paper_admissible([m], (0, 1, 2))
