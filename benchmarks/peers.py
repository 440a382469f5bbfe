"""holdfast beside NumPy, filterpy, simdkalman and dynamax, in one run, as ratios.

    pip install ".[bench]"
    python benchmarks/peers.py [--repeat 7]

Every contestant filters the same data of one constant 4-state, 4-output plant; the answers
are compared before anything is timed. Rounds alternate between contestants, so that a change
of the machine's speed meets all of them; the figure is the median over rounds, the ratio is
that of medians. A peer that is not installed is left out and said so.
"""

import argparse
import os
import time
from collections.abc import Callable

os.environ.setdefault("OMP_NUM_THREADS", "1")

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from holdfast import Kalman, Live, Monitor, Observation
from holdfast.detectors import chi_square
from holdfast.estimators import unknown_input
from holdfast.plants.build import linear_plant

jax.config.update("jax_cpu_enable_async_dispatch", False)

N = P = 4
RNG = np.random.default_rng(0)
A = 0.95 * np.eye(N) + 0.01 * RNG.normal(size=(N, N))
C = RNG.normal(size=(P, N))
Q, R = 0.1 * np.eye(N), np.diag([0.1, 0.2, 0.3, 0.4]) + 0.02
X0, P0 = np.zeros(N), np.eye(N)
PLANT = linear_plant(A=A, C=C, Q=Q, R=R)
KALMAN = Kalman(PLANT, jnp.asarray(X0), jnp.asarray(P0))

Contest = dict[str, Callable[[], object]]


def numpy_filter(y):
    x, cov, out = X0, P0, []
    for sample in y:
        x, cov = A @ x, A @ cov @ A.T + Q
        gain = np.linalg.solve(C @ cov @ C.T + R, C @ cov).T
        x, cov = x + gain @ (sample - C @ x), cov - gain @ C @ cov
        out.append(x)
    return np.array(out)


def filterpy_filter():
    from filterpy.kalman import KalmanFilter

    f = KalmanFilter(dim_x=N, dim_z=P)
    f.F, f.H, f.Q, f.R, f.x, f.P = A, C, Q, R, X0.copy(), P0.copy()
    return f


def simdkalman_filter():
    import simdkalman

    return simdkalman.KalmanFilter(A, Q, C, R)


def dynamax_filter():
    from dynamax.linear_gaussian_ssm import inference as lg

    zero = jnp.zeros
    model = lg.ParamsLGSSM(
        lg.ParamsLGSSMInitial(jnp.asarray(A @ X0), jnp.asarray(A @ P0 @ A.T + Q)),
        lg.ParamsLGSSMDynamics(jnp.asarray(A), zero(N), zero((N, 0)), jnp.asarray(Q)),
        lg.ParamsLGSSMEmissions(jnp.asarray(C), zero(P), zero((P, 0)), jnp.asarray(R)),
    )
    return lambda y: lg.lgssm_filter(model, y).filtered_means


def scan(estimator, y, keep):
    """Every ``keep(estimate)`` of a log in which all arrived."""
    everything = jnp.ones(y.shape, bool)
    log = Observation(
        jnp.zeros((*y.shape[:-1], 0)), y, everything, ~everything, jnp.zeros(y.shape[0], jnp.int32)
    )
    start = estimator.init()[0]
    return jax.lax.scan(
        lambda s, o: (lambda s, e: (s, keep(e)))(*estimator.step(s, o)), start, log
    )[1]


def timed(contest: Contest, repeat: int, units: int) -> dict[str, float]:
    """Median seconds per unit of each contestant, rounds alternating."""
    taken: dict[str, list[float]] = {name: [] for name in contest}
    for run in contest.values():
        run()
    for _ in range(repeat):
        for name, run in contest.items():
            start = time.perf_counter()
            run()
            taken[name].append((time.perf_counter() - start) / units)
    return {name: float(np.median(seconds)) for name, seconds in taken.items()}


def show(title: str, unit: str, scale: float, found: dict[str, float]) -> None:
    table = Table(title=title, title_justify="left")
    table.add_column("")
    table.add_column(unit, justify="right")
    table.add_column("times holdfast", justify="right")
    ours = found["holdfast"]
    for name, seconds in found.items():
        table.add_row(name, f"{seconds * scale:.3g}", f"{seconds / ours:.2f}")
    Console().print(table)


