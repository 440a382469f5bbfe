"""What a stealthy attacker reaches: the recursion beside the dense formula, and the searches.

    python benchmarks/reaching.py [--repeat 3]

The dense formula is (59) of the INTEGRITY paper as printed: Theta of (49) summed over the steps,
M_k of (44), one solve; NumPy, for the ellipsoid of one step. The recursion gives those of all steps
up to it. Both are compared first (1e-9 relative). The searches have no peer: their times are
printed, with the policy that was found; programs are compiled in the first round.
"""

import argparse
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from holdfast.numerics.reachability import backward, forward, joined
from holdfast.numerics.stealth import Stealth
from holdfast.plants.library import dcacc, vehicle_tracking
from holdfast.plants.watched import watched
from holdfast.reach.bounds import reach
from holdfast.reach.policy import policy
from holdfast.reach.setting import Setting
from holdfast.records import Enforcement

EVERY, LONG, AGREE = 20, 100_000, 1e-9


def asked(plant, detector, level, every=None, duration=1) -> Setting:
    s = watched(plant)
    p = len(s.C)
    held = None if every is None else Enforcement.of([every] * p, duration, every)
    stealth = Stealth(detector, 0.001, level, p)
    return Setting(s, stealth, np.ones(p, bool), held, np.eye(len(s.A)))


def dense(setting: Setting, k: int) -> np.ndarray:
    """Y_k over alpha^2, k the end of a block: M Theta^-1 M' on the attacked entries."""
    A, C, K, Q = setting.system[:4]
    n, p = len(A), len(C)
    columns = np.flatnonzero(setting.alterable(k).reshape(-1))
    inverse = np.linalg.inv(Q)
    M, Theta = np.zeros((n, p * k)), np.zeros((p * k, p * k))
    for i in range(k):
        upto = p * (i + 1)
        N = C @ A @ M[:, :upto]
        N[:, upto - p :] += np.eye(p)
        Theta[:upto, :upto] += N.T @ inverse @ N
        M[:, :upto] = A @ M[:, :upto] - K @ N
    M = M[:, columns]
    return M @ np.linalg.solve(Theta[np.ix_(columns, columns)], M.T)


def recursion(setting: Setting, k: int) -> np.ndarray:
    m, index = setting.moves(k)
    ends = np.zeros(k, np.int32)
    ends[setting.horizons(k) - 1] = 1
    ones = np.ones((k, 1))
    L = forward(m, index, ones, np.zeros(m.F.shape[1:]))
    factors = joined(L, backward(m, index, ones, ends))
    return factors @ np.swapaxes(factors, 1, 2)


def took(work, repeat: int) -> tuple[float, object]:
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        found = work()
        times.append(time.perf_counter() - start)
    return min(times), found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeat", type=int, default=3)
    repeat = parser.parse_args().repeat
    for k in (100, 1000):
        setting = asked(vehicle_tracking.build(), "sprt", 0.015, EVERY)
        recursion(setting, k)
        ours, Y = took(lambda s=setting, k=k: recursion(s, k), repeat)
        theirs, D = took(lambda s=setting, k=k: dense(s, k), 1)
        differ = np.max(np.abs(Y[k - 1] - D)) / np.max(np.abs(D))
        assert differ < AGREE, differ
        print(
            f"vehicle, k = {k}: recursion {1e3 * ours:.2f} ms for every step, dense formula "
            f"{theirs:.2f} s for one, {theirs / ours:.0f} times as long (difference {differ:.0e})"
        )
    setting = asked(vehicle_tracking.build(), "sprt", 0.015, EVERY)
    reach(setting, LONG)
    ours, _ = took(lambda: reach(setting, LONG), repeat)
    print(f"vehicle, sprt, {LONG} steps with alpha at every one: {ours:.2f} s")
    for name, plant, level, limit in (
        ("vehicle", vehicle_tracking.build(), 0.015, 0.7),
        ("dCACC", dcacc.build(), 0.0035, 3.351),
    ):
        for detector, steps in (("sprt", 90), ("chi_square", None), ("windowed", None)):
            setting = asked(plant, detector, level)
            start = time.perf_counter()
            policy(setting, limit, steps)
            first = time.perf_counter() - start
            warm, found = took(lambda s=setting, n=limit, k=steps: policy(s, n, k), repeat)
            held = found.enforcement
            words = "none" if held is None else f"every {held.every[0]} for {held.duration[0]}"
            span = "for ever" if steps is None else f"{steps} steps"
            print(
                f"policy, {name}, {detector}, {span}, limit {limit}: {words}, reaches "
                f"{found.worst:.4g}; {warm:.1f} s (with compiling {first:.1f} s)"
            )


if __name__ == "__main__":
    main()
