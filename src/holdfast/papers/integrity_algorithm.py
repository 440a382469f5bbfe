"""INTEGRITY, Section V-B: Algorithm 1, where it stops, and what it accepts."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from holdfast.papers.integrity_systems import (
    QUARTER,
    Policy,
    System,
    ellipsoids,
    norms,
    rotation,
    sure,
    under,
)
from holdfast.papers.rows import Row, claim, read_only

H = 8.4
CLOSE = 1e-9
BLOCKS = 60
"""That are looked at."""
LOUD = sure([[1.0, 0.01], [0.0, 1.0]], np.eye(2), 3.1966, 0.03, (1.0, 1.0))
"""The vehicle with sensors that are good against its process noise."""
SLOW = sure(rotation(1.0, np.pi / 10), [[1.0, 0.0]], 0.1, 1.0,
            (np.exp(0.1j * np.pi), np.exp(-0.1j * np.pi)))  # fmt: skip
"""A rotation by 18 degrees a step of which one coordinate is measured: f = 2."""


class Stopped(NamedTuple):
    """``block`` at whose end line 17 holds, 0 if it never does; the largest error up to the block
    before it, which is what the algorithm takes for all, and up to the last block.
    """

    block: int
    error: float
    later: float


def stopped(of: System, policy: Policy, h: float = H, blocks: int = BLOCKS) -> Stopped:
    """Lines 6 to 17, t the end of a block."""
    Y, ends = under(of, policy, blocks, h), policy.ends(blocks)
    sizes = norms(Y)
    later = float(np.max(sizes))
    for b in range(1, blocks):
        old, new = ends[b - 1], ends[b]
        if _kept(Y, sizes, int(old), int(new)):
            return Stopped(b + 1, float(np.max(sizes[:old])), later)
    return Stopped(0, later, later)


def _kept(Y: np.ndarray, sizes: np.ndarray, old: int, new: int) -> bool:
    """Line 17: each new ellipsoid within an old one, which is enough, the last in the last."""
    if np.max(sizes[old:new]) > np.max(sizes[:old]) * (1.0 + CLOSE):
        return False
    if not _within(Y[new - 1], Y[old - 1][None]):
        return False
    return all(_within(one, Y[:old]) for one in Y[old:new])


def _within(inner: np.ndarray, outer: np.ndarray) -> bool:
    left = np.linalg.eigvalsh(outer - inner)[:, 0]
    return bool(np.any(left >= -CLOSE * np.linalg.norm(inner, 2)))


def terminating(of: System = LOUD, blocks: int = BLOCKS) -> Row:
    """What is reached after line 17 has held."""
    found = stopped(of, Policy(1, 20), blocks=blocks)
    return claim(
        "Section V-B, terminating condition", "once R_t2 and R_1..t2 are within R_t1, R_1..t1, "
        "nothing new is reached: block of t2, largest error before it, and up to block 60",
        [None, "equal", "equal"], [found.block, found.error, found.later],
        found.block > 0 and found.later <= found.error * (1.0 + 1e-6),
        "Vehicle with Q = 3.1966 I, R = 0.03 I, h = 8.4, L = 20. alpha(t) first falls, then grows "
        "for ever: what is within at one block is not at a later one.",
    )  # fmt: skip


def algorithm_1(of: System = LOUD, limit: float = 1.3, most: int = 40) -> Row:
    """The policy that the algorithm accepts, and what is reached under it later."""
    accepted = 0
    for L in range(2, most):
        found = stopped(of, Policy(1, L), blocks=4)
        if found.block == 0 or found.error >= limit:
            break
        accepted = L
    found = stopped(of, Policy(1, accepted))
    return claim(
        "Algorithm 1", "under the policy that it accepts no error over the limit is reached: "
        "limit, L, largest error when it stops and up to block 60", [limit, None, None, "< limit"],
        [limit, accepted, found.error, found.later], found.later < limit,
        "Vehicle with Q = 3.1966 I, R = 0.03 I, h = 8.4, f = 1. The search for policies of the "
        "product uses a limit over stated steps, or a test with a bounded alpha for ever.",
    )  # fmt: skip


def line_4(first: int = 1) -> Row:
    """The first block of the first policy that is tried."""
    return claim(
        "Algorithm 1, line 4", "t_0 = L is the start of a policy of Definition 4, t_0 > 1: t_0 of "
        "the first L that is tried", "> 1", first, first > 1,
        "L = 1 authenticates every step from the first on, so that there is no attack at all.",
    )  # fmt: skip


def line_9(of: System = QUARTER, policy: Policy = Policy(2, 4), blocks: int = 5) -> Row:  # noqa: B008
    """Regions whose t is the start of a block, or its end."""
    ends = policy.ends(blocks)
    starts = ends - policy.f + 1
    k = np.arange(1, starts[-1] + 1)
    free = policy.free(int(ends[-1]), len(of.C))
    found = [
        float(np.max(norms(ellipsoids(of, free, at[np.searchsorted(at, k)], H))))
        for at in (starts, ends)
    ]
    return claim(
        "Algorithm 1, line 9", "t in mu, the start of a block, is the t of Theorem 7: largest "
        "error with it, and with the block's end; rotation by 90 degrees, f = 2, L = 4", "equal",
        found, abs(found[0] / found[1] - 1.0) < 1e-6,
        "t must be the end of the block, t - f + 1 in mu; equal for f = 1 alone.",
    )  # fmt: skip


def largest_L(
    of: System = SLOW, limit: float = 0.4, every: Sequence[int] = range(3, 20), steps: int = 200
) -> Row:
    """The largest error for each L over about 200 steps, and the first L over the limit."""
    f = of.f
    sizes = [float(np.max(norms(under(of, Policy(f, L), -(-steps // L), 4.2)))) for L in every]
    safe = [size < limit for size in sizes]
    first = safe.index(False) if False in safe else len(safe)
    accepted = every[first - 1] if first else 0
    best = max(L for L, fine in zip(every, safe, strict=True) if fine)
    return claim(
        "Algorithm 1, the largest L", "the policy it finds maximises L: L before the first that is "
        "over the limit, and the largest safe one; rotation by 18 degrees, f = 2",
        "equal", [accepted, best], accepted == best,
        f"Over {steps} steps, h = 4.2, limit {limit:g}: errors do not grow with L, as what one "
        "block does not see the next may see.",
    )  # fmt: skip


def unjudged() -> list[Row]:
    """What nothing in a run decides."""
    return [
        read_only(
            "Section IV, overhead", "global enforcement costs far more in a step than sensors "
            "authenticated one after the other", None,
            "About message formats and processors that are not modelled here.",
        ),
        read_only(
            "Section V-A, other detectors", "the method can be extended to cumulative sums and "
            "generalised likelihood ratio tests", None,
            "Not said how. The product bounds per-step and windowed tests by cone programs, with "
            "an attack beside each bound.",
        ),
    ]  # fmt: skip