def available(contest: dict[str, Callable[[], Callable[[], object]]]) -> Contest:
    """The contestants that are installed."""
    found: Contest = {}
    for name, make in contest.items():
        try:
            found[name] = make()
        except ImportError as missing:
            print(f"{name}: left out, {missing}")
    return found


def live(repeat: int) -> None:
    """One sample from Python, as a control loop would: in with y, out with the estimate."""
    steps = 1000
    y = RNG.normal(size=(steps, P))
    nothing = np.zeros(0)
    G, H = np.eye(N)[:, :2], np.zeros((P, 2))
    attacked = linear_plant(A=A, C=C, Q=Q, R=R, G=G, H=H)

    def ours(estimator):
        stream = Live(Monitor(estimator, chi_square.build(estimator.plant)))

        def run():
            stream.reset()
            for sample in y:
                stream.push(Observation.of(nothing, sample))

        return run

    def numpy_run():
        return lambda: numpy_filter(y)

    def filterpy_run():
        f = filterpy_filter()

        def run():
            for sample in y:
                f.predict()
                f.update(sample)

        return run

    def simdkalman_run():
        from simdkalman.primitives import predict, update

        def run():
            m, cov = X0, P0
            for sample in y:
                m, cov = predict(m, cov, A, Q)
                m, cov = update(m, cov, C, R, sample)

        return run

    contest = {
        "holdfast": lambda: ours(KALMAN),
        "holdfast, unknown_input": lambda: ours(unknown_input.build(attacked, X0, P0)),
        "NumPy": numpy_run,
        "filterpy": filterpy_run,
        "simdkalman": simdkalman_run,
    }
    found = timed(available(contest), repeat, steps)
    show("live step, n = 4, p = 4 (holdfast: estimate and verdict)", "us", 1e6, found)


def trajectory(repeat: int) -> None:
    """10^4 steps at once: means and covariances."""
    steps = 10_000
    y = RNG.normal(size=(steps, P))
    both = jax.jit(lambda y: scan(KALMAN, y, lambda e: (e.x, e.x_cov)))
    np.testing.assert_allclose(np.asarray(both(y)[0])[:500], numpy_filter(y[:500]), atol=1e-9)

    def filterpy_run():
        f = filterpy_filter()
        return lambda: f.batch_filter(y)

    def simdkalman_run():
        f = simdkalman_filter()
        return lambda: f.compute(y[None], 0, initial_value=X0, initial_covariance=P0)

    def dynamax_run():
        run = jax.jit(dynamax_filter())
        np.testing.assert_allclose(np.asarray(run(y)), np.asarray(both(y)[0]), atol=1e-8)
        return lambda: run(y).block_until_ready()

    contest = {
        "holdfast": lambda: lambda: jax.block_until_ready(both(y)),
        "NumPy": lambda: lambda: numpy_filter(y),
        "filterpy": filterpy_run,
        "simdkalman": simdkalman_run,
        "dynamax": dynamax_run,
    }
    show("trajectory of 10^4 steps", "us / step", 1e6, timed(available(contest), repeat, steps))


def batch(repeat: int) -> None:
    """1024 trajectories of 100 steps that share plant, start and pattern of arrival."""
    runs, steps = 1024, 100
    y = RNG.normal(size=(runs, steps, P))
    ours = eqx.filter_jit(jax.vmap(lambda y: scan(KALMAN, y, lambda e: e.x)))

    def simdkalman_run():
        f = simdkalman_filter()
        return lambda: f.compute(y, 0, initial_value=X0, initial_covariance=P0, smoothed=False)

    def dynamax_run():
        run = jax.jit(jax.vmap(dynamax_filter()))
        np.testing.assert_allclose(np.asarray(run(y)), np.asarray(ours(y)), atol=1e-8)
        return lambda: run(y).block_until_ready()

    contest = {
        "holdfast": lambda: lambda: ours(y).block_until_ready(),
        "simdkalman": simdkalman_run,
        "dynamax": dynamax_run,
    }
    found = timed(available(contest), repeat, runs * steps)
    show("batch of 1024 x 100, covariance shared", "ns / step", 1e9, found)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=7, help="rounds")
    rounds = parser.parse_args().repeat
    live(rounds)
    trajectory(rounds)
    batch(rounds)
